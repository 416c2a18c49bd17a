"""Sums over blocks, and repeated entries."""

from __future__ import annotations

import numpy as np
import pytest


@pytest.fixture
def mi(device):
    import mitsuba

    return mitsuba


def gradients(mi, sums, repeated):
    """Of a computation with both in it: by what is repeated, a Vector3f and a Float."""
    import drjit as dr

    rng = np.random.default_rng(0)
    a, b = (
        mi.Vector3f(rng.normal(size=(3, 5)).astype(np.float32)),
        mi.Float(rng.normal(size=5).astype(np.float32)),
    )
    dr.enable_grad(a, b)
    n, m = repeated(a, b, 4)
    wave = n * dr.sin(m * (dr.arange(mi.Float, 20) + 1))
    first, second = sums(wave, n.x * m, 4)
    dr.backward(dr.sum(first.x * first.y * second + dr.square(first.z)))
    return [np.array(v) for v in (first, second, dr.grad(a), dr.grad(b))]


def test_sums_and_repeated_entries_are_those_of_each_alone(mi):
    import drjit as dr

    from relit.rendering.blocks import block_sums, repeat

    alone = gradients(
        mi,
        lambda v, f, n: (mi.Vector3f(*[dr.block_sum(c, n) for c in v]), dr.block_sum(f, n)),
        lambda v, f, n: (mi.Vector3f(*[dr.repeat(c, n) for c in v]), dr.repeat(f, n)),
    )
    together = gradients(
        mi, lambda v, f, n: block_sums((v, f), n), lambda v, f, n: repeat((v, f), n)
    )
    for a, b in zip(alone, together, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-7)
        assert np.abs(a).max() > 0.1


def test_nothing_is_computed_for_each_sum_again(mi):
    """Kernels over all entries: one for the sums, one for their adjoint."""
    import drjit as dr

    from relit.rendering.blocks import block_sums, repeat

    a, width = mi.Vector3f(*[dr.arange(mi.Float, 1000) * k for k in (1, 2, 3)]), 1000 * 8
    b = dr.opaque(mi.Float, 0.5, 1000)
    dr.enable_grad(a, b)
    dr.eval(a, b)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        n, m = repeat((a, b), 8)
        wave = n * dr.sin(m * n.y)
        first, second = block_sums((wave, n + m), 8)
        dr.backward(first.x * first.y * second.z + first.z)
        dr.eval(dr.grad(a), dr.grad(b))
        kernels = [
            k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT and k["size"] == width
        ]
    assert 1 <= len(kernels) <= 2


def test_what_is_the_same_everywhere_has_the_sum_as_its_gradient_and_no_kernel_of_its_own(mi):
    import drjit as dr

    from relit.rendering.blocks import everywhere

    numbers, width = mi.Float(np.arange(27, dtype=np.float32)), 5000
    x = dr.arange(mi.Float, width) / width
    dr.enable_grad(numbers)
    dr.eval(x, numbers)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        total = sum((x + k) * everywhere(mi.Color3f, numbers, k, width) for k in range(9))
        dr.backward(total.x + 2 * total.y + 3 * total.z)
        gradient = np.array(dr.grad(numbers))
        kernels = [
            k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT and k["size"] == width
        ]
    expected = np.array([[c * (np.array(x) + k).sum() for c in (1, 2, 3)] for k in range(9)])
    np.testing.assert_allclose(gradient.reshape(9, 3), expected, rtol=1e-4)
    assert 1 <= len(kernels) <= 2

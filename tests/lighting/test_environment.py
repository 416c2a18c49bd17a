"""The environment map in Dr.Jit against the NumPy conventions, against integrals, and against
finite differences."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from relit.conventions import environment_solid_angles, sample_environment
from relit.lighting.environment import Environment


def unit(rng, n):
    d = rng.normal(size=(n, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def vectors(d):
    return mi.Vector3f(*np.asarray(d, np.float32).T)


@pytest.fixture
def sky():
    image = np.random.default_rng(1).random((7, 12, 3)).astype(np.float32)
    image[2, 3] = 80.0
    image[5] = 0.0
    return image


@pytest.mark.parametrize("shape", [(7, 12), (16, 32), (1, 4)])
def test_lookup_equals_the_conventions(shape):
    rng = np.random.default_rng(0)
    image = rng.random((*shape, 3)).astype(np.float32)
    d = np.concatenate(
        [unit(rng, 4000), [[0, 1, -1e-6], [0, -1, -1e-6], [0, 0, -1], [1e-6, 0, -1]]]
    )
    got = np.array(Environment.from_image(image).eval(vectors(d))).T
    assert np.abs(got - sample_environment(image, d)).max() < 2e-4


def test_density_integrates_to_one_and_belongs_to_the_samples(sky):
    env = Environment.from_image(sky)
    rng = np.random.default_rng(2)
    d = unit(rng, 200_000)
    density = np.array(env.pdf(vectors(d)))
    assert density.min() > 0
    assert np.mean(density) * 4 * np.pi == pytest.approx(1, abs=0.03)
    assert (
        np.array(env._density).reshape(7, 12) * environment_solid_angles(7, 12)
    ).sum() == pytest.approx(1, abs=1e-5)
    s, p = env.sample(mi.Point2f(*rng.random((2, 50_000)).astype(np.float32)))
    assert np.allclose(np.linalg.norm(np.array(s), axis=0), 1, atol=1e-5)
    again = np.array(env.pdf(s))
    assert (
        np.mean(np.abs(again / np.array(p) - 1) > 1e-4) < 2e-3
    )  # but for rounding at the edges of texels


def test_samples_follow_the_density(sky):
    env = Environment.from_image(sky)
    n = 200_000
    s, _ = env.sample(mi.Point2f(*np.random.default_rng(3).random((2, n)).astype(np.float32)))
    s = np.array(s).T
    u, v = (
        np.mod(np.arctan2(s[:, 0], -s[:, 2]) / (2 * np.pi), 1),
        np.arccos(np.clip(s[:, 1], -1, 1)) / np.pi,
    )
    seen, _, _ = np.histogram2d(v, u, bins=(7, 12), range=((0, 1), (0, 1)))
    expected = n * np.array(env._density).reshape(7, 12) * environment_solid_angles(7, 12)
    chi2 = ((seen - expected) ** 2 / expected).sum()
    assert chi2 < 83 + 5 * np.sqrt(2 * 83)


def test_sampling_is_unbiased(sky):
    """E[L / p] is the integral of the bilinear map, also after the texels changed and the table did
    not."""
    env = Environment.from_image(sky)
    d = unit(np.random.default_rng(4), 400_000)
    for image in (sky, sky[::-1].copy()):
        env.radiance = mi.Float(image.ravel())
        s, p = env.sample(
            mi.Point2f(*np.random.default_rng(5).random((2, 400_000)).astype(np.float32))
        )
        got = np.array(env.eval(s) / p).mean(1)
        truth = sample_environment(image, d).mean(0) * 4 * np.pi
        assert np.allclose(got, truth, rtol=0.03)


def test_gradients_agree_with_finite_differences(sky):
    smooth = np.random.default_rng(6).random((6, 10, 3)).astype(np.float32)
    d0, t = unit(np.random.default_rng(7), 200), np.random.default_rng(8).normal(size=(200, 3))

    def value(image, d):
        return np.sum(
            sample_environment(image.astype(np.float64), d).astype(np.float64) * [1, 2, 3]
        )

    env = Environment.from_image(smooth)
    env.radiance = mi.Float(smooth.ravel())
    d = vectors(d0)
    dr.enable_grad(env.radiance, d)
    out = env.eval(d)
    dr.backward(dr.sum(out.x + 2 * out.y + 3 * out.z))
    texels = np.array(dr.grad(env.radiance))
    change = np.random.default_rng(9).random(smooth.shape)
    assert np.dot(texels, change.ravel()) == pytest.approx(
        (value(smooth + change, d0) - value(smooth, d0)), rel=1e-3
    )
    e = 1e-4
    each = np.array(dr.grad(d)).T
    f = lambda s: sample_environment(smooth, d0 + s * e * t) @ [1, 2, 3]  # noqa: E731  directions need not stay unit to first order in u
    inside = np.abs(d0[:, 1]) < 0.95
    difference, adjoint = (f(1) - f(-1)) / (2 * e), (each * t).sum(1)
    kink = (
        np.abs(f(1) - 2 * f(0) + f(-1)) > 1e-3 * np.abs(f(1) - f(-1)) + 1e-6
    )  # a texel centre in between
    ok = inside & ~kink
    assert ok.sum() > 120
    assert np.abs(difference - adjoint)[ok].max() < 0.02 * np.abs(difference[ok]).max()


def test_gradients_at_the_poles_are_finite(sky):
    env = Environment.from_image(sky)
    d = mi.Vector3f([0, 0, 1e-7], [1, -1, 1], [0, 0, 0])
    dr.enable_grad(d)
    dr.backward(dr.sum(env.eval(d)))
    assert np.isfinite(np.array(dr.grad(d))).all()


def test_nothing_is_compiled_in_steady_state(sky):
    env = Environment.from_image(sky)
    random = mi.PCG32(size=sky.size)
    seen = []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for _ in range(4):
            env.radiance = random.next_float32()
            dr.eval(env.radiance, random)
            dr.kernel_history()
            env.rebuild()
            s, p = env.sample(mi.Point2f(random.next_float32(), random.next_float32()))
            dr.eval(env.eval(s) / p, random)
            seen.append([k["hash"] for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT])
    assert seen[0]
    assert seen[1] == seen[2] == seen[3]


def test_black_map_still_samples_all_directions():
    env = Environment.from_image(np.zeros((4, 8, 3), np.float32))
    d, p = env.sample(mi.Point2f(*np.random.default_rng(0).random((2, 1000)).astype(np.float32)))
    assert np.allclose(np.array(p), 1 / (4 * np.pi), rtol=1e-4)
    assert np.isfinite(np.array(d)).all()


def test_wrong_size_is_refused():
    with pytest.raises(ValueError, match="values for a 4 x 8"):
        Environment(mi.Float([1.0, 2.0]), 4, 8)

"""Patches of pixels and the terms on them, against NumPy."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from relit.fit.flash.patches import C1, C2, DARK, SIDE, draw_patches, pyramid_loss, ssim_loss
from relit.fit.passes.pixels import make_bank
from support import flash_ball as scene

N = SIDE**2
CURVE = np.array(
    [
        [(k >> 0 & 1) | (k >> 1 & 2) | (k >> 2 & 4), (k >> 1 & 1) | (k >> 2 & 2) | (k >> 3 & 4)]
        for k in range(N)
    ]
)  # x, y


@pytest.fixture(scope="module")
def bank(device):
    views = scene.cameras(3, 20)
    return make_bank(
        views, [np.zeros((20, 20, 3), np.float32)] * 3, [np.ones((20, 20), np.float32)] * 3
    )


def test_patches_are_squares_inside_one_photo(bank):
    rng = mi.PCG32(size=32 * N, initstate=3)
    dr.eval(rng)
    pixel = np.array(draw_patches(bank, rng, 32 * N)).reshape(32, N)
    view, y, x = pixel // 400, pixel % 400 // 20, pixel % 20
    assert (view == view[:, :1]).all() and len(np.unique(view)) == 3
    np.testing.assert_array_equal(x - x[:, :1], np.tile(CURVE[:, 0], (32, 1)))
    np.testing.assert_array_equal(y - y[:, :1], np.tile(CURVE[:, 1], (32, 1)))
    assert x.max() <= 19 and y.max() <= 19
    with pytest.raises(ValueError, match="multiple"):
        draw_patches(bank, rng, 100)


def patches(seed, count=5):
    """a, b, target (count, N, 3)."""
    rng = np.random.default_rng(seed)
    target = rng.uniform(0.02, 0.9, (count, N, 3))
    return (
        target * rng.uniform(0.8, 1.3, target.shape),
        target * rng.uniform(0.8, 1.3, target.shape),
        target,
    )


def colour(v):
    return mi.Color3f(*[mi.Float(np.ascontiguousarray(c, np.float32)) for c in v.reshape(-1, 3).T])


def test_pyramid_against_numpy(device):
    a, b, t = patches(1)
    weight = np.random.default_rng(2).uniform(0, 1, t.shape[:2])
    scale = (t + 0.02) ** -0.55 * weight[..., None]
    expected = 0.0
    for side in (2, 4, 8):
        block = CURVE[:, 1] // side * SIDE + CURVE[:, 0] // side
        pooled = [
            np.stack([((h - t) * scale)[:, block == k].mean(1) for k in np.unique(block)])
            for h in (a, b)
        ]
        expected += (pooled[0] * pooled[1]).mean()
    got = pyramid_loss(colour(a), colour(b), colour(t), mi.Float(weight.ravel().astype(np.float32)))
    assert float(got[0]) == pytest.approx(expected, rel=1e-4)


def test_ssim_against_numpy(device):
    a, b, t = patches(3)
    valid = np.ones(t.shape[:2], bool)
    valid[1, 7] = False
    p, q, s = ((v + DARK) ** (1 / 2.2) for v in (a, b, t))
    m, mt = (p.mean(1) + q.mean(1)) / 2, s.mean(1)
    variance = np.maximum((p * q).mean(1) - p.mean(1) * q.mean(1), 0)
    covariance = ((p + q) / 2 * s).mean(1) - m * mt
    ssim = (
        (2 * m * mt + C1)
        * (2 * covariance + C2)
        / ((m**2 + mt**2 + C1) * (variance + s.var(1) + C2))
    )
    expected = (1 - ssim[[0, 2, 3, 4]]).mean() / 2
    got = ssim_loss(colour(a), colour(b), colour(t), mi.Bool(valid.ravel()))
    assert float(got[0]) == pytest.approx(expected, rel=1e-3)


def test_both_vanish_at_the_photo_and_have_gradients(device):
    a, _, t = patches(4)
    one = mi.Float(np.ones(t.shape[0] * N, np.float32))
    assert float(pyramid_loss(colour(t), colour(t), colour(t), one)[0]) == 0
    assert abs(float(ssim_loss(colour(t), colour(t), colour(t), one > 0)[0])) < 1e-3
    direction = np.random.default_rng(5).uniform(0.5, 1, a.shape) * np.sign(a - t)
    for loss in (
        lambda c: pyramid_loss(c, c, colour(t), one),
        lambda c: ssim_loss(c, c, colour(t), one > 0),
    ):
        c = colour(a)
        dr.enable_grad(c)
        dr.backward(loss(c))
        gradient = (np.array(dr.grad(c)).T.reshape(a.shape) * direction).sum()
        h = 1e-3
        there, back = (float(loss(colour(a + s * h * direction))[0]) for s in (1, -1))
        assert gradient == pytest.approx((there - back) / (2 * h), rel=0.02)

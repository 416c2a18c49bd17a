"""The first guess of the base colour: shading out, colour left."""

import numpy as np

from relit.materials.intrinsic import base_without_shading, harmonics


def ball(count=4000, seed=0):
    n = np.random.default_rng(seed).normal(size=(count, 3))
    return n / np.linalg.norm(n, axis=1, keepdims=True)


def two_colours(n):
    """Piecewise constant: a stripe that no harmonic of the normal explains."""
    return np.where((np.floor(9 * n[:, :1] + 0.3) % 3 == 0), [[0.15, 0.3, 0.5]], [[0.6, 0.5, 0.4]])


def correlation(a, b):
    return np.corrcoef(np.log(a).ravel(), np.log(b).ravel())[0, 1]


def test_shading_is_taken_out_and_two_colours_stay():
    n = ball()
    base = two_colours(n)
    shading = np.exp(harmonics(n) @ np.array([0.2, 0.6, -0.5, 0.3, 0.2, 0.0, -0.1, 0.15, 0.05]))[
        :, None
    ]
    got = base_without_shading(base * shading, n, np.ones(len(n)))
    for colour in np.unique(base, axis=0):
        which = (base == colour).all(1)
        assert got[which].std(0).max() < 0.05 * got[which].mean()
    ratio = got / base
    assert ratio.std() / ratio.mean() < 0.05  # one common scale
    assert correlation(got, base) > 0.995 > 0.9 > correlation(base * shading, base)


def test_real_diffuse_shading_is_nearly_taken_out():
    """Clamped cosine lobes of three lamps: nine harmonics hold 98 % of them, and the result is
    nearer to the colours than the radiance."""
    n = ball(seed=1)
    base = two_colours(n)
    lamps = np.array([[0.3, 0.9, 0.3], [-0.8, 0.4, -0.45], [0, -1, 0.1]])
    shading = (np.maximum(n @ lamps.T, 0) @ np.array([1.0, 0.5, 0.15]) + 0.25)[:, None]
    got = base_without_shading(base * shading, n, np.ones(len(n)))
    assert (
        correlation(got, base) > 0.95
        and correlation(got, base) > correlation(base * shading, base) + 0.05
    )


def test_mean_luminance_is_one_by_area():
    n = ball(500, seed=2)
    areas = np.random.default_rng(0).uniform(0.1, 3, len(n))
    got = base_without_shading(two_colours(n) * 7.0, n, areas)
    assert abs((areas[:, None] * got).sum(0).mean() / areas.sum() - 1) < 1e-6
    assert (got > 0).all()


def test_black_points_are_no_hole():
    n = ball(800, seed=3)
    radiance = two_colours(n)
    radiance[:40] = 0
    got = base_without_shading(radiance, n, np.ones(len(n)))
    assert np.isfinite(got).all() and got[:40].max() < 0.1 * got[40:].min()

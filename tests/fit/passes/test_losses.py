"""Loss terms against NumPy, what makes them fair to noise and to dark pixels, and the step along
the common scale."""

import mitsuba as mi
import numpy as np
import pytest

from relit.fit.passes.losses import (
    display_loss,
    display_weight,
    dual_loss,
    mask_loss,
    normal_loss,
    weighted_mean,
)
from relit.fit.passes.material_priors import SurfaceOptions, light_prior

N = 500


def colour(x):
    return mi.Color3f(np.ascontiguousarray(np.asarray(x, np.float32).T))


def vector(x):
    return mi.Vector3f(np.ascontiguousarray(np.asarray(x, np.float32).T))


def number(x):
    return float(x[0])


@pytest.fixture(scope="module")
def pair():
    rng = np.random.default_rng(0)
    return rng.uniform(0, 1.5, (N, 3)), rng.uniform(0, 1, (N, 3))


def test_display_loss(pair):
    radiance, target = pair
    active = np.arange(N) % 3 == 0
    expected = ((radiance - target) ** 2 * (target + 0.02) ** -1.1).mean(1)
    assert number(display_loss(colour(radiance), colour(target))) == pytest.approx(
        expected.mean(), rel=1e-4
    )
    assert number(display_loss(colour(radiance), colour(target), mi.Bool(active))) == pytest.approx(
        (expected * active).mean(), rel=1e-4
    )


def test_equal_steps_of_the_display_cost_about_the_same(pair):
    """A difference of one display code weighs alike in dark and in bright pixels; without the
    weight it would differ a hundredfold."""
    codes = np.linspace(0.15, 0.95, 9)
    linear = lambda c: np.repeat((c**2.2)[:, None], 3, 1)  # noqa: E731
    step = linear(codes + 0.01) - linear(codes)
    weight = np.array(display_weight(colour(linear(codes)))).T
    cost, plain = (step**2 * weight).mean(1), (step**2).mean(1)
    assert cost.max() / cost.min() < 3 and plain.max() / plain.min() > 50


def test_mask_loss(pair):
    a, m = pair[1][:, 0], (pair[0][:, 0] > 0.7).astype(float)
    c = a.clip(1e-3, 1 - 1e-3)
    expected = -(m * np.log(c) + (1 - m) * np.log(1 - c)).mean()
    assert number(mask_loss(mi.Float(a), mi.Float(m))) == pytest.approx(expected, rel=1e-4)


def test_normal_loss():
    """SfD Eq. (4): 0 for equal normals, 2 + |2n|_1 for opposite ones, and only where the weight
    says so."""
    n = np.random.default_rng(1).normal(size=(N, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    one, half = mi.Float(np.ones(N)), mi.Float((np.arange(N) < N // 2).astype(float))
    assert number(normal_loss(vector(n), vector(n), one)) == pytest.approx(0, abs=1e-5)
    expected = 2 + 2 * np.abs(n).sum(1)
    assert number(normal_loss(vector(n), vector(-n), one)) == pytest.approx(
        expected.mean(), rel=1e-4
    )
    assert number(normal_loss(vector(n), vector(-n), half)) == pytest.approx(
        (expected * (np.arange(N) < N // 2)).mean(), rel=1e-4
    )


def test_weighted_mean():
    v, w = np.random.default_rng(2).uniform(0, 1, (2, N))
    assert number(weighted_mean(mi.Float(v), mi.Float(w))) == pytest.approx(
        (v * w).sum() / w.sum(), rel=1e-4
    )
    assert number(weighted_mean(mi.Float(v), mi.Float(0 * w))) == 0


def test_two_estimates_are_fair_to_noise():
    """The expectation of the dual loss is the squared error whatever the noise; one estimate would
    add its variance."""
    rng = np.random.default_rng(3)
    count = 200_000
    target, mean, noise = np.full((count, 3), 0.4), 0.5, 0.3
    a, b = (mean + noise * rng.normal(size=(count, 3)) for _ in range(2))
    valid = mi.Bool(np.ones(count, bool))
    weight = (0.4 + 0.02) ** -1.1
    exact = (mean - 0.4) ** 2 * weight
    got = number(dual_loss(colour(a), colour(b), colour(target), valid))
    one = number(dual_loss(colour(a), colour(a), colour(target), valid))
    assert got == pytest.approx(exact, rel=0.1) and one == pytest.approx(
        (exact / weight + noise**2) * weight, rel=0.05
    )


def test_a_saturated_pixel_only_says_at_least():
    target = np.ones((4, 3))
    valid = mi.Bool(np.ones(4, bool))
    brighter, darker = colour(np.full((4, 3), 1.7)), colour(np.full((4, 3), 0.5))
    assert number(dual_loss(brighter, brighter, colour(target), valid)) == 0
    assert number(dual_loss(darker, darker, colour(target), valid)) > 0.1
    nothing = mi.Bool(np.zeros(4, bool))
    assert number(dual_loss(darker, darker, colour(target), nothing)) == 0


# ---------------------------------------------------------------- light


def test_light_prior_prefers_even_grey_light():
    options = SurfaceOptions(light=4)
    rng = np.random.default_rng(5)
    flat = np.full((4, 8, 3), 0.3, np.float32)
    tinted = flat + np.array([0.5, 0.0, -0.5], np.float32)
    rough = flat + rng.normal(size=(4, 8, 1)).astype(np.float32)
    cost = {
        k: number(light_prior(mi.Float(v.ravel()), options))
        for k, v in {"flat": flat, "tinted": tinted, "rough": rough}.items()
    }
    turned = number(light_prior(mi.Float(np.roll(rough, 3, axis=1).ravel()), options))
    assert cost["flat"] < cost["tinted"] and cost["flat"] < cost["rough"]
    assert turned == pytest.approx(
        cost["rough"], rel=1e-5
    )  # it wraps round: no direction is special


def test_light_prior_asks_more_of_tints_that_change():
    rng = np.random.default_rng(6)
    grey, tints = rng.normal(size=(4, 8, 1)).repeat(3, -1), rng.normal(size=(4, 8, 3))
    tints -= tints.mean(-1, keepdims=True)

    def cost(light, tint):
        options = SurfaceOptions(light=4, light_smooth=1.0, light_neutral=0.0, light_tint=tint)
        return number(light_prior(mi.Float(light.astype(np.float32).ravel()), options))

    even = cost(np.zeros((4, 8, 3)), 4.0)  # what the square root adds where nothing changes
    assert cost(grey, 4.0) - even == pytest.approx(cost(grey, 0.0) - even / 5, rel=1e-3)
    assert cost(tints, 4.0) == pytest.approx(5 * cost(tints, 0.0), rel=1e-5)

"""Spherical Gaussians as a light that is optimised."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from relit.lighting.gaussian_light import FLOATS, GaussianLight
from relit.lighting.spherical_gaussians import environment_of


def test_starts_as_an_even_light():
    light = GaussianLight(128, 16, 0.7)
    radiance = np.exp(np.array(light.log_radiance()))
    assert radiance.mean() == pytest.approx(0.7, rel=0.05) and radiance.std() < 0.1


def test_the_map_is_that_of_the_lobes():
    light = GaussianLight(12, 32, 0.5)
    rng = np.random.default_rng(0)
    light.parameters = mi.Float(
        np.array(light.parameters) + rng.normal(0, 0.3, 12 * FLOATS).astype(np.float32)
    )
    light.project()
    radiance = np.exp(np.array(light.log_radiance())).reshape(32, 64, 3)
    assert radiance == pytest.approx(environment_of(light.lobes(), 32, 64), rel=0.06, abs=0.02)


def test_gradients_agree_with_finite_differences():
    light = GaussianLight(5, 8, 0.5)
    start = np.array(light.parameters) + np.random.default_rng(1).normal(0, 0.2, 5 * FLOATS).astype(
        np.float32
    )
    weight = mi.Float(np.random.default_rng(2).uniform(0, 1, 8 * 16 * 3).astype(np.float32))

    def loss(values):
        light.parameters = mi.Float(values.astype(np.float32))
        return float(dr.sum(weight * dr.exp(light.log_radiance()))[0])

    light.parameters = mi.Float(start)
    dr.enable_grad(light.parameters)
    dr.backward(dr.sum(weight * dr.exp(light.log_radiance())))
    gradient = np.array(dr.grad(light.parameters))
    for i in (0, 2, 3, 5, 10, 17, 33):
        step = np.zeros_like(start)
        step[i] = 1e-2
        assert gradient[i] == pytest.approx(
            (loss(start + step) - loss(start - step)) / 2e-2, rel=0.03, abs=0.02
        )


def test_the_sharpest_lobe_stays_as_wide_as_a_texel():
    light = GaussianLight(4, 16, 1.0)
    light.parameters = mi.Float(np.tile(np.array([0, 3, 0, 99, 0, 0, 0], np.float32), 4))
    light.project()
    assert np.allclose(light.lobes().axis, [0, 1, 0]) and light.lobes().sharpness.max() < 2000

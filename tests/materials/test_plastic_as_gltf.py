"""A rough plastic as glTF's dielectric: base colour against diffuse albedo, and the coats against
each other."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from relit.conventions import f0_from_ior
from relit.materials import brdf, rough_plastic
from relit.materials.plastic_as_gltf import base_colour, base_over_diffuse, diffuse_albedo
from relit.materials.rough_plastic import Coat, Plastic, fresnel

IOR = 1.49


def hemisphere(side: int = 160):
    """Directions (Vector3f), evenly in solid angle: a mean of f cos θ_l over them times 2 π is a
    directional albedo."""
    z, phi = np.meshgrid((np.arange(side) + 0.5) / side, 2 * np.pi * (np.arange(side) + 0.5) / side)
    s = np.sqrt(1 - z**2)
    return mi.Vector3f(
        *[mi.Float(c.ravel().astype(np.float32)) for c in (s * np.cos(phi), s * np.sin(phi), z)]
    )


def albedos(kd, base, ks, alpha, degrees):
    """Directional albedos under a uniform light: of the plastic, and of glTF's material with the
    given base colour."""
    n, l = mi.Vector3f(0, 0, 1), hemisphere()
    v = mi.Vector3f(float(np.sin(np.radians(degrees))), 0, float(np.cos(np.radians(degrees))))
    plastic = rough_plastic.evaluate_plastic(
        Plastic(mi.Color3f(kd), mi.Float(ks), mi.Float(alpha)), Coat(IOR), n, v, l
    )
    f0 = mi.Color3f(f0_from_ior(IOR) * ks)
    gltf = brdf.evaluate_brdf(
        brdf.Surface(mi.Color3f(base), mi.Float(np.sqrt(alpha)), mi.Float(0), f0), n, v, l
    )
    return [2 * np.pi * float(dr.mean(c.x)[0]) for c in (plastic, gltf)]


@pytest.mark.slow
@pytest.mark.parametrize("degrees", [0, 45])
@pytest.mark.parametrize("alpha, tolerance", [(0.05, 0.06), (0.14, 0.06), (0.3, 0.06), (0.5, 0.08)])
def test_both_are_as_bright_under_a_uniform_light(alpha, tolerance, degrees):
    for kd, ks in ((0.5, 1.0), (0.2, 0.6)):
        base = kd * float(base_over_diffuse(alpha, ks, IOR))
        plastic, gltf = albedos(kd, base, ks, alpha, degrees)
        assert gltf == pytest.approx(plastic, rel=tolerance)


def test_the_diffuse_albedo_itself_would_be_too_bright():
    for alpha, ratio in ((0.05, 1.035), (0.3, 1.42), (0.8, 2.5)):
        plastic, gltf = albedos(0.5, 0.5, 1.0, alpha, 45)
        assert gltf / plastic == pytest.approx(ratio, rel=0.03)


@pytest.mark.parametrize("alpha, ks", [(0.05, 1.0), (0.3, 0.4), (0.6, 1.8)])
def test_the_factor_is_the_least_squares_one(alpha, ks):
    """Against random pairs of directions by the cosine: no other factor has a smaller error."""
    rng = np.random.default_rng(1)

    def draw():
        return mi.warp.square_to_cosine_hemisphere(
            mi.Point2f(rng.random((2, 200_000)).astype(np.float32))
        )

    v, l = draw(), draw()
    cos_v, cos_l = (np.array(d.z, np.float64) for d in (v, l))
    m = Plastic(mi.Color3f(1), mi.Float(0), mi.Float(alpha))
    plastic = (
        np.array(
            rough_plastic.evaluate_plastic(m, Coat(IOR), mi.Vector3f(0, 0, 1), v, l).x, np.float64
        )
        / cos_l
    )
    h = np.sqrt(np.clip(0.5 + 0.5 * np.array(dr.dot(v, l), np.float64), 0, 1))  # v·h
    f0 = f0_from_ior(IOR) * ks
    gltf = (1 - (f0 + (1 - f0) * (1 - h) ** 5)) / np.pi
    ok = (cos_v > 0.03) & (cos_l > 0.03)  # below it the plastic's cosine is clamped
    assert float(base_over_diffuse(alpha, ks, IOR)) == pytest.approx(
        (plastic * gltf)[ok].sum() / (gltf**2)[ok].sum(), rel=0.01
    )


def test_maps_there_and_back():
    rng = np.random.default_rng(2)
    kd = rng.uniform(0, 1, (16, 16, 3)).astype(np.float32)
    roughness, ks = (
        np.sqrt(rng.uniform(0.03, 0.6, (16, 16))).astype(np.float32),
        rng.uniform(0, 1, (16, 16)).astype(np.float32),
    )
    for r, s in (
        (roughness, ks),
        (roughness[:1, :1], None),
        (roughness, np.repeat(ks[..., None], 3, -1)),
        (roughness[::2, ::2], ks),
    ):
        base = base_colour(kd, r, s, IOR)
        assert (
            base.shape == kd.shape
            and base.dtype == np.float32
            and base.min() >= 0
            and base.max() <= 1
        )
        np.testing.assert_allclose(diffuse_albedo(base, r, s, IOR), kd, atol=2e-4)


def test_one_colour_under_a_coat_that_varies():
    roughness = np.array([[0.3, 0.7]], np.float32)
    base = base_colour(np.full((1, 1, 3), 0.5, np.float32), roughness, None, IOR)
    assert base.shape == (1, 2, 3) and base[0, 0, 0] > 1.2 * base[0, 1, 0]
    np.testing.assert_allclose(diffuse_albedo(base, roughness, None, IOR), 0.5, atol=1e-4)


def test_what_would_exceed_white_is_clipped():
    one = np.ones((1, 1), np.float32)
    assert base_colour(np.ones((2, 2, 3), np.float32), 0.1 * one, 4.0 * one, IOR).max() == 1
    assert base_colour(np.ones((2, 2, 3), np.float32), 0.1 * one, 1.5 * one, IOR).max() < 1


@pytest.mark.parametrize("ks", [0.3, 1.0, 1.5])
def test_both_coats_reflect_alike_at_normal_incidence(ks):
    """F0 is k_s ((ior - 1) / (ior + 1))^2 of both, and so is the lobe's peak, roughness being
    sqrt(alpha)."""
    assert float(fresnel(mi.Float(1), IOR)[0]) == pytest.approx(f0_from_ior(IOR), rel=1e-5)
    n = mi.Vector3f(0, 0, 1)
    for alpha in (0.05, 0.14, 0.3):
        plastic = rough_plastic.evaluate_plastic(
            Plastic(mi.Color3f(0), mi.Float(ks), mi.Float(alpha)), Coat(IOR), n, n, n
        )
        f0 = mi.Color3f(f0_from_ior(IOR) * ks)
        gltf = brdf.evaluate_brdf(
            brdf.Surface(mi.Color3f(0), mi.Float(np.sqrt(alpha)), mi.Float(0), f0), n, n, n
        )
        assert float(gltf.x[0]) == pytest.approx(float(plastic.x[0]), rel=0.01)

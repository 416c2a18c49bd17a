"""The rough plastic against Mitsuba's own, against its NumPy twin, against finite differences, and
in a white furnace."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from relit.materials.rough_plastic import (
    Coat,
    Plastic,
    crossing,
    evaluate_plastic,
    plastic_pdf,
    sample_plastic,
    transmittance_tables,
)
from support.twins.rough_plastic import plastic


def directions(count: int = 400):
    rng = np.random.default_rng(3)
    z = rng.uniform(0.05, 1, (2, count))
    phi = rng.uniform(0, 2 * np.pi, (2, count))
    phi[1, : count // 2] = (
        phi[0, : count // 2] + np.pi + rng.normal(0, 0.1, count // 2)
    )  # near the mirror direction
    z[1, : count // 2] = np.clip(z[0, : count // 2] + rng.normal(0, 0.05, count // 2), 0.05, 1)
    r = np.sqrt(1 - z**2)
    return [np.stack([r[k] * np.cos(phi[k]), r[k] * np.sin(phi[k]), z[k]]) for k in (0, 1)]


def ours(kd, ks, alpha, ior, v, l):
    n = dr.zeros(mi.Vector3f, v.shape[1])
    n.z = 1
    m = Plastic(mi.Color3f(*kd), mi.Float(ks), mi.Float(alpha))
    return np.array(evaluate_plastic(m, Coat(ior), n, mi.Vector3f(v), mi.Vector3f(l)))


@pytest.mark.slow
@pytest.mark.parametrize("ior", [1.33, 1.49, 1.7])
@pytest.mark.parametrize("alpha", [0.05, 0.15, 0.4, 0.9])
def test_agrees_with_mitsuba(alpha, ior):
    kd, ks = (0.6, 0.3, 0.1), 0.7
    v, l = directions()
    bsdf = mi.load_dict(
        {
            "type": "roughplastic",
            "distribution": "ggx",
            "alpha": alpha,
            "int_ior": ior,
            "ext_ior": 1.0,
            "diffuse_reflectance": {"type": "rgb", "value": list(kd)},
            "specular_reflectance": {"type": "rgb", "value": ks},
        }
    )
    si = dr.zeros(mi.SurfaceInteraction3f, v.shape[1])
    si.wi = mi.Vector3f(v)
    theirs = np.array(bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(l)))
    np.testing.assert_allclose(ours(kd, ks, alpha, ior, v, l), theirs, rtol=4e-3, atol=4e-4)


def test_agrees_with_the_twin():
    v, l = directions(100)
    kd, ks, alpha = (0.6, 0.3, 0.1), 0.7, 0.23
    np.testing.assert_allclose(
        ours(kd, ks, alpha, 1.49, v, l),
        plastic(kd, ks, alpha, 1.49, v.T, l.T).T,
        rtol=4e-3,
        atol=2e-4,
    )


def test_gradients():
    """Every parameter, roughness through the tables as well, against central differences."""
    v, l = directions(60)
    n = mi.Vector3f(0, 0, 1)
    start = {"kd": 0.5, "ks": 0.6, "alpha": 0.31, "tilt": 0.05, "light": 0.02}

    def value(p, weights):
        m = Plastic(mi.Color3f(p["kd"]), p["ks"], p["alpha"])
        bent = dr.normalize(n + mi.Vector3f(p["tilt"], 0, 0))
        to = dr.normalize(mi.Vector3f(l) + mi.Vector3f(0, p["light"], 0))
        return dr.sum(evaluate_plastic(m, coat, bent, mi.Vector3f(v), to).y * weights)

    coat = Coat(1.49)
    weights = mi.Float(np.random.default_rng(1).uniform(0, 1, 60))
    for name in start:
        p = {k: mi.Float(x) for k, x in start.items()}
        dr.enable_grad(p[name])
        dr.backward(value(p, weights))
        found = float(dr.grad(p[name])[0])
        e = 2e-3
        ends = [
            float(
                value({k: mi.Float(x + s * e * (k == name)) for k, x in start.items()}, weights)[0]
            )
            for s in (1, -1)
        ]
        expected = (ends[0] - ends[1]) / (2 * e)
        assert found == pytest.approx(expected, rel=0.03), (
            f"{name}: {100 * (found / expected - 1):.1f} % off"
        )


def test_roughness_changes_the_diffuse_part():
    """The gradient of roughness through the tables alone is there: k_s = 0."""
    alpha = mi.Float(0.3)
    dr.enable_grad(alpha)
    m = Plastic(mi.Color3f(0.8), mi.Float(0), alpha)
    v, l = mi.Vector3f(0.6, 0, 0.8), mi.Vector3f(-0.28, 0, 0.96)
    dr.backward(evaluate_plastic(m, Coat(), mi.Vector3f(0, 0, 1), v, l).x)
    assert abs(float(dr.grad(alpha)[0])) > 1e-3


def test_tables_limits():
    """A smooth coat has Fresnel's transmittance; from inside it reflects about .58 of diffuse light
    at 1.49, .01 below the exact mean."""
    t, r = transmittance_tables(1.49)
    assert t[0, -1] == pytest.approx(1 - (0.49 / 2.49) ** 2, abs=2e-3)
    assert r[0] == pytest.approx(0.579, abs=0.01)
    assert (np.diff(t[:, -1]) < 0).all()  # rougher coats lose more
    mu = np.array([0.4, 0.9])
    for through in (False, True):
        np.testing.assert_allclose(
            crossing(mu, 0.3, 1.49, 32, through), crossing(mu, 0.3, 1.49, 80, through), rtol=2e-3
        )


def test_samples_follow_their_density():
    """The mean of f cos / pdf over samples is the albedo that a fine quadrature of the hemisphere
    gives."""
    count = 40_000
    m, n = Plastic(mi.Color3f(0.7), mi.Float(0.9), mi.Float(0.25)), mi.Vector3f(0, 0, 1)
    v = mi.Vector3f(0.6, 0, 0.8)
    rng = mi.PCG32(size=count)
    u = [rng.next_float32() for _ in range(3)]
    l = sample_plastic(m, n, v, u[0], mi.Point2f(u[1], u[2]))
    p = plastic_pdf(m, n, v, l)
    coat = Coat()
    drawn = float(
        dr.mean(dr.select(p > 0, evaluate_plastic(m, coat, n, v, l).x / dr.maximum(p, 1e-9), 0))[0]
    )
    x, y = (
        a.ravel() for a in np.meshgrid((np.arange(800) + 0.5) / 800, (np.arange(800) + 0.5) / 800)
    )
    l = mi.Vector3f(
        np.sqrt(1 - x**2) * np.cos(2 * np.pi * y), np.sqrt(1 - x**2) * np.sin(2 * np.pi * y), x
    )
    exact = float(dr.mean(evaluate_plastic(m, coat, n, v, l).x)[0]) * 2 * np.pi
    assert drawn == pytest.approx(exact, rel=0.02)
    assert exact < 0.9 + 0.1

"""The metallic-roughness BRDF against its NumPy twin, integrals, finite differences, and Mitsuba's
`principled`."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from relit.materials import brdf
from support.twins import brdf as twin

MATERIALS = [  # base colour, roughness, metallic
    ((0.8, 0.4, 0.1), 0.2, 0.0),
    ((0.8, 0.4, 0.1), 0.7, 0.0),
    ((0.9, 0.6, 0.3), 0.3, 1.0),
    ((0.5, 0.5, 0.5), 0.9, 0.5),
]


def surface(base, roughness, metallic, f0=0.04):
    return brdf.Surface(mi.Color3f(*base), mi.Float(roughness), mi.Float(metallic), mi.Float(f0))


def vectors(d):
    return mi.Vector3f(*np.atleast_2d(np.asarray(d, np.float32)).T)


def unit(x):
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def hemisphere(n):
    """n ** 2 stratified uniform directions above +Z, weight 2 pi / n^2 each."""
    z, phi = np.meshgrid((np.arange(n) + 0.5) / n, (np.arange(n) + 0.5) / n * 2 * np.pi)
    s = np.sqrt(1 - z**2)
    return np.stack([s * np.cos(phi), s * np.sin(phi), z], -1).reshape(-1, 3)


def viewer(cos):
    return np.array([np.sqrt(1 - cos * cos), 0.0, cos])


def lobe_energy(cos, roughness):
    return np.array(
        brdf.lobe_albedo(
            mi.Float(np.asarray(cos, np.float32)), mi.Float(np.asarray(roughness, np.float32))
        )
    )


@pytest.mark.parametrize("seed", [0, 1])
def test_equals_the_twin(seed):
    rng = np.random.default_rng(seed)
    count = 3000
    base, rough, metal = rng.random((count, 3)), rng.uniform(0.1, 1, count), rng.random(count)
    n = unit(rng.normal(size=(count, 3)))
    v, l = (
        unit(n * rng.uniform(0.1, 2, (count, 1)) + unit(rng.normal(size=(count, 3))))
        for _ in range(2)
    )
    m = brdf.Surface(mi.Color3f(*base.T), mi.Float(rough), mi.Float(metal), mi.Float(0.05))
    got = np.array(brdf.evaluate_brdf(m, vectors(n), vectors(v), vectors(l))).T
    want = twin.evaluate(base, rough, metal, 0.05, n, v, l, lobe_energy)
    assert np.median(want) > 0.05
    assert np.abs(got / np.maximum(want, 1e-3) - np.where(want > 1e-3, 1, got / 1e-3)).max() < 0.02


def test_directional_albedo_table_is_the_integral_of_the_lobe():
    l = hemisphere(600)
    for cos, roughness in [(0.9, 0.4), (0.5, 0.7), (0.2, 1.0), (0.7, 0.9)]:
        v, n = np.broadcast_to(viewer(cos), l.shape), np.broadcast_to([0.0, 0.0, 1.0], l.shape)
        f = twin.single_scattering(n, v, l, roughness**2, np.ones(3))[:, 0] * l[:, 2]
        assert lobe_energy(cos, roughness).item() == pytest.approx(f.mean() * 2 * np.pi, abs=0.01)


@pytest.mark.parametrize("roughness", [0.3, 0.6, 0.9, 1.0])
@pytest.mark.parametrize(("cos", "too_much"), [(0.2, 0.25), (0.5, 0.04), (0.9, 0.01)])
def test_white_furnace(roughness, cos, too_much):
    """A white metal in a white room is white. A white dielectric returns somewhat too much towards
    the rim, as glTF's own model does: its Lambertian part is weighted with 1 - F(v.h) instead of
    what the lobe leaves over."""
    l = hemisphere(400)
    for metallic, low, high in [(1.0, 0.985, 1.01), (0.0, 0.96, 1 + too_much)]:
        m = surface((1, 1, 1), roughness, metallic)
        f = brdf.evaluate_brdf(m, mi.Normal3f(0, 0, 1), vectors(viewer(cos)), vectors(l))
        assert low < np.array(f)[0].mean() * 2 * np.pi < high


def test_reciprocity_of_the_single_scattering_lobe():
    """The compensation of Turquin 2019 is one-sided by construction; what it multiplies is
    symmetric."""
    rng = np.random.default_rng(3)
    v, l = (unit(rng.normal(size=(500, 3)) + np.array([0, 0, 1.2])) for _ in range(2))
    up = (v[:, 2] > 0.05) & (l[:, 2] > 0.05)
    v, l, n = v[up], l[up], mi.Normal3f(0, 0, 1)
    m = surface((0.9, 0.5, 0.2), 0.5, 1.0)

    def lobe(a, b):
        energy = lobe_energy(a[:, 2], np.full(len(a), 0.5, np.float32))[:, None]
        compensation = 1 + np.array([0.9, 0.5, 0.2]) * (1 / energy - 1)
        return (
            np.array(brdf.evaluate_brdf(m, n, vectors(a), vectors(b))).T / compensation / b[:, 2:]
        )

    assert np.allclose(lobe(v, l), lobe(l, v), rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize(("base", "roughness", "metallic"), MATERIALS)
@pytest.mark.parametrize("cos", [0.15, 0.8])
def test_density_integrates_to_the_part_above_the_horizon(base, roughness, metallic, cos):
    m, n, v = surface(base, roughness, metallic), mi.Normal3f(0, 0, 1), vectors(viewer(cos))
    total = np.array(brdf.brdf_pdf(m, n, v, vectors(hemisphere(1200)))).mean() * 2 * np.pi
    u = np.random.default_rng(0).random((3, 100_000)).astype(np.float32)
    l = brdf.sample_brdf(m, n, v, mi.Float(u[0]), mi.Point2f(u[1], u[2]))
    assert total == pytest.approx(np.mean(np.array(l.z) > 0), abs=0.01)


@pytest.mark.parametrize(("base", "roughness", "metallic"), MATERIALS)
@pytest.mark.parametrize("cos", [0.15, 0.8])
def test_samples_follow_the_density(base, roughness, metallic, cos):
    """Chi-squared over cells of equal solid angle, in the frame of a tilted normal."""
    normal = unit(np.array([0.3, -0.5, 0.8]))
    frame = mi.Frame3f(mi.Normal3f(vectors(normal)))
    m, n = surface(base, roughness, metallic), mi.Normal3f(vectors(normal))
    v = frame.to_world(vectors(viewer(cos)))
    count, rows, columns, fine = 60_000, 12, 24, 24
    u = np.random.default_rng(1).random((3, count)).astype(np.float32)
    l = np.array(
        frame.to_local(brdf.sample_brdf(m, n, v, mi.Float(u[0]), mi.Point2f(u[1], u[2])))
    ).T
    phi = np.mod(np.arctan2(l[:, 1], l[:, 0]) / (2 * np.pi), 1)
    seen, _, _ = np.histogram2d(l[:, 2], phi, bins=(rows, columns), range=((0, 1), (0, 1)))
    z, p = np.meshgrid(
        (np.arange(rows * fine) + 0.5) / (rows * fine),
        (np.arange(columns * fine) + 0.5) / (columns * fine),
        indexing="ij",
    )
    s = np.sqrt(1 - z**2)
    grid = frame.to_world(
        vectors(
            np.stack([s * np.cos(2 * np.pi * p), s * np.sin(2 * np.pi * p), z], -1).reshape(-1, 3)
        )
    )
    density = np.array(brdf.brdf_pdf(m, n, v, grid)).reshape(rows, fine, columns, fine).mean((1, 3))
    expected = density * count * 2 * np.pi / (rows * columns)
    ok = expected > 5
    chi2, dof = ((seen - expected)[ok] ** 2 / expected[ok]).sum(), ok.sum()
    assert chi2 < dof + 6 * np.sqrt(2 * dof)


@pytest.mark.parametrize("roughness", [0.2, 0.6])
@pytest.mark.parametrize("cos", [-0.3, 0.05, 0.3])
def test_sampling_is_unbiased(cos, roughness):
    """E[n.l / p] is pi, also where the lobe is too narrow for a grid and where the interpolated
    normal looks away from the viewer."""
    m, n, v = surface((0.8, 0.4, 0.1), roughness, 0.3), mi.Normal3f(0, 0, 1), vectors(viewer(cos))
    u = np.random.default_rng(2).random((3, 400_000)).astype(np.float32)
    l = brdf.sample_brdf(m, n, v, mi.Float(u[0]), mi.Point2f(u[1], u[2]))
    p = np.array(brdf.brdf_pdf(m, n, v, l))
    got = np.where(p > 0, np.array(l.z) / np.maximum(p, 1e-9), 0)
    assert got.mean() == pytest.approx(np.pi, abs=max(0.02, 4 * got.std() / np.sqrt(len(p))))
    assert got.std() < 20


def test_the_viewer_behind_an_interpolated_normal_is_not_black():
    value = brdf.evaluate_brdf(
        surface((0.8, 0.8, 0.8), 0.5, 0.0),
        mi.Normal3f(0, 0, 1),
        vectors(viewer(-0.1)),
        vectors(viewer(0.7) * [-1, 1, 1]),
    )
    assert np.array(value).min() > 0.05


@pytest.mark.parametrize(("base", "roughness", "metallic"), MATERIALS)
def test_gradients_agree_with_finite_differences(base, roughness, metallic):
    """Of the material, the normal, the viewer and the light, in double steps of a float64 twin."""
    rng = np.random.default_rng(4)
    n = unit(rng.normal(size=(1, 3)))
    v, l = (unit(n + 0.6 * rng.normal(size=(1, 3))) for _ in range(2))
    assert min((n * v).sum(), (n * l).sum()) > 0.1
    weight = np.array([0.5, 1.0, 2.0])
    x0 = np.concatenate([base, [roughness, min(metallic, 0.95)], n[0], v[0], l[0]])
    energy = lambda c, r: 0.5 + 0 * c  # noqa: E731  held fixed in the twin: the table's own slope is tested below

    def value(x):
        f = twin.evaluate(
            x[None, :3], x[3:4], x[4:5], 0.04, x[None, 5:8], x[None, 8:11], x[None, 11:14], energy
        )
        return (f * weight).sum()

    x = [mi.Float(float(c)) for c in x0]
    for c in x:
        dr.enable_grad(c)
    original, brdf.lobe_albedo = brdf.lobe_albedo, lambda c, r: mi.Float(0.5)
    try:
        m = brdf.Surface(mi.Color3f(*x[:3]), x[3], x[4], mi.Float(0.04))
        f = brdf.evaluate_brdf(m, mi.Vector3f(*x[5:8]), mi.Vector3f(*x[8:11]), mi.Vector3f(*x[11:]))
    finally:
        brdf.lobe_albedo = original
    dr.backward(0.5 * f.x + f.y + 2 * f.z)
    got = np.array([dr.grad(c)[0] for c in x])
    e = 1e-5
    want = np.array([(value(x0 + e * d) - value(x0 - e * d)) / (2 * e) for d in np.eye(len(x0))])
    assert np.abs(got - want).max() < 0.02 * np.abs(want).max()
    assert np.abs(got[:5] - want[:5]).max() < 0.02 * np.abs(want[:5]).max()


def test_gradient_of_the_albedo_table():
    c, r = mi.Float([0.21, 0.55, 0.83]), mi.Float([0.4, 0.73, 0.95])
    dr.enable_grad(c, r)
    dr.backward(dr.sum(brdf.lobe_albedo(c, r)))
    e = 2e-3
    for grad, dc, drr in ((dr.grad(c), e, 0), (dr.grad(r), 0, e)):
        f = lambda s, dc=dc, drr=drr: lobe_energy(dr.detach(c) + s * dc, dr.detach(r) + s * drr)  # noqa: E731
        assert np.allclose(np.array(grad), (f(1) - f(-1)) / (2 * e), rtol=0.05, atol=5e-3)


@pytest.mark.parametrize(("base", "roughness", "metallic"), [m for m in MATERIALS if m[1] <= 0.7])
def test_close_to_mitsubas_principled(base, roughness, metallic):
    """Same D, F, G; ours is compensated and its diffuse has no retro-reflection: 12 percent at
    moderate angles, on average 6."""
    material = {
        "type": "principled",
        "base_color": {"type": "rgb", "value": list(base)},
        "roughness": roughness,
        "metallic": metallic,
        "eta": 1.5,
    }
    other = mi.load_dict(material)
    rng = np.random.default_rng(5)
    v, l = (unit(rng.normal(size=(2000, 3)) * 0.5 + [0, 0, 1]) for _ in range(2))
    ok = (v[:, 2] > 0.6) & (l[:, 2] > 0.6)
    v, l = vectors(v[ok]), vectors(l[ok])
    si = dr.zeros(mi.SurfaceInteraction3f, int(ok.sum()))
    si.wi = v
    want = np.array(other.eval(mi.BSDFContext(), si, l)).sum(0)
    m = surface(base, roughness, metallic)
    energy = 1 / lobe_energy(np.array(v)[2], np.full(int(ok.sum()), roughness, np.float32)) - 1
    got = np.array(brdf.evaluate_brdf(m, mi.Normal3f(0, 0, 1), v, l)).sum(0)
    tint = metallic * np.mean(base) + (1 - metallic) * 0.04
    error = got / (1 + metallic * tint * energy) / want - 1
    assert np.abs(error).mean() < 0.06
    assert np.quantile(np.abs(error), 0.95) < 0.12

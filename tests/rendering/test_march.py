"""The volume march: against its NumPy twin, and its hand-written adjoint against finite
differences."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from relit.geometry.sdf import make_grid, node_positions
from relit.rendering.march import march, sphere_interval
from support.twins import march as twin

N, RAYS = 16, 64
STEPS = {
    "values": 3e-4,
    "features": 1e-2,
    "o": 2e-4,
    "d": 1e-4,
}  # large against float32, small against the kinks of the quadrature


def vectors(x):
    return mi.Vector3f(np.ascontiguousarray(np.asarray(x, np.float32).T))


def lumpy():
    """Distances and features (n, n, n, 4) of a small object without symmetry."""
    p = node_positions(N)
    values = (
        np.linalg.norm(p - np.array([0.1, 0, 0.05]), axis=-1)
        - 0.6
        + 0.05 * np.sin(5 * p[..., 0]) * np.cos(4 * p[..., 1])
    )
    return values.astype(np.float32), np.random.default_rng(1).uniform(0, 1, (N, N, N, 4)).astype(
        np.float32
    )


def rays(rng, count, distance=2.5, spread=0.5):
    o = rng.normal(size=(count, 3))
    o = o / np.linalg.norm(o, axis=1, keepdims=True) * distance
    d = rng.uniform(-spread, spread, (count, 3)) - o
    return o.astype(np.float32), (d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32)


def interval(o, d):
    t0, t1 = sphere_interval(vectors(o), vectors(d))
    return np.array(t0), np.array(t1)


def run(grid, o, d, t0, t1, inv_s, dt):
    m = march(
        grid,
        vectors(o),
        vectors(d),
        mi.Float(t0),
        mi.Float(t1),
        dr.opaque(mi.Float, inv_s),
        dr.opaque(mi.Float, dt),
    )
    return (
        np.array([np.array(f) for f in m.features]).T,
        np.array(m.normal).T,
        np.array(m.depth),
        np.array(m.transmittance),
    )


@pytest.mark.slow
@pytest.mark.parametrize("sharpness, step", [(1.0, 0.9), (4.0, 0.3)])
@pytest.mark.parametrize("band", [np.inf, 3.0])
def test_forward_agrees_with_the_twin(sharpness, step, band):
    values, features = lumpy()
    grid = make_grid(values, 4, band=band, features=features, fill=0.25)
    if band < np.inf:
        features = np.where((np.abs(values) < band * grid.h)[..., None], features, np.float32(0.25))
    o, d = rays(np.random.default_rng(0), RAYS, spread=0.8)
    o[:8] *= 0.1  # from inside
    t0, t1 = interval(o, d)
    inv_s, dt = sharpness / grid.h, step * grid.h
    got = run(grid, o, d, t0, t1, inv_s, dt)
    want = twin.march(
        values.astype(float),
        features.astype(float),
        o.astype(float),
        d.astype(float),
        t0,
        t1,
        inv_s,
        dt,
    )
    assert want[3].min() < 0.1 and want[3].max() > 0.95  # some rays hit, some do not
    for name, a, b in zip(
        ("features", "normal", "depth", "transmittance"), got, want, strict=False
    ):
        # A sample whose alpha stands at MIN_ALPHA, or whose T at MIN_TRANSMITTANCE, may fall on
        # either side in float32.
        assert np.abs(a - b).max() < 5e-3, name
        assert np.quantile(np.abs(a - b), 0.95) < 1e-4, name


def test_weights_and_features_add_up():
    """Constant features come out times the opacity, and the accumulated gradient points back along
    central rays."""
    values, _ = lumpy()
    grid = make_grid(values, 4, band=np.inf, fill=[1.0, 2.0, 3.0, 4.0])
    o, d = rays(np.random.default_rng(2), RAYS)
    t0, t1 = interval(o, d)
    F, normal, depth, T = run(grid, o, d, t0, t1, 4 / grid.h, 0.2 * grid.h)
    assert (
        np.abs(F - (1 - T)[:, None] * [1, 2, 3, 4]).max() < 0.1
    )  # up to the samples below MIN_ALPHA
    hit = T < 0.01
    assert hit.sum() > 30
    assert ((normal * d).sum(1)[hit] < 0).all()
    x = o[hit] + d[hit] * (depth[hit] / F[hit, 0])[:, None]
    assert np.mean([abs(twin.distance(values, p)[0]) for p in x.astype(float)]) < 0.3 * grid.h


def test_rays_that_miss_see_nothing():
    values, features = lumpy()
    grid = make_grid(values, 4, band=np.inf, features=features)
    o = np.tile(np.array([[0, 0, -3]], np.float32), (3, 1))
    d = np.array(
        [[0, 0, -1], [1, 0, 0], [0.6, 0, 0.8]], np.float32
    )  # away, sideways, past the sphere
    t0, t1 = interval(o, d)
    assert (t1 <= t0).all()
    F, normal, depth, T = run(grid, o, d, t0, t1, 4 / grid.h, 0.2 * grid.h)
    assert (T == 1).all() and (F == 0).all() and (normal == 0).all() and (depth == 0).all()


def test_a_ray_from_inside_leaves_without_a_surface():
    """NeuS' alpha counts entries only: from inside the object, going out adds no opacity."""
    values, features = lumpy()
    grid = make_grid(values, 4, band=np.inf, features=features)
    d = np.array([[0, 0, 1], [1, 0, 0], [0, -1, 0]], np.float32)
    o = np.tile(np.array([[0.1, 0, 0.05]], np.float32), (3, 1))
    t0, t1 = interval(o, d)
    assert (t0 == 0).all() and (np.abs(t1 - 1) < 0.15).all()
    *_, T = run(grid, o, d, t0, t1, 4 / grid.h, 0.2 * grid.h)
    assert (T > 0.95).all()


def test_sphere_interval():
    o, d = rays(np.random.default_rng(3), 200, spread=1.2)
    t0, t1 = interval(o, d)
    hit = t1 > t0
    assert 20 < hit.sum() < 200
    for t in (t0[hit], t1[hit]):
        assert np.abs(np.linalg.norm(o[hit] + d[hit] * t[:, None], axis=1) - 1).max() < 1e-4
    closest = np.linalg.norm(o - d * (o * d).sum(1, keepdims=True), axis=1)
    assert (hit == (closest < 1)).mean() > 0.99


# ---------------------------------------------------------------- the adjoint


class Problem:
    """A weighted sum of all outputs as a function of row values, features, origins and
    directions."""

    def __init__(
        self, weights=("features", "normal", "depth", "transmittance"), sharpness=1.0, step=0.1
    ):
        rng = np.random.default_rng(0)
        values, features = lumpy()
        self.grid = make_grid(values, 4, band=np.inf, features=features)
        o, d = rays(rng, RAYS)
        w = {
            k: rng.normal(size=s)
            for k, s in {
                "features": (4, RAYS),
                "normal": (3, RAYS),
                "depth": RAYS,
                "transmittance": RAYS,
            }.items()
        }
        self.w = {k: v.astype(np.float32) * (k in weights) for k, v in w.items()}
        self.inv_s, self.dt = (
            dr.opaque(mi.Float, sharpness / self.grid.h),
            dr.opaque(mi.Float, step * self.grid.h),
        )
        # the interval is a constant of the quadrature
        self.t0, self.t1 = sphere_interval(vectors(o), vectors(d))
        self.start = {
            "values": np.array(self.grid.row_values),
            "features": np.array(self.grid.features),
            "o": o,
            "d": d,
        }

    def loss(self, x):
        grid = self.grid
        grid.row_values, grid.features = x["values"], x["features"]
        dr.scatter(
            grid.values,
            dr.gather(mi.Float, dr.detach(x["values"]), dr.arange(mi.UInt32, grid.rows - 1) + 1),
            grid.nodes,
        )
        m = march(grid, x["o"], x["d"], self.t0, self.t1, self.inv_s, self.dt)
        out = dr.sum(m.depth * mi.Float(self.w["depth"])) + dr.sum(
            m.transmittance * mi.Float(self.w["transmittance"])
        )
        for k in range(4):
            out += dr.sum(m.features[k] * mi.Float(self.w["features"][k]))
        for k in range(3):
            out += dr.sum(m.normal[k] * mi.Float(self.w["normal"][k]))
        return out

    def arrays(self, changed=None, change=0.0):
        x = dict(self.start)
        if changed:
            x[changed] = x[changed] + change
        return {
            k: vectors(v) if v.ndim == 2 else mi.Float(v.astype(np.float32)) for k, v in x.items()
        }

    def gradients(self):
        x = self.arrays()
        dr.enable_grad(*x.values())
        dr.backward(self.loss(x))
        return {
            k: np.array(dr.grad(v)).T if self.start[k].ndim == 2 else np.array(dr.grad(v))
            for k, v in x.items()
        }

    def difference(self, name, direction):
        e = STEPS[name]
        low, high = (float(self.loss(self.arrays(name, s * e * direction))[0]) for s in (-1, 1))
        return (high - low) / (2 * e)


@pytest.fixture(scope="module")
def problem():
    p = Problem()
    return p, p.gradients()


@pytest.mark.parametrize("name", ["values", "features", "o", "d"])
def test_gradient_agrees_with_finite_differences(problem, name):
    """Along the sign of the gradient: a random direction cancels, and what is left is samples that
    cross MIN_ALPHA."""
    p, gradients = problem
    g = gradients[name]
    direction = np.sign(g).astype(np.float32)
    assert np.isfinite(g).all() and np.abs(g).max() > 0
    assert p.difference(name, direction) == pytest.approx(float((g * direction).sum()), rel=0.02)


@pytest.mark.parametrize("name", ["values", "features", "o", "d"])
def test_the_adjoint_itself_is_exact(monkeypatch, name):
    """Without MIN_ALPHA, whose crossing moves the difference and not the gradient, the two agree to
    .1 %.

    Rays that move see the trilinear normal jump from cell to cell, which is no part of its
    derivative: where everything is moved along the sign of the gradient the normal's share is up to
    40 % short. So origins and directions are tested on the other outputs; a field whose normal does
    not jump is in tests/fit/passes/test_gradients.py.
    """
    monkeypatch.setattr("relit.rendering.march.MIN_ALPHA", 0.0)
    p = (
        Problem()
        if name in ("values", "features")
        else Problem(weights=("features", "depth", "transmittance"))
    )
    g = p.gradients()[name]
    direction = np.sign(g).astype(np.float32)
    assert p.difference(name, direction) == pytest.approx(float((g * direction).sum()), rel=0.005)


@pytest.mark.parametrize("output", ["features", "normal", "depth", "transmittance"])
def test_gradient_of_each_output(output):
    p = Problem(weights=(output,))
    g = p.gradients()["values"]
    direction = np.sign(g).astype(np.float32)
    assert p.difference("values", direction) == pytest.approx(
        float((g * direction).sum()), rel=0.02
    )


def test_gradient_of_blocks_of_the_grid(monkeypatch):
    """The eight octants one by one, so that errors of opposite sign cannot hide each other. Without
    MIN_ALPHA: the few rays of an octant cross it often enough to move the difference by up to 6 %;
    without it the two agree to 0.1 %."""
    monkeypatch.setattr("relit.rendering.march.MIN_ALPHA", 0.0)
    p = Problem()
    g = p.gradients()["values"]
    octant = (np.sign(node_positions(N)) @ [1, 2, 4]).ravel()
    for k in np.unique(octant):
        direction = np.zeros_like(g)
        direction[1:] = np.sign(g[1:]) * (octant == k)
        assert p.difference("values", direction) == pytest.approx(
            float((g * direction).sum()), rel=0.005
        ), k


def test_outside_the_band_nothing_gets_a_gradient():
    """Row 0 takes what falls on nodes outside the band, and it belongs to none of them; the rows of
    the band do as without a band."""
    values, features = lumpy()
    o, d = rays(np.random.default_rng(0), RAYS)
    found = {}
    for band in (np.inf, 2.0):
        grid = make_grid(values, 4, band=band, features=np.full_like(features, 0.5), fill=0.5)
        dr.enable_grad(grid.row_values)
        t0, t1 = sphere_interval(vectors(o), vectors(d))
        m = march(
            grid,
            vectors(o),
            vectors(d),
            t0,
            t1,
            dr.opaque(mi.Float, 1 / grid.h),
            dr.opaque(mi.Float, 0.5 * grid.h),
        )
        dr.backward(dr.sum(m.transmittance))
        g, at = np.zeros(N**3), np.array(grid.nodes)
        g[at] = np.array(dr.grad(grid.row_values))[1:]
        found[band] = g
        assert grid.rows == len(at) + 1
        inside = np.abs(values.ravel()) < band * grid.h
        assert set(at) == set(np.flatnonzero(inside))
    assert np.allclose(found[2.0][inside], found[np.inf][inside], atol=1e-4)
    assert (found[2.0][~inside] == 0).all() and np.abs(found[np.inf][~inside]).max() > 0

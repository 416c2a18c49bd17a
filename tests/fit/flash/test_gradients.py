"""The flash's shading in the volume pass and its soft shadows (PIR Eq. 4 and 5) against finite
differences, on small fields."""

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import relit.rendering.march as marching
from relit.fit.passes.losses import display_loss
from relit.fit.passes.pixels import batch_of, make_bank
from relit.geometry.sdf import make_grid, node_positions
from relit.geometry.se3 import look_at
from relit.materials.rough_plastic import Coat
from relit.rendering.appearance.fixed_light import CHANNELS
from relit.rendering.appearance.flash_light import NODES, FlashAppearance, start_learnt
from relit.rendering.march import march, sphere_interval
from relit.scene import Camera

N, SIZE = 16, 10
ABOVE = ([0.5, 0.3, 2.2], [-0.5, 0.6, 2.0], [0.2, -0.8, 2.4], [0.4, 0.7, 2.0])


@pytest.fixture(autouse=True)
def even_steps(monkeypatch):
    """What crosses a threshold, or a step that grows, moves the quadrature: that is no
    gradient's."""
    for name, off in {"MIN_ALPHA": 0.0, "MIN_TRANSMITTANCE": 0.0, "ACCELERATE": 1e3}.items():
        monkeypatch.setattr(marching, name, off)


def put(grid, rows):
    """Let the field have these distances in its rows, for look-ups and for gradients."""
    grid.row_values = rows
    dr.scatter(
        grid.values,
        dr.gather(mi.Float, dr.detach(rows), dr.arange(mi.UInt32, grid.rows - 1) + 1),
        grid.nodes,
    )


def check(loss, start, name, step, parts=4):
    """Along the sign of the gradient, over all entries and over parts of them. loss: {name: Float}
    -> Float."""
    x = {k: mi.Float(v) for k, v in start.items()}
    dr.enable_grad(x[name])
    dr.backward(loss(x))
    g = np.array(dr.grad(x[name]), np.float64)
    assert np.isfinite(g).all() and np.abs(g).max() > 0
    kind = np.arange(g.size) * parts // g.size
    for chosen in (np.ones(g.size, bool), *(kind == k for k in range(parts))):
        direction = (np.sign(g) * chosen).astype(np.float32)
        expected = float((g * direction).sum())
        ends = [
            float(
                loss(
                    {
                        **{k: mi.Float(v) for k, v in start.items()},
                        name: mi.Float(start[name] + np.float32(s * step) * direction),
                    }
                )[0]
            )
            for s in (1, -1)
        ]
        assert (ends[0] - ends[1]) / (2 * step) == pytest.approx(
            expected, rel=0.03, abs=2e-3 * np.abs(g).sum()
        )


class FlashPhotos:
    """Rays onto a saddle, which trilinear interpolation holds exactly; `shadows`: with a ball
    between it and the flash."""

    def __init__(self, shadows: bool):
        rng = np.random.default_rng(0)
        p = node_positions(N).astype(np.float64)
        x, y, z = np.moveaxis(p, -1, 0)
        values = z + 0.1 * x + 0.25 * x * y - 0.2 * y * z + 0.1 * x * y * z + 0.15
        if shadows:
            values = np.minimum(
                values, np.linalg.norm(p - np.array([0.15, -0.05, 0.45]), axis=-1) - 0.15
            )
        features = rng.uniform(0.2, 0.6, (N, N, N, CHANNELS)).astype(np.float32)
        self.grid = make_grid(values.astype(np.float32), CHANNELS, band=np.inf, features=features)
        views = [Camera(SIZE, SIZE, 40.0, 40.0, SIZE / 2, SIZE / 2, look_at(o)) for o in ABOVE]
        self.bank = make_bank(
            views,
            [rng.uniform(0.1, 0.9, (SIZE, SIZE, 3)).astype(np.float32) for _ in views],
            [None] * 4,
        )
        self.batch = batch_of(self.bank, mi.UInt32(np.arange(self.bank.total, dtype=np.uint32)))
        self.t0, self.t1 = sphere_interval(self.batch.o, self.batch.d)
        self.inv_s, self.dt = 1.0 / self.grid.h, dr.opaque(mi.Float, 0.1 * self.grid.h)
        self.appearance = FlashAppearance(Coat(), 6.0, 0 if shadows else np.inf)
        self.appearance.model = SimpleNamespace(grid=self.grid, inv_s=self.inv_s)
        q = np.stack(np.meshgrid(*[np.linspace(-1, 1, NODES)] * 3, indexing="ij"), -1)
        learnt = np.array(start_learnt((0.12, -0.07, 0.05))[0])
        learnt[3:] = (
            0.3 + 0.08 * np.sin(2 * q[..., 0] + q[..., 1]) * np.cos(q[..., 2])
        ).ravel()  # little from node to node
        self.start = {
            "distances": np.array(self.grid.row_values),
            "features": np.array(self.grid.features),
            "offset": learnt[:3].copy(),
            "alpha": learnt[3:].copy(),
        }
        self.counts = (
            march(
                self.grid,
                self.batch.o,
                self.batch.d,
                self.t0,
                self.t1,
                mi.Float(self.inv_s),
                self.dt,
            ).opacity
            > 0.9
        )
        dr.eval(self.counts)

    def loss(self, x):
        put(self.grid, x["distances"])
        self.grid.features = x["features"]
        k = dr.arange(mi.UInt32, 3 + NODES**3)
        learnt = dr.gather(mi.Float, x["offset"], k, k < 3) + dr.gather(
            mi.Float, x["alpha"], k - 3, k >= 3
        )
        m = march(
            self.grid,
            self.batch.o,
            self.batch.d,
            self.t0,
            self.t1,
            dr.opaque(mi.Float, self.inv_s),
            self.dt,
        )
        colour, _ = self.appearance(m, self.batch, self.bank.cameras, learnt)
        return display_loss(colour, self.batch.rgb, self.counts)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name, step", [("offset", 1e-3), ("distances", 1e-4), ("features", 2e-3), ("alpha", 1e-3)]
)
def test_shading(name, step):
    scene = FlashPhotos(shadows=False)
    assert np.mean(np.array(scene.counts)) > 0.5
    check(scene.loss, scene.start, name, step, parts=3)


def test_the_offset_feels_shadows():
    """Shadow rays start at points that are held, so that of the whole term the offset alone has an
    exact difference."""
    scene = FlashPhotos(shadows=True)
    plain = FlashPhotos(shadows=True)
    plain.appearance.shadows_from = np.inf
    start = {k: mi.Float(v) for k, v in scene.start.items()}
    assert abs(float(scene.loss(start)[0]) / float(plain.loss(start)[0]) - 1) > 0.002
    check(scene.loss, scene.start, "offset", 1e-3, parts=3)


@pytest.mark.parametrize("name, step", [("distances", 1e-4), ("light", 1e-3)])
def test_soft_visibility(name, step):
    """PIR Eq. 5 alone, for points of a floor below a ball: gradients to the field and to the
    light's place."""
    rng = np.random.default_rng(1)
    p = node_positions(24).astype(np.float64)
    values = np.linalg.norm(p - np.array([0.05, 0.1, 0.2]), axis=-1) - 0.3
    grid = make_grid(values.astype(np.float32), CHANNELS, band=np.inf)
    count = 200
    x = np.stack([*rng.uniform(-0.45, 0.45, (2, count)), np.full(count, -0.6)]).astype(np.float32)
    weight = mi.Float(rng.uniform(-1, 1, count).astype(np.float32))
    appearance = FlashAppearance(Coat(), 1.0, 0)
    appearance.model = SimpleNamespace(grid=grid, inv_s=2.0 / grid.h)
    hit = SimpleNamespace(opacity=dr.full(mi.Float, 1.0, count))
    start = {
        "distances": np.array(grid.row_values),
        "light": np.array([0.3, -0.2, 2.0], np.float32),
    }

    def seen(v):
        put(grid, v["distances"])
        light = mi.Vector3f(*[dr.gather(mi.Float, v["light"], mi.UInt32(k)) for k in range(3)])
        return appearance.visibility(mi.Vector3f(x), mi.Vector3f(0, 0, 1), light, hit)

    found = np.array(seen({k: mi.Float(v) for k, v in start.items()}))
    assert found.min() < 0.05 and found.max() > 0.95 and ((found > 0.2) & (found < 0.8)).sum() > 5
    check(lambda v: dr.mean(seen(v) * weight), start, name, step, parts=3)

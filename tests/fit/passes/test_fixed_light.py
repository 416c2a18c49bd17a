"""Once the light rests, nothing that would move it is computed, and it stays as it is."""

from collections import Counter

import mitsuba as mi
import numpy as np

from relit.fit.passes import surface
from relit.fit.passes.optimiser import NoStage
from relit.fit.passes.pixels import make_bank
from relit.lighting.environment import Environment
from relit.rendering.transport import TraceableMesh
from support import lump

MOVING = 2
OPTIONS = surface.SurfaceOptions(
    steps=5, points=64, directions=4, texture=8, light=4, light_steps=MOVING
)


def test_a_resting_light_costs_nothing(monkeypatch):
    calls, lights = Counter(), []

    def counted(owner, name):
        real = getattr(owner, name)

        def call(*args):
            calls[name] += 1
            return real(*args)

        monkeypatch.setattr(owner, name, call)

    class Watch(NoStage):
        def step(self, i, **losses):
            lights.append(np.array(model.log_light))

    mesh, _ = lump.lump()
    rng = np.random.default_rng(0)
    cameras = lump.cameras(12, 4)
    bank = make_bank(
        cameras,
        [rng.uniform(0.1, 0.9, (12, 12, 3)).astype(np.float32) for _ in cameras],
        [None] * 4,
    )
    known = np.ones((8, 8), bool)
    begun = surface.TexelStart(
        rng.uniform(0.2, 0.8, (8, 8, 3)), known, 0.4, np.tile([0.0, 1.0, 0.0], (8, 8, 1))
    )
    model = surface.start_surface(begun, OPTIONS)
    for owner, name in (
        (surface, "parsimony"),
        (surface, "light_prior"),
        (Environment, "rebuild"),
        (surface.Exchange, "step"),
    ):
        counted(owner, name)
    traced = TraceableMesh(mesh, np.full(mesh.vertices.shape, 0.3))
    fit = surface.fit_surface(surface.EnvironmentTerms(bank, traced, model, OPTIONS), Watch())
    assert calls == {
        "parsimony": MOVING,
        "light_prior": MOVING,
        "rebuild": 1 + MOVING,
        "step": MOVING,
    }
    assert len(lights) == OPTIONS.steps and np.abs(lights[0] - lights[MOVING - 1]).max() > 1e-3
    for light in lights[MOVING:]:
        np.testing.assert_array_equal(light, lights[MOVING - 1])
    np.testing.assert_allclose(np.array(fit.environment.radiance), np.exp(lights[-1]), rtol=1e-5)
    assert (
        isinstance(fit.material.colour, mi.Float)
        and np.isfinite(np.array(fit.material.colour)).all()
    )

"""A collection that was stopped: verdicts stand, and the surface pass goes on under what it began
with."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from relit.errors import UserError
from relit.fit.collection import photo_poses
from relit.fit.collection import surface as collection_surface
from relit.fit.collection.options import CollectionOptions
from relit.fit.collection.surface import (
    LightOptions,
    PhotoLightTerms,
    fit_collection_surface,
    start_collection_surface,
)
from relit.fit.passes.material_priors import ALBEDO_START, SurfaceOptions
from relit.fit.passes.optimiser import NoStage
from relit.fit.passes.pixels import make_bank
from relit.materials.field import start_material
from relit.recipe import FitContext
from relit.rendering.transport import TraceableMesh
from relit.run import Run
from support import flash_ball as scene


def test_poses_that_were_refused_are_refused_again(tmp_path, monkeypatch):
    photos = SimpleNamespace(names=[f"{i}.jpg" for i in range(6)])
    evidence = photo_poses.PoseEvidence(0.4, np.nan, np.nan, np.nan)
    poses, none = np.tile(np.eye(4), (6, 1, 1)), np.zeros(6, bool)
    found = photo_poses.PhotoPoses(poses, np.full(6, 0.4), none, np.ones(6), "search", evidence)
    searched = []
    monkeypatch.setattr(photo_poses, "find_all", lambda *_: searched.append(1) or found)
    for _ in range(2):
        with (
            Run.open(tmp_path / "run", {}) as run,
            pytest.raises(UserError, match="could not be found") as error,
        ):
            photo_poses.pose_stage(photos, [], FitContext(run, CollectionOptions(), 0))
        assert error.value.code == 4
    assert searched == [1]


class Resumed(NoStage):
    def __init__(self, saved):
        super().__init__()
        self.saved = saved

    def load(self, name):
        return self.saved


@pytest.fixture(scope="module")
def bowl(device):
    """Two photos of the inside of a bowl, which lights itself."""
    mesh, cameras = scene.bowl(), scene.cameras(4, 16)[:2]
    bank = make_bank(
        cameras, [np.full((16, 16, 3), 0.3, np.float32)] * 2, [np.ones((16, 16), np.float32)] * 2
    )
    return bank, TraceableMesh(mesh, np.full((len(mesh.vertices), 3), 0.4, np.float32))


def surface(bowl, saved=None, steps=1, **changes):
    """The pass on the bowl, begun or taken up from `saved`; its model."""
    material = start_material(8, np.full((8, 8, 3), ALBEDO_START, np.float32), 0.5, 0.05)
    model = start_collection_surface(material, np.full((2, 3), 0.3), ALBEDO_START)
    if saved is not None:
        begun = {n: np.array(getattr(material, n)) for n in ("colour", "metallic", "slope")}
        saved = begun | {n: getattr(model, n) for n in ("coefficients", "gains", "weights")} | saved
    o = SurfaceOptions(steps, 64, 8, 8)
    terms = PhotoLightTerms(*bowl, model, o, LightOptions(**changes))
    return fit_collection_surface(terms, NoStage() if saved is None else Resumed(saved))


def test_what_blocks_a_light_keeps_its_brightness(bowl, monkeypatch):
    """Gains and base colour have moved against each other by then, and the mesh's own colours with
    neither."""
    original, blocked = collection_surface.reflected, []

    def watched(points, drawn, *rest):
        blocked.append(np.array(drawn.blocked).sum())
        return original(points, drawn, *rest)

    monkeypatch.setattr(collection_surface, "reflected", watched)
    model = surface(bowl)
    surface(bowl, {"step": 0, "gains": (model.gains + 1).astype(np.float32)})
    assert blocked[0] > 1 and blocked[1] == pytest.approx(blocked[0], rel=1e-4)


def test_a_silenced_photo_stays_silenced(bowl):
    weights = np.array([1.0, 0.1], np.float32)
    history = {
        "losses": np.random.default_rng(0).normal(1.0, 0.1, 500),
        "running": np.array([1.0, 2.0]),
    }
    after = surface(bowl, {"step": 9, "weights": weights, **history}, steps=10).weights
    assert after[0] > 0.9 and after[1] < 0.2

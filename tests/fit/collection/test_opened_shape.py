"""A hollow that no silhouette shows, in photos under a light each: the shape of a collection is
opened there, and nowhere else."""

from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from relit.fit.collection import shape as collection_shape
from relit.fit.collection.options import CollectionOptions
from relit.fit.shape.lids import open_lids
from relit.geometry.hull import distance_of
from relit.geometry.sdf import dense_values, resample
from relit.recipe import FitContext
from relit.run import Run
from support.hollow_box import BOX, FIRST_SMALL, ROOM, THEN_SMALL, N, cameras, pictures

OPTIONS = CollectionOptions(
    levels=(N, N + 8),
    level_steps=(60, 60),
    mask_weights=(0.8,),
    rays=2048,
    refine_cameras=0.0,
    hollows=2,
)


@pytest.fixture
def small(monkeypatch):
    """Trials of a size for tests."""
    monkeypatch.setattr(collection_shape, "FIRST", FIRST_SMALL)
    monkeypatch.setattr(
        collection_shape, "open_lids", partial(open_lids, first=FIRST_SMALL, then=THEN_SMALL)
    )


def shape_of(inside, folder, options=OPTIONS):
    """(distances of the shape that comes out, its cameras) where the volume pass left the hull,
    which is the box."""
    from relit.fit.passes.pixels import make_bank

    rgb, alpha = pictures(inside)
    lights = (
        np.random.default_rng(0).uniform(0.5, 2, (len(rgb), 1, 1, 3)).astype(np.float32)
    )  # exposure and white of each photo
    bank = make_bank(cameras(), list(rgb * lights), list(alpha))
    tints = 0.3 * lights[:, 0, 0]
    photos = SimpleNamespace(shots=[SimpleNamespace(mask=m) for m in alpha], tints=tints)
    model = collection_shape.fresh_model(distance_of(BOX), tints)
    shape = collection_shape.FittedShape(bank, cameras(), model)
    with Run.open(folder, {}) as run:
        collection_shape.opened_stage(shape, photos, FitContext(run, options, 0))
    return dense_values(model.grid), shape.cameras


@pytest.mark.slow
def test_room_is_opened_once(small, tmp_path):
    values, found = shape_of(BOX & ~ROOM, tmp_path / "run")
    shown = resample(values, N) < 0
    assert shown[ROOM & BOX].mean() < 0.4 and shown[BOX & ~ROOM].mean() > 0.7
    assert len(found) == len(cameras())

    def done():
        return {p: p.stat().st_mtime_ns for p in (tmp_path / "run" / "stages").glob("*/DONE")}

    before = done()
    kept, _ = shape_of(BOX & ~ROOM, tmp_path / "run")
    assert np.array_equal(kept, values) and len(before) >= 2 and done() == before, "it is read back"


@pytest.mark.slow
def test_solid_box_stays_as_it_was(small, tmp_path):
    values, found = shape_of(BOX, tmp_path / "run")
    assert np.array_equal(values < 0, BOX)
    assert np.array_equal(found[3].world_from_camera, cameras()[3].world_from_camera)
    assert not (tmp_path / "run" / "stages" / "opened").exists()


def test_draft_does_not_ask(tmp_path):
    shape_of(BOX, tmp_path / "run", CollectionOptions(hollows=0))
    assert not (tmp_path / "run" / "stages").exists()

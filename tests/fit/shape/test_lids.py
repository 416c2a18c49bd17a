"""A hollow that no silhouette shows is found under its flat lid; a solid face stays."""

from dataclasses import replace

import numpy as np
import pytest

from relit.fit.shape import lids
from relit.fit.shape.lids import FIRST, flat_faces, open_lids, opened_at
from relit.geometry.hull import distance_of
from relit.geometry.sdf import node_positions
from support.hollow_box import BOX, FIRST_SMALL, ROOM, THEN_SMALL, P, cameras, photographed


def found(inside, progress=None):
    bank, start = photographed(inside)
    said = []
    gone = open_lids(
        bank,
        cameras(),
        distance_of(BOX),
        start,
        said.append,
        0,
        2,
        FIRST_SMALL,
        THEN_SMALL,
        progress,
    )
    return gone, said


@pytest.mark.slow
def test_hollow_under_a_lid_is_opened(monkeypatch):
    """Each face is asked for what lies under it once, but again after one was opened; the steps of
    all trials are counted."""
    asked, steps, real = [], [], lids.opened_at
    monkeypatch.setattr(
        lids, "opened_at", lambda inside, lid, *rest: asked.append(lid) or real(inside, lid, *rest)
    )
    gone, said = found(BOX & ~ROOM, steps.append)
    assert len(asked) <= len(flat_faces(distance_of(BOX))) + 1
    assert (
        steps == list(range(1, len(steps) + 1))
        and len(steps) >= 2 * FIRST_SMALL.steps + 2 * THEN_SMALL.steps
    )
    assert len(said) == 1 and "falls to" in said[0]
    assert (gone < 0)[ROOM & BOX].mean() > 0.6
    assert (gone < 0)[~ROOM].mean() < 0.01


@pytest.mark.slow
def test_solid_box_stays_whole():
    gone, said = found(BOX)
    assert gone is None and not said


def test_few_photos_are_not_asked():
    """Their hull has flat facets everywhere; no fit is begun."""
    assert open_lids(None, cameras()[:16], distance_of(BOX), None, None) is None


def test_faces_of_a_box_and_what_is_behind_them():
    faces = flat_faces(distance_of(BOX))
    below = max((f for f in faces if P[f][:, 1].max() < -0.2), key=np.sum)
    assert below.sum() > 0.7 * (BOX & (P[..., 1] < -0.27)).sum()
    trial, mouth = opened_at(BOX, below, cameras(), replace(FIRST_SMALL, wall=2.0))
    assert (mouth <= below).all() and mouth.any()
    assert (trial < 0)[BOX & (P[..., 1] > 0.25)].all(), "the wall opposite stays"
    assert not (trial < 0)[mouth].any()


def test_ball_has_no_large_flat_face():
    r = np.linalg.norm(P, axis=-1)
    assert (
        max((f.sum() for f in flat_faces((r - 0.6).astype(np.float32))), default=0)
        < 0.12 * (np.abs(r - 0.6) < 0.03).sum()
    )


@pytest.mark.parametrize("n", [24])
def test_nothing_is_asked_of_a_thin_thing(n):
    p = node_positions(n)
    thin = (np.abs(p[..., 1]) < 0.09) & (np.hypot(p[..., 0], p[..., 2]) < 0.7)
    assert all(
        opened_at(thin, f, cameras(), replace(FIRST, nodes=n)) is None
        for f in flat_faces(distance_of(thin))
    )

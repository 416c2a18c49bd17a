"""A change of a photo, rendered at full size only where it shows, against both renders whole."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest

from relit.geometry.se3 import look_at
from relit.reference.changed import change_of
from relit.reference.mitsuba_scene import build_scene, render
from relit.reference.pile import build_pile, instance_ids
from relit.scene import Camera
from relit.synthesize.procedural import pawn
from support.two_pawns import two_pawns


def shown(scene, camera, **how):
    return render(scene, camera, spp=32, seed=3, **how)[..., :3]


def blurred(picture):
    """Freed of most of the noise."""
    return cv2.blur(picture, (7, 7))


@pytest.fixture(scope="module")
def piles():
    """Scenes of two objects on the ground and of the left one alone, camera, and which object is
    where."""
    mesh, material, poses, ground, light = two_pawns()
    camera = Camera(400, 300, 330.0, 330.0, 200.0, 150.0, look_at([0, 4.5, 7.0], (0, 0.4, 0)))
    both, one = (build_pile(mesh, material, some, ground) for some in (poses, poses[:1]))
    scenes = [build_scene(p.mesh, p.material, np.eye(4), light) for p in (both, one)]
    return scenes, camera, instance_ids(scenes[0], both, camera)


@pytest.mark.slow
def test_a_change_is_the_same_as_of_whole_renders_and_most_of_the_photo_is_not_rendered(piles):
    (before, after), camera, ids = piles
    picture, own = shown(before, camera), ids == 1
    asked, told = [], []

    def counting(scene, camera, where=None, progress=None):
        asked.append(camera.width * camera.height if where is None else int(where.sum()))
        return shown(scene, camera, where=where, progress=progress)

    got, change = change_of(
        partial(counting, before),
        partial(counting, after),
        camera,
        picture,
        own,
        progress=lambda *told_of: told.append(told_of),
    )
    true = shown(after, camera) - picture  # drawn with the same numbers: little noise
    inner = ~(cv2.dilate(own.astype(np.uint8), np.ones((9, 9))) > 0)
    moved = inner & (np.abs(blurred(true)).max(-1) > 0.05)  # the shadow that goes
    assert moved.sum() > 1000
    off = np.abs(blurred(change) - blurred(true))
    assert off[moved].mean() < 0.1 * np.abs(blurred(true))[moved].mean()
    assert off[inner].mean() < 0.002 and off[inner].max() < 0.05
    assert got[own].mean() == pytest.approx(shown(after, camera)[own].mean(), rel=0.03)
    assert sum(asked) < 0.6 * 2 * camera.width * camera.height
    assert all(0 <= done <= every for done, every in told) and told[-1][0] >= told[-1][1] - 1


def test_of_chosen_pixels_alone(piles):
    (scene, _), camera, ids = piles
    where = ids == 0
    part, whole = shown(scene, camera, where=where), shown(scene, camera)
    assert not part[~where].any()
    inner = cv2.erode(where.astype(np.uint8), np.ones((7, 7))) > 0
    assert (
        inner.sum() > 500
        and np.abs(blurred(part) - blurred(whole))[inner].mean() < 0.05 * whole[inner].mean()
    )  # but for noise


@pytest.mark.slow
def test_pixels_that_the_new_thing_shares_are_rendered_both_ways(piles):
    (after, before), camera, ids = piles  # one object is put in
    picture, edge = shown(before, camera), np.zeros(ids.shape, bool)
    edge[-20:, :20] = True  # far from it: no change
    got, change = change_of(
        partial(shown, before), partial(shown, after), camera, picture, ids == 1, edge
    )
    assert (
        got[edge].mean() == pytest.approx(picture[edge].mean(), rel=0.02)
        and np.abs(change[edge]).mean() < 0.01
    )


def test_nothing_of_the_object_itself_leaks_onto_what_it_stands_before():
    mesh, material = pawn(rows=24, columns=24, texture=32)
    light, camera = (
        np.full((8, 16, 3), 0.5, np.float32),
        Camera(320, 240, 330.0, 330.0, 160.0, 120.0, look_at([0, 1.5, 4.0], (0, 0.5, 0))),
    )
    red = replace(
        material,
        base_color=np.broadcast_to(np.float32([0.9, 0, 0]), material.base_color.shape).copy(),
    )
    before, after = (build_scene(mesh, m, None, light) for m in (material, red))
    alpha = render(before, camera, spp=64)[..., 3]
    own, picture = alpha > 0.5, np.full((240, 320, 3), 2.0, np.float32)
    _, change = change_of(partial(shown, before), partial(shown, after), camera, picture, own)
    beside = (cv2.dilate(own.astype(np.uint8), np.ones((25, 25))) > 0) & (
        cv2.dilate(alpha, np.ones((5, 5))) == 0
    )
    assert beside.sum() > 1000 and np.abs(change[beside]).max() < 1e-3

"""A pot with the same paint on either side: half a turn of it is told by its spout and its handle
alone."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from relit.conventions import similarity
from relit.fit.duplicates import pose_passes
from relit.fit.duplicates.options import options_for
from relit.fit.registration.instances import near_symmetry_search as instance_turns
from relit.fit.registration.instances import search as instance_search
from relit.fit.registration.instances.near_symmetry import (
    AlikeTurn,
    alike_turns,
    distinct_rotations,
)
from relit.fit.registration.instances.near_symmetry_search import (
    Turned,
    axis_moved,
    coherent_turns,
    model_at,
    motions_about,
    stands,
)
from relit.fit.registration.instances.options import DETAILED, Growth, Search
from relit.fit.registration.instances.regrowth import Placed
from relit.fit.registration.instances.silhouette_turns import Silhouettes
from relit.fit.registration.instances.views import instance_crops
from relit.fit.registration.register import crop_rings
from relit.geometry.se3 import exp_so3, rotation_angle
from relit.scene import Mesh
from support.two_ellipsoids import views_of_body

BODY = (np.zeros(3), np.array([0.4, 0.3, 0.4]))
SPOUT = (np.array([0.5, 0.1, 0.0]), np.array([0.22, 0.06, 0.06]))
HANDLE = (np.array([-0.42, 0.0, 0.0]), np.array([0.14, 0.28, 0.05]))
HALF = similarity(exp_so3(np.array([0, np.pi, 0])), np.zeros(3))
ABOUT_Y = AlikeTurn(np.array([0.0, 1.0, 0.0]), 2, 1.0)
SMALL = Search(nodes=28, steps=25, growth=Growth(nodes=32, steps=50, viewpoints=300))
WRONG = np.array([0, 1, 1, 0, 0, 1, 0, 1])


def twice(p):
    """A colour that is the same after half a turn about y."""
    a = 2 * np.arctan2(p[:, 0], p[:, 2])
    return 0.5 + 0.25 * np.stack(
        [np.sin(a + 9 * p[:, 1]), np.cos(2 * a - 7 * p[:, 1]), np.sin(3 * a + 0.5)], -1
    )


def pot(parts=(BODY, SPOUT, HANDLE), colour=twice):
    return views_of_body(
        np.arange(8) * 360 / 8 + [25, 11, 32, 20, 28, 14, 23, 30], colour, parts=list(parts)
    )


@pytest.fixture(scope="module")
def pots():
    return pot()


def turned(poses, which):
    return np.where(np.asarray(which)[:, None, None] > 0, HALF @ poses, poses)


def errors(poses, true):
    """Degrees, up to one turn of all."""
    e = np.array([p[:3, :3] @ t[:3, :3].T for p, t in zip(poses, true, strict=True)])
    return min((np.array([rotation_angle(m.T @ d) for d in e]) for m in e), key=np.median)


@pytest.mark.slow
def test_a_model_of_it_looks_most_like_itself_after_half_a_turn(pots):
    views, poses = pots
    best, *others = alike_turns(model_at(views, poses, SMALL, 0).gallery, 3)
    assert (
        best.order == 2
        and abs(best.axis[1]) > 0.99
        and all(best.likeness > t.likeness + 0.05 for t in others)
    )
    assert np.allclose(best.rotation(2), np.eye(3)) and np.allclose(
        AlikeTurn(best.axis, 4, 0).rotation(2), best.rotation()
    )


def test_of_turns_that_are_nearly_the_same_or_undo_one_another_the_best_is_kept():
    tried = [
        (k / 10, exp_so3(np.radians(a) * np.array([0, 1.0, 0])))
        for k, a in enumerate((75, -115, 180, 110, 120, 60))
    ]
    assert [value for value, _ in distinct_rotations(tried, 5)] == [0.5, 0.4, 0.2]
    assert [value for value, _ in distinct_rotations(tried, 2)] == [0.5, 0.4]


@pytest.mark.slow
def test_silhouettes_of_one_body_leave_the_smallest_gap(pots):
    views, poses = pots
    found = Silhouettes(views, turned(poses, WRONG), motions_about(ABOUT_Y, np.zeros(3)))
    none, right = np.zeros(8, int), WRONG ^ WRONG[0]
    assert found.gap(right) < 0.7 * found.gap(none)
    gap, turns = found.most_coherent(0)
    assert np.array_equal(turns, right) and gap == found.gap(right)
    assert found.descended(right)[0] == gap
    blind = Silhouettes(
        [replace(v, known=np.zeros_like(v.known)) for v in views],
        poses,
        motions_about(ABOUT_Y, np.zeros(3)),
    )
    assert blind.gap(none) == blind.gap(right) == 0


@pytest.mark.slow
def test_the_axis_of_the_turn_is_moved_to_where_silhouettes_fit(pots):
    views, poses = pots
    point = np.array([0.04, 0.3, -0.03])  # .05 from the object's axis
    moved = axis_moved(views, turned(poses, WRONG), ABOUT_Y, point, WRONG)
    assert np.abs(moved[[0, 2]]).max() < 0.015 and moved[1] == point[1]


@pytest.mark.slow
def test_those_half_a_turn_off_are_turned_and_the_right_ones_are_left(pots, monkeypatch):
    monkeypatch.setattr(instance_turns, "ASKED", 1)
    monkeypatch.setattr(instance_turns, "SETTLED", 1)
    views, poses = pots
    crops, said = instance_crops(views), []
    rings = crop_rings(crops, DETAILED)
    off = turned(poses, WRONG)
    assert (errors(off, poses) > 170).sum() == 4
    found = coherent_turns(views, crops, rings, off, SMALL, seed=0, say=said.append)
    assert (
        errors(found.poses, poses).max() < 8
        and "4 of 8 were turned" in said[0]
        and len(found.rotations) == 2
    )
    assert coherent_turns(views, crops, rings, poses, SMALL, seed=0) is None
    assert all(stands(views, crops, rings, found, k, SMALL, 0) for k in (0, 3))
    astray = found.poses.copy()
    astray[3] = similarity(exp_so3(np.array([0.9, 0, 0.4])), np.zeros(3)) @ astray[3]
    assert not stands(
        views, crops, rings, Turned(astray, found.own, found.value, found.rotations), 3, SMALL, 0
    )


@pytest.mark.slow
def test_exact_poses_are_turned_and_do_not_move(pots, monkeypatch):
    monkeypatch.setattr(instance_turns, "ASKED", 1)
    views, poses = pots
    crops, off = instance_crops(views), turned(poses, WRONG)
    found = coherent_turns(
        views, crops, crop_rings(crops, DETAILED), off, SMALL, seed=0, exact=True
    )
    assert errors(found.poses, poses).max() < 3
    moved = (found.poses != off).any((1, 2))
    assert moved.sum() == 4, "the others stand as they did"
    run, options = SimpleNamespace(say=lambda text: None), options_for("draft")
    monkeypatch.setattr(
        pose_passes, "coherent_turns", lambda *_, exact, **__: found if exact else None
    )
    mesh, rod = (
        Mesh(s.vertices, s.faces)
        for s in (trimesh.creation.box((1.2, 0.7, 0.4)), trimesh.creation.cylinder(0.3, 1.2))
    )
    assert pose_passes.resolve_near_symmetry(mesh, views, off, run, options, 0) is found.poses
    assert pose_passes.resolve_near_symmetry(rod, views, off, run, options, 0) is None
    assert pose_passes.resolve_near_symmetry(mesh, views[:3], off[:3], run, options, 0) is None
    assert (
        pose_passes.resolve_near_symmetry(
            mesh, views, off, run, replace(options, without=("search",)), 0
        )
        is None
    )


def test_a_finer_view_closes_wider_gaps_between_nodes(pots):
    views, poses = pots
    body = Silhouettes(views, poses, np.eye(4)[None]).gap(np.zeros(8, int))
    larger = [
        replace(v, camera=v.camera.resized(*(6 * n for n in v.mask.shape[::-1])), **enlarged(v, 6))
        for v in views
    ]
    assert abs(Silhouettes(larger, poses, np.eye(4)[None]).gap(np.zeros(8, int)) - body) < 0.06


def enlarged(view, times):
    return {
        name: np.kron(getattr(view, name), np.ones((times, times), np.float32))
        for name in ("mask", "known")
    }


@pytest.mark.slow
def test_an_object_that_looks_like_itself_all_the_way_is_left_alone():
    """Neither spout nor handle: either way is right."""
    views, poses = pot([BODY])
    crops = instance_crops(views)
    assert (
        coherent_turns(
            views, crops, crop_rings(crops, DETAILED), turned(poses, WRONG), SMALL, seed=0
        )
        is None
    )


@pytest.mark.slow
def test_who_stands_up_to_such_turns_is_no_longer_unsure(pots, monkeypatch):
    """Those who were not sure are asked against a model of the others; one of them is astray."""
    views, poses = pots
    crops, astray = instance_crops(views), poses.copy()
    astray[4] = similarity(exp_so3(np.array([0.9, 0, 0.4])), np.zeros(3)) @ astray[4]
    rotations = motions_about(ABOUT_Y, np.zeros(3))[:, :3, :3]
    found = Turned(astray, np.arange(8) / 8, 1.0, rotations)
    placed = Placed(turned(poses, WRONG), np.ones(8), (0, 1), (2, 4), DETAILED)
    told = iter([found, None])
    monkeypatch.setattr(instance_search, "coherent_turns", lambda *_, **__: next(told))
    best = instance_search.up_to_turns(views, crops, placed, SMALL, seed=0)
    assert np.array_equal(best.poses, found.poses) and best.unsure == (4,)
    assert best.agreement == found.own.mean()
    assert instance_search.up_to_turns(views, crops, placed, SMALL, seed=0) is placed

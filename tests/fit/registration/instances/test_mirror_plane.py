"""The plane in which an object is its own mirror image, told by a few of its views."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from relit.conventions import similarity
from relit.fit.registration.instances import bodies as instance_bodies
from relit.fit.registration.instances import mirror_plane
from relit.fit.registration.instances.bodies import body_of
from relit.fit.registration.instances.mirror_plane import (
    HullPoints,
    Plane,
    find_plane,
    flip,
    flipped_poses,
    flipped_views,
    normal_between,
    plane_scores,
    settled_plane,
)
from relit.fit.registration.instances.options import Growth
from relit.fit.registration.instances.views import carved
from relit.fit.registration.register import directions_around, views_from
from relit.geometry.se3 import exp_so3
from support.two_ellipsoids import SIDE, views_of_body

PARTS = (0.6, 2.0, 0.1)


def even(p):
    """A colour that is the same on both sides of x = 0."""
    return 0.2 + 0.6 * np.stack([p[:, 2] > 0.1, np.abs(p[:, 0]) > 0.15, p[:, 1] > 0.1], -1)


def odd(p):
    return 0.2 + 0.6 * np.stack([p[:, 0] > 0.02, p[:, 0] > 0.02, p[:, 1] > 0.1], -1)


def test_a_flipped_picture_shows_the_mirrored_object():
    view, pose = (a[0] for a in views_of_body([35], even))
    view = replace(view, camera=replace(view.camera, cx=41.5))
    plane = Plane(np.array([0.6, 0.0, 0.8]), 0.07)
    points = np.random.default_rng(0).uniform(-0.4, 0.4, (20, 3))
    mirrored = points @ plane.mirror[:3, :3].T + plane.mirror[:3, 3]
    assert np.allclose(mirrored @ plane.normal + points @ plane.normal, 2 * plane.offset)
    there = flip(view).camera.with_pose(flipped_poses(plane, pose[None])[0])
    assert np.isclose(np.linalg.det(there.world_from_camera[:3, :3]), 1)
    a, b = view.camera.with_pose(pose).project(points), there.project(mirrored)
    assert np.allclose(a[:, 0] + b[:, 0], SIDE) and np.allclose(a[:, 1:], b[:, 1:])
    assert np.array_equal(flip(view).rgb, view.rgb[:, ::-1])


def test_silhouettes_tell_where_the_plane_lies():
    views, poses = views_of_body([-60, 10, 70, 150], even)
    for offset in (0.0, 0.08):
        moved = poses.copy()
        moved[:, 0, 3] += offset
        share, found = HullPoints(views, moved).offset(np.array([1.0, 0.0, 0.0]))
        assert share > 0.98 and found == pytest.approx(offset, abs=0.03)
    wrong = [
        HullPoints(views, poses).offset(np.array(n))[0]
        for n in ([0.0, 0.6, 0.8], [0.0, 0.0, 1.0], [0.6, 0.0, 0.8])
    ]
    assert max(wrong) < share - 0.01


def test_the_normal_is_that_of_the_pictures_that_agree():
    _, poses = views_of_body([-60, 10, 70, 150], even)
    normal = np.array([0.8, 0.0, -0.6])
    placed = flipped_poses(Plane(normal, 0.0), poses)
    placed[3] = (
        similarity(exp_so3(np.array([0.0, 1.5, 0.3])), np.zeros(3)) @ placed[3]
    )  # one slid away
    start = exp_so3(np.array([0.0, 0.1, 0.0])) @ normal
    assert abs(normal_between(poses, placed, start) @ normal) > 1 - 1e-9
    assert np.array_equal(normal_between(poses[3:], placed[3:], start), start)


def found_plane(views, poses, seed=0):
    o = Growth(nodes=28, steps=40, viewpoints=400)
    cameras = views_from(directions_around(o.viewpoints, seed), 5.0)
    return body_of(
        views,
        poses,
        cameras,
        PARTS,
        o,
        steps=o.steps,
        seed=seed,
        pictures=flipped_views(views, PARTS),
    ).plane


@pytest.mark.slow
def test_a_few_views_tell_the_plane_and_not_where_shape_and_paint_are_lopsided():
    views, poses = views_of_body([-100, -30, 40, 110], even)
    plane = found_plane(views, poses)
    assert (
        plane is not None
        and abs(plane.normal[0]) > np.cos(np.radians(8))
        and abs(plane.offset) < 0.05
    )
    views, poses = views_of_body([-100, -30, 40, 110], odd, lopsided=0.25)
    other = found_plane(views, poses)
    assert other is None or abs(other.normal[0]) < 0.9


@pytest.mark.slow
def test_a_plane_must_lead_by_more_where_two_tell_it_and_the_last_one_is_believed_longer(
    monkeypatch,
):
    views, poses = views_of_body([-100, -30, 40, 110], even)
    pictures, o = flipped_views(views, PARTS), Growth(nodes=28, steps=20)
    body = body_of(
        views, poses, views_from(directions_around(200), 5.0), PARTS, o, steps=o.steps, seed=0
    )
    told: list[float] = []

    def settled(first, *others):
        return told.pop(0), first

    monkeypatch.setattr(mirror_plane, "settled_plane", settled)

    def found(count, *scores):
        told[:] = scores
        return find_plane(
            views[:count],
            pictures.of(list(range(count))),
            poses[:count],
            body.gallery,
            body.render,
            PARTS,
        )

    assert found(3, 1.0, 1.04, 0.9, 0.9) is not None and found(3, 1.0, 1.03, 0.9, 0.9) is None
    assert found(2, 1.0, 1.09, 0.9, 0.9) is None and found(2, 1.0, 1.11, 0.9, 0.9) is not None
    monkeypatch.undo()
    first, hull = Plane(np.array([1.0, 0.0, 0.0]), 0.0), HullPoints(views, poses)
    near, far = (
        Plane(np.array([np.cos(0.2), 0.0, np.sin(0.2)]), 0.0),
        Plane(np.array([0.0, 1.0, 0.0]), 0.0),
    )
    plain, kept, other = (
        settled_plane(first, hull, pictures, poses, body.render, PARTS, last)[0]
        for last in (None, near, far)
    )
    assert kept == pytest.approx(plain + 0.03) and other == pytest.approx(plain)


@pytest.mark.slow
def test_a_body_is_bounded_by_its_mirror_image(monkeypatch):
    """Two views from one side leave the far side open; mirrored, the outlines bound it from there
    too: half as far off as the hull, and nearer than a taut body without a mirror."""
    views, poses = views_of_body([60, 100], even)
    o = Growth(nodes=28, steps=40, viewpoints=60)
    across = views_from(np.array([[0.0, 0.3, 1.0], [0.0, 0.5, -1.0]]), 5.0)
    truth, _ = views_of_body([0, 180], even)
    width = [np.ptp(np.nonzero(v.mask.any(0))[0]) / SIDE * 5.0 * SIDE / v.camera.fx for v in truth]
    plain, twice = (
        body_of(views, poses, across, PARTS, o, steps=o.steps, seed=0, plane=p)
        for p in (None, Plane(np.array([1.0, 0.0, 0.0]), 0.0))
    )
    assert len(twice.poses) == 2
    monkeypatch.setattr(instance_bodies, "taut_body", carved)
    hull = body_of(views, poses, across, PARTS, o, steps=o.steps, seed=0)

    def widths(body):
        _, alpha = body.render(across)
        return [
            np.ptp(np.nonzero((a > 0.5).any(0))[0]) / a.shape[1] * 5.0 * a.shape[1] / c.fx
            for a, c in zip(alpha, across, strict=True)
        ]

    off = [np.mean(np.abs(np.subtract(widths(body), width))) for body in (twice, plain, hull)]
    assert off[0] < 0.5 * off[2] and off[0] < off[1]


def test_planes_are_scored_by_where_they_put_the_pictures():
    views, poses = views_of_body([-100, -30, 40, 110], even)
    o = Growth(nodes=28, steps=40)
    cameras = views_from(directions_around(400), 5.0)
    body = body_of(views, poses, cameras, PARTS, o, steps=o.steps, seed=0)
    normals = np.array([[1.0, 0, 0], [0, 1.0, 0], [0.7, 0.7, 0.1], [0, 0.6, 0.8]])
    score = plane_scores(
        normals / np.linalg.norm(normals, axis=1, keepdims=True),
        flipped_views(views, PARTS),
        poses,
        body.gallery,
    )
    assert score.argmax() == 0 and score[0] > 0.8

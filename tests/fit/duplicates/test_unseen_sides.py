"""Sides of a shape that no view shows."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from relit.fit.duplicates.unseen_sides import (
    closed_where_unseen,
    hidden_sky,
    moved_along,
    seen_in,
    told_at,
)
from relit.fit.registration.instances.views import InstanceView
from relit.geometry.hull import visual_hull
from relit.geometry.mesh import extract_mesh, face_areas
from relit.geometry.sdf import node_positions, redistance
from relit.geometry.se3 import look_at
from relit.reference.mitsuba_scene import build_geometry
from relit.scene import Camera

NODES, SIDE = 80, 140
ABOVE = [
    np.array([x, 3.5, z])
    for x, z in ((1.0, 0.2), (-0.6, 0.9), (-0.3, -1.0), (0.4, 0.8), (0.8, -0.7), (-1.0, 0.0))
]
AROUND = [
    np.array(e)
    for e in (
        (3.5, 0.5, 0),
        (-3.5, 0.5, 0),
        (0, 0.5, 3.5),
        (0, 0.5, -3.5),
        (0.2, 3.5, 0),
        (0.2, -3.5, 0),
    )
]


def ball(p):
    return np.linalg.norm(p, axis=-1) - 0.5


def slab(p):
    """A board, .3 thick."""
    q = np.abs(p) - np.array([0.6, 0.15, 0.4])
    return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0)


def two_legs(p):
    """A bar on two legs, of which nobody sees the feet."""
    bar, leg = (
        np.abs(p - np.array([0, 0.3, 0])) - np.array([0.6, 0.12, 0.2]),
        np.abs(np.abs(p) - np.array([0.5, 0, 0])) - 0.08,
    )
    leg[..., 1] = np.abs(p[..., 1]) - 0.4
    return np.minimum(bar.max(-1), leg.max(-1))


def scene_of(body, eyes):
    """(true distances, distances of what a volume pass can leave, views, poses) of a body (function
    of points), seen from there. Above the plane y = 0 that is the body; below, its visual hull."""
    truth = redistance(body(node_positions(NODES)).astype(np.float32))
    mesh = extract_mesh(truth)
    scene, views, poses = build_geometry(mesh), [], []
    for k, eye in enumerate(eyes):
        camera = Camera(SIDE, SIDE, 260.0, 260.0, SIDE / 2, SIDE / 2, look_at(eye))
        mask = mask_of(scene, camera)
        views.append(
            InstanceView(
                k + 1,
                camera.with_pose(np.eye(4)),
                np.ones((SIDE, SIDE, 3), np.float32),
                mask,
                np.ones_like(mask),
                1.0,
            )
        )
        poses.append(camera.world_from_camera)
    cameras = [v.camera.with_pose(p) for v, p in zip(views, poses, strict=True)]
    hull = redistance(visual_hull(cameras, [v.mask for v in views], NODES, tolerance=0.0))
    built = np.where(node_positions(NODES)[..., 1] > 0, np.maximum(hull, truth), hull)
    return truth, redistance(built), views, np.array(poses)


def mask_of(scene, camera):
    import mitsuba as mi

    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    d = np.stack(
        [(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], -1
    ).reshape(-1, 3)
    d = d @ camera.world_from_camera[:3, :3].T
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    o = np.broadcast_to(camera.centre, d.shape)
    ray = mi.Ray3f(mi.Point3f(o.T.astype(np.float32)), mi.Vector3f(d.T.astype(np.float32)))
    return np.array(scene.ray_test(ray)).reshape(camera.height, camera.width).astype(np.float32)


def wrong(values, truth):
    """Volume that is told wrong, of the body's."""
    return float(((values < 0) != (truth < 0)).sum() / (truth < 0).sum())


def lowest(values):
    return float(node_positions(NODES)[..., 1][values < 0].min())


@pytest.mark.slow
@pytest.mark.parametrize("body, share, below", [(ball, 0.5, 0.35), (slab, 0.2, 0.15)])
def test_what_hangs_below_goes_where_all_look_down(body, share, below):
    truth, hull, views, poses = scene_of(body, ABOVE)
    before = wrong(hull, truth)
    assert before > 0.5  # the cone, or wedge, that silhouettes leave below
    after, gone = closed_where_unseen(hull, views, poses)
    assert gone > 0.3
    assert wrong(after, truth) < share * before
    assert abs(lowest(after) - lowest(truth)) < below < lowest(truth) - lowest(hull)


@pytest.mark.slow
def test_what_is_seen_stays_where_it_is():
    _, hull, views, poses = scene_of(ball, ABOVE)
    after, _ = closed_where_unseen(hull, views, poses)
    mesh, built = extract_mesh(after), extract_mesh(hull)
    seen = built.vertices[np.unique(built.faces[seen_in(built, views, poses)])]
    away = cKDTree(mesh.vertices).query(seen[seen[:, 1] > 0.15])[0]
    assert away.max() < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("body, lost", [(ball, 0.01), (slab, 0.01), (two_legs, 0.02)])
def test_every_ray_of_a_silhouette_still_meets_the_body(body, lost):
    _, hull, views, poses = scene_of(body, ABOVE)
    after, gone = closed_where_unseen(hull, views, poses)
    assert gone > 0
    scenes = [build_geometry(extract_mesh(values)) for values in (hull, after)]
    for view, pose in zip(views, poses, strict=True):
        before, now = (mask_of(scene, view.camera.with_pose(pose)) for scene in scenes)
        assert ((before > now) & (view.mask > 0)).sum() < lost * view.mask.sum()


def test_nothing_changes_where_views_look_from_all_around():
    _, hull, views, poses = scene_of(ball, AROUND)
    after, gone = closed_where_unseen(hull, views, poses)
    assert gone == 0
    assert after is hull


@pytest.mark.slow
def test_what_is_too_thin_for_the_coarse_grid_stays():
    _, _, views, poses = scene_of(ball, ABOVE)
    y = node_positions(193)[..., 1]
    thin = np.abs(y) - 0.4 * 2 / 192  # one layer of nodes, between those of the coarse grid
    thin = np.maximum(thin, np.abs(node_positions(193)[..., [0, 2]]).max(-1) - 0.5).astype(
        np.float32
    )
    assert thin.min() < 0
    assert closed_where_unseen(thin, views, poses)[1] == 0


def test_who_sees_what():
    truth, _, views, poses = scene_of(ball, ABOVE)
    mesh = extract_mesh(truth)
    seen, areas, height = (
        seen_in(mesh, views, poses),
        face_areas(mesh),
        mesh.vertices[mesh.faces].mean(1)[:, 1],
    )
    assert seen[height > 0.2].all()
    assert not seen[height < -0.3].any()
    blind = [
        InstanceView(v.label, v.camera, v.rgb, np.zeros_like(v.mask), v.known, v.seen)
        for v in views
    ]  # something else is in front
    assert not seen_in(mesh, blind, poses).any()
    assert 0.4 < areas[seen].sum() / areas.sum() < 0.75


@pytest.mark.slow
def test_share_of_the_sky():
    truth = redistance(ball(node_positions(NODES)).astype(np.float32))
    mesh = extract_mesh(truth)
    height = mesh.vertices[mesh.faces].mean(1)[:, 1]
    deep = truth < -0.1
    np.testing.assert_allclose(
        hidden_sky(mesh, np.ones(len(height), bool), truth)[deep], 1, atol=0.03
    )
    half = hidden_sky(mesh, height > 0, truth)
    y = node_positions(NODES)[..., 1]
    axis = deep & (np.abs(node_positions(NODES)[..., [0, 2]]) < 0.03).all(-1)
    # a half ball hides what its rim hides, from below, and all but that from above: a disk of
    # radius .5 from the height y
    share = (1 + y[axis] / np.hypot(y[axis], 0.5)) / 2
    np.testing.assert_allclose(half[axis], share, atol=0.03)
    assert (half[truth > 0.1] == 0).all()


def test_looks_come_from_the_surface_that_was_built():
    built = np.array([[0, 0, 0], [1, 0, 0]], np.float32)
    vertices = np.array([[0.01, 0, 0], [0.8, 0, 0]], np.float32)
    np.testing.assert_allclose(told_at(vertices, built, 101), [[0.01, 0, 0], [1, 0, 0]])


def test_a_closed_shape_moves_with_what_was_built():
    mesh = extract_mesh(ball(node_positions(40)).astype(np.float32))
    built = mesh.vertices
    placed = (1.02 * built + np.array([0.01, -0.02, 0.03])).astype(np.float32)
    chosen = np.arange(0, len(built), 3)
    moved = moved_along(mesh, built[chosen], placed[chosen])
    np.testing.assert_allclose(moved.vertices[chosen], placed[chosen], atol=1e-6)
    np.testing.assert_allclose(moved.vertices, placed, atol=2e-3)
    assert moved.faces is mesh.faces

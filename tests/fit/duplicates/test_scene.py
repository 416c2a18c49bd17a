"""Objects on their ground, and what the ground says of the light."""

from __future__ import annotations

import numpy as np
import pytest

from relit.conventions import environment_directions, move_points, similarity
from relit.fit.duplicates.scene import (
    ONTO,
    SETTLED,
    distance_in,
    ground_reflectance,
    light_below,
    parts_of_the_way,
    set_down,
)
from relit.geometry.sdf import node_positions
from relit.geometry.se3 import exp_so3

UP = np.array([0.0, -np.sin(0.9), -np.cos(0.9)])  # of the ground, in the photo's frame


def ball(count=600):
    rng = np.random.default_rng(0)
    v = rng.normal(size=(count, 3))
    return 0.8 * v / np.linalg.norm(v, axis=1, keepdims=True)


def from_ball(points):
    return np.linalg.norm(points, axis=-1) - 0.8


def standing(vertices, count, seed=1):
    """Poses photo_from_object of objects that touch the plane through (0, 0, 10)."""
    rng, out = np.random.default_rng(seed), []
    for _ in range(count):
        turn = exp_so3(rng.normal(size=3))
        low = (vertices @ turn.T @ UP).min()
        side = rng.uniform(-3, 3, 3)
        side -= UP * (side @ UP)
        out.append(similarity(turn, np.array([0, 0, 10.0]) + side - UP * low))
    return out


def test_what_floats_or_sinks_is_set_down_along_its_line_of_sight():
    vertices = ball()
    true = standing(vertices, 16)
    errors = np.random.default_rng(2).uniform(-0.005, 0.005, 16)
    seen = [similarity(m[:3, :3], m[:3, 3] * (1 + e)) for m, e in zip(true, errors, strict=True)]
    wrong = np.array([np.linalg.inv(m) for m in seen])
    tilted = exp_so3(np.array([0.02, 0.0, 0.01])) @ UP
    poses, plane, count = set_down(
        vertices,
        wrong,
        np.stack([[0, 0, 10.02], tilted]),
        lambda points: np.full(points.shape[:-1], 9.0),
    )
    assert count == 16
    assert np.degrees(np.arccos(plane[1] @ UP)) < 0.6
    before = [np.linalg.norm(a[:3, 3] - b[:3, 3]) for a, b in zip(seen, true, strict=True)]
    after = [
        np.linalg.norm(np.linalg.inv(p)[:3, 3] - b[:3, 3]) for p, b in zip(poses, true, strict=True)
    ]
    assert np.median(after) < 0.6 * np.median(before)
    for p in poses:
        assert abs(((move_points(np.linalg.inv(p), vertices) - plane[0]) @ plane[1]).min()) < 0.01
    assert np.allclose(poses[:, :3, :3], wrong[:, :3, :3])


def test_what_lies_deep_in_the_ground_is_lifted_and_what_floats_over_another_comes_nearer_to_it():
    vertices = ball(6000)
    side, ahead = np.cross(UP, [1.0, 0, 0]), np.array([1.0, 0, 0])
    at = [
        np.array([0, 0, 10.0]) + a * 1.9 * ahead + b * 1.9 * side + 0.8 * UP
        for a in (-1, 0, 1)
        for b in (-1, 0, 1)
    ]
    at.append((at[4] + at[5]) / 2 + np.sqrt(1.6**2 - 0.95**2) * UP)  # on two others
    at.append(at[0] + 1.6 * UP)  # on top of one
    turn = np.eye(3)
    true = [similarity(turn, p) for p in at]
    shift = np.zeros(len(at))
    shift[3], shift[9], shift[10] = 0.015, -0.004, 0.004
    seen = np.array(
        [np.linalg.inv(similarity(turn, p * (1 + e))) for p, e in zip(at, shift, strict=True)]
    )
    poses, _, count = set_down(vertices, seen, np.stack([[0, 0, 10.0], UP]), from_ball)
    assert count == 3  # the others are where they belong
    for k, p in enumerate(poses):
        part = ONTO if k > 8 else 1.0  # of the way
        expected = true[k][:3, 3] * (1 + (1 - part) * shift[k])
        assert np.linalg.norm(np.linalg.inv(p)[:3, 3] - expected) < 0.015, k


def test_distances_between_nodes_and_beyond_the_cube():
    p = node_positions(41)
    distance = distance_in((np.linalg.norm(p, axis=-1) - 0.8).astype(np.float32))
    points = np.random.default_rng(0).uniform(-0.95, 0.95, (50, 2, 3))
    assert np.allclose(distance(points), from_ball(points), atol=0.02)
    assert distance(np.array([[3.0, 0, 0]]))[0] == pytest.approx(2.2, abs=0.01)
    assert distance(np.array([[0.5, 0.1, -0.2]]))[0] < 0 < distance(np.array([[0.1, 0.2, 0.9]]))[0]


def test_few_objects_stay_where_they_are():
    vertices = ball()
    poses = np.array([np.linalg.inv(m) for m in standing(vertices, SETTLED - 1)])
    plane = np.stack([[0, 0, 10.0], UP])
    same, _, count = set_down(vertices, poses, plane, from_ball)
    assert count == 0 and np.array_equal(same, poses)


def test_ground_under_an_even_sky_shows_its_reflectance():
    light = np.full((32, 64, 3), 2.0, np.float32)
    assert ground_reflectance(
        light, np.array([0, 1.0, 0]), np.array([0.6, 0.4, 0.2])
    ) == pytest.approx([0.3, 0.2, 0.1], rel=0.01)


def test_below_the_ground_is_the_ground():
    light = np.full((32, 64, 3), 2.0, np.float32)
    up, height = np.array([0, 1.0, 0]), environment_directions(32, 64)[..., 1]
    out = light_below(light, up, np.array([0.5, 0.4, 0.3]))
    assert np.allclose(out[height > 0], 2.0) and np.allclose(out[height < -0.1], [0.5, 0.4, 0.3])


def test_without_visibility_nothing_but_itself_shadows_an_instance(device):
    """Two rows of balls that touch each other: together they block much of each other's sky, moved
    apart none of it."""
    import drjit as dr
    import mitsuba as mi

    from relit.fit.duplicates.placed_pile import PlacedPile
    from relit.fit.duplicates.scene import alone_bank, instance_meshes, pile_scene, spread_moves
    from relit.fit.passes.pixels import batch_of
    from relit.fit.registration.instances.views import ViewId
    from relit.lighting.environment import Environment
    from relit.materials.brdf import Surface
    from relit.rendering.transport import TraceableMesh, first_hits, sample_lights
    from relit.scene import Camera, Pixels
    from support.flash_ball import ball as round_ball

    mesh = round_ball(16, 32)
    camera = Camera(96, 64, 160.0, 160.0, 48.0, 32.0, np.eye(4))
    standing = [
        similarity(np.eye(3), np.array([1.45 * x, -1.1 * z, 8 + 0.95 * z]))
        for z in (0, 1)
        for x in (-1, 0, 1)
    ]
    labels = np.zeros((64, 96), np.int32)
    for k, pose in reversed(list(enumerate(standing))):  # the front row last
        x, y, z = camera.project(pose[None, :3, 3])[0]
        row, column = np.mgrid[:64, :96]
        labels[np.hypot(column + 0.5 - x, row + 0.5 - y) < 150 * 0.7 / z] = 10 + k
    labels[0, 0] = 99  # an object that is not registered
    pixels = Pixels(np.random.default_rng(0).random((64, 96, 3)).astype(np.float32), labels=labels)
    names = tuple(ViewId(0, 10 + k) for k in range(6))
    pile = PlacedPile(
        mesh=mesh,
        radiance=np.ones((6, len(mesh.vertices), 3), np.float32),
        poses=np.linalg.inv(standing),
        ids=names,
        views=names,
        view_instances=np.arange(6),
        motions=np.eye(4)[None],
        related=np.ones(1, bool),
        plane=np.stack([[0, 0.7, 8.0], [0, -1.0, 0]]),
    )
    place = similarity(np.eye(3), np.array([0, 0, -8.7]))
    moves = spread_moves(standing, place)
    own = camera.with_pose(place)
    whole, radiance = instance_meshes(pile, place, moves)
    assert whole.vertices.shape == (6 * len(mesh.vertices), 3)
    bank = alone_bank([pixels], [own], [{10 + k: k for k in range(6)}], moves, 10**6)
    batch = batch_of(bank, bank.candidates)
    traced = TraceableMesh(whole, radiance)
    points = first_hits(traced, batch.o, batch.d)
    hit = np.array(points.valid)
    assert hit.mean() > 0.8 and set(np.array(batch.view)[hit].tolist()) == set(range(bank.views))
    number = np.linalg.norm(
        np.array(points.x).T[hit][:, None] - (moves + [m[:3, 3] + place[:3, 3] for m in standing]),
        axis=2,
    ).argmin(1)
    assert (np.array(batch.view)[hit] == number).all()  # each view shows the instance that it is of
    count = dr.width(points.x)
    grey = Surface(
        mi.Color3f(dr.full(mi.Float, 0.5, count)),
        dr.full(mi.Float, 0.5, count),
        dr.zeros(mi.Float, count),
    )

    def open_sky(scene, points):
        rng = mi.PCG32(size=count, initstate=3)
        light = Environment(dr.full(mi.Float, 1.0, 8 * 16 * 3), 8, 16)
        drawn = sample_lights(scene, points, grey, light, 16, rng)
        return np.average(np.array(drawn.visible), weights=np.array(drawn.weight) > 0)

    assert open_sky(traced, points) > 0.995
    scene = pile_scene(pile, place, pixels, camera).traceable()
    assert scene.only_blocks.sum() == len(scene.mesh.vertices) - 6 * len(mesh.vertices) > 0
    points.x = mi.Point3f(
        points.x - dr.gather(mi.Vector3f, mi.Float(moves.ravel().astype(np.float32)), batch.view)
    )
    assert open_sky(scene, points) < 0.75


def test_sizes_that_agree_with_the_ground_are_believed_and_one_that_does_not_is_moved():
    stands = np.arange(8) < 7
    fine = np.array([0.01, -0.012, 0.009, 0.011, -0.01, 0.008, 0.15, 0.01])
    parts = parts_of_the_way(fine, stands)
    assert 0.5 < parts[0] < 0.8 and parts[6] > 0.99
    assert (parts_of_the_way(0.1 * fine, stands)[:6] == 0).all()
    assert (parts_of_the_way(5 * fine, stands) > 0.9).all()

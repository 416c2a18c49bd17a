"""The mesh follows the masks to a part of a pixel."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from relit.fit.shape.outlines import (
    Outline,
    follow_outlines,
    follow_with_poses,
    laplacian,
    outline_of,
    solve,
)
from relit.geometry.se3 import exp_so3
from relit.geometry.tangents import vertex_normals
from relit.reference.mitsuba_scene import build_geometry
from relit.scene import Mesh
from support.outlined_ball import FOCAL, SIZE, ball, coverage, ring


def shifted(mask: np.ndarray, dx: int, dy: int) -> np.ndarray:
    return np.roll(mask, (dy, dx), (0, 1))


@pytest.fixture(scope="module")
def seen():
    cameras, truth = ring(), ball()
    return cameras, [coverage(truth, c) for c in cameras]


def test_an_outline_that_lies_too_far_out_is_told_in_pixels(seen):
    mesh, camera = ball(0.505), seen[0][0]
    found = outline_of(mesh, build_geometry(mesh), camera, seen[1][0])
    each = FOCAL / 3 / (1 - (0.5 / 3) ** 2) ** 1.5  # d/dr of FOCAL tan(asin(r / 3))
    assert np.median(found.scale) == pytest.approx(each, rel=0.03)
    assert np.median(found.shift) == pytest.approx(-0.005 * each, abs=0.05)


def test_a_dented_ball_becomes_round(seen):
    cameras, masks = seen
    truth = ball()
    bump = (
        0.008 * np.sin(6 * truth.vertices[:, 0] / 0.5) + 0.006
    )  # .6 of a pixel at most, wider than a pixel
    start = Mesh((truth.vertices * (1 + bump[:, None] / 0.5)).astype(np.float32), truth.faces)
    start = replace(start, normals=vertex_normals(start))
    out = follow_outlines(start, cameras, masks, 3)
    error = lambda m: np.sqrt(np.mean((np.linalg.norm(m.vertices, axis=1) - 0.5) ** 2))  # noqa: E731
    assert error(out) < 0.25 * error(start)
    assert np.allclose(np.linalg.norm(out.normals, axis=1), 1, atol=1e-5)
    turned = lambda m: np.arccos(np.clip((m.normals * truth.normals).sum(1), -1, 1)).mean()  # noqa: E731
    assert turned(out) < 0.5 * turned(start)


def test_masks_that_contradict_one_another_move_less(seen):
    cameras, masks = seen
    rng = np.random.default_rng(0)
    loose = [shifted(m, *rng.integers(-1, 2, 2)) for m in masks]

    def moved(found):
        return np.abs(
            np.linalg.norm(follow_outlines(ball(), cameras, found, 1).vertices, axis=1) - 0.5
        ).max()

    assert moved(masks) < 0.0015  # a tenth of a pixel
    assert moved(loose) < 0.01  # the masks are wrong by up to 1.4 pixels, .019


def test_no_outline_no_move(seen):
    mesh = ball()
    empty = Outline(
        np.zeros((0, 3), int),
        np.zeros((0, 3)),
        np.zeros((0, 3)),
        np.zeros((0, 2)),
        np.zeros(0),
        np.zeros(0),
    )
    assert not solve(mesh, [empty]).any()
    still = follow_outlines(mesh, seen[0], seen[1], 0)
    assert still is mesh


def test_the_laplacian_of_what_is_even_is_nothing():
    mesh = ball()
    assert (
        np.abs(laplacian(mesh.faces, len(mesh.vertices)) @ np.ones(len(mesh.vertices))).max() < 1e-9
    )


def test_poses_follow_too():
    shape = trimesh.creation.box([0.7, 0.5, 0.9]).subdivide_loop(
        4
    )  # an egg with no symmetry of turning
    truth = Mesh(np.asarray(shape.vertices, np.float32), np.asarray(shape.faces, np.int32))
    truth = replace(truth, normals=vertex_normals(truth))
    cameras = ring(8)
    masks = [coverage(truth, c) for c in cameras]
    rng = np.random.default_rng(1)
    wrong = []
    for c in cameras:
        motion = np.eye(4)
        motion[:3, :3], motion[:3, 3] = (
            exp_so3(rng.normal(0, 0.001, 3)),
            rng.normal(0, 0.004, 3) * [1, 1, 5],
        )
        wrong.append(c.with_pose(c.world_from_camera @ motion))
    known = [np.ones_like(m) for m in masks]
    for k in known[:4]:
        k[: SIZE // 2, : SIZE // 2] = 0  # a quarter is hidden by something else
    hidden = [m * k for m, k in zip(masks, known, strict=True)]
    _, found = follow_with_poses(truth, wrong, hidden, known)
    error = lambda poses: np.std([np.linalg.inv(p)[2, 3] for p in poses])  # noqa: E731  (all together may be nearer to a smaller object)
    assert error(found) < 0.3 * error([c.world_from_camera for c in wrong])


@pytest.mark.slow
def test_places_follow_and_turns_stay(seen):
    """Every camera is moved, the first one turned too."""
    cameras, masks = seen
    rng, off = np.random.default_rng(5), []
    for k, c in enumerate(cameras):
        step = np.eye(4)
        step[:3, 3] = rng.normal(0, 0.02, 3)
        step[:3, :3] = exp_so3(np.radians([0.0, 0.0, 2.0])) if k == 0 else np.eye(3)
        off.append(c.with_pose(c.world_from_camera @ step))
    known = [np.ones_like(m) for m in masks]
    mesh, poses = follow_with_poses(ball(0.505), off, masks, known, 4, turning=False)
    size = (
        np.linalg.norm(mesh.vertices, axis=1).mean() / 0.5
    )  # all together may be nearer to a smaller object

    def off_by(poses):
        return np.array(
            [
                np.linalg.norm(p[:3, 3] - c.world_from_camera[:3, 3])
                for p, c in zip(poses, cameras, strict=True)
            ]
        )

    before, after = (
        off_by([c.world_from_camera for c in off]),
        off_by([np.block([[p[:3, :3], p[:3, 3:] / size], [p[3:]]]) for p in poses]),
    )
    assert size == pytest.approx(1, abs=0.02)
    assert np.median(before) > 0.025 and np.median(after) < 0.25 * np.median(before)
    assert all(
        np.array_equal(p[:3, :3], o.world_from_camera[:3, :3])
        for p, o in zip(poses, off, strict=True)
    )
    same, there = follow_with_poses(
        mesh, off[:4], masks[:4], known[:4], 4, turning=False, still=True
    )
    assert same is mesh and np.abs(there - poses[:4])[:, :3, 3].max() < 0.004

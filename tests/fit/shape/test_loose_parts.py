"""Parts of a shape that hang loose beside it."""

from __future__ import annotations

import numpy as np
import pytest

from relit.conventions import similarity
from relit.fit.shape.loose_parts import faces_by_part, of_faces, without_loose_parts
from relit.geometry.mesh import extract_mesh
from relit.geometry.sdf import node_positions
from relit.geometry.se3 import exp_so3
from relit.scene import Camera

SMALL = np.array(
    [0.0, 0.0, 0.75]
)  # beside the ball of radius .5 around the origin, and .12 in radius


def balls(*centres: np.ndarray):
    p = node_positions(64)
    away = [
        np.linalg.norm(p, axis=-1) - 0.5,
        *(np.linalg.norm(p - c, axis=-1) - 0.12 for c in centres),
    ]
    return extract_mesh(np.min(away, 0))


def view(angle: float) -> Camera:
    """A camera 4 units away, turned about the y axis: from 0 the small ball lies before the large
    one, at a quarter turn beside it."""
    turn = exp_so3(np.array([0.0, angle, 0.0]))
    return Camera(
        120, 120, 250.0, 250.0, 60.0, 60.0, similarity(turn, turn @ np.array([0.0, 0.0, -4.0]))
    )


def mask_of(camera: Camera, *spheres: tuple[np.ndarray, float]) -> np.ndarray:
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    d = (
        np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], -1)
        @ camera.world_from_camera[:3, :3].T
    )
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    away = [np.linalg.norm(np.cross(c - camera.centre, d), axis=-1) < r for c, r in spheres]
    return np.any(away, 0).astype(np.float32)


BALL, BESIDE = (np.zeros(3), 0.5), (SMALL, 0.12)


@pytest.mark.parametrize(
    "angles, shown, hidden, loose",
    [
        ((0.0, 3.1, 0.15), (BALL,), False, 1),  # before or behind the ball in every view
        ((0.0, 3.1, 1.57), (BALL, BESIDE), False, 0),  # the object has it
        ((0.0, 3.1, 1.57), (BALL, BESIDE), True, 1),  # where it would stand out nothing is known
    ],
)
def test_what_no_silhouette_asks_for_goes(angles, shown, hidden, loose):
    mesh, cameras = balls(SMALL), [view(a) for a in angles]
    masks = [mask_of(c, *shown) for c in cameras]
    known = [np.ones_like(m) for m in masks]
    if hidden:
        known[-1] = mask_of(cameras[-1], BALL)
    left, count = without_loose_parts(mesh, cameras, masks, known)
    assert count == loose
    assert len(left.faces) == len((balls() if loose else mesh).faces)
    assert (np.linalg.norm(left.vertices, axis=1) < 0.52).all() == bool(loose)
    assert np.allclose(
        (left.normals * left.vertices / np.linalg.norm(left.vertices, axis=1, keepdims=True)).sum(
            1
        )[:100],
        1,
        atol=0.02,
    )


def test_parts_are_told_apart():
    mesh = balls(SMALL, -SMALL)
    part = faces_by_part(mesh)
    counts = np.bincount(part)
    assert len(counts) == 3 and counts[0] > 4 * counts[1] and counts.sum() == len(mesh.faces)
    ball = of_faces(mesh, part == 0)
    assert (
        np.allclose(np.linalg.norm(ball.vertices, axis=1), 0.5, atol=0.01)
        and len(ball.faces) == counts[0]
    )
    middles = [of_faces(mesh, part == k).vertices.mean(0) for k in (1, 2)]
    assert np.allclose(sorted(m[2] for m in middles), [-0.75, 0.75], atol=0.01)
    assert without_loose_parts(balls(), [], [], [])[1] == 0

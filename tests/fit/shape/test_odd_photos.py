"""Photos whose masks the finished shape does not fill."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from relit.errors import UserError
from relit.fit.shape.odd_photos import check_overlaps, mask_overlaps, note_of_odd_photos
from relit.geometry.se3 import look_at
from relit.run import Run
from relit.scene import Camera, Mesh

SIDE = 160


def seen(count: int = 6) -> tuple[Mesh, list[Camera], list[np.ndarray]]:
    """A ball of radius .4, cameras around it at distance 3, and its masks by calculation."""
    ball = trimesh.creation.icosphere(4, 0.4)
    mesh = Mesh(
        ball.vertices.astype(np.float32),
        ball.faces.astype(np.uint32),
        ball.vertex_normals.astype(np.float32),
    )
    angles = np.arange(count) * 2 * np.pi / count
    cameras = [
        Camera(
            SIDE,
            SIDE,
            200.0,
            200.0,
            SIDE / 2,
            SIDE / 2,
            look_at(3 * np.array([np.sin(a), 0.2, np.cos(a)])),
        )
        for a in angles
    ]
    y, x = np.mgrid[:SIDE, :SIDE] + 0.5
    rays = np.stack([(x - SIDE / 2) / 200, (y - SIDE / 2) / 200, np.ones((SIDE, SIDE))], -1)
    cosine = 1 / np.linalg.norm(rays, axis=-1)
    return (
        mesh,
        cameras,
        [(cosine > np.sqrt(1 - 0.16 / (c.centre @ c.centre))).astype(np.float32) for c in cameras],
    )


def test_masks_that_the_shape_fills_are_not_spoken_of(device):
    mesh, cameras, masks = seen()
    overlaps = mask_overlaps(mesh, cameras, masks)
    assert overlaps.min() > 0.97
    assert note_of_odd_photos(overlaps, [f"{k}.png" for k in range(6)]) == ""
    assert (
        mask_overlaps(mesh, cameras[:1], [np.zeros((SIDE, SIDE), np.float32)])[0] == 0
    )  # a silhouette where the mask has none


def test_one_that_it_does_not_fill_is_named(device):
    mesh, cameras, masks = seen()
    masks[2] = np.roll(masks[2], SIDE // 6, axis=1)
    overlaps = mask_overlaps(mesh, cameras, masks)
    radius, shift = np.sqrt(masks[0].sum() / np.pi), SIDE // 6
    lens = 2 * radius**2 * np.arccos(shift / (2 * radius)) - shift / 2 * np.sqrt(
        4 * radius**2 - shift**2
    )
    assert overlaps[2] == pytest.approx(
        lens / (2 * np.pi * radius**2 - lens), abs=0.02
    )  # two discs, as far apart
    note = note_of_odd_photos(overlaps, [f"{k}.png" for k in range(6)])
    assert "1 of 6 photos" in note and "2.png" in note and "3.png" not in note


def test_a_shape_that_fills_hardly_any_is_refused(device, tmp_path):
    mesh, cameras, masks = seen()
    overlaps = mask_overlaps(mesh, cameras, [np.roll(m, SIDE // 3, axis=1) for m in masks])
    with Run.open(tmp_path / "run", {}) as run:
        with pytest.raises(UserError, match="does not fill the masks") as raised:
            check_overlaps(overlaps, run)
        assert raised.value.code == 4 and "--sphere" in raised.value.fix
        assert "--force" in raised.value.fix
        run.force = True
        check_overlaps(overlaps, run)
        assert "kept by --force" in (run.folder / "log.txt").read_text()

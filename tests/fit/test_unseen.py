"""What no photo sees is left out of the mesh of photos without masks."""

from dataclasses import replace

import numpy as np
import trimesh
from lump import cameras, lump

from relit.asset.gltf import has_border
from relit.fit.unseen import seen_faces, without_unseen
from relit.geometry.mesh import face_areas
from relit.geometry.tangents import vertex_normals
from relit.scene import Mesh


def ball(radius=0.6, dent=0.0) -> Mesh:
    """dent: depth of a narrow pit at +y."""
    sphere = trimesh.creation.icosphere(subdivisions=5, radius=1.0)
    n = np.asarray(sphere.vertices)
    pit = np.exp(-((np.linalg.norm(n - [0, 1, 0], axis=1) / 0.06) ** 2))
    mesh = Mesh((n * (radius - dent * pit)[:, None]).astype(np.float32), np.asarray(sphere.faces, np.int32))
    return replace(mesh, normals=vertex_normals(mesh))


def from_above():
    return [c for c in cameras() if c.centre[1] > 0.8]


def test_the_side_that_no_camera_sees_goes():
    mesh, views = ball(), from_above()
    kept = without_unseen(mesh, views)
    assert has_border(kept) and not has_border(mesh)
    assert kept.vertices[:, 1].max() > 0.59
    height = kept.vertices[kept.faces].mean(1)[:, 1]
    # a camera at distance D sees the cap of a ball of radius r above the plane r^2 / D from its centre
    lowest = min((c.centre / np.linalg.norm(c.centre))[1] for c in views)
    tilt = np.arccos(lowest)
    below = 0.6 * np.cos(tilt + np.arccos(0.6 / 2.1))
    assert below - 0.08 < height.min() < below + 0.08
    assert len(kept.normals) == len(kept.vertices)
    np.testing.assert_allclose(np.linalg.norm(kept.vertices, axis=1), 0.6, atol=0.01)


def test_seen_from_everywhere_it_stays_closed():
    mesh = ball()
    assert seen_faces(mesh, cameras()).all()
    assert without_unseen(mesh, cameras()) is mesh


def test_small_gaps_stay_filled():
    mesh = ball(dent=0.45)
    above = [c for c in cameras() if abs(c.centre[1]) < 1.6]
    unseen = ~seen_faces(mesh, above)
    assert 0 < face_areas(mesh)[unseen].sum() < 0.01 * face_areas(mesh).sum()
    assert not has_border(without_unseen(mesh, above))


def test_cameras_that_see_nothing_leave_the_mesh_as_it_is():
    mesh, _ = lump()
    away = [c.with_pose(c.world_from_camera @ np.diag([-1.0, 1.0, -1.0, 1.0])) for c in cameras()]
    assert without_unseen(mesh, away) is mesh

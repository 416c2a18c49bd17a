"""What no photo sees is left out of the mesh of photos without masks."""

from dataclasses import replace

import numpy as np
import trimesh

from relit.asset.gltf import has_border
from relit.fit.duplicates.recipe import shown_faces
from relit.fit.shape.unseen import seen_faces, seen_points, without_unseen
from relit.geometry.mesh import face_areas
from relit.geometry.se3 import look_at
from relit.geometry.tangents import vertex_normals
from relit.reference.mitsuba_scene import build_geometry
from relit.scene import Mesh
from support.lump import cameras, lump


def ball(radius=0.6, dent=0.0) -> Mesh:
    """dent: depth of a narrow pit at +y."""
    sphere = trimesh.creation.icosphere(subdivisions=5, radius=1.0)
    n = np.asarray(sphere.vertices)
    pit = np.exp(-((np.linalg.norm(n - [0, 1, 0], axis=1) / 0.06) ** 2))
    mesh = Mesh(
        (n * (radius - dent * pit)[:, None]).astype(np.float32), np.asarray(sphere.faces, np.int32)
    )
    return replace(mesh, normals=vertex_normals(mesh))


def from_above():
    return [c for c in cameras() if c.centre[1] > 0.8]


def test_the_side_that_no_camera_sees_goes():
    mesh, views = ball(), from_above()
    kept = without_unseen(mesh, views)
    assert has_border(kept) and not has_border(mesh)
    assert kept.vertices[:, 1].max() > 0.59
    height = kept.vertices[kept.faces].mean(1)[:, 1]
    # a camera at distance D sees the cap of a ball of radius r above the plane r^2 / D from its
    # centre
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


def test_what_stands_behind_another_body_is_not_seen():
    one = ball(0.4)
    far = replace(one, vertices=one.vertices - np.float32([0, 0, 2]))
    faces = np.concatenate([one.faces, far.faces + len(one.vertices)])
    both = Mesh(
        np.concatenate([one.vertices, far.vertices]), faces, np.concatenate([one.normals] * 2)
    )
    before = cameras()[0].with_pose(look_at(np.array([0.0, 0.0, 2.1])))
    seen = seen_faces(both, [before])
    front = one.vertices[one.faces].mean(1)[:, 2] > 0.2
    assert seen[: len(front)][front].all() and not seen[len(front) :].any()


def test_aslant_is_seen_by_a_lower_cosine_alone():
    mesh, eye = ball(0.6), np.array([0.0, 0.0, 2.1])
    camera = cameras()[0].with_pose(look_at(eye))
    to = eye - mesh.vertices
    cosine = (mesh.normals * to).sum(1) / np.linalg.norm(to, axis=1)
    scene = build_geometry(mesh)
    for least in (0.0, 0.3):
        seen = seen_points(scene, mesh.vertices, mesh.normals, [camera], least)
        assert seen[cosine > least + 0.05].all() and not seen[cosine < least].any()


def test_what_another_instance_hides_of_all_counts_as_unseen():
    """Two instances, one straight behind the other: of the far one nothing is seen, of the near one
    its front."""
    one = ball(0.6)
    far = one.vertices - np.float32([0, 0, 2])
    n = len(one.vertices)
    vertices, normals = np.concatenate([one.vertices, far]), np.tile(one.normals, (2, 1))
    pile = Mesh(vertices, np.concatenate([one.faces, one.faces + n]), normals, np.zeros((2 * n, 2)))
    front = cameras()[0].with_pose(look_at(np.array([0.0, 0.0, 2.1])))
    middle = one.vertices[one.faces].mean(1)[:, 2]
    both = np.array([True, True])
    seen = shown_faces(pile, both, [front])
    assert seen.shape == (len(one.faces),)
    assert seen[middle > 0.3].all() and not seen[middle < 0.1].any()
    back = cameras()[0].with_pose(look_at(np.array([0.0, 0.0, -4.1]), np.array([0.0, 0.0, -2.0])))
    assert shown_faces(pile, both, [front, back])[middle < -0.3].all()  # which the far one shows
    assert not shown_faces(pile, np.array([True, False]), [front, back])[
        middle < 0.1
    ].any()  # but not where its turn is a guess

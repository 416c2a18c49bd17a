"""Vertex normals and tangents."""

import numpy as np
import pytest

from relit.geometry.tangents import vertex_normals, vertex_tangents
from relit.scene import Mesh


def cylinder(mirrored: bool, columns=24) -> Mesh:
    """Open cylinder round +Y, u round it (or back), v downwards, with a seam."""
    v, u = np.meshgrid(np.linspace(0, 1, 5), np.linspace(0, 1, columns + 1), indexing="ij")
    phi = 2 * np.pi * u
    points = np.stack([np.sin(phi), 1 - 2 * v, np.cos(phi)], -1).reshape(-1, 3)
    index = np.arange(v.size).reshape(v.shape)
    a, b, c, d = (
        i.ravel() for i in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:])
    )
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
    uvs = np.stack([1 - u if mirrored else u, v], -1).reshape(-1, 2)
    return Mesh(points.astype(np.float32), faces.astype(np.int32), None, uvs.astype(np.float32))


def test_normals_point_outwards_and_ignore_the_seam():
    mesh = cylinder(False)
    radial = mesh.vertices * [1, 0, 1]
    assert np.allclose(vertex_normals(mesh), radial, atol=1e-5)


def test_normals_are_weighted_by_angle_not_by_triangle_count():
    """A cube's corners, whichever way its squares are cut, point along the diagonal."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32)
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    faces = np.array([t for a, b, c, d in quads for t in ([a, b, c], [a, c, d])], np.int32)
    assert np.allclose(vertex_normals(Mesh(corners, faces)), corners / np.sqrt(3), atol=1e-6)


@pytest.mark.parametrize("mirrored", [False, True])
def test_tangents_follow_u_and_the_bitangent_points_up_in_the_texture(mirrored):
    mesh = cylinder(mirrored)
    t = vertex_tangents(mesh)
    x, _, z = mesh.vertices.T
    along = np.stack([z, 0 * x, -x], -1) * (-1 if mirrored else 1)
    inner = (mesh.uvs[:, 0] > 0) & (mesh.uvs[:, 0] < 1)
    assert np.allclose(t[inner, :3], along[inner], atol=1e-5)
    assert np.allclose(np.abs(t[:, 3]), 1)
    up = t[:, 3:] * np.cross(vertex_normals(mesh), t[:, :3])
    assert np.allclose(up, [0, 1, 0], atol=1e-5)


def test_degenerate_coordinates_still_give_unit_tangents():
    mesh = cylinder(False)
    flat = Mesh(mesh.vertices, mesh.faces, None, np.zeros_like(mesh.uvs))
    t = vertex_tangents(flat)
    assert np.allclose(np.linalg.norm(t[:, :3], axis=1), 1, atol=1e-5)
    assert np.abs((t[:, :3] * vertex_normals(flat)).sum(1)).max() < 1e-5
    assert np.isfinite(t).all()

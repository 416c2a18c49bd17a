"""Edges, vertex normals and tangents of a mesh, in NumPy."""

from __future__ import annotations

import numpy as np

from relit.scene import Mesh


def _unit(x):
    """(N, 3) -> unit rows; zero rows become +Z."""
    length = np.linalg.norm(x, axis=-1, keepdims=True)
    return np.where(length > 1e-20, x / np.maximum(length, 1e-20), np.array([0.0, 0.0, 1.0]))


def _corner_angles(corners):
    """Three (F, 1): the angles of faces (F, 3, 3) at their first, second and third corners."""
    sides = [
        _unit(corners[:, (k + 1) % 3] - corners[:, k]) for k in range(3)
    ]  # from each corner to the next one
    return [
        np.arccos(np.clip(-(sides[k] * sides[k - 1]).sum(-1, keepdims=True), -1, 1))
        for k in range(3)
    ]


def _sums(faces, shares, count):
    """(count, 3) what the corners of all faces (F, 3) add up to at their vertices. shares: three
    (F, 3), of the faces' first, second and third corners."""
    index, values = np.asarray(faces).T.ravel(), np.concatenate(shares)
    return np.stack([np.bincount(index, values[:, k], count) for k in range(3)], -1)


def edges(faces: np.ndarray) -> np.ndarray:
    """(3 F, 2) vertices of the sides of all faces: first sides 0-1 of all, then sides 1-2, then
    sides 2-0."""
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def vertex_normals(mesh: Mesh) -> np.ndarray:
    """(V, 3) float32 unit normals weighted by corner angles; vertices at one position (a UV seam),
    to a millionth of the mesh, share their normal."""
    v, f = np.asarray(mesh.vertices, np.float64), mesh.faces
    grid = max(float(np.ptp(v, axis=0).max(initial=0.0)), 1e-30) * 1e-6
    _, ident = np.unique(
        np.round((v - v.min(0, initial=np.inf)) / grid).astype(np.int64),
        axis=0,
        return_inverse=True,
    )
    ident = ident.reshape(-1)
    corners = v[f]  # [F, 3, 3]
    face = _unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    total = _sums(ident[f], [face * a for a in _corner_angles(corners)], ident.max(initial=-1) + 1)
    return _unit(total)[ident].astype(np.float32)


def vertex_tangents(mesh: Mesh) -> np.ndarray:
    """(V, 4) float32 tangents as glTF has them: xyz along +u, orthogonal to the normal; w = +1 or
    -1 so that w * cross(normal, xyz) points UP in the texture (against v, whose zero is the top
    row).

    Averaged over the faces of a vertex, weighted by angle. Where the UVs are degenerate any
    orthogonal direction stands in.
    """
    v, f, uv = np.asarray(mesh.vertices, np.float64), mesh.faces, np.asarray(mesh.uvs, np.float64)
    n = np.asarray(mesh.normals if mesh.normals is not None else vertex_normals(mesh), np.float64)
    corners, st = v[f], uv[f]
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    d1, d2 = st[:, 1] - st[:, 0], st[:, 2] - st[:, 0]
    det = d1[:, 0] * d2[:, 1] - d1[:, 1] * d2[:, 0]
    sign = np.sign(det)[:, None]
    dp_du = (e1 * d2[:, 1:] - e2 * d1[:, 1:]) * sign  # direction only
    dp_dv = (e2 * d1[:, :1] - e1 * d2[:, :1]) * sign
    length_u, length_v = (
        np.linalg.norm(dp_du, axis=-1, keepdims=True),
        np.linalg.norm(dp_dv, axis=-1, keepdims=True),
    )
    dp_du, dp_dv = dp_du / np.maximum(length_u, 1e-30), dp_dv / np.maximum(length_v, 1e-30)
    angles = _corner_angles(corners)
    along_u, along_v = (_sums(f, [along * a for a in angles], len(v)) for along in (dp_du, dp_dv))
    t = along_u - n * (n * along_u).sum(-1, keepdims=True)
    lost = np.linalg.norm(t, axis=-1) < 1e-8
    axis = np.where(np.abs(n[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    t = _unit(np.where(lost[:, None], axis - n * (n * axis).sum(-1, keepdims=True), t))
    w = np.where((np.cross(n, t) * along_v).sum(-1) > 0, -1.0, 1.0)
    return np.concatenate([t, w[:, None]], -1).astype(np.float32)

"""Between textures and the surface: which texel lies where, and filling the gutters between
charts."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import distance_transform_edt

from relit.scene import Mesh


def rasterise_atlas(mesh: Mesh, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Which face covers the centre of each texel: face (S, S) int32 (-1: none) and barycentric
    coordinates (S, S, 3) float32."""
    face = np.full((size, size), -1, np.int32)
    bary = np.zeros((size, size, 3), np.float32)
    corners = mesh.uvs[mesh.faces].astype(np.float64) * size - 0.5  # texel centres at integers
    low = np.clip(np.ceil(corners.min(1) - 1e-6), 0, size - 1).astype(int)
    high = np.clip(np.floor(corners.max(1) + 1e-6), 0, size - 1).astype(int)
    span = high - low + 1
    span = np.maximum(span, 0)
    for extent in np.unique(span, axis=0):  # faces of one box size at a time, vectorised
        w, h = int(extent[0]), int(extent[1])
        if w <= 0 or h <= 0:
            continue
        which = np.flatnonzero((span == extent).all(1))
        dx, dy = np.meshgrid(np.arange(w), np.arange(h))
        for part in np.array_split(which, max(1, len(which) * w * h // 2_000_000)):
            x = low[part, 0, None] + dx.ravel()
            y = low[part, 1, None] + dy.ravel()
            a, b, c = (corners[part, k][:, None] for k in range(3))
            det = (b[..., 1] - c[..., 1]) * (a[..., 0] - c[..., 0]) + (c[..., 0] - b[..., 0]) * (
                a[..., 1] - c[..., 1]
            )
            det = np.where(np.abs(det) < 1e-12, 1e-12, det)
            l0 = (
                (b[..., 1] - c[..., 1]) * (x - c[..., 0])
                + (c[..., 0] - b[..., 0]) * (y - c[..., 1])
            ) / det
            l1 = (
                (c[..., 1] - a[..., 1]) * (x - c[..., 0])
                + (a[..., 0] - c[..., 0]) * (y - c[..., 1])
            ) / det
            l2 = 1 - l0 - l1
            inside = (l0 >= -1e-4) & (l1 >= -1e-4) & (l2 >= -1e-4)
            f = np.broadcast_to(part[:, None], inside.shape)
            face[y[inside], x[inside]] = f[inside]
            bary[y[inside], x[inside]] = np.stack([l0, l1, l2], -1)[inside]
    return face, bary


def interpolate(
    mesh_values: np.ndarray, faces: np.ndarray, face: np.ndarray, bary: np.ndarray
) -> np.ndarray:
    """Vertex values (V, C) at covered texels: (S, S, C), 0 where face is -1."""
    out = np.einsum("ijk,ijkc->ijc", bary, mesh_values[faces[np.maximum(face, 0)]])
    return np.where(face[..., None] >= 0, out, 0).astype(np.float32)


def fill_gutters(texture: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Give unknown texels the value of the nearest known one, so that filtering across chart
    borders brings in nothing foreign."""
    if known.all() or not known.any():
        return texture
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    return texture[tuple(nearest)]

"""A signed distance field from depth maps (Curless & Levoy 1996)."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from scipy.ndimage import gaussian_filter, label

from relit.geometry.sdf import node_positions, redistance
from relit.scene import Camera


def fuse_depths(
    cameras: Iterable[Camera], depths: Iterable[np.ndarray], n: int, *, truncation: float
) -> np.ndarray:
    """Signed distance (n, n, n) float32 over [-1, 1]^3.

    cameras: unit frame. depths: (H, W) distances along the rays, not along the optical axis. A node
    counts a view when it lies in front of the depth or at most `truncation` behind it; nodes that
    only ever lie deeper are inside, nodes that no view looks at are outside.
    """
    p = node_positions(n).reshape(-1, 3).astype(np.float64)
    total, count, looked = np.zeros(len(p)), np.zeros(len(p)), np.zeros(len(p), bool)
    for camera, depth in zip(cameras, depths, strict=False):
        q = camera.project(p)
        u, v = np.floor(q[:, 0]).astype(np.int64), np.floor(q[:, 1]).astype(np.int64)
        ok = np.flatnonzero(
            (q[:, 2] > 1e-6) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        )
        looked[ok] = True
        s = depth[v[ok], u[ok]] - np.linalg.norm(p[ok] - camera.centre, axis=1)
        near = s > -truncation
        total[ok[near]] += np.clip(s[near], -truncation, truncation)
        count[ok[near]] += 1
    seen = count >= 2
    values = np.where(seen, total / np.maximum(count, 1), np.where(looked, -truncation, truncation))
    values = np.where((p**2).sum(1) > 0.98**2, truncation, values).reshape(n, n, n)
    values = gaussian_filter(values, 0.7)
    parts, number = label(values < 0)
    if number > 1:  # specks of the first fit
        sizes = np.bincount(parts.ravel())[1:]
        small = np.flatnonzero(sizes < 0.02 * sizes.max()) + 1
        values = np.where(np.isin(parts, small), truncation, values)
    if values.min() >= 0:
        raise ValueError("no depth lies inside the object sphere")
    return redistance(values)

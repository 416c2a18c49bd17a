"""The visual hull of masks: where the volume pass begins."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from scipy.ndimage import distance_transform_edt

from relit.geometry.sdf import node_positions
from relit.scene import Camera


class NoShape(ValueError):
    """Silhouettes, in the poses given, leave no shape."""


def visual_hull(
    cameras: Iterable[Camera], masks: Iterable[np.ndarray], n: int, *, tolerance: float = 1 / 30
) -> np.ndarray:
    """Signed distance (n, n, n) float32 [z, y, x] of the visual hull over [-1, 1]^3.

    cameras: in the unit frame. masks: (H, W) in [0, 1], one per camera. A node belongs to the hull
    when some camera sees it and at most `tolerance` of the cameras that see it (one in thirty) have
    background there; so one bad mask does not carve the object away.
    """
    p = node_positions(n).reshape(-1, 3)
    seen = np.zeros(len(p), np.int32)
    empty = np.zeros(len(p), np.int32)
    for camera, mask in zip(cameras, masks, strict=False):
        m = camera.camera_from_world.astype(np.float32)
        q = p @ m[:3, :3].T + m[:3, 3]
        z = np.maximum(q[:, 2], 1e-6)
        u = np.floor(camera.fx * q[:, 0] / z + camera.cx).astype(np.int64)
        v = np.floor(camera.fy * q[:, 1] / z + camera.cy).astype(np.int64)
        ok = (q[:, 2] > 1e-6) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        seen += ok
        empty[ok] += mask[v[ok], u[ok]] < 0.3
    inside = (seen > 0) & (empty <= np.floor(seen * tolerance + 1e-6))
    inside &= (p**2).sum(1) < 1.0
    return distance_of(inside.reshape(n, n, n))


def distance_of(inside: np.ndarray) -> np.ndarray:
    """Signed distance (n, n, n) of an occupancy grid over [-1, 1]^3, negative inside."""
    h = 2.0 / (inside.shape[0] - 1)
    if not inside.any() or inside.all():
        raise NoShape("the occupancy is empty or full")
    return ((distance_transform_edt(~inside) - distance_transform_edt(inside)) * h).astype(
        np.float32
    )

"""Views of an ellipsoid with a colour for each octant."""

from __future__ import annotations

import numpy as np

from relit.conventions import similarity
from relit.fit.registration.instances.views import (
    views_of,
)
from relit.geometry.se3 import exp_so3
from relit.scene import Camera


def painted(angles, axes=(0.5, 0.35, 0.7), contrast=0.7) -> tuple[list, np.ndarray]:
    """Views of an ellipsoid with a colour for each octant, turned by `angles` (degrees about +y),
    and their poses."""
    axes, side = np.array(axes), 96
    u, v = np.meshgrid(np.arange(side) + 0.5, np.arange(side) + 0.5)
    camera = Camera(side, side, 260.0, 260.0, side / 2, side / 2, np.eye(4))
    d = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1)
    views, poses = [], []
    for k, a in enumerate(angles):
        turn = exp_so3(np.array([0.2, np.radians(a), 0.0]))
        pose = similarity(turn, -5.0 * turn[:, 2])
        o, w = pose[:3, 3] / axes, (d @ turn.T) / axes
        b, e, c = (w * o).sum(-1), (w * w).sum(-1), o @ o - 1
        root = b * b - e * c
        p = (o + w * ((-b - np.sqrt(np.maximum(root, 0))) / e)[..., None]) * axes
        colour = 0.15 + contrast * (p > np.array([0.05, 0.0, -0.1]))
        mask = (root > 0).astype(np.float32)
        rgb = (colour * mask[..., None]).astype(np.float32)
        views += views_of(rgb, (mask > 0).astype(np.int32) * (k + 1), camera, 10**6)
        poses.append(pose)
    return views, np.array(poses)

"""Views of an ellipsoid with a smaller one at its head."""

from __future__ import annotations

import numpy as np

from relit.conventions import similarity
from relit.fit.registration.instances.views import InstanceView
from relit.geometry.se3 import exp_so3
from relit.scene import Camera

SIDE = 96


def views_of_body(angles, colour, lopsided=0.0, parts=None):
    """(views, poses) of two ellipsoids, one at the other's head, coloured by position, seen from
    `angles` (degrees about +y) and a little from above. lopsided: how far the head lies to one side
    (x). parts: [(middle, half axes)] of other ellipsoids."""
    u, v = np.meshgrid(np.arange(SIDE) + 0.5, np.arange(SIDE) + 0.5)
    camera = Camera(SIDE, SIDE, 230.0, 230.0, SIDE / 2, SIDE / 2, np.eye(4))
    d = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1)
    parts = parts or [
        (np.zeros(3), np.array([0.3, 0.25, 0.55])),
        (np.array([lopsided, 0.3, 0.35]), np.array([0.2, 0.3, 0.15])),
    ]
    views, poses = [], []
    for k, a in enumerate(angles):
        turn = exp_so3(np.array([0.0, np.radians(a), 0.0])) @ exp_so3(np.array([-0.4, 0.0, 0.0]))
        pose = similarity(turn, -5.0 * turn[:, 2])
        best, rgb = np.full(u.shape, np.inf), np.zeros((SIDE, SIDE, 3))
        for centre, axes in parts:
            o, w = (pose[:3, 3] - centre) / axes, (d @ turn.T) / axes
            b, e, c = (w * o).sum(-1), (w * w).sum(-1), o @ o - 1
            root = b * b - e * c
            t = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / e, np.inf)
            hit = t < best
            p = pose[:3, 3] + np.where(hit, t, 0)[..., None] * (d @ turn.T)
            rgb[hit], best = colour(p[hit]), np.minimum(best, t)
        mask = np.isfinite(best).astype(np.float32)
        views.append(
            InstanceView(k + 1, camera, rgb.astype(np.float32), mask, np.ones_like(mask), 1.0)
        )
        poses.append(pose)
    return views, np.array(poses)

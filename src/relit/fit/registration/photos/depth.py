"""How deep an object may be where its photos are all from one side: silhouettes leave that open,
and a hull would reach far behind it."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import distance_transform_edt

from relit.fit.registration.register import Crop, crop_views
from relit.geometry.sdf import node_positions
from relit.scene import Camera

ONE_SIDE = 75.0  # degrees between viewpoints below which silhouettes leave the depth open


def inflated_occupancy(crop: Crop, camera: Camera, nodes: int, loosen: float) -> np.ndarray:
    """(n, n, n) bool: where the object may be when one photo was seen from `camera`: as thick as
    its outline is far."""
    p = node_positions(nodes).reshape(-1, 3)
    to_outline = distance_transform_edt(crop.mask > 0.5) * (
        np.linalg.norm(camera.centre) / camera.fx
    )
    q = camera.project(p)
    u, v = np.floor(q[:, 0]).astype(int), np.floor(q[:, 1]).astype(int)
    ok = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    limit = np.zeros(len(p))
    limit[ok] = np.minimum(to_outline[v[ok], u[ok]] * 1.4, 0.6)
    depth = np.abs(p @ camera.world_from_camera[:3, 2])
    return (depth < limit * loosen + 0.03).reshape(nodes, nodes, nodes)


def depth_limit(crops: list[Crop], poses: np.ndarray, nodes: int) -> np.ndarray | None:
    """(n, n, n) bool: where the object may be, told by the photo in the middle of the others, while
    all look from one side: then their silhouettes leave its depth open. None where they go around
    it."""
    centres = poses[:, :3, 3] / np.linalg.norm(poses[:, :3, 3], axis=1, keepdims=True)
    middle = int((centres @ centres.mean(0)).argmax())
    spread = np.degrees(np.arccos(np.clip((centres @ centres[middle]).min(), -1, 1)))
    if spread >= ONE_SIDE:
        return None
    return inflated_occupancy(
        crops[middle], crop_views([crops[middle]], poses[middle][None])[0], nodes, 1 + spread / 40
    )

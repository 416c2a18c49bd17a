"""Where a reconstructed mesh stands in the frame of the user's cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from relit.conventions import move_points, similarity
from relit.scene import Capture, Mesh


def placed_mesh(capture: Capture, mesh: Mesh) -> tuple[Mesh, np.ndarray]:
    """A mesh of the unit frame in the asset's, and world_from_asset (4, 4): the origin in the
    middle of the object sphere, +Y up where the capture knows its up direction, lengths in the
    units of the user's cameras."""
    up = np.array([0.0, 1.0, 0.0]) if capture.up is None else np.asarray(capture.up, np.float64)
    world_from_asset = similarity(rotation_from_y(up), capture.sphere.centre)
    asset_from_unit = np.linalg.inv(world_from_asset) @ capture.sphere.world_from_unit
    rotation = asset_from_unit[:3, :3] / np.cbrt(np.linalg.det(asset_from_unit[:3, :3]))
    vertices = move_points(asset_from_unit, mesh.vertices).astype(np.float32)
    return replace(
        mesh, vertices=vertices, normals=(mesh.normals @ rotation.T).astype(np.float32)
    ), world_from_asset


def rotation_from_y(up: np.ndarray) -> np.ndarray:
    """The shortest rotation (3, 3) that carries +Y to `up`."""
    y, u = np.array([0.0, 1.0, 0.0]), up / np.linalg.norm(up)
    axis, cosine = np.cross(y, u), float(y @ u)
    if cosine < -0.999999:
        return np.diag([1.0, -1.0, -1.0])
    k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + k + k @ k / (1 + cosine)

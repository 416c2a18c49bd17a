"""A ball, cameras around it, and its coverage of pixels."""

import numpy as np
import trimesh

from relit.fit.shape.outlines import (
    trace_rays,
)
from relit.reference.mitsuba_scene import build_geometry
from relit.scene import Camera, Mesh

SIZE, FOCAL = 96, 220.0


def looking_at_origin(direction) -> Camera:
    z = -np.asarray(direction, float) / np.linalg.norm(direction)
    x = np.cross(z, [0.3, 0.9, 0.1])
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([x, np.cross(z, x), z], 1), -3 * z
    return Camera(SIZE, SIZE, FOCAL, FOCAL, SIZE / 2, SIZE / 2, pose)


def ring(count: int = 24) -> list[Camera]:
    k = np.arange(count) + 0.5
    y, turn = 1 - 2 * k / count, k * np.pi * (3 - np.sqrt(5))
    return [
        looking_at_origin(d)
        for d in np.stack(
            [np.sqrt(1 - y * y) * np.cos(turn), y, np.sqrt(1 - y * y) * np.sin(turn)], -1
        )
    ]


def ball(radius=0.5) -> Mesh:
    shape = trimesh.creation.icosphere(4, 1.0)
    v = np.asarray(shape.vertices)
    return Mesh(
        (v * radius).astype(np.float32), np.asarray(shape.faces, np.int32), v.astype(np.float32)
    )


def coverage(mesh: Mesh, camera: Camera, side: int = 8) -> np.ndarray:
    part = (np.arange(side) + 0.5) / side
    y, x = np.mgrid[:SIZE, :SIZE]
    at = np.broadcast_arrays(x[..., None, None] + part, y[..., None, None] + part[:, None])
    met = np.isfinite(trace_rays(build_geometry(mesh), camera, at[0].ravel(), at[1].ravel())[0])
    return met.reshape(SIZE, SIZE, side * side).mean(-1).astype(np.float32)

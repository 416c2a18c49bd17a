"""A painted lump, views of it, and poses that are off."""

import numpy as np
import trimesh

from relit.fit.shape.alignment import camera_after_motion
from relit.fit.shape.outlines import trace_rays
from relit.fit.shape.texture_shifts import shown_by
from relit.geometry.se3 import exp_so3
from relit.reference.mitsuba_scene import build_geometry
from relit.scene import Camera, Mesh

SIZE, FOCAL = 160, 400.0


def lump() -> Mesh:
    """An egg with bumps: its outlines tell poses, its surface is not a sphere's."""
    shape = trimesh.creation.icosphere(4, 1.0)
    v = np.asarray(shape.vertices)
    radius = 0.45 * (
        1 + 0.15 * np.sin(3 * v[:, :1] + 1) * np.cos(4 * v[:, 1:2]) + 0.1 * np.sin(5 * v[:, 2:])
    )
    v = v * radius * [1.25, 0.85, 1.0]
    made = trimesh.Trimesh(v, shape.faces, process=False)
    return Mesh(
        v.astype(np.float32),
        np.asarray(shape.faces, np.int32),
        np.asarray(made.vertex_normals, np.float32),
    )


def colours(points: np.ndarray) -> np.ndarray:
    """A pattern without edges, in the object's frame."""
    waves = np.random.default_rng(3).normal(size=(12, 3)) * 14
    values = np.sin(points @ waves.T + np.arange(12))
    return 0.5 + 0.12 * values.reshape(*points.shape[:-1], 3, 4).sum(-1)


def camera_at(direction, turn) -> Camera:
    z = -np.asarray(direction, float) / np.linalg.norm(direction)
    x = np.cross(z, [0.3, 0.9, 0.1])
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([x, np.cross(z, x), z], 1) @ exp_so3([0, 0, turn]), -3 * z
    return Camera(SIZE, SIZE, FOCAL, FOCAL, SIZE / 2, SIZE / 2, pose)


def shown(mesh: Mesh, cameras: list[Camera], paint=colours):
    """(pictures, masks) of the mesh, each under another light. paint: colours (..., 3) of points
    (..., 3)."""
    scene = build_geometry(mesh)
    pictures, masks = [], []
    part = (np.arange(4) + 0.5) / 4
    y, x = np.mgrid[:SIZE, :SIZE]
    at = np.broadcast_arrays(x[..., None, None] + part, y[..., None, None] + part[:, None])
    for k, camera in enumerate(cameras):
        seen = shown_by(mesh, scene, camera, np.ones((SIZE, SIZE), np.float32))
        brightness = 0.6 + 0.3 * np.sin(0.02 * x + k)[..., None]
        picture = np.full((SIZE, SIZE, 3), 0.1, np.float32)
        picture[seen.hit] = (
            np.broadcast_to(brightness, picture.shape)[seen.hit] * paint(seen.point)
        ).astype(np.float32)
        pictures.append(picture)
        hit = np.isfinite(trace_rays(scene, camera, at[0].ravel(), at[1].ravel())[0])
        masks.append(hit.reshape(SIZE, SIZE, 16).mean(-1).astype(np.float32))
    return pictures, masks


def astray(cameras, degrees, seed=0) -> list[Camera]:
    turns = np.random.default_rng(seed).normal(size=(len(cameras), 3))
    turns *= np.radians(degrees) / np.linalg.norm(turns, axis=1, keepdims=True)
    return [
        camera_after_motion(c, np.append(t, np.zeros(3)))
        for c, t in zip(cameras, turns, strict=True)
    ]


def everywhere(masks) -> list[np.ndarray]:
    return [np.ones_like(m) for m in masks]

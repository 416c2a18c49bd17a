"""A small textured lump without symmetry, photographed: the captures of the tests of cameras,
normal priors and stopped fits."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh

from relit.conventions import world_from_gl_camera
from relit.geometry.se3 import exp_so3, look_at
from relit.geometry.tangents import vertex_normals
from relit.images import write_linear
from relit.reference.mitsuba_scene import build_scene, render, render_channels
from relit.scene import Camera, Material, Mesh

SIZE, VIEWS, FIELD = 56, 16, np.radians(38)


def radius(n: np.ndarray) -> np.ndarray:
    """(N,) distance of the surface from the origin in unit directions (N, 3)."""
    return (
        0.46
        + 0.07 * np.sin(3 * n[:, 0] + 1) * np.cos(2.5 * n[:, 1])
        + 0.06 * n[:, 2] * n[:, 0]
        + 0.05 * np.sin(4 * n[:, 2])
    )


def lump() -> tuple[Mesh, Material]:
    """Radius about .5, with dents; a texture of random patches."""
    ball = trimesh.creation.uv_sphere(1.0, count=[32, 32])
    n = np.asarray(ball.vertices, np.float64)
    uvs = np.stack(
        [np.arctan2(n[:, 1], n[:, 0]) / (2 * np.pi) + 0.5, np.arccos(n[:, 2].clip(-1, 1)) / np.pi],
        -1,
    )
    mesh = Mesh(
        (n * radius(n)[:, None]).astype(np.float32),
        np.asarray(ball.faces, np.int32),
        None,
        uvs.astype(np.float32),
    )
    base = np.random.default_rng(0).uniform(0.08, 0.8, (12, 20, 3)).astype(np.float32)
    return replace(mesh, normals=vertex_normals(mesh)), Material(
        base, np.full((2, 2), 0.8, np.float32), np.zeros((2, 2), np.float32)
    )


def cameras(size: int = SIZE, views: int = VIEWS) -> list[Camera]:
    """All around, 2.1 from the origin."""
    out, focal = [], 0.5 * size / np.tan(FIELD / 2)
    for i in range(views):
        y = 1 - 2 * (i + 0.5) / views
        o = 2.1 * np.array(
            [np.sqrt(1 - y * y) * np.cos(2.4 * i), y, np.sqrt(1 - y * y) * np.sin(2.4 * i)]
        )
        out.append(Camera(size, size, focal, focal, size / 2, size / 2, look_at(o)))
    return out


def write_photos(folder: Path, *, normals: float | None = None) -> Path:
    """The photos with alpha and their cameras. normals: also STEM_normal.exr of each, the true ones
    (camera axes) times this sign."""
    mesh, material = lump()
    light = np.full((8, 16, 3), 0.5, np.float32)
    light[1:3, 3:6] = 3.0
    scene = build_scene(mesh, material, np.eye(4), light)
    for i, camera in enumerate(cameras()):
        write_linear(folder / f"r_{i:02d}.exr", render(scene, camera, spp=24, seed=i))
        if normals is not None:
            world = render_channels(scene, camera, spp=16)["normal"]
            write_linear(
                folder / f"r_{i:02d}_normal.exr", normals * world @ camera.world_from_camera[:3, :3]
            )
    write_cameras(folder, cameras())
    return folder


def write_cameras(folder: Path, cameras: list[Camera]) -> None:
    frames = [
        {
            "file_path": f"r_{i:02d}.exr",
            "transform_matrix": world_from_gl_camera(c.world_from_camera).tolist(),
        }
        for i, c in enumerate(cameras)
    ]
    (folder / "transforms.json").write_text(
        json.dumps({"camera_angle_x": float(FIELD), "frames": frames})
    )


def shaken(cameras: list[Camera], degrees: float, length: float) -> list[Camera]:
    """Each camera turned about its centre by `degrees` and moved by `length`, in random
    directions."""
    rng, out = np.random.default_rng(5), []
    for camera in cameras:
        axis, move = rng.normal(size=(2, 3))
        pose = camera.world_from_camera.copy()
        pose[:3, :3] = exp_so3(axis / np.linalg.norm(axis) * np.radians(degrees)) @ pose[:3, :3]
        pose[:3, 3] += move / np.linalg.norm(move) * length
        out.append(camera.with_pose(pose))
    return out


def distance_to_truth(vertices: np.ndarray) -> float:
    """Mean distance of world points (N, 3) from the true surface, along the line to the origin."""
    length = np.linalg.norm(vertices, axis=1)
    return float(np.abs(length - radius(vertices / length[:, None])).mean())

"""A striped ball in the NeRF-synthetic layout: the capture of most tests of the command line."""

from __future__ import annotations

import json

import numpy as np
from PIL import Image

from relit.conventions import world_from_gl_camera
from relit.geometry.se3 import look_at

SIDE, FOV = 48, 0.7


def eye(i, n=6):
    angle = 2 * np.pi * i / n
    return np.array([3 * np.sin(angle), 0.8, 3 * np.cos(angle)])


def picture(i, n=6):
    """RGBA (48, 48, 4) uint8: a ball of radius .7 at the origin with stripes, seen from
    `eye(i)`."""
    pose = look_at(eye(i, n), np.zeros(3))
    focal = 0.5 * SIDE / np.tan(0.5 * FOV)
    x, y = np.meshgrid(np.arange(SIDE) + 0.5 - SIDE / 2, np.arange(SIDE) + 0.5 - SIDE / 2)
    d = np.stack([x / focal, y / focal, np.ones_like(x)], -1) @ pose[:3, :3].T
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    b, c = d @ pose[:3, 3], pose[:3, 3] @ pose[:3, 3] - 0.7**2
    hit = b * b > c
    point = pose[:3, 3] - (b + np.sqrt(np.maximum(b * b - c, 0)))[..., None] * d
    shade = 0.5 + 0.4 * np.sin(9 * point) * np.sign(np.sin(7 * point[..., ::-1]))
    return (np.concatenate([shade * hit[..., None], hit[..., None]], -1) * 255).astype(np.uint8)


def write_capture(folder, n=6, mode="RGBA"):
    """NeRF-synthetic layout: transforms.json and n PNGs."""
    (folder / "images").mkdir(parents=True)
    frames = []
    for i in range(n):
        Image.fromarray(picture(i, n)).convert(mode).save(folder / f"images/p{i}.png")
        pose = world_from_gl_camera(look_at(eye(i, n), np.zeros(3)))
        frames.append({"file_path": f"images/p{i}.png", "transform_matrix": pose.tolist()})
    write_transforms(folder, {"camera_angle_x": FOV, "frames": frames})
    return folder


def write_transforms(folder, content):
    (folder / "transforms.json").write_text(json.dumps(content))


def edit(folder, change):
    content = json.loads((folder / "transforms.json").read_text())
    change(content)
    write_transforms(folder, content)


def photos_only(folder):
    (folder / "transforms.json").unlink()


def black_masks(f):
    for i in range(6):
        rgba = picture(i)
        rgba[..., 3] = 0
        Image.fromarray(rgba).save(f / f"images/p{i}.png")

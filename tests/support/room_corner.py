"""A textured corner of a room, drawn."""

import cv2
import numpy as np

from relit.geometry.se3 import look_at
from relit.scene import Camera

WIDTH, HEIGHT, FOCAL = 256, 192, 240.0


CORNER = np.array([-1.0, 1.0, 1.0])


def texture(seed):
    rng = np.random.default_rng(seed)
    layers = [
        cv2.resize(
            rng.uniform(size=(n, n, 3)).astype(np.float32),
            (512, 512),
            interpolation=cv2.INTER_CUBIC,
        )
        for n in (16, 48, 128)
    ]
    return np.clip(sum(layers) / 3 * 1.6 - 0.3, 0, 1)


TEXTURES = [texture(i) for i in range(3)]


def photo(camera):
    """The planes x = -1, y = 1 (below) and z = 1, each 4 x 4, with a texture on it: linear (H, W,
    3), and a mask of its corner (H, W)."""
    gx, gy = np.meshgrid(
        (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx,
        (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy,
    )
    d = np.stack([gx, gy, np.ones_like(gx)], -1) @ camera.world_from_camera[:3, :3].T
    rgb, depth = np.full((*gx.shape, 3), 0.2, np.float32), np.full(gx.shape, np.inf)
    for axis, level in ((0, -1.0), (1, 1.0), (2, 1.0)):
        t = (level - camera.centre[axis]) / np.where(
            np.abs(d[..., axis]) < 1e-9, 1e-9, d[..., axis]
        )
        p = camera.centre + t[..., None] * d
        u, v = (np.delete(p, axis, axis=-1)[..., i] for i in (0, 1))
        hit = (t > 0) & (t < depth) & (np.abs(u) < 2) & (np.abs(v) < 2)
        xy = [((c + 2) * 127.9).astype(np.float32) for c in (u, v)]
        rgb[hit] = cv2.remap(
            TEXTURES[axis], *xy, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )[hit]
        depth[hit] = t[hit]
    points = camera.centre + np.where(np.isfinite(depth), depth, 1e6)[..., None] * d
    return rgb, (np.linalg.norm(points - CORNER, axis=-1) < 1.5).astype(np.float32)


def arc(count=6):
    out = []
    for i in range(count):
        a = -0.5 + 1.0 * i / (count - 1)
        eye = np.array([2.2 * np.cos(a) + 0.2, -0.6 - 0.25 * np.sin(3 * a), -2.2 - 1.2 * np.sin(a)])
        pose = look_at(eye, [-0.5, 0.5, 0.5], [0, -1, 0])
        out.append(Camera(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, pose))
    return out

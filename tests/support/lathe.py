"""Things turned on a lathe: a cup, and a plug with the same outside."""

import numpy as np

from relit.scene import Material, Mesh

TOP, BOTTOM, RIM, BASE, WALL, FLOOR = 0.35, -0.35, 0.55, 0.36, 0.05, -0.2  # the axis is y


def side(y):
    """Radius of the outside at height y."""
    return BASE + (RIM - BASE) * (np.asarray(y) - BOTTOM) / (TOP - BOTTOM)


OUTSIDE = [(0.0, BOTTOM), (BASE, BOTTOM), (RIM, TOP)]
PLUG = [*OUTSIDE, (0.0, TOP)]
CUP = [*OUTSIDE, (RIM - WALL, TOP), (float(side(FLOOR)) - WALL, FLOOR), (0.0, FLOOR)]


def turned(profile, columns: int = 48, finer: int = 12) -> Mesh:
    """The closed surface of a section, (radius, height) from the bottom of the outside to the end
    of it on the axis."""
    ends = np.asarray(profile, float)
    t = np.linspace(0, len(ends) - 1, finer * (len(ends) - 1) + 1)
    r, y = (np.interp(t, np.arange(len(ends)), ends[:, k]) for k in (0, 1))
    a = np.linspace(0, 2 * np.pi, columns + 1)
    vertices = np.stack(
        [
            r[:, None] * np.sin(a),
            np.broadcast_to(y[:, None], (len(r), columns + 1)),
            r[:, None] * np.cos(a),
        ],
        -1,
    )
    slope = np.stack([np.gradient(r), np.gradient(y)], -1)
    out = np.stack([slope[:, 1], -slope[:, 0]], -1) / np.maximum(
        np.linalg.norm(slope, axis=1, keepdims=True), 1e-9
    )
    normals = np.stack(
        [
            out[:, :1] * np.sin(a),
            np.broadcast_to(out[:, 1:], (len(r), columns + 1)),
            out[:, :1] * np.cos(a),
        ],
        -1,
    )
    uv = np.stack(np.broadcast_arrays(a / (2 * np.pi), (t / t[-1])[:, None]), -1)
    k = (np.arange(len(r) - 1)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    b, c, d = k + 1, k + columns + 1, k + columns + 2
    faces = np.concatenate([np.stack([k, b, d], 1), np.stack([k, d, c], 1)])
    flat = [x.reshape(-1, x.shape[-1]).astype(np.float32) for x in (vertices, normals, uv)]
    corners = flat[0][faces]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    return Mesh(flat[0], faces[area > 1e-9].astype(np.int32), flat[1], flat[2])


def spotted(size: int = 64, seed: int = 0) -> Material:
    """Matt paint with soft spots."""
    import cv2

    coarse = (
        np.random.default_rng(seed).uniform(0.25, 0.8, (size // 8, size // 8, 3)).astype(np.float32)
    )
    base = cv2.resize(coarse, (size, size), interpolation=cv2.INTER_CUBIC).clip(0.05, 0.9)
    return Material(
        base, np.full((size, size), 0.6, np.float32), np.zeros((size, size), np.float32)
    )

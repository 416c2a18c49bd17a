"""A coarse model that every photo tells apart, and photos of it from anywhere."""

import numpy as np

from relit.geometry.sdf import node_positions
from relit.geometry.se3 import exp_so3, look_at, rotation_angle
from relit.scene import Camera


def volume_lump():
    """A lump with three arms of different lengths and a colour that changes all over it."""
    import mitsuba as mi

    from relit.fit.passes.volume import start_model

    n = 40
    p = node_positions(n)
    x, y, z = np.moveaxis(p, -1, 0)
    body = np.sqrt(x**2 + (1.3 * y) ** 2 + (1.6 * z) ** 2) - 0.4

    def arm(tip, radius):
        tip = np.array(tip)
        t = np.clip((p @ tip) / (tip @ tip), 0, 1)
        return np.linalg.norm(p - t[..., None] * tip, axis=-1) - radius

    values = np.minimum.reduce(
        [body, arm([0.7, 0.2, 0], 0.1), arm([-0.1, 0.6, 0.2], 0.13), arm([0, -0.2, 0.65], 0.08)]
    )
    model = start_model(values.astype(np.float32), np.array([0.3, 0.3, 0.3]), None, full=True)
    colours = np.stack(
        [
            0.3 + 0.25 * np.sin(4 * x + 1),
            0.3 + 0.25 * np.sin(5 * y),
            0.3 + 0.25 * np.sin(4 * z - x),
            0 * x,
        ],
        -1,
    )
    model.grid.features = mi.Float(
        np.concatenate([np.zeros((1, 4)), colours.reshape(-1, 4)]).astype(np.float32).ravel()
    )
    model.inv_s = 3.0 / model.grid.h
    return model


def photos_of(model, count, rng, turn=np.pi):
    """Photos from anywhere, off the middle, turned by up to `turn` radians, any exposure and white:
    (rgb, mask, camera), with the true pose in the camera."""
    from relit.fit.registration.register import volume_render

    out = []
    for _ in range(count):
        d = rng.normal(size=3)
        pose = look_at(d / np.linalg.norm(d) * 3.5, roll=rng.uniform(-turn, turn))
        pose[:3, :3] = pose[:3, :3] @ exp_so3(rng.uniform(-0.15, 0.15, 3))
        camera = Camera(120, 120, 150.0, 150.0, 60.0, 60.0, pose)
        rgb, alpha = (a[0] for a in volume_render(model)([camera]))
        out.append((rgb * rng.uniform(0.5, 2, 3).astype(np.float32), alpha, camera))
    return out


def errors(poses, photos):
    return np.array(
        [
            rotation_angle(p[:3, :3].T @ c.world_from_camera[:3, :3])
            for p, (_, _, c) in zip(poses, photos, strict=True)
        ]
    )

"""The phone's flash: one white point light that moves with the camera (PIR Eq. 4), and its file.

    w_i(x) = (o + Δo - x) / |o + Δo - x|,    L_i(x) = L / |o + Δo - x|²

o: camera centre, Δo: offset, fixed in the OpenCV axes of every camera, L: radiant intensity.
"""

from __future__ import annotations

import json
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from relit.errors import UserError
from relit.scene import Camera, Flash


def light_position(cameras, view, offset):
    """o + R Δo (Vector3f) for each ray's photo. cameras: Float [views * 16], rows of
    fit.pixels.camera_rows. view: UInt32. offset: Vector3f."""
    r = [dr.gather(mi.Vector4f, cameras, view * 4 + j) for j in (1, 2, 3)]
    return mi.Vector3f(*[k.x * offset.x + k.y * offset.y + k.z * offset.z + k.w for k in r])


def incident(position, x):
    """Unit direction from x to the light and 1 / distance² (Eq. 4 for L = 1); differentiable in
    both."""
    to = mi.Vector3f(position) - mi.Vector3f(x)
    inverse = dr.rcp(dr.maximum(dr.squared_norm(to), 1e-6))
    return to * dr.sqrt(inverse), inverse


def flash_position(flash: Flash, camera: Camera) -> np.ndarray:
    """(3,) where the light stands in the world when `camera` takes its photo."""
    return camera.centre + np.asarray(camera.world_from_camera)[:3, :3] @ np.asarray(
        flash.offset, np.float64
    )


def seen_angle(a: Flash, b: Flash, cameras, centre) -> float:
    """Mean angle in degrees, over cameras, between the directions from `centre` (world) to the two
    lights."""
    angles = []
    for camera in cameras:
        u, v = (flash_position(f, camera) - centre for f in (a, b))
        angles.append(np.arctan2(np.linalg.norm(np.cross(u, v)), u @ v))
    return float(np.degrees(np.mean(angles)))


def flash_json(flash: Flash) -> str:
    """The text of lights/flash.json."""
    return (
        json.dumps(
            {
                "offset": [float(v) for v in flash.offset],
                "intensity": [float(v) for v in flash.intensity],
            },
            indent=1,
        )
        + "\n"
    )


def read_flash(path: str | Path) -> Flash:
    """A flash from its file: {"offset": [x, y, z], "intensity": [r, g, b]}. Raises UserError."""
    path = Path(path)
    try:
        data = json.loads(path.read_text())
        offset, intensity = (np.array(data[k], np.float64) for k in ("offset", "intensity"))
        if (
            offset.shape != (3,)
            or intensity.shape != (3,)
            or not np.isfinite([offset, intensity]).all()
            or (intensity < 0).any()
        ):
            raise ValueError(
                "offset and intensity must be three finite numbers each, intensity not negative"
            )
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError) as e:
        why = f"{type(e).__name__}: {e}"
        raise UserError(
            "the flash cannot be read",
            why,
            f'it should hold {{"offset": [x, y, z], "intensity": [r, g, b]}}: {path}',
        ) from None
    return Flash(offset, intensity)

"""Lenses: from a distorted photo to the pinhole photo that the rest of Relit sees.

A lens is a function from ideal to distorted normalised image coordinates, (N, 2) -> (N, 2) float64,
where (x, y) = (X/Z, Y/Z). The pixel is then (fx x + cx, fy y + cy).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from relit.scene import Camera

# ideal coordinates beyond 60 degrees off the axis are cut: a pinhole image of them is mostly
# stretch
MAX_TANGENT = 1.7


@dataclass(frozen=True)
class BrownLens:
    """OpenCV's radial-tangential model; coefficients (k1, k2, p1, p2[, k3[, k4, k5, k6]]) as in
    `Camera.distortion`."""

    coefficients: tuple[float, ...]

    def __call__(self, xy: np.ndarray) -> np.ndarray:
        k1, k2, p1, p2, k3, k4, k5, k6 = (*self.coefficients, *[0.0] * (8 - len(self.coefficients)))
        x, y = xy[:, 0], xy[:, 1]
        r2 = x * x + y * y
        radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        return np.stack(
            [
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
            ],
            axis=-1,
        )


@dataclass(frozen=True)
class FisheyeLens:
    """Equidistant fisheye (OpenCV's and COLMAP's OPENCV_FISHEYE): theta_d = theta (1 + k1 theta^2 +
    k2 theta^4 + ...)."""

    coefficients: tuple[float, ...]

    def __call__(self, xy: np.ndarray) -> np.ndarray:
        r = np.maximum(np.linalg.norm(xy, axis=-1, keepdims=True), 1e-12)
        theta = np.arctan(r)
        powers = sum(k * theta ** (2 * i + 2) for i, k in enumerate(self.coefficients))
        return xy * (theta * (1 + powers) / r)


Lens = Callable[[np.ndarray], np.ndarray]


def lens_of(camera: Camera) -> Lens | None:
    """The lens that `camera.distortion` describes, or None for a pinhole."""
    return BrownLens(tuple(camera.distortion)) if any(camera.distortion) else None


def pixels_from_ideal(camera: Camera, lens: Lens | None, xy: np.ndarray) -> np.ndarray:
    """Ideal normalised coordinates (N, 2) -> pixels (N, 2) of the photo as taken."""
    d = lens(xy) if lens else xy
    return np.stack([camera.fx * d[:, 0] + camera.cx, camera.fy * d[:, 1] + camera.cy], axis=-1)


def ideal_from_pixels(
    camera: Camera, lens: Lens | None, pixels: np.ndarray, iterations: int = 60
) -> np.ndarray:
    """Inverse of `pixels_from_ideal` by damped fixed-point steps; NaN where the lens cannot be
    inverted to 1/100 pixel."""
    target = (np.asarray(pixels, dtype=np.float64) - (camera.cx, camera.cy)) / (
        camera.fx,
        camera.fy,
    )
    if lens is None:
        return target
    xy, step = target.copy(), np.full((len(target), 1), 1.0)
    error = lens(xy) - target
    for _ in range(iterations):
        trial = xy - step * error
        trial_error = lens(trial) - target
        better = np.linalg.norm(trial_error, axis=1) < np.linalg.norm(error, axis=1)
        xy[better], error[better] = trial[better], trial_error[better]
        step[~better] *= 0.5
    bad = np.linalg.norm(error, axis=1) * max(camera.fx, camera.fy) > 0.01
    xy[bad] = np.nan
    return xy


def undistorted_camera(camera: Camera, lens: Lens | None) -> Camera:
    """The pinhole camera of the undistorted photo: same focal lengths, cropped to the largest
    rectangle without blank pixels.

    The rectangle is cut at 60 degrees off the axis and at 1.25 times the size of the photo as
    taken.
    """
    if lens is None:
        return replace(camera, distortion=())
    w, h, n = camera.width, camera.height, 64
    s, zero = np.linspace(0, 1, n), np.zeros(n)
    borders = {
        "left": (zero, s * h),
        "right": (zero + w, s * h),
        "top": (s * w, zero),
        "bottom": (s * w, zero + h),
    }
    ideal = {k: ideal_from_pixels(camera, lens, np.stack(v, axis=-1)) for k, v in borders.items()}
    limit = MAX_TANGENT

    def side(values: np.ndarray, sign: float, other: float) -> float:
        values = np.where(np.isfinite(values), values * sign, limit)
        return sign * float(min(values.min(), limit, 1.25 * abs(other)))

    left = side(ideal["left"][:, 0], -1, camera.cx / camera.fx)
    right = side(ideal["right"][:, 0], 1, (w - camera.cx) / camera.fx)
    top = side(ideal["top"][:, 1], -1, camera.cy / camera.fy)
    bottom = side(ideal["bottom"][:, 1], 1, (h - camera.cy) / camera.fy)
    width, height = int((right - left) * camera.fx), int((bottom - top) * camera.fy)
    # the fraction of a pixel that int() cut off is shared by both sides
    cx = -left * camera.fx - ((right - left) * camera.fx - width) / 2
    cy = -top * camera.fy - ((bottom - top) * camera.fy - height) / 2
    return replace(camera, width=max(width, 1), height=max(height, 1), cx=cx, cy=cy, distortion=())


def undistortion_map(camera: Camera, lens: Lens, ideal: Camera) -> tuple[np.ndarray, np.ndarray]:
    """For each pixel of the `ideal` pinhole image, where to look in the photo as taken: two (H, W)
    float32 maps for cv2.remap."""
    x = (np.arange(ideal.width) + 0.5 - ideal.cx) / ideal.fx
    y = (np.arange(ideal.height) + 0.5 - ideal.cy) / ideal.fy
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    pixels = (
        pixels_from_ideal(camera, lens, grid).reshape(ideal.height, ideal.width, 2) - 0.5
    )  # cv2 puts centres at integers
    return pixels[..., 0].astype(np.float32), pixels[..., 1].astype(np.float32)

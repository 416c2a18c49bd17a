"""Light as a sum of spherical Gaussians.

SfD Eq. (2), after Wang et al. 2009: L_i(w) = sum_k mu_k exp(lambda_k (w . phi_k - 1)), mu_k >= 0 per channel.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from relit.conventions import environment_directions, environment_solid_angles
from relit.errors import UserError

MAX_LOBES = 4096
ROWS = 64  # of the coarsest map that a lobe must be seen on: 2.8 degrees a texel
SOFTEST = 0.2
SHARPEST = 1 / (0.7 * np.pi / ROWS) ** 2  # a lobe is no narrower than .7 texel (one sigma), or its samples would miss its energy


@dataclass(frozen=True)
class SphericalGaussians:
    """axis (phi): (K, 3) unit directions to the light, in the frame of the environment map it stands for. sharpness (lambda): (K,) > 0.
    amplitude (mu): (K, 3) linear RGB radiance >= 0."""

    axis: np.ndarray
    sharpness: np.ndarray
    amplitude: np.ndarray


def evaluate(sg: SphericalGaussians, direction) -> np.ndarray:
    """Radiance (..., 3) from unit directions (..., 3): SfD Eq. (2)."""
    d = np.asarray(direction, np.float64)
    flat = d.reshape(-1, 3)
    out = np.empty((len(flat), 3))
    for i in range(0, len(flat), 1 << 15):  # bounds the memory
        w = flat[i : i + (1 << 15)]
        out[i : i + len(w)] = np.exp(sg.sharpness * (w @ sg.axis.T - 1)) @ sg.amplitude
    return out.reshape(d.shape)


def environment_of(sg: SphericalGaussians, height: int = 128, width: int = 256) -> np.ndarray:
    """Lat-long map (H, W, 3) float32 of texel means; sharp lobes are sampled several times within a texel."""
    sigma = 1 / np.sqrt(max(float(np.max(sg.sharpness, initial=1.0)), 1e-6))
    n = int(np.clip(np.ceil(np.pi / height / (0.7 * sigma)), 1, 8))
    weight = environment_solid_angles(height * n, width * n)[..., None]
    fine = evaluate(sg, environment_directions(height * n, width * n)) * weight
    mean = lambda a: a.reshape(height, n, width, n, -1).sum((1, 3))  # noqa: E731
    return (mean(fine) / mean(weight)).astype(np.float32)


def fibonacci(count: int) -> np.ndarray:
    """(count, 3) directions spread evenly over the sphere."""
    k = np.arange(count)
    y = 1 - (2 * k + 1) / count
    phi = k * np.pi * (3 - np.sqrt(5))
    s = np.sqrt(1 - y * y)
    return np.stack([s * np.cos(phi), y, s * np.sin(phi)], -1)


# ---------------------------------------------------------------- files


def read_json(path: str | Path) -> SphericalGaussians:
    """The lobes of {"lobes": [{"axis": [x, y, z], "sharpness": lambda, "amplitude": [r, g, b]}, ...]}. Raises UserError for other files."""
    path = Path(path)
    try:
        if path.stat().st_size > 16 << 20:
            raise ValueError("larger than 16 MB")
        lobes = json.loads(path.read_text())["lobes"]
        if not 1 <= len(lobes) <= MAX_LOBES:
            raise ValueError(f"{len(lobes)} lobes")
        axis, amplitude = (np.array([x[k] for x in lobes], np.float64).reshape(-1, 3) for k in ("axis", "amplitude"))
        sharpness = np.array([x["sharpness"] for x in lobes], np.float64).reshape(-1)
        length = np.linalg.norm(axis, axis=1, keepdims=True)
        finite = np.isfinite(axis).all() and np.isfinite(amplitude).all() and np.isfinite(sharpness).all()
        if not finite or (length < 1e-6).any() or (sharpness <= 0).any() or (amplitude < 0).any():
            raise ValueError("axis, sharpness or amplitude of a lobe makes no sense")
    except (OSError, KeyError, TypeError, ValueError, RecursionError) as e:
        fix = f'it must hold {{"lobes": [{{"axis": [x, y, z], "sharpness": s, "amplitude": [r, g, b]}}]}}: {path}'
        raise UserError("the file holds no spherical Gaussians", f"{type(e).__name__}: {e}", fix) from None
    return SphericalGaussians(axis / length, sharpness, amplitude)

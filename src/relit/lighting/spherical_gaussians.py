"""Light as a sum of spherical Gaussians, and its fit to an environment map.

SfD Eq. (2), after Wang et al. 2009: L_i(w) = sum_k mu_k exp(lambda_k (w . phi_k - 1)), mu_k >= 0
per channel.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from relit.conventions import environment_directions, environment_solid_angles
from relit.errors import UserError
from relit.images import write_bytes

MAX_LOBES = 4096
ROWS = 64  # of the map that the fit sees: 2.8 degrees a texel
SOFTEST = 0.2
SHARPEST = (
    1 / (0.7 * np.pi / ROWS) ** 2
)  # a lobe is no narrower than .7 texel (one sigma), or its samples would miss its energy


@dataclass(frozen=True)
class SphericalGaussians:
    """axis (phi): (K, 3) unit directions to the light, in the frame of the environment map it
    stands for. sharpness (lambda): (K,) > 0. amplitude (mu): (K, 3) linear RGB radiance >= 0."""

    axis: np.ndarray
    sharpness: np.ndarray
    amplitude: np.ndarray


def gaussian_radiance(sg: SphericalGaussians, direction) -> np.ndarray:
    """Radiance (..., 3) from unit directions (..., 3): SfD Eq. (2)."""
    d = np.asarray(direction, np.float64)
    flat = d.reshape(-1, 3)
    out = np.empty((len(flat), 3))
    for i in range(0, len(flat), 1 << 15):  # bounds the memory
        w = flat[i : i + (1 << 15)]
        out[i : i + len(w)] = np.exp(sg.sharpness * (w @ sg.axis.T - 1)) @ sg.amplitude
    return out.reshape(d.shape)


def energy(sg: SphericalGaussians) -> np.ndarray:
    """Integral over the sphere, (3,): sum of mu 2 pi / lambda (1 - exp(-2 lambda))."""
    return ((2 * np.pi / sg.sharpness * -np.expm1(-2 * sg.sharpness))[:, None] * sg.amplitude).sum(
        0
    )


def rotate(sg: SphericalGaussians, b_from_a) -> SphericalGaussians:
    """The same light in frame b (rotation 3x3, or the rotation of a 4x4 similarity)."""
    r = np.asarray(b_from_a, np.float64)[:3, :3]
    return SphericalGaussians(
        sg.axis @ (r / np.cbrt(np.linalg.det(r))).T, sg.sharpness, sg.amplitude
    )


def environment_of(sg: SphericalGaussians, height: int = 128, width: int = 256) -> np.ndarray:
    """Lat-long map (H, W, 3) float32 of texel means; sharp lobes are sampled several times within a
    texel."""
    sigma = 1 / np.sqrt(max(float(np.max(sg.sharpness, initial=1.0)), 1e-6))
    n = int(np.clip(np.ceil(np.pi / height / (0.7 * sigma)), 1, 8))
    weight = environment_solid_angles(height * n, width * n)[..., None]
    fine = gaussian_radiance(sg, environment_directions(height * n, width * n)) * weight
    mean = lambda a: a.reshape(height, n, width, n, -1).sum((1, 3))  # noqa: E731
    return (mean(fine) / mean(weight)).astype(np.float32)


def fibonacci(count: int) -> np.ndarray:
    """(count, 3) directions spread evenly over the sphere."""
    k = np.arange(count)
    y = 1 - (2 * k + 1) / count
    phi = k * np.pi * (3 - np.sqrt(5))
    s = np.sqrt(1 - y * y)
    return np.stack([s * np.cos(phi), y, s * np.sin(phi)], -1)


# ---------------------------------------------------------------- fit


def fit_spherical_gaussians(
    environment, count: int = 128, *, steps: int = 80, seed: int = 0
) -> SphericalGaussians:
    """`count` lobes that come close to a lat-long map (H, W, 3), with its energy per channel. A few
    seconds for 128.

    Departs from the released SfD fit (100k Adam steps on plain MSE from Fibonacci lobes). A sum of
    spherical Gaussians is a mixture of von Mises-Fisher densities with a weight per colour channel,
    and expectation maximisation fits it (Banerjee et al. 2005): no step size, no sun that silences
    the sky, and every step keeps the energy of each channel exactly.
    """
    image = np.asarray(environment, np.float64)
    if image.ndim != 3 or image.shape[2] != 3 or not np.isfinite(image).all():
        raise UserError(
            "spherical Gaussians need a lat-long RGB map of finite radiance",
            f"this one has shape {image.shape}",
            "check the light",
        )
    if not 1 <= count <= MAX_LOBES:
        raise UserError(f"{count} lobes cannot be fitted", fix=f"choose 1 to {MAX_LOBES}")
    image, omega = _shrunk(np.maximum(image, 0))
    power = (image * omega[..., None]).reshape(-1, 3)  # [N, 3], energy of each texel
    total = power.sum(0)
    if total.max() <= 0:
        return SphericalGaussians(fibonacci(count), np.full(count, 10.0), np.zeros((count, 3)))
    d = environment_directions(*image.shape[:2]).reshape(-1, 3)
    share = power.sum(1) / total.sum()
    phi, lam = _start(d, share, count, np.random.default_rng(seed))
    pi = np.tile(total / count, (count, 1))  # [K, 3], energy of each lobe
    directions, energies, area = (
        d.astype(np.float32),
        power.astype(np.float32),
        omega.reshape(-1, 1).astype(np.float32),
    )
    for _ in range(steps):
        peak = lam / (
            2 * np.pi * -np.expm1(-2 * lam)
        )  # density of a lobe of unit energy on its axis
        f = np.exp(lam.astype(np.float32) * (directions @ phi.T.astype(np.float32) - 1)) * (
            peak.astype(np.float32)
        )  # [N, K]
        f /= np.maximum(
            (f * area).sum(0), 1e-12
        )  # a lobe near the texels' size: unit energy of what the texels see
        q = energies / np.maximum(f @ pi.astype(np.float32), 1e-20)  # [N, 3]
        claimed = f * (
            q @ pi.T.astype(np.float32)
        )  # [N, K], energy of texel n that lobe k answers for
        sums, first = claimed.sum(0).astype(np.float64), (claimed.T @ directions).astype(np.float64)
        pi = pi * (f.T @ q)
        pi *= np.where(pi.sum(0) > 0, total / np.maximum(pi.sum(0), 1e-30), 1)
        length = np.linalg.norm(first, axis=1)
        alive = length > 1e-12 * max(sums.sum(), 1e-30)
        phi = np.where(alive[:, None], first / np.maximum(length, 1e-30)[:, None], phi)
        r = np.where(alive, np.clip(length / np.maximum(sums, 1e-30), 0, 1 - 1e-6), 0.9)
        lam = np.clip(
            r * (3 - r * r) / (1 - r * r), SOFTEST, SHARPEST
        )  # Banerjee et al. 2005, Eq. (4.4)
    return SphericalGaussians(phi, lam, pi * (lam / (2 * np.pi * -np.expm1(-2 * lam)))[:, None])


def _shrunk(image):
    """The map at most ROWS high (means over solid angle, so that energy is kept), and the solid
    angles of its texels."""
    h, w = image.shape[:2]
    if h <= ROWS:
        return image, environment_solid_angles(h, w)
    columns = max(round(ROWS * w / h), 1)
    weighted = _bin(_bin(image * environment_solid_angles(h, w)[..., None], ROWS, 0), columns, 1)
    omega = environment_solid_angles(ROWS, columns)
    return weighted / omega[..., None], omega


def _bin(a, count: int, axis: int):
    """Sum cells along an axis into `count` equal bins; a cell on an edge is shared out in
    proportion."""
    n = a.shape[axis]
    running = np.concatenate([np.zeros_like(np.take(a, [0], axis)), np.cumsum(a, axis)], axis)
    at = np.arange(count + 1) * n / count
    low = np.minimum(at.astype(int), n - 1)
    shape = [1] * a.ndim
    shape[axis] = -1
    f = (at - low).reshape(shape)
    return np.diff(
        np.take(running, low, axis) * (1 - f) + np.take(running, low + 1, axis) * f, axis=axis
    )


def _start(d, share, count: int, rng):
    """Half of the lobes spread evenly, half drawn where the energy is; neighbours overlap."""
    even = fibonacci((count + 1) // 2)
    drawn = d[rng.choice(len(d), count // 2, p=share)] + 0.02 * rng.normal(
        size=(count // 2, 3)
    )  # two on one texel must be able to part
    axis = np.concatenate([even, drawn / np.linalg.norm(drawn, axis=1, keepdims=True)])
    sharpness = np.concatenate(
        [np.full(len(even), len(even) / 4.5), np.full(len(drawn), len(even) / 1.5)]
    )
    return axis, sharpness.clip(SOFTEST, SHARPEST)


# ---------------------------------------------------------------- files


def write_lobes(path: str | Path, sg: SphericalGaussians) -> None:
    """{"lobes": [{"axis": [x, y, z], "sharpness": lambda, "amplitude": [r, g, b]}, ...]}"""
    lobes = [
        {"axis": a.tolist(), "sharpness": float(s), "amplitude": m.tolist()}
        for a, s, m in zip(
            np.asarray(sg.axis, float), sg.sharpness, np.asarray(sg.amplitude, float), strict=True
        )
    ]
    write_bytes(path, (json.dumps({"lobes": lobes}, indent=1) + "\n").encode())


def read_lobes(path: str | Path) -> SphericalGaussians:
    """Inverse of `write_lobes`. Raises UserError for a file that is not one."""
    path = Path(path)
    try:
        if path.stat().st_size > 16 << 20:
            raise ValueError("larger than 16 MB")
        lobes = json.loads(path.read_text())["lobes"]
        if not 1 <= len(lobes) <= MAX_LOBES:
            raise ValueError(f"{len(lobes)} lobes")
        axis, amplitude = (
            np.array([x[k] for x in lobes], np.float64).reshape(-1, 3)
            for k in ("axis", "amplitude")
        )
        sharpness = np.array([x["sharpness"] for x in lobes], np.float64).reshape(-1)
        length = np.linalg.norm(axis, axis=1, keepdims=True)
        finite = (
            np.isfinite(axis).all()
            and np.isfinite(amplitude).all()
            and np.isfinite(sharpness).all()
        )
        if not finite or (length < 1e-6).any() or (sharpness <= 0).any() or (amplitude < 0).any():
            raise ValueError("axis, sharpness or amplitude of a lobe makes no sense")
    except (OSError, KeyError, TypeError, ValueError, OverflowError, RecursionError) as e:
        fix = f'it must hold {{"lobes": [{{"axis": [x, y, z], "sharpness": s, "amplitude": [r, g, b]}}]}}: {path}'
        raise UserError(
            "the file holds no spherical Gaussians", f"{type(e).__name__}: {e}", fix
        ) from None
    return SphericalGaussians(axis / length, sharpness, amplitude)

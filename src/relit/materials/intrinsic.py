"""A first guess of the base colour: what is left of the radiance once shading that depends smoothly
on the normal is taken out."""

from __future__ import annotations

import numpy as np


def harmonics(n: np.ndarray) -> np.ndarray:
    """The nine real spherical harmonics up to order 2, not normalised, at unit vectors (N, 3) ->
    (N, 9)."""
    x, y, z = n.T
    return np.stack(
        [np.ones_like(x), x, y, z, x * y, y * z, x * z, x * x - y * y, 3 * z * z - 1], -1
    )


def base_without_shading(
    radiance: np.ndarray, normals: np.ndarray, weights: np.ndarray, *, iterations: int = 25
) -> np.ndarray:
    """Relative base colour (N, 3) > 0, mean luminance 1, of surface points with `radiance` (N, 3),
    unit `normals` and areas `weights`.

    Diffuse shading is a function of the normal that nine harmonics describe (Ramamoorthi & Hanrahan
    2001); base colour is piecewise constant. So log radiance = harmonics(n) c + log base with few
    large residuals: least absolute deviations, by reweighting, one shading for all channels but its
    constant (coloured light is left to the fit).
    """
    logs = np.log(np.maximum(radiance, 1e-3))
    y = harmonics(normals)
    grey = logs.mean(1)
    w = weights / weights.sum()
    c = np.zeros(9)
    ridge = np.diag([0.0] + [1e-3] * 8)
    for _ in range(iterations):
        r = np.abs(grey - y @ c)
        k = w / np.maximum(r, 0.02)
        c = np.linalg.solve((y * k[:, None]).T @ y + ridge * k.sum(), (y * k[:, None]).T @ grey)
    base = np.exp(logs - (y @ c)[:, None])
    return base / (w[:, None] * base).sum(0).mean()

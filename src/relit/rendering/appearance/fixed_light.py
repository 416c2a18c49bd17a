"""Deferred appearance of the volume pass: what a ray looks like, from the features that the march
accumulated.

Radiance = diffuse + tint * E(r): a view-independent part and a reflection of a small learnt
environment in the direction mirrored at the accumulated normal. It explains highlights well enough
that they do not dent the surface; the material proper is found later, on the mesh. Not physically
based; the surface pass is.

Feature channels: 0-2 diffuse radiance (linear), 3 tint. Four, not more: the adjoint's scatter of
the features is its dearest part.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from relit.lighting.environment import lookup_latlong
from relit.rendering.march import Marched

CHANNELS = 4
ROWS, COLUMNS = 16, 32  # of the reflection map


def start_reflections(level: float):
    """Lat-long map of log radiance, Float [ROWS * COLUMNS * 3], in the axes of
    `conventions.uv_from_direction`."""
    return mi.Float(np.full(ROWS * COLUMNS * 3, np.log(max(level, 1e-4)), np.float32))


def start_features(level: np.ndarray) -> np.ndarray:
    """(4,) start of every row: diffuse at `level` (3,) and little tint."""
    return np.array([*level, 0.05], np.float32)


def shade(m: Marched, d, reflections):
    """Radiance premultiplied with opacity (Color3f) and the unit normal (Vector3f) of each ray."""
    F = m.features
    n = m.unit_normal
    r = d - 2 * dr.dot(d, n) * n
    r = mi.Vector3f(
        r.x, dr.clip(r.y, -0.9999, 0.9999), r.z
    )  # the polar angle's slope has no bound at the poles
    e = dr.exp(lookup_latlong(reflections, ROWS, COLUMNS, r))
    return dr.maximum(mi.Color3f(F[0], F[1], F[2]) + dr.maximum(F[3], 0) * e, 0), n


def features_at(grid, features: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(N, CHANNELS) trilinear features at points (N, 3) near the surface. features: (rows,
    CHANNELS)."""
    n = grid.n
    at = (points.astype(np.float64) + 1) * (0.5 * (n - 1))
    low = np.clip(np.floor(at).astype(np.int64), 0, n - 2)
    f = at - low
    index, values, weight = (
        np.array(grid.index),
        np.zeros((len(points), CHANNELS)),
        np.zeros(len(points)),
    )
    for corner in np.ndindex(2, 2, 2):
        c = np.array(corner)
        w = np.where(c, f, 1 - f).prod(1)
        k = low + c
        row = index[(k[:, 2] * n + k[:, 1]) * n + k[:, 0]]
        w = np.where(row > 0, w, 0)  # nodes outside the band know nothing
        values += w[:, None] * features[row]
        weight += w
    return values / np.maximum(weight, 1e-6)[:, None]


def mean_radiance(grid, features: np.ndarray, reflections, points: np.ndarray) -> np.ndarray:
    """(N, 3) radiance at surface points (N, 3), averaged over directions: what the features say,
    with the mean of the reflection map.

    features: (rows, CHANNELS).
    """
    values = features_at(grid, features, points)
    mirror = np.exp(np.array(reflections).reshape(ROWS, COLUMNS, 3)).mean((0, 1))
    return np.maximum(values[:, :3] + np.maximum(values[:, 3:4], 0) * mirror, 1e-3).astype(
        np.float32
    )

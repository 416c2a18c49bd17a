"""The axis of a surface of revolution: the line that all its normals meet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

WIDE = 0.1  # distance of a normal from the axis, in radii of the surface, at which it counts half
ROUNDS = 6


@dataclass(frozen=True)
class Axis:
    """A line: point (3,), direction (3,), unit."""

    point: np.ndarray
    direction: np.ndarray

    def heights(self, x: np.ndarray) -> np.ndarray:
        """(...,) along the axis, of points (..., 3)."""
        return (x - self.point) @ self.direction

    def radii(self, x: np.ndarray) -> np.ndarray:
        """(...,) distances from the axis."""
        away = x - self.point
        return np.linalg.norm(away - (away @ self.direction)[..., None] * self.direction, axis=-1)


def revolution_axis(points: np.ndarray, normals: np.ndarray) -> tuple[Axis, float]:
    """(axis, median distance of the normals from it in radii of the surface, 0 for a body of
    revolution) of points (N, 3) that lie evenly on a surface, with unit normals (N, 3).

    A line through p along n meets the axis (a, ā) where a · (p × n) + ā · n = 0, Plücker's
    condition, which is linear: least squares under
    |a| = 1 is an eigenvector (Pottmann and Wallner 2001, Computational Line Geometry), with less
    weight for normals that miss it.
    """
    middle = points.mean(0)
    size = np.quantile(np.linalg.norm(points - middle, axis=1), 0.99)
    q = (points - middle) / size
    lines, weight = np.concatenate([np.cross(q, normals), normals], 1), np.ones(len(q))
    for _ in range(ROUNDS):
        m = (lines * weight[:, None]).T @ lines
        back = np.linalg.pinv(m[3:, 3:], rcond=1e-6) @ m[3:, :3]
        a = np.linalg.eigh(m[:3, :3] - m[:3, 3:] @ back)[1][:, 0]
        moment = -back @ a
        missed = np.abs(lines @ np.concatenate([a, moment]))
        weight = 1 / (1 + (missed / WIDE) ** 2)
    return Axis(middle + size * np.cross(a, moment), a), float(np.median(missed))

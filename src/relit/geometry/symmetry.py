"""The plane in which a surface is its own mirror image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from relit.conventions import move_points, similarity

NORMALS, LOOKED_AT = (
    500,
    8,
)  # planes that are tried, and of these from how many the nearest points are iterated
POINTS = 1500  # of the surface that are mirrored
TRIMMED = 0.9  # share of the points that count: the others have no partner
ROUNDS = 25


@dataclass(frozen=True)
class Plane:
    """Points x with normal . x = offset; normal: (3,), unit."""

    normal: np.ndarray
    offset: float

    @property
    def mirror(self) -> np.ndarray:
        """(4, 4) the reflection."""
        return similarity(
            np.eye(3) - 2 * np.outer(self.normal, self.normal), 2 * self.offset * self.normal
        )


def symmetry_plane(points: np.ndarray, seed: int = 0) -> tuple[Plane, float]:
    """(plane, mean distance of the mirrored points from the others, without the farthest tenth) of
    points (N, 3) that lie evenly on a
    surface: nearest points are iterated (ICP with a reflection) from the best of planes of all
    directions through their middle."""
    rng = np.random.default_rng(seed)
    tree, middle = cKDTree(points), points.mean(0)
    some = points[rng.permutation(len(points))[:POINTS]]
    planes = [Plane(n, float(n @ middle)) for n in half_sphere(NORMALS)]
    few = some[:: max(1, len(some) // 300)]
    order = np.argsort([distances(p, few, tree).mean() for p in planes])[:LOOKED_AT]
    settled = [refine_plane(planes[k], some, tree) for k in order]
    return min(settled, key=lambda one: one[1])


def refine_plane(plane: Plane, points: np.ndarray, tree: cKDTree) -> tuple[Plane, float]:
    for _ in range(ROUNDS):
        distance, partner = tree.query(move_points(plane.mirror, points))
        near = distance <= np.quantile(distance, TRIMMED)
        plane = plane_between(points[near], tree.data[partner[near]])
    distance = distances(plane, points, tree)
    return plane, float(distance[distance <= np.quantile(distance, TRIMMED)].mean())


def distances(plane: Plane, points: np.ndarray, tree: cKDTree) -> np.ndarray:
    return tree.query(move_points(plane.mirror, points))[0]


def plane_between(a: np.ndarray, b: np.ndarray) -> Plane:
    """The plane whose reflection takes points a (N, 3) to b with the least squared distance."""
    middle_a, middle_b = a.mean(0), b.mean(0)
    h = (a - middle_a).T @ (b - middle_b)
    normal = np.linalg.eigh(h + h.T)[1][:, 0]
    return Plane(normal, float(normal @ (middle_a + middle_b)) / 2)


def half_sphere(count: int) -> np.ndarray:
    """(count, 3) unit vectors with z > 0, evenly spread (Fibonacci spiral)."""
    i = np.arange(count) + 0.5
    z, a = 1 - i / count, i * np.pi * (3 - np.sqrt(5))
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(a), r * np.sin(a), z], 1)

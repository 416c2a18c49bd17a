"""Signed distance fields on a grid over [-1, 1]^3: primitives, their unions, and the shapes of
`synthesize.objects`.

Distances of superquadrics are along the ray from their centre, which is exact on the surface only;
marching cubes needs no more.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

REACH = 0.9  # half the side of the cube that shapes stay in


@dataclass(frozen=True)
class Field:
    """distance: (n, n, n) [z, y, x] float32, negative inside. part: (n, n, n) int, index of the
    nearest part."""

    distance: np.ndarray
    part: np.ndarray


def grid_points(n: int) -> np.ndarray:
    """(n, n, n, 3) points (x, y, z) of the grid [z, y, x] over [-1, 1]^3."""
    a = np.linspace(-1, 1, n, dtype=np.float32)
    z, y, x = np.meshgrid(a, a, a, indexing="ij")
    return np.stack([x, y, z], -1)


def length(p: np.ndarray) -> np.ndarray:
    """Norms of vectors (..., 3)."""
    return np.sqrt(np.einsum("...k,...k->...", p, p))


def superquadric(p: np.ndarray, half: np.ndarray, exponents: tuple[float, float]) -> np.ndarray:
    """Distance of points (..., 3) to a superquadric at the origin (Barr 1981). half: (3,) half
    axes. exponents: (1, 1) is an ellipsoid, towards 0 a box."""
    e1, e2 = exponents
    x, y, z = (np.maximum(np.abs(p[..., k]) / float(half[k]), 1e-6) for k in range(3))
    f = (x ** (2 / e2) + z ** (2 / e2)) ** (e2 / e1) + y ** (2 / e1)
    return length(p) * (1 - np.maximum(f, 1e-9) ** (-e1 / 2))


def capsule(p: np.ndarray, a: np.ndarray, b: np.ndarray, radius: float) -> np.ndarray:
    """Distance of points (..., 3) to the segment a b, less `radius`."""
    along, q = np.float32(b - a), p - np.float32(a)
    t = np.clip(q @ along / (along @ along), 0, 1)
    return length(q - t[..., None] * along) - np.float32(radius)


def torus(p: np.ndarray, radius: float, thick: float) -> np.ndarray:
    """Distance of points (..., 3) to a ring about the y axis."""
    ring = np.hypot(p[..., 0], p[..., 2]) - np.float32(radius)
    return np.hypot(ring, p[..., 1]) - np.float32(thick)


def smooth_union(a: np.ndarray, b: np.ndarray, width: float) -> np.ndarray:
    """Union with a fillet of about `width` (the polynomial minimum of Quilez)."""
    h = np.maximum(width - np.abs(a - b), 0) / width
    return np.minimum(a, b) - h * h * width / 4


def united(fields: list[np.ndarray], width: float) -> Field:
    """Smooth union of distances and the nearest of them."""
    total = fields[0]
    for each in fields[1:]:
        total = smooth_union(total, each, width)
    return Field(total.astype(np.float32), np.argmin(np.stack(fields), 0))


def random_superquadric(
    p: np.ndarray, rng: np.random.Generator, centre: np.ndarray, sizes: tuple[float, float]
) -> np.ndarray:
    """A turned superquadric of random roundness. sizes: range of its half axes."""
    turn = Rotation.random(random_state=rng).as_matrix().astype(np.float32)
    exponents = (float(rng.uniform(0.35, 1.3)), float(rng.uniform(0.35, 1.3)))
    return superquadric((p - np.float32(centre)) @ turn, rng.uniform(*sizes, 3), exponents)


def lump(p: np.ndarray, rng: np.random.Generator, bumps: np.ndarray) -> Field:
    """Superquadrics in a smooth union, with dents cut out, displaced by `bumps` (noise of unit
    variance on the grid)."""
    parts = []
    for _ in range(rng.integers(3, 6)):
        parts.append(random_superquadric(p, rng, rng.uniform(-0.38, 0.38, 3), (0.2, 0.45)))
    parts.append(random_superquadric(p, rng, np.zeros(3), (0.3, 0.4)))  # joins them
    field = united(parts, 0.12)
    distance = field.distance + rng.uniform(0.0, 0.025) * bumps
    for _ in range(rng.integers(0, 3)):
        towards = rng.normal(size=3)
        centre = 0.62 * towards / np.linalg.norm(towards)
        dent = length(p - np.float32(centre)) - rng.uniform(0.2, 0.32)
        distance = -smooth_union(-distance, dent, 0.05)
    return Field(distance.astype(np.float32), field.part)


def bowl(p: np.ndarray, rng: np.random.Generator, bumps: np.ndarray) -> Field:
    """An open bowl on a foot with three to five things in it. Part 0 is the bowl."""
    depth, wide, wall = rng.uniform(0.4, 0.65), rng.uniform(0.7, 0.85), rng.uniform(0.035, 0.05)
    half = np.array([wide, depth, wide])
    q = p - np.float32([0, 0.4, 0])  # the rim is at y = .4
    body = superquadric(q, half, (float(rng.uniform(0.6, 1.1)), 1.0))
    shell = np.maximum(np.abs(body) - wall, q[..., 1])
    foot = torus(p - np.float32([0, 0.4 - depth, 0]), rng.uniform(0.25, 0.4), 0.05)
    vessel = smooth_union(shell, foot, 0.06)
    things = []
    count = int(rng.integers(3, 6))
    for k in range(count):
        angle, size = 2 * np.pi * (k + rng.uniform(-0.3, 0.3)) / count, rng.uniform(0.17, 0.27)
        out = rng.uniform(0.22, 0.4)
        ground = 0.4 - depth * np.sqrt(1 - (out / wide) ** 2)
        centre = np.array([out * np.cos(angle), ground + 0.9 * size, out * np.sin(angle)])
        things.append(random_superquadric(p, rng, centre, (0.8 * size, 1.3 * size)) + 0.01 * bumps)
    return united([vessel, *things], 0.02)


def strut_frame(p: np.ndarray, rng: np.random.Generator) -> Field:
    """Struts between random nodes, each node tied to the nearest of those before it, with a ring
    and a plate. Radii are .03 to .045."""
    nodes = rng.uniform(-0.75, 0.75, (int(rng.integers(6, 9)), 3))
    parts = []
    for k in range(1, len(nodes)):
        distance = np.linalg.norm(nodes[:k] - nodes[k], axis=1)
        for j in np.argsort(distance)[:2]:
            parts.append(capsule(p, nodes[k], nodes[j], rng.uniform(0.03, 0.045)))
    for node, flat in ((nodes[0], False), (nodes[1], True)):
        turn = Rotation.random(random_state=rng).as_matrix().astype(np.float32)
        radius = rng.uniform(0.25, 0.38)
        centre = np.clip(node, -REACH + radius, REACH - radius)
        parts.append(capsule(p, node, centre + 1e-3, 0.035))
        q = (p - np.float32(centre)) @ turn
        if flat:
            parts.append(superquadric(q, np.array([radius, 0.035, radius]), (0.5, 1.0)))
        else:
            parts.append(torus(q, radius, 0.035))
            parts.append(capsule(q, np.array([-radius, 0, 0]), np.array([radius, 0, 0]), 0.03))
    return united(parts, 0.03)

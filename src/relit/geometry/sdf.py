"""The signed distance field: a dense grid for look-ups, a narrow band of rows for everything that
is optimised.

The grid has n^3 nodes over [-1, 1]^3 (the `unit` frame), node (x, y, z) at flat index (z n + y) n +
x, spacing h = 2 / (n - 1). Negative inside. Rows exist only for nodes of the band |sdf| < band * h;
row 0 belongs to no node and collects what falls outside. An optimiser step touches rows, never the
whole grid.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import distance_transform_edt

MOST_COPIES = 1 << 23  # numbers, of all threads; see `sums_into`


@dataclass
class SdfGrid:
    """n: nodes per side. values: Float [n^3], signed distance in unit-frame lengths. index: UInt32
    [n^3], row of each node.
    nodes: UInt32 [rows - 1], node of each row from row 1 on. rows: number of rows, row 0 included.
    row_values: Float [rows], the optimised copy of `values` on the band. features: Float [rows *
    channels], packed by row."""

    n: int
    values: Any
    index: Any
    nodes: Any
    rows: int
    row_values: Any
    features: Any
    channels: int

    @property
    def h(self) -> float:
        return 2.0 / (self.n - 1)


def make_grid(
    values: np.ndarray, channels: int, *, band: float, features: np.ndarray | None = None, fill=0.0
) -> SdfGrid:
    """Build a grid from distances (n, n, n) [z, y, x]; `band` in voxels (inf: every node).
    features: (n, n, n, channels) or None."""
    n = values.shape[0]
    h = 2.0 / (n - 1)
    nodes = np.flatnonzero(np.abs(values.ravel()) < band * h).astype(np.uint32)
    index = np.zeros(n**3, np.uint32)
    index[nodes] = np.arange(1, len(nodes) + 1, dtype=np.uint32)
    rows = len(nodes) + 1
    row_features = np.empty((rows, channels), np.float32)
    row_features[:] = np.asarray(fill, np.float32)
    if features is not None:
        row_features[1:] = features.reshape(-1, channels)[nodes]
    row_values = np.concatenate([[1.0], values.ravel()[nodes]]).astype(np.float32)
    return SdfGrid(
        n,
        mi.Float(values.ravel().astype(np.float32)),
        mi.UInt32(index),
        mi.UInt32(nodes),
        rows,
        mi.Float(row_values),
        mi.Float(row_features.ravel()),
        channels,
    )


def write_rows(grid: SdfGrid) -> None:
    """Copy the optimised row values into the dense grid (band nodes only)."""
    values = dr.gather(mi.Float, grid.row_values, dr.arange(mi.UInt32, grid.rows - 1) + 1)
    dr.scatter(grid.values, values, grid.nodes)
    dr.eval(grid.values)


def redistance(values: np.ndarray) -> np.ndarray:
    """Make (n, n, n) values a distance again, keeping the zero level to sub-voxel accuracy.

    Near the surface the distance is value / |gradient|; farther off, the exact Euclidean transform
    of the sign.
    """
    h = 2.0 / (values.shape[0] - 1)
    gradient = np.stack(np.gradient(values, h), -1)  # pyright: ignore[reportArgumentType, reportCallIssue]
    near = values / np.maximum(np.linalg.norm(gradient, axis=-1), 0.2)
    inside = values < 0
    if not inside.any() or inside.all():
        return values.astype(np.float32)
    far = (distance_transform_edt(~inside) - distance_transform_edt(inside)) * h
    far = far - 0.5 * h * np.sign(far)
    w = np.clip((np.abs(far) / h - 1.5) / 1.5, 0, 1)
    near = np.clip(near, -3 * h, 3 * h)
    out = (1 - w) * near + w * far
    return np.where(inside, np.minimum(out, -1e-4 * h), np.maximum(out, 1e-4 * h)).astype(
        np.float32
    )


def resample(values: np.ndarray, n: int) -> np.ndarray:
    """Trilinear resampling of (m, m, m[, C]) node values to n nodes a side over the same cube."""
    from scipy.ndimage import map_coordinates

    m = values.shape[0]
    axis = np.arange(n) * ((m - 1) / (n - 1))
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    if values.ndim == 3:
        return map_coordinates(values, [z, y, x], order=1, mode="nearest").astype(np.float32)
    return np.stack(
        [
            map_coordinates(values[..., c], [z, y, x], order=1, mode="nearest")
            for c in range(values.shape[-1])
        ],
        -1,
    ).astype(np.float32)


def node_positions(n: int) -> np.ndarray:
    """(n, n, n, 3) float32 positions of the nodes, [z, y, x] order, components (x, y, z)."""
    g = (np.arange(n) / (n - 1) * 2 - 1).astype(np.float32)
    z, y, x = np.meshgrid(g, g, g, indexing="ij")
    return np.stack([x, y, z], -1)


def dense_values(grid: SdfGrid) -> np.ndarray:
    """(n, n, n) float32 on the CPU."""
    return np.array(grid.values).reshape(grid.n, grid.n, grid.n)


def row_features(grid: SdfGrid) -> np.ndarray:
    """(rows, channels) float32 on the CPU."""
    return np.array(grid.features).reshape(grid.rows, grid.channels)


def smoothness_gradient(grid: SdfGrid, eikonal):
    """Two Floats [rows]: the gradient of eikonal * mean over the band of (|∇S| - 1)^2 with respect
    to the row values (SfD Eq. 4, E_reg), and L S, the mean of the six neighbours minus the value.

    eikonal: opaque Float. Central differences; nodes at the border of the cube take no part.
    """
    n, h = grid.n, grid.h
    count = grid.rows - 1
    a = grid.nodes
    x, y, z = a % n, (a // n) % n, a // (n * n)
    ok = (x > 0) & (x < n - 1) & (y > 0) & (y < n - 1) & (z > 0) & (z < n - 1)
    centre = dr.gather(mi.Float, grid.values, a, ok)
    pairs = [
        (
            dr.gather(mi.Float, grid.values, a + k, ok),
            dr.gather(mi.Float, grid.values, a - k, ok),
            k,
        )
        for k in (1, n, n * n)
    ]
    g = [(p - m) / (2 * h) for p, m, _ in pairs]
    norm = dr.sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
    ke = eikonal * (2.0 / count) * (1 - 1 / dr.maximum(norm, 0.05))
    around = pairs[0][0] + pairs[0][1] + pairs[1][0] + pairs[1][1] + pairs[2][0] + pairs[2][1]
    slopes = [dr.select(ok, ke * v / (2 * h), 0) for v in g]
    rounder = dr.select(ok, around * (1 / 6) - centre, 0)
    dr.eval(slopes, rounder)
    pull = sum(neighbour_difference(grid, e, k) for e, (_, _, k) in zip(slopes, pairs, strict=True))
    own, out, diffusion = (
        dr.arange(mi.UInt32, count) + 1,
        dr.zeros(mi.Float, grid.rows),
        dr.zeros(mi.Float, grid.rows),
    )
    dr.scatter(out, pull, own)
    dr.scatter(diffusion, rounder, own)
    return out, diffusion


def neighbour_difference(grid: SdfGrid, e, k: int):
    """Float [rows - 1]: e (Float [rows - 1], by node of the band) at the node k before each minus e
    at the node k after it; 0 outside."""
    a = grid.nodes
    before, after = (
        dr.gather(mi.UInt32, grid.index, node, there)
        for node, there in ((a - k, a >= k), (a + k, a + k < grid.n**3))
    )
    return dr.gather(mi.Float, e, before - 1, before > 0) - dr.gather(
        mi.Float, e, after - 1, after > 0
    )


def sums_into(entries: int):
    """The dr.ReduceMode in which sums are scattered into so many numbers. On the CPU each thread
    adds to a copy of its own where these are few, which is cleared and added to the others' each
    time; atomic additions need none, but take several times as long each."""
    few = entries * dr.thread_count() <= MOST_COPIES
    return (
        dr.ReduceMode.Expand
        if few and dr.backend_v(mi.Float) == dr.JitBackend.LLVM
        else dr.ReduceMode.Direct
    )


def neighbour_mean_difference(grid: SdfGrid, rows):
    """L applied to a row array (Float [rows], row 0 is 0): mean of the six neighbours minus the
    value; 0 where a neighbour leaves the band.

    L L S removes noise of the grid's own scale from S and leaves curvature alone, where L S would
    shrink thin parts.
    """
    n = grid.n
    a = grid.nodes
    x, y, z = a % n, (a // n) % n, a // (n * n)
    ok = (x > 0) & (x < n - 1) & (y > 0) & (y < n - 1) & (z > 0) & (z < n - 1)
    around = mi.Float(0)
    for k in (1, n, n * n):
        for node in (a + k, a - k):
            row = dr.gather(mi.UInt32, grid.index, node, ok)
            ok &= row != 0
            around += dr.gather(mi.Float, rows, row, ok)
    own = dr.arange(mi.UInt32, grid.rows - 1) + 1
    out = dr.zeros(mi.Float, grid.rows)
    dr.scatter(out, dr.select(ok, around * (1 / 6) - dr.gather(mi.Float, rows, own), 0), own)
    return out

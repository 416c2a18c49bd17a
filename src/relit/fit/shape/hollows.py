"""Concavities that silhouettes cannot show: a first shape that is opened where the photos
contradict the visual hull.

The hull of a cup has a lid. The volume pass does not leave it: a small dent in a lid explains the
photos no better than none, because the near wall of the dent hides what its far wall gains. So a
larger step is tried. The hull is fitted for a while on a coarse grid; where the surface is then
explained badly it counts as open, and all that lies under it, but for a wall along the surface that
is explained well, is taken away. Fitted for as long from the same start, the opened shape is kept
if it explains the photos clearly better; then it is opened further in the same manner. A convex
object costs one fit and one trial.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import (
    binary_dilation,
    binary_propagation,
    distance_transform_edt,
    gaussian_filter,
)

from relit.fit.passes.optimiser import NoStage
from relit.fit.passes.pixels import PixelBank
from relit.fit.passes.ray_errors import ray_errors
from relit.fit.passes.volume import VolumeModel, VolumeOptions, fit_volume
from relit.geometry.hull import distance_of
from relit.geometry.sdf import dense_values, node_positions, resample
from relit.scene import Camera

KEEP = (
    0.3,
    0.15,
    0.05,
    0.0,
)  # share of the photos in which a node is bare and so stays, turn after turn


@dataclass(frozen=True)
class HollowOptions:
    """nodes a side, steps and rays of each trial. sharpness: as in VolumeOptions.

    well: quantile of the surface's error that is good; bad: times that, from which on it counts as
    open. wall: thickness in voxels that is left. gain: part of the error that a trial must take
    away. rounds: of trials. least: nodes that are worth a trial. probes: rays that the error is
    taken from. blur: of its map, voxels.
    """

    nodes: int = 48
    steps: int = 150
    rays: int = 4096
    well: float = 0.25
    bad: float = 2.5
    wall: float = 2.0
    gain: float = 0.05
    rounds: int = 3
    sharpness: tuple[float, float] = (1.0, 4.0)
    least: int = 20
    probes: int = 200_000
    blur: float = 1.5


def open_hollows(
    bank: PixelBank,
    cameras: list[Camera],
    values: np.ndarray,
    start: Callable[[np.ndarray], VolumeModel],
    options: HollowOptions,
    say: Callable[[str], None],
    seed: int = 0,
    progress: Callable[[int], None] | None = None,
) -> np.ndarray | None:
    """What is to be taken away from a visual hull: (n, n, n) distances, negative in the hollows, or
    None where there are none.

    values: (n, n, n) distances of the hull, n = options.nodes. cameras: unit frame. start:
    distances -> a fresh model of the capture kind.
    progress: told how many steps of all trials are over.
    """
    stage = NoStage(progress)
    o, hull = options, values < 0
    some = cameras[:: max(1, len(cameras) // 40)]

    def fitted(v: np.ndarray):
        model = briefly_fitted(bank, start(v), o, stage, seed)
        return dense_values(model.grid), *error_near_nodes(bank, model, o, seed)

    shape, error, where = fitted(values)
    for _ in range(o.rounds):
        trial = opened(shape, where, some, o)
        if trial is None:
            break
        new = fitted(trial)
        say(f"a hollow was tried: mean squared error {error:.5f} without, {new[1]:.5f} with it")
        if new[1] > (1 - o.gain) * error:
            break
        values, (shape, error, where) = trial, new
    gone = hull & (values >= 0)
    return distance_of(gone) if gone.any() else None


def briefly_fitted(
    bank: PixelBank, model: VolumeModel, o: HollowOptions, stage, seed: int
) -> VolumeModel:
    """The model after a trial's steps."""
    return fit_volume(
        bank,
        model,
        VolumeOptions((o.nodes,), (o.steps,), o.rays, sharpness=o.sharpness),
        stage,
        seed,
    )


def without(values: np.ndarray, hollows: np.ndarray | None) -> np.ndarray:
    """Distances (n, n, n) of a shape without its hollows, which may have another number of
    nodes."""
    return values if hollows is None else np.maximum(values, -resample(hollows, values.shape[0]))


def error_near_nodes(bank: PixelBank, model: VolumeModel, o: HollowOptions, seed: int):
    """(mean error, (n, n, n) mean error of the rays whose surface point is near each node, NaN
    where there are none)."""
    n = o.nodes
    rays = ray_errors(bank, model, o.probes, seed)
    value, flat = rays.value[rays.hit], nearest_node(rays.x[rays.hit], n)
    value = np.minimum(value, 4 * value.mean())  # highlights
    total, count = (
        np.bincount(flat, w, n**3).reshape(n, n, n) for w in (value, np.ones_like(value))
    )
    total, count = gaussian_filter(total, o.blur), gaussian_filter(count, o.blur)
    return float(value.mean()), np.where(count > 0.02, total / np.maximum(count, 1e-9), np.nan)


def nearest_node(x: np.ndarray, n: int) -> np.ndarray:
    """(N,) index into a flat (n, n, n) grid of points (N, 3) of the unit frame."""
    node = np.clip(np.round((x * 0.5 + 0.5) * (n - 1)).astype(int), 0, n - 1)
    return (node[:, 2] * n + node[:, 1]) * n + node[:, 0]


def opened(
    shape: np.ndarray, where: np.ndarray, cameras: list[Camera], o: HollowOptions
) -> np.ndarray | None:
    """Distances of the shape without what lies under its badly explained surface; None where that
    is nothing, or nearly all."""
    inside = shape < 0
    skin = skin_of(inside) & np.isfinite(where)
    if not skin.any():
        return None
    bad = skin & (where > o.bad * np.quantile(where[skin], o.well))
    good = skin & ~bad
    if bad.sum() < o.least or not good.any():
        return None
    return left_without(inside, bad, good, cameras, o)


def skin_of(inside: np.ndarray) -> np.ndarray:
    """The outermost nodes of a shape, (n, n, n) bool."""
    return inside & (distance_transform_edt(inside) < 1.5)


def left_without(
    inside: np.ndarray, bad: np.ndarray, good: np.ndarray, cameras: list[Camera], o: HollowOptions
) -> np.ndarray | None:
    """Distances of `inside` without what can be reached through the skin `bad`, but for a wall
    along the skin `good` and what the silhouettes need; None where that is nothing, or nearly all.
    All (n, n, n) bool."""
    far = inside & (distance_transform_edt(~good) > o.wall)
    gone = binary_propagation(bad & far, mask=far)
    for (
        votes
    ) in KEEP:  # a handle is bare in most photos; what is behind a handle that is gone is so in few
        need = bare(cameras, inside & ~gone, gone) > votes * len(cameras)
        gone &= ~binary_dilation(need, iterations=2)  # and its root stays with it
    left = inside & ~gone
    if gone.sum() < o.least or not left.any():
        return None
    return distance_of(left)


def bare(cameras: list[Camera], left: np.ndarray, gone: np.ndarray) -> np.ndarray:
    """(n, n, n) int: how many cameras see a node of `gone` with nothing of `left` behind or before
    it: without it the silhouette would have a hole. left, gone: (n, n, n) bool."""
    n = left.shape[0]
    p = node_positions(n)
    solid, asked = p[left].astype(np.float64), p[gone].astype(np.float64)
    out = np.zeros(len(asked), int)
    for camera in cameras:
        w, h = small_size(camera, n)
        columns, rows, _ = small_pixels(camera, solid, w, h)
        cover = np.zeros((h, w), bool)
        cover[rows, columns] = True
        cover = binary_dilation(cover, np.ones((3, 3), bool))
        columns, rows, seen = small_pixels(camera, asked, w, h)
        out[seen] += ~cover[rows, columns]
    found = np.zeros(gone.shape, int)
    found[gone] = out
    return found


def small_size(camera: Camera, nodes: int) -> tuple[int, int]:
    """Width and height of the small picture in which a voxel at the centre, of so many nodes a
    side, is a pixel."""
    scale = np.linalg.norm(camera.centre) * 0.5 * (nodes - 1) / camera.fx
    return max(2, round(camera.width * scale)), max(2, round(camera.height * scale))


def small_pixels(camera: Camera, points: np.ndarray, width: int, height: int):
    """Columns and rows of those points (N, 3), unit frame, that lie in the picture of `camera`
    shrunk to (width, height); and which they are (N,) bool."""
    m = camera.camera_from_world
    q = points @ m[:3, :3].T + m[:3, 3]
    z = np.maximum(q[:, 2], 1e-6)
    column = np.floor((camera.fx * q[:, 0] / z + camera.cx) * (width / camera.width)).astype(
        np.int64
    )
    row = np.floor((camera.fy * q[:, 1] / z + camera.cy) * (height / camera.height)).astype(
        np.int64
    )
    seen = (q[:, 2] > 1e-6) & (column >= 0) & (row >= 0) & (column < width) & (row < height)
    return column[seen], row[seen], seen

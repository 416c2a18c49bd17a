"""Bodies of revolution, handles aside: what a silhouette rules out on one side of the body is ruled out all around it.

A waist above a foot shows at the sides of a few outlines alone, and between those sides the fitted shape stays as wide as its rims let
it be. Where the space beside the axis is cut into circles, each circle is asked from all views at once. What sticks out beside the
body, a handle or a spout, is not the same all around: it is what the silhouettes have and the turned body has not.

Distances (n, n, n) are those of nodes of the unit frame, negative inside.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy.ndimage import binary_dilation, median_filter, minimum_filter

from relit.fit.hollows import small_pixels, small_size
from relit.fit.instances import View, nearest_pixels
from relit.geometry.revolution_axis import Axis
from relit.geometry.sdf import node_positions
from relit.scene import Camera

TURNS = 72  # places on a circle that are asked
RULED_OUT = 0.05  # share of a circle: one that is a hundredth too wide shows so much of itself at the sides of a view
AGREEING = 0.25  # share of the views: poses are not exact, and where each outline cuts off a little, all together cut off too much
SLACK = 1.0  # voxels; the axis and the poses are not exact, and the fit that follows does not put back what was cut off
BESIDE = 0.15  # share of the views of a place in which it must stick out beside the turned body to be part of a handle
NEAR = 2  # voxels around what sticks out that stay as they are


def turned_body(values: np.ndarray, axis: Axis, views: list[View], cameras: list[Camera]) -> np.ndarray:
    """Distances of the shape `values` (n, n, n) without what the silhouettes rule out all around the axis, handles left as they are.
    cameras: of the views, unit frame."""
    p, inside, voxel = node_positions(values.shape[0]), values < 0, 2 / (values.shape[0] - 1)
    heights, widest = widest_circles(values, axis, views, cameras)
    beyond = (axis.radii(p) - np.interp(axis.heights(p), heights, widest) - SLACK * voxel).astype(values.dtype)
    spare = inside & (beyond > 0)
    if not spare.any():
        return values
    stays = binary_dilation(sticking_out(inside & ~spare, spare, views, cameras), iterations=NEAR)
    return np.where(stays, values, np.maximum(values, beyond))


def widest_circles(values: np.ndarray, axis: Axis, views: list[View], cameras: list[Camera]) -> tuple[np.ndarray, np.ndarray]:
    """(H,) heights along the axis, half a voxel apart, and the radii (H,) up to which circles about it are not ruled out by AGREEING of the
    views. A view rules out a circle of which it shows more than RULED_OUT on known background that is no neighbour of the silhouette."""
    step, inside = 1 / (values.shape[0] - 1), values < 0
    p = node_positions(values.shape[0])[inside]
    heights = np.arange(axis.heights(p).min(), axis.heights(p).max() + step, step)
    radii = np.arange(step, axis.radii(p).max() + step, step)
    across = np.linalg.svd(axis.direction[None])[2][1:]  # two directions across the axis
    a = np.arange(TURNS) * 2 * np.pi / TURNS
    ring = np.cos(a)[:, None] * across[0] + np.sin(a)[:, None] * across[1]
    points = axis.point + heights[:, None, None, None] * axis.direction + radii[None, :, None, None] * ring
    reach = []
    for view, camera in zip(views, cameras, strict=True):
        u, v, shown = nearest_pixels(camera, points.reshape(-1, 3))
        background = (cv2.dilate((view.mask > 0.5).astype(np.uint8), np.ones((3, 3), np.uint8)) == 0) & (view.known > 0.5)
        empty = (background[v, u] & shown).reshape(points.shape[:3])
        reach.append(np.cumprod(empty.mean(-1) <= RULED_OUT, axis=1).sum(1))
    rank = max(1, round(AGREEING * len(reach))) - 1
    return heights, median_filter((np.sort(reach, axis=0)[rank] + 0.5) * step, 3, mode="nearest")


def sticking_out(body: np.ndarray, spare: np.ndarray, views: list[View], cameras: list[Camera]) -> np.ndarray:
    """Which of the nodes `spare` (n, n, n) bool are part of a handle: seen beside the `body` (n, n, n) bool, but inside the silhouette, in
    BESIDE of the views that know anything there."""
    n = body.shape[0]
    p = node_positions(n)
    own, asked = p[body].astype(np.float64), p[spare].astype(np.float64)
    out, told = np.zeros(len(asked)), np.zeros(len(asked))
    for view, camera in zip(views, cameras, strict=True):
        w, h = small_size(camera, n)
        columns, rows, _ = small_pixels(camera, own, w, h)
        free = np.ones((h, w), np.uint8)
        free[rows, columns] = 0
        free = minimum_filter(free, 3)
        shrunk = [cv2.resize(x.astype(np.float32), (w, h), interpolation=cv2.INTER_AREA) > 0.5 for x in (view.mask, view.known)]
        beside = cv2.morphologyEx((shrunk[0] & shrunk[1] & (free > 0)).astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8)) > 0
        columns, rows, seen = small_pixels(camera, asked, w, h)
        out[seen] += beside[rows, columns]
        told[seen] += shrunk[1][rows, columns]
    found = np.zeros_like(spare)
    found[spare] = out >= np.maximum(BESIDE * told, 1)
    return found

"""A body inside a visual hull that is as round as the silhouettes let it be.

The visual hull is the largest body that silhouettes allow. Of few of them it has corners and lumps
that no silhouette asks for, and from another side it looks like something else. Here it shrinks by
mean curvature flow as long as it still fills every silhouette: threshold dynamics (Merriman, Bence,
Osher 1992: smooth the indicator function, take what is above a half), with the silhouettes as
constraints (as Kolev and Cremers 2008: every ray of a silhouette meets the body).
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from relit.geometry.hull import distance_of
from relit.geometry.sdf import node_positions
from relit.scene import Camera

ROUNDING = 0.077  # unit lengths, standard deviation of what smooths the body in a round
ROUNDS = 4  # more of them leave a skin
HALF = 0.5  # of a pixel, and of the smoothed indicator function, from which on it counts as inside


def taut(
    values: np.ndarray,
    cameras: Sequence[Camera],
    masks: Sequence[np.ndarray],
    *,
    rounds: int = ROUNDS,
) -> np.ndarray:
    """Signed distance (n, n, n) of the hull's body `values` (n, n, n, negative inside) after some
    rounds of shrinking.

    cameras: in the unit frame. masks: (H, W) in [0, 1], one for each, what is certainly the
    object's (not where something else may hide it). What the hull does not cover of them is not
    asked of the body either. Pixels are as large as the grid's cells are in the picture.
    Raises NoShape where nothing is inside.
    """
    n = len(values)
    inside = np.flatnonzero(values.ravel() < 0)
    points = node_positions(n).reshape(-1, 3)[inside]
    seen = [
        shown_at(points, camera, mask, 2 / (n - 1))
        for camera, mask in zip(cameras, masks, strict=True)
    ]
    body, filled = np.ones(len(inside), bool), np.zeros((n, n, n), np.float32)
    for _ in range(rounds):
        filled.flat[inside] = body
        smooth = gaussian_filter(filled, ROUNDING * (n - 1) / 2).ravel()[inside]
        body = smooth > HALF
        for at, asked in seen:
            body |= deepest_of_uncovered(body, smooth, at, asked)
    solid = np.zeros((n, n, n), bool)
    solid.flat[inside] = body
    return distance_of(solid)


def shown_at(
    points: np.ndarray, camera: Camera, mask: np.ndarray, cell: float
) -> tuple[np.ndarray, np.ndarray]:
    """(pixel (P,) of a coarser picture that shows each point, whether each of its pixels must show
    the body). cell: of the grid, unit lengths, as large as a pixel of the coarser picture at the
    object's middle."""
    step = max(1.0, cell * camera.fx / float(np.linalg.norm(camera.centre)))
    width, height = int(np.ceil(camera.width / step)), int(np.ceil(camera.height / step))
    small = cv2.resize(np.asarray(mask, np.float32), (width, height), interpolation=cv2.INTER_AREA)
    q = camera.project(points)
    column = np.clip(q[:, 0] * width / camera.width, 0, width - 1).astype(int)
    row = np.clip(q[:, 1] * height / camera.height, 0, height - 1).astype(int)
    at = row * width + column
    covered = np.zeros(width * height, bool)
    covered[at] = True
    return at, covered & (small.ravel() > HALF)


def deepest_of_uncovered(
    body: np.ndarray, smooth: np.ndarray, at: np.ndarray, asked: np.ndarray
) -> np.ndarray:
    """(P,) bool: of each pixel that is asked for and that no point of the `body` covers, the point
    that lies deepest inside (`smooth`)."""
    covered = np.zeros(len(asked), bool)
    covered[at[body]] = True
    back = np.zeros(len(at), bool)
    missing = np.flatnonzero((asked & ~covered)[at])
    if len(missing):
        deepest = np.zeros(len(asked), np.float32)
        np.maximum.at(deepest, at[missing], smooth[missing])
        back[missing] = smooth[missing] >= deepest[at[missing]]
    return back

"""Photos that structure from motion has put where they were not taken, told by their masks.

A second group of photos can be joined to the first by a few false matches, with small reprojection errors of its own. All that is seen of
the object lies inside its mask in every photo, from wherever it was taken: the points on which most photos agree fall beside the mask of
a photo whose camera is wrong.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from relit.scene import Camera

AGREED = 0.8  # share of the photos whose masks hold a point of the object; other points are background, or the strays' own
HELD = 0.7  # share of these points that the mask of a photo in its place holds: masks may miss a dark side
USUAL = 0.9  # the same of the median photo: below it masks or points tell nothing
MOST = 0.2  # share of the photos; where more disagree, there is no telling who is wrong
LEAST_POINTS = 100


def stray_photos(cameras: Sequence[Camera], masks: Sequence[np.ndarray], points: np.ndarray | None) -> tuple[list[int], np.ndarray]:
    """Indices of the photos whose masks do not hold the points that most others agree on, and which points these are, (N,) bool.

    cameras: as calibrated, in the frame of the points; lenses are left out of account. masks: (h, w) in [0, 1], of any size. points:
    (N, 3), some of them beside the object. None are strays, and all points stay, where too little is known.
    """
    if points is None or len(points) < LEAST_POINTS:
        return [], np.ones(0 if points is None else len(points), bool)
    nobody = [], np.ones(len(points), bool)
    held = np.array([holds(camera, mask, points) for camera, mask in zip(cameras, masks, strict=True)])
    here = np.ones(len(cameras), bool)
    while True:  # without the strays more points are agreed on, and those show strays that hid among them
        agreed = held[here].mean(0) >= AGREED
        if agreed.sum() < LEAST_POINTS:
            return nobody
        share = held[:, agreed].mean(1)
        still = here & (share >= HELD)
        if np.median(share[here]) < USUAL or (~still).sum() > MOST * len(cameras):
            return nobody
        if (still == here).all():
            return np.flatnonzero(~here).tolist(), agreed if not here.all() else nobody[1]
        here = still


def holds(camera: Camera, mask: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(N,) bool: points (N, 3) that a camera sees inside its mask (h, w), grown by two pixels."""
    h, w = mask.shape
    grown = cv2.dilate((mask > 0.3).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    u, v, depth = camera.resized(w, h).project(points).T
    inside = (depth > 0) & (u >= 0) & (v >= 0) & (u < w) & (v < h)
    out = np.zeros(len(points), bool)
    out[inside] = grown[v[inside].astype(int), u[inside].astype(int)]
    return out

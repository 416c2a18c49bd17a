"""Photos that structure from motion has put where they were not taken, told by their masks.

A second group of photos can be joined to the first by a few false matches, with small reprojection
errors of its own. All that is seen of
the object lies inside its mask in every photo, from wherever it was taken: the points on which most
photos agree fall beside the mask of a photo whose camera is wrong.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from relit.scene import Camera

# share of the photos that should show a point of the object whose masks hold it; others are
# background, or the strays' own
AGREED = 0.8
# share of the points it should show that the mask of a photo in its place holds: masks may miss a
# dark side
HELD = 0.7
USUAL = 0.9  # the same of the median photo: below it masks or points tell nothing
MOST = 0.2  # share of the photos; where more disagree, there is no telling who is wrong
LEAST_POINTS = 100
LEAST_SHOWN = 30  # of them in a photo that is judged
LEAST_PHOTOS = 3  # that hold a point


def stray_photos(
    cameras: Sequence[Camera], masks: Sequence[np.ndarray], points: np.ndarray | None
) -> tuple[list[int], np.ndarray]:
    """Indices of the photos whose masks do not hold the points that most others agree on, and which
    points these are, (N,) bool.

    cameras: as calibrated, in the frame of the points; lenses are left out of account. masks: (h,
    w) in [0, 1], of any size. points: (N, 3), some of them beside the object. None are strays, and
    all points stay, where too little is known.
    """
    if points is None or len(points) < LEAST_POINTS:
        return [], np.ones(0 if points is None else len(points), bool)
    nobody = [], np.ones(len(points), bool)
    seen, held = np.moveaxis(
        [  # pyright: ignore[reportArgumentType]
            expected_points(camera, mask, points)
            for camera, mask in zip(cameras, masks, strict=True)
        ],
        1,
        0,
    )
    here = np.ones(len(cameras), bool)
    while (
        True
    ):  # without the strays more points are agreed on, and those show strays that hid among them
        agreed = held[here].sum(0) >= np.maximum(AGREED * seen[here].sum(0), LEAST_PHOTOS)
        if agreed.sum() < LEAST_POINTS:
            return nobody
        due = seen[:, agreed].sum(1)
        share = np.where(due >= LEAST_SHOWN, held[:, agreed].sum(1) / np.maximum(due, 1), 1.0)
        still = here & (share >= HELD)
        if np.median(share[here]) < USUAL or (~still).sum() > MOST * len(cameras):
            return nobody
        if (still == here).all():
            return np.flatnonzero(~here).tolist(), agreed if not here.all() else nobody[1]
        here = still


def expected_points(
    camera: Camera, mask: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(N,) bool each: points (N, 3) that a photo should show if they are on the object, and those
    that lie inside its mask (h, w), grown by two pixels. Where the mask reaches the border, as in a
    close-up, these are the points in its frame; else the whole object is."""
    h, w = mask.shape
    solid = mask > 0.3
    whole = not (solid[[0, -1]].any() or solid[:, [0, -1]].any())
    grown = cv2.dilate(solid.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    u, v, depth = camera.resized(w, h).project(points).T
    inside = (depth > 0) & (u >= 0) & (v >= 0) & (u < w) & (v < h)
    held = np.zeros(len(points), bool)
    held[inside] = grown[v[inside].astype(int), u[inside].astype(int)]
    return inside | whole, held

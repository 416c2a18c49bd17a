"""Masks of photos taken before a plain backdrop: a dark room, a black cloth, a white sheet."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from relit.conventions import srgb_from_linear

BAND = 0.03  # width of the border that is looked at, as a share of the shorter side
BLACK = 0.05  # sRGB value below which a pixel holds no picture: bars, edges of undistorted photos
FRAME = 0.005  # share of a picture that a black frame covers at least
ROUND = 0.93  # share of its convex hull that the picture inside a black frame fills
CENTRED = 0.02  # of the picture: twice the distance of a window from its middle
FILLED = 0.6  # share of the pixels inside the frame's edge that are not black
MOST_SHADOW = 0.2  # share of the photos in which they may be
DARK = 0.12  # sRGB value below which a backdrop counts as dark


@dataclass(frozen=True)
class Backdrop:
    """A plain backdrop. dark: its pixels are nearly black. tolerance: largest difference to it, in
    sRGB values [0, 1]."""

    dark: bool
    tolerance: float

    def __call__(self, rgb: np.ndarray) -> np.ndarray:
        """Linear (H, W, 3) -> mask (H, W) float32, 0 or 1. The backdrop's colour is taken from the
        photo's own border."""
        coded = _smoothed(rgb)
        d = _distance(coded, _border_colour(coded))
        return _cleaned(d, self.tolerance)


def find_backdrop(photos: list[np.ndarray]) -> Backdrop | None:
    """Decide from small linear photos (each (h, w, 3)) whether all stand before a plain backdrop.

    Plain means: in at least 80 % of the photos, 75 % of the border is within .1 of one colour, the
    same in all photos to .12 (sRGB values), and what differs from it is between 1 % and 85 % of the
    picture. Returns None otherwise.
    """
    coded = [_smoothed(p) for p in photos]
    colours = np.array([_border_colour(c) for c in coded])
    middle = np.median(colours, axis=0)
    plain, borders, insides = [], [], []
    for c, colour in zip(coded, colours, strict=True):
        d = _distance(c, colour)
        edge = d[_border(d.shape)]
        plain.append(
            float((edge < 0.1).mean()) > 0.75 and float(np.abs(colour - middle).max()) < 0.12
        )
        borders.append(np.quantile(edge[edge < 0.1], 0.95) if (edge < 0.1).any() else 0.1)
        insides.append(d[d > 0.02])
    if np.mean(plain) < 0.8:
        return None
    values = np.concatenate(insides)
    if len(values) < 16:
        return None
    # near the backdrop's noise rather than half way to the object: shadowed parts of an object
    # before a dark backdrop are dark as well
    tolerance = float(
        np.clip(0.37 * _otsu(values), max(0.05, 1.2 * float(np.median(borders))), 0.15)
    )
    shares = [
        float((_cleaned(_distance(c, k), tolerance) > 0.5).mean())
        for c, k in zip(coded, colours, strict=True)
    ]
    if np.mean([0.01 < s < 0.85 for s in shares]) < 0.8:
        return None
    return Backdrop(bool(middle.max() < DARK), tolerance)


def black_frame(photos: list[np.ndarray]) -> float | None:
    """Share of the picture that a black frame covers, from small linear photos (each (h, w, 3)):
    bars of a video, the outside of a fisheye's circle, edges of undistorted photos. None where
    there is none: of a dark backdrop the object's outline changes from photo to photo, and what
    lies along the union of the outlines is mostly black in each photo.
    """
    shapes = [p.shape for p in photos]
    common = max(set(shapes), key=shapes.count)
    coded = [_smoothed(p) for p in photos if p.shape == common]
    if len(coded) < max(3, 0.8 * len(photos)):
        return None
    black = np.array([c.max(axis=-1) < BLACK for c in coded])
    always = black.mean(axis=0) > 0.9
    labels = cv2.connectedComponents(always.astype(np.uint8), connectivity=4)[1]
    edge = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    dead = np.isin(labels, edge[edge > 0])
    live = ~dead
    if dead.mean() < FRAME or live.mean() < 0.02 or not (_is_around(dead) and _is_framed(live)):
        return None
    near = cv2.dilate(dead.astype(np.uint8), np.ones((5, 5)))  # blurred by JPEG and resampling
    ring = live & (cv2.dilate(near, np.ones((7, 7))) > 0) & (near == 0)
    filled = ~black[:, ring]
    shadowed = filled.mean(axis=1) < FILLED
    return float(dead.mean()) if ring.any() and shadowed.mean() <= MOST_SHADOW else None


def _is_around(dead: np.ndarray) -> bool:
    """Whether a black area (h, w) lies at both ends of the picture in like manner: in all corners,
    or in the middle of opposite sides. What is dark in the scene lies at one end."""
    h, w = dead.shape
    corners = dead[0, 0] and dead[0, -1] and dead[-1, 0] and dead[-1, -1]
    sides = (dead[h // 2, 0] and dead[h // 2, -1]) or (dead[0, w // 2] and dead[-1, w // 2])
    return bool(corners or sides)


def _is_framed(live: np.ndarray) -> bool:
    """Whether an area (h, w) has the shape of a picture inside a black frame: convex or nearly so,
    and as large as the photo in one direction; a rectangle that is most of the photo; or a window
    in the very middle, the same upside down."""
    contours, _ = cv2.findContours(live.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    largest = max(contours, key=cv2.contourArea)
    x, y, bw, bh = cv2.boundingRect(largest)
    h, w = live.shape
    area, hull = cv2.contourArea(largest), cv2.contourArea(cv2.convexHull(largest))
    across = (x <= 2 and x + bw >= w - 2) or (y <= 2 and y + bh >= h - 2)
    box = area > 0.97 * (bw - 1) * (bh - 1) and area > 0.4 * h * w
    filled = area / max((bw - 1) * (bh - 1), 1)
    middle = abs(2 * x + bw - w) <= CENTRED * w and abs(2 * y + bh - h) <= CENTRED * h
    window = middle and filled > 0.9 and _same_upside_down(live[y : y + bh, x : x + bw])
    return area > ROUND * max(hull, 1.0) and (across or box or window)


def _same_upside_down(area: np.ndarray) -> bool:
    other = area[::-1, ::-1]
    return bool((area & other).sum() > 0.97 * (area | other).sum())


def _smoothed(rgb: np.ndarray) -> np.ndarray:
    """sRGB values of a linear photo, blurred a little against noise."""
    return cv2.GaussianBlur(
        np.minimum(srgb_from_linear(rgb), 1.0), (0, 0), max(0.6, min(rgb.shape[:2]) / 600)
    )


def _border(shape: tuple[int, ...]) -> np.ndarray:
    n = max(2, round(BAND * min(shape[:2])))
    out = np.ones(shape[:2], bool)
    out[n:-n, n:-n] = False
    return out


def _border_colour(coded: np.ndarray) -> np.ndarray:
    return np.median(coded[_border(coded.shape)], axis=0)


def _distance(coded: np.ndarray, colour: np.ndarray) -> np.ndarray:
    return np.abs(coded - colour).max(axis=-1)


def _otsu(values: np.ndarray) -> float:
    """Otsu 1979: the threshold that splits values in [0, 1] into two classes with the largest
    variance between them."""
    counts, edges = np.histogram(values, bins=128, range=(0, 1))
    centres = (edges[:-1] + edges[1:]) / 2
    below, total = np.cumsum(counts), counts.sum()
    sums = np.cumsum(counts * centres)
    with np.errstate(invalid="ignore", divide="ignore"):
        between = (sums[-1] * below / total - sums) ** 2 / (below * (total - below))
    return float(centres[int(np.nanargmax(np.where(np.isfinite(between), between, np.nan)))])


def _cleaned(distance: np.ndarray, tolerance: float) -> np.ndarray:
    """Threshold, close gaps, drop specks, fill small holes: shadows inside the object, not the
    opening of a handle."""
    h, w = distance.shape
    mask = (distance > tolerance).astype(np.uint8)
    size = max(3, round(min(h, w) / 60)) | 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, disc)
    mask = cv2.morphologyEx(
        mask, cv2.MORPH_OPEN, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))
    )
    n, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    if n <= 1:
        return mask.astype(np.float32)
    area = stats[:, cv2.CC_STAT_AREA]
    largest = area[1:].max()
    keep = area >= 0.05 * largest
    keep[0] = False
    mask = keep[labels].astype(np.uint8)
    n, labels, stats, _ = cv2.connectedComponentsWithStats(1 - mask, connectivity=4)
    x, y, bw, bh = (stats[:, i] for i in range(4))
    closed = (x > 0) & (y > 0) & (x + bw < w) & (y + bh < h)
    fill = closed & (stats[:, cv2.CC_STAT_AREA] < 0.02 * largest)
    fill[0] = False  # label 0 is the mask itself
    return np.maximum(mask, fill[labels]).astype(np.float32)

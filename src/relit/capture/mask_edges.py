"""Whether a mask lies on the edges of its photo: decides between two orientations of equal shape."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np

from relit.images import turn_upright

CLEARER = 1.25  # times stronger edges along the outlines that decide between two orientations


def edge_strength(rgb: np.ndarray, labels: np.ndarray) -> float:
    """How much stronger the edges of a linear photo (h, w, 3) are along the borders of labels or of
    a mask (H, W) than elsewhere; 1 where they do not belong together."""
    gray = np.sqrt(np.maximum(rgb.mean(axis=-1), 0.0)).astype(np.float32)
    small = cv2.resize(labels.astype(np.float32), gray.shape[::-1], interpolation=cv2.INTER_NEAREST)
    slope = np.hypot(cv2.Sobel(gray, cv2.CV_32F, 1, 0), cv2.Sobel(gray, cv2.CV_32F, 0, 1))
    along = cv2.dilate(cv2.Laplacian(small, cv2.CV_32F) ** 2, np.ones((3, 3))) > 0
    return float(slope[along].mean() / max(slope.mean(), 1e-9)) if along.any() else 0.0


def is_turned(pairs: Iterable[tuple[np.ndarray, np.ndarray, int]]) -> bool:
    """Whether masks lie on the edges of their photos once EXIF's orientation is applied to them.
    pairs: (photo (h, w, 3), mask (H, W), orientation), of which those count whose shape stays."""
    here, turned = [], []
    for rgb, mask, orientation in pairs:
        other = turn_upright(mask, orientation)
        if orientation != 1 and other.shape == mask.shape:
            here.append(edge_strength(rgb, mask))
            turned.append(edge_strength(rgb, other))
    return bool(here) and float(np.mean(turned)) > CLEARER * float(np.mean(here))

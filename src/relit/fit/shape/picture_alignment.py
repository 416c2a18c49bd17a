"""A rendered picture laid on a photo: what a slightly wrong pose moves in the picture is taken out
before the two are compared."""

from __future__ import annotations

import cv2
import numpy as np

STEPS, SETTLED = (
    8,
    0.01,
)  # of Gauss-Newton at most, and pixels: a step that moves nothing by more is the last one
BLUR = 1.0  # pixels, standard deviation: of both pictures while they are laid on each other
DAMPING = 1e-6  # of the mean curvature, for pictures that do not tell some motion


def align_picture(picture: np.ndarray, photo: np.ndarray, where: np.ndarray) -> np.ndarray:
    """The similarity (2, 3), photo's pixels to the picture's, with which a picture (h, w, 3)
    differs least from a photo (h, w, 3) in the pixels `where` (h, w) bool; from one that is off by
    a pixel or two (Lucas & Kanade 1981, in all channels at once)."""
    found = np.eye(2, 3)
    picture, photo = (
        cv2.GaussianBlur(p.astype(np.float32), (0, 0), BLUR) for p in (picture, photo)
    )
    rows, columns = np.nonzero(where)
    if not len(rows):
        return found
    middle = np.array([columns.mean(), rows.mean()])
    x, y = columns - middle[0], rows - middle[1]
    size = max(np.hypot(x, y).max(), 1.0)
    zero, one = np.zeros_like(x), np.ones_like(x)
    motions = np.stack(
        [[one, zero], [zero, one], [-y / size, x / size], [x / size, y / size]], axis=-1
    )  # (2, P, 4): pixels at the rim
    for _ in range(STEPS):
        moved = moved_by(picture, found)
        slope = np.stack(
            [cv2.Sobel(moved, -1, *axes, scale=1 / 8)[where] for axes in ((1, 0), (0, 1))]
        )  # (2, P, 3)
        jacobian = np.einsum("apc,apk->pck", slope, motions).reshape(-1, 4)
        curvature = jacobian.T @ jacobian
        trust = DAMPING * (np.trace(curvature) / 4 + 1e-12) * np.eye(4)
        right, down, turn, grow = np.linalg.solve(
            curvature + trust, jacobian.T @ (photo - moved)[where].reshape(-1)
        )
        linear = np.array([[1 + grow / size, -turn / size], [turn / size, 1 + grow / size]])
        step = np.column_stack([linear, np.array([right, down]) + middle - linear @ middle])
        found = found @ np.vstack([step, [0, 0, 1]])
        if np.abs([right, down, turn, grow]).max() < SETTLED:
            break
    return found


def moved_by(picture: np.ndarray, similarity: np.ndarray) -> np.ndarray:
    """(h, w, 3) float32: at each pixel what the picture (h, w, 3) shows where the similarity (2, 3)
    takes that pixel."""
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(
        picture.astype(np.float32),
        similarity,
        picture.shape[1::-1],
        flags=flags,
        borderMode=cv2.BORDER_REPLICATE,
    )

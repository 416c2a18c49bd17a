"""Features of a vision transformer (DINO) on the surface: PIR Sec. 3.5, Eq. 7.

The network is an ONNX file of the usual signature: one picture (1, 3, H, W), normalised as
ImageNet's, to tokens (1, P, C) or (1, 1 + P, C) with the class token first, or a map (1, C, h, w).
It runs in OpenCV. Pictures are enlarged twice before (Sec. 3.5).

Eq. 7 asks for the features on the surface that lie nearest to those of the photos. Where the
features of a place are free, as a texture's
are, that is the mean over the photos that show it: no network has to be trained. The first
principal components stand for them.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from relit.capture.networks import Network, first_line
from relit.conventions import srgb_from_linear
from relit.errors import EXIT_ENVIRONMENT, UserError
from relit.scene import Camera

ENLARGED = 2
MULTIPLE = 112  # sides are multiples of it: of 8, 14 and 16, the patches of the common networks
LARGEST = 896  # side, in pixels: the cost grows with its fourth power
KEPT = 4  # principal components
SCALE = 0.25  # standard deviation of the first, in the units of a displayed colour
HUB = "hub:"


class DinoNetwork:
    """The network in memory. Raises UserError for files that OpenCV cannot read."""

    def __init__(self, file: str | Path):
        self.network = Network(file)

    def features(self, rgb: np.ndarray) -> np.ndarray:
        """(H, W, 3) linear -> (h, w, C) float32, one row and column for each patch."""
        side = ENLARGED * max(rgb.shape[:2])
        side = int(np.clip(round(side / MULTIPLE) * MULTIPLE, MULTIPLE, LARGEST))
        shown = cv2.resize(
            np.clip(srgb_from_linear(rgb), 0, 1).astype(np.float32),
            (side, side),
            interpolation=cv2.INTER_CUBIC,
        )
        out = self.network.run(shown)
        tokens = token_map(out)
        if tokens is None:
            raise self.network.strange(
                out, "tokens (1, 1 + P, C) of a square picture or a map (1, C, h, w)"
            )
        return tokens


def token_map(out: np.ndarray) -> np.ndarray | None:
    """The network's output as (h, w, C): tokens of a square picture, or a map as it is. None for
    other shapes."""
    if out.ndim == 4 and out.shape[0] == 1:
        return out[0].transpose(1, 2, 0)
    if out.ndim == 3 and out.shape[0] == 1:
        for first in (0, 1, 5):  # nothing, the class token, and four registers besides
            h = round(np.sqrt(max(out.shape[1] - first, 0)))
            if h > 0 and h * h == out.shape[1] - first:
                return out[0, first:].reshape(h, h, -1)
    return None


def network_file(setting: str) -> Path:
    """The file that a setting names: a path, or `hub:OWNER/NAME/PATH`, which is fetched and kept by
    the hub's own client."""
    if not setting.startswith(HUB):
        return Path(setting)
    parts = setting[len(HUB) :].split("/")
    if len(parts) < 3:
        raise UserError(
            f"'{setting}' names no file on the hub", fix="write hub:OWNER/NAME/PATH.onnx", code=2
        )
    try:
        from huggingface_hub import hf_hub_download  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise UserError(
            "fetching a network needs an optional package",
            "huggingface_hub is not installed",
            "pip install huggingface_hub, or give the path of an ONNX file",
            code=EXIT_ENVIRONMENT,
        ) from None
    try:
        return Path(hf_hub_download("/".join(parts[:2]), "/".join(parts[2:])))
    except (
        Exception
    ) as error:  # whatever the client raises without a network or for a name that is not there
        raise UserError(
            f"'{setting}' could not be fetched",
            first_line(error),
            "give the path of an ONNX file",
            code=EXIT_ENVIRONMENT,
        ) from None


def dino_features(
    network: DinoNetwork, photos, cameras: list[Camera], places, count: int, views: int = 30
) -> tuple[np.ndarray, np.ndarray]:
    """Features of `count` places of the surface: (count, KEPT) float32, 0 where unseen; seen
    (count,) bool.

    photos(view) -> (H, W, 3) linear. places(view) -> (column, row, weight), (count,) each: where
    the photo shows the places, pixels, and how much it counts there, 0 where it does not. views:
    photos that are looked at, evenly spread.
    """
    total, weights = None, np.zeros(count)
    for view in np.unique(
        np.linspace(0, len(cameras) - 1, min(views, len(cameras))).round().astype(int)
    ):
        tokens = network.features(photos(int(view)))
        column, row, weight = places(int(view))
        camera = cameras[view]
        x = (column / camera.width * tokens.shape[1] - 0.5).astype(np.float32)
        y = (row / camera.height * tokens.shape[0] - 0.5).astype(np.float32)
        total = np.zeros((count, tokens.shape[2])) if total is None else total
        at = np.flatnonzero(weight > 0)
        total[at] += weight[at, None] * sampled(tokens, x[at], y[at])
        weights += weight
    seen = weights > 0
    return principal(total / np.maximum(weights, 1e-9)[:, None], seen), seen


def sampled(picture: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Bilinear look-up of (h, w, C) at pixel centres x, y (N,): (N, C)."""
    h, w = picture.shape[:2]
    x, y = np.clip(x, 0, w - 1), np.clip(y, 0, h - 1)
    i, j = np.minimum(y.astype(int), max(h - 2, 0)), np.minimum(x.astype(int), max(w - 2, 0))
    a, b = (y - i)[:, None], (x - j)[:, None]
    i2, j2 = np.minimum(i + 1, h - 1), np.minimum(j + 1, w - 1)
    return (1 - a) * ((1 - b) * picture[i, j] + b * picture[i, j2]) + a * (
        (1 - b) * picture[i2, j] + b * picture[i2, j2]
    )


def principal(features: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """The first KEPT principal components of the seen rows, scaled together so that the first has
    the deviation SCALE."""
    out = np.zeros((len(features), KEPT), np.float32)
    if seen.sum() < 2:
        return out
    some = features[seen] - features[seen].mean(0)
    values, vectors = np.linalg.eigh(some.T @ some / len(some))
    k = min(KEPT, len(values))
    part = some @ vectors[:, ::-1][:, :k]
    out[seen, :k] = part * (SCALE / max(np.sqrt(max(values[-1], 0)), 1e-9))
    return out

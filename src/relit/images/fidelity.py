"""Peak signal-to-noise ratio of pictures, as `evaluate` and the truth of captures report it."""

from __future__ import annotations

import numpy as np

from relit.conventions import srgb_from_linear

MASK = 0.99  # truth coverage from which a pixel counts as inside: rims mix object and background


def encode(linear):
    """Linear -> sRGB clipped to [0, 1], what every picture figure is taken on."""
    return srgb_from_linear(np.clip(linear, 0.0, 1.0))


def psnr(a, b, where=None, peak: float = 1.0) -> float:
    """Peak signal-to-noise ratio in dB of two arrays in the space they are given in.

    where: (H, W) bool, the pixels that count, or None for all. Equal arrays give 100, the largest
    figure returned; no pixel at all gives nan.
    """
    error = np.square(np.asarray(a, np.float64) - np.asarray(b, np.float64))
    if where is not None:
        error = error[np.asarray(where, bool)]
    if error.size == 0:
        return float("nan")
    return float(min(100.0, 10 * np.log10(peak**2 / max(error.mean(), 1e-12))))

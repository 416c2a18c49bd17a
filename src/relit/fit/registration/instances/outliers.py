"""Instances that stand out after the first volume pass: what they show does not agree with the
model of all.

An instance that is mostly hidden can be placed wrongly and still agree with the coarse models of
the search. The volume pass then paints what it shows onto the object, and its silhouette bends the
shape. Against the finished model its pixels are wrong by several times what the others' are (wrong
by 101 degrees: 6.3 times their median; the other 19 of that pile at most 1.7), so it can be told
and left out.
"""

from __future__ import annotations

import numpy as np

from relit.fit.passes.pixels import PixelBank
from relit.fit.passes.ray_errors import ray_errors
from relit.fit.passes.volume import VolumeModel

ODD = 4.0  # times the median error of all instances
LEAST = 8  # instances: of fewer each is needed for the shape, and their median tells little
MOST = 0.2  # of the instances can be odd
PROBES = 200_000  # rays


def odd_instances(errors: np.ndarray) -> np.ndarray:
    """(N,) bool: whose error (see `view_errors`) is more than ODD times the median; none where that
    were more than MOST of all."""
    odd = errors > ODD * np.nanmedian(errors)
    return odd if len(errors) >= LEAST and odd.mean() <= MOST else np.zeros_like(odd)


def view_errors(bank: PixelBank, model: VolumeModel, seed: int = 0) -> np.ndarray:
    """(views,) mean squared difference of display values over whole pixels of the object; NaN where
    a view has none."""
    rays = ray_errors(bank, model, PROBES, seed)
    value, view = rays.value[rays.whole], rays.view[rays.whole]
    total, count = (np.bincount(view, w, bank.views) for w in (value, np.ones_like(value)))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)

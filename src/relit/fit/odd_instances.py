"""Instances that stand out after the volume pass: what they show does not agree with the model of all.

An instance that is mostly hidden can be placed wrongly and still agree with the coarse models of the search. The volume pass then paints
what it shows onto the object, and its silhouette bends the shape. Against the finished model its pixels are wrong by several times what
the others' are (wrong by 101 degrees: 6.3 times their median; the other 19 of that pile at most 1.7), so it can be told and left out.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from relit.fit.losses import display_weight
from relit.fit.pixels import PixelBank, batch_of
from relit.fit.volume import VolumeModel
from relit.rendering.march import march, sphere_interval

ODD = 4.0  # times the median error of all instances
LEAST = 8  # instances: of fewer each is needed for the shape, and their median tells little
MOST = 0.2  # of the instances can be odd
PROBES = 200_000  # rays


def odd_instances(bank: PixelBank, model: VolumeModel, seed: int = 0) -> np.ndarray:
    """(views,) bool: whose whole pixels have more than ODD times the median squared error; none where that were more than MOST of all."""
    error = view_errors(bank, model, seed)
    odd = error > ODD * np.nanmedian(error)
    return odd if bank.views >= LEAST and odd.mean() <= MOST else np.zeros_like(odd)


def view_errors(bank: PixelBank, model: VolumeModel, seed: int = 0) -> np.ndarray:
    """(views,) mean squared difference of display values over whole pixels of the object; NaN where a view has none."""
    rng = mi.PCG32(size=PROBES, initstate=seed + 177)
    with dr.suspend_grad():
        k = dr.minimum(mi.UInt32(rng.next_float32() * dr.width(bank.candidates)), dr.width(bank.candidates) - 1)
        batch = batch_of(bank, dr.gather(mi.UInt32, bank.candidates, k), bank.corrections)
        t0, t1 = sphere_interval(batch.o, batch.d)
        dr.eval(batch.o, batch.d, batch.rgb, batch.mask, batch.view, t0, t1)
        m = march(model.grid, batch.o, batch.d, t0, t1, dr.opaque(mi.Float, model.inv_s), dr.opaque(mi.Float, model.grid.h))
        colour, _ = model.shade(m, batch, bank.cameras)
        r = dr.square(colour - batch.rgb) * display_weight(batch.rgb)
        value, whole, view = np.array((r.x + r.y + r.z) / 3), np.array(batch.mask) > 0.99, np.array(batch.view)
    total, count = (np.bincount(view[whole], w, bank.views) for w in (value[whole], np.ones(whole.sum())))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)

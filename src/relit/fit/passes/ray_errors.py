"""What a volume model explains badly, ray by ray."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from relit.fit.passes.losses import display_weight
from relit.fit.passes.pixels import PixelBank, batch_of, drawn_from
from relit.fit.passes.volume import VolumeModel
from relit.rendering.march import march, sphere_interval


@dataclass
class RayErrors:
    """value: (N,) squared difference of display values, mean over channels. whole: (N,) bool, the
    pixel is all object. hit: (N,) bool, it is, and the ray meets the surface. x: (N, 3) where, unit
    frame. view: (N,)."""

    value: np.ndarray
    whole: np.ndarray
    hit: np.ndarray
    x: np.ndarray
    view: np.ndarray


def ray_errors(bank: PixelBank, model: VolumeModel, count: int, seed: int) -> RayErrors:
    """Of `count` drawn rays of the object's pixels, the same for the same seed, from the cameras as
    they have been corrected."""
    rng = mi.PCG32(size=count, initstate=seed + 77)
    with dr.suspend_grad():
        batch = batch_of(bank, drawn_from(bank.candidates, rng), bank.corrections)
        t0, t1 = sphere_interval(batch.o, batch.d)
        dr.eval(batch.o, batch.d, batch.rgb, batch.mask, batch.view, t0, t1)
        m = march(
            model.grid,
            batch.o,
            batch.d,
            t0,
            t1,
            dr.opaque(mi.Float, model.inv_s),
            dr.opaque(mi.Float, model.grid.h),
        )
        colour, _ = model.shade(m, batch, bank.cameras)
        r = dr.square(colour - batch.rgb) * display_weight(batch.rgb)
        value, whole = (r.x + r.y + r.z) / 3, batch.mask > 0.99
        hit = (m.opacity > 0.5) & whole & dr.isfinite(value)
        x = m.surface_point(batch.o, batch.d)
        return RayErrors(
            np.array(value), np.array(whole), np.array(hit), np.array(x).T, np.array(batch.view)
        )

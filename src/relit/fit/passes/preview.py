"""Pictures of a fit that is under way, for `relit view RUN`: a photo, and what stands for it now,
side by side."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from relit.fit.passes.pixels import PixelBank, RayBatch, batch_of
from relit.rendering.march import march, sphere_interval
from relit.rendering.transport import first_hits

SIDE = 200  # pixels, longer side of one picture


def photo_pixels(bank: PixelBank) -> tuple[np.ndarray, int, int]:
    """Every k-th pixel of the first photo of the bank: flat numbers (h * w,) uint32, h, w; at most
    SIDE a side."""
    width, end = int(bank.widths[0]), int(bank.offsets[1]) if bank.views > 1 else bank.total
    height = end // width
    k = -(-max(width, height) // SIDE)
    rows, columns = np.arange(k // 2, height, k), np.arange(k // 2, width, k)
    return (rows[:, None] * width + columns).astype(np.uint32).ravel(), len(rows), len(columns)


def volume_preview(
    bank: PixelBank, model, step: float, corrections=None
) -> Callable[[], np.ndarray]:
    """Photo, and the volume model from its camera. step: of the march, in cells. corrections: those
    of `bank`, when they are fitted."""
    pixel, h, w = photo_pixels(bank)

    def picture() -> np.ndarray:
        batch = batch_of(bank, mi.UInt32(pixel), None if corrections is None else corrections())
        t0, t1 = sphere_interval(batch.o, batch.d)
        inv_s, dt = dr.opaque(mi.Float, model.inv_s), dr.opaque(mi.Float, step * model.grid.h)
        dr.eval(batch.o, batch.d, batch.rgb, t0, t1)
        m = march(model.grid, batch.o, batch.d, t0, t1, inv_s, dt)
        colour, _ = model.shade(
            m, RayBatch(batch.o, batch.d, None, None, batch.view, batch.pixel), bank.cameras
        )
        return side_by_side([batch.rgb, dr.select(t1 > t0, dr.detach(colour), 0)], h, w)

    return picture


def surface_preview(bank: PixelBank, mesh, textures: Callable) -> Callable[[], np.ndarray]:
    """Photo, and textures on the mesh from its camera. textures: (uv, valid) -> [Color3f or Float,
    ...]."""
    pixel, h, w = photo_pixels(bank)

    def picture() -> np.ndarray:
        batch = batch_of(bank, mi.UInt32(pixel))
        points = first_hits(mesh, batch.o, batch.d)
        dr.eval(points, batch.rgb)
        return side_by_side(
            [
                batch.rgb,
                *(
                    dr.select(points.valid, mi.Color3f(t), 0)
                    for t in textures(points.uv, points.valid)
                ),
            ],
            h,
            w,
        )

    return picture


def side_by_side(parts: list, height: int, width: int) -> np.ndarray:
    """(height, parts * width, 3) linear. The first part, a photo, is exposed to the range of the
    display where it leaves it."""
    pictures = [np.array(p).T.reshape(height, width, 3) for p in parts]
    bright = float(np.quantile(pictures[0], 0.99))
    if not 0.2 < bright < 1.5:
        pictures[0] = pictures[0] * (0.9 / max(bright, 1e-6))
    return np.concatenate(pictures, 1)

"""The Gaussian-pyramid and SSIM terms of PIR Eq. 9, on square patches of SIDE pixels (IRON's
losses; the paper's patches have 128).

The pixels of a patch follow each other along a Z curve, so that 4, 16 and 64 neighbours in the
array are squares of 2, 4 and 8 pixels: the pyramid's levels are means over blocks. Both terms take
two independent estimates of radiance, so that noise does not count as error: squares are products
of the two residuals, the variance of the estimate is the covariance of its two halves.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from relit.fit.passes.losses import display_weight
from relit.fit.passes.pixels import PixelBank, draw_pixels, locate

SIDE, LEVELS = 8, 3
C1, C2 = 0.01**2, 0.03**2  # of SSIM, for display values of at most 1
DARK = 1e-3  # added before the power: its slope is finite at black


def even_bits(k):
    """Every second bit of a UInt32 below 64, packed: x of the Z curve; of k // 2: y."""
    return (k & 1) | ((k >> 1) & 2) | ((k >> 2) & 4)


def draw_patches(bank: PixelBank, rng, count: int):
    """Flat numbers (UInt32, `count`, a multiple of SIDE^2) of the pixels of patches that begin at
    random candidates, moved inside their photo. rng: evaluated PCG32 of size `count`."""
    if count % SIDE**2:
        raise ValueError(f"count must be a multiple of {SIDE**2}")
    first = dr.arange(mi.UInt32, count // SIDE**2) * SIDE**2
    corner = dr.gather(mi.UInt32, draw_pixels(bank, rng, count), first)
    view, x, y = locate(bank, corner)
    width = dr.maximum(
        dr.gather(mi.UInt32, bank.widths, view), 1
    )  # as in `locate`: unused lanes of a vector register
    offset = dr.gather(mi.UInt32, bank.offsets, view)
    last = view + 1 >= bank.views
    end = dr.select(
        last, bank.total, dr.gather(mi.UInt32, bank.offsets, dr.minimum(view + 1, bank.views - 1))
    )
    height = (end - offset) // width
    start = offset + dr.minimum(y, height - SIDE) * width + dr.minimum(x, width - SIDE)
    dr.eval(start, width)
    k = dr.arange(mi.UInt32, count)
    patch, inside = k // SIDE**2, k % SIDE**2
    step = even_bits(inside >> 1) * dr.gather(mi.UInt32, width, patch) + even_bits(inside)
    return dr.gather(mi.UInt32, start, patch) + step


def pyramid_loss(a, b, target, weight):
    """Sum over LEVELS coarser levels of the mean of r_a r_b, where r is the residual in units of a
    display value, averaged over blocks.

    a, b, target: Color3f in patch order. weight: Float, 0 where a pixel does not count.
    """
    scale = dr.sqrt(display_weight(target)) * weight
    total = mi.Float(0)
    halves = [(a - target) * scale, (b - target) * scale]
    for level in range(1, LEVELS + 1):
        n = 4**level
        pooled = [
            mi.Color3f(*[dr.block_reduce(dr.ReduceOp.Add, c, n) for c in h]) / n for h in halves
        ]
        product = pooled[0] * pooled[1]
        total += dr.mean(product.x + product.y + product.z) / 3
    return total


def ssim_loss(a, b, target, valid):
    """Mean of (1 - SSIM) / 2 over patches all of whose pixels are valid, from display values; one
    window per patch, evenly weighted."""
    n = SIDE**2
    shown = lambda c: (dr.maximum(c, 0) + DARK) ** (1 / 2.2)  # noqa: E731
    mean = lambda v: dr.block_reduce(dr.ReduceOp.Add, v, n) / n  # noqa: E731
    whole = dr.block_reduce(dr.ReduceOp.Add, dr.select(valid, mi.Float(1), 0), n) > n - 0.5
    total = mi.Float(0)
    for p, q, t in zip(a, b, target, strict=True):
        p, q, t = shown(p), shown(q), shown(t)
        mp, mq, mt = mean(p), mean(q), mean(t)
        m = (mp + mq) * 0.5
        variance = dr.maximum(mean(p * q) - mp * mq, 0)
        covariance = mean((p + q) * t) * 0.5 - m * mt
        ssim = (2 * m * mt + C1) * (2 * covariance + C2)
        ssim /= (dr.square(m) + dr.square(mt) + C1) * (variance + mean(t * t) - dr.square(mt) + C2)
        total += dr.select(whole, (1 - ssim) * 0.5, 0)
    return dr.sum(total) / (3 * dr.maximum(dr.sum(dr.select(whole, mi.Float(1), 0)), 1))

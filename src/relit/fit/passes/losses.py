"""Loss terms on per-ray Dr.Jit arrays. Each returns a Float of width 1."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from relit.fit.passes.pixels import SATURATED


def display_weight(target, eps: float = 0.02):
    """Weight of a squared difference of radiance that makes it nearly one of display values: (L* +
    eps)^-1.1, the slope of L^(1/2.2) squared.

    From the photo, never from the estimate: a weight that follows the estimate prefers dark ones,
    which eats a quarter of a pixel off every bright silhouette and darkens noisy renderings.
    target: Color3f, linear.
    """
    return dr.rcp(mi.Color3f(target) + eps) ** 1.1


def display_loss(radiance, target, active=None):
    """Mean over rays and channels of display_weight (L - L*)^2. radiance, target: Color3f, linear.
    active: Bool or None."""
    r = dr.square(radiance - target) * display_weight(target)
    value = (r.x + r.y + r.z) / 3
    if active is not None:
        value = dr.select(active, value, 0)
    return dr.mean(value)


def mask_loss(opacity, mask):
    """Binary cross-entropy between the opacity of a ray and the mask (SfD Eq. 4, E_mask); the
    logarithms are bounded at 1e-3."""
    a = dr.clip(opacity, 1e-3, 1 - 1e-3)
    return -dr.mean(mask * dr.log(a) + (1 - mask) * dr.log(1 - a))


def normal_loss(normal, prior, weight):
    """SfD Eq. (4) E_normal: weighted mean of |1 - n·n̂| + |n̂ - n|_1 for unit normals
    (Vector3f)."""
    difference = dr.abs(normal - prior)
    value = dr.abs(1 - dr.dot(normal, prior)) + difference.x + difference.y + difference.z
    return dr.mean(value * weight)


def weighted_mean(value, weight):
    """Σ w v / Σ w."""
    return dr.sum(value * weight) / dr.maximum(dr.sum(mi.Float(weight)), 1e-6)


def dual_loss(a, b, target, valid, saturated=SATURATED):
    """Mean of `dual_values` over valid points."""
    return weighted_mean(dual_values(a, b, target, saturated), dr.select(valid, mi.Float(1), 0))


def dual_values(a, b, target, saturated=SATURATED):
    """display_weight (a - L*)(b - L*), mean over channels (Float); a and b are independent
    estimates of L, so this is unbiased for the squared error. A pixel from `saturated` (float or
    Float) on only says "at least this bright"."""
    value = (a - target) * (b - target) * display_weight(target)
    mean = dr.detach((a + b) * 0.5)
    value = dr.select((target >= saturated) & (mean > target), 0, value)
    return (value.x + value.y + value.z) / 3

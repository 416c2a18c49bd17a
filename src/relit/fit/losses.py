"""Loss terms on per-ray Dr.Jit arrays. Each returns a Float of width 1."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def composite_loss(radiance, target, active=None, eps: float = 0.1):
    """Mean over rays and channels of ((L - L*) / (sg(L) + eps))^2: relative, so that it is close to a difference of display values.

    radiance, target: Color3f, linear. active: Bool or None.
    """
    r = (radiance - target) / (dr.detach(radiance) + eps)
    value = (dr.square(r.x) + dr.square(r.y) + dr.square(r.z)) / 3
    if active is not None:
        value = dr.select(active, value, 0)
    return dr.mean(value)


def mask_loss(opacity, mask):
    """Binary cross-entropy between the opacity of a ray and the mask (SfD Eq. 4, E_mask); the logarithms are bounded at 1e-3."""
    a = dr.clip(opacity, 1e-3, 1 - 1e-3)
    return -dr.mean(mask * dr.log(a) + (1 - mask) * dr.log(1 - a))


def normal_loss(normal, prior, weight):
    """SfD Eq. (4) E_normal: weighted mean of |1 - n·n̂| + |n̂ - n|_1 for unit normals (Vector3f)."""
    difference = dr.abs(normal - prior)
    value = dr.abs(1 - dr.dot(normal, prior)) + difference.x + difference.y + difference.z
    return dr.mean(value * weight)


def weighted_mean(value, weight):
    """Σ w v / Σ w."""
    return dr.sum(value * weight) / dr.maximum(dr.sum(mi.Float(weight)), 1e-6)

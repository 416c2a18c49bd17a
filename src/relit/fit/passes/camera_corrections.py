"""What all cameras of a fit have in common: a similarity of the whole scene, which no photo tells.

Shape and cameras, turned, moved or grown together, give the same pictures. Left free, this common
motion drifts by a little with every
step, and the shape, which is bound to its grid, is dragged behind it: from true poses ten instances
of an object ended .6 degree off, and the farther the longer the pass was. Taken out at every step
the same pass stays within .3 degree.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from relit.fit.passes.pixels import CAMERA_FLOATS


def without_common_motion(corrections, cameras):
    """The corrections (Float; `fit.passes.pixels.rays_through`, six to eight a view) without the small
    turn, growth and shift that they share. What cameras are to each other stays, but for terms of
    second order. cameras: as `PixelBank.cameras`."""
    views = dr.width(cameras) // CAMERA_FLOATS
    each, k = dr.width(corrections) // views, dr.arange(mi.UInt32, views)
    w, t = (
        mi.Vector3f(*[dr.gather(mi.Float, corrections, k * each + first + j) for j in range(3)])
        for first in (0, 3)
    )
    o = mi.Vector3f(*[dr.gather(mi.Vector4f, cameras, k * 4 + j).w for j in (1, 2, 3)])
    turn = _mean(w)
    w = w - turn
    if each == 6:  # these turn each camera about itself, and a turn of the scene moves it as well
        t = t - dr.cross(turn, o)
    spread = o - _mean(o)
    growth = dr.mean(dr.dot(t - _mean(t), spread)) / dr.maximum(
        dr.mean(dr.squared_norm(spread)), 1e-12
    )
    t = t - growth * o
    t = t - _mean(t)
    out = mi.Float(corrections)
    for first, vector in ((0, w), (3, t)):
        for j in range(3):
            dr.scatter(out, vector[j], k * each + first + j)
    if each == 8:
        log_distance = dr.gather(mi.Float, corrections, k * each + 7)
        dr.scatter(out, log_distance - dr.mean(log_distance), k * each + 7)
    return out


def _mean(v):
    return mi.Vector3f(*[dr.mean(c) for c in v])

"""Deferred appearance of the volume pass for collections: one object, each photo under a light of
its own.

radiance = diffuse(x) exp(A_v(n)) + tint(x) exp(B_v(r)), with nine spherical harmonics per channel
for each photo v: A over the normal, B over the mirrored view direction, both in the object's frame.
It explains most of what one photo's light does to the shading, which thereby tells of the shape;
the light proper is found later, on the mesh.

Feature channels as in rendering/appearance/fixed_light.py. What is learnt besides, in one flat
array: for each photo 9 x 3 coefficients of A, then of B.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from relit.rendering.appearance.world_light import device_harmonics
from relit.rendering.march import Marched

EACH = 54  # numbers a photo
RATE = 0.3  # of the pass's rate of what is learnt besides the features


def start_photo_lights(tints: np.ndarray, grey: float) -> tuple:
    """(learnt, rates). tints: (V, 3) mean colour of the object in each photo; grey: the features'
    own mean."""
    learnt = np.zeros((len(tints), 2, 9, 3), np.float32)
    learnt[:, 0, 0] = np.log(np.maximum(tints, 1e-4) / grey)
    learnt[:, 1, 0] = np.log(np.maximum(tints, 1e-4))
    return mi.Float(learnt.ravel()), mi.Float(np.full(learnt.size, RATE, np.float32))


def shade_photos(m: Marched, rays, cameras, learnt):
    """The appearance itself: see `fit.volume.VolumeModel.appearance`."""
    F, d = m.features, rays.d
    n = m.unit_normal
    r = d - 2 * dr.dot(d, n) * n
    first = rays.view * (EACH // 3)

    def light(direction, offset):
        y, log = device_harmonics(direction), mi.Color3f(0)
        for k in range(9):
            log += y[k] * dr.gather(mi.Color3f, learnt, first + (offset + k))
        return dr.exp(dr.clip(log, -8, 5))

    diffuse = mi.Color3f(dr.maximum(F[0], 0), dr.maximum(F[1], 0), dr.maximum(F[2], 0))
    return diffuse * light(n, 0) + dr.maximum(F[3], 0) * light(r, 9), n


def shade_plain(m: Marched, rays, cameras, learnt):
    """The object's colours without any photo's light: what registration compares."""
    F = m.features
    return mi.Color3f(
        *[dr.maximum(F[k], 0) + 0.3 * dr.maximum(F[3], 0) for k in range(3)]
    ), m.normal

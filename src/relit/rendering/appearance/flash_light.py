"""Deferred appearance of the volume pass under a flash: rough plastic at the rendered surface
point, lit from o + Δo (PIR Eq. 2 and 4).

No view-independent colour explains such photos: each is lit anew. Feature channels: 0-2 diffuse
albedo, 3 specular albedo, both up to the common factor that they share with the flash's intensity,
which is fixed here. What is learnt besides, in one flat array: the offset Δo (3 entries) and the
lobe's width alpha on a coarse grid over the unit cube, looked up once a ray.

Shadows are soft visibility (Eq. 5): the field's transmittance along the ray from the surface point
to the light, with gradients to the field and to the light's place. Inter-reflection is what
`Around` tells, a constant of the pass; the exact term is the surface pass's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from relit.lighting.flash import incident, light_position
from relit.materials.field import nearest_texel
from relit.materials.rough_plastic import MIN_ALPHA, Coat, Plastic, base_radiance, evaluate_plastic
from relit.rendering.blocks import everywhere
from relit.rendering.march import Marched, march, sphere_interval

NODES = 24  # of the alpha grid, a side
START_ALPHA = 0.25
OFFSET_RATE, ALPHA_RATE = 0.05, 0.08  # of the pass's rate of what is learnt besides the features
LEAVE = 3.0  # voxels along the normal before the shadow ray begins


@dataclass(frozen=True)
class Around:
    """Irradiance from the surface itself over the flash's intensity. light: Float [views * places *
    3]. place: UInt32 [nodes^3], which place a node of a grid over the unit cube takes its light
    from. nodes: a side. places: their number. enters: share of it that enters the coat."""

    light: Any
    place: Any
    nodes: int
    places: int
    enters: float

    def at(self, view, x):
        """Color3f at unit-frame points."""
        q = [
            mi.UInt32(dr.clip((c * 0.5 + 0.5) * (self.nodes - 1) + 0.5, 0, self.nodes - 1))
            for c in (x.x, x.y, x.z)
        ]
        place = dr.gather(mi.UInt32, self.place, (q[2] * self.nodes + q[1]) * self.nodes + q[0])
        return dr.gather(mi.Color3f, self.light, view * self.places + place)


@dataclass(frozen=True)
class AroundTexels:
    """The same on a texture. place: UInt32 [size^2], which place a texel takes its light from.
    size: texels a side."""

    light: Any
    place: Any
    size: int
    places: int
    enters: float

    def at(self, view, uv):
        """Color3f at texture coordinates."""
        place = dr.gather(mi.UInt32, self.place, nearest_texel(self, uv))
        return dr.gather(mi.Color3f, self.light, view * self.places + place)


class FlashAppearance:
    """The function itself, with what it needs: see `fit.volume.VolumeModel.appearance`. intensity:
    radiant, grey, unit frame.

    shadows_from: nodes a side from which on visibility is computed. model: the VolumeModel whose
    field it is. A plain class: Dr.Jit would carry a dataclass through its loops."""

    def __init__(self, coat: Coat, intensity: float, shadows_from: float = np.inf):
        self.coat, self.intensity = coat, dr.opaque(mi.Float, intensity)
        self.shadows_from, self.model, self.around = shadows_from, None, None

    def __call__(self, m: Marched, rays, cameras, learnt):
        F = m.features
        n = m.unit_normal
        x = m.surface_point(rays.o, rays.d)
        offset = everywhere(mi.Vector3f, learnt, 0, dr.width(x))
        position = light_position(cameras, rays.view, offset)
        l, inverse = incident(position, x)
        alpha = alpha_at(learnt, x)
        diffuse, specular = mi.Color3f(*[dr.maximum(f, 0) for f in F[:3]]), dr.maximum(F[3], 0)
        value = evaluate_plastic(Plastic(diffuse, specular, alpha), self.coat, n, -rays.d, l) * (
            inverse * self.intensity
        )
        if self.model.grid.n >= self.shadows_from:
            value *= self.visibility(dr.detach(x), dr.detach(n), position, m)
        if self.around is not None:
            entered = self.around.at(rays.view, dr.detach(x)) * (
                self.intensity * self.around.enters
            )
            value += base_radiance(diffuse, self.coat, dr.abs(dr.dot(n, rays.d)), alpha, entered)
        return value, n

    def visibility(self, x, n, position, m: Marched):
        """PIR Eq. (5): f_v = 1 - Σ α_j Π (1 - α_k), from LEAVE voxels above the surface to the
        light."""
        grid = self.model.grid
        inv_s, dt = dr.opaque(mi.Float, self.model.inv_s), dr.opaque(mi.Float, grid.h)
        start = x + n * (LEAVE * grid.h)
        to = position - start
        d = dr.normalize(to)
        with dr.suspend_grad():
            t0, t1 = sphere_interval(start, dr.detach(d))
            t1 = dr.select((dr.detach(m.opacity) > 0.5) & (dr.dot(n, dr.detach(d)) > 0.05), t1, 0)
        dr.eval(t0, t1)
        return march(grid, start, d, t0, t1, inv_s, dt).transmittance


def alpha_at(learnt, x):
    """Trilinear look-up of the alpha grid at unit-frame points (Float); differentiable in `learnt`
    and x."""
    q = [dr.clip((c * 0.5 + 0.5) * (NODES - 1), 0, NODES - 1.001) for c in (x.x, x.y, x.z)]
    low = [mi.UInt32(dr.detach(c)) for c in q]
    f = [c - mi.Float(k) for c, k in zip(q, low, strict=True)]
    base = (low[2] * NODES + low[1]) * NODES + low[0] + 3
    out = mi.Float(0)
    for dz in (0, 1):
        for dy in (0, 1):
            for dx in (0, 1):
                w = (
                    (f[0] if dx else 1 - f[0])
                    * (f[1] if dy else 1 - f[1])
                    * (f[2] if dz else 1 - f[2])
                )
                out = dr.fma(
                    w, dr.gather(mi.Float, learnt, base + (dz * NODES + dy) * NODES + dx), out
                )
    return dr.clip(out, MIN_ALPHA, 1)


def start_learnt(offset=(0.0, 0.0, 0.0)):
    """(learnt, rates): the flat array at the start, and each entry's rate."""
    values = np.concatenate(
        [np.asarray(offset, np.float32), np.full(NODES**3, START_ALPHA, np.float32)]
    )
    rates = np.concatenate([np.full(3, OFFSET_RATE), np.full(NODES**3, ALPHA_RATE)])
    return mi.Float(values.astype(np.float32)), mi.Float(rates.astype(np.float32))


def alpha_on(learnt: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(N,) float32: the alpha grid at unit-frame points (N, 3)."""
    from scipy.ndimage import map_coordinates

    grid = np.asarray(learnt)[3:].reshape(NODES, NODES, NODES)
    at = (np.asarray(points, np.float64)[:, ::-1] * 0.5 + 0.5) * (NODES - 1)
    return np.clip(map_coordinates(grid, at.T, order=1, mode="nearest"), MIN_ALPHA, 1).astype(
        np.float32
    )

"""What lies outside the object sphere: a coarse radiance field in contracted space, for photos
without masks.

Points are contracted as in mip-NeRF 360 (Barron et al. 2022, Eq. 10) with the object sphere as the
unit ball: c(x) = x for |x| <= 1, (2 - 1/|x|) x/|x| beyond, so all of space fits a ball of radius 2.
The field is a dense grid of (log density, RGB), sampled at depths that are uniform in 1/distance.
Emission and absorption, no shading.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from relit.rendering.blocks import block_sums

FOG = 0.9  # radius of the fog at the start, unit frame


@dataclass
class Background:
    """n: nodes a side over [-2, 2]^3. cells: Float [n^3 * 4], (density before softplus, RGB before
    exp). samples: per ray."""

    n: int
    cells: Any
    samples: int


def start_background(n: int, level: np.ndarray, samples: int = 24) -> Background:
    """level: (3,) mean radiance of the photos.

    The object sphere starts as dense fog. Where photos stand all around, each could be explained by
    a patch of background that no other sees, and an object that starts thin is never found; from
    fog it is carved, and what the fog hides is found behind it.
    """
    x = np.linspace(-2, 2, n, dtype=np.float32) ** 2
    within = (x[:, None, None] + x[:, None] + x) < FOG**2  # [z, y, x]
    cells = np.empty((n**3, 4), np.float32)
    cells[:, 0] = np.where(within.ravel(), 4.0, -1.0)
    cells[:, 1:] = np.log(np.maximum(level, 1e-3))
    return Background(n, mi.Float(cells.ravel()), samples)


def contract(x):
    """mip-NeRF 360 Eq. (10)."""
    r = dr.maximum(dr.norm(x), 1e-6)
    return dr.select(r <= 1, x, x * ((2 - 1 / r) / r))


def render_background(field: Background, o, d, jitter):
    """Radiance (Color3f) that reaches the object sphere from behind along rays o + t d;
    differentiable in field.cells, o and d.

    Rays that miss the sphere start at their point closest to the origin. jitter: Float in [0, 1).
    """
    depths = sample_depths(field, o, d, jitter, 0)
    return emission(field, o, d, depths)[0]


def render_everything(field: Background, o, d, jitter, inside: int):
    """Radiance (Color3f) along whole rays, with `inside` samples within the object sphere before
    those behind it: the field alone, before there is a surface. Also the mean density within the
    sphere (Float, per ray). What stands between camera and sphere is not seen."""
    depths = sample_depths(field, o, d, jitter, inside)
    rgb, density, _ = emission(field, o, d, depths)
    within = mi.Float(dr.tile(dr.arange(mi.UInt32, depths.count), dr.width(d))) < inside
    return rgb, dr.block_sum(dr.select(within, density * depths.length, 0), depths.count)


def median_depth(field: Background, o, d, inside: int):
    """Distance (Float) at which half the light along each ray is absorbed; detached."""
    with dr.suspend_grad():
        depths = sample_depths(field, o, d, dr.full(mi.Float, 0.5, dr.width(d)), inside)
        _, _, before = emission(field, o, d, depths)
        visible = dr.select(dr.exp(-before) > 0.5, depths.t, 0)
        return dr.block_reduce(dr.ReduceOp.Max, visible, depths.count)


@dataclass
class Depths:
    """Where rays are sampled, `count` times each, ray by ray. t: Float, distance along the ray.
    length: Float, what the density is multiplied with; -1: opaque. ray: UInt32. All constants of
    the quadrature."""

    t: Any
    length: Any
    ray: Any
    count: int


def sample_depths(field: Background, o, d, jitter, inside: int) -> Depths:
    """`inside` samples between entry and exit of the object sphere, then field.samples behind it.
    Detached."""
    k = inside + field.samples
    with dr.suspend_grad():
        o, d = dr.detach(mi.Vector3f(o)), dr.detach(mi.Vector3f(d))
        b = dr.dot(o, d)
        disc = b * b - (dr.squared_norm(o) - 1)
        root = dr.sqrt(dr.maximum(disc, 0))
        near, far = dr.maximum(-b - root, 0), dr.maximum(-b + root, 1e-3)
        rays = dr.width(d)
        ray = dr.repeat(dr.arange(mi.UInt32, rays), k)
        j = mi.Float(dr.tile(dr.arange(mi.UInt32, k), rays))
        t0, t1, jit = (
            dr.gather(mi.Float, near, ray),
            dr.gather(mi.Float, far, ray),
            dr.gather(mi.Float, jitter, ray),
        )
        # behind the sphere t - t1 = u / (1 - u), u uniform in [0, 1): uniform in inverse distance
        i = dr.maximum(j - inside, 0)
        u0, u1, um = i / field.samples, (i + 1) / field.samples, (i + jit) / field.samples
        reach = um / dr.maximum(1 - um, 1e-3)
        behind = (dr.minimum(u1 / dr.maximum(1 - u1, 1e-3), 1e3) - u0 / (1 - u0)) / (
            1 + reach
        )  # density is per contracted length
        step = dr.maximum(t1 - t0, 0) / max(inside, 1)
        is_inside = j < inside
        t = dr.select(is_inside, t0 + (j + jit) * step, t1 + reach)
        length = dr.select(is_inside, step, behind)
        length = dr.select(
            j == k - 1, -1, length
        )  # what lies farthest is opaque: every ray ends somewhere
        return Depths(t, length, ray, k)


def emission(field: Background, o, d, depths: Depths):
    """Radiance per ray, density per sample, optical depth before each sample; differentiable in
    field.cells, o and d."""
    n, k = field.n, depths.count
    x = (
        dr.gather(mi.Vector3f, mi.Vector3f(o), depths.ray)
        + dr.gather(mi.Vector3f, mi.Vector3f(d), depths.ray) * depths.t
    )
    p = contract(x)
    q = [dr.clip((c * 0.25 + 0.5) * (n - 1), 0, n - 1.001) for c in (p.x, p.y, p.z)]
    base = [mi.UInt32(dr.detach(c)) for c in q]
    f = [c - mi.Float(b) for c, b in zip(q, base, strict=False)]
    node = (base[2] * n + base[1]) * n + base[0]
    value = mi.Vector4f(0)
    for dz in (0, 1):
        for dy in (0, 1):
            for dx in (0, 1):
                w = (
                    (f[0] if dx else 1 - f[0])
                    * (f[1] if dy else 1 - f[1])
                    * (f[2] if dz else 1 - f[2])
                )
                value = dr.fma(
                    dr.gather(mi.Vector4f, field.cells, node + (dz * n + dy) * n + dx), w, value
                )
    density = softplus(value.x)
    tau = dr.select(depths.length < 0, 30.0, density * depths.length)
    before = dr.block_prefix_sum(tau, k)  # exclusive
    weight = dr.exp(-before) * (1 - dr.exp(-tau))
    rgb = dr.exp(dr.clip(mi.Color3f(value.y, value.z, value.w), -12, 6))
    return block_sums((weight * rgb,), k)[0], density, before


def softplus(x):
    """log(1 + e^x), without overflow."""
    return dr.maximum(x, 0) + dr.log(1 + dr.exp(-dr.abs(x)))

"""Material textures as flat Dr.Jit arrays: look-up with gradients, and the way back to pictures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from relit.materials.brdf import Surface

MIN_ROUGHNESS = 0.08  # brdf.MIN_ALPHA
MAX_SLOPE = 1.0  # of a normal map: 45 degrees along each axis


@dataclass
class MaterialField:
    """Square textures of `size` texels a side. colour: Float [size^2 * 4], linear base colour and
    roughness. metallic: Float [size^2].
    slope: Float [size^2 * 2], the normal map as x / z and y / z of tangent-space normals."""

    size: int
    colour: Any
    metallic: Any
    slope: Any
    f0: float = 0.04


def start_material(
    size: int, base: np.ndarray, roughness, metallic, f0: float = 0.04
) -> MaterialField:
    """base: (size, size, 3) linear start of the base colour. roughness, metallic: a number or
    (size, size)."""
    rough, metal = (
        np.broadcast_to(np.asarray(a, np.float32), (size, size)) for a in (roughness, metallic)
    )
    colour = np.concatenate([base, rough[..., None]], -1).astype(np.float32)
    return MaterialField(
        size,
        mi.Float(colour.ravel()),
        mi.Float(metal.ravel()),
        dr.zeros(mi.Float, size * size * 2),
        f0,
    )


def texels_at(field: MaterialField, uv):
    """The four texels around uv (Point2f): flat indices and bilinear weights."""
    s = field.size
    x, y = dr.clip(uv.x * s - 0.5, 0, s - 1.001), dr.clip(uv.y * s - 0.5, 0, s - 1.001)
    x0, y0 = mi.UInt32(x), mi.UInt32(y)
    fx, fy = x - mi.Float(x0), y - mi.Float(y0)
    i = y0 * s + x0
    return [
        (i, (1 - fx) * (1 - fy)),
        (i + 1, fx * (1 - fy)),
        (i + s, (1 - fx) * fy),
        (i + s + 1, fx * fy),
    ]


def nearest_texel(field: MaterialField, uv):
    """Flat index (UInt32) of the texel that uv (Point2f) lies in."""
    s = field.size
    x, y = (mi.UInt32(dr.clip(c * s, 0, s - 1)) for c in (uv.x, uv.y))
    return y * s + x


def material_at(field: MaterialField, uv, active=True) -> Surface:
    """Bilinear look-up; differentiable in field.colour and field.metallic."""
    colour, metallic = mi.Vector4f(0), mi.Float(0)
    for i, w in texels_at(field, uv):
        colour = dr.fma(dr.gather(mi.Vector4f, field.colour, i, active), w, colour)
        metallic = dr.fma(dr.gather(mi.Float, field.metallic, i, active), w, metallic)
    return Surface(mi.Color3f(colour.x, colour.y, colour.z), colour.w, metallic, field.f0)


def slope_at(field: MaterialField, uv, active=True):
    """Bilinear look-up of the normal map's slope (Vector2f); differentiable in field.slope."""
    slope = mi.Vector2f(0)
    for i, w in texels_at(field, uv):
        slope = dr.fma(dr.gather(mi.Vector2f, field.slope, i, active), w, slope)
    return slope


def project(field: MaterialField) -> None:
    """Clip every texel to what a material may be: colour and metallic in [0, 1], roughness in
    [MIN_ROUGHNESS, 1]."""
    n = dr.width(field.colour)
    low = dr.select(dr.arange(mi.UInt32, n) % 4 == 3, mi.Float(MIN_ROUGHNESS), mi.Float(0.0))
    field.colour = dr.clip(field.colour, low, 1)
    field.metallic = dr.clip(field.metallic, 0, 1)
    field.slope = dr.clip(field.slope, -MAX_SLOPE, MAX_SLOPE)
    dr.schedule(field.colour, field.metallic, field.slope)


def normal_map(field: MaterialField) -> np.ndarray:
    """(S, S, 3) float32 unit tangent-space normals, x along the tangent, y up in the texture."""
    slope = np.array(field.slope).reshape(field.size, field.size, 2)
    n = np.concatenate([slope, np.ones_like(slope[..., :1])], -1)
    return n / np.linalg.norm(n, axis=-1, keepdims=True)


def pictures(field: MaterialField) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Base colour (S, S, 3), roughness (S, S), metallic (S, S), float32."""
    c = np.array(field.colour).reshape(field.size, field.size, 4)
    return (
        c[..., :3].copy(),
        c[..., 3].copy(),
        np.array(field.metallic).reshape(field.size, field.size),
    )

"""Textures of a rough plastic as flat Dr.Jit arrays: look-up with gradients, and the way back to
pictures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from relit.materials.field import MAX_SLOPE, texels_at
from relit.materials.rough_plastic import Plastic

LEAST_ALPHA, MOST_SPECULAR = 0.03, 2.0


@dataclass
class PlasticField:
    """Square textures of `size` texels a side. diffuse: Float [size^2 * 4], diffuse albedo and
    nothing. lobe: Float [size^2 * 2], specular albedo and alpha. slope: Float [size^2 * 2], the
    normal map as x / z and y / z of tangent-space normals."""

    size: int
    diffuse: Any
    lobe: Any
    slope: Any


def start_plastic(diffuse: np.ndarray, specular: np.ndarray, alpha: np.ndarray) -> PlasticField:
    """diffuse: (S, S, 3). specular, alpha: (S, S). No slope."""
    s = diffuse.shape[0]
    flat = lambda *parts: mi.Float(np.concatenate(parts, -1).astype(np.float32).ravel())  # noqa: E731
    zero = np.zeros((s, s, 1))
    return PlasticField(
        s, flat(diffuse, zero), flat(specular[..., None], alpha[..., None]), flat(zero, zero)
    )


def plastic_at(field: PlasticField, uv, active=True):
    """Bilinear look-up: (Plastic, slope as Vector2f); differentiable in the field's arrays."""
    diffuse, lobe, slope = mi.Vector4f(0), mi.Vector2f(0), mi.Vector2f(0)
    for i, w in texels_at(field, uv):
        diffuse = dr.fma(dr.gather(mi.Vector4f, field.diffuse, i, active), w, diffuse)
        lobe = dr.fma(dr.gather(mi.Vector2f, field.lobe, i, active), w, lobe)
        slope = dr.fma(dr.gather(mi.Vector2f, field.slope, i, active), w, slope)
    return Plastic(mi.Color3f(diffuse.x, diffuse.y, diffuse.z), lobe.x, lobe.y), slope


def project_plastic(field: PlasticField) -> None:
    """Clip every texel to what a material may be."""
    field.diffuse = dr.clip(field.diffuse, 0, 1)
    second = dr.arange(mi.UInt32, dr.width(field.lobe)) % 2 == 1
    low, high = (
        dr.select(second, mi.Float(LEAST_ALPHA), mi.Float(0.0)),
        dr.select(second, mi.Float(1.0), mi.Float(MOST_SPECULAR)),
    )
    field.lobe = dr.clip(field.lobe, low, high)
    field.slope = dr.clip(field.slope, -MAX_SLOPE, MAX_SLOPE)
    dr.schedule(field.diffuse, field.lobe, field.slope)


def plastic_pictures(field: PlasticField) -> dict[str, np.ndarray]:
    """diffuse (S, S, 3), specular, alpha (S, S), normal (S, S, 3) unit tangent-space, float32."""
    s = field.size
    lobe, slope = np.array(field.lobe).reshape(s, s, 2), np.array(field.slope).reshape(s, s, 2)
    n = np.concatenate([slope, np.ones_like(slope[..., :1])], -1)
    diffuse = np.array(field.diffuse).reshape(s, s, 4)[..., :3].copy()
    normal = n / np.linalg.norm(n, axis=-1, keepdims=True)
    return {
        "diffuse": diffuse,
        "specular": lobe[..., 0].copy(),
        "alpha": lobe[..., 1].copy(),
        "normal": normal,
    }

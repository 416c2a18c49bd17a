"""Deferred appearance of the volume pass for duplicates: one object in many poses under one light,
so the light stands with the camera.

A point of the object looks different in every instance, because each turns it differently into the
light. So (SfD Sec. 3.2, the auxiliary appearance, made explicit): radiance = diffuse(x_obj) S(n)
exp(a_i + b_i · x_obj) + tint(x_obj) E(r), with normal n and mirrored direction r in the PHOTO's
frame. S is exp of nine spherical harmonics per channel, E a small map; a_i, b_i let an instance, or
one end of it, stand in the shadow of others.

Feature channels as in rendering/appearance/fixed_light.py. What is learnt besides, in one flat
array: log E (ROWS x COLUMNS x 3), 9 x 3 coefficients of log S (the constant one is fixed: it
belongs to `diffuse`), then a_i, b_i (4 for each view).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from relit.lighting.environment import lookup_latlong
from relit.materials import intrinsic
from relit.rendering.appearance.fixed_light import COLUMNS, ROWS, features_at
from relit.rendering.blocks import everywhere
from relit.rendering.march import Marched

MAP = ROWS * COLUMNS * 3
SHADE = MAP + 27
SHADE_RATE, SHADOW_RATE = 0.3, 0.3  # of the pass's rate of what is learnt besides the features


def start_world_light(level: float, views: int) -> tuple:
    """(learnt, rates): an even light of mean radiance `level`, and how fast each entry moves."""
    learnt = np.concatenate(
        [np.full(MAP, np.log(max(level, 1e-4))), np.zeros(27 + 4 * views)]
    ).astype(np.float32)
    rates = np.concatenate(
        [np.ones(MAP), np.zeros(3), np.full(24, SHADE_RATE), np.full(4 * views, SHADOW_RATE)]
    ).astype(np.float32)
    return mi.Float(learnt), mi.Float(rates)


def device_harmonics(n) -> list:
    """The nine real spherical harmonics up to order 2, not normalised, of Vector3f: a list of
    Floats."""
    x, y, z = n.x, n.y, n.z
    return [1.0, x, y, z, x * y, y * z, x * z, x * x - y * y, 3 * z * z - 1]


def in_photo(cameras, view, v):
    """A direction of the object's frame (Vector3f) in the axes of the camera of `view`."""
    k = [dr.gather(mi.Vector4f, cameras, view * 4 + j) for j in (1, 2, 3)]
    return mi.Vector3f(*[k[0][c] * v.x + k[1][c] * v.y + k[2][c] * v.z for c in range(3)])


def shading(n, learnt):
    """S(n) (Color3f) of directions n in the photo's frame."""
    log = mi.Color3f(0)
    for k, y in enumerate(device_harmonics(n)):
        log += y * everywhere(mi.Color3f, learnt, MAP // 3 + k, dr.width(n))
    return dr.exp(log)


def shade_world(m: Marched, rays, cameras, learnt, turns=None):
    """The appearance itself: see `fit.volume.VolumeModel.appearance`. turns: Float, 9 a view, the
    rotation (by rows) from its photo's axes to those of the light, where views come from several
    photos; None where they come from one."""
    F = m.features
    n = m.unit_normal
    d = rays.d
    r = d - 2 * dr.dot(d, n) * n
    turned, mirrored = in_photo(cameras, rays.view, n), in_photo(cameras, rays.view, r)
    if turns is not None:
        k = [dr.gather(mi.Vector3f, turns, rays.view * 3 + j) for j in range(3)]
        turned, mirrored = (mi.Vector3f(*[dr.dot(row, v) for row in k]) for v in (turned, mirrored))
    mirrored = mi.Vector3f(mirrored.x, dr.clip(mirrored.y, -0.9999, 0.9999), mirrored.z)
    e = dr.exp(lookup_latlong(learnt, ROWS, COLUMNS, mirrored))
    x = m.surface_point(rays.o, d)
    a = [dr.gather(mi.Float, learnt, SHADE + rays.view * 4 + k) for k in range(4)]
    shadow = dr.exp(a[0] + a[1] * x.x + a[2] * x.y + a[3] * x.z)
    diffuse = mi.Color3f(dr.maximum(F[0], 0), dr.maximum(F[1], 0), dr.maximum(F[2], 0))
    return (diffuse * shading(turned, learnt) + dr.maximum(F[3], 0) * e) * shadow, n


def shade_albedo(m: Marched, rays, cameras, learnt):
    """The object's own colours without any light: what registration compares."""
    F = m.features
    level = dr.exp(dr.gather(mi.Float, learnt, mi.UInt32(0)))
    return mi.Color3f(
        *[dr.maximum(F[k], 0) + dr.maximum(F[3], 0) * level for k in range(3)]
    ), m.normal


def instance_radiance(
    grid,
    features: np.ndarray,
    learnt,
    points: np.ndarray,
    normals: np.ndarray,
    photo_from_object: np.ndarray,
    view: int,
):
    """(N, 3) mean radiance over directions of surface points (N, 3) with normals (N, 3) of the
    instance number `view` in the pose `photo_from_object`, and (N, 3) their colour without light,
    up to scale. features: (rows, CHANNELS)."""
    values, flat = features_at(grid, features, points), np.array(learnt)
    n = normals @ np.asarray(photo_from_object)[:3, :3].T
    s = np.exp(intrinsic.harmonics(n) @ flat[MAP:SHADE].reshape(9, 3))
    a = flat[SHADE + 4 * view : SHADE + 4 * view + 4]
    shadow = np.exp(a[0] + points @ a[1:])
    mirror = np.exp(flat[:MAP]).mean()
    gloss = np.maximum(values[:, 3:4], 0) * mirror
    base = np.maximum(values[:, :3], 0)
    return np.maximum((base * s + gloss) * shadow[:, None], 1e-4).astype(np.float32), np.maximum(
        base + gloss, 1e-3
    ).astype(np.float32)

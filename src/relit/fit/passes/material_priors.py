"""Priors of the surface pass: on metallic-roughness textures, the normal map and the environment."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from relit.fit.passes.losses import weighted_mean
from relit.materials.field import MaterialField, material_at, slope_at
from relit.rendering.transport import Points

ALBEDO_START = 0.4  # mean base colour at the start; light and albedo share one unknown scale
VARIED = 2.0  # see `common_scale`
# base colour of white paint and paper; what would have to be brighter is rather lit more
WHITE = 0.8


@dataclass(frozen=True)
class SurfaceOptions:
    """steps, points (pixels per step), directions (per point). texture: texels a side. light: rows
    of the environment (twice as many columns).

    colour_rate, roughness_rate, metallic_rate, light_rate: largest move of a value (of log radiance
    for the light) per step; exchange_rate: of `Exchange` (log), whose moves of the light are hats
    of a map of exchange_rows rows; exchange_mirrored: what is mirrored counts there.
    warm: part of light_steps over which colour_rate rises from a twentieth. roughness_start: first
    roughness. smooth_roughness,
    smooth_metallic, smooth_colour: weights of differences between similar neighbours, up to
    similarity_reach (unit frame) apart and similarity_width in base colour; smooth_shade: power of
    `relative_irradiance` in smooth_colour. scale_power: see `common_scale`. metallic_binary,
    metallic_sparse: of m (1 - m), and of the distance of m from the side that a place began on, 0
    or 1. bright: of base colour beyond WHITE, squared. light_smooth: total variation of the log
    radiance, of its tint light_tint times that more. light_cells: it moves by `LightSteps`.
    light_neutral: its chroma; light_even: its squared distance from its mean. light_steps: after
    them the light rests, and `parsimony`, which helps to find it, ends; 0: never. parsimony,
    parsimony_width,
    parsimony_toe: see `parsimony`. slope_rate, slope_begin: of the normal map, and the part of the
    steps after which it moves.
    slope_small, slope_smooth: weights of `slope_prior`, whose neighbours are up to slope_reach
    apart. slope_calm: floor of its optimiser (see `Adam`), so that noise does not move it at full
    rate.
    """

    steps: int = 700
    points: int = 4096
    directions: int = 64
    texture: int = 512
    light: int = 64
    colour_rate: float = 0.01
    roughness_rate: float = 0.03
    metallic_rate: float = 0.01
    light_rate: float = 0.05
    exchange_rate: float = 0.02
    exchange_rows: int = 4
    exchange_mirrored: bool = False
    warm: float = 0.3
    roughness_start: float = 0.4
    smooth_roughness: float = 0.1
    smooth_metallic: float = 0.1
    smooth_colour: float = 0.2
    smooth_shade: float = 0.9
    similarity_reach: float = 0.15
    similarity_width: float = 0.1
    metallic_binary: float = 0.01
    metallic_sparse: float = 0.03
    bright: float = 0.3
    light_smooth: float = 0.002
    light_neutral: float = 2e-4
    light_tint: float = 0.0
    light_cells: bool = False
    light_even: float = 0.0
    light_steps: int = 0
    scale_power: float = 0.5
    parsimony: float = 0.02
    parsimony_width: float = 0.1
    parsimony_toe: float = 0.0
    slope_rate: float = 0.01
    slope_begin: float = 0.25
    slope_small: float = 0.02
    slope_smooth: float = 0.05
    slope_reach: float = 0.02
    slope_calm: float = 1.0


def relative_irradiance(rgb, base, valid, power: float):
    """How much light arrives at each point, 1 on average (Float): what is in the shade shows its
    colour less, and is smoothed less."""
    arriving = mi.luminance(rgb) / dr.maximum(mi.luminance(dr.detach(base)), 0.05)
    mean = weighted_mean(arriving, dr.select(valid, mi.Float(1), 0))
    return dr.minimum(arriving / dr.maximum(mean, 1e-6), 2) ** power


def common_scale(surface, valid, power: float = 0.5):
    """Factor on the base colours of the valid points in priors: (ALBEDO_START / their mean) **
    power for each channel (Color3f of width 1), with its gradient; for the power 1 in the place of
    the mean what they differ by, VARIED times their mean distance from it, where that is more.

    Differences themselves shrink when everything darkens, and the light would brighten without end;
    relative differences shrink when a grey veil is laid over everything, and the light would dim.
    In between, as differences of display values do, they pull neither way. One factor for all
    channels would let the least visible ones go dark, under a tinted light. power: 1 is right where
    each texel stands in many places and a veil would show (a photo of duplicates), but in a channel
    in which most of an object is black: there a veil is faint and its mean grows many times with
    it, while what its colours differ by stays.
    """
    w = dr.select(valid, mi.Float(1), 0)
    typical = []
    for c in surface.base:
        mean = weighted_mean(c, w)
        typical.append(
            dr.maximum(mean, VARIED * weighted_mean(dr.abs(c - mean), w)) if power == 1 else mean
        )
    return mi.Color3f(*[(ALBEDO_START / dr.maximum(c, 1e-3)) ** power for c in typical])


def material_prior(
    material: MaterialField,
    surface,
    near: Points,
    valid,
    level,
    options: SurfaceOptions,
    colour_smoothing,
    side=0.0,
):
    """SfD Eq. (5) E_smooth, E_metal and E_sparse, with smoothness as a similarity kernel:
    neighbours with like base colour should share roughness, metallic and, more strictly, base
    colour (weight colour_smoothing, opaque Float). level: `common_scale`. side: Float, 1 where the
    surface began as metal, whose E_sparse pulls to 1."""
    other = material_at(material, near.uv, near.valid)
    step = (other.base - surface.base) * level
    difference = dr.detach(step)
    alike = dr.exp(-dr.squared_norm(mi.Vector3f(difference)) / (2 * options.similarity_width**2))
    w = dr.select(valid & near.valid, alike, 0)
    change = dr.abs(step)
    smooth = (
        options.smooth_roughness * dr.abs(other.roughness - surface.roughness)
        + options.smooth_metallic * dr.abs(other.metallic - surface.metallic)
        + colour_smoothing * (change.x + change.y + change.z) * w
    )
    m = surface.metallic
    white = dr.maximum(mi.Vector3f(surface.base) - WHITE, 0)
    single = (
        options.metallic_binary * m * (1 - m)
        + options.metallic_sparse * dr.abs(m - side)
        + options.bright * dr.squared_norm(white)
    )
    return dr.mean(smooth * w) + dr.mean(dr.select(valid, single, 0))


def parsimony(material: MaterialField, surface, uv, valid, level, shift, options: SurfaceOptions):
    """An object has few materials (Barron & Malik 2015, Sec. 4.2): pairs of points anywhere on it
    attract each other's display value of base colour when they are closer than about
    parsimony_width. level: `common_scale`. shift: opaque UInt32, how far the partner of a point is
    in the batch. parsimony_toe is added to what is displayed: noise in a channel that is black is
    large in display values, and would look less different under a grey veil."""
    n = dr.width(uv)
    partner = (dr.arange(mi.UInt32, n) + shift) % n
    uv, valid = dr.gather(mi.Point2f, uv, partner), valid & dr.gather(mi.Bool, valid, partner)
    other = material_at(material, uv, valid)
    shown = lambda c: (dr.maximum(c * level, 1e-3) + options.parsimony_toe) ** (1 / 2.2)  # noqa: E731
    alike = dr.exp(
        -dr.squared_norm(mi.Vector3f(shown(other.base) - shown(surface.base)))
        / (2 * options.parsimony_width**2)
    )
    return -options.parsimony * dr.mean(dr.select(valid, alike, 0))


def slope_prior(material: MaterialField, bend, close: Points, valid, options: SurfaceOptions):
    """Normal maps are small, and change little between neighbours. bend: Vector3f, slope.x t +
    slope.y b at the points."""
    slope = slope_at(material, close.uv, close.valid)
    difference = bend - (slope.x * close.t + slope.y * close.b)
    small = options.slope_small * dr.select(valid, dr.squared_norm(bend), 0)
    smooth = options.slope_smooth * dr.select(valid & close.valid, dr.norm(difference + 1e-5), 0)
    return dr.mean(small + smooth)


def light_prior(log_light, options: SurfaceOptions):
    """Total variation over the lat-long map, of the log radiance and of its tint (difference from
    grey), and the tint squared."""
    h, w = options.light, 2 * options.light
    i = dr.arange(mi.UInt32, h * w)
    row, column = i // w, i % w
    here = dr.gather(mi.Color3f, log_light, i)
    right = dr.gather(mi.Color3f, log_light, row * w + (column + 1) % w)
    below = dr.gather(mi.Color3f, log_light, dr.minimum(row + 1, h - 1) * w + column)
    area = dr.sin((mi.Float(row) + 0.5) * (dr.pi / h))
    soft = lambda c: dr.sqrt(dr.squared_norm(mi.Vector3f(c)) + 1e-4)  # noqa: E731
    tint = lambda c: c - (c.x + c.y + c.z) / 3  # noqa: E731
    change = soft(right - here) + soft(below - here)
    if options.light_tint > 0:
        change += options.light_tint * (soft(tint(right - here)) + soft(tint(below - here)))
    grey = (here.x + here.y + here.z) / 3
    chroma = dr.squared_norm(mi.Vector3f(here - grey))
    middle = dr.detach(dr.sum(grey * area) / dr.sum(area))
    even = options.light_even * dr.mean(dr.square(grey - middle) * area)
    return (
        even
        + options.light_smooth * dr.mean(change * area)
        + options.light_neutral * dr.mean(chroma * area)
    )

"""The surface pass: metallic-roughness textures and the environment light, by Monte Carlo light
transport on the mesh.

Each step takes a few thousand pixels of all photos, traces many directions at each
(rendering/transport.py) and moves material texels and light texels. Shape is fixed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from relit.fit.passes.exchange import REFRESH, Exchange
from relit.fit.passes.light_steps import LightSteps
from relit.fit.passes.losses import display_weight, weighted_mean
from relit.fit.passes.optimiser import Adam, cosine_decay, memory, recall, run_steps
from relit.fit.passes.pixels import SATURATED, PixelBank, batch_of, draw_pixels, saturated_at
from relit.fit.passes.preview import surface_preview
from relit.lighting.environment import Environment
from relit.lighting.gaussian_light import GaussianLight
from relit.materials.field import (
    MaterialField,
    material_at,
    nearest_texel,
    project,
    slope_at,
    start_material,
)
from relit.rendering.transport import (
    Points,
    TraceableMesh,
    bent_normal,
    first_hits,
    reflected,
    sample_lights,
)

ALBEDO_START = 0.4  # mean base colour at the start; light and albedo share one unknown scale
VARIED = 2.0  # see `common_scale`
# base colour of white paint and paper; what would have to be brighter rather stands in more light
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


@dataclass
class SurfaceModel:
    """material: the textures. log_light: Float [rows * 2 rows * 3], log radiance, lat-long in the
    unit frame. environment: exp of it.
    normals: (S, S, 3) unit normals of the texels, or None. gaussians: what log_light is rendered
    from, where the light is to be spherical Gaussians, or None. metal: Float [S²], 1 where the
    surface begins as metal, 0 elsewhere."""

    material: MaterialField
    log_light: Any
    environment: Environment
    metal: Any
    normals: np.ndarray | None = None
    gaussians: GaussianLight | None = None


def start_surface(
    base: np.ndarray,
    known: np.ndarray,
    radiance: float,
    options: SurfaceOptions,
    normals=None,
    metallic=0.1,
    roughness=None,
) -> SurfaceModel:
    """base: (S, S, 3) first guess of the base colour up to scale (materials.intrinsic), known: (S,
    S) bool, radiance: mean over the object,
    normals: (S, S, 3) of the texels, None where they stand in many places. metallic, roughness
    (None: roughness_start): a number or (S, S).

    The light starts grey and even, bright enough that the mean base colour is ALBEDO_START.
    """
    mean = float(base[known].mean())
    albedo = np.clip(base * (ALBEDO_START / max(mean, 1e-6)), 0.02, 0.95)
    rough = options.roughness_start if roughness is None else roughness
    material = start_material(options.texture, albedo, rough, metallic)
    h = options.light
    log_light = mi.Float(
        np.full(h * 2 * h * 3, np.log(max(radiance, 1e-4) / ALBEDO_START), np.float32)
    )
    metal = dr.select(material.metallic > 0.5, mi.Float(1), 0)
    dr.eval(metal)
    return SurfaceModel(
        material, log_light, Environment(dr.exp(log_light), h, 2 * h), metal, normals
    )


def light_parameters(model: SurfaceModel):
    """What is optimised of the light (Float)."""
    return model.log_light if model.gaussians is None else model.gaussians.parameters


def fit_surface(
    bank: PixelBank,
    mesh: TraceableMesh,
    model: SurfaceModel,
    options: SurfaceOptions,
    stage,
    seed: int = 0,
    before=None,
) -> SurfaceModel:
    """Run the pass; returns the same model, optimised. Resumes from the stage's checkpoint when
    there is one. before(step, steps, material, environment, seed): called before each step; it may
    change the mesh's radiance."""
    material, environment, gaussians = model.material, model.environment, model.gaussians
    first = 0
    saved = stage.load("checkpoint")
    if saved:
        first = int(saved["step"])
        material.colour, material.metallic = mi.Float(saved["colour"]), mi.Float(saved["metallic"])
        material.slope, model.metal = mi.Float(saved["slope"]), mi.Float(saved["metal"])
        if gaussians is None:
            model.log_light = mi.Float(saved["light"])
        else:
            gaussians.parameters = mi.Float(saved["light"])
    if saved and before is not None:
        mesh.radiance = mi.Float(saved["radiance"])
    if gaussians is not None:
        model.log_light = gaussians.log_radiance()
    environment.radiance = dr.exp(model.log_light)
    environment.rebuild()
    count = options.points
    rng = mi.PCG32(size=count, initstate=seed * 7919 + 13)
    exchange = Exchange(model.normals, material.size**2, options.light, options.exchange_rows)
    adam_colour, adam_metallic = (Adam(dr.width(p)) for p in (material.colour, material.metallic))
    adam_slope = Adam(dr.width(material.slope), floor=options.slope_calm)
    by_cells = options.light_cells and gaussians is None
    light_mover = LightSteps(options.light) if by_cells else Adam(dr.width(light_parameters(model)))
    adam = {
        "colour": adam_colour,
        "metallic": adam_metallic,
        "slope": adam_slope,
        "exchange": exchange.adam,
    }
    adam |= light_mover.adam if by_cells else {"light": light_mover}
    recall(saved, rng, adam)
    if saved and "followed" in saved:
        exchange.refresh(mi.Float(saved["followed"]))
    light_steps = min(options.light_steps or options.steps, options.steps)
    ratio = np.tile(
        np.array([1, 1, 1, options.roughness_rate / options.colour_rate], np.float32),
        material.size**2,
    )
    ratio = mi.Float(ratio)

    def step(i: int) -> dict:
        decay = cosine_decay(i / options.steps, 0.05)
        warm = min(
            1.0, 0.05 + (i / (options.warm * light_steps)) ** 2
        )  # the light first: base colour could explain all shading at once
        if before is not None:
            before(i, options.steps, material, environment, seed)
        batch, points = drawn_points(bank, mesh, rng, count)
        valid = points.valid
        near = neighbour_points(mesh, points, options.similarity_reach, rng)
        close = neighbour_points(mesh, points, options.slope_reach, rng)
        dr.eval(near, close, rng)
        shift = dr.opaque(mi.UInt32, 1 + (i * 7919) % (count - 1))
        with dr.suspend_grad():
            start = material_at(material, points.uv, valid)
            side = dr.gather(mi.Float, model.metal, nearest_texel(material, points.uv), valid)
            smooth_n = points.n
            points.n = bent_normal(points, slope_at(material, points.uv, valid))
            dr.eval(start.base, start.roughness, start.metallic, side, points.n)
        lights = sample_lights(mesh, points, start, environment, options.directions, rng)

        colour_smoothing = dr.opaque(
            mi.Float, options.smooth_colour
        )  # opaque: the weight must not become a literal
        params = [
            material.colour,
            material.metallic,
            material.slope,
            *([light_parameters(model)] if i < light_steps else []),
        ]
        dr.enable_grad(*params)
        if i < light_steps:
            log_light = model.log_light if gaussians is None else gaussians.log_radiance()
            environment.radiance = dr.exp(log_light)
        surface = material_at(material, points.uv, valid)
        slope = slope_at(material, points.uv, valid)
        points.n = smooth_n
        bend = slope.x * points.t + slope.y * points.b
        points.n = bent_normal(points, slope)
        a, b = reflected(points, lights, surface, environment)
        fit = dual_loss(a, b, batch.rgb, valid, saturated_at(bank, batch.view))
        lit = relative_irradiance(batch.rgb, surface.base, valid, options.smooth_shade)
        level = common_scale(surface, valid, options.scale_power)
        prior = material_prior(
            material, surface, near, valid, level, options, colour_smoothing * lit, side
        )
        prior += slope_prior(material, bend, close, valid, options)
        if i < light_steps:
            prior += light_prior(log_light, options)
        if i < light_steps and options.parsimony > 0:
            prior += parsimony(material, surface, points.uv, valid, level, shift, options)
        dr.backward(fit + prior)
        gradients = [dr.grad(p) for p in params]
        dr.disable_grad(*params)
        dr.eval(gradients, fit)
        material.colour = adam_colour.step(
            dr.detach(material.colour), gradients[0], options.colour_rate * decay * warm, ratio
        )
        material.metallic = adam_metallic.step(
            dr.detach(material.metallic), gradients[1], options.metallic_rate * decay
        )
        slope_rate = options.slope_rate * decay * (i >= options.slope_begin * options.steps)
        material.slope = adam_slope.step(dr.detach(material.slope), gradients[2], slope_rate)
        if i < light_steps:
            move_light(i, gradients[3], gradients[0])
        project(material)
        dr.eval(material.colour, material.metallic, material.slope)
        return {"colour": fit}

    def move_light(i: int, gradient, colour_gradient) -> None:
        decay = cosine_decay(i / light_steps, 0.05)
        if gaussians is None:
            model.log_light = light_mover.step(
                dr.detach(model.log_light), gradient, options.light_rate * decay
            )
        else:
            gaussians.parameters = light_mover.step(
                dr.detach(gaussians.parameters),
                gradient,
                options.light_rate * decay,
                gaussians.rates,
            )
            gaussians.project()
            model.log_light = gaussians.log_radiance()
        if options.exchange_rate > 0 and gaussians is None:
            if i % REFRESH == 0 or exchange.share is None:
                exchange.refresh(environment.radiance)
            dr.eval(material.colour, model.log_light)
            rate, metallic = (
                options.exchange_rate * decay,
                material.metallic if options.exchange_mirrored else None,
            )
            pulls = (colour_gradient, gradient)
            material.colour, model.log_light = exchange.step(
                material.colour, model.log_light, *pulls, rate, metallic
            )
        environment.radiance = dr.exp(model.log_light)
        dr.eval(model.log_light, environment.radiance)
        environment.rebuild()

    def state() -> dict:
        names = {
            "colour": material.colour,
            "metallic": material.metallic,
            "slope": material.slope,
            "light": light_parameters(model),
        }
        arrays = {name: np.array(value) for name, value in {**names, "metal": model.metal}.items()}
        followed = {} if exchange.light is None else {"followed": np.array(exchange.light)}
        followed |= {} if before is None else {"radiance": np.array(mesh.radiance)}
        return arrays | followed | memory(rng, adam)

    def textures(uv, valid):
        at = material_at(material, uv, valid)
        return [at.base, at.roughness]

    run_steps(
        stage, first, options.steps, step, state, preview=surface_preview(bank, mesh, textures)
    )
    return model


def drawn_points(
    bank: PixelBank, mesh: TraceableMesh, rng, count: int, draw: Callable = draw_pixels
):
    """`count` drawn pixels (RayBatch) and the surface they show (Points), valid where a pixel is
    all object and not seen too flat. draw: what draws them, called as `draw_pixels`."""
    pixel = draw(bank, rng, count)
    dr.eval(pixel, rng)
    batch = batch_of(bank, pixel)
    points = first_hits(mesh, batch.o, batch.d)
    points.valid = points.valid & (batch.mask > 0.99) & (dr.dot(points.n, points.v) > 0.1)
    dr.eval(points, batch.rgb)
    return batch, points


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


def neighbour_points(mesh: TraceableMesh, points: Points, reach: float, rng) -> Points:
    """For each point another one on the same stretch of surface, up to `reach` away (log-uniform in
    its tangent plane). Detached."""
    with dr.suspend_grad():
        phi = dr.two_pi * rng.next_float32()
        r = reach * dr.exp(-4 * rng.next_float32())
        frame = mi.Frame3f(points.n)
        offset = (frame.s * dr.cos(phi) + frame.t * dr.sin(phi)) * r
        return first_hits(mesh, points.x + offset + points.n * r, -points.n)


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

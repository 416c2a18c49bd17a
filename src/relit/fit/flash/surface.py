"""The surface pass of flash captures: rough-plastic textures, a normal map, and the flash itself,
on a fixed mesh.

Each step takes some thousand pixels of all photos. Direct light is exact; inter-reflection is
estimated twice and independently, so that the product of the two residuals is unbiased for the
squared error (rendering/transport_flash.py). An over-exposed pixel has no say over lobes and
patches, and none over a texel that is brighter yet.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np

from relit.conventions import srgb_from_linear
from relit.fit.flash.lobe_clusters import Kinship, share_evidence
from relit.fit.flash.patches import draw_patches, pyramid_loss, ssim_loss
from relit.fit.passes.losses import display_weight
from relit.fit.passes.optimiser import Adam, cosine_decay, memory, recall, run_steps
from relit.fit.passes.pixels import PixelBank, draw_pixels, saturated_at, well_exposed
from relit.fit.passes.preview import surface_preview
from relit.fit.passes.surface import drawn_points, dual_values, neighbour_points
from relit.lighting.flash import light_position
from relit.materials.plastic_field import PlasticField, plastic_at, project_plastic
from relit.materials.rough_plastic import Coat, Plastic, base_radiance
from relit.rendering.transport import Points, TraceableMesh, bent_normal
from relit.rendering.transport_flash import direct, indirect, lit

RESCALE = 25  # steps after which albedos and intensity are brought back to their common scale
BOUNCE_SAMPLES = 8  # of inter-reflection per pixel where the groups' evidence is gathered


@dataclass(frozen=True)
class FlashSurfaceOptions:
    """steps, points (pixels per step). directions: of inter-reflection, for each of the two
    estimates; 0 for none. bounces: of it.
    shadow: whether the flash throws any.

    *_rate: largest move of a value per step. offset_rate: unit lengths. intensity_rate: of its log.
    edge: contrast of neighbouring pixels, in display values, at which a pixel counts half. robust:
    display value beyond which a residual counts less (edges of paint, shape and shadow), at the
    start and from two thirds of the steps on. smooth: weight of differences of specular albedo and
    alpha between neighbours up to reach apart, of like features (to about width). share: length of
    the like places' common step (fit/flash/lobe_clusters.py), taken every share_every steps; own:
    part of what a texel has to itself that is kept per step. slope_*: the normal map (see
    SurfaceOptions of fit/passes/surface.py). offset_z: weight of |Δo_z|. alpha_range: of alpha
    beyond .5.
    patches: weight of the Gaussian-pyramid and SSIM terms of PIR Eq. 9; pixels are then drawn in
    patches (fit/flash/patches.py).
    """

    steps: int = 2000
    points: int = 8192
    directions: int = 1
    bounces: int = 2
    shadow: bool = True
    colour_rate: float = 0.004
    specular_rate: float = 0.004
    alpha_rate: float = 0.002
    offset_rate: float = 0.002
    intensity_rate: float = 0.002
    edge: float = 0.06
    robust: tuple[float, float] = (0.5, 0.1)
    smooth: float = 0.0003
    reach: float = 0.1
    width: float = 0.06
    share: float = 0.5
    share_every: int = 8
    own: float = 0.99
    lobe_calm: float = 0.3
    slope_rate: float = 0.01
    slope_begin: float = 0.05
    slope_small: float = 0.01
    slope_smooth: float = 0.02
    slope_reach: float = 0.02
    slope_calm: float = 0.1
    offset_z: float = 0.002
    alpha_range: float = 0.1
    patches: float = 0.0


@dataclass
class FlashModel:
    """field: the textures. features: Float [size^2 * 4], what places are compared by. kinship:
    which places are alike, or None.
    offset: Float [3], unit frame. log_intensity: Float [1]. coat: the tables. around: light that
    the surface throws on itself, as it was known before the pass (fit/flash/ambient.py), or
    None."""

    field: PlasticField
    features: Any
    kinship: Kinship | None
    offset: Any
    log_intensity: Any
    coat: Coat
    around: Any = None


def fit_flash_surface(
    bank: PixelBank,
    cameras,
    mesh: TraceableMesh,
    model: FlashModel,
    options: FlashSurfaceOptions,
    stage,
    seed: int = 0,
) -> FlashModel:
    """Run the pass; returns the same model, optimised. Resumes from the stage's checkpoint when
    there is one."""
    field, o = model.field, options
    even = calm_weights(bank, cameras, o.edge)
    beginning = PlasticField(field.size, mi.Float(field.diffuse), field.lobe, field.slope)
    brightest = brightest_albedo(beginning)
    first = 0
    saved = stage.load("checkpoint")
    if saved:
        first = int(saved["step"])
        field.diffuse, field.lobe, field.slope = (
            mi.Float(saved[name]) for name in ("diffuse", "lobe", "slope")
        )
        model.offset, model.log_intensity = (
            mi.Float(saved["offset"]),
            mi.Float(saved["log_intensity"]),
        )
        if model.kinship is not None:
            model.kinship.take_up(saved["level"], saved["sums"])
    rng = mi.PCG32(size=o.points, initstate=seed * 7919 + 17)
    adam = {
        "diffuse": Adam(dr.width(field.diffuse)),
        "slope": Adam(dr.width(field.slope), floor=o.slope_calm),
    }
    adam |= {
        "lobe": Adam(dr.width(field.lobe), floor=o.lobe_calm),
        "offset": Adam(3),
        "log_intensity": Adam(1),
    }
    recall(saved, rng, adam)
    ratio = mi.Float(
        np.tile(np.array([o.specular_rate / o.alpha_rate, 1], np.float32), field.size**2)
    )

    def step(i: int) -> dict:
        decay = cosine_decay(i / o.steps, 0.03)
        batch, points = drawn_points(
            bank, mesh, rng, o.points, draw_patches if o.patches > 0 else draw_pixels
        )
        valid, calm = points.valid, dr.gather(mi.Float, even, batch.pixel)
        dr.eval(batch.view, calm)
        near = neighbour_points(mesh, points, o.reach, rng)
        close = neighbour_points(mesh, points, o.slope_reach, rng)
        dr.eval(near, close, rng)
        with dr.suspend_grad():
            flash = light_position(bank.cameras, batch.view, offset_of(model.offset))
            seen = lit(mesh, points, flash, valid) if o.shadow else dr.select(valid, mi.Float(1), 0)
            dr.eval(seen)
        params = {"diffuse": field.diffuse, "lobe": field.lobe, "slope": field.slope}
        params |= {"offset": model.offset, "log_intensity": model.log_intensity}
        dr.enable_grad(*params.values())
        position = light_position(bank.cameras, batch.view, offset_of(model.offset))
        intensity = dr.exp(dr.gather(mi.Float, model.log_intensity, mi.UInt32(0)))
        plastic, slope = plastic_at(field, points.uv, valid)
        n = bent_normal(points, slope)
        straight = direct(points, plastic, model.coat, n, position, intensity, seen)
        a = b = straight
        expected = straight + expected_bounce(model, points, plastic, n, batch.view, intensity)
        if o.directions > 0:
            a, b = (
                straight
                + bounced(mesh, field, model, points, plastic, n, position, intensity, rng, o)
                for _ in range(2)
            )
        e = min(1.5 * i / o.steps, 1.0)
        sigma = dr.opaque(mi.Float, o.robust[0] ** (1 - e) * o.robust[1] ** e)
        saturated = saturated_at(bank, batch.view)
        trust = calm * robust_weight(dr.detach(expected) - batch.rgb, batch.rgb, sigma)
        fit = paired_loss(a, b, batch.rgb, valid, trust, saturated)
        if o.patches > 0:
            counts = valid & well_exposed(batch.rgb, saturated)
            alike = pyramid_loss(a, b, batch.rgb, dr.select(counts, calm, 0)) + ssim_loss(
                a, b, batch.rgb, counts
            )
            fit += dr.opaque(mi.Float, o.patches) * alike
        bend = slope.x * points.t + slope.y * points.b
        prior = gloss_prior(model, plastic, points, near, valid, o) + flash_slope_prior(
            field, bend, close, valid, o
        )
        offset_z = dr.abs(dr.gather(mi.Float, model.offset, mi.UInt32(2)))
        dr.backward(fit + prior + o.offset_z * offset_z)
        gradients = {name: dr.grad(p) for name, p in params.items()}
        dr.disable_grad(*params.values())
        dr.eval(gradients, fit)
        colour_rate = o.colour_rate * decay * min(1.0, 10 * i / o.steps)  # the lobes settle first
        field.diffuse = adam["diffuse"].step(
            dr.detach(field.diffuse), gradients["diffuse"], colour_rate
        )
        field.lobe = adam["lobe"].step(
            dr.detach(field.lobe), gradients["lobe"], o.alpha_rate * decay, ratio
        )
        slope_rate = o.slope_rate * decay * (i >= o.slope_begin * o.steps)
        field.slope = adam["slope"].step(dr.detach(field.slope), gradients["slope"], slope_rate)
        model.offset = adam["offset"].step(
            dr.detach(model.offset), gradients["offset"], o.offset_rate * decay
        )
        model.log_intensity = adam["log_intensity"].step(
            dr.detach(model.log_intensity), gradients["log_intensity"], o.intensity_rate * decay
        )
        if model.kinship is not None:
            with dr.suspend_grad():
                common = model.kinship.spread(model.kinship.level)
                keep = 1 - (1 - model.kinship.own(o.own)) * dr.opaque(mi.Float, decay)
                field.lobe = common + keep * (field.lobe - common)
                if i % (o.share_every if 20 * i > o.steps else 2) == 0:
                    share(points, batch, plastic, n, position, intensity, seen, calm, sigma, decay)
        if i % RESCALE == RESCALE - 1:
            rescale(model, brightest)
        project_plastic(field)
        dr.eval(model.offset, model.log_intensity, field.diffuse, field.lobe, field.slope)
        return {"colour": fit}

    def share(points, batch, plastic, n, position, intensity, seen, calm, sigma, decay):
        n, position, intensity, plastic = (dr.detach(v) for v in (n, position, intensity, plastic))
        photo = mi.Color3f(batch.rgb)
        for _ in range(BOUNCE_SAMPLES if o.directions > 0 else 0):
            photo -= (
                bounced(mesh, field, model, points, plastic, n, position, intensity, rng, o)
                / BOUNCE_SAMPLES
            )
            dr.eval(photo, rng)
        now = direct(points, plastic, model.coat, n, position, intensity, seen)
        now += expected_bounce(model, points, plastic, n, batch.view, intensity)
        counts = points.valid & well_exposed(batch.rgb, saturated_at(bank, batch.view))
        weight = display_weight(batch.rgb) * dr.select(
            counts, calm * robust_weight(now - batch.rgb, batch.rgb, sigma), 0
        )
        dr.eval(n, position, intensity, photo, weight, plastic)
        shade = lambda p: direct(points, p, model.coat, n, position, intensity, seen)  # noqa: E731
        told, _ = plastic_at(beginning, points.uv, points.valid)
        plastic = Plastic(told.diffuse, plastic.specular, plastic.alpha)
        share_evidence(
            model.kinship, field, points.uv, plastic, shade, photo, weight, o.share * decay
        )

    def state() -> dict:
        values = {"diffuse": field.diffuse, "lobe": field.lobe, "slope": field.slope}
        values |= {"offset": model.offset, "log_intensity": model.log_intensity}
        values |= (
            {"level": model.kinship.level, "sums": model.kinship.sums}
            if model.kinship is not None
            else {}
        )
        return {name: np.array(value) for name, value in values.items()} | memory(rng, adam)

    def textures(uv, valid):
        at, _ = plastic_at(field, uv, valid)
        return [at.diffuse, at.specular, at.alpha]

    run_steps(stage, first, o.steps, step, state, preview=surface_preview(bank, mesh, textures))
    return model


def brightest_albedo(field: PlasticField) -> float:
    """The 99th percentile over texels of the brightest channel of the diffuse albedo."""
    return float(np.percentile(np.array(field.diffuse).reshape(-1, 4)[:, :3].max(1), 99))


def rescale(model: FlashModel, brightest: float) -> None:
    """Albedos and intensity changed by a factor and its inverse, which direct light does not
    notice, so that the diffuse albedo is as bright as it was. What inter-reflection there is rests
    on that factor; it must not drift with chance along a valley so flat."""
    factor = dr.opaque(mi.Float, brightest_albedo(model.field) / max(brightest, 1e-6))

    def specular(lobe):
        return dr.select(dr.arange(mi.UInt32, dr.width(lobe)) % 2 == 0, lobe / factor, lobe)

    model.field.diffuse = model.field.diffuse / factor
    model.field.lobe = specular(model.field.lobe)
    model.log_intensity = model.log_intensity + dr.log(factor)
    if model.kinship is not None:
        model.kinship.level = specular(model.kinship.level)


def offset_of(flat):
    """Float [3] -> Vector3f of width 1."""
    return mi.Vector3f(*[dr.gather(mi.Float, flat, mi.UInt32(k)) for k in range(3)])


def bounced(
    mesh, field, model, points, plastic, n, position, intensity, rng, o: FlashSurfaceOptions
):
    """Mean of `directions` estimates of the inter-reflected light."""
    total = mi.Color3f(0)
    for _ in range(o.directions):
        total += indirect(
            mesh,
            field,
            model.coat,
            points,
            plastic,
            n,
            position,
            intensity,
            rng,
            o.bounces,
            o.shadow,
        )
    return total / o.directions


def calm_weights(bank: PixelBank, cameras, edge: float):
    """Float [total]: 1 where a photo is even, less where neighbouring pixels differ by more than
    about `edge` (display values): edges of paint, shape and shadow, where a pixel mixes what a ray
    through its middle cannot. From the photo alone."""
    rgbm, weights, begin = np.array(bank.rgbm).reshape(-1, 4), [], 0
    kernel = np.ones((3, 3), np.uint8)
    for camera in cameras:
        count = camera.width * camera.height
        shown = np.minimum(
            srgb_from_linear(
                rgbm[begin : begin + count, :3].reshape(camera.height, camera.width, 3)
            ),
            1.5,
        )
        contrast = (cv2.dilate(shown, kernel) - cv2.erode(shown, kernel)).max(-1)
        weights.append((1 / (1 + (contrast / edge) ** 2)).astype(np.float32).ravel())
        begin += count
    return mi.Float(np.concatenate(weights))


def expected_bounce(model: FlashModel, points: Points, plastic, n, view, intensity):
    """Color3f, detached: the inter-reflected light as it was known before the pass. It is rough,
    but without noise: a weight that saw the noise of an estimate would take sides, for the dark
    ones."""
    if model.around is None:
        return mi.Color3f(0)
    with dr.suspend_grad():
        at, cos_v = dr.detach(plastic), dr.abs(dr.dot(dr.detach(n), points.v))
        entered = model.around.at(view, points.uv) * (dr.detach(intensity) * model.around.enters)
        return base_radiance(at.diffuse, model.coat, cos_v, at.alpha, entered)


def paired_loss(a, b, target, valid, trust, saturated):
    """Mean of w (a - L*)(b - L*) with w of the photo, times trust (Float). A saturated pixel says
    only "at least this bright"."""
    value = dual_values(a, b, target, saturated) * trust
    return dr.sum(dr.select(valid, value, 0)) / dr.maximum(
        dr.sum(dr.select(valid, mi.Float(1), 0)), 1
    )


def robust_weight(difference, target, sigma):
    """Geman & McClure's weight of a residual (Color3f): 1 / (1 + r^2 / sigma^2)^2 with r in display
    values."""
    far = dr.square(difference) * display_weight(target)
    return dr.rcp(dr.square(1 + (far.x + far.y + far.z) / (3 * dr.square(sigma))))


def texel_features(model: FlashModel, uv, active):
    """Bilinear look-up of the features (Vector4f), detached."""
    from relit.materials.field import texels_at

    out = mi.Vector4f(0)
    for i, w in texels_at(model.field, uv):
        out = dr.fma(dr.gather(mi.Vector4f, model.features, i, active), w, out)
    return dr.detach(out)


def gloss_prior(
    model: FlashModel, plastic, points: Points, near: Points, valid, o: FlashSurfaceOptions
):
    """Neighbours of like features share specular albedo and alpha; alpha beyond .5 is rare (PIR Eq.
    9, L_smooth and L_α)."""
    there, _ = plastic_at(model.field, near.uv, near.valid)
    distance = dr.squared_norm(
        texel_features(model, near.uv, near.valid) - texel_features(model, points.uv, valid)
    )
    alike = dr.select(near.valid & valid, dr.exp(-distance / (2 * o.width**2)), 0)
    change = dr.abs(there.specular - plastic.specular) + 2 * dr.abs(there.alpha - plastic.alpha)
    wide = dr.select(valid, dr.maximum(plastic.alpha - 0.5, 0), 0)
    return dr.opaque(mi.Float, o.smooth) * dr.mean(alike * change) + o.alpha_range * dr.mean(wide)


def flash_slope_prior(field: PlasticField, bend, close: Points, valid, o: FlashSurfaceOptions):
    """Normal maps are small, and change little between neighbours. bend: Vector3f, slope.x t +
    slope.y b at the points."""
    _, slope = plastic_at(field, close.uv, close.valid)
    difference = bend - (slope.x * close.t + slope.y * close.b)
    small = o.slope_small * dr.select(valid, dr.squared_norm(bend), 0)
    smooth = o.slope_smooth * dr.select(valid & close.valid, dr.norm(difference + 1e-5), 0)
    return dr.mean(small + smooth)

"""The surface pass of flash captures: rough-plastic textures, a normal map, and the flash itself,
on a fixed mesh.

Each step takes some thousand pixels of all photos. Direct light is exact; inter-reflection is
estimated twice and independently, so that the product of the two residuals is unbiased for the
squared error (rendering/transport_flash.py). An over-exposed pixel has no say over lobes and
patches, and none over a texel that is brighter yet.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np

from relit.conventions import srgb_from_linear
from relit.fit.flash.lobe_clusters import Kinship, share_evidence
from relit.fit.flash.patches import draw_patches, pyramid_loss, ssim_loss
from relit.fit.passes.losses import display_weight, dual_values
from relit.fit.passes.optimiser import Adam, Variable, cosine_decay
from relit.fit.passes.pixels import PixelBank, draw_pixels, saturated_at, well_exposed
from relit.fit.passes.surface_loop import drawn_points, neighbour_points, run_surface
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


@dataclass
class FlashSample:
    """What a step of `FlashTerms` draws. near, close: neighbours for the priors of gloss and normal
    map. calm: Float, see `calm_weights`. seen: Float, visibility of the flash. shading: what the
    points are shaded with, set by the loss. sigma: see `robust_weight`."""

    batch: Any
    points: Points
    near: Points
    close: Points
    calm: Any
    seen: Any
    shading: Shading | None = None
    sigma: Any = None


@dataclass(frozen=True)
class Shading:
    """plastic: material at the points. n: bent normals. position: of the flash for each point.
    intensity: Float of width 1."""

    plastic: Any
    n: Any
    position: Any
    intensity: Any

    def detached(self) -> Shading:
        return Shading(
            *(dr.detach(v) for v in (self.plastic, self.n, self.position, self.intensity))
        )


class FlashTerms:
    """Rough-plastic textures under a flash beside the lens, for `run_surface`."""

    def __init__(
        self,
        bank: PixelBank,
        cameras,
        mesh: TraceableMesh,
        model: FlashModel,
        options: FlashSurfaceOptions,
    ):
        self.bank, self.mesh, self.model, self.options = bank, mesh, model, options
        self.even = calm_weights(bank, cameras, options.edge)
        field = model.field
        self.beginning = PlasticField(field.size, mi.Float(field.diffuse), field.lobe, field.slope)
        self.brightest = brightest_albedo(self.beginning)
        self.rng: Any = None

    def decay(self, i: int) -> float:
        return cosine_decay(i / self.options.steps, 0.03)

    def variables(self) -> list[Variable]:
        o, field, model, decay = self.options, self.model.field, self.model, self.decay
        ratio = np.tile(np.array([o.specular_rate / o.alpha_rate, 1], np.float32), field.size**2)
        begin = o.slope_begin * o.steps

        def diffuse(i: int) -> float:  # the lobes settle first
            return o.colour_rate * decay(i) * min(1.0, 10 * i / o.steps)

        return [
            Variable("diffuse", field, "diffuse", diffuse),
            Variable(
                "lobe",
                field,
                "lobe",
                lambda i: o.alpha_rate * decay(i),
                mi.Float(ratio),
                floor=o.lobe_calm,
            ),
            Variable(
                "slope",
                field,
                "slope",
                lambda i: o.slope_rate * decay(i) * (i >= begin),
                floor=o.slope_calm,
            ),
            Variable("offset", model, "offset", lambda i: o.offset_rate * decay(i)),
            Variable(
                "log_intensity", model, "log_intensity", lambda i: o.intensity_rate * decay(i)
            ),
        ]

    def optimisers(self) -> dict[str, Adam]:
        return {}

    def state(self) -> dict[str, np.ndarray]:
        kinship = self.model.kinship
        if kinship is None:
            return {}
        return {"level": np.array(kinship.level), "sums": np.array(kinship.sums)}

    def restore(self, saved: Mapping[str, np.ndarray]) -> None:
        if self.model.kinship is not None:
            self.model.kinship.take_up(saved["level"], saved["sums"])

    def begin(self, i: int, rng: Any) -> FlashSample:
        o, bank, mesh = self.options, self.bank, self.mesh
        self.rng = rng
        draw = draw_patches if o.patches > 0 else draw_pixels
        batch, points = drawn_points(bank, mesh, rng, o.points, draw)
        valid, calm = points.valid, dr.gather(mi.Float, self.even, batch.pixel)
        dr.eval(batch.view, calm)
        near = neighbour_points(mesh, points, o.reach, rng)
        close = neighbour_points(mesh, points, o.slope_reach, rng)
        dr.eval(near, close, rng)
        with dr.suspend_grad():
            flash = light_position(bank.cameras, batch.view, offset_of(self.model.offset))
            seen = lit(mesh, points, flash, valid) if o.shadow else dr.select(valid, mi.Float(1), 0)
            dr.eval(seen)
        return FlashSample(batch, points, near, close, calm, seen)

    def loss(self, i: int, sample: FlashSample) -> tuple[Any, Any]:
        o, model, points, batch = self.options, self.model, sample.points, sample.batch
        valid = points.valid
        position = light_position(self.bank.cameras, batch.view, offset_of(model.offset))
        intensity = dr.exp(dr.gather(mi.Float, model.log_intensity, mi.UInt32(0)))
        plastic, slope = plastic_at(model.field, points.uv, valid)
        shading = Shading(plastic, bent_normal(points, slope), position, intensity)
        sample.shading = shading
        straight = self._direct(sample, shading)
        a = b = straight
        expected = straight + expected_bounce(
            model, points, plastic, shading.n, batch.view, intensity
        )
        if o.directions > 0:
            a, b = (straight + self._bounced(points, shading) for _ in range(2))
        e = min(1.5 * i / o.steps, 1.0)
        sample.sigma = dr.opaque(mi.Float, o.robust[0] ** (1 - e) * o.robust[1] ** e)
        saturated = saturated_at(self.bank, batch.view)
        residual = dr.detach(expected) - batch.rgb
        trust = sample.calm * robust_weight(residual, batch.rgb, sample.sigma)
        fit = paired_loss(a, b, batch.rgb, valid, trust, saturated)
        if o.patches > 0:
            counts = valid & well_exposed(batch.rgb, saturated)
            alike = pyramid_loss(a, b, batch.rgb, dr.select(counts, sample.calm, 0))
            alike = alike + ssim_loss(a, b, batch.rgb, counts)
            fit += dr.opaque(mi.Float, o.patches) * alike
        bend = slope.x * points.t + slope.y * points.b
        prior = gloss_prior(model, plastic, points, sample.near, valid, o)
        prior = prior + flash_slope_prior(model.field, bend, sample.close, valid, o)
        offset_z = dr.abs(dr.gather(mi.Float, model.offset, mi.UInt32(2)))
        return fit, fit + prior + o.offset_z * offset_z

    def finish(self, i: int, sample: FlashSample, gradients: Mapping[str, Any]) -> None:
        o, model, field = self.options, self.model, self.model.field
        if model.kinship is not None:
            with dr.suspend_grad():
                common = model.kinship.spread(model.kinship.level)
                decay = dr.opaque(mi.Float, self.decay(i))
                keep = 1 - (1 - model.kinship.own(o.own)) * decay
                field.lobe = common + keep * (field.lobe - common)
                if i % (o.share_every if 20 * i > o.steps else 2) == 0:
                    self._share(i, sample)
        if i % RESCALE == RESCALE - 1:
            rescale(model, self.brightest)
        project_plastic(field)
        dr.eval(model.offset, model.log_intensity, field.diffuse, field.lobe, field.slope)

    def _direct(self, sample: FlashSample, shading: Shading, plastic: Any = None) -> Any:
        """Radiance by the flash alone (Color3f). plastic: in the place of the shading's own."""
        return direct(
            sample.points,
            shading.plastic if plastic is None else plastic,
            self.model.coat,
            shading.n,
            shading.position,
            shading.intensity,
            sample.seen,
        )

    def _bounced(self, points: Points, shading: Shading) -> Any:
        """Mean of `directions` estimates of the inter-reflected light."""
        o, model, total = self.options, self.model, mi.Color3f(0)
        for _ in range(o.directions):
            total += indirect(
                self.mesh,
                model.field,
                model.coat,
                points,
                shading.plastic,
                shading.n,
                shading.position,
                shading.intensity,
                self.rng,
                o.bounces,
                o.shadow,
            )
        return total / o.directions

    def _share(self, i: int, sample: FlashSample) -> None:
        """A step of the common lobes of like places, by the evidence of this sample."""
        o, model, batch, points = self.options, self.model, sample.batch, sample.points
        assert sample.shading is not None
        shading = sample.shading.detached()
        photo = mi.Color3f(batch.rgb)
        for _ in range(BOUNCE_SAMPLES if o.directions > 0 else 0):
            photo -= self._bounced(points, shading) / BOUNCE_SAMPLES
            dr.eval(photo, self.rng)
        now = self._direct(sample, shading)
        now += expected_bounce(
            model, points, shading.plastic, shading.n, batch.view, shading.intensity
        )
        counts = points.valid & well_exposed(batch.rgb, saturated_at(self.bank, batch.view))
        trust = sample.calm * robust_weight(now - batch.rgb, batch.rgb, sample.sigma)
        weight = display_weight(batch.rgb) * dr.select(counts, trust, 0)
        dr.eval(shading.n, shading.position, shading.intensity, photo, weight, shading.plastic)
        first, _ = plastic_at(self.beginning, points.uv, points.valid)
        plastic = Plastic(first.diffuse, shading.plastic.specular, shading.plastic.alpha)
        share_evidence(
            model.kinship,
            model.field,
            points.uv,
            plastic,
            lambda p: self._direct(sample, shading, p),
            photo,
            weight,
            o.share * self.decay(i),
        )

    def textures(self, uv: Any, valid: Any) -> list[Any]:
        at, _ = plastic_at(self.model.field, uv, valid)
        return [at.diffuse, at.specular, at.alpha]


def fit_flash_surface(terms: FlashTerms, stage: Any, seed: int = 0) -> FlashModel:
    """Run the pass; returns the model of the terms, optimised. Resumes from the stage's checkpoint
    where there is one."""
    rng = mi.PCG32(size=terms.options.points, initstate=seed * 7919 + 17)
    run_surface(terms, terms.options.steps, rng, stage)
    return terms.model


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

"""The surface pass of a collection: one material, one light per photo.

As fit/passes/surface.py, whose priors and Monte Carlo estimate it shares; every point stands under
the light of the photo that shows it. Lights are few numbers each under a learnt prior
(lighting/per_photo.py). A photo that the model cannot explain is silenced: posterior scaling.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from relit.fit.collection.options import CollectionOptions
from relit.fit.passes.broad_steps import BroadSteps
from relit.fit.passes.losses import display_weight, dual_values, weighted_mean
from relit.fit.passes.material_priors import (
    ALBEDO_START,
    SurfaceOptions,
    common_scale,
    material_prior,
    parsimony,
)
from relit.fit.passes.optimiser import Adam, Variable, cosine_decay
from relit.fit.passes.pixels import PixelBank, saturated_at
from relit.fit.passes.surface import MaterialSchedule
from relit.fit.passes.surface_loop import drawn_points, neighbour_points, run_surface
from relit.geometry.mesh import vertex_areas
from relit.lighting.neural_pil import load_neural_pil
from relit.lighting.per_photo import (
    TEXELS,
    LightComponents,
    PhotoLights,
    load_light_prior,
    log_lights,
    mean_level,
)
from relit.materials.field import MaterialField, material_at, project, slope_at
from relit.rendering.transport import (
    Points,
    TraceableMesh,
    bent_normal,
    reflected,
    sample_lights,
)
from relit.scene import Mesh

LEAST = (
    0.02  # weight of a silenced photo: the material hardly hears it, its own light still follows
)
HISTORY = 1000  # losses in the ring buffer of posterior scaling


@dataclass(frozen=True)
class AlbedoMesh:
    """mesh: in the unit frame, with an atlas. albedo: (V, 3) colour of its vertices without light,
    linear, up to scale."""

    mesh: Mesh
    albedo: np.ndarray

    @property
    def scale(self) -> float:
        """Factor that gives the colours a mean of ALBEDO_START over the surface."""
        areas = vertex_areas(self.mesh)
        return ALBEDO_START / float((self.albedo * areas[:, None]).sum() / areas.sum() / 3)


@dataclass(frozen=True)
class PhotoLitMaterial:
    """Textures (S, S[, 3]) of a metallic-roughness material, linear: base_color, roughness,
    metallic, normal (tangent space). lights: (P, ROWS, COLUMNS, 3) radiance of each photo's
    environment, lat-long in the unit frame. weights: (P,) of the photos in the fit."""

    base_color: np.ndarray
    roughness: np.ndarray
    metallic: np.ndarray
    normal: np.ndarray
    lights: np.ndarray
    weights: np.ndarray


@dataclass(frozen=True)
class LightOptions:
    """rate: step of the lights' numbers. prior: weight of |c|^2 / 2 per photo. neutral: of the mean
    chroma of all lights: without it, base colour and lights drift apart in blue and orange.
    posterior: whether photos are scaled. anchor: weight of SAMURAI's L_init, the squared difference
    of base colour and the photos' own pixels at even exposure; it falls to a tenth within the share
    lambda_a of the steps.
    still: share of the steps in which the lights stay the prior's middle one, but for their gains:
    what all photos share is the object's.
    broad: share of the steps in which base colour also takes `BroadSteps`, one each share `window`
    of the steps."""

    rate: float = 0.03
    prior: float = 3e-5
    neutral: float = 1.0
    posterior: bool = True
    anchor: float = 0.0
    lambda_a: float = 0.27
    still: float = 0.1
    broad: float = 0.3
    window: float = 0.03


def light_options(options: CollectionOptions) -> LightOptions:
    """Those of the recipe, or of an ablation."""
    off = {"prior": 0.0, "neutral": 0.0} if "light_prior" in options.without else {}
    return LightOptions(
        posterior="posterior" not in options.without,
        anchor=options.init_colour,
        lambda_a=options.lambda_a,
        **off,
    )


@dataclass
class CollectionSurface:
    """coefficients: (V, K), gains: (V, 3) log: float32. losses: the last losses of single photos.
    weights: (V,) posterior."""

    material: MaterialField
    coefficients: np.ndarray
    gains: np.ndarray
    weights: np.ndarray
    family: object  # of lights: what makes maps of coefficients
    losses: list[float] = field(default_factory=list)

    def lights(self) -> np.ndarray:
        """(V, TEXELS * 3) log radiance."""
        return log_lights(self.coefficients, self.gains, self.family)


def light_family(options: CollectionOptions):
    """The lights that photos may stand under: the network at `light_network`, or what is
    shipped."""
    return (
        load_neural_pil(options.light_network)
        if options.light_network
        else LightComponents(*load_light_prior())
    )


def start_collection_surface(
    material: MaterialField, tints: np.ndarray, albedo: float, family=None
) -> CollectionSurface:
    """tints: (V, 3) mean radiance of the object in each photo; albedo: mean base colour. A light of
    radiance L shows albedo * L."""
    family = LightComponents(*load_light_prior()) if family is None else family
    gains = np.log(np.maximum(tints, 1e-3) / albedo / mean_level(family)).astype(np.float32)
    return CollectionSurface(
        material,
        np.zeros((len(tints), family.size), np.float32),
        gains,
        np.ones(len(tints), np.float32),
        family,
    )


def posterior(losses: np.ndarray, history: list[float]) -> np.ndarray:
    """clip(tanh((μ - L) / σ) + 1, 0, 1), μ and σ of the ring buffer. SAMURAI Sec. 3.1 prints
    max(tanh(.) + 1, 1), which cannot silence a bad photo; its code clips, and so does this."""
    if len(history) < 20:
        return np.ones(len(losses), np.float32)
    mean, deviation = float(np.mean(history)), float(np.std(history))
    return np.clip(np.tanh((mean - losses) / max(deviation, 1e-6)) + 1, 0, 1).astype(np.float32)


@dataclass
class PhotoLightSample:
    """What a step of `PhotoLightTerms` draws. near: neighbours for the priors. of: the light of
    each direction. drawn: see `sample_lights`. each: the data term of each point, set by the
    loss, as `a` and `b`, the two estimates, and `weight`, the posterior of its photo."""

    batch: Any
    points: Points
    near: Points
    smooth_n: Any
    of: Any
    drawn: Any
    shift: Any
    each: Any = None
    a: Any = None
    b: Any = None
    weight: Any = None


class PhotoLightTerms:
    """Metallic-roughness textures under one light per photo, for `run_surface`.

    frozen: only lights move (held-out photos).
    """

    def __init__(
        self,
        bank: PixelBank,
        mesh: TraceableMesh,
        model: CollectionSurface,
        options: SurfaceOptions,
        light: LightOptions,
        frozen: bool = False,
    ):
        self.bank, self.mesh, self.model = bank, mesh, model
        self.options, self.light, self.frozen = options, light, frozen
        self.even = mean_level(model.family)
        # (V, 3) light of each photo as the pass begins, which the mesh's own colours go with
        begun = np.exp(model.gains) * self.even
        self.level = mi.Float(begun.astype(np.float32).ravel())  # on average, for what blocks
        self.exposure = mi.Float(begun.mean(1).astype(np.float32))
        self.running = np.zeros(bank.views)  # running mean of each photo's loss
        self.leaf: Any = mi.Float(model.lights().ravel())
        self.lights = PhotoLights(dr.exp(self.leaf), bank.views)
        self.schedule = MaterialSchedule(options, options.steps)
        self.adam = {
            "coefficients": Adam(model.coefficients.size),
            "gains": Adam(model.gains.size),
            "scale": Adam(3),
        }
        self.broad = None if frozen else BroadSteps(mesh.mesh, options.texture)
        self.window = max(5, round(light.window * options.steps))

    def variables(self) -> list[Variable]:
        lights = Variable("lights", self, "leaf", kept=False)
        material = [] if self.frozen else self.schedule.variables(self.model.material)
        return [lights, *material]

    def optimisers(self) -> dict[str, Adam]:
        return self.adam

    def state(self) -> dict[str, np.ndarray]:
        model = self.model
        kept = {name: getattr(model, name) for name in ("coefficients", "gains", "weights")}
        if self.broad is not None:
            kept["broad"] = np.stack([self.broad.shown, self.broad.predicted])
        return {**kept, "losses": np.array(model.losses), "running": self.running}

    def restore(self, saved: Mapping[str, np.ndarray]) -> None:
        model = self.model
        for name in ("coefficients", "gains", "weights"):
            setattr(model, name, saved[name])
        model.losses = saved.get("losses", np.zeros(0)).tolist()
        self.running = saved.get("running", self.running)
        if self.broad is not None and "broad" in saved:
            self.broad.shown, self.broad.predicted = saved["broad"]
        self._follow_lights()

    def _follow_lights(self) -> None:
        self.lights.radiance = dr.exp(mi.Float(self.model.lights().ravel()))
        dr.eval(self.lights.radiance)
        self.lights.rebuild()

    def begin(self, i: int, rng: Any) -> PhotoLightSample:
        o, mesh, material = self.options, self.mesh, self.model.material
        batch, points = drawn_points(self.bank, mesh, rng, o.points)
        valid = points.valid
        dr.eval(batch.view)
        near = neighbour_points(mesh, points, o.similarity_reach, rng)
        dr.eval(near, rng)
        shift = dr.opaque(mi.UInt32, 1 + (i * 7919) % (o.points - 1))
        of = self.lights.of(dr.repeat(batch.view, o.directions))
        with dr.suspend_grad():
            start = material_at(material, points.uv, valid)
            smooth_n = points.n
            points.n = bent_normal(points, slope_at(material, points.uv, valid))
            dr.eval(start.base, start.roughness, start.metallic, points.n)
        drawn = sample_lights(mesh, points, start, of, o.directions, rng)
        # what blocks is lit by the same photo's light
        drawn.blocked = drawn.blocked * dr.gather(mi.Color3f, self.level, of.light)
        dr.eval(drawn.blocked)
        self.leaf = mi.Float(self.model.lights().ravel())
        return PhotoLightSample(batch, points, near, smooth_n, of, drawn, shift)

    def loss(self, i: int, sample: PhotoLightSample) -> tuple[Any, Any]:
        points, batch, material = sample.points, sample.batch, self.model.material
        valid = points.valid
        self.lights.radiance = dr.exp(self.leaf)
        surface = material_at(material, points.uv, valid)
        points.n = sample.smooth_n
        slope = slope_at(material, points.uv, valid)
        points.n = bent_normal(points, slope)
        sample.a, sample.b = reflected(points, sample.drawn, surface, sample.of)
        sample.weight = dr.gather(mi.Float, mi.Float(self._trust()), batch.view)
        saturated = saturated_at(self.bank, batch.view)
        sample.each = dual_values(sample.a, sample.b, batch.rgb, saturated)
        fit = weighted_mean(sample.each, dr.select(valid, sample.weight, 0))
        return fit, fit if self.frozen else fit + self._prior(i, sample, surface, slope)

    def _trust(self) -> np.ndarray:
        """(V,) weight of each photo's residuals."""
        return np.maximum(self.model.weights, LEAST).astype(np.float32)

    def _prior(self, i: int, sample: PhotoLightSample, surface: Any, slope: Any) -> Any:
        o, light, material = self.options, self.light, self.model.material
        points, valid, batch = sample.points, sample.points.valid, sample.batch
        smoothing = dr.opaque(mi.Float, o.smooth_colour)
        scale = common_scale(surface, valid, o.scale_power)
        prior = material_prior(material, surface, sample.near, valid, scale, o, smoothing)
        if o.parsimony > 0:
            prior = prior + parsimony(material, surface, points.uv, valid, scale, sample.shift, o)
        prior = prior + o.slope_small * dr.mean(dr.select(valid, dr.squared_norm(slope), 0))
        if light.anchor > 0:
            pull = dr.opaque(mi.Float, light.anchor * 0.1 ** (i / (light.lambda_a * o.steps)))
            away = surface.base - batch.rgb / dr.gather(mi.Float, self.exposure, batch.view)
            prior = prior + pull * dr.mean(dr.select(valid, dr.squared_norm(away), 0))
        return prior

    def finish(self, i: int, sample: PhotoLightSample, gradients: Mapping[str, Any]) -> None:
        material = self.model.material
        dr.eval(sample.each)
        if not self.frozen:
            project(material)
            dr.eval(material.colour, material.metallic, material.slope)
        self._move_lights(i, gradients)
        if self.broad is not None and i < self.light.broad * self.options.steps:
            self._broad_step(i, sample)
        if self.light.posterior and not self.frozen:
            self._weigh_photos(i, sample)

    def _move_lights(self, i: int, gradients: Mapping[str, Any]) -> None:
        model, o, light, views = self.model, self.options, self.light, self.bank.views
        decay = cosine_decay(i / o.steps, 0.05)
        # the scaling is the material's, not the lights'
        g = np.array(gradients["lights"]).reshape(views, TEXELS * 3) / self._trust()[:, None]
        gc = model.family.pull_back(model.coefficients, g)
        gc = gc + light.prior / views * model.coefficients
        gg = g.reshape(views, TEXELS, 3).sum(1)
        if not self.frozen:
            chroma = model.gains + np.log(self.even)
            chroma = chroma - chroma.mean(1, keepdims=True)
            gg = gg + light.neutral / views * np.mean(chroma, 0)
        rate = light.rate * decay
        if not self.frozen and o.exchange_rate > 0:
            pull, rate_of_scale = gradients["colour"], o.exchange_rate * decay
            move = exchange_scale(self.adam["scale"], model.material, pull, gg, rate_of_scale)
            model.gains = model.gains + move
        moves = self.frozen or i >= light.still * o.steps
        flat = lambda x: mi.Float(np.asarray(x, np.float32).ravel())  # noqa: E731
        c = self.adam["coefficients"].step(
            flat(model.coefficients), flat(gc), 2 * rate if moves else 0.0
        )
        k = self.adam["gains"].step(flat(model.gains), flat(gg), rate)
        dr.eval(c, k)
        model.coefficients, model.gains = (
            np.array(c).reshape(views, -1),
            np.array(k).reshape(views, 3),
        )
        self._follow_lights()

    def _broad_step(self, i: int, sample: PhotoLightSample) -> None:
        broad, material, valid = self.broad, self.model.material, sample.points.valid
        assert broad is not None
        rgb = sample.batch.rgb
        weight = display_weight(rgb) * dr.select(valid, sample.weight, 0)
        broad.add(sample.points.uv, weight, sample.a, sample.b, rgb)
        if i % self.window == self.window - 1:
            material.colour = material.colour * mi.Float(broad.factors().ravel())
            project(material)
            dr.eval(material.colour)

    def _weigh_photos(self, i: int, sample: PhotoLightSample) -> None:
        """Follow each photo's loss, put it into the ring buffer, set the weights once the lights
        have settled."""
        model = self.model
        valid, view = np.array(sample.points.valid), np.array(sample.batch.view)
        sums = np.bincount(view[valid], np.array(sample.each)[valid], len(model.weights))
        counts = np.bincount(view[valid], minlength=len(model.weights))
        seen, mean = counts > 0, sums / np.maximum(counts, 1)
        followed = np.where(self.running == 0, mean, 0.95 * self.running + 0.05 * mean)
        self.running = np.where(seen, followed, self.running)
        model.losses = [*model.losses, *self.running[seen].tolist()][-HISTORY:]
        if i > 0.15 * self.options.steps:
            model.weights = posterior(self.running, model.losses)

    def textures(self, uv: Any, valid: Any) -> list[Any]:
        at = material_at(self.model.material, uv, valid)
        return [at.base, at.roughness]


def fit_collection_surface(terms: PhotoLightTerms, stage: Any, seed: int = 0) -> CollectionSurface:
    """Run the pass; returns the model of the terms, optimised. Resumes from the stage's
    checkpoint."""
    rng = mi.PCG32(size=terms.options.points, initstate=seed * 7919 + 13)
    run_surface(terms, terms.options.steps, rng, stage)
    return terms.model


def exchange_scale(
    adam: Adam, material: MaterialField, colour_gradient, gain_gradient: np.ndarray, rate: float
) -> np.ndarray:
    """One step along the valley in which all lights grow and the base colour shrinks, channel by
    channel (see fit/passes/exchange.py). What is not diffuse, reflections by a dielectric's F0
    above all, tells the scale. gain_gradient: (V, 3). Returns what the log gains change by (3,);
    the base colour has been divided by its exponential."""
    base, pull = dr.unravel(mi.Vector4f, material.colour), dr.unravel(mi.Vector4f, colour_gradient)
    sums = np.array([dr.sum(base[i] * pull[i])[0] for i in range(3)])
    move = np.array(
        adam.step(
            dr.zeros(mi.Float, 3), mi.Float((gain_gradient.sum(0) - sums).astype(np.float32)), rate
        )
    )
    factor = [float(np.exp(-v)) for v in move]
    scaled = [base[i] * dr.opaque(mi.Float, factor[i]) for i in range(3)]
    material.colour = dr.ravel(mi.Vector4f(*scaled, base.w))
    project(material)
    dr.eval(material.colour)
    return move.astype(np.float32)

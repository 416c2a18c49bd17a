"""The surface pass of a collection: one material, one light per photo.

As fit/passes/surface.py, whose priors and Monte Carlo estimate it shares; every point stands under
the light of the photo that shows it. Lights are few numbers each under a learnt prior
(lighting/per_photo.py). A photo that the model cannot explain is silenced: posterior scaling.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi
import numpy as np

from relit.fit.collection.options import CollectionOptions
from relit.fit.passes.broad_steps import BroadSteps
from relit.fit.passes.losses import display_weight, weighted_mean
from relit.fit.passes.optimiser import Adam, cosine_decay, memory, recall, run_steps
from relit.fit.passes.pixels import PixelBank, saturated_at
from relit.fit.passes.preview import surface_preview
from relit.fit.passes.surface import (
    SurfaceOptions,
    common_scale,
    drawn_points,
    dual_values,
    material_prior,
    neighbour_points,
    parsimony,
)
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
from relit.rendering.transport import TraceableMesh, bent_normal, reflected, sample_lights

LEAST = (
    0.02  # weight of a silenced photo: the material hardly hears it, its own light still follows
)
HISTORY = 1000  # losses in the ring buffer of posterior scaling


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


def fit_collection_surface(
    bank: PixelBank,
    mesh: TraceableMesh,
    model: CollectionSurface,
    options: SurfaceOptions,
    light: LightOptions,
    stage,
    seed: int = 0,
    frozen: bool = False,
) -> CollectionSurface:
    """Run the pass; returns the same model, optimised. frozen: only lights move (held-out photos).
    Resumes from the stage's checkpoint."""
    material, first, views, count = model.material, 0, bank.views, options.points
    even = mean_level(model.family)
    begun = (
        np.exp(model.gains) * even
    )  # (V, 3) light of each photo as the pass begins, which the mesh's own colours go with
    running = np.zeros(views)
    saved = stage.load("checkpoint")
    if saved:
        first = int(saved["step"])
        material.colour, material.metallic, material.slope = (
            mi.Float(saved[n]) for n in ("colour", "metallic", "slope")
        )
        model.coefficients, model.gains, model.weights = (
            saved["coefficients"],
            saved["gains"],
            saved["weights"],
        )
        model.losses, running = (
            saved.get("losses", np.zeros(0)).tolist(),
            saved.get("running", running),
        )
    rng = mi.PCG32(size=count, initstate=seed * 7919 + 13)
    adam_colour, adam_metallic, adam_slope = (
        Adam(dr.width(p)) for p in (material.colour, material.metallic, material.slope)
    )
    adam_slope.floor = options.slope_calm
    adam_c, adam_g = Adam(model.coefficients.size), Adam(model.gains.size)
    adam_s = Adam(3)
    adam = {"colour": adam_colour, "metallic": adam_metallic, "slope": adam_slope}
    adam |= {"coefficients": adam_c, "gains": adam_g, "scale": adam_s}
    recall(saved, rng, adam)
    ratio = mi.Float(
        np.tile(
            np.array([1, 1, 1, options.roughness_rate / options.colour_rate], np.float32),
            material.size**2,
        )
    )
    lights = PhotoLights(dr.exp(mi.Float(model.lights().ravel())), views)
    level = mi.Float(
        begun.astype(np.float32).ravel()
    )  # what arrives on average: for what blocks a direction
    exposure = mi.Float(begun.mean(1).astype(np.float32))

    broad = (
        None
        if frozen or first >= light.broad * options.steps
        else BroadSteps(mesh.mesh, options.texture)
    )
    if broad is not None and saved and "broad" in saved:
        broad.shown, broad.predicted = saved["broad"]
    window = max(5, round(light.window * options.steps))

    def step(i: int) -> dict:
        nonlocal running
        decay = cosine_decay(i / options.steps, 0.05)
        warm = min(1.0, 0.05 + (i / (options.warm * options.steps)) ** 2)
        batch, points = drawn_points(bank, mesh, rng, count)
        valid = points.valid
        dr.eval(batch.view)
        near = neighbour_points(mesh, points, options.similarity_reach, rng)
        dr.eval(near, rng)
        shift = dr.opaque(mi.UInt32, 1 + (i * 7919) % (count - 1))
        of = lights.of(dr.repeat(batch.view, options.directions))
        with dr.suspend_grad():
            start = material_at(material, points.uv, valid)
            smooth_n = points.n
            points.n = bent_normal(points, slope_at(material, points.uv, valid))
            dr.eval(start.base, start.roughness, start.metallic, points.n)
        drawn = sample_lights(mesh, points, start, of, options.directions, rng)
        drawn.blocked = drawn.blocked * dr.gather(
            mi.Color3f, level, of.light
        )  # what blocks is lit by the same photo's light
        dr.eval(drawn.blocked)

        leaf = mi.Float(model.lights().ravel())
        params = [leaf] if frozen else [leaf, material.colour, material.metallic, material.slope]
        dr.enable_grad(*params)
        lights.radiance = dr.exp(leaf)
        surface = material_at(material, points.uv, valid)
        points.n = smooth_n
        slope = slope_at(material, points.uv, valid)
        points.n = bent_normal(points, slope)
        a, b = reflected(points, drawn, surface, of)
        heard = np.maximum(model.weights, LEAST).astype(np.float32)
        weight = dr.gather(mi.Float, mi.Float(heard), batch.view)
        each = dual_values(a, b, batch.rgb, saturated_at(bank, batch.view))
        fit = weighted_mean(each, dr.select(valid, weight, 0))
        loss = fit
        if not frozen:
            smoothing = dr.opaque(mi.Float, options.smooth_colour)
            scale = common_scale(surface, valid, options.scale_power)
            loss = loss + material_prior(material, surface, near, valid, scale, options, smoothing)
            if options.parsimony > 0:
                loss = loss + parsimony(material, surface, points.uv, valid, scale, shift, options)
            loss = loss + options.slope_small * dr.mean(dr.select(valid, dr.squared_norm(slope), 0))
            if light.anchor > 0:
                pull = dr.opaque(
                    mi.Float, light.anchor * 0.1 ** (i / (light.lambda_a * options.steps))
                )
                away = surface.base - batch.rgb / dr.gather(mi.Float, exposure, batch.view)
                loss = loss + pull * dr.mean(dr.select(valid, dr.squared_norm(away), 0))
        dr.backward(loss)
        gradients = [dr.grad(p) for p in params]
        dr.disable_grad(*params)
        dr.eval(gradients, fit, each)
        if not frozen:
            material.colour = adam_colour.step(
                dr.detach(material.colour), gradients[1], options.colour_rate * decay * warm, ratio
            )
            material.metallic = adam_metallic.step(
                dr.detach(material.metallic), gradients[2], options.metallic_rate * decay
            )
            slope_rate = options.slope_rate * decay * (i >= options.slope_begin * options.steps)
            material.slope = adam_slope.step(dr.detach(material.slope), gradients[3], slope_rate)
            project(material)
            dr.eval(material.colour, material.metallic, material.slope)
        g = (
            np.array(gradients[0]).reshape(views, TEXELS * 3) / heard[:, None]
        )  # the scaling is the material's, not the lights'
        gc = (
            model.family.pull_back(model.coefficients, g) + light.prior / views * model.coefficients
        )
        gg = g.reshape(views, TEXELS, 3).sum(1)
        if not frozen:
            chroma = model.gains + np.log(even)
            chroma = chroma - chroma.mean(1, keepdims=True)
            gg = gg + light.neutral / views * np.mean(chroma, 0)
        rate = light.rate * decay
        if not frozen and options.exchange_rate > 0:
            move = exchange_scale(adam_s, material, gradients[1], gg, options.exchange_rate * decay)
            model.gains = model.gains + move
        moves = frozen or i >= light.still * options.steps
        c = adam_c.step(
            mi.Float(model.coefficients.ravel()),
            mi.Float(gc.astype(np.float32).ravel()),
            2 * rate if moves else 0.0,
        )
        k = adam_g.step(
            mi.Float(model.gains.ravel()), mi.Float(gg.astype(np.float32).ravel()), rate
        )
        dr.eval(c, k)
        model.coefficients, model.gains = (
            np.array(c).reshape(views, -1),
            np.array(k).reshape(views, 3),
        )
        lights.radiance = dr.exp(mi.Float(model.lights().ravel()))
        dr.eval(lights.radiance)
        lights.rebuild()
        if broad is not None and i < light.broad * options.steps:
            broad.add(
                points.uv, display_weight(batch.rgb) * dr.select(valid, weight, 0), a, b, batch.rgb
            )
            if i % window == window - 1:
                material.colour = material.colour * mi.Float(broad.factors().ravel())
                project(material)
                dr.eval(material.colour)
        if light.posterior and not frozen:
            running = _watch(
                model,
                np.array(each),
                np.array(valid),
                np.array(batch.view),
                running,
                i,
                options.steps,
            )
        return {"colour": fit}

    def state() -> dict:
        arrays = {
            "colour": np.array(material.colour),
            "metallic": np.array(material.metallic),
            "slope": np.array(material.slope),
        }
        arrays |= {
            "coefficients": model.coefficients,
            "gains": model.gains,
            "weights": model.weights,
        }
        arrays |= {} if broad is None else {"broad": np.stack([broad.shown, broad.predicted])}
        return {**arrays, "losses": np.array(model.losses), "running": running, **memory(rng, adam)}

    def textures(uv, valid):
        at = material_at(material, uv, valid)
        return [at.base, at.roughness]

    run_steps(
        stage, first, options.steps, step, state, preview=surface_preview(bank, mesh, textures)
    )
    return model


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


def _watch(model: CollectionSurface, each, valid, view, running, i: int, steps: int) -> np.ndarray:
    """Follow each photo's loss, put it into the ring buffer, set the weights once the lights have
    settled. Returns the running means."""
    sums = np.bincount(view[valid], each[valid], len(model.weights))
    counts = np.bincount(view[valid], minlength=len(model.weights))
    seen = counts > 0
    mean = sums / np.maximum(counts, 1)
    running = np.where(seen, np.where(running == 0, mean, 0.95 * running + 0.05 * mean), running)
    model.losses = [*model.losses, *running[seen].tolist()][-HISTORY:]
    if i > 0.15 * steps:
        model.weights = posterior(running, model.losses)
    return running

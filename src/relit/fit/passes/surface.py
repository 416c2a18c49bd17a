"""The surface pass: metallic-roughness textures and the environment light, by Monte Carlo light
transport on the mesh.

Each step takes a few thousand pixels of all photos, traces many directions at each
(rendering/transport.py) and moves material texels and light texels. Shape is fixed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from relit.fit.passes.exchange import REFRESH, Exchange
from relit.fit.passes.light_steps import LightSteps
from relit.fit.passes.losses import dual_loss
from relit.fit.passes.material_priors import (
    ALBEDO_START,
    SurfaceOptions,
    common_scale,
    light_prior,
    material_prior,
    parsimony,
    relative_irradiance,
    slope_prior,
)
from relit.fit.passes.optimiser import Adam, Variable, cosine_decay
from relit.fit.passes.pixels import PixelBank, saturated_at
from relit.fit.passes.surface_loop import drawn_points, neighbour_points, run_surface
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
    reflected,
    sample_lights,
)


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


@dataclass(frozen=True)
class TexelStart:
    """What is known of the texels before the surface pass. base: (S, S, 3) first guess of the base
    colour up to scale (materials.intrinsic). known: (S, S) bool, texels on the surface. radiance:
    mean over the object. normals: (S, S, 3) unit, None where texels stand in many places."""

    base: np.ndarray
    known: np.ndarray
    radiance: float
    normals: np.ndarray | None = None


def start_surface(
    texels: TexelStart, options: SurfaceOptions, metallic=0.1, roughness=None
) -> SurfaceModel:
    """metallic, roughness (None: roughness_start): a number or (S, S). The light starts grey and
    even, bright enough that the mean base colour is ALBEDO_START.
    """
    radiance = texels.radiance
    mean = float(texels.base[texels.known].mean())
    albedo = np.clip(texels.base * (ALBEDO_START / max(mean, 1e-6)), 0.02, 0.95)
    rough = options.roughness_start if roughness is None else roughness
    material = start_material(options.texture, albedo, rough, metallic)
    h = options.light
    log_light = mi.Float(
        np.full(h * 2 * h * 3, np.log(max(radiance, 1e-4) / ALBEDO_START), np.float32)
    )
    metal = dr.select(material.metallic > 0.5, mi.Float(1), 0)
    dr.eval(metal)
    return SurfaceModel(
        material, log_light, Environment(dr.exp(log_light), h, 2 * h), metal, texels.normals
    )


def light_parameters(model: SurfaceModel):
    """What is optimised of the light (Float)."""
    return model.log_light if model.gaussians is None else model.gaussians.parameters


@dataclass
class MaterialSchedule:
    """Rates of the metallic-roughness textures over a pass of options.steps. light_steps: steps in
    which the light moves; the base colour begins slowly, since it could explain all shading."""

    options: SurfaceOptions
    light_steps: int

    def decay(self, i: int) -> float:
        return cosine_decay(i / self.options.steps, 0.05)

    def colour(self, i: int) -> float:
        warm = min(1.0, 0.05 + (i / (self.options.warm * self.light_steps)) ** 2)
        return self.options.colour_rate * self.decay(i) * warm

    def metallic(self, i: int) -> float:
        return self.options.metallic_rate * self.decay(i)

    def slope(self, i: int) -> float:
        begun = i >= self.options.slope_begin * self.options.steps
        return self.options.slope_rate * self.decay(i) * begun

    def variables(self, material: MaterialField) -> list[Variable]:
        """Base colour with roughness, metallic, and slopes of the normal map."""
        o = self.options
        ratio = np.array([1, 1, 1, o.roughness_rate / o.colour_rate], np.float32)
        ratio = mi.Float(np.tile(ratio, material.size**2))
        return [
            Variable("colour", material, "colour", self.colour, ratio),
            Variable("metallic", material, "metallic", self.metallic),
            Variable("slope", material, "slope", self.slope, floor=o.slope_calm),
        ]


@dataclass
class EnvironmentSample:
    """What a step of `EnvironmentTerms` draws. near, close: neighbours for the priors of material
    and normal map. side: Float, 1 where the surface began as metal. smooth_n: the mesh's normals.
    lights: see `sample_lights`. shift: see `parsimony`."""

    batch: Any
    points: Points
    near: Points
    close: Points
    side: Any
    smooth_n: Any
    lights: Any
    shift: Any


class EnvironmentTerms:
    """Metallic-roughness textures under one environment, for `run_surface`.

    before(step, steps, material, environment, seed): called before each step; it may change the
    radiance of the mesh.
    """

    def __init__(
        self,
        bank: PixelBank,
        mesh: TraceableMesh,
        model: SurfaceModel,
        options: SurfaceOptions,
        seed: int = 0,
        before: Callable | None = None,
    ):
        self.bank, self.mesh, self.model, self.options = bank, mesh, model, options
        self.seed, self.before = seed, before
        o, rows = options, options.light
        self.light_steps = min(o.light_steps or o.steps, o.steps)
        self.schedule = MaterialSchedule(o, self.light_steps)
        self.exchange = Exchange(model.normals, model.material.size**2, rows, o.exchange_rows)
        self.by_cells = o.light_cells and model.gaussians is None
        self.mover = LightSteps(rows) if self.by_cells else Adam(dr.width(light_parameters(model)))
        self.log_light: Any = None  # log radiance in this step, with its gradient
        self._follow_light()

    def _follow_light(self) -> None:
        model = self.model
        if model.gaussians is not None:
            model.log_light = model.gaussians.log_radiance()
        model.environment.radiance = dr.exp(model.log_light)
        model.environment.rebuild()

    def variables(self) -> list[Variable]:
        gaussians = self.model.gaussians
        light = (self.model, "log_light") if gaussians is None else (gaussians, "parameters")
        return [
            *self.schedule.variables(self.model.material),
            Variable("light", *light, until=self.light_steps),
        ]

    def optimisers(self) -> dict[str, Adam]:
        own = self.mover.adam if isinstance(self.mover, LightSteps) else {"light": self.mover}
        return {"exchange": self.exchange.adam, **own}

    def state(self) -> dict[str, np.ndarray]:
        kept = {"metal": np.array(self.model.metal)}
        if self.exchange.light is not None:
            kept["followed"] = np.array(self.exchange.light)
        if self.before is not None:
            kept["radiance"] = np.array(self.mesh.radiance)
        return kept

    def restore(self, saved: Mapping[str, np.ndarray]) -> None:
        self.model.metal = mi.Float(saved["metal"])
        if self.before is not None:
            self.mesh.radiance = mi.Float(saved["radiance"])
        self._follow_light()
        if "followed" in saved:
            self.exchange.refresh(mi.Float(saved["followed"]))

    def begin(self, i: int, rng: Any) -> EnvironmentSample:
        model, o, mesh = self.model, self.options, self.mesh
        material, environment = model.material, model.environment
        if self.before is not None:
            self.before(i, o.steps, material, environment, self.seed)
        batch, points = drawn_points(self.bank, mesh, rng, o.points)
        valid = points.valid
        near = neighbour_points(mesh, points, o.similarity_reach, rng)
        close = neighbour_points(mesh, points, o.slope_reach, rng)
        dr.eval(near, close, rng)
        shift = dr.opaque(mi.UInt32, 1 + (i * 7919) % (o.points - 1))
        with dr.suspend_grad():
            start = material_at(material, points.uv, valid)
            side = dr.gather(mi.Float, model.metal, nearest_texel(material, points.uv), valid)
            smooth_n = points.n
            points.n = bent_normal(points, slope_at(material, points.uv, valid))
            dr.eval(start.base, start.roughness, start.metallic, side, points.n)
        lights = sample_lights(mesh, points, start, environment, o.directions, rng)
        return EnvironmentSample(batch, points, near, close, side, smooth_n, lights, shift)

    def loss(self, i: int, sample: EnvironmentSample) -> tuple[Any, Any]:
        model, o, points = self.model, self.options, sample.points
        material, valid, batch = model.material, points.valid, sample.batch
        # opaque: the weight must not become a literal of the kernel
        colour_smoothing = dr.opaque(mi.Float, o.smooth_colour)
        if i < self.light_steps:
            gaussians = model.gaussians
            self.log_light = model.log_light if gaussians is None else gaussians.log_radiance()
            model.environment.radiance = dr.exp(self.log_light)
        surface = material_at(material, points.uv, valid)
        slope = slope_at(material, points.uv, valid)
        points.n = sample.smooth_n
        bend = slope.x * points.t + slope.y * points.b
        points.n = bent_normal(points, slope)
        a, b = reflected(points, sample.lights, surface, model.environment)
        fit = dual_loss(a, b, batch.rgb, valid, saturated_at(self.bank, batch.view))
        lit = relative_irradiance(batch.rgb, surface.base, valid, o.smooth_shade)
        level = common_scale(surface, valid, o.scale_power)
        smoothing = colour_smoothing * lit
        prior = material_prior(
            material, surface, sample.near, valid, level, o, smoothing, sample.side
        )
        prior += slope_prior(material, bend, sample.close, valid, o)
        if i < self.light_steps:
            prior += light_prior(self.log_light, o)
        if i < self.light_steps and o.parsimony > 0:
            prior += parsimony(material, surface, points.uv, valid, level, sample.shift, o)
        return fit, fit + prior

    def finish(self, i: int, sample: EnvironmentSample, gradients: Mapping[str, Any]) -> None:
        material = self.model.material
        if i < self.light_steps:
            self._move_light(i, gradients)
        project(material)
        dr.eval(material.colour, material.metallic, material.slope)

    def _move_light(self, i: int, gradients: Mapping[str, Any]) -> None:
        model, o, gaussians = self.model, self.options, self.model.gaussians
        decay, gradient = cosine_decay(i / self.light_steps, 0.05), gradients["light"]
        rate = o.light_rate * decay
        if gaussians is None:
            model.log_light = self.mover.step(dr.detach(model.log_light), gradient, rate)
        else:
            gaussians.parameters = self.mover.step(
                dr.detach(gaussians.parameters), gradient, rate, gaussians.rates
            )
            gaussians.project()
            model.log_light = gaussians.log_radiance()
        if o.exchange_rate > 0 and gaussians is None:
            self._exchange(i, o.exchange_rate * decay, (gradients["colour"], gradient))
        model.environment.radiance = dr.exp(model.log_light)
        dr.eval(model.log_light, model.environment.radiance)
        model.environment.rebuild()

    def _exchange(self, i: int, rate: float, pulls: tuple[Any, Any]) -> None:
        model, material = self.model, self.model.material
        if i % REFRESH == 0 or self.exchange.share is None:
            self.exchange.refresh(model.environment.radiance)
        dr.eval(material.colour, model.log_light)
        metallic = material.metallic if self.options.exchange_mirrored else None
        material.colour, model.log_light = self.exchange.step(
            material.colour, model.log_light, *pulls, rate, metallic
        )

    def textures(self, uv: Any, valid: Any) -> list[Any]:
        at = material_at(self.model.material, uv, valid)
        return [at.base, at.roughness]


def fit_surface(terms: EnvironmentTerms, stage: Any) -> SurfaceModel:
    """Run the pass; returns the model of the terms, optimised. Resumes from the stage's checkpoint
    where there is one."""
    rng = mi.PCG32(size=terms.options.points, initstate=terms.seed * 7919 + 13)
    run_surface(terms, terms.options.steps, rng, stage)
    return terms.model

"""Each optimisation pass on a ball, very small."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from relit.fit.collection.surface import (
    LightOptions,
    PhotoLightTerms,
    fit_collection_surface,
    start_collection_surface,
)
from relit.fit.flash.lobe_clusters import start_kinship
from relit.fit.flash.recipe import rates_by_step
from relit.fit.flash.surface import FlashModel, FlashSurfaceOptions, FlashTerms, fit_flash_surface
from relit.fit.passes.camera_corrections import CorrectionModel, no_corrections
from relit.fit.passes.material_priors import ALBEDO_START, SurfaceOptions
from relit.fit.passes.surface import EnvironmentTerms, TexelStart, fit_surface, start_surface
from relit.fit.passes.volume import VolumeOptions, fit_volume, start_model
from relit.fit.registration.instances.views import hold_distances, move_poses
from relit.geometry.sdf import node_positions
from relit.lighting.gaussian_light import GaussianLight
from relit.materials.field import start_material
from relit.materials.plastic_field import start_plastic
from relit.materials.rough_plastic import Coat
from relit.rendering.appearance.flash_light import FlashAppearance, start_learnt
from relit.rendering.appearance.light_per_photo import shade_photos, start_photo_lights
from relit.rendering.appearance.world_light import shade_world, start_world_light
from support import flash_ball as scene

# Tables of live objects grow for some hundred steps, ever slower (350 blocks of Python from step
# 150 to 490): not counted as left behind.
STEPS, SETTLED, LAST = 1000, 400, 990


TEXELS = 8


VOLUME = {"levels": (16,), "steps": (STEPS,), "rays": 64}


SURFACE = {"steps": STEPS, "points": 32, "directions": 4, "texture": TEXELS}


def ball_model():
    """A volume model of the ball."""
    values = np.linalg.norm(node_positions(16), axis=-1) - 0.7
    return start_model(values.astype(np.float32), np.full(3, 0.3), None, full=False)


def flash_volume(shot, stage):
    """With the offset moving from half way on, and soft shadows."""
    model = ball_model()
    model.reflections, rates = start_learnt()
    model.rates = rates_by_step(rates, STEPS // 2)
    model.appearance = FlashAppearance(Coat(), scene.INTENSITY, 16)
    model.appearance.model = model
    fit_volume(shot[0], model, VolumeOptions(**VOLUME), stage)


def flash_surface(shot, stage):
    """With inter-reflection, features, and the patches of PIR."""
    bank, cameras, mesh, _ = shot
    one = np.ones((TEXELS, TEXELS), np.float32)
    features = np.random.default_rng(0).random((TEXELS, TEXELS, 4)).astype(np.float32)
    kinship = start_kinship(features, one > 0, np.stack([0.5 * one, 0.3 * one], -1), groups=4)
    field = start_plastic(np.full((TEXELS, TEXELS, 3), 0.3), 0.5 * one, 0.3 * one)
    model = FlashModel(
        field, mi.Float(features.ravel()), kinship, mi.Float(0, 0, 0), mi.Float([1.5]), Coat()
    )
    options = FlashSurfaceOptions(STEPS, 128, 1, 1, patches=0.1, share_every=45)
    fit_flash_surface(FlashTerms(bank, cameras, mesh, model, options), stage)


def collection_volume(shot, stage):
    """A light for each photo; cameras and focal lengths move. The poses' own descents and those of
    held-out photos are such fits too."""
    bank, *_ = shot
    bank.corrections = no_corrections(bank.views, CorrectionModel.ABOUT_ORIGIN)
    model = ball_model()
    model.reflections, model.rates = start_photo_lights(np.full((bank.views, 3), 0.3), 0.3)
    model.appearance = shade_photos
    model.correction_ratios = mi.Float(np.ones(7 * bank.views, np.float32))
    fit_volume(bank, model, VolumeOptions(**VOLUME, refine_cameras=0.003), stage)


def collection_surface(shot, stage):
    """The lights of held-out photos alone are found by less of the same step."""
    bank, _, mesh, _ = shot
    material = start_material(
        TEXELS, np.full((TEXELS, TEXELS, 3), ALBEDO_START, np.float32), 0.5, 0.05
    )
    model = start_collection_surface(material, np.full((bank.views, 3), 0.3), ALBEDO_START)
    terms = PhotoLightTerms(bank, mesh, model, SurfaceOptions(**SURFACE), LightOptions(anchor=0.1))
    fit_collection_surface(terms, stage)


def duplicates_volume(shot, stage):
    """Shape and poses together, the distances held after a while."""
    bank, *_ = shot
    model = ball_model()
    model.appearance = shade_world
    model.reflections, model.rates = start_world_light(0.3, bank.views)
    move_poses(bank, model)
    options = VolumeOptions(
        (12, 16), (SETTLED // 3, STEPS - SETTLED // 3), 64, refine_cameras=0.004, hold=40
    )
    fit_volume(bank, model, options, stage, 0, hold_distances)


def duplicates_surface(shot, stage):
    """Under spherical Gaussians."""
    bank, _, mesh, _ = shot
    o = SurfaceOptions(**SURFACE, light=8, scale_power=1.0)
    known = np.ones((TEXELS, TEXELS), bool)
    begun = TexelStart(np.full((TEXELS, TEXELS, 3), 0.3, np.float32), known, 0.3)
    model = start_surface(begun, o)
    model.gaussians = GaussianLight(6, o.light, 0.3 / ALBEDO_START)
    fit_surface(EnvironmentTerms(bank, mesh, model, o), stage)


PASSES = [
    flash_volume,
    flash_surface,
    collection_volume,
    collection_surface,
    duplicates_volume,
    duplicates_surface,
]

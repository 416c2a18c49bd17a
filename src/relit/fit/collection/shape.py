"""The shape of a collection: the volume pass with cameras and focal lengths free, and the hollows
that no silhouette shows."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np

from relit.errors import UserError
from relit.fit.collection.options import CollectionOptions
from relit.fit.collection.photos import collection_crops
from relit.fit.passes.camera_corrections import CorrectionModel, corrected, no_corrections
from relit.fit.passes.pixels import PixelBank, make_bank, place_cameras
from relit.fit.passes.volume import (
    VolumeModel,
    VolumeOptions,
    fit_volume,
    next_level,
    restore_model,
    start_model,
)
from relit.fit.registration.photos.depth import depth_limit
from relit.fit.registration.photos.few import FEW
from relit.fit.registration.photos.poses import GREY
from relit.fit.shape.hollows import without
from relit.fit.shape.lids import FIRST, PHOTOS, open_lids
from relit.geometry.hull import NoShape, distance_of, visual_hull
from relit.recipe import FitContext
from relit.rendering.appearance.light_per_photo import shade_photos, start_photo_lights
from relit.run import run_arrays
from relit.scene import Camera

DIFFUSION = 0.1  # of the volume pass: with quiet masks it needs less smoothing
BAND = 8.0  # voxels around an opened surface


def volume_options(options: CollectionOptions) -> VolumeOptions:
    levels, steps, masks = options.levels, options.level_steps, options.mask_weights
    if "coarse_to_fine" in options.without:
        levels, steps, masks = levels[-1:], (sum(steps),), masks[-1:]
    calm = {"mask": masks, "diffusion": DIFFUSION, "sharpness": (1.5, 6.0)}
    return VolumeOptions(levels, steps, options.rays, refine_cameras=options.refine_cameras, **calm)


def fresh_model(values: np.ndarray, tints: np.ndarray) -> VolumeModel:
    """A grey model of distances (n, n, n), a small light for each photo. tints: (V, 3) mean
    radiance of the object in each."""
    model = start_model(values, np.full(3, GREY), None, full=False)
    model.reflections, model.rates = start_photo_lights(tints, GREY)
    model.appearance = shade_photos
    return model


def volume_stage(shots, cameras, weights, linked, tints, fit: FitContext):
    """(pixel bank with the final cameras, cameras, model). Poses that come from matches move at a
    third of the others' rate."""
    run, options, seed = fit.run, fit.options, fit.seed
    silhouettes = [s.mask for s in shots]
    bank = weighted_bank(make_bank(cameras, [s.rgb for s in shots], silhouettes), weights, seed)
    bank.corrections = no_corrections(bank.views, CorrectionModel.ABOUT_ORIGIN)
    o = volume_options(options)
    values = tolerant_hull(cameras, silhouettes, o.levels[0])
    limit = (
        depth_limit(
            collection_crops(shots), np.array([c.world_from_camera for c in cameras]), o.levels[0]
        )
        if len(shots) < FEW
        else None
    )
    if limit is not None and (limit & (values < 0)).any():
        values = distance_of(limit & (values < 0))
    model = fresh_model(values, tints)
    model.correction_ratios = mi.Float(np.repeat(np.where(linked, 0.3, 1.0), 7).astype(np.float32))
    if run.done("volume"):
        restore_model(model, bank, run_arrays(run, "volume", "checkpoint"))
    else:
        with run.stage(
            "volume", steps=sum(o.steps), title="shape and cameras (volume pass)"
        ) as stage:
            fit_volume(bank, model, o, stage, seed)
    cameras = corrected(cameras, bank.corrections)
    place_cameras(bank, cameras)
    return bank, cameras, model


def opened_stage(
    bank: PixelBank, shots, cameras: list[Camera], model: VolumeModel, tints, fit: FitContext
):
    """The cameras after the finer levels of the volume pass, made again where a hollow was found
    that no silhouette shows; `model` is then the opened one, and `bank` gets the cameras. As they
    are where there is none."""
    run, options, seed = fit.run, fit.options, fit.seed
    if options.hollows == 0 or len(shots) < PHOTOS:
        return cameras
    bank.corrections = no_corrections(bank.views, CorrectionModel.ABOUT_ORIGIN)
    if run.done("hollows"):
        found = run_arrays(run, "hollows", "hollows")["distances"]
    else:
        with run.stage("hollows", title="hollows that no silhouette shows") as stage:
            hull, show = (
                tolerant_hull(cameras, [s.mask for s in shots], FIRST.nodes),
                run.progress("hollows that no silhouette shows"),
            )
            gone = open_lids(
                bank,
                cameras,
                hull,
                lambda v: fresh_model(v, tints),
                run.say,
                seed,
                options.hollows,
                progress=show,
            )
            found = np.zeros((0, 0, 0), np.float32) if gone is None else gone
            stage.save("hollows", distances=found)
    if not found.size:
        return cameras
    if run.done("opened"):
        restore_model(model, bank, run_arrays(run, "opened", "checkpoint"))
    else:
        o = volume_options(options)
        finer = replace(
            o,
            levels=o.levels[1:] or o.levels,
            steps=o.steps[1:] or o.steps,
            mask=o.mask[1:] or o.mask,
        )
        with run.stage(
            "opened", steps=sum(finer.steps), title="shape and cameras, opened (volume pass)"
        ) as stage:
            next_level(model, finer.levels[0], BAND, lambda values: without(values, found))
            fit_volume(bank, model, finer, stage, seed + 1)
    cameras = corrected(cameras, bank.corrections)
    place_cameras(bank, cameras)
    return cameras


def tolerant_hull(cameras: list[Camera], masks: list[np.ndarray], nodes: int) -> np.ndarray:
    """The visual hull by a vote that forgives poses that are a few degrees off."""
    for tolerance in (0.1, 0.2, 0.35, 0.5):
        try:
            values = visual_hull(cameras, masks, nodes, tolerance=tolerance)
        except NoShape:
            continue
        if (values < 0).sum() > 100:
            return values
    raise UserError(
        "the silhouettes have nothing in common",
        "poses or masks are wrong",
        "look at the masks (relit inspect)",
        code=4,
    )


def weighted_bank(bank: PixelBank, weights: np.ndarray, seed: int) -> PixelBank:
    """The bank, its batches drawn from photos in proportion to `weights`: posterior scaling as the
    chance to be looked at."""
    candidates = np.array(bank.candidates)
    view = np.searchsorted(np.array(bank.offsets), candidates, side="right") - 1
    keep = np.random.default_rng(seed).random(len(candidates)) < np.asarray(weights)[view]
    bank.candidates = mi.UInt32(candidates[keep] if keep.any() else candidates)
    return bank

"""The shape of a collection: the volume pass with cameras and focal lengths free, and the hollows
that no silhouette shows."""

from __future__ import annotations

from dataclasses import dataclass, replace

import mitsuba as mi
import numpy as np

from relit.errors import UserError
from relit.fit.collection.options import CollectionOptions
from relit.fit.collection.photo_poses import PhotoPoses
from relit.fit.collection.photos import PhotoSet, collection_crops
from relit.fit.passes.camera_corrections import CorrectionModel, corrected, no_corrections
from relit.fit.passes.pixels import PixelBank, make_bank, place_cameras
from relit.fit.passes.volume import (
    VolumeModel,
    VolumeOptions,
    VolumeResult,
    fit_volume,
    next_level,
    restore_model,
    start_model,
    volume_result,
)
from relit.fit.registration.photos.depth import depth_limit
from relit.fit.registration.photos.few import FEW
from relit.fit.registration.photos.poses import GREY
from relit.fit.shape.hollows import without
from relit.fit.shape.lids import FIRST, PHOTOS, open_lids
from relit.geometry.hull import NoShape, distance_of, visual_hull
from relit.recipe import FitContext
from relit.rendering.appearance.light_per_photo import shade_photos, start_photo_lights
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


@dataclass
class FittedShape:
    """Where the shape of a collection is while its cameras still move. bank: pixels, with the
    present cameras and no corrections. cameras: of the photos, unit frame."""

    bank: PixelBank
    cameras: list[Camera]
    model: VolumeModel

    def place(self, cameras: list[Camera]) -> None:
        """Take these cameras."""
        self.cameras = cameras
        place_cameras(self.bank, cameras)

    def free_cameras(self) -> None:
        """Let the next volume pass move cameras and focal lengths."""
        self.bank.corrections = no_corrections(self.bank.views, CorrectionModel.ABOUT_ORIGIN)

    def take(self, result: VolumeResult) -> None:
        """Take the field and the cameras that a volume pass ends with."""
        restore_model(self.model, self.bank, result)
        self.place(corrected(self.cameras, self.bank.corrections))


def start_of_shape(photos: PhotoSet, poses: PhotoPoses, fit: FitContext) -> FittedShape:
    """The hull of the silhouettes. Cameras that come from matches move at a third of the others'
    rate."""
    options, shots, cameras = fit.options, photos.shots, poses.cameras(photos.shots)
    silhouettes = [s.mask for s in shots]
    ignored = [s.ignored for s in shots]
    bank = make_bank(cameras, [s.rgb for s in shots], silhouettes, ignored=ignored)
    weights = np.ones(len(shots)) if "posterior" in options.without else poses.weights()
    bank = weighted_bank(bank, weights, fit.seed)
    nodes = volume_options(options).levels[0]
    values = tolerant_hull(cameras, silhouettes, nodes)
    if len(shots) < FEW:
        placed = np.array([c.world_from_camera for c in cameras])
        limit = depth_limit(collection_crops(shots), placed, nodes)
        if limit is not None and (limit & (values < 0)).any():
            values = distance_of(limit & (values < 0))
    model = fresh_model(values, photos.tints)
    each = CorrectionModel.ABOUT_ORIGIN.value
    model.correction_ratios = mi.Float(
        np.repeat(np.where(poses.linked, 0.3, 1.0), each).astype(np.float32)
    )
    return FittedShape(bank, cameras, model)


def volume_stage(photos: PhotoSet, poses: PhotoPoses, fit: FitContext) -> FittedShape:
    """The volume pass with cameras and focal lengths free, and a small light for each photo."""
    shape, o = start_of_shape(photos, poses, fit), volume_options(fit.options)
    shape.free_cameras()

    def computed(stage) -> VolumeResult:
        fit_volume(shape.bank, shape.model, o, stage, fit.seed)
        return volume_result(shape.model, shape.bank)

    title = "shape and cameras (volume pass)"
    shape.take(fit.run.cached("volume", VolumeResult, computed, steps=sum(o.steps), title=title))
    return shape


@dataclass(frozen=True)
class HollowDistances:
    """distances: (n, n, n) float32 to the space that was found under flat faces of the hull, or
    None where there is none."""

    distances: np.ndarray | None


def hollows_stage(shape: FittedShape, photos: PhotoSet, fit: FitContext) -> HollowDistances:
    """Spaces that no silhouette shows, tested by the photos."""
    run, options = fit.run, fit.options

    def computed(stage) -> HollowDistances:
        hull = tolerant_hull(shape.cameras, [s.mask for s in photos.shots], FIRST.nodes)
        gone = open_lids(
            shape.bank,
            shape.cameras,
            hull,
            lambda v: fresh_model(v, photos.tints),
            run.say,
            fit.seed,
            options.hollows,
            progress=run.progress("hollows that no silhouette shows"),
        )
        return HollowDistances(gone)

    title = "hollows that no silhouette shows"
    return run.cached("hollows", HollowDistances, computed, title=title)


def opened_stage(shape: FittedShape, photos: PhotoSet, fit: FitContext) -> None:
    """Run the finer levels of the volume pass again where a hollow was found; `shape` is then the
    opened one."""
    options = fit.options
    if options.hollows == 0 or len(photos.shots) < PHOTOS:
        return
    shape.free_cameras()
    found = hollows_stage(shape, photos, fit).distances
    if found is None:
        return
    o = volume_options(options)
    finer = replace(
        o,
        levels=o.levels[1:] or o.levels,
        steps=o.steps[1:] or o.steps,
        mask=o.mask[1:] or o.mask,
    )

    def computed(stage) -> VolumeResult:
        next_level(shape.model, finer.levels[0], BAND, lambda values: without(values, found))
        fit_volume(shape.bank, shape.model, finer, stage, fit.seed + 1)
        return volume_result(shape.model, shape.bank)

    title = "shape and cameras, opened (volume pass)"
    steps = sum(finer.steps)
    shape.take(fit.run.cached("opened", VolumeResult, computed, steps=steps, title=title))


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

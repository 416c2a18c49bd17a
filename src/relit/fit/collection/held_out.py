"""Photos that stand against a finished model: those that were set aside, and those whose place was
not found at first."""

from __future__ import annotations

from dataclasses import dataclass, replace

import mitsuba as mi
import numpy as np

from relit.fit.collection.options import CollectionOptions
from relit.fit.collection.photos import CollectionPhoto, PhotoSet, collection_crops
from relit.fit.collection.shape import FittedShape
from relit.fit.collection.surface import (
    AlbedoMesh,
    PhotoLightTerms,
    PhotoLitMaterial,
    fit_collection_surface,
    light_family,
    light_options,
    start_collection_surface,
)
from relit.fit.passes.camera_corrections import CorrectionModel, corrected, no_corrections
from relit.fit.passes.material_priors import ALBEDO_START, SurfaceOptions
from relit.fit.passes.optimiser import NoStage
from relit.fit.passes.pixels import make_bank
from relit.fit.passes.volume import VolumeModel, VolumeOptions, fit_volume
from relit.fit.registration.fine_detail import (
    compare_detail,
    detail_correlation,
    detail_of,
    photo_values_at,
    surface_of,
)
from relit.fit.registration.photos.framing import is_cut, slide
from relit.fit.registration.photos.poses import COARSE, GREY, PARTS, SLACK, best_refined
from relit.fit.registration.register import (
    crop_rings,
    directions_around,
    hint_prior,
    make_gallery,
    near,
    refine,
    search,
    views_from,
    volume_render,
)
from relit.geometry.mesh import extract_mesh
from relit.geometry.sdf import dense_values
from relit.geometry.se3 import rotation_angle
from relit.lighting.per_photo import COLUMNS, ROWS
from relit.materials.field import start_material
from relit.recipe import FitContext
from relit.rendering.appearance.light_per_photo import shade_photos, shade_plain, start_photo_lights
from relit.rendering.transport import TraceableMesh
from relit.scene import Camera, Mesh

AGAIN = 600  # viewpoints that a finished model is looked at from
CHOICES = 6  # places of each photo that are looked into
ELSEWHERE = 20.0  # degrees: what is nearer is found by descent
LONGER = (
    3  # times `frozen_steps` that held-out photos descend: they have no further pass to arrive in
)
FAR = 30.0  # degrees from which on fine detail decides
WORSE = 0.06  # by which the score of a place may be lower for fine detail to decide
# by which another pose must score better than the present one: sides that look alike differ by .01
# from light alone
GAIN = 0.03


@dataclass(frozen=True)
class HeldOutPhotos:
    """poses: (H, 4, 4) world_from_camera. focal: (H,) pixels. lights: (H, ROWS, COLUMNS, 3)."""

    poses: np.ndarray
    focal: np.ndarray
    lights: np.ndarray

    def cameras(self, held: list[CollectionPhoto]) -> list[Camera]:
        """Their cameras."""
        return with_poses_and_focals([s.camera for s in held], self.poses, self.focal)


def with_poses_and_focals(
    cameras: list[Camera], poses: np.ndarray, focal: np.ndarray
) -> list[Camera]:
    """The cameras with poses (N, 4, 4) and focal lengths (N,), pixels, in place of their own."""
    return [
        replace(c, fx=f, fy=f, world_from_camera=p)
        for c, f, p in zip(cameras, focal, poses, strict=True)
    ]


def held_out_stage(
    shape: FittedShape,
    photos: PhotoSet,
    colours: AlbedoMesh,
    maps: PhotoLitMaterial,
    fit: FitContext,
) -> HeldOutPhotos:
    """Cameras and lights of the photos that were set aside: registered by rendering and by what the
    other photos show, descended, lit; shape and material stay."""
    steps, held, model = fit.options.frozen_steps, photos.held, shape.model
    if not held:
        none = np.zeros((0, ROWS, COLUMNS, 3), np.float32)
        return HeldOutPhotos(np.zeros((0, 4, 4)), np.zeros(0), none)

    def computed(stage) -> HeldOutPhotos:
        new = [replace(s, camera=with_median_field(s, shape.cameras)) for s in held]
        found = register_held_out(new, model, photos.degrees, fit.options, fit.seed)
        found = refine_held_out_cameras(new, found, model, fit.options, fit.seed, LONGER)
        found = told_by_others(new, found, shape, photos, colours.mesh, fit)
        return HeldOutPhotos(
            poses=np.array([c.world_from_camera for c in found]),
            focal=np.array([c.fx for c in found]),
            lights=lights_of(new, found, colours, maps, stage, fit),
        )

    title = "photos that were set aside"
    return fit.run.cached("held_out", HeldOutPhotos, computed, steps=steps, title=title)


def lights_of(
    shots: list[CollectionPhoto],
    cameras: list[Camera],
    colours: AlbedoMesh,
    maps: PhotoLitMaterial,
    stage,
    fit: FitContext,
) -> np.ndarray:
    """(N, ROWS, COLUMNS, 3) radiance of each photo's light under a finished material."""
    options, size = fit.options, maps.roughness.shape[0]
    ignored = [s.ignored for s in shots]
    bank = make_bank(cameras, [s.rgb for s in shots], [s.mask for s in shots], ignored=ignored)
    material = start_material(size, maps.base_color, 0.5, 0.0)
    material.colour = mi.Float(
        np.concatenate([maps.base_color, maps.roughness[..., None]], -1).astype(np.float32).ravel()
    )
    material.metallic = mi.Float(maps.metallic.astype(np.float32).ravel())
    n = maps.normal
    material.slope = mi.Float((n[..., :2] / np.maximum(n[..., 2:], 0.1)).astype(np.float32).ravel())
    tints = np.array([s.tint for s in shots])
    lit = start_collection_surface(material, tints, ALBEDO_START, light_family(options))
    o = SurfaceOptions(options.frozen_steps, options.points, options.directions, size)
    traced = TraceableMesh(colours.mesh, colours.albedo * colours.scale)
    terms = PhotoLightTerms(bank, traced, lit, o, light_options(options), frozen=True)
    fit_collection_surface(terms, stage, fit.seed)
    return np.exp(lit.lights()).reshape(-1, ROWS, COLUMNS, 3)


def with_median_field(shot: CollectionPhoto, cameras: list[Camera]) -> Camera:
    """A held-out photo without EXIF starts with the median focal length of the others, in units of
    the longer side."""
    if shot.photo.focal_hint is not None or shot.photo.camera is not None:
        return shot.camera
    focal = float(np.median([c.fx / max(c.width, c.height) for c in cameras])) * max(
        shot.camera.width, shot.camera.height
    )
    return replace(shot.camera, fx=focal, fy=focal)


def find(
    shots: list[CollectionPhoto],
    model: VolumeModel,
    degrees: float,
    keep: int,
    seed: int,
    slid: bool = False,
):
    """(crops, their descriptors, what renders the model, `keep` hypotheses of every photo) by
    search from all around. slid: those that the frame cuts with place and size free (takes a second
    a photo)."""
    crops, hints = collection_crops(shots), np.array([s.direction for s in shots])
    render, rings = volume_render(replace(model, appearance=shade_plain)), crop_rings(crops, PARTS)
    gallery = make_gallery(render, views_from(directions_around(AGAIN, seed)), PARTS)
    hinted = np.linalg.norm(hints, axis=1) > 0.5
    prior = 0.03 * hint_prior(gallery, hints, degrees, 60.0) * hinted[:, None, None]
    allowed = near(gallery, hints, degrees + SLACK) | ~hinted[:, None]
    found = search(crops, gallery, keep, rings=rings, prior=prior, allowed=allowed)
    cut = np.flatnonzero([is_cut(c) for c in crops])
    if slid and len(cut):
        more = slide(
            [crops[i] for i in cut], render, gallery.cameras, keep, allowed[cut], prior[cut].max(2)
        )
        found.poses[cut], found.scores[cut] = more.poses, more.scores
    return crops, rings, render, found


def register_held_out(
    shots: list[CollectionPhoto],
    model: VolumeModel,
    degrees: float,
    options: CollectionOptions,
    seed: int,
) -> list[Camera]:
    """The cameras of photos that the model has not seen, by search and local refinement."""
    crops, rings, render, found = find(shots, model, degrees, options.hypotheses, seed, slid=True)
    poses, _ = best_refined(crops, found, render, rings, options.hypotheses)
    return [s.camera.with_pose(p) for s, p in zip(shots, poses, strict=True)]


def told_by_others(
    new: list[CollectionPhoto],
    found: list[Camera],
    shape: FittedShape,
    photos: PhotoSet,
    mesh: Mesh,
    fit: FitContext,
) -> list[Camera]:
    """The cameras `found` of `new` photos, but for those that from elsewhere show more of what the
    other photos show there."""
    still = np.zeros(len(new), bool)
    degrees, options, seed = photos.degrees, fit.options, fit.seed
    places = far_from(found, other_places(new, found, shape.model, degrees, still, options, seed))
    if not places:
        return found
    surface = surface_of(mesh)
    laid = np.array(
        [
            photo_values_at(surface, c, detail_of(s.rgb, s.mask))
            for c, s in zip(shape.cameras, photos.shots, strict=True)
        ]
    )
    pictures = [detail_of(s.rgb, s.mask) for s in new]
    moved = compare_detail(surface, pictures, found, places, laid).moved
    return [moved.get(i, c) for i, c in enumerate(found)]


@dataclass(frozen=True)
class SecondLook:
    """poses: (P, 4, 4) and focal: (P,) pixels of all photos. moved: (M,) numbers of the photos that
    moved. detail: (P,), see `detail_correlation`. as_well: (P,) degrees by which another place,
    from which a photo shows about as much of what the others show, is turned against its own; 0
    where there is none."""

    poses: np.ndarray
    focal: np.ndarray
    moved: np.ndarray
    detail: np.ndarray
    as_well: np.ndarray

    def placed(self, cameras: list[Camera]) -> list[Camera]:
        """The cameras at these poses."""
        return with_poses_and_focals(cameras, self.poses, self.focal)


def look_again(
    shape: FittedShape, photos: PhotoSet, still: np.ndarray, fit: FitContext
) -> SecondLook:
    """Every photo is searched for in the finished model, whose detail tells apart what the coarse
    ones took for each other. Photos that fit elsewhere by GAIN move there, and so do those that
    from elsewhere show more of what the others show there (a stool from above, half a turn away:
    fit/registration/fine_detail.py). still: (P,) bool, photos that stay."""
    shots, cameras, model = photos.shots, shape.cameras, shape.model
    places = other_places(shots, cameras, model, photos.degrees, still, fit.options, fit.seed)
    out, moved = list(cameras), {}
    for i, camera, gain in places:  # the best comes first
        if gain > GAIN and i not in moved:
            out[i] = moved[i] = camera
    surface = surface_of(extract_mesh(dense_values(model.grid), faces=fit.options.faces))
    pictures = [detail_of(s.rgb, s.mask) for s in shots]
    found = compare_detail(surface, pictures, out, far_from(out, places))
    out = [found.moved.get(i, c) for i, c in enumerate(out)]
    turns = np.zeros(len(out))
    for i, camera in found.as_well.items():
        turns[i] = turn_between(out[i].world_from_camera, camera.world_from_camera)
    return SecondLook(
        poses=np.array([c.world_from_camera for c in out]),
        focal=np.array([c.fx for c in out]),
        moved=np.array(sorted(moved | found.moved), int),
        detail=detail_correlation(surface, pictures, out),
        as_well=turns,
    )


def other_places(
    shots,
    cameras: list[Camera],
    model: VolumeModel,
    degrees: float,
    still,
    options: CollectionOptions,
    seed: int,
):
    """[(photo, camera, by how much the score is better than at its own camera)], the best first:
    where else in the finished model each photo may have been taken, ELSEWHERE away or more,
    descended."""
    shots = [replace(s, camera=c.with_pose(np.eye(4))) for s, c in zip(shots, cameras, strict=True)]
    present = np.array([c.world_from_camera for c in cameras])
    crops, rings, render, found = find(
        shots, model, degrees, CHOICES if options.hypotheses > 1 else 1, seed
    )
    _, height = refine(crops, present, render, rings=rings, steps=(0,), parts=PARTS)
    still = still | np.array(
        [is_cut(c) for c in crops]
    )  # whole silhouettes are compared: they tell nothing of cut ones
    apart = np.array(
        [[turn_between(p, q) for q in row] for p, row in zip(present, found.poses, strict=True)]
    )
    photo, which = np.nonzero(
        (found.scores > height[:, None] - 0.1) & (apart > ELSEWHERE) & ~still[:, None]
    )
    if not len(photo):
        return []
    some = [crops[i] for i in photo]
    poses, scores = refine(
        some,
        found.poses[photo, which],
        render,
        rings=crop_rings(some, PARTS),
        steps=COARSE,
        parts=PARTS,
    )
    gains = scores - height[photo]
    turns = [turn_between(present[i], p) for i, p in zip(photo, poses, strict=True)]
    kept = [
        k for k in np.argsort(-gains) if gains[k] > GAIN or (gains[k] > -WORSE and turns[k] > FAR)
    ]
    if not kept:
        return []
    placed = refine_held_out_cameras(
        [shots[photo[k]] for k in kept],
        [cameras[photo[k]].with_pose(poses[k]) for k in kept],
        model,
        options,
        seed,
    )
    return [
        (int(photo[k]), camera, float(gains[k])) for k, camera in zip(kept, placed, strict=True)
    ]


def far_from(cameras: list[Camera], places) -> list[tuple[int, Camera]]:
    """(photo, camera) of those of `other_places` that are FAR from where the photo is now."""
    return [
        (i, c)
        for i, c, _ in places
        if turn_between(cameras[i].world_from_camera, c.world_from_camera) > FAR
    ]


def turn_between(a: np.ndarray, b: np.ndarray) -> float:
    """Degrees between two poses (4, 4)."""
    return rotation_angle(a[:3, :3].T @ b[:3, :3])


def refine_held_out_cameras(
    shots: list[CollectionPhoto],
    cameras: list[Camera],
    model: VolumeModel,
    options: CollectionOptions,
    seed: int,
    longer=1,
) -> list[Camera]:
    """The cameras after a descent with the shape frozen: pose, distance, focal length and small
    lights move. longer: in `frozen_steps`."""
    ignored = [s.ignored for s in shots]
    bank = make_bank(cameras, [s.rgb for s in shots], [s.mask for s in shots], ignored=ignored)
    bank.corrections = no_corrections(bank.views, CorrectionModel.ABOUT_ORIGIN)
    learnt, rates = start_photo_lights(np.array([s.tint for s in shots]), GREY)
    own = replace(
        model, reflections=learnt, rates=rates, appearance=shade_photos, correction_ratios=None
    )
    own.grid = replace(model.grid)
    o = VolumeOptions(
        (model.grid.n,),
        (longer * max(60, options.frozen_steps),),
        options.rays // 2,
        sdf_rate=0.0,
        feature_rate=0.0,
        diffusion=0.0,
        eikonal=0.0,
        sharpness=(2.0, 6.0),
        refine_cameras=options.refine_cameras,
    )
    fit_volume(bank, own, o, NoStage(), seed)
    return corrected(cameras, bank.corrections)

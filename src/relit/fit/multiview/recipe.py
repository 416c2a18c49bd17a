"""Photos around an object under one fixed, unknown light -> a relightable asset.

The recipe of the `multiview` capture. Stages:

    photos    decode; cameras to the unit frame (object sphere = unit sphere): passes/load_photos.py
    hull      visual hull of the masks; without masks the fused depths of a radiance field of the
              whole scene: passes/explore.py
    volume    signed distance field and deferred appearance, coarse to fine: passes/volume.py
    mesh      zero level set, decimated; outlines follow the masks, or without masks what the
              photos see; texture atlas: shape/outlines.py, shape/unseen.py
    surface   metallic-roughness textures and environment by Monte Carlo light transport:
              passes/first_material.py, passes/surface.py
    asset     textures with filled gutters, in the frame of the user's cameras
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import mitsuba as mi
import numpy as np

from relit.conventions import move_points, move_pose
from relit.errors import UserError
from relit.fit.passes.camera_corrections import corrected
from relit.fit.passes.explore import explore, first_shape
from relit.fit.passes.first_material import PAINT, describe, first_material
from relit.fit.passes.held_out import score_held_out
from relit.fit.passes.load_photos import UnitPhotos, load_pixels
from relit.fit.passes.material_priors import SurfaceOptions
from relit.fit.passes.pixels import PixelBank, place_cameras
from relit.fit.passes.surface import (
    EnvironmentTerms,
    SurfaceModel,
    TexelStart,
    fit_surface,
    start_surface,
)
from relit.fit.passes.volume import (
    Mend,
    VolumeModel,
    VolumeOptions,
    VolumeResult,
    fit_volume,
    start_model,
    volume_result,
)
from relit.fit.shape.hollows import without
from relit.fit.shape.lids import FIRST, open_lids
from relit.fit.shape.mesh_stage import TexelMap, hull_of_masks, outlined_mesh, texels_of, with_atlas
from relit.fit.shape.placing import placed_mesh
from relit.fit.shape.unseen import seen_faces, without_unseen
from relit.geometry.hull import visual_hull
from relit.geometry.mesh import extract_mesh, vertex_areas
from relit.geometry.se3 import align_cameras, nearest_rotation
from relit.materials.intrinsic import base_without_shading
from relit.recipe import FitContext, Recipe
from relit.rendering.appearance.fixed_light import mean_radiance
from relit.rendering.background import start_background
from relit.rendering.transport import TraceableMesh
from relit.scene import Asset, Camera, Capture, Material, Mesh
from relit.settings import check_levels, check_parts, preset


@dataclass(frozen=True)
class MultiviewOptions:
    """levels, level_steps: nodes a side and optimisation steps of each level of the volume pass; a
    surface moves by a few nodes a level, so it takes a coarse one to get from the hull into a
    concave side. rays: per step. hollows: flat faces of the visual hull that are asked whether they
    are lids (fit/shape/lids.py). max_pixels: photos are shrunk until all together have no more.
    refine_cameras: step of the camera corrections in the volume pass (0: cameras are exact).
    normal: weight of normal priors read from files. background, explore_steps: nodes a side of the
    radiance field for photos without masks, and the steps that fit it.
    faces: of the mesh, about. outlines: rounds in which the mesh follows the masks
    (fit/shape/outlines.py). texture: texels a side.
    surface_steps, points, directions: steps of the surface pass, pixels per step, directions per
    pixel. light_steps: after so many of them the light rests (0: never). light: rows of the
    environment map. without: parts of the surface pass that are switched off, names of WITHOUT.
    """

    levels: tuple[int, ...] = (48, 128, 256)
    level_steps: tuple[int, ...] = (200, 400, 400)
    rays: int = 8192
    hollows: int = 3
    max_pixels: int = 24_000_000
    refine_cameras: float = 0.0
    normal: float = 0.05
    background: int = 96
    explore_steps: int = 400
    faces: int = 40_000
    outlines: int = 3
    texture: int = 512
    surface_steps: int = 3000
    light_steps: int = 1200
    points: int = 4096
    directions: int = 32
    light: int = 64
    without: tuple[str, ...] = ()

    def __post_init__(self):
        check_parts(self.without, WITHOUT)


SMOOTH_COLOUR = 0.1  # of SurfaceOptions: here many photos see each place under one light
EXCHANGE_RATE = 0.04  # of SurfaceOptions: the light must have arrived when it comes to rest
LIGHT_EVEN = 1e-3  # of SurfaceOptions: holds the light where photos do not tell it from base colour

WITHOUT = {  # what an ablation switches off: settings of the surface pass
    "interreflection": {},  # what blocks a direction is black
    "exchange": {"exchange_rate": 0.0},
    "white": {"bright": 0.0},
    "material_prior": {
        "smooth_roughness": 0.0,
        "smooth_metallic": 0.0,
        "metallic_binary": 0.0,
        "metallic_sparse": 0.0,
    },
    "colour_smoothing": {"smooth_colour": 0.0},
    "light_prior": {"light_smooth": 0.0, "light_neutral": 0.0, "light_even": 0.0},
    "parsimony": {"parsimony": 0.0},
    "normal_map": {"slope_rate": 0.0},
    "first_material": {},  # every place begins as paint of one roughness
}

PRESETS = {
    "draft": {
        "levels": (48, 96),
        "level_steps": (150, 180),
        "rays": 4096,
        "hollows": 0,
        "max_pixels": 8_000_000,
        "background": 64,
        "explore_steps": 200,
        "faces": 12_000,
        "outlines": 2,
        "texture": 256,
        "surface_steps": 700,
        "light_steps": 500,
        "points": 2048,
        "light": 32,
    },
    "standard": {},
    "high": {
        "levels": (48, 128, 256),
        "level_steps": (300, 700, 800),
        "max_pixels": 60_000_000,
        "background": 128,
        "explore_steps": 800,
        "faces": 60_000,
        "texture": 1024,
        "surface_steps": 6000,
        "light_steps": 1600,
        "points": 8192,
    },
}


def options_for(quality: str) -> MultiviewOptions:
    """The recipe's options for 'draft', 'standard' or 'high'. Raises UserError (code 2) for
    others."""
    return MultiviewOptions(**preset(quality, PRESETS))


def volume_options(o: MultiviewOptions) -> VolumeOptions:
    return VolumeOptions(
        o.levels, o.level_steps, o.rays, refine_cameras=o.refine_cameras, normal=o.normal
    )


def surface_options(o: MultiviewOptions) -> SurfaceOptions:
    own = {"smooth_colour": SMOOTH_COLOUR, "light_even": LIGHT_EVEN, "light_steps": o.light_steps}
    own |= {"exchange_rate": EXCHANGE_RATE, "exchange_mirrored": True}
    own |= {key: value for name in o.without for key, value in WITHOUT[name].items()}
    return SurfaceOptions(o.surface_steps, o.points, o.directions, o.texture, o.light, **own)


def reconstruct(capture: Capture, run, options: MultiviewOptions, seed: int = 0) -> Asset:
    """Run all stages of the recipe in the run folder; stages that are done are read back. `capture`
    has cameras and an object sphere."""
    if not capture.has_cameras or capture.sphere is None:
        raise ValueError("reconstruct needs cameras and the object sphere")
    fit = FitContext(run, options, seed)
    check_levels(options)
    photos = load_pixels(capture, options, run)
    volume = volume_stage(photos, capture, fit)
    shaped = moved_back(mesh_stage(photos, volume, fit), photos, volume, options)
    cameras, _ = refined_cameras(photos.cameras, volume, options)
    if options.refine_cameras > 0:
        place_cameras(photos.bank, cameras)
    maps = surface_stage(photos.bank, cameras, shaped, fit)
    refined = cameras if options.refine_cameras > 0 else None
    return assemble(capture, shaped.mesh, maps, refined)


# ---------------------------------------------------------------- cameras


def refined_cameras(
    cameras: list[Camera], volume: VolumeResult, options: MultiviewOptions
) -> tuple[list[Camera], np.ndarray]:
    """The cameras (unit frame) with the corrections that the volume pass has found, and
    unit_from_found (4, 4): corrections can drift together with the shape, so both are carried back
    to where the cameras were. Unchanged, and the identity, where cameras are exact."""
    if options.refine_cameras <= 0:
        return cameras, np.eye(4)
    found = corrected(cameras, volume.camera_corrections())
    poses = np.array([c.world_from_camera for c in found])
    unit_from_found = align_cameras(poses, np.array([c.world_from_camera for c in cameras]))
    return [
        c.with_pose(move_pose(unit_from_found, pose)) for c, pose in zip(found, poses, strict=True)
    ], unit_from_found


def moved_back(
    shaped: RadiantMesh, photos: UnitPhotos, volume: VolumeResult, options: MultiviewOptions
) -> RadiantMesh:
    """The mesh in the frame of the refined cameras (`refined_cameras`)."""
    if options.refine_cameras <= 0:
        return shaped
    _, unit_from_found = refined_cameras(photos.cameras, volume, options)
    mesh, turn = shaped.mesh, nearest_rotation(unit_from_found[:3, :3])
    moved = replace(
        mesh,
        vertices=move_points(unit_from_found, mesh.vertices).astype(np.float32),
        normals=(mesh.normals @ turn.T).astype(np.float32),
    )
    return replace(shaped, mesh=moved)


# ---------------------------------------------------------------- stages


def volume_stage(photos: UnitPhotos, capture: Capture, fit: FitContext) -> VolumeResult:
    """Hull, or without masks a first shape from a radiance field of the whole scene; then the
    volume pass, and its score in the photos that the capture sets aside."""
    run, options = fit.run, fit.options

    def computed(stage) -> VolumeResult:
        model, mend = (
            masked_start(photos, stage, fit) if photos.masks else unmasked_start(photos, fit)
        )
        fit_volume(photos.bank, model, volume_options(options), stage, fit.seed, mend=mend)
        volume = volume_result(model, photos.bank)
        _, unit_from_found = refined_cameras(photos.cameras, volume, options)
        score_held_out(capture, model, run, unit_from_found)
        return volume

    steps = sum(options.level_steps)
    return run.cached("volume", VolumeResult, computed, steps=steps, title="shape (volume pass)")


def masked_start(photos: UnitPhotos, stage, fit: FitContext) -> tuple[VolumeModel, Mend]:
    """The visual hull without the hollows that were found under its flat faces, and what takes
    these away from the distances of the next level, whose voxels show their rim and walls."""
    options = fit.options
    without_masks = "--sphere X,Y,Z,RADIUS, or --masks none to do without masks"
    values = hull_of_masks(photos, options.levels[0], without_masks)
    hollows = sought_hollows(photos, stage, fit) if options.hollows > 0 else None
    model = start_model(without(values, hollows), photos.level, None, full=False)
    return model, partial(without, hollows=hollows)


def unmasked_start(photos: UnitPhotos, fit: FitContext) -> tuple[VolumeModel, None]:
    """The surface of a radiance field of the whole scene, and that field as background."""
    run, options, bank = fit.run, fit.options, photos.bank
    field = start_background(options.background, photos.level)
    with run.stage("explore", steps=options.explore_steps, title="whole scene (no masks)") as stage:
        explore(bank, field, options.explore_steps, options.rays // 2, stage, fit.seed)
        stage.save("field", step=options.explore_steps, cells=np.array(field.cells))
    try:
        values = first_shape(bank, photos.cameras, field, options.levels[0])
    except ValueError:
        raise UserError(
            "nothing solid was found inside the object sphere",
            "the cameras are wrong, or the sphere lies beside the object",
            "look at `relit inspect INPUT`; give --sphere X,Y,Z,RADIUS, or masks",
            code=4,
        ) from None
    return start_model(values, photos.level, field, full=False), None


def sought_hollows(photos: UnitPhotos, stage, fit: FitContext) -> np.ndarray | None:
    """What `fit.shape.lids.open_lids` takes away from the visual hull, (n, n, n) distances or None; kept
    in the stage."""
    run, saved = fit.run, stage.load("hollows")
    if saved is None:
        coarse = visual_hull(photos.cameras, photos.masks, FIRST.nodes)
        fresh = partial(start_model, level=photos.level, background=None, full=True)
        show = run.progress("hollows that no silhouette shows")
        found = open_lids(
            photos.bank,
            photos.cameras,
            coarse,
            fresh,
            run.say,
            fit.seed,
            fit.options.hollows,
            progress=show,
        )
        saved = {"distances": np.zeros((0, 0, 0), np.float32) if found is None else found}
        stage.save("hollows", **saved)
    return saved["distances"] if saved["distances"].size else None


@dataclass(frozen=True)
class RadiantMesh:
    """mesh: in the unit frame, with an atlas. radiance: (V, 3) mean outgoing radiance of each
    vertex, linear."""

    mesh: Mesh
    radiance: np.ndarray


def mesh_stage(photos: UnitPhotos, volume: VolumeResult, fit: FitContext) -> RadiantMesh:
    """Mesh, its outlines where the masks have them, or without masks no more than the photos see,
    atlas, and the mean radiance of each vertex."""
    run, options = fit.run, fit.options

    def computed(stage) -> RadiantMesh:
        mesh = extract_mesh(volume.values, faces=options.faces)
        found = photos.cameras
        if options.refine_cameras > 0:
            found = corrected(found, volume.camera_corrections())
        if photos.masks is None:
            mesh = without_unseen(mesh, found)
        else:
            mesh = outlined_mesh(mesh, photos, found, options.outlines, run)
        mesh = with_atlas(mesh, options.texture, run.say)
        grid, reflections = volume.grid(), mi.Float(volume.reflections)
        return RadiantMesh(mesh, mean_radiance(grid, volume.features, reflections, mesh.vertices))

    return run.cached("mesh", RadiantMesh, computed, title="mesh and atlas")


@dataclass(frozen=True)
class LitMaterial:
    """Textures (S, S[, 3]) of a metallic-roughness material, linear: base_color, roughness,
    metallic, normal (tangent space). environment: (H, 2 H, 3) radiance, lat-long in the unit frame."""

    base_color: np.ndarray
    roughness: np.ndarray
    metallic: np.ndarray
    normal: np.ndarray
    environment: np.ndarray


def surface_stage(
    bank: PixelBank, cameras: list[Camera], shaped: RadiantMesh, fit: FitContext
) -> LitMaterial:
    """Material and light. cameras: unit frame. Texels that no camera sees continue the seen ones."""
    o = surface_options(fit.options)

    def computed(stage) -> LitMaterial:
        texels = texels_of(shaped.mesh, o.texture)
        model, traced = surface_start(bank, shaped, texels, stage, fit)
        fit_surface(EnvironmentTerms(bank, traced, model, o, fit.seed), stage)
        return LitMaterial(
            **texels.material_maps(model.material, seen_faces(shaped.mesh, cameras)),
            environment=model.environment.image(),
        )

    title = "material and light (surface pass)"
    return fit.run.cached("surface", LitMaterial, computed, steps=o.steps, title=title)


def surface_start(
    bank: PixelBank, shaped: RadiantMesh, texels: TexelMap, stage, fit: FitContext
) -> tuple[SurfaceModel, TraceableMesh]:
    """The material and light that the surface pass begins with, and the mesh that rays are traced
    through."""
    run, options, o = fit.run, fit.options, surface_options(fit.options)
    mesh, radiance = shaped.mesh, shaped.radiance
    known, areas = texels.known, vertex_areas(mesh)
    start = texels.spread(base_without_shading(radiance, mesh.normals, areas))
    mean = float((radiance * areas[:, None]).sum() / areas.sum() / 3)
    begun = TexelStart(start, known, mean, texels.spread(mesh.normals))
    reflecting = radiance * (0.0 if "interreflection" in options.without else 1.0)
    traced = TraceableMesh(mesh, reflecting)
    metallic, roughness = PAINT, None
    if "first_material" not in options.without and stage.load("checkpoint") is None:
        progress = run.progress("metal or paint")
        metallic, roughness = first_material(bank, traced, begun, o, fit.seed, progress)
        run.say(describe(metallic, roughness, known))
    return start_surface(begun, o, metallic, roughness), traced


def assemble(
    capture: Capture, mesh: Mesh, maps: LitMaterial, refined: list[Camera] | None
) -> Asset:
    """The asset in the frame of the user's cameras (`placed_mesh`). refined: cameras of the photos
    (unit frame), None where they are as given."""
    placed, world_from_asset = placed_mesh(capture, mesh)
    material = Material(maps.base_color, maps.roughness, maps.metallic, normal=maps.normal)
    cameras = [p.camera for p in capture.photos]
    if refined is not None:
        to_world = capture.sphere.world_from_unit
        poses = [move_pose(to_world, c.world_from_camera) for c in refined]
        cameras = [c.with_pose(pose) for c, pose in zip(cameras, poses, strict=True)]
    named = tuple((p.name, c) for p, c in zip(capture.photos, cameras, strict=True))
    return Asset(placed, material, world_from_asset, maps.environment, named, {})


RECIPE = Recipe(
    name="multiview",
    light="one fixed light is assumed (multiview)",
    options=options_for,
    run=reconstruct,
    stages=("volume", "mesh", "surface"),
    cost={"draft": (50.0, 0.9e9), "standard": (250.0, 2.1e9), "high": (1000.0, 3.0e9)},
    ablations={
        "interreflection": "light that surfaces reflect onto each other",
        "exchange": "steps along which light and base colour trade brightness",
        "white": "the penalty of base colours brighter than white paint",
        "material_prior": "smoothness and sparsity of roughness and metallic",
        "colour_smoothing": "smoothness of base colour between similar neighbours",
        "light_prior": "total variation and chroma of the environment",
        "parsimony": "the prior of few distinct base colours",
        "normal_map": "shading detail finer than the mesh",
        "first_material": "the choice between metal and paint before the surface pass",
    },
)

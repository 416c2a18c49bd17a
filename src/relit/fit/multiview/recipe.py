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

from dataclasses import dataclass
from functools import partial

import numpy as np

from relit.conventions import move_points, move_pose
from relit.errors import UserError
from relit.fit.passes.explore import explore, first_shape
from relit.fit.passes.first_material import PAINT, describe, first_material
from relit.fit.passes.held_out import score_held_out
from relit.fit.passes.load_photos import load_pixels
from relit.fit.passes.material_priors import SurfaceOptions
from relit.fit.passes.pixels import PixelBank, corrected, place_cameras
from relit.fit.passes.surface import EnvironmentTerms, fit_surface, start_surface
from relit.fit.passes.volume import VolumeModel, VolumeOptions, fit_volume, start_model
from relit.fit.shape.hollows import without
from relit.fit.shape.inpaint import painted_over
from relit.fit.shape.lids import FIRST, open_lids
from relit.fit.shape.odd_photos import check_masks
from relit.fit.shape.outlines import follow_outlines
from relit.fit.shape.placing import placed_mesh
from relit.fit.shape.unseen import seen_faces, without_unseen
from relit.geometry.atlas import unwrap
from relit.geometry.bake import fill_gutters, interpolate, rasterise_atlas
from relit.geometry.hull import NoShape, visual_hull
from relit.geometry.mesh import extract_mesh, vertex_areas
from relit.geometry.sdf import dense_values, row_features
from relit.geometry.se3 import align_cameras, nearest_rotation
from relit.materials.field import normal_map, pictures
from relit.materials.intrinsic import base_without_shading
from relit.recipe import FitContext, Recipe
from relit.rendering.appearance.fixed_light import mean_radiance
from relit.rendering.background import start_background
from relit.rendering.transport import TraceableMesh
from relit.run import run_arrays
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
    bank, cameras, masks, level = load_pixels(capture, options, run)

    if run.done("mesh"):
        parts = run_arrays(run, "mesh", "mesh")
    else:
        model = volume_stage(bank, cameras, masks, level, fit)
        score_held_out(capture, model, run, refined_cameras(cameras, run, options)[1])
        parts = mesh_stage(model, cameras, masks, [p.name for p in capture.photos], run, options)
    cameras, parts = follow_cameras(bank, cameras, parts, run, options)
    mesh = Mesh(parts["vertices"], parts["faces"], parts["normals"], parts["uvs"])

    if run.done("surface"):
        maps = run_arrays(run, "surface", "maps")
    else:
        maps = surface_stage(bank, cameras, mesh, parts["radiance"], fit)
    poses = (
        [move_pose(capture.sphere.world_from_unit, c.world_from_camera) for c in cameras]
        if options.refine_cameras > 0
        else None
    )
    return assemble(capture, mesh, maps, poses)


def refined_cameras(
    cameras: list[Camera], run, options: MultiviewOptions
) -> tuple[list[Camera], np.ndarray]:
    """The cameras (unit frame) with the corrections that the volume pass has found, and
    unit_from_found (4, 4): corrections can drift together with the shape, so both are carried back
    to where the cameras were. Unchanged, and the identity, where cameras are exact."""
    if options.refine_cameras <= 0:
        return cameras, np.eye(4)
    found = found_cameras(cameras, run, options)
    poses = np.array([c.world_from_camera for c in found])
    unit_from_found = align_cameras(poses, np.array([c.world_from_camera for c in cameras]))
    return [
        c.with_pose(move_pose(unit_from_found, pose)) for c, pose in zip(found, poses, strict=True)
    ], unit_from_found


def found_cameras(cameras: list[Camera], run, options: MultiviewOptions) -> list[Camera]:
    """The cameras (unit frame) as the shape of the volume pass has them, with its corrections where
    they are refined."""
    return (
        cameras
        if options.refine_cameras <= 0
        else corrected(cameras, run_arrays(run, "volume", "checkpoint")["corrections"])
    )


def follow_cameras(
    bank: PixelBank,
    cameras: list[Camera],
    parts: dict[str, np.ndarray],
    run,
    options: MultiviewOptions,
):
    """Refined cameras for the pixel bank, and the mesh in their frame; returns (cameras, parts)."""
    cameras, unit_from_found = refined_cameras(cameras, run, options)
    if options.refine_cameras <= 0:
        return cameras, parts
    place_cameras(bank, cameras)
    turn = nearest_rotation(unit_from_found[:3, :3])
    moved = move_points(unit_from_found, parts["vertices"]).astype(np.float32)
    return cameras, {
        **parts,
        "vertices": moved,
        "normals": (parts["normals"] @ turn.T).astype(np.float32),
    }


def volume_stage(
    bank: PixelBank, cameras: list[Camera], masks, level, fit: FitContext
) -> VolumeModel:
    """Hull, or without masks a first shape from a radiance field of the whole scene; then the
    volume pass."""
    run, options, seed = fit.run, fit.options, fit.seed
    if masks is None:
        field = start_background(options.background, level)
        with run.stage(
            "explore", steps=options.explore_steps, title="whole scene (no masks)"
        ) as stage:
            explore(bank, field, options.explore_steps, options.rays // 2, stage, seed)
            stage.save("field", step=options.explore_steps, cells=np.array(field.cells))
    with run.stage("volume", steps=sum(options.level_steps), title="shape (volume pass)") as stage:
        n, mend = options.levels[0], None
        if masks is not None:
            try:
                values = visual_hull(cameras, masks, n)
            except NoShape:
                raise UserError(
                    "the masks and the cameras do not agree: no point of space lies inside the masks of nearly all photos",
                    "wrong cameras, a wrong camera convention, inverted masks, or an object sphere that misses the object",
                    "look at `relit inspect INPUT`; give --sphere X,Y,Z,RADIUS, or --masks none to do without masks",
                    code=4,
                ) from None
            hollows = (
                sought_hollows(bank, cameras, masks, level, run, stage, options, seed)
                if options.hollows > 0
                else None
            )
            model = start_model(without(values, hollows), level, None, full=False)
            mend = partial(
                without, hollows=hollows
            )  # its rim and walls are finer than the first level's voxels
        else:
            try:
                values = first_shape(bank, cameras, field, n)
            except ValueError:
                raise UserError(
                    "nothing solid was found inside the object sphere",
                    "the cameras are wrong, or the sphere lies beside the object",
                    "look at `relit inspect INPUT`; give --sphere X,Y,Z,RADIUS, or masks",
                    code=4,
                ) from None
            model = start_model(values, level, field, full=False)
        fit_volume(bank, model, volume_options(options), stage, seed, mend=mend)
    return model


def sought_hollows(
    bank: PixelBank,
    cameras: list[Camera],
    masks,
    level,
    run,
    stage,
    options: MultiviewOptions,
    seed: int,
):
    """What `fit.shape.lids.open_lids` takes away from the visual hull, (n, n, n) distances or None; kept
    in the stage."""
    saved = stage.load("hollows")
    if saved is None:
        coarse = visual_hull(cameras, masks, FIRST.nodes)
        fresh = partial(start_model, level=level, background=None, full=True)
        show = run.progress("hollows that no silhouette shows")
        found = open_lids(
            bank, cameras, coarse, fresh, run.say, seed, options.hollows, progress=show
        )
        saved = {"distances": np.zeros((0, 0, 0), np.float32) if found is None else found}
        stage.save("hollows", **saved)
    return saved["distances"] if saved["distances"].size else None


def mesh_stage(
    model: VolumeModel,
    cameras: list[Camera],
    masks,
    names: list[str],
    run,
    options: MultiviewOptions,
) -> dict[str, np.ndarray]:
    """Mesh, its outlines where the masks have them, or without masks no more than the photos see,
    atlas, and the mean radiance of each vertex. Returns (and keeps) vertices, faces, normals, uvs,
    radiance. names: of the photos."""
    with run.stage("mesh", title="mesh and atlas") as stage:
        mesh = extract_mesh(dense_values(model.grid), faces=options.faces)
        found = found_cameras(cameras, run, options)
        mesh = (
            without_unseen(mesh, found)
            if masks is None
            else follow_outlines(mesh, found, masks, options.outlines)
        )
        if masks is not None and (note := check_masks(mesh, found, masks, names)):
            run.say(note)
        mesh, how = unwrap(mesh, options.texture)
        if how != "xatlas":
            run.say(
                "note: the mesh was too difficult for charts; its atlas has one cell for every two faces"
            )
        parts = {
            "vertices": mesh.vertices,
            "faces": mesh.faces,
            "normals": mesh.normals,
            "uvs": mesh.uvs,
            "radiance": mean_radiance(
                model.grid, row_features(model.grid), model.reflections, mesh.vertices
            ),
        }
        stage.save("mesh", **parts)
    return parts


def surface_stage(
    bank: PixelBank, cameras, mesh: Mesh, radiance, fit: FitContext
) -> dict[str, np.ndarray]:
    """Material and light. cameras: unit frame. What none of them sees is painted like what is next
    to it. Returns (and keeps) base_color, roughness, metallic, normal, environment (unit frame),
    f0."""
    run, options, seed = fit.run, fit.options, fit.seed
    o = surface_options(options)
    with run.stage("surface", steps=o.steps, title="material and light (surface pass)") as stage:
        face, bary = rasterise_atlas(mesh, o.texture)
        known = face >= 0
        areas = vertex_areas(mesh)
        guess = base_without_shading(radiance, mesh.normals, areas)
        start = fill_gutters(interpolate(guess, mesh.faces, face, bary), known)
        mean = float((radiance * areas[:, None]).sum() / areas.sum() / 3)
        normals = fill_gutters(interpolate(mesh.normals, mesh.faces, face, bary), known)
        reflecting = radiance * (0.0 if "interreflection" in options.without else 1.0)
        traced = TraceableMesh(mesh, reflecting)
        metallic, roughness = PAINT, None
        if "first_material" not in options.without and stage.load("checkpoint") is None:
            metallic, roughness = first_material(
                bank, traced, start, known, mean, normals, o, seed, run.progress("metal or paint")
            )
            run.say(describe(metallic, roughness, known))
        model = start_surface(start, known, mean, o, normals, metallic, roughness)
        fit_surface(EnvironmentTerms(bank, traced, model, o, seed), stage)
        base, roughness, metallic = pictures(model.material)
        paint = {"base_color": base, "roughness": roughness, "metallic": metallic}
        paint = painted_over(
            mesh,
            seen_faces(mesh, cameras),
            {n: fill_gutters(t, known) for n, t in paint.items()},
            face,
            bary,
        )
        maps = {
            **paint,
            "environment": model.environment.image(),
            "normal": normal_map(model.material),
            "f0": np.array(model.material.f0),
        }
        stage.save("maps", **maps)
    return maps


def assemble(capture: Capture, mesh: Mesh, maps: dict[str, np.ndarray], poses=None) -> Asset:
    """The asset in the frame of the user's cameras (`placed_mesh`).

    poses: world_from_camera (4, 4) of each photo where the cameras were refined.
    """
    placed, world_from_asset = placed_mesh(capture, mesh)
    material = Material(
        maps["base_color"], maps["roughness"], maps["metallic"], normal=maps["normal"]
    )
    poses = [p.camera.world_from_camera for p in capture.photos] if poses is None else poses
    cameras = tuple(
        (p.name, p.camera.with_pose(pose)) for p, pose in zip(capture.photos, poses, strict=True)
    )
    return Asset(placed, material, world_from_asset, maps["environment"], cameras, {})


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

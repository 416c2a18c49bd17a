"""Photos in a dark room under the camera's own flash -> shape, rough plastic and the flash.

The recipe of the `flash` capture: PIR (Bao et al. 2024), with voxels and textures in place of its
networks. Stages:

    photos    decode; cameras to the unit frame: passes/load_photos.py
    hull      visual hull of the masks, opened where the photos contradict it: shape/hollows.py
    volume    signed distance field, shaded by the flash at each rendered point:
              rendering/appearance/flash_light.py
    mesh      zero level set, decimated; outlines follow the masks; texture atlas; albedos of the
              vertices: shape/outlines.py
    surface   rough-plastic textures, normal map and flash by exact direct light and estimated
              inter-reflection: flash/surface.py
    asset     textures with filled gutters, in the frame of the user's cameras

Direct light does not determine the common scale of intensity and albedos: it is set so that the
99th percentile of the diffuse albedo is BRIGHTEST.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from relit.capture.photo import layers
from relit.errors import UserError
from relit.fit.flash.ambient import find_ambient
from relit.fit.flash.dino import DinoNetwork, network_file
from relit.fit.flash.features import FlashView, capture_features, network_features
from relit.fit.flash.lobe_clusters import start_kinship
from relit.fit.flash.surface import FlashModel, FlashSurfaceOptions, FlashTerms, fit_flash_surface
from relit.fit.passes.held_out import score_held_out
from relit.fit.passes.load_photos import load_pixels
from relit.fit.passes.pixels import PixelBank
from relit.fit.passes.volume import VolumeModel, VolumeOptions, fit_volume, start_model
from relit.fit.shape.hollows import HollowOptions, open_hollows, without
from relit.fit.shape.odd_photos import check_masks
from relit.fit.shape.outlines import follow_outlines
from relit.fit.shape.placing import placed_mesh
from relit.geometry.atlas import unwrap
from relit.geometry.bake import fill_gutters, interpolate, rasterise_atlas
from relit.geometry.hull import NoShape, visual_hull
from relit.geometry.mesh import extract_mesh
from relit.geometry.sdf import dense_values, row_features
from relit.masks.threshold import Backdrop
from relit.materials.plastic_as_gltf import base_colour
from relit.materials.plastic_field import MOST_SPECULAR, plastic_pictures, start_plastic
from relit.materials.rough_plastic import IOR, Coat
from relit.recipe import FitContext, Recipe
from relit.rendering.appearance.fixed_light import features_at
from relit.rendering.appearance.flash_light import FlashAppearance, alpha_on, start_learnt
from relit.rendering.transport import TraceableMesh
from relit.run import run_arrays
from relit.scene import Asset, Camera, Capture, Flash, Material, Mesh
from relit.settings import check_levels, check_parts, preset

BRIGHTEST = 0.8  # the 99th percentile of the diffuse albedo, by which its scale is set
COARSE_FACES = 20_000  # of the mesh on which the volume pass's inter-reflection is estimated
PLACE = 0.15  # how much a unit length counts beside a display value when places are compared
# of the last level's steps in which the flash still stands at the camera: before the shape, it runs
# past its place
HELD = 0.25
START_ALBEDO, MEAN_COSINE, START_WIDTH = 0.4, 0.7, 0.2


@dataclass(frozen=True)
class FlashOptions:
    """levels, level_steps: nodes a side and optimisation steps of each level of the volume pass.
    rays: per step. max_pixels: photos are shrunk until all together have no more. shadows: soft
    visibility in the last level of the volume pass.
    faces: of the mesh, about. outlines: rounds in which it follows the masks
    (fit/shape/outlines.py). texture: texels a side.
    surface_steps, points: steps of the surface pass, pixels per step.
    hollows: nodes a side of the search for concavities that no silhouette shows
    (fit/shape/hollows.py), 0 for none.
    directions: of inter-reflection per pixel and estimate. bounces: of it. ior: index of refraction
    of the coat.
    smooth: weight of the material's smoothness. patches: weight of PIR's pyramid and SSIM terms,
    none by default.
    dino: an ONNX file of a DINO network whose features tell which places are alike, or
    `hub:OWNER/NAME/PATH` to fetch it; what the capture itself tells where empty. check_light:
    refuse photos whose light clearly does not move with the camera. without: parts that are
    switched off, names of WITHOUT.
    """

    levels: tuple[int, ...] = (128, 256)
    level_steps: tuple[int, ...] = (400, 600)
    rays: int = 8192
    max_pixels: int = 24_000_000
    shadows: bool = True
    hollows: int = 64
    faces: int = 60_000
    outlines: int = 3
    texture: int = 512
    surface_steps: int = 2000
    points: int = 8192
    directions: int = 1
    bounces: int = 2
    ior: float = IOR
    smooth: float = 0.0003
    patches: float = 0.0
    dino: str = ""
    check_light: bool = True
    without: tuple[str, ...] = ()

    def __post_init__(self):
        if self.directions < 0 or self.bounces < 1:
            raise ValueError("directions must be at least 0 and bounces at least 1")
        check_parts(self.without, WITHOUT)


WITHOUT = ("offset", "shadow", "interreflection", "features", "refinement")

PRESETS = {
    "draft": {
        "levels": (48, 96),
        "level_steps": (150, 200),
        "hollows": 48,
        "rays": 4096,
        "max_pixels": 8_000_000,
        "faces": 20_000,
        "outlines": 2,
        "texture": 256,
        "surface_steps": 400,
        "points": 4096,
        "bounces": 1,
    },
    "standard": {},
    "high": {
        "level_steps": (800, 1200),
        "max_pixels": 60_000_000,
        "texture": 1024,
        "surface_steps": 5000,
    },
}


def options_for(quality: str) -> FlashOptions:
    """The recipe's options for 'draft', 'standard' or 'high'. Raises UserError (code 2) for
    others."""
    return FlashOptions(**preset(quality, PRESETS))


def surface_options(o: FlashOptions) -> FlashSurfaceOptions:
    off = {}
    if "offset" in o.without:
        off["offset_rate"] = 0.0
    if "refinement" in o.without:
        off["slope_rate"] = 0.0
    directions = 0 if "interreflection" in o.without else o.directions
    share = {"smooth": o.smooth} if "features" not in o.without else {"smooth": 0.0}
    shadow = "shadow" not in o.without
    return FlashSurfaceOptions(
        o.surface_steps, o.points, directions, o.bounces, shadow, patches=o.patches, **off, **share
    )


def reconstruct(capture: Capture, run, options: FlashOptions, seed: int = 0) -> Asset:
    """Run all stages of the recipe in the run folder; stages that are done are read back. `capture`
    has cameras and an object sphere."""
    if not capture.has_cameras or capture.sphere is None:
        raise ValueError("reconstruct needs cameras and the object sphere")
    fit = FitContext(run, options, seed)
    check_levels(options)
    check_backdrop(capture)
    bank, cameras, masks, level = load_pixels(capture, options, run)
    check_photos(bank, cameras, masks, level)
    bank.drop_saturated = True
    coat = Coat(options.ior)
    if options.dino and not run.done("surface"):
        DinoNetwork(
            network_file(options.dino)
        )  # what is wrong with it is told before anything is computed
    if run.done("mesh"):
        parts = run_arrays(run, "mesh", "mesh")
    else:
        model = volume_stage(bank, cameras, masks, level, coat, fit)
        score_held_out(capture, model, run, np.eye(4))
        parts = mesh_stage(model, cameras, masks, [p.name for p in capture.photos], run, options)
    mesh = Mesh(parts["vertices"], parts["faces"], parts["normals"], parts["uvs"])
    if run.done("surface"):
        maps = run_arrays(run, "surface", "maps")
    else:
        maps = surface_stage(bank, cameras, mesh, parts, coat, fit)
    return assemble(capture, mesh, maps, options.ior)


def check_backdrop(capture: Capture) -> None:
    """Raises UserError where the masks were found before a plain backdrop that is not dark: other
    light than the flash falls on it."""
    backdrops = [
        m
        for p in capture.photos
        for layer in layers(p.load)
        if isinstance(m := getattr(layer, "mask", None), Backdrop)
    ]
    if sum(not b.dark for b in backdrops) > len(capture.photos) / 2:
        raise UserError(
            "the surroundings are not dark: the photos stand before a bright, even backdrop",
            "a flash capture is taken in a dark room, where the flash is the only light and the background stays black",
            "take --capture multiview for photos under fixed lamps; or give mask files for flash photos before a bright backdrop",
        )


def check_photos(bank: PixelBank, cameras: list[Camera], masks, level: np.ndarray) -> None:
    """Raises UserError for photos that are no flash capture that could be reconstructed. level:
    mean radiance of the object (3,)."""
    if float(np.max(level)) < 0.004:
        raise UserError(
            "the photos are black",
            "the flash did not fire, or the exposure was far too short",
            "look at the photos, and take them again",
        )
    if masks is None:
        raise UserError(
            "the surroundings are not dark, and there are no masks",
            "a flash capture is taken in a dark room, where the flash is the only light and the background stays black",
            "take --capture multiview for photos under fixed lamps; or give masks for flash photos with a visible background",
        )
    centres = np.array([c.centre for c in cameras])
    reach = np.linalg.norm(centres, axis=1).mean()
    if np.linalg.norm(centres - centres.mean(0), axis=1).max() < 0.05 * reach:
        raise UserError(
            "all photos are taken from one place",
            "shape is found by comparing photos from different sides, and a flash lights each of them differently",
            "photograph from all around the object",
        )
    rgbm = np.array(bank.rgbm).reshape(-1, 4)
    inside = rgbm[rgbm[:, 3] > 0.99][::7, :3]
    ends = np.repeat(
        np.broadcast_to(np.array(bank.saturated), bank.views),
        np.diff([*np.array(bank.offsets), bank.total]),
    )
    burnt = float((inside.min(1) >= ends[rgbm[:, 3] > 0.99][::7]).mean()) if len(inside) else 0.0
    if burnt > 0.5:
        raise UserError(
            f"{100 * burnt:.0f} % of the object's pixels are over-exposed",
            "what is white in every photo has no colour, and its highlights have no edge",
            "take the photos again with a shorter exposure, or with the flash farther away",
        )


def volume_stage(
    bank: PixelBank, cameras: list[Camera], masks, level, coat: Coat, fit: FitContext
) -> VolumeModel:
    """Visual hull, then the volume pass with the flash's shading. The model's `extra` holds the
    intensity."""
    run, options, seed = fit.run, fit.options, fit.seed
    distance2 = float(np.median([c.centre @ c.centre for c in cameras]))
    intensity = np.pi * distance2 * float(level.mean()) / (START_ALBEDO * MEAN_COSINE)
    shadows = options.shadows and "shadow" not in options.without
    free = (
        np.inf
        if "offset" in options.without
        else sum(options.level_steps) - (1 - HELD) * options.level_steps[-1]
    )
    with run.stage("volume", steps=sum(options.level_steps), title="shape (volume pass)") as stage:
        try:
            values = visual_hull(cameras, masks, options.levels[0])
        except NoShape:
            raise UserError(
                "the masks and the cameras do not agree: no point of space lies inside the masks of nearly all photos",
                "wrong cameras, a wrong camera convention, inverted masks, or an object sphere that misses the object",
                "look at `relit inspect INPUT`; give --sphere X,Y,Z,RADIUS",
                code=4,
            ) from None

        def start(values: np.ndarray, full: bool) -> VolumeModel:
            model = start_model(values, START_ALBEDO * level / level.mean(), None, full=full)
            model.reflections, rates = start_learnt()
            model.rates = rates_by_step(
                rates, 0 if full and "offset" not in options.without else free
            )
            appearance = FlashAppearance(coat, intensity, options.levels[-1] if shadows else np.inf)
            model.appearance, appearance.model = appearance, model
            model.extra["intensity"] = intensity
            return model

        if options.hollows > 0 and not stage.load("checkpoint"):
            o = HollowOptions(options.hollows)
            coarse = visual_hull(cameras, masks, o.nodes)
            show = run.progress("hollows that no silhouette shows")
            values = without(
                values,
                open_hollows(
                    bank, cameras, coarse, lambda v: start(v, True), o, run.say, seed, show
                ),
            )
        model = start(values, False)
        mirrors = options.directions > 0 and "interreflection" not in options.without
        shadow = "shadow" not in options.without
        begin_level = (lambda m: look_around(bank, cameras, m, coat, shadow)) if mirrors else None
        fit_volume(
            bank,
            model,
            VolumeOptions(options.levels, options.level_steps, options.rays),
            stage,
            seed,
            begin_level,
        )
        model.appearance.around = (
            None  # it holds the training photos; the score of others goes without
        )
        offset = np.array(model.reflections)[:3]
        run.say(
            f"flash after the volume pass: offset {offset.round(4).tolist()} of the object sphere's radius"
        )
    return model


def rates_by_step(rates, free: float) -> Callable:
    """Step -> `rates` (Float), those of the flash's offset 0 before the step `free`."""
    held = np.array(rates)
    held[:3] = 0
    held = mi.Float(held)
    return lambda i: rates if i >= free else held


def look_around(
    bank: PixelBank, cameras: list[Camera], model: VolumeModel, coat: Coat, shadow: bool = True
) -> None:
    """Tell the model's appearance what light its surface, as it is now, throws on itself. shadow:
    whether the flash throws any."""
    values = dense_values(model.grid)
    flash = FlashView(np.array(model.reflections)[:3], float(model.appearance.intensity[0]), shadow)
    ambient = find_ambient(
        bank, cameras, extract_mesh(values, faces=COARSE_FACES), coat, flash, BRIGHTEST
    )
    model.appearance.around = ambient.around(values, coat)


def mesh_stage(
    model: VolumeModel, cameras: list[Camera], masks, names: list[str], run, options: FlashOptions
) -> dict[str, np.ndarray]:
    """Mesh, its outlines where the masks have them, atlas, and what the volume pass knows of each
    vertex. Returns (and keeps) vertices, faces, normals, uvs, albedo (V, 4: diffuse and specular),
    alpha (V,), offset (3,), intensity. names: of the photos."""
    with run.stage("mesh", title="mesh and atlas") as stage:
        mesh = extract_mesh(dense_values(model.grid), faces=options.faces)
        rounds = 0 if "refinement" in options.without else options.outlines
        mesh = follow_outlines(mesh, cameras, masks, rounds)
        if note := check_masks(mesh, cameras, masks, names):
            run.say(note)
        mesh, how = unwrap(mesh, options.texture)
        if how != "xatlas":
            run.say(
                "note: the mesh was too difficult for charts; its atlas has one cell for every two faces"
            )
        learnt = np.array(model.reflections)
        parts = {
            "vertices": mesh.vertices,
            "faces": mesh.faces,
            "normals": mesh.normals,
            "uvs": mesh.uvs,
            "albedo": np.maximum(
                features_at(model.grid, row_features(model.grid), mesh.vertices), 0
            ).astype(np.float32),
            "alpha": alpha_on(learnt, mesh.vertices),
            "offset": learnt[:3],
            "intensity": np.array(model.extra["intensity"]),
        }
        stage.save("mesh", **parts)
    return parts


def surface_stage(bank: PixelBank, cameras, mesh: Mesh, parts, coat: Coat, fit: FitContext):
    """Material and flash. Returns (and keeps) diffuse, specular, alpha, normal, offset and
    intensity (unit frame)."""
    run, options, seed = fit.run, fit.options, fit.seed
    o = surface_options(options)
    network = DinoNetwork(network_file(options.dino)) if options.dino else None
    with run.stage("surface", steps=o.steps, title="material and flash (surface pass)") as stage:
        face, bary = rasterise_atlas(mesh, options.texture)
        known = face >= 0
        spread = lambda v: fill_gutters(interpolate(v, mesh.faces, face, bary), known)  # noqa: E731
        traceable = TraceableMesh(mesh, np.zeros_like(mesh.vertices))
        flash = FlashView(parts["offset"], float(parts["intensity"]), o.shadow)
        texels = {
            "x": interpolate(mesh.vertices, mesh.faces, face, bary)[known],
            "n": interpolate(mesh.normals, mesh.faces, face, bary)[known],
        }
        ambient = (
            None if o.directions == 0 else find_ambient(bank, cameras, mesh, coat, flash, BRIGHTEST)
        )
        found = capture_features(
            bank, cameras, traceable, texels["x"], texels["n"], coat, flash, ambient
        )
        diffuse = spread(parts["albedo"][:, :3])
        diffuse[known] = np.where(found.seen[:, None], found.albedo, diffuse[known])
        scale = BRIGHTEST / max(float(np.percentile(diffuse[known].max(1), 99)), 1e-6)
        specular = np.clip(spread(parts["albedo"][:, 3:])[..., 0] * scale, 0.05, MOST_SPECULAR)
        specular = np.full_like(
            specular, np.median(specular[known])
        )  # one lobe all over: that of the volume pass is coarse
        alpha = np.full_like(specular, START_WIDTH)
        field = start_plastic(np.clip(fill_gutters(diffuse, known) * scale, 0, 1), specular, alpha)
        features = np.zeros((*known.shape, 4), np.float32)
        features[known] = found.features
        if network is not None:
            features[known] = network_features(
                bank, cameras, traceable, texels["x"], texels["n"], flash, network
            )
        log_intensity = mi.Float([float(np.log(flash.intensity / scale))])
        features = fill_gutters(features, known)
        kinship = None
        if "features" not in options.without:
            place = PLACE * spread(mesh.vertices)
            lobe = np.stack([specular, alpha], -1)
            kinship = start_kinship(np.concatenate([features, place], -1), known, lobe)
        model = FlashModel(
            field,
            mi.Float(features.ravel()),
            kinship,
            mi.Float(parts["offset"]),
            log_intensity,
            coat,
        )
        if ambient is not None:
            model.around = ambient.on_texels(texels["x"], texels["n"], known, coat)
        fit_flash_surface(FlashTerms(bank, cameras, traceable, model, o), stage, seed)
        maps = {
            name: fill_gutters(picture, known)
            for name, picture in plastic_pictures(model.field).items()
        }
        maps |= {
            "offset": np.array(model.offset),
            "intensity": np.exp(np.array(model.log_intensity)),
        }
        stage.save("maps", **maps)
        right, down, forward = maps["offset"]
        run.say(
            f"flash: offset ({right:.4f}, {down:.4f}, {forward:.4f}) of the object sphere's radius: right, down, forward of the camera"
        )
    return maps


def assemble(capture: Capture, mesh: Mesh, maps: dict[str, np.ndarray], ior: float) -> Asset:
    """The asset in the frame of the user's cameras (`placed_mesh`)."""
    (placed, world_from_asset), radius = placed_mesh(capture, mesh), capture.sphere.radius
    roughness = np.sqrt(maps["alpha"])
    base = base_colour(maps["diffuse"], roughness, maps["specular"], ior)
    metallic = np.zeros((1, 1), np.float32)
    material = Material(
        base, roughness, metallic, ior, maps["specular"], maps["normal"], maps["diffuse"]
    )
    flash = Flash(
        maps["offset"].astype(np.float64) * radius,
        np.full(3, float(maps["intensity"][0]) * radius**2),
    )
    cameras = tuple((p.name, p.camera) for p in capture.photos)
    return Asset(
        placed, material, world_from_asset, None, cameras, {"material": "rough_plastic"}, flash
    )


RECIPE = Recipe(
    name="flash",
    light="a flash that moves with the camera, in a dark room",
    options=options_for,
    run=reconstruct,
    stages=("volume", "mesh", "surface"),
    # 120 photos of 400 x 400 took 217 s and 2.4 GB at standard, half of it the volume pass; 56 s at
    # draft
    cost={"draft": (55.0, 0.9e9), "standard": (215.0, 2.0e9), "high": (600.0, 2.8e9)},
    ablations={
        "offset": "the flash's place beside the lens (PIR Sec. 3.3)",
        "shadow": "soft visibility of the flash (PIR Eq. 5)",
        "interreflection": "light that surfaces reflect onto each other (PIR Sec. 3.4)",
        "features": "shared gloss of similar places (PIR Sec. 3.5)",
        "refinement": "the normal map (PIR Sec. 3.6)",
    },
)

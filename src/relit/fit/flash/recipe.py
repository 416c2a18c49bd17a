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
from relit.fit.flash.features import FlashLamp, FlashPhotos, capture_features, network_features
from relit.fit.flash.lobe_clusters import start_kinship
from relit.fit.flash.surface import FlashModel, FlashSurfaceOptions, FlashTerms, fit_flash_surface
from relit.fit.passes.held_out import score_held_out
from relit.fit.passes.load_photos import UnitPhotos, load_pixels
from relit.fit.passes.volume import (
    VolumeModel,
    VolumeOptions,
    VolumeResult,
    fit_volume,
    start_model,
    volume_result,
)
from relit.fit.shape.hollows import HollowOptions, open_hollows, without
from relit.fit.shape.mesh_stage import TexelMap, hull_of_masks, outlined_mesh, texels_of, with_atlas
from relit.fit.shape.placing import placed_mesh
from relit.geometry.hull import visual_hull
from relit.geometry.mesh import extract_mesh
from relit.geometry.sdf import dense_values
from relit.masks.threshold import Backdrop
from relit.materials.plastic_as_gltf import base_colour
from relit.materials.plastic_field import MOST_SPECULAR, plastic_pictures, start_plastic
from relit.materials.rough_plastic import IOR, Coat
from relit.recipe import FitContext, Recipe
from relit.rendering.appearance.fixed_light import features_at
from relit.rendering.appearance.flash_light import FlashAppearance, start_learnt
from relit.rendering.transport import TraceableMesh
from relit.scene import Asset, Capture, Flash, Material, Mesh
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
    photos = load_pixels(capture, options, run)
    check_photos(photos)
    photos.bank.drop_saturated = True
    if options.dino and not run.done("surface"):
        DinoNetwork(network_file(options.dino))  # a file that cannot be used is named at once
    volume = volume_stage(photos, capture, fit)
    shaped = mesh_stage(photos, volume, fit)
    maps = surface_stage(photos, shaped, fit)
    return assemble(capture, shaped.mesh, maps, options.ior)


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


def check_photos(photos: UnitPhotos) -> None:
    """Raises UserError for photos that are no flash capture that could be reconstructed."""
    bank = photos.bank
    if float(np.max(photos.level)) < 0.004:
        raise UserError(
            "the photos are black",
            "the flash did not fire, or the exposure was far too short",
            "look at the photos, and take them again",
        )
    if photos.masks is None:
        raise UserError(
            "the surroundings are not dark, and there are no masks",
            "a flash capture is taken in a dark room, where the flash is the only light and the background stays black",
            "take --capture multiview for photos under fixed lamps; or give masks for flash photos with a visible background",
        )
    centres = np.array([c.centre for c in photos.cameras])
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


def volume_stage(photos: UnitPhotos, capture: Capture, fit: FitContext) -> VolumeResult:
    """Visual hull, then the volume pass with the flash's shading, and its score in the photos that
    the capture sets aside."""
    run, options, bank = fit.run, fit.options, photos.bank
    coat, shadow = Coat(options.ior), "shadow" not in options.without
    mirrors = options.directions > 0 and "interreflection" not in options.without

    def computed(stage) -> VolumeResult:
        model = opened_hull(photos, stage, fit)
        begin_level = (lambda m: look_around(photos, m, coat, shadow)) if mirrors else None
        passes = VolumeOptions(options.levels, options.level_steps, options.rays)
        fit_volume(bank, model, passes, stage, fit.seed, begin_level)
        # it holds the training photos; the score of others goes without
        model.appearance.around = None
        offset = np.array(model.reflections)[:3]
        run.say(
            f"flash after the volume pass: offset {offset.round(4).tolist()} of the object sphere's radius"
        )
        score_held_out(capture, model, run, np.eye(4))
        return volume_result(model, bank)

    steps = sum(options.level_steps)
    return run.cached("volume", VolumeResult, computed, steps=steps, title="shape (volume pass)")


def intensity_of(photos: UnitPhotos) -> float:
    """Intensity of the flash with which a mean albedo of START_ALBEDO has the photos' mean radiance
    (PIR Eq. 2), in radiance times squared unit lengths."""
    distance2 = float(np.median([c.centre @ c.centre for c in photos.cameras]))
    return np.pi * distance2 * float(photos.level.mean()) / (START_ALBEDO * MEAN_COSINE)


def opened_hull(photos: UnitPhotos, stage, fit: FitContext) -> VolumeModel:
    """The visual hull, opened where the photos contradict it."""
    run, options = fit.run, fit.options
    values = hull_of_masks(photos, options.levels[0], "--sphere X,Y,Z,RADIUS")
    if options.hollows > 0 and not stage.load("checkpoint"):
        o = HollowOptions(options.hollows)
        coarse = visual_hull(photos.cameras, photos.masks, o.nodes)
        fresh = lambda v: model_under_flash(v, photos, options, full=True)  # noqa: E731
        show = run.progress("hollows that no silhouette shows")
        opened = open_hollows(
            photos.bank, photos.cameras, coarse, fresh, o, run.say, fit.seed, show
        )
        values = without(values, opened)
    return model_under_flash(values, photos, options, full=False)


def model_under_flash(
    values: np.ndarray, photos: UnitPhotos, options: FlashOptions, full: bool
) -> VolumeModel:
    """A model of distances (n, n, n) under the flash. full: optimise every node, and the flash's
    offset from the first step on."""
    level, fixed = photos.level, "offset" in options.without
    shadows = options.shadows and "shadow" not in options.without
    model = start_model(values, START_ALBEDO * level / level.mean(), None, full=full)
    model.reflections, rates = start_learnt()
    free = sum(options.level_steps) - (1 - HELD) * options.level_steps[-1]
    model.rates = rates_by_step(rates, np.inf if fixed else 0 if full else free)
    appearance = FlashAppearance(
        Coat(options.ior), intensity_of(photos), options.levels[-1] if shadows else np.inf
    )
    model.appearance, appearance.model = appearance, model
    return model


def rates_by_step(rates, free: float) -> Callable:
    """Step -> `rates` (Float), those of the flash's offset 0 before the step `free`."""
    held = np.array(rates)
    held[:3] = 0
    held = mi.Float(held)
    return lambda i: rates if i >= free else held


def look_around(photos: UnitPhotos, model: VolumeModel, coat: Coat, shadow: bool = True) -> None:
    """Give the model's appearance the light that its surface, as it is now, throws on itself.
    shadow: whether the flash casts any."""
    values = dense_values(model.grid)
    flash = FlashLamp(np.array(model.reflections)[:3], float(model.appearance.intensity[0]), shadow)
    mesh = extract_mesh(values, faces=COARSE_FACES)
    ambient = find_ambient(photos.bank, photos.cameras, mesh, coat, flash, BRIGHTEST)
    model.appearance.around = ambient.around(values, coat)


@dataclass(frozen=True)
class FlashMesh:
    """mesh: in the unit frame, with an atlas. albedo: (V, 4) of its vertices, diffuse (linear RGB)
    and specular, up to scale. offset: (3,) of the flash from the camera: right, down, forward, in
    unit lengths. intensity: of the flash."""

    mesh: Mesh
    albedo: np.ndarray
    offset: np.ndarray
    intensity: float


def mesh_stage(photos: UnitPhotos, volume: VolumeResult, fit: FitContext) -> FlashMesh:
    """Mesh, its outlines where the masks have them, atlas, and what the volume pass has found of
    each vertex."""
    run, options = fit.run, fit.options

    def computed(stage) -> FlashMesh:
        mesh = extract_mesh(volume.values, faces=options.faces)
        rounds = 0 if "refinement" in options.without else options.outlines
        mesh = outlined_mesh(mesh, photos, photos.cameras, rounds, run)
        mesh = with_atlas(mesh, options.texture, run.say)
        albedo = np.maximum(features_at(volume.grid(), volume.features, mesh.vertices), 0)
        return FlashMesh(
            mesh, albedo.astype(np.float32), volume.reflections[:3], intensity_of(photos)
        )

    return run.cached("mesh", FlashMesh, computed, title="mesh and atlas")


@dataclass(frozen=True)
class PlasticMaps:
    """Textures (S, S[, 3]) of a rough plastic, linear: diffuse albedo, specular albedo, alpha
    (width of the lobe), normal (tangent space). offset: (3,) of the flash in unit lengths.
    intensity: (1,) of the flash."""

    diffuse: np.ndarray
    specular: np.ndarray
    alpha: np.ndarray
    normal: np.ndarray
    offset: np.ndarray
    intensity: np.ndarray


def surface_stage(photos: UnitPhotos, shaped: FlashMesh, fit: FitContext) -> PlasticMaps:
    """Material and flash (PIR Sec. 3.3 to 3.6)."""
    run, o = fit.run, surface_options(fit.options)

    def computed(stage) -> PlasticMaps:
        texels = texels_of(shaped.mesh, fit.options.texture)
        terms = flash_terms(photos, shaped, texels, fit)
        fit_flash_surface(terms, stage, fit.seed)
        model = terms.model
        maps = {name: texels.filled(t) for name, t in plastic_pictures(model.field).items()}
        offset = np.array(model.offset)
        right, down, forward = offset
        run.say(
            f"flash: offset ({right:.4f}, {down:.4f}, {forward:.4f}) of the object sphere's radius: right, down, forward of the camera"
        )
        return PlasticMaps(**maps, offset=offset, intensity=np.exp(np.array(model.log_intensity)))

    title = "material and flash (surface pass)"
    return run.cached("surface", PlasticMaps, computed, steps=o.steps, title=title)


def flash_terms(
    photos: UnitPhotos, shaped: FlashMesh, texels: TexelMap, fit: FitContext
) -> FlashTerms:
    """Plastic and flash that the surface pass begins with: diffuse albedos from the photos, one
    lobe all over, since that of the volume pass is coarse."""
    options, o = fit.options, surface_options(fit.options)
    bank, cameras, mesh, coat = photos.bank, photos.cameras, shaped.mesh, Coat(options.ior)
    traceable = TraceableMesh(mesh, np.zeros_like(mesh.vertices))
    flash = FlashLamp(shaped.offset, shaped.intensity, o.shadow)
    known = texels.known
    x, n = texels.on_faces(mesh.vertices)[known], texels.on_faces(mesh.normals)[known]
    ambient = None
    if o.directions > 0:
        ambient = find_ambient(bank, cameras, mesh, coat, flash, BRIGHTEST)
    scene = FlashPhotos(bank, cameras, traceable, coat, flash)
    found = capture_features(scene, x, n, ambient)
    diffuse = texels.spread(shaped.albedo[:, :3])
    diffuse[known] = np.where(found.seen[:, None], found.albedo, diffuse[known])
    scale = BRIGHTEST / max(float(np.percentile(diffuse[known].max(1), 99)), 1e-6)
    specular = np.clip(texels.spread(shaped.albedo[:, 3:])[..., 0] * scale, 0.05, MOST_SPECULAR)
    specular = np.full_like(specular, np.median(specular[known]))
    alpha = np.full_like(specular, START_WIDTH)
    features = np.zeros((*known.shape, 4), np.float32)
    features[known] = found.features
    if options.dino:
        network = DinoNetwork(network_file(options.dino))
        features[known] = network_features(scene, x, n, network)
    features = texels.filled(features)
    kinship = None
    if "features" not in options.without:
        place = PLACE * texels.spread(mesh.vertices)
        lobe = np.stack([specular, alpha], -1)
        kinship = start_kinship(np.concatenate([features, place], -1), known, lobe)
    model = FlashModel(
        start_plastic(np.clip(texels.filled(diffuse) * scale, 0, 1), specular, alpha),
        mi.Float(features.ravel()),
        kinship,
        mi.Float(shaped.offset),
        mi.Float([float(np.log(flash.intensity / scale))]),
        coat,
    )
    if ambient is not None:
        model.around = ambient.on_texels(x, n, known, coat)
    return FlashTerms(bank, cameras, traceable, model, o)


def assemble(capture: Capture, mesh: Mesh, maps: PlasticMaps, ior: float) -> Asset:
    """The asset in the frame of the user's cameras (`placed_mesh`)."""
    (placed, world_from_asset), radius = placed_mesh(capture, mesh), capture.sphere.radius
    roughness = np.sqrt(maps.alpha)
    base = base_colour(maps.diffuse, roughness, maps.specular, ior)
    metallic = np.zeros((1, 1), np.float32)
    material = Material(base, roughness, metallic, ior, maps.specular, maps.normal, maps.diffuse)
    flash = Flash(
        maps.offset.astype(np.float64) * radius,
        np.full(3, float(maps.intensity[0]) * radius**2),
    )
    cameras = tuple((p.name, p.camera) for p in capture.photos)
    meta = {"material": "rough_plastic"}
    return Asset(placed, material, world_from_asset, None, cameras, meta, flash)


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

"""Photos of one object from anywhere -> a relightable asset. The recipe of the `collection` capture (SAMURAI, Boss et al. 2022).

    photos     decode, masks (given, or guessed by GrabCut from the middle), focal length from EXIF or a guess
    poses      coarse models and registration by rendering, in turns, from quadrants or from one silhouette   fit/collection_poses.py
    volume     signed distance field, one small light per photo, cameras and focal lengths free               fit/volume.py
    mesh       zero level set, decimated; texture atlas
    surface    metallic-roughness textures, one environment per photo                                         fit/collection_surface.py
    held_out   camera and light of photos that were set aside, with the model frozen

Frame of the result: the object's own, in which quadrants are said: +x right, +y up, +z to the front; the object sphere has radius 1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from relit.capture.samurai import read_hints
from relit.conventions import similarity
from relit.errors import UserError, did_you_mean
from relit.fit.collection_poses import GREY, PARTS, even_colours, find_poses, schedule_of
from relit.fit.collection_surface import LightOptions, fit_collection_surface, posterior, start_collection_surface
from relit.fit.multiview import resize, run_arrays, vertex_areas
from relit.fit.pixels import PixelBank, corrected, make_bank, place_cameras
from relit.fit.register import (
    Crop,
    crop_photo,
    crop_rings,
    directions_around,
    hint_prior,
    make_gallery,
    refine,
    search,
    views_from,
    volume_render,
)
from relit.fit.surface import ALBEDO_START, SurfaceOptions
from relit.fit.volume import VolumeModel, VolumeOptions, fit_volume, restore_model, start_model
from relit.geometry.atlas import unwrap
from relit.geometry.bake import fill_gutters, interpolate, rasterise_atlas
from relit.geometry.hull import visual_hull
from relit.geometry.mesh import extract_mesh
from relit.geometry.sdf import dense_values, row_features
from relit.lighting.per_photo import COLUMNS, ROWS
from relit.masks.grabcut import centre_cut
from relit.materials.field import normal_map, pictures, start_material
from relit.rendering.shade import features_at
from relit.rendering.shade_photos import shade_photos, shade_plain, start_photo_lights
from relit.rendering.transport import TraceableMesh
from relit.scene import Asset, Camera, Capture, Material, Mesh, Photo

LIGHT = "one light per photo (collection)"
STAGES = ("poses", "volume", "mesh", "surface", "held_out")
FINDS_CAMERAS = True
LEAST_PHOTOS = 4
COST = {"draft": (150.0, 1.2e9), "standard": (700.0, 2.0e9), "high": (2500.0, 3.0e9)}
FIELD = 50.0  # degrees along the longer side, where EXIF tells nothing
WITHOUT = ("quadrants", "search", "multiplex", "posterior", "coarse_to_fine", "light_prior")


@dataclass(frozen=True)
class CollectionOptions:
    """side: pixels of the photos' longer side. rounds: of coarse fit and registration. polish: turns of descent and search after
    them. keep: hypotheses of each photo that are refined
    (SAMURAI's multiplex). hints: whether quadrants or angles are used. holdout: every so many photos are set aside (0: none but those of
    held_out.json). starts: photos that growth begins from without hints. least_score: of the registration, on average, below which
    the poses are taken for wrong. levels, level_steps, rays: of the volume pass. refine_cameras:
    step of the camera corrections in it. faces, texture, surface_steps, points, directions: of mesh and surface pass. frozen_steps: of the
    fit of held-out photos. without: what an ablation switches off.
    """

    side: int = 400
    rounds: int = 6
    polish: int = 0
    keep: int = 3
    hints: bool = True
    holdout: int = 0
    starts: int = 4
    least_score: float = 0.84
    levels: tuple[int, ...] = (64, 128)
    level_steps: tuple[int, ...] = (400, 500)
    rays: int = 6144
    refine_cameras: float = 0.003
    faces: int = 30_000
    texture: int = 512
    surface_steps: int = 700
    points: int = 4096
    directions: int = 32
    frozen_steps: int = 150
    without: tuple[str, ...] = ()

    @property
    def max_pixels(self) -> int:
        """Of all photos together, for the forecast of memory: each is shrunk as it is read."""
        return 150 * self.side**2

    def __post_init__(self):
        for name in self.without:
            if name not in WITHOUT:
                raise ValueError(f"without={name} is not known.{did_you_mean(name, WITHOUT)} Known: {', '.join(WITHOUT)}")


PRESETS = {
    "draft": {
        "side": 200,
        "keep": 2,
        "starts": 2,
        "levels": (48, 80),
        "level_steps": (200, 250),
        "rays": 4096,
        "faces": 10_000,
        "texture": 256,
        "surface_steps": 250,
        "points": 2048,
        "frozen_steps": 80,
    },
    "standard": {},
    "high": {
        "side": 800,
        "levels": (64, 128, 192),
        "level_steps": (500, 600, 600),
        "rays": 8192,
        "faces": 60_000,
        "texture": 1024,
        "surface_steps": 2000,
        "directions": 64,
    },
}


def options_for(quality: str) -> CollectionOptions:
    """The recipe's options for 'draft', 'standard' or 'high'. Raises UserError (code 2) for others."""
    if quality not in PRESETS:
        raise UserError(f"quality '{quality}' is not known.{did_you_mean(quality, PRESETS)}", fix=f"one of: {', '.join(PRESETS)}", code=2)
    return CollectionOptions(**PRESETS[quality])


@dataclass(frozen=True)
class Shot:
    """One photo, decoded. rgb: (H, W, 3) linear, mask: (H, W). camera: intrinsics by EXIF or guess, pose the identity.
    direction: (3,) hint, or 0."""

    photo: Photo
    rgb: np.ndarray
    mask: np.ndarray
    camera: Camera
    direction: np.ndarray

    @property
    def tint(self) -> np.ndarray:
        """(3,) mean colour of the object."""
        inside = self.mask > 0.9
        inside = inside if inside.any() else self.mask >= self.mask.max()
        return np.maximum(self.rgb[inside].mean(0), 1e-3)


def reconstruct(capture: Capture, run, options: CollectionOptions, seed: int = 0) -> Asset:
    """Run all stages of the recipe in the run folder; stages that are done are read back."""
    shots, held, degrees = load_shots(capture, options, run)
    tints = np.array([s.tint for s in shots])
    cameras, weights = pose_stage(shots, degrees, run, options, seed)
    bank, cameras, model = volume_stage(shots, cameras, weights, tints, run, options, seed)
    parts = mesh_stage(model, run, options)
    mesh = Mesh(parts["vertices"], parts["faces"], parts["normals"], parts["uvs"])
    maps = surface_stage(bank, mesh, parts["albedo"], tints, run, options, seed)
    found = held_out_stage(held, model, mesh, parts["albedo"], maps, cameras, degrees, run, options, seed)
    return assemble(shots + held, cameras + found[0], np.concatenate([maps["lights"], found[1]]), mesh, maps, [s.photo.name for s in held])


# ---------------------------------------------------------------- photos


def load_shots(capture: Capture, options: CollectionOptions, run) -> tuple[list[Shot], list[Shot], float]:
    """Training shots, held-out shots, and how many degrees the hints may be off."""
    photos, held = list(capture.photos), list(capture.held_out)
    if options.holdout > 1 and not held:
        held = photos[options.holdout // 2 :: options.holdout]
        photos = [p for p in photos if p not in held]
    if len(photos) < LEAST_PHOTOS:
        what = f"{len(photos)} photos are not enough: a collection needs at least {LEAST_PHOTOS}"
        raise UserError(what, "shape is found by comparing photos from different sides", "add photos; 30 to 80 all around are good")
    use = options.hints and "quadrants" not in options.without
    hints = read_hints(capture.root, [p.name for p in (*photos, *held)]) if use else None
    if hints is not None:
        run.say(f"{len(hints.directions)} of {len(photos) + len(held)} photos have a hint where they were taken from ({hints.source})")
    guessed, shots = 0, []
    for photo in (*photos, *held):
        pixels = photo.load()
        mask, rgb = pixels.mask, pixels.rgb
        shrink = min(1.0, options.side / max(photo.width, photo.height))
        w, h = max(16, round(photo.width * shrink)), max(16, round(photo.height * shrink))
        rgb = resize(rgb, w, h)
        if mask is None:
            mask, guessed = centre_cut(rgb), guessed + 1
        else:
            mask = np.clip(resize(mask, w, h), 0, 1)
        direction = np.zeros(3) if hints is None else hints.directions.get(photo.name, np.zeros(3))
        shots.append(Shot(photo, rgb, mask, guessed_camera(photo, w, h), direction))
    if guessed:
        run.say(f"note: {guessed} photos have no mask; they were guessed by GrabCut from the pictures' middle: look at them")
    empty = [s.photo.name for s in shots if (s.mask > 0.5).sum() < 30]
    if empty:
        run.say(f"note: {len(empty)} photos have an empty mask and are not used, for example {empty[0]}")
    kept = [s for s in shots if s.photo.name not in empty]
    training = [s for s in kept if s.photo in photos]
    if len(training) < LEAST_PHOTOS:
        raise UserError(f"only {len(training)} photos have a mask with anything in it", fix="give masks that are white on the object")
    return training, [s for s in kept if s.photo in held], 45.0 if hints is None else hints.degrees


def guessed_camera(photo: Photo, width: int, height: int) -> Camera:
    """Intrinsics at width x height: known ones, EXIF's focal length, or FIELD degrees."""
    if photo.camera is not None:
        return photo.camera.resized(width, height).with_pose(np.eye(4))
    focal = 0.5 * max(width, height) / np.tan(np.radians(FIELD) / 2)
    if photo.focal_hint is not None:
        focal = photo.focal_hint * width / photo.width
    return Camera(width, height, focal, focal, width / 2, height / 2, np.eye(4))


def crops_of(shots: list[Shot]) -> list[Crop]:
    """What registration compares."""
    return even_colours([crop_photo(s.rgb, s.mask, s.camera) for s in shots])


# ---------------------------------------------------------------- stages


def pose_stage(shots: list[Shot], degrees: float, run, options: CollectionOptions, seed: int):
    """The cameras, and the photos' weights (P,)."""
    if run.done("poses"):
        kept = run_arrays(run, "poses", "poses")
    else:
        with run.stage("poses", title="where the photos were taken from") as stage:
            crops, hints = crops_of(shots), np.array([s.direction for s in shots])
            try:
                poses, scores = find_poses(
                    crops,
                    hints,
                    degrees,
                    schedule_of(options.rounds),
                    options.keep,
                    options.starts,
                    options.without,
                    seed,
                    run.say,
                    options.polish,
                )
            except ValueError as error:
                why = f"{error}: the masks belong to different objects, or are wrong"
                raise UserError("no shape agrees with the photos", why, "look at the masks (relit inspect)", code=4) from None
            kept = {"poses": poses, "scores": scores}
            stage.save("poses", **kept)
        judge_poses(kept["scores"], shots, options.least_score, run)
    poses, scores = kept["poses"], kept["scores"]
    loss = 1 - scores
    weights = np.ones(len(shots)) if "posterior" in options.without else posterior(loss, [*loss, *loss][:1000] * (20 // len(loss) + 1))
    return [s.camera.with_pose(p) for s, p in zip(shots, poses, strict=True)], weights


def judge_poses(scores: np.ndarray, shots: list[Shot], least: float, run) -> None:
    """Say how well the photos agree, and which do not. Raises UserError (code 4) when the poses are wrong as a whole."""
    mean = float(np.mean(scores))
    run.say(f"mean score of the registration {mean:.3f} (1 is perfect; below {least} is a failure)")
    worst = np.argsort(scores)
    low = [k for k in worst if scores[k] < np.median(scores) - 4 * max(float(np.median(np.abs(scores - np.median(scores)))), 0.004)]
    if low:
        named = ", ".join(f"{shots[k].photo.name} ({scores[k]:.2f})" for k in low[:5])
        run.say(f"note: {len(low)} photos agree badly with the others (another object, a wrong mask or a wrong pose): {named}")
    if mean < least:
        raise UserError(
            f"where the photos were taken from could not be found: they agree with no common shape (score {mean:.3f}, {least} is needed)",
            "too few photos, wrong masks, photos of different objects, quadrants of other photos, or an object alike from all sides",
            "look at the masks; answer `relit quadrants PHOTOS`; add photos between those that are far apart",
            code=4,
        )


def volume_stage(shots, cameras, weights, tints, run, options: CollectionOptions, seed: int):
    """(pixel bank with the final cameras, cameras, model)."""
    masks = [s.mask for s in shots]
    bank = weighted_bank(make_bank(cameras, [s.rgb for s in shots], masks), weights, seed)
    import drjit as dr
    import mitsuba as mi

    bank.corrections = dr.zeros(mi.Float, 7 * bank.views)
    levels, steps = (options.levels, options.level_steps)
    if "coarse_to_fine" in options.without:
        levels, steps = levels[-1:], (sum(steps),)
    values = hull_of(cameras, masks, levels[0])
    model = start_model(values, np.full(3, GREY), None, full=False)
    model.reflections, model.rates = start_photo_lights(tints, GREY)
    model.appearance = shade_photos
    o = VolumeOptions(levels, steps, options.rays, sharpness=(1.5, 6.0), refine_cameras=options.refine_cameras)
    if run.done("volume"):
        restore_model(model, bank, run_arrays(run, "volume", "checkpoint"))
    else:
        with run.stage("volume", steps=sum(steps), title="shape and cameras (volume pass)") as stage:
            fit_volume(bank, model, o, stage, seed)
    cameras = corrected(cameras, np.array(bank.corrections))
    place_cameras(bank, cameras)
    return bank, cameras, model


def hull_of(cameras: list[Camera], masks: list[np.ndarray], nodes: int) -> np.ndarray:
    """The visual hull by a vote that forgives poses that are a few degrees off."""
    for tolerance in (0.1, 0.2, 0.35, 0.5):
        try:
            values = visual_hull(cameras, masks, nodes, tolerance=tolerance)
        except ValueError:
            continue
        if (values < 0).sum() > 100:
            return values
    raise UserError("the silhouettes have nothing in common", "poses or masks are wrong", "look at the masks (relit inspect)", code=4)


def weighted_bank(bank: PixelBank, weights: np.ndarray, seed: int) -> PixelBank:
    """The bank, its batches drawn from photos in proportion to `weights`: posterior scaling as the chance to be looked at."""
    import mitsuba as mi

    candidates = np.array(bank.candidates)
    view = np.searchsorted(np.array(bank.offsets), candidates, side="right") - 1
    keep = np.random.default_rng(seed).random(len(candidates)) < np.asarray(weights)[view]
    bank.candidates = mi.UInt32(candidates[keep] if keep.any() else candidates)
    return bank


def mesh_stage(model: VolumeModel, run, options: CollectionOptions) -> dict[str, np.ndarray]:
    """Mesh, atlas, and each vertex's colour without light: vertices, faces, normals, uvs, albedo."""
    if run.done("mesh"):
        return run_arrays(run, "mesh", "mesh")
    with run.stage("mesh", title="mesh and atlas") as stage:
        mesh, how = unwrap(extract_mesh(dense_values(model.grid), faces=options.faces), options.texture)
        if how != "xatlas":
            run.say("note: the mesh was too difficult for charts; its atlas has one cell for every two faces")
        f = features_at(model.grid, row_features(model.grid), mesh.vertices)
        albedo = np.maximum(f[:, :3] + GREY * np.maximum(f[:, 3:4], 0), 1e-3).astype(np.float32)
        parts = {"vertices": mesh.vertices, "faces": mesh.faces, "normals": mesh.normals, "uvs": mesh.uvs, "albedo": albedo}
        stage.save("mesh", **parts)
    return parts


def light_options(options: CollectionOptions) -> LightOptions:
    off = {"prior": 0.0, "neutral": 0.0} if "light_prior" in options.without else {}
    return LightOptions(posterior="posterior" not in options.without, **off)


def surface_stage(bank: PixelBank, mesh: Mesh, albedo, tints, run, options: CollectionOptions, seed: int) -> dict[str, np.ndarray]:
    """Material and lights. Returns (and keeps) base_color, roughness, metallic, normal, lights (V, ROWS, COLUMNS, 3) in the unit frame."""
    if run.done("surface"):
        return run_arrays(run, "surface", "maps")
    o = SurfaceOptions(options.surface_steps, options.points, options.directions, options.texture)
    with run.stage("surface", steps=o.steps, title="material and lights (surface pass)") as stage:
        face, bary = rasterise_atlas(mesh, o.texture)
        known = face >= 0
        areas = vertex_areas(mesh)
        scale = ALBEDO_START / float((albedo * areas[:, None]).sum() / areas.sum() / 3)
        start = np.clip(fill_gutters(interpolate(albedo, mesh.faces, face, bary), known) * scale, 0.02, 0.95)
        material = start_material(o.texture, start, o.roughness_start, 0.05)
        model = start_collection_surface(material, tints, ALBEDO_START)
        fit_collection_surface(bank, TraceableMesh(mesh, albedo * scale), model, o, light_options(options), stage, seed)
        base, roughness, metallic = pictures(model.material)
        silent = int((model.weights < 0.3).sum())
        if silent:
            run.say(f"note: {silent} photos were all but silenced: the model does not explain them")
        maps = {
            "base_color": fill_gutters(base, known),
            "roughness": fill_gutters(roughness, known),
            "metallic": fill_gutters(metallic, known),
            "normal": normal_map(model.material),
            "lights": np.exp(model.lights()).reshape(-1, ROWS, COLUMNS, 3),
            "weights": model.weights,
        }
        stage.save("maps", **maps)
    return maps


def held_out_stage(held: list[Shot], model: VolumeModel, mesh, albedo, maps, cameras, degrees, run, options: CollectionOptions, seed: int):
    """(cameras, lights (H, ROWS, COLUMNS, 3)) of the held-out photos: registered by rendering, descended, lit; model and material stay."""
    if not held:
        return [], np.zeros((0, ROWS, COLUMNS, 3), np.float32)
    if run.done("held_out"):
        kept = run_arrays(run, "held_out", "photos")
    else:
        with run.stage("held_out", steps=options.frozen_steps, title="photos that were set aside") as stage:
            import mitsuba as mi

            shots = [replace(s, camera=with_median_field(s, cameras)) for s in held]
            found = register(shots, model, degrees, options, seed)
            found = descend(shots, found, model, options, seed)
            bank = make_bank(found, [s.rgb for s in shots], [s.mask for s in shots])
            size = maps["roughness"].shape[0]
            material = start_material(size, maps["base_color"], 0.5, 0.0)
            material.colour = mi.Float(np.concatenate([maps["base_color"], maps["roughness"][..., None]], -1).astype(np.float32).ravel())
            material.metallic = mi.Float(maps["metallic"].astype(np.float32).ravel())
            n = maps["normal"]
            material.slope = mi.Float((n[..., :2] / np.maximum(n[..., 2:], 0.1)).astype(np.float32).ravel())
            lit = start_collection_surface(material, np.array([s.tint for s in shots]), ALBEDO_START)
            areas = vertex_areas(mesh)
            scale = ALBEDO_START / float((albedo * areas[:, None]).sum() / areas.sum() / 3)
            o = SurfaceOptions(options.frozen_steps, options.points, options.directions, size)
            fit_collection_surface(bank, TraceableMesh(mesh, albedo * scale), lit, o, light_options(options), stage, seed, frozen=True)
            kept = {
                "poses": np.array([c.world_from_camera for c in found]),
                "focal": np.array([c.fx for c in found]),
                "lights": np.exp(lit.lights()).reshape(-1, ROWS, COLUMNS, 3),
            }
            stage.save("photos", **kept)
    found = [replace(s.camera, fx=f, fy=f, world_from_camera=p) for s, f, p in zip(held, kept["focal"], kept["poses"], strict=True)]
    return found, kept["lights"]


def with_median_field(shot: Shot, cameras: list[Camera]) -> Camera:
    """A held-out photo without EXIF starts with the median focal length of the others, in units of the longer side."""
    if shot.photo.focal_hint is not None or shot.photo.camera is not None:
        return shot.camera
    focal = float(np.median([c.fx / max(c.width, c.height) for c in cameras])) * max(shot.camera.width, shot.camera.height)
    return replace(shot.camera, fx=focal, fy=focal)


def register(shots: list[Shot], model: VolumeModel, degrees: float, options: CollectionOptions, seed: int) -> list[Camera]:
    """The cameras of photos that the model has not seen, by search and local refinement."""
    crops, hints = crops_of(shots), np.array([s.direction for s in shots])
    render, rings = volume_render(replace(model, appearance=shade_plain)), crop_rings(crops, PARTS)
    gallery = make_gallery(render, views_from(directions_around(600, seed)), PARTS)
    prior = 0.03 * hint_prior(gallery, hints, degrees, 60.0) * (np.linalg.norm(hints, axis=1) > 0.5)[:, None, None]
    found = search(crops, gallery, options.keep, rings=rings, prior=prior)
    best, score = found.poses[:, 0].copy(), np.full(len(shots), -1.0)
    for k in range(options.keep):
        poses, scores = refine(crops, found.poses[:, k], render, rings=rings, parts=PARTS)
        better = (scores > score) & (found.scores[:, k] > -1)
        best[better], score[better] = poses[better], scores[better]
    return [s.camera.with_pose(p) for s, p in zip(shots, best, strict=True)]


def descend(shots: list[Shot], cameras: list[Camera], model: VolumeModel, options: CollectionOptions, seed: int) -> list[Camera]:
    """The cameras after a descent with the shape frozen: pose, distance, focal length and small lights move."""
    import drjit as dr
    import mitsuba as mi

    from relit.fit.collection_poses import Quiet

    bank = make_bank(cameras, [s.rgb for s in shots], [s.mask for s in shots])
    bank.corrections = dr.zeros(mi.Float, 7 * bank.views)
    learnt, rates = start_photo_lights(np.array([s.tint for s in shots]), GREY)
    own = replace(model, reflections=learnt, rates=rates, appearance=shade_photos)
    own.grid = replace(model.grid)
    o = VolumeOptions(
        (model.grid.n,),
        (max(60, options.frozen_steps),),
        options.rays // 2,
        sdf_rate=0.0,
        feature_rate=0.0,
        diffusion=0.0,
        eikonal=0.0,
        sharpness=(2.0, 6.0),
        refine_cameras=options.refine_cameras,
    )
    fit_volume(bank, own, o, Quiet(), seed)
    return corrected(cameras, np.array(bank.corrections))


# ---------------------------------------------------------------- the asset


def assemble(shots: list[Shot], cameras: list[Camera], lights: np.ndarray, mesh: Mesh, maps, held: list[str]) -> Asset:
    """The asset in the object's own frame. Cameras come at the photos' own size."""
    own = [c.resized(s.photo.width, s.photo.height) for c, s in zip(cameras, shots, strict=True)]
    environment = np.median(lights / lights.mean((1, 2, 3), keepdims=True), 0) * np.median(lights.mean((1, 2, 3)))
    material = Material(maps["base_color"], maps["roughness"], maps["metallic"], normal=maps["normal"])
    pairs = tuple((s.photo.name, c) for s, c in zip(shots, own, strict=True))
    meta = {"held_out": held}
    return Asset(mesh, material, similarity(np.eye(3), np.zeros(3)), environment.astype(np.float32), pairs, meta, lights=tuple(lights))

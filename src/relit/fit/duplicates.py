"""One photo of several identical objects under an unknown light -> the object, its poses, its material, the light. The recipe of
`duplicates`.

    poses     a virtual camera for each instance; matching, and search by rendering     cameras/duplicates.py, fit/instance_search.py
    volume     one signed distance field in the object's frame, seen by all virtual cameras; poses move with it      fit/volume.py
    mesh       zero level set, decimated; texture atlas; the ground that the instances stand on
    surface    one material for all instances and one environment, light traced past all instances and the ground     fit/surface.py
    asset      object, instances, ground and light in the frame of the user's camera

SfD Sec. 3: ξ_obj_i = ξ_ref ∘ (ξ_cam_i)^-1. With one photo ξ_ref is the photo's camera, so instance i stands at world_from_camera
(object_from_camera_i)^-1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from relit.cameras.se3 import nearest_rotation, rotation_from
from relit.conventions import move_points, similarity
from relit.errors import EXIT_FAILED, UserError, did_you_mean
from relit.fit.instance_search import Search, place
from relit.fit.instances import COARSE, View, carved, move_poses, moved_poses, pixel_bank, views_of
from relit.fit.multiview import run_arrays, vertex_areas
from relit.fit.pile_scene import find_ground, ground_colour, ground_reflectance, light_below, photo_bank, scene_mesh, set_down
from relit.fit.surface import SurfaceOptions, fit_surface, start_surface
from relit.fit.volume import VolumeOptions, fit_volume, start_model
from relit.geometry.atlas import unwrap
from relit.geometry.bake import fill_gutters, interpolate, rasterise_atlas
from relit.geometry.mesh import extract_mesh
from relit.geometry.sdf import dense_values, row_features
from relit.materials.field import normal_map, pictures
from relit.rendering.shade_world import instance_radiance, shade_world, start_world_light
from relit.rendering.transport import TraceableMesh
from relit.scene import Asset, Camera, Capture, Ground, Instance, Material, Mesh

LIGHT = "one photo of several identical objects under one light is assumed (duplicates)"  # what `relit inspect` says
STAGES = ("poses", "volume", "mesh", "surface")
FINDS_CAMERAS = True
LEAST_PHOTOS = 1
COST = {"draft": (60.0, 1.0e9), "standard": (300.0, 2.0e9), "high": (1200.0, 3.0e9)}
HOLD = 40  # steps of the volume pass before poses move
AGREES = 0.2  # an instance whose score lies further below the median did not find its place


@dataclass(frozen=True)
class DuplicatesOptions:
    """side: pixels of an instance's window in the volume pass. search_rounds: of fit and search for all poses. levels, level_steps, rays:
    of the volume pass. refine_poses: step of the pose corrections in it (radians, unit lengths). faces, texture: of the object.
    surface_steps, points, directions, light: of the surface pass. max_pixels: of the photo. without: parts that are switched off, names
    of WITHOUT.
    """

    side: int = 320
    search_rounds: int = 1
    levels: tuple[int, ...] = (64, 128)
    level_steps: tuple[int, ...] = (400, 500)
    rays: int = 6144
    refine_poses: float = 0.004
    faces: int = 16_000
    texture: int = 512
    surface_steps: int = 900
    points: int = 4096
    directions: int = 48
    light: int = 64
    max_pixels: int = 4_000_000
    without: tuple[str, ...] = ()

    def __post_init__(self):
        for name in self.without:
            if name not in WITHOUT:
                raise ValueError(f"without={name} is not known.{did_you_mean(name, WITHOUT)} Known: {', '.join(WITHOUT)}")


WITHOUT = {
    "rotation_sweep": "pictures are matched as they are, not turned against each other",
    "matching": "no features are matched",
    "search": "what matching does not link is dropped",
    "refinement": "poses stay as search has found them",
    "visibility": "no instance, and no ground, shadows another",
    "normals": "normal priors are not used",
    "metal": "no term pulls metallic to 0 or 1",
    "ground": "no ground is looked for",
}

PRESETS = {
    "draft": {
        "side": 200,
        "levels": (48, 96),
        "level_steps": (150, 200),
        "rays": 4096,
        "faces": 8_000,
        "texture": 256,
        "surface_steps": 300,
        "points": 2048,
        "directions": 32,
        "light": 32,
        "max_pixels": 1_000_000,
    },
    "standard": {},
    "high": {"side": 480, "levels": (96, 192), "level_steps": (500, 700), "texture": 1024, "surface_steps": 2500, "directions": 64},
}


def options_for(quality: str) -> DuplicatesOptions:
    """The recipe's options for 'draft', 'standard' or 'high'. Raises UserError (code 2) for others."""
    if quality not in PRESETS:
        raise UserError(f"quality '{quality}' is not known.{did_you_mean(quality, PRESETS)}", fix=f"one of: {', '.join(PRESETS)}", code=2)
    return DuplicatesOptions(**PRESETS[quality])


def reconstruct(capture: Capture, run, options: DuplicatesOptions, seed: int = 0) -> Asset:
    """Run all stages of the recipe in the run folder; stages that are done are read back."""
    photo = one_photo(capture)
    pixels, camera = photo.load(), photo.camera
    view_camera = camera.with_pose(np.eye(4))  # the photo's frame: OpenCV axes, unit lengths of the object
    poses, registered, labels = poses_stage(pixels, view_camera, run, options, seed)
    chosen = [k for k in range(len(labels)) if registered[k]]
    normal = None if "normals" in options.without else pixels.normal
    views = [v for v in views_of(pixels.rgb, pixels.labels, view_camera, options.side, normal) if v.label in {labels[k] for k in chosen}]
    poses = poses[chosen]
    if run.done("mesh"):
        parts = run_arrays(run, "mesh", "mesh")
    else:
        parts = shape_stages(views, poses, run, options, seed)
    mesh = Mesh(parts["vertices"], parts["faces"], parts["normals"], parts["uvs"])
    maps = (
        run_arrays(run, "surface", "maps") if run.done("surface") else surface_stage(pixels, camera, views, mesh, parts, run, options, seed)
    )
    return assemble(photo, mesh, maps, parts, [int(x) for x in labels], chosen)


def one_photo(capture: Capture):
    """The capture's photo. Raises UserError where there are several or it has no labels."""
    if len(capture.photos) != 1:
        raise UserError(
            f"{len(capture.photos)} photos: a duplicates capture is one photo",
            "several photos of one pile are not reconstructed together in this version",
            "give the best one with its labels; photos around ONE object are --capture multiview",
        )
    photo = capture.photos[0]
    if capture.kind != "duplicates":
        raise UserError(
            "the photo has no labels",
            "which pixel belongs to which object is not known",
            f"put {photo.name.rsplit('.', 1)[0]}_labels.png beside it: one grey level or colour for each object, black elsewhere",
        )
    return photo


# ---------------------------------------------------------------- poses


def poses_stage(pixels, camera: Camera, run, options: DuplicatesOptions, seed: int):
    """(poses (N, 4, 4) object_from_camera, registered (N,) bool, labels (N,)) of all instances, in the unit frame of the object."""
    if run.done("poses"):
        saved = run_arrays(run, "poses", "poses")
        return saved["poses"], saved["registered"], saved["labels"]
    views = views_of(pixels.rgb, pixels.labels, camera, COARSE, None if "normals" in options.without else pixels.normal)
    with run.stage("poses", title="poses of the instances") as stage:
        links = () if "matching" in options.without else matched(pixels, camera, run, options, seed)
        search = Search(rounds=options.search_rounds, **({"descents": 0} if "refinement" in options.without else {}))
        try:
            poses, scores = place(views, search, seed=seed, links=links, say=run.say)
        except ValueError:
            raise UserError(
                "no poses of the instances fit together",
                "the objects are not identical, the labels are wrong, or too few are seen from near-by sides",
                "check the label image; more instances, or a photo in which they are larger, help",
                code=EXIT_FAILED,
            ) from None
        registered = scores >= np.median(scores) - AGREES
        linked = {i for link in links for i in link[:2]}
        if "search" in options.without and len(views) > 1:
            registered &= np.array([k in linked for k in range(len(views))])
        if registered.sum() < min(2, len(views)):
            raise UserError("hardly any instance could be placed", "see the scores in the log", "check the label image", code=EXIT_FAILED)
        labels = np.array([v.label for v in views])
        for k in np.flatnonzero(~registered):
            run.say(f"note: the object with label {labels[k]} is left out: it agrees with the others' model by {scores[k]:.2f} only")
        if len(views) > 1 and scores[registered].std() < 0.004 and scores.min() > 0.97:
            run.say("note: all poses fit equally well: a symmetric or textureless object leaves them ambiguous")
        poses = centred(views, poses, registered)
        stage.save("poses", poses=poses, registered=registered, labels=labels, scores=scores)
    return poses, registered, labels


def matched(pixels, camera: Camera, run, options: DuplicatesOptions, seed: int) -> tuple:
    """Links of pairs by rotation-swept feature matching: (i, j, rotation of i onto j in the photo)."""
    from relit.cameras.duplicates import find_features, link_instances, map_instances
    from relit.cameras.sfm import _quiet
    from relit.device import load_pycolmap

    full = views_of(pixels.rgb, pixels.labels, camera, 10**6)
    features = [find_features(v.rgb, v.mask, (camera.cx - v.camera.cx, camera.cy - v.camera.cy)) for v in full]
    size = float(np.median([max(v.mask.shape) for v in full]))
    with _quiet(load_pycolmap()):
        links = link_instances(features, camera, max(0.5, size / 250), sweep="rotation_sweep" not in options.without)
        clusters = map_instances(features, links, camera, seed)
    names = [v.label for v in full]
    for i, j in links:
        run.log.note(f"{len(links[i, j].a)} matches link {names[i]} and {names[j]}, turned by {links[i, j].turn:.0f} degrees")
    out, together = [], set()
    for cluster in clusters:
        members = sorted(cluster)
        run.say(f"matching links the instances {', '.join(str(names[k]) for k in members)}")
        together |= {(i, j) for i in members for j in members if i < j}
        out += [(i, j, cluster[j][:3, :3] @ cluster[i][:3, :3].T) for i in members for j in members if i < j]
    out += [(i, j, link.rotation) for (i, j), link in links.items() if link.rotation is not None and (i, j) not in together]
    return tuple(out)


def centred(views: list[View], poses: np.ndarray, registered: np.ndarray) -> np.ndarray:
    """The poses in a frame whose unit sphere holds the object: its middle at the origin, its farthest point at 0.85."""
    chosen = [k for k in range(len(views)) if registered[k]]
    inside = carved([views[k] for k in chosen], poses[chosen], 64, 0.2)
    z, y, x = np.nonzero(inside < 0)
    p = np.stack([x, y, z], -1) * (2 / 63) - 1
    middle = (p.min(0) + p.max(0)) / 2
    s = 0.85 / np.linalg.norm(p - middle, axis=1).max()
    out = poses.copy()
    out[:, :3, 3] = s * (poses[:, :3, 3] - middle)
    return out


# ---------------------------------------------------------------- shape


def shape_stages(views: list[View], poses: np.ndarray, run, options: DuplicatesOptions, seed: int) -> dict[str, np.ndarray]:
    """Volume pass, mesh, ground. Returns (and keeps) vertices, faces, normals, uvs, base (V, 3), radiance (N, V, 3), poses (N, 4, 4),
    ground (point, normal) or empty, ground_colour."""
    bank = pixel_bank(views, poses)
    with run.stage("volume", steps=sum(options.level_steps), title="shape and poses (volume pass)") as stage:
        inside = np.concatenate([v.rgb[v.mask > 0.99] for v in views])
        try:
            values = carved(views, poses, options.levels[0], 0.15, Search.depth, crossed=True)
        except ValueError:
            raise UserError(
                "the silhouettes have nothing in common",
                "poses are wrong, or the objects differ",
                "check the label image",
                code=EXIT_FAILED,
            ) from None
        model = start_model(values, np.maximum(inside.mean(0), 1e-3), None, full=False)
        model.appearance = shade_world
        model.reflections, model.rates = start_world_light(float(inside.mean()), len(views))
        rate = 0.0 if "refinement" in options.without or len(views) < 2 else options.refine_poses
        if rate > 0:
            move_poses(bank, model)
        fit_volume(
            bank, model, VolumeOptions(options.levels, options.level_steps, options.rays, refine_cameras=rate, hold=HOLD), stage, seed
        )
    poses = moved_poses(bank, views, poses)
    with run.stage("mesh", title="mesh, atlas, ground") as stage:
        mesh, how = unwrap(extract_mesh(dense_values(model.grid), faces=options.faces), options.texture)
        if how != "xatlas":
            run.say("note: the mesh was too difficult for charts; its atlas has one cell for every two faces")
        rows = row_features(model.grid)
        seen = [
            instance_radiance(model.grid, rows, model.reflections, mesh.vertices, mesh.normals, np.linalg.inv(p), k)
            for k, p in enumerate(poses)
        ]
        plane = np.zeros((0, 3)) if "ground" in options.without else find_ground(mesh.vertices, poses)
        if len(plane) and rate > 0:
            poses, plane, count = set_down(mesh.vertices, poses, plane)
            run.say(f"{count} instances stand on the ground and were moved along their lines of sight onto it")
        if len(plane) == 0:
            run.say("note: no ground was found that the instances stand on; nothing but they themselves casts shadows")
        parts = {
            "vertices": mesh.vertices,
            "faces": mesh.faces,
            "normals": mesh.normals,
            "uvs": mesh.uvs,
            "base": seen[0][1],
            "radiance": np.stack([r for r, _ in seen]),
            "poses": poses,
            "plane": plane,
        }
        stage.save("mesh", **parts)
    return parts


# ---------------------------------------------------------------- material and light


def surface_options(o: DuplicatesOptions) -> SurfaceOptions:
    off = {"metallic_binary": 0.0, "metallic_sparse": 0.0} if "metal" in o.without else {}
    return SurfaceOptions(o.surface_steps, o.points, o.directions, o.texture, o.light, scale_power=1.0, **off)


def surface_stage(pixels, camera: Camera, views, mesh: Mesh, parts, run, options: DuplicatesOptions, seed: int) -> dict[str, np.ndarray]:
    """Material and light, in the scene frame: the world's axes, unit lengths of the object, the origin in the middle of the pile. Returns
    (and keeps) base_color, roughness, metallic, normal, environment, ground_colour."""
    o = surface_options(options)
    with run.stage("surface", steps=o.steps, title="material and light (surface pass)") as stage:
        turn = camera.world_from_camera[:3, :3]
        standing = [np.linalg.inv(p) for p in parts["poses"]]
        middle = np.mean([s[:3, 3] for s in standing], 0)
        scene_from_photo = similarity(turn, -turn @ middle)
        ground_level = ground_colour(pixels, camera, parts["plane"])
        whole, radiance = scene_mesh(mesh, parts, standing, scene_from_photo, pixels, camera, alone="visibility" in options.without)
        bank = photo_bank(pixels, camera.with_pose(scene_from_photo), {v.label for v in views}, options.max_pixels)
        face, bary = rasterise_atlas(mesh, o.texture)
        known = face >= 0
        start = fill_gutters(interpolate(parts["base"], mesh.faces, face, bary), known)
        areas = vertex_areas(mesh)
        level = float((parts["radiance"].mean(0) * areas[:, None]).sum() / areas.sum() / 3)
        model = start_surface(start, known, level, o)
        fit_surface(bank, TraceableMesh(whole, radiance), model, o, stage, seed)
        base, roughness, metallic = pictures(model.material)
        environment = model.environment.image()
        ground = ground_level
        if len(parts["plane"]):
            up = turn @ parts["plane"][1]
            ground = ground_reflectance(environment, up, ground_level)
            environment = light_below(environment, up, ground_level)
        maps = {
            "base_color": fill_gutters(base, known),
            "roughness": fill_gutters(roughness, known),
            "metallic": fill_gutters(metallic, known),
            "normal": normal_map(model.material),
            "environment": environment,
            "ground_colour": ground,
        }
        stage.save("maps", **maps)
    return maps


# ---------------------------------------------------------------- asset


def assemble(photo, mesh: Mesh, maps, parts, labels: list[int], chosen: list[int]) -> Asset:
    """The asset: the object +Y up where a ground was found (as the first instance stands), its instances in the user's world, whose unit is
    the unit of the fit (one photo does not know the scale)."""
    world_from_photo = photo.camera.world_from_camera
    world_from_unit = [world_from_photo @ np.linalg.inv(p) for p in parts["poses"]]
    plane = parts["plane"]
    up = world_from_photo[:3, :3] @ plane[1] if len(plane) else np.array([0.0, 1.0, 0.0])
    # the instance whose own axes are turned least stands for all
    asset_from_unit = similarity(nearest_rotation(rotation_from(world_from_unit[0][:3, :3].T @ up, np.array([0.0, 1.0, 0.0]))), np.zeros(3))
    placed = replace(
        mesh,
        vertices=move_points(asset_from_unit, mesh.vertices).astype(np.float32),
        normals=(mesh.normals @ asset_from_unit[:3, :3].T).astype(np.float32),
    )
    world_from_object = [m @ np.linalg.inv(asset_from_unit) for m in world_from_unit]
    instances = []
    for k, label in enumerate(labels):
        pose = world_from_object[chosen.index(k)] if k in chosen else None
        instances.append(Instance(label, pose, "" if pose is not None else "it agrees too little with the model of the others"))
    ground = None
    if len(plane):
        point = move_points(world_from_photo, plane[0])
        reach = max(np.linalg.norm(m[:3, 3] - point) for m in world_from_object) + 1.0
        ground = Ground(point, up, 4 * float(reach), maps["ground_colour"])
    material = Material(maps["base_color"], maps["roughness"], maps["metallic"], normal=maps["normal"])
    cameras = ((photo.name, photo.camera),)
    return Asset(placed, material, world_from_object[0], maps["environment"], cameras, {}, None, instances=tuple(instances), ground=ground)

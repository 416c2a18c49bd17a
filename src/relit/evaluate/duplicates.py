"""Figures of a photo of duplicates: poses, shape, material, light and the pile under other lights,
against the truth of a synthetic capture.

The photo's camera is known, so the reconstruction differs from the truth by one scale about that
camera (a photo does not know it) and by the choice of the object's own frame. The frame is the one
that agrees best with all registered instances.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from relit.conventions import move_points, world_from_cv_camera
from relit.errors import UserError
from relit.evaluate import metrics as m
from relit.evaluate.pile_alignment import grown_about, object_turn, scene_alignment
from relit.evaluate.results import entries, view_means
from relit.files import parse_toml
from relit.geometry.se3 import nearest_rotation, rotation_angle
from relit.scene import Asset, Camera, Ground, Pixels

VISIBLE = (
    0.25  # share of an instance that must be seen for it to count among those to be registered
)
SAMPLES = 30_000
PHOTO_SIDE = 480  # pixels of the re-rendered photo, longer side
MASKED = f"pixels of the objects (truth coverage >= {m.MASK}) in novel views of the whole pile; a pixel without a prediction is black"
DUPLICATES_DEFINITIONS: dict[str, tuple[str, str]] = {
    "rotation_median": (
        "degrees",
        "median over registered instances of the rotation error, after the one turn of the object's frame that fits all",
    ),
    "rotation_pairs": (
        "degrees",
        "median over pairs of registered instances of the error of their relative rotation",
    ),
    "rotation_worst": ("degrees", "largest of the errors of which rotation_median is the median"),
    "rotation_before": (
        "degrees",
        "rotation_median of the poses before the joint refinement with shape and appearance",
    ),
    "pairs_before": ("degrees", "rotation_pairs of the poses before the joint refinement"),
    "translation_median": (
        "radii",
        "median distance of the objects' centres from the true ones after the one scale about the camera, in radii",
    ),
    "surface_median": (
        "radii",
        "median over registered instances of the mean distance between points of the true surface where it stands and the nearest of it at "
        "the recovered pose (ADD-S), after the one scale about the camera: a turn that the shape does not tell costs nothing",
    ),
    "registered": (
        "%",
        f"share of the instances of which {VISIBLE:.0%} or more are visible that are registered within 10 degrees",
    ),
    "albedo_psnr": (
        "dB",
        f"base colour, one factor per channel over all test views, sRGB-encoded, {MASKED}; mean of the per-view PSNR",
    ),
    "roughness_mse": ("", f"perceptual roughness, {MASKED}"),
    "metallic_mse": ("", f"metallic, {MASKED}"),
    "novel_psnr": (
        "dB",
        f"the pile under the recovered light, sRGB-encoded, {MASKED}; mean of the per-view PSNR",
    ),
    "relit_psnr": (
        "dB",
        f"the pile under unseen lights, base colour times the factors of albedo_psnr, sRGB-encoded, {MASKED}; mean over lights, views",
    ),
    "environment_mse": (
        "",
        "recovered against true light, lat-long 256x512, clipped to [0, 1], to the power 1/2.2, mean of all texels (SfD)",
    ),
    "environment_mse_scaled": (
        "",
        "as environment_mse, the recovered light divided by the factors of albedo_psnr first",
    ),
    "chamfer": (
        "radii",
        "mean of the two mean distances between points of both whole surfaces after a similarity (ICP), in radii of the true object",
    ),
    "photo_psnr": (
        "dB",
        f"the photo, its longer side shrunk to {PHOTO_SIDE} pixels, re-rendered with its own camera and light, sRGB-encoded, over pixels "
        "that lie wholly in registered instances",
    ),
}


@dataclass(frozen=True)
class PileTruth:
    """What `relit synthesize duplicates` wrote. content: of truth.json. cameras: of the test views,
    by name. photo: the camera of the photo. poses: label -> world_from_object (4, 4)."""

    folder: Path
    content: dict[str, Any]
    cameras: list[tuple[str, Camera]]
    photo: Camera
    poses: dict[int, np.ndarray]

    def picture(self, name: str) -> np.ndarray:
        """A linear picture below truth/."""
        from relit.images import read_data

        return read_data(self.folder / "truth" / f"{name}.exr")


def pile_truth(folder: Path) -> PileTruth:
    """The truth of a rendered pile. Raises UserError where its rendering was stopped."""
    from relit.asset.asset import read_bounded_json

    if not (folder / "truth" / "truth.json").is_file():
        raise UserError(
            "the folder holds no complete truth",
            "its rendering was stopped",
            f"make it again: {folder}",
        )
    content = read_bounded_json(folder / "truth" / "truth.json")
    return PileTruth(
        folder,
        content,
        read_transforms(folder / "transforms_test.json"),
        read_transforms(folder / "transforms_train.json")[0][1],
        {i["label"]: np.array(i["world_from_object"]) for i in content["instances"]},
    )


def evaluate_duplicates(
    run: str | Path, truth_folder: str | Path, *, spp: int = 64, seed: int = 0
) -> dict[str, Any]:
    """Every figure that the truth allows, as `evaluate.dispatch.evaluate`. Raises UserError where
    the truth is unfinished."""
    from relit.asset.asset import load_asset

    asset, truth = load_asset(run), pile_truth(Path(truth_folder))
    values, scale = _pose_and_shape_figures(Path(run), asset, truth)
    per_view, factor = _view_figures(asset, truth, scale, spp, seed)
    light = truth.picture("environment")[..., :3]
    values["environment_mse"] = m.environment_mse(asset.environment, light)
    values["environment_mse_scaled"] = m.environment_mse(asset.environment / factor, light)
    values["photo_psnr"] = photo_figure(asset, truth.folder, spp=spp, seed=seed)
    values |= view_means(per_view)
    return {
        "metrics": entries(values, DUPLICATES_DEFINITIONS),
        "per_view": per_view,
        "albedo_scale": [float(x) for x in factor],
        "alignment": "scale about the camera",
    }


def registered_poses(asset: Asset) -> dict[int, np.ndarray]:
    """label -> world_from_object (4, 4) of the registered instances."""
    return {
        i.label: np.asarray(i.world_from_object)
        for i in asset.instances
        if i.registered and i.photo == 0
    }


def _pose_and_shape_figures(
    run: Path, asset: Asset, truth: PileTruth
) -> tuple[dict[str, float], float]:
    """Figures of poses and shape, and the scale about the photo's camera that aligns the pile."""
    import trimesh

    poses, photo, radius = registered_poses(asset), truth.photo, truth.content["radius"]
    visible = {i["label"]: i["visible"] for i in truth.content["instances"]}
    values = instance_pose_figures(poses, truth.poses, visible)
    before = poses_before(run, photo, list(poses))
    if len(before) == len(poses):
        earlier = instance_pose_figures(before, truth.poses, {})
        values["rotation_before"] = earlier["rotation_median"]
        values["pairs_before"] = earlier["rotation_pairs"]
    loaded = trimesh.load(truth.folder / "truth" / "mesh.ply", process=False)
    points = m.sample_surface(loaded.vertices, loaded.faces, SAMPLES).points
    scale, own_middle, frame = scene_alignment(
        poses, truth.poses, photo, points, asset.mesh.vertices
    )
    centres = centre_error(poses, truth.poses, photo, scale, own_middle, points)
    values["translation_median"] = centres / radius
    some = points[:: SAMPLES // 2000]
    values["surface_median"] = add_s(poses, truth.poses, photo, scale, frame, some) / radius
    own = m.sample_surface(asset.mesh.vertices, asset.mesh.faces, SAMPLES).points
    values["chamfer"] = sample_chamfer(points, own, frame)
    return values, scale


def _view_figures(
    asset: Asset, truth: PileTruth, scale: float, spp: int, seed: int
) -> tuple[dict[str, dict[str, float]], np.ndarray]:
    """Figures of each test view, and the scale of base colour (3,) that they use."""
    from relit.reference.mitsuba_scene import build_scene, render, render_channels
    from relit.reference.pile import build_pile

    centre, cameras = truth.photo.centre, truth.cameras
    moved = [grown_about(centre, scale) @ p for p in registered_poses(asset).values()]
    ground = None if asset.ground is None else scaled_ground(asset.ground, centre, scale)
    objects = build_pile(asset.mesh, asset.material, moved)
    # channels of the objects alone
    bare = build_scene(objects.mesh, objects.material, np.eye(4), None)
    predicted = {name: render_channels(bare, camera, spp=16) for name, camera in cameras}
    reference = {name: truth.picture(f"test/{name}_albedo") for name, _ in cameras}
    inside = {name: r[..., 3] >= m.MASK for name, r in reference.items()}
    both = {name: inside[name] & (predicted[name]["alpha"] > 0) for name in inside}
    factor = m.albedo_scale(
        np.concatenate([predicted[n]["albedo"][both[n]] for n in both]),
        np.concatenate([reference[n][..., :3][both[n]] for n in both]),
    )

    def under(material, light, pictures: str) -> dict[str, float]:
        """PSNR of each view inside the mask, against truth/`pictures`."""
        pile = build_pile(asset.mesh, material, moved, ground)
        scene = build_scene(pile.mesh, pile.material, np.eye(4), light)
        depth, out = truth.content["settings"]["max_depth"], {}
        for i, (name, camera) in enumerate(cameras):
            shown = render(scene, camera, spp=spp, seed=seed + i, max_depth=depth)[..., :3]
            shown = shown * (predicted[name]["alpha"] > 0)[..., None]
            picture = truth.picture(f"{pictures}/{name}")[..., :3]
            out[name] = m.psnr(m.encode(shown), m.encode(picture), inside[name])
        return out

    novel = under(asset.material, asset.environment, "test")
    per_view: dict[str, dict[str, float]] = {}
    for name, _ in cameras:
        p, where = predicted[name], inside[name]
        true_albedo = m.encode(reference[name][..., :3])
        per_view[name] = {
            f"{key}_mse": float(
                np.square(p[key] - truth.picture(f"test/{name}_{key}"))[where].mean()
            )
            for key in ("roughness", "metallic")
        }
        albedo = m.encode(p["albedo"] * factor)
        per_view[name]["albedo_psnr"] = m.psnr(albedo, true_albedo, where)
        per_view[name]["novel_psnr"] = novel[name]
    base = np.clip(asset.material.base_color * factor, 0, 1).astype(np.float32)
    for light in truth.content["relight"]:
        radiance = truth.picture(f"relight/{light}")[..., :3]
        relit = under(replace(asset.material, base_color=base), radiance, f"relight/{light}")
        for name, value in relit.items():
            per_view[name][f"relit_psnr:{light}"] = value
    return per_view, factor


def evaluate_on_photo(
    run: str | Path, capture: str | Path, *, spp: int = 64, seed: int = 0
) -> dict[str, Any]:
    """Figures of a real photo: the photo re-rendered, and the rotations against SfD's poses where
    its `object_pred_pose.json` lies there.

    Those poses were found by structure from motion: a reference, not the truth. Raises UserError
    where the capture is no such photo.
    """
    from relit.asset.asset import load_asset

    asset, capture = load_asset(run), Path(capture)
    values = {"photo_psnr": photo_figure(asset, capture, run=Path(run), spp=spp, seed=seed)}
    reference = reference_poses(capture, asset.cameras[0][1])
    poses = {
        i.label: np.asarray(i.world_from_object)
        for i in asset.instances
        if i.registered and i.photo == 0
    }
    if reference:
        values.update(instance_pose_figures(poses, reference, dict.fromkeys(reference, 1.0)))
        before = poses_before(Path(run), asset.cameras[0][1], list(poses))
        if len(before) == len(poses):
            earlier = instance_pose_figures(before, reference, {})
            values["rotation_before"], values["pairs_before"] = (
                earlier["rotation_median"],
                earlier["rotation_pairs"],
            )
    return {"metrics": entries(values, DUPLICATES_DEFINITIONS), "per_view": {}}


def reference_poses(capture: Path, camera: Camera) -> dict[int, np.ndarray]:
    """SfD's own poses world_from_object (4, 4) by label; the object of each file entry is the one
    at whose label its middle lies. {} where there are none."""
    from relit.asset.asset import read_bounded_json
    from relit.capture.readers.sfd import open_duplicates, recognise

    files = [capture / name for name in ("object_pred_pose.json", "object_scale_matrix.json")]
    source = recognise(capture)
    if source is None or not all(f.is_file() for f in files):
        return {}
    labels = open_duplicates(source, focal=camera.fx).photos[0].load().labels
    listed = read_bounded_json(files[0])
    middle = np.array(read_bounded_json(files[1])["scale_matrix"], np.float64)[:3, 3]
    out = {}
    for name in sorted(listed):
        pose = np.array(listed[name], np.float64)
        u, v, z = camera.project(move_points(pose, middle))
        if (
            z > 0
            and 0 <= u < camera.width
            and 0 <= v < camera.height
            and labels[int(v), int(u)] > 0
        ):
            out[int(labels[int(v), int(u)])] = pose
    return out


def labelled_pixels(capture: Path, run: Path | None, focal: float) -> Pixels | None:
    """The capture's first photo with its labels, of the network that the run's config.toml names
    where it names one. None where there are no labels."""
    from relit.capture.readers.sfd import open_duplicates, open_segmented, recognise

    config = run / "config.toml" if run else None
    masks = (
        str(parse_toml(config.read_text(encoding="utf-8")).get("masks", ""))
        if config and config.is_file()
        else ""
    )
    if masks.startswith("segment:"):
        return open_segmented(capture, masks.split(":", 1)[1], focal=focal).photos[0].load()
    source = recognise(capture)
    return None if source is None else open_duplicates(source, focal=focal).photos[0].load()


def photo_figure(
    asset: Asset, capture: Path, *, run: Path | None = None, spp: int = 64, seed: int = 0
) -> float:
    """PSNR of the re-rendered photo over the pixels of registered instances (see photo_psnr). run:
    whose settings say where the labels are from."""
    from relit.evaluate.photos import shrunk_to_camera
    from relit.reference.photographed import as_photographed

    pixels = labelled_pixels(capture, run, asset.cameras[0][1].fx) if asset.cameras else None
    if pixels is None:
        raise UserError(
            "the capture is no photo of duplicates",
            fix=f"give the folder that the run was made from: {capture}",
        )
    camera = asset.cameras[0][1]
    own = np.isin(
        pixels.labels, [i.label for i in asset.instances if i.registered and i.photo == 0]
    )
    camera = camera.within(PHOTO_SIDE)
    rgb, where = (
        shrunk_to_camera(pixels.rgb, camera),
        shrunk_to_camera(own.astype(np.float32), camera) >= m.MASK,
    )
    picture = as_photographed(asset)(asset.cameras[0][0], camera, spp=spp, seed=seed)
    return m.psnr(m.encode(picture[..., :3]), m.encode(rgb), where)


def read_transforms(file: Path) -> list[tuple[str, Camera]]:
    """(name, Camera) pairs of a transforms file with one focal length."""
    from relit.asset.asset import read_bounded_json

    data = read_bounded_json(file)
    w, h, f = data["w"], data["h"], float(data["focal"])
    return [
        (
            Path(x["file_path"]).stem,
            Camera(
                w,
                h,
                f,
                f,
                w / 2,
                h / 2,
                world_from_cv_camera(np.array(x["transform_matrix"], np.float64)),
            ),
        )
        for x in data["frames"]
    ]


# ---------------------------------------------------------------- poses


def instance_pose_figures(poses: dict, true_poses: dict, visible: dict) -> dict[str, float]:
    """rotation_median, rotation_worst, rotation_pairs and, where the visible shares are known,
    registered."""
    keys = [k for k in poses if k in true_poses]
    poses = {k: poses[k] for k in keys}
    if not keys:
        raise UserError(
            "no registered instance has a label of the truth",
            fix="is this the capture that the run was made from?",
        )
    turn = object_turn(poses, true_poses)
    a = {k: nearest_rotation(poses[k][:3, :3]) @ turn for k in keys}
    b = {k: nearest_rotation(true_poses[k][:3, :3]) for k in keys}
    errors = {k: rotation_angle(a[k].T @ b[k]) for k in keys}
    pairs = [
        rotation_angle((a[i] @ a[j].T).T @ (b[i] @ b[j].T))
        for n, i in enumerate(keys)
        for j in keys[:n]
    ]
    out = {
        "rotation_median": float(np.median(list(errors.values()))),
        "rotation_worst": max(errors.values()),
    }
    out["rotation_pairs"] = float(np.median(pairs)) if pairs else 0.0
    asked = [k for k, v in visible.items() if v >= VISIBLE]
    if asked:
        out["registered"] = 100.0 * float(np.mean([errors.get(k, 180.0) < 10 for k in asked]))
    return out


def poses_before(run: Path, photo: Camera, labels: list[int]) -> dict[int, np.ndarray]:
    """world_from_object of the given labels as the pose search has left them; {} for an asset
    without its run."""
    from relit.files import NO_ARRAYS, load_arrays

    try:
        saved = load_arrays(run / "stages" / "poses" / "result.npz")
        found = {
            int(saved[f"ids.{k}.label"]): pose
            for k, pose in enumerate(saved["poses"])
            if not saved[f"ids.{k}.photo"]
        }
    except (*NO_ARRAYS, KeyError):  # not there, or damaged
        return {}
    return {k: photo.world_from_camera @ np.linalg.inv(found[k]) for k in labels if k in found}


def scaled_ground(g: Ground, centre: np.ndarray, scale: float) -> Ground:
    return replace(
        g, point=move_points(grown_about(centre, scale), g.point), radius=g.radius * scale
    )


def centre_error(
    poses, true_poses, photo: Camera, scale: float, own: np.ndarray, true_points: np.ndarray
) -> float:
    """own: (3,) the point of the recovered object's frame that is the middle of the true one."""
    middle, grow = (true_points.min(0) + true_points.max(0)) / 2, grown_about(photo.centre, scale)
    distances = [
        np.linalg.norm(move_points(grow @ poses[k], own) - move_points(true_poses[k], middle))
        for k in poses
        if k in true_poses
    ]
    return float(np.median(distances))


def add_s(
    poses, true_poses, photo: Camera, scale: float, frame: np.ndarray, true_points: np.ndarray
) -> float:
    """ADD-S (Xiang et al. 2018, PoseCNN, Sec. V-A), the median over instances, in units of the
    scene."""
    from scipy.spatial import cKDTree

    grow = grown_about(photo.centre, scale)
    known = [k for k in poses if k in true_poses]
    found = [
        cKDTree(move_points(grow @ poses[k] @ frame, true_points)).query(
            move_points(true_poses[k], true_points)
        )[0]
        for k in known
    ]
    return float(np.median([d.mean() for d in found]))


def sample_chamfer(true_points: np.ndarray, own: np.ndarray, frame: np.ndarray) -> float:
    """Mean of the two mean nearest distances between samples, in radii of the true object."""
    from scipy.spatial import cKDTree

    back = move_points(np.linalg.inv(frame), own)
    radius = np.linalg.norm(
        true_points - (true_points.min(0) + true_points.max(0)) / 2, axis=1
    ).max()
    one, two = (
        cKDTree(true_points).query(back)[0].mean(),
        cKDTree(back).query(true_points)[0].mean(),
    )
    return float((one + two) / 2 / radius)

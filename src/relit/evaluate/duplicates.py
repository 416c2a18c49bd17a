"""Figures of a photo of duplicates: poses, shape, material, light and the pile under other lights,
against the truth of a synthetic capture.

The photo's camera is known, so the reconstruction differs from the truth by one scale about that
camera (a photo does not know it) and by the choice of the object's own frame. The frame is the one
that agrees best with all registered instances.
"""

from __future__ import annotations

from dataclasses import replace
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


def evaluate_duplicates(
    run: str | Path, truth_folder: str | Path, *, spp: int = 64, seed: int = 0
) -> dict[str, Any]:
    """Every figure that the truth allows, as `evaluate.dispatch.evaluate`. Raises UserError where
    the truth is unfinished."""
    from relit.asset.asset import load_asset, read_bounded_json
    from relit.images import read_data
    from relit.reference.mitsuba_scene import build_scene, render, render_channels
    from relit.reference.pile import build_pile

    folder, asset = Path(truth_folder), load_asset(run)
    if not (folder / "truth" / "truth.json").is_file():
        raise UserError(
            "the folder holds no complete truth",
            "its rendering was stopped",
            f"make it again: {folder}",
        )
    truth = read_bounded_json(folder / "truth" / "truth.json")
    cameras = read_transforms(folder / "transforms_test.json")
    photo = read_transforms(folder / "transforms_train.json")[0][1]
    true_poses = {i["label"]: np.array(i["world_from_object"]) for i in truth["instances"]}
    poses = {i.label: np.asarray(i.world_from_object) for i in asset.instances if i.registered}
    values = instance_pose_figures(
        poses, true_poses, {i["label"]: i["visible"] for i in truth["instances"]}
    )
    before = poses_before(Path(run), photo, list(poses))
    if len(before) == len(poses):
        earlier = instance_pose_figures(before, true_poses, {})
        values["rotation_before"], values["pairs_before"] = (
            earlier["rotation_median"],
            earlier["rotation_pairs"],
        )

    import trimesh

    loaded = trimesh.load(folder / "truth" / "mesh.ply", process=False)
    true_points = m.sample_surface(loaded.vertices, loaded.faces, SAMPLES).points
    scale, own_middle, frame = scene_alignment(
        poses, true_poses, photo, true_points, asset.mesh.vertices
    )
    radius, depth = truth["radius"], truth["settings"]["max_depth"]
    values["translation_median"] = (
        centre_error(poses, true_poses, photo, scale, own_middle, true_points) / radius
    )
    values["surface_median"] = (
        add_s(poses, true_poses, photo, scale, frame, true_points[:: SAMPLES // 2000]) / radius
    )
    own = m.sample_surface(asset.mesh.vertices, asset.mesh.faces, SAMPLES).points
    values["chamfer"] = sample_chamfer(true_points, own, frame)

    moved = [grown_about(photo.centre, scale) @ p for p in poses.values()]
    ground = None if asset.ground is None else scaled_ground(asset.ground, photo.centre, scale)
    per_view: dict[str, dict[str, float]] = {name: {} for name, _ in cameras}

    def scene_under(material, light):
        pile = build_pile(asset.mesh, material, moved, ground)
        return build_scene(pile.mesh, pile.material, np.eye(4), light)

    scene = scene_under(asset.material, asset.environment)
    objects = build_pile(asset.mesh, asset.material, moved)
    bare = build_scene(
        objects.mesh, objects.material, np.eye(4), None
    )  # channels of the objects alone
    predicted, reference = {}, {}
    for name, camera in cameras:
        predicted[name] = render_channels(bare, camera, spp=16)
        reference[name] = read_data(folder / "truth" / "test" / f"{name}_albedo.exr")
    inside = {name: r[..., 3] >= m.MASK for name, r in reference.items()}
    both = {name: inside[name] & (predicted[name]["alpha"] > 0) for name in inside}
    factor = m.albedo_scale(
        np.concatenate([predicted[n]["albedo"][both[n]] for n in both]),
        np.concatenate([reference[n][..., :3][both[n]] for n in both]),
    )
    for i, (name, camera) in enumerate(cameras):
        p, where = predicted[name], inside[name]
        for key in ("roughness", "metallic"):
            t = read_data(folder / "truth" / "test" / f"{name}_{key}.exr")
            per_view[name][f"{key}_mse"] = float(np.square(p[key] - t)[where].mean())
        per_view[name]["albedo_psnr"] = m.psnr(
            m.encode(p["albedo"] * factor), m.encode(reference[name][..., :3]), where
        )
        picture = read_data(folder / "truth" / "test" / f"{name}.exr")
        shown = (
            render(scene, camera, spp=spp, seed=seed + i, max_depth=depth)[..., :3]
            * (p["alpha"] > 0)[..., None]
        )
        per_view[name]["novel_psnr"] = m.psnr(m.encode(shown), m.encode(picture[..., :3]), where)
    scaled = replace(
        asset.material,
        base_color=np.clip(asset.material.base_color * factor, 0, 1).astype(np.float32),
    )
    for light_name in truth["relight"]:
        scene = scene_under(
            scaled, read_data(folder / "truth" / "relight" / f"{light_name}.exr")[..., :3]
        )
        for i, (name, camera) in enumerate(cameras):
            picture = read_data(folder / "truth" / "relight" / light_name / f"{name}.exr")
            shown = (
                render(scene, camera, spp=spp, seed=seed + i, max_depth=depth)[..., :3]
                * (predicted[name]["alpha"] > 0)[..., None]
            )
            per_view[name][f"relit_psnr:{light_name}"] = m.psnr(
                m.encode(shown), m.encode(picture[..., :3]), inside[name]
            )
    light = read_data(folder / "truth" / "environment.exr")[..., :3]
    values["environment_mse"] = m.environment_mse(asset.environment, light)
    values["environment_mse_scaled"] = m.environment_mse(asset.environment / factor, light)
    values["photo_psnr"] = photo_figure(asset, folder, spp=spp, seed=seed)
    values |= view_means(per_view)
    return {
        "metrics": entries(values, DUPLICATES_DEFINITIONS),
        "per_view": per_view,
        "albedo_scale": [float(x) for x in factor],
        "alignment": "scale about the camera",
    }


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
    poses = {i.label: np.asarray(i.world_from_object) for i in asset.instances if i.registered}
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
    own = np.isin(pixels.labels, [i.label for i in asset.instances if i.registered])
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
        saved = load_arrays(run / "stages" / "poses" / "poses.npz")
        found = {int(k): p for k, p in zip(saved["labels"], saved["poses"], strict=True)}
    except NO_ARRAYS:  # not there, or damaged
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

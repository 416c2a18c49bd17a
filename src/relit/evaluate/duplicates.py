"""Figures of a photo of duplicates: poses, shape, material, light and the pile under other lights,
against the truth of a synthetic capture.

The photo's camera is known, so the reconstruction differs from the truth by one scale about that
camera (a photo does not know it) and by the choice of the object's own frame. The frame is the one
that agrees best with all registered instances.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from relit.conventions import move_points, similarity
from relit.errors import UserError
from relit.evaluate import metrics as m
from relit.evaluate.alignment import LOST, angles_between
from relit.evaluate.baselines import Baselines, Constants, chance, random_rotations
from relit.evaluate.environments import ENVIRONMENT_DEFINITIONS, environment_figures
from relit.evaluate.lpips import Lpips
from relit.evaluate.picture_figures import LPIPS, Draw, picture_figures
from relit.evaluate.pile_alignment import (
    frame_by_poses,
    grown_about,
    object_turn,
    scene_alignment,
)
from relit.evaluate.pile_views import PileTruth, PileViews, load_pile_truth, registered_poses
from relit.evaluate.results import entries, view_means
from relit.evaluate.truth import ceiling_of
from relit.files import parse_toml
from relit.geometry.se3 import nearest_rotation
from relit.scene import Asset, Camera, Pixels

VISIBLE = (
    0.25  # share of an instance that must be seen for it to count among those to be registered
)
SAMPLES = 30_000
PHOTO_SIDE = 480  # pixels of the re-rendered photo, longer side
SURFACE_DRAWS = 5  # of chance between surfaces, whose median over instances varies little
MASKED = f"pixels of the objects (truth coverage >= {m.MASK}) in novel views of the whole pile; a pixel without a prediction is black"
FRAME = "novel views of the whole pile, whole frame, black where no object is"
RELIT = "the pile under unseen lights, base colour times the factors of albedo_psnr"
NOVEL = "the pile under the recovered light"
PHOTO = (
    f"the photo, its longer side shrunk to {PHOTO_SIDE} pixels, re-rendered with its own camera and "
    "light, sRGB-encoded"
)


def _pictures(prefix: str, what: str, over: str) -> dict[str, tuple[str, str]]:
    """Definitions of the pile's pictures: PREFIX_psnr is over the mask, PREFIX_psnr_frame over the
    whole frame."""
    ssim = "SSIM (Gaussian 11 x 11, sigma 1.5), sRGB-encoded"
    return {
        f"{prefix}_psnr": ("dB", f"{what}, sRGB-encoded, {MASKED}; mean of the PSNR over {over}"),
        f"{prefix}_psnr_frame": ("dB", f"{what}, sRGB-encoded, {FRAME}; mean over {over}"),
        f"{prefix}_ssim": ("", f"{what}, {ssim}, {MASKED}; mean over {over}"),
        f"{prefix}_ssim_frame": ("", f"{what}, {ssim}, {FRAME}; mean over {over}"),
        f"{prefix}_lpips": ("", f"{what}, {LPIPS['lpips_masked']}"),
        f"{prefix}_lpips_frame": ("", f"{what}, {LPIPS['lpips']}"),
    }


DUPLICATES_DEFINITIONS: dict[str, tuple[str, str]] = {
    "rotation_median": (
        "degrees",
        "median over ALL instances that the photo shows of the rotation error, after the one turn of the object's frame that fits the "
        f"registered ones best; an instance that is not registered counts {LOST:g} degrees",
    ),
    "rotation_median_registered": (
        "degrees",
        "as rotation_median, over registered instances only",
    ),
    "rotation_pairs": (
        "degrees",
        "median over pairs of registered instances of the error of their relative rotation",
    ),
    "rotation_worst": (
        "degrees",
        "largest of the errors of which rotation_median_registered is the median",
    ),
    "rotation_before": (
        "degrees",
        "rotation_median of the poses before the joint refinement with shape and appearance",
    ),
    "pairs_before": ("degrees", "rotation_pairs of the poses before the joint refinement"),
    "translation_median": (
        "radii",
        "median distance of the registered objects' centres from the true ones after the one scale about the camera, in radii",
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
        f"base colour, one linear factor per channel over all test views, sRGB-encoded, {MASKED}; mean of the per-view PSNR",
    ),
    "roughness_mse": ("", f"perceptual roughness, mean squared error, {MASKED}"),
    "metallic_mse": ("", f"metallic, mean squared error, {MASKED}"),
    **_pictures("novel", NOVEL, "views"),
    **_pictures("relit", RELIT, "lights and views"),
    **ENVIRONMENT_DEFINITIONS,
    "chamfer": (
        "radii",
        f"mean of the two mean distances between {SAMPLES} points uniform by area on each whole surface, in radii of the true object, "
        "after the similarity that the poses and the camera give (SfD): no surface is consulted for it",
    ),
    "chamfer_icp": (
        "radii",
        "as chamfer, after a similarity fitted between the two surfaces (ICP): the error of the shape alone",
    ),
    "photo_psnr": ("dB", f"{PHOTO}, PSNR over pixels that lie wholly in registered instances"),
    "photo_psnr_frame": (
        "dB",
        f"{PHOTO}, PSNR of the whole frame, black in both where no registered instance is",
    ),
    "photo_ssim": (
        "",
        f"{PHOTO}, SSIM (Gaussian 11 x 11, sigma 1.5) over pixels that lie wholly in registered instances",
    ),
    "photo_ssim_frame": ("", "as photo_ssim, over the whole frame"),
    "photo_lpips": ("", f"{PHOTO}, LPIPS, black in both where no registered instance is"),
}


def evaluate_duplicates(
    run: str | Path,
    truth_folder: str | Path,
    *,
    spp: int = 64,
    seed: int = 0,
    lpips: Lpips | None = None,
) -> dict[str, Any]:
    """Every figure that the truth allows, as `evaluate.dispatch.evaluate`. Raises UserError where
    the truth is unfinished."""
    from relit.asset.asset import load_asset

    asset, truth = load_asset(run), load_pile_truth(Path(truth_folder))
    draw, constants = Draw(spp, seed, lpips), Constants()
    values, scale, baselines = _pose_and_shape_figures(Path(run), asset, truth)
    per_view, factor = _view_figures(PileViews.of(asset, truth, scale), constants, draw)
    light = truth.picture("environment")[..., :3]
    values |= environment_figures(asset.environment, light, factor, constants)
    values |= photo_figures_of(asset, truth.folder, draw)
    values |= view_means(per_view)
    baselines |= constants.baselines()
    return {
        "metrics": entries(values, DUPLICATES_DEFINITIONS, baselines),
        "ceiling": ceiling_of(truth.folder),
        "per_view": per_view,
        "albedo_scale": [float(x) for x in factor],
        "alignment": "scale about the camera",
    }


def _pose_and_shape_figures(
    run: Path, asset: Asset, truth: PileTruth
) -> tuple[dict[str, float], float, Baselines]:
    """Figures of poses and shape, the scale about the photo's camera that aligns the pile, and what
    random rotations score."""
    import trimesh

    poses, photo, radius = registered_poses(asset), truth.photo, truth.content["radius"]
    visible = {i["label"]: i["visible"] for i in truth.content["instances"]}
    values = instance_pose_figures(poses, truth.poses, visible)
    baselines = instance_chance(list(poses), truth.poses, visible)
    before = poses_before(run, photo, list(poses))
    if len(before) == len(poses):
        values |= _earlier(instance_pose_figures(before, truth.poses, visible))
    loaded = trimesh.load(truth.folder / "truth" / "mesh.ply", process=False)
    points = m.sample_surface(loaded.vertices, loaded.faces, SAMPLES).samples
    scale, own_middle, fitted = scene_alignment(
        poses, truth.poses, photo, points, asset.mesh.vertices
    )
    values["translation_median"] = (
        centre_error(poses, truth.poses, photo, scale, own_middle, points) / radius
    )
    some = points[:: SAMPLES // 2000]
    values["surface_median"] = add_s(poses, truth.poses, photo, scale, fitted, some) / radius
    baselines |= surface_chance(list(poses), truth.poses, photo, some, radius)
    own = m.sample_surface(asset.mesh.vertices, asset.mesh.faces, SAMPLES, seed=1).samples
    middle = (points.min(0) + points.max(0)) / 2
    by_poses = frame_by_poses(poses, truth.poses, scale, own_middle, middle)
    values["chamfer"] = sample_chamfer(points, own, by_poses)
    values["chamfer_icp"] = sample_chamfer(points, own, fitted)
    return values, scale, baselines


def _view_figures(
    views: PileViews, constants: Constants, draw: Draw
) -> tuple[dict[str, dict[str, float]], np.ndarray]:
    """Figures of each test view, and the scale of base colour (3,) that they use."""
    predicted, inside = views.predicted, views.inside
    both = {name: inside[name] & (predicted[name]["alpha"] > 0) for name in inside}
    factor = m.albedo_scale(
        np.concatenate([predicted[n]["albedo"][both[n]] for n in both]),
        np.concatenate([views.albedo[n][..., :3][both[n]] for n in both]),
    )
    per_view: dict[str, dict[str, float]] = {}
    for name, p in predicted.items():
        where, figures = inside[name], per_view.setdefault(name, {})
        for key in ("roughness", "metallic"):
            true = views.truth.picture(f"test/{name}_{key}")
            figures[f"{key}_mse"] = float(np.square(p[key] - true)[where].mean())
            constants.add(f"{key}_mse", true, where)
        true_albedo = m.encode(views.albedo[name][..., :3])
        figures["albedo_psnr"] = m.psnr(m.encode(p["albedo"] * factor), true_albedo, where)
        constants.add("albedo_psnr", true_albedo, where)
    asset = views.asset
    for name, pair in views.pictures(asset.material, asset.environment, "test", draw).items():
        per_view[name] |= _pile_pictures("novel", *pair, inside[name], draw.lpips)
    base = np.clip(asset.material.base_color * factor, 0, 1).astype(np.float32)
    scaled = replace(asset.material, base_color=base)
    for light in views.truth.content["relight"]:
        radiance = views.truth.picture(f"relight/{light}")[..., :3]
        for name, pair in views.pictures(scaled, radiance, f"relight/{light}", draw).items():
            figures = _pile_pictures("relit", *pair, inside[name], draw.lpips)
            per_view[name] |= {f"{key}:{light}": value for key, value in figures.items()}
    return per_view, factor


def _pile_pictures(prefix: str, shown, truth, inside, lpips: Lpips | None) -> dict[str, float]:
    """`picture_figures` under the pile's names: without a tail inside the mask, `_frame` the whole
    frame."""
    figures = picture_figures(shown, truth, inside, lpips)
    out = {}
    for name in ("psnr", "ssim", "lpips"):
        if name in figures:
            out[f"{prefix}_{name}"] = figures[f"{name}_masked"]
            out[f"{prefix}_{name}_frame"] = figures[name]
    return out


def evaluate_on_photo(
    run: str | Path,
    capture: str | Path,
    *,
    spp: int = 64,
    seed: int = 0,
    lpips: Lpips | None = None,
) -> dict[str, Any]:
    """Figures of a real photo: the photo re-rendered, and the rotations against SfD's poses where
    its `object_pred_pose.json` lies there.

    Those poses were found by structure from motion: a reference, not the truth. Raises UserError
    where the capture is no such photo.
    """
    from relit.asset.asset import load_asset

    asset, capture = load_asset(run), Path(capture)
    values = photo_figures_of(asset, capture, Draw(spp, seed, lpips), run=Path(run))
    baselines: Baselines = {}
    reference = reference_poses(capture, asset.cameras[0][1])
    poses = registered_poses(asset)
    if reference:
        visible = dict.fromkeys(reference, 1.0)
        values.update(instance_pose_figures(poses, reference, visible))
        baselines = instance_chance(list(poses), reference, visible)
        before = poses_before(Path(run), asset.cameras[0][1], list(poses))
        if len(before) == len(poses):
            values |= _earlier(instance_pose_figures(before, reference, visible))
    return {"metrics": entries(values, DUPLICATES_DEFINITIONS, baselines), "per_view": {}}


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


def photo_figures_of(
    asset: Asset, capture: Path, draw: Draw, *, run: Path | None = None
) -> dict[str, float]:
    """photo_psnr, photo_ssim and photo_lpips of the re-rendered photo over the pixels of registered
    instances and over the frame. run: whose settings say where the labels are from."""
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
    shown = as_photographed(asset)(asset.cameras[0][0], camera, spp=draw.spp, seed=draw.seed)
    only = where[..., None]
    figures = _pile_pictures("photo", shown[..., :3] * only, rgb * only, where, draw.lpips)
    figures.pop("photo_lpips_frame", None)  # the pictures are black outside: it is the same
    return figures


# ---------------------------------------------------------------- poses


def instance_pose_figures(
    poses: Mapping, true_poses: Mapping, visible: Mapping
) -> dict[str, float]:
    """The rotation figures of registered instances. poses: world_from_object (4, 4) by label.
    visible: label -> share that the photo shows, of all instances of the truth; those of share 0
    do not count. Raises UserError where no label is known."""
    keys = [k for k in poses if k in true_poses]
    poses = {k: poses[k] for k in keys}
    if not keys:
        raise UserError(
            "no registered instance has a label of the truth",
            fix="is this the capture that the run was made from?",
        )
    turn = object_turn(poses, dict(true_poses))
    a = np.array([nearest_rotation(poses[k][:3, :3]) @ turn for k in keys])
    b = np.array([nearest_rotation(true_poses[k][:3, :3]) for k in keys])
    errors = dict(zip(keys, angles_between(a, b), strict=True))
    i, j = np.tril_indices(len(keys), -1)
    transposed = np.swapaxes(a, 1, 2), np.swapaxes(b, 1, 2)
    pairs = angles_between(a[i] @ transposed[0][j], b[i] @ transposed[1][j])
    lost = [k for k, share in visible.items() if share > 0 and k not in errors]
    registered = np.array(list(errors.values()))
    out = {
        "rotation_median": float(np.median([*registered, *(LOST for _ in lost)])),
        "rotation_median_registered": float(np.median(registered)),
        "rotation_worst": float(registered.max()),
        "rotation_pairs": float(np.median(pairs)) if len(pairs) else 0.0,
    }
    wanted = [k for k, share in visible.items() if share >= VISIBLE]
    if wanted:
        out["registered"] = 100.0 * float(np.mean([errors.get(k, LOST) < 10 for k in wanted]))
    return out


def instance_chance(labels: list[int], true_poses: Mapping, visible: Mapping) -> Baselines:
    """What uniformly random rotations of the registered instances score under
    `instance_pose_figures`."""
    known = [k for k in labels if k in true_poses]

    def drawn(rng: np.random.Generator) -> dict[str, float]:
        poses = {}
        for k, turn in zip(known, random_rotations(len(known), rng), strict=True):
            poses[k] = np.eye(4)
            poses[k][:3, :3] = turn
        return instance_pose_figures(poses, true_poses, visible)

    found = chance(drawn) if known else {}
    return found | (_earlier(found) if found else {})


def _earlier(figures: Mapping[str, Any]) -> dict[str, Any]:
    """The figures of the poses before the joint refinement, under their own names."""
    return {
        "rotation_before": figures["rotation_median"],
        "pairs_before": figures["rotation_pairs"],
    }


def surface_chance(
    labels: list[int], true_poses: Mapping, photo: Camera, points: np.ndarray, radius: float
) -> Baselines:
    """What the true surface at random rotations about its middle scores as surface_median."""
    known = {k: true_poses[k] for k in labels if k in true_poses}
    middle = (points.min(0) + points.max(0)) / 2

    def drawn(rng: np.random.Generator) -> dict[str, float]:
        turned = {}
        turns = random_rotations(len(known), rng)
        for (k, pose), turn in zip(known.items(), turns, strict=True):
            turned[k] = pose @ similarity(turn, middle - turn @ middle)
        value = add_s(turned, known, photo, 1.0, np.eye(4), points) / radius
        return {"surface_median": value}

    return chance(drawn, SURFACE_DRAWS) if known else {}


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
    back = move_points(np.linalg.inv(frame), own)
    radius = np.linalg.norm(
        true_points - (true_points.min(0) + true_points.max(0)) / 2, axis=1
    ).max()
    return float(m.point_chamfer(back, true_points)[0] / radius)

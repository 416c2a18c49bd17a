"""What is measured on the asset of a collection: recovered cameras after Procrustes, held-out
photos from their own fitted camera and light, material and shape in the true test views.

The truth is the folder that `relit synthesize collection` wrote (of real photos see
`evaluate.collection_photos`). Pictures are rendered by the package's path tracer.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from relit.conventions import move_points, move_pose, similarity
from relit.errors import UserError
from relit.evaluate import definitions
from relit.evaluate import metrics as m
from relit.evaluate.multiview import fixed_albedo_scale, material_figures
from relit.evaluate.results import entries, view_means
from relit.evaluate.surfaces import chamfer_figures
from relit.evaluate.truth import Truth, camera_key
from relit.geometry.se3 import align_cameras as align_poses
from relit.geometry.se3 import camera_errors, nearest_rotation, rotation_angle, umeyama
from relit.scene import Asset, Camera

WITHIN = 10.0  # degrees
_POSE = "after the best similarity between recovered and true training cameras (Procrustes, without those more than 3 medians off)"
_HELD = "held-out photos from the camera and under the light that were fitted to them with shape and material frozen"
DEFINITIONS = {
    "rotation_mean": ("degrees", f"mean rotation error of the training cameras, {_POSE}"),
    "rotation_median": ("degrees", f"median rotation error of the training cameras, {_POSE}"),
    "rotation_within_10": (
        "%",
        f"share of training cameras whose rotation error is below {WITHIN:g} degrees, {_POSE}",
    ),
    "translation_percent": (
        "%",
        f"mean distance of the camera centres, in per cent of the mean distance from the object, {_POSE}",
    ),
    "focal_percent": ("%", "mean error of the focal lengths of the training cameras"),
    "held_out_rotation": ("degrees", f"mean rotation error of the held-out cameras, {_POSE}"),
    "novel_psnr": (
        "dB",
        f"{_HELD}: PSNR of sRGB pictures composite on white, each by its own coverage, whole frame (Neural-PIL, SAMURAI)",
    ),
    "novel_ssim": ("", f"{_HELD}: SSIM (11 x 11, sigma 1.5), composite on white, whole frame"),
    "novel_psnr_masked": (
        "dB",
        f"{_HELD}: PSNR of sRGB pictures over pixels with true coverage >= {m.MASK}",
    ),
    "novel_mask_iou": ("", f"{_HELD}: intersection over union of the coverages, both >= .5"),
}


def load_collection_truth(folder: str | Path) -> Truth:
    """The truth of a synthetic collection as `evaluate.truth.Truth`. Raises UserError where it is
    not complete."""
    from relit.asset.asset import read_bounded_json, read_cameras

    folder = Path(folder)
    file = folder / "truth" / "truth.json"
    if not file.is_file():
        raise UserError(
            "the folder holds no complete truth",
            fix=f"make one with `relit synthesize collection`: {folder}",
        )
    meta = read_bounded_json(file)
    cameras = {
        camera_key(name): camera for name, camera in read_cameras(folder / "truth" / "cameras.json")
    }
    train, test = ({n: cameras[n] for n in meta[split]} for split in ("train", "test"))
    return Truth(folder, train, test, float(meta["sphere"]["radius"]), meta)


def evaluate_collection(
    run_or_asset: str | Path, truth_folder: str | Path, *, spp: int = 256, seed: int = 0
) -> dict[str, Any]:
    """Every figure of the module. Call `relit.device.use_device` first. Returns as
    `dispatch.evaluate`."""
    from relit.asset.asset import load_asset

    truth, asset = load_collection_truth(truth_folder), load_asset(run_or_asset)
    return evaluate_collection_asset(asset, truth, spp=spp, seed=seed)


def evaluate_collection_asset(
    asset: Asset, truth: Truth, *, spp: int = 256, seed: int = 0
) -> dict[str, Any]:
    """As `evaluate_collection`, for an asset in memory."""
    from relit.reference.mitsuba_scene import build_scene

    check_lights(asset)
    found = {
        camera_key(name): (camera, light)
        for (name, camera), light in zip(asset.cameras, asset.lights, strict=True)
    }
    values, world_from_found, per_view = camera_pose_figures(
        {n: c for n, (c, _) in found.items()}, truth.train, truth.test
    )
    for i, name in enumerate(n for n in truth.test if n in found):
        per_view.setdefault(name, {}).update(
            picture_figures(asset, *found[name], truth.picture(f"test/{name}"), spp, seed + i)
        )
    placed = replace(asset, world_from_asset=onto_surface(asset, world_from_found, truth))
    scene = build_scene(
        placed.mesh, placed.material, placed.world_from_asset, np.ones((8, 16, 3), np.float32)
    )
    scale = fixed_albedo_scale(scene, truth)
    for name, camera in truth.test.items():
        per_view.setdefault(name, {}).update(material_figures(scene, camera, truth, name, scale))
    values.update(view_means(per_view))
    values.update(chamfer_figures(placed.mesh, placed.world_from_asset, truth))
    metrics = entries(values, {**definitions.DEFINITIONS, **DEFINITIONS})
    return {
        "metrics": metrics,
        "per_view": per_view,
        "albedo_scale": [float(x) for x in scale],
        "alignment": "sim3",
    }


def check_lights(asset: Asset) -> None:
    """Raises UserError for an asset that is of no collection."""
    if not asset.lights:
        why = "the photos were taken under different lights; only a collection's asset holds the light of each"
        raise UserError(
            "the asset has no light for each photo", why, "reconstruct with --capture collection"
        )


def camera_pose_figures(
    found: dict[str, Camera],
    train: dict[str, Camera],
    test: dict[str, Camera],
    centre=(0.0, 0.0, 0.0),
) -> tuple[dict[str, float], np.ndarray, dict[str, dict[str, float]]]:
    """(figures, world_from_found (4, 4), per held-out view figures). train, test: true cameras.
    centre: (3,) of the object in their frame. Focal lengths are compared in widths of the
    picture."""
    names = [n for n in train if n in found]
    if len(names) < 3:
        raise UserError(
            "fewer than 3 recovered cameras have the name of a true one",
            "the asset was made from other photos",
        )
    a = np.array([found[n].world_from_camera for n in names])
    b = np.array([train[n].world_from_camera for n in names])
    angle, distance = camera_errors(a, b)
    good = angle <= max(3 * float(np.median(angle)), 1.0)
    world_from_found = align_poses(a[good], b[good])
    away = float(np.mean(np.linalg.norm(b[:, :3, 3] - np.asarray(centre), axis=1)))
    focal = [abs(found[n].fx / found[n].width * train[n].width / train[n].fx - 1) for n in names]
    values = {
        "rotation_mean": float(angle.mean()),
        "rotation_median": float(np.median(angle)),
        "rotation_within_10": float(100 * (angle < WITHIN).mean()),
        "translation_percent": float(100 * distance.mean() / away),
        "focal_percent": float(100 * np.mean(focal)),
    }
    per_view = {}
    for n in (n for n in test if n in found):
        moved = move_pose(world_from_found, found[n].world_from_camera)
        per_view[n] = {
            "held_out_rotation": rotation_angle(moved[:3, :3].T @ test[n].world_from_camera[:3, :3])
        }
    return values, world_from_found, per_view


def onto_surface(
    asset: Asset, world_from_found: np.ndarray, truth: Truth, rounds: int = 40, count: int = 6000
) -> np.ndarray:
    """world_from_asset (4, 4): the similarity that brings the recovered surface onto the true one,
    by iterated closest points (Besl & McKay 1992) from the rotation that the cameras give. Camera
    centres leave size and place as open as the focal lengths are."""
    import trimesh
    from scipy.spatial import cKDTree

    loaded = trimesh.load(truth.folder / "truth" / "mesh.ply", process=False)
    target = m.sample_surface(
        np.asarray(loaded.vertices, np.float64), np.asarray(loaded.faces), 10 * count, seed=1
    ).points
    found = move_points(asset.world_from_asset, asset.mesh.vertices)
    source = m.sample_surface(found, asset.mesh.faces, count, seed=0).points
    rotation = nearest_rotation(world_from_found[:3, :3])
    scale = np.sqrt(target.var(0).sum() / source.var(0).sum())
    placed = similarity(rotation, target.mean(0) - scale * rotation @ source.mean(0), scale)
    tree = cKDTree(target)
    for _ in range(rounds):
        moved = move_points(placed, source)
        distance, index = tree.query(moved)
        near = distance <= np.quantile(distance, 0.9)
        placed = umeyama(source[near], target[index[near]])
    return placed @ asset.world_from_asset


def picture_figures(
    asset: Asset, camera: Camera, light: np.ndarray, reference: np.ndarray, spp: int, seed: int
) -> dict[str, float]:
    """A held-out photo: the asset under the light fitted to it, against the true linear RGBA (H, W,
    4), premultiplied on black."""
    from relit.reference.mitsuba_scene import build_scene, render

    height, width = reference.shape[:2]
    scene = build_scene(asset.mesh, asset.material, asset.world_from_asset, light)
    shown = render(scene, camera.resized(width, height), spp=spp, seed=seed)
    a, b = on_white(shown), on_white(reference)
    inside = reference[..., 3] >= m.MASK
    return {
        "novel_psnr": m.psnr(a, b),
        "novel_ssim": float(m.ssim_map(a, b).mean()),
        "novel_psnr_masked": m.psnr(m.encode(shown[..., :3]), m.encode(reference[..., :3]), inside),
        "novel_mask_iou": m.mask_iou(shown[..., 3], reference[..., 3]),
    }


def on_white(rgba: np.ndarray) -> np.ndarray:
    """Premultiplied linear (H, W, 4) -> sRGB picture (H, W, 3) composite on white in linear values,
    clipped to [0, 1]."""
    return m.encode(rgba[..., :3] + (1 - np.clip(rgba[..., 3:], 0, 1)))

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

from relit.conventions import move_points, similarity
from relit.errors import UserError
from relit.evaluate import definitions as common
from relit.evaluate import metrics as m
from relit.evaluate.alignment import LOST, align_centres, angles_between, turned_cameras
from relit.evaluate.baselines import Baselines, Constants, chance, random_rotations
from relit.evaluate.lpips import Lpips
from relit.evaluate.multiview import fixed_albedo_scale, material_figures, relit_figures
from relit.evaluate.picture_figures import Draw
from relit.evaluate.results import entries, view_means
from relit.evaluate.surfaces import chamfer_figures
from relit.evaluate.truth import Truth, camera_key, ceiling_of
from relit.geometry.se3 import align_cameras, nearest_rotation, umeyama
from relit.scene import Asset, Camera

WITHIN = 10.0  # degrees
_POSE = (
    "after the best similarity between the CENTRES of recovered and true training cameras "
    "(Procrustes, without those more than 3 medians off), which sees no orientation"
)
_HELD = "held-out photos from the camera and under the light that were fitted to them with shape and material frozen"
_WHITE = "sRGB pictures composite on white, each by its own coverage, whole frame"
DEFINITIONS = {
    "cameras": ("%", "share of the training photos that have a camera"),
    "rotation_mean": (
        "degrees",
        f"mean rotation error of the training cameras that were found, {_POSE}",
    ),
    "rotation_median": (
        "degrees",
        f"median rotation error over ALL training photos, one without a camera counts {LOST:g} degrees, {_POSE}",
    ),
    "rotation_within_10": (
        "%",
        f"share of all training photos whose camera's rotation error is below {WITHIN:g} degrees, {_POSE}",
    ),
    "translation_percent": (
        "%",
        f"mean distance of the camera centres, in per cent of the mean distance from the object, {_POSE}",
    ),
    "focal_percent": ("%", "mean error of the focal lengths of the training cameras"),
    "held_out_rotation": ("degrees", f"mean rotation error of the held-out cameras, {_POSE}"),
    "novel_psnr": ("dB", f"{_HELD}: PSNR of {_WHITE}"),
    "novel_ssim": ("", f"{_HELD}: SSIM (Gaussian 11 x 11, sigma 1.5) of {_WHITE}"),
    "novel_lpips": ("", f"{_HELD}: LPIPS by the network of --lpips of {_WHITE}"),
    "novel_psnr_masked": (
        "dB",
        f"{_HELD}: PSNR of sRGB pictures over pixels with true coverage >= {m.MASK}",
    ),
    "novel_ssim_masked": (
        "",
        f"{_HELD}: the SSIM map of sRGB pictures on white, over pixels with true coverage >= {m.MASK}",
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
    run_or_asset: str | Path,
    truth_folder: str | Path,
    *,
    spp: int = 256,
    seed: int = 0,
    lpips: Lpips | None = None,
) -> dict[str, Any]:
    """Every figure of the module. Call `relit.device.use_device` first. Returns as
    `dispatch.evaluate`."""
    from relit.asset.asset import load_asset

    truth, asset = load_collection_truth(truth_folder), load_asset(run_or_asset)
    return evaluate_collection_asset(asset, truth, spp=spp, seed=seed, lpips=lpips)


def evaluate_collection_asset(
    asset: Asset, truth: Truth, *, spp: int = 256, seed: int = 0, lpips: Lpips | None = None
) -> dict[str, Any]:
    """As `evaluate_collection`, for an asset in memory."""
    from relit.reference.mitsuba_scene import build_scene

    draw, constants = Draw(spp, seed, lpips), Constants()
    found = cameras_and_lights(asset)
    cameras = {n: c for n, (c, _) in found.items()}
    values, per_view = camera_pose_figures(cameras, truth.train, truth.test)
    baselines = camera_chance(cameras, truth.train, truth.test)
    for i, name in enumerate(n for n in truth.test if n in found):
        per_view.setdefault(name, {}).update(
            picture_figures_on_white(
                asset, *found[name], truth.picture(f"test/{name}"), replace(draw, seed=seed + i)
            )
        )
    names = [n for n in truth.train if n in found]
    oriented = align_cameras(poses_of(cameras, names), poses_of(truth.train, names))
    placed = replace(asset, world_from_asset=onto_surface(asset, oriented, truth))
    scene = build_scene(
        placed.mesh, placed.material, placed.world_from_asset, np.ones((8, 16, 3), np.float32)
    )
    scale = fixed_albedo_scale(scene, truth)
    for name, camera in truth.test.items():
        per_view.setdefault(name, {}).update(
            material_figures(scene, camera, truth, name, scale, constants)
        )
    for name, figures in relit_figures(placed, truth, scale, draw).items():
        per_view[name] |= figures
    values.update(view_means(per_view))
    values.update(chamfer_figures(placed.mesh, placed.world_from_asset, truth))
    return {
        "metrics": entries(
            values,
            {**common.DEFINITIONS, **DEFINITIONS},
            baselines | constants.baselines(),
        ),
        "ceiling": ceiling_of(truth.folder),
        "per_view": per_view,
        "albedo_scale": [float(x) for x in scale],
        "alignment": "sim3",
    }


def cameras_and_lights(asset: Asset) -> dict[str, tuple[Camera, np.ndarray]]:
    """Name without folder and extension -> (camera, light) of each photo. Raises UserError for an
    asset that is of no collection."""
    check_lights(asset)
    return {
        camera_key(name): (camera, light)
        for (name, camera), light in zip(asset.cameras, asset.lights, strict=True)
    }


def poses_of(cameras: dict[str, Camera], names: list[str]) -> np.ndarray:
    """(N, 4, 4) world_from_camera."""
    return np.array([cameras[n].world_from_camera for n in names])


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
) -> tuple[dict[str, float], dict[str, dict[str, float]]]:
    """(figures, per held-out view figures). train, test: true cameras, train of all photos that
    were to be given a camera. centre: (3,) of the object in their frame. Focal lengths are compared
    in widths of the picture."""
    names = [n for n in train if n in found]
    if len(names) < 3:
        raise UserError(
            "fewer than 3 recovered cameras have the name of a true one",
            "the asset was made from other photos",
        )
    a, b = poses_of(found, names), poses_of(train, names)
    world_from_found = align_centres(a[:, :3, 3], b[:, :3, 3])
    turn = nearest_rotation(world_from_found[:3, :3])
    angle = angles_between(turn @ a[:, :3, :3], b[:, :3, :3])
    distance = np.linalg.norm(move_points(world_from_found, a[:, :3, 3]) - b[:, :3, 3], axis=1)
    everyone = np.append(angle, np.full(len(train) - len(names), LOST))
    away = float(np.mean(np.linalg.norm(b[:, :3, 3] - np.asarray(centre), axis=1)))
    focal = [abs(found[n].fx / found[n].width * train[n].width / train[n].fx - 1) for n in names]
    values = {
        "cameras": 100 * len(names) / len(train),
        "rotation_mean": float(angle.mean()),
        "rotation_median": float(np.median(everyone)),
        "rotation_within_10": float(100 * (everyone < WITHIN).mean()),
        "translation_percent": float(100 * distance.mean() / away),
        "focal_percent": float(100 * np.mean(focal)),
    }
    per_view = {}
    for n in (n for n in test if n in found):
        r = turn @ found[n].world_from_camera[:3, :3]
        error = float(angles_between(r, test[n].world_from_camera[:3, :3]))
        per_view[n] = {"held_out_rotation": error}
    return values, per_view


def camera_chance(
    found: dict[str, Camera],
    train: dict[str, Camera],
    test: dict[str, Camera],
    centre=(0.0, 0.0, 0.0),
) -> Baselines:
    """What true cameras that are each turned at random about the object score under
    `camera_pose_figures`."""
    both = {n: c for n, c in {**train, **test}.items() if n in found}

    def drawn(rng: np.random.Generator) -> dict[str, float]:
        turned = turned_cameras(centre, both, random_rotations(len(both), rng))
        values, per_view = camera_pose_figures(turned, train, test, centre)
        del values["focal_percent"], values["cameras"]
        return values | view_means(per_view)

    return chance(drawn)


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


def picture_figures_on_white(
    asset: Asset, camera: Camera, light: np.ndarray, reference: np.ndarray, draw: Draw
) -> dict[str, float]:
    """A held-out photo: the asset under the light fitted to it, against the true linear RGBA (H, W,
    4), premultiplied on black."""
    shown = shown_under(asset, camera, light, reference.shape[:2], draw)
    a, b = on_white(shown), on_white(reference)
    inside = reference[..., 3] >= m.MASK
    s = m.ssim_map(a, b)
    out = {
        "novel_psnr": m.psnr(a, b),
        "novel_ssim": float(s.mean()),
        "novel_psnr_masked": m.psnr(m.encode(shown[..., :3]), m.encode(reference[..., :3]), inside),
        "novel_ssim_masked": float(s[inside].mean()) if inside.any() else float("nan"),
        "novel_mask_iou": m.mask_iou(shown[..., 3], reference[..., 3]),
    }
    return out if draw.lpips is None else out | {"novel_lpips": draw.lpips(a, b)}


def shown_under(
    asset: Asset, camera: Camera, light: np.ndarray, size: tuple[int, ...], draw: Draw
) -> np.ndarray:
    """(H, W, 4) linear, premultiplied on black, of size (H, W): the asset under a light."""
    from relit.reference.mitsuba_scene import build_scene, render

    scene = build_scene(asset.mesh, asset.material, asset.world_from_asset, light)
    return render(scene, camera.resized(size[1], size[0]), spp=draw.spp, seed=draw.seed)


def on_white(rgba: np.ndarray) -> np.ndarray:
    """Premultiplied linear (H, W, 4) -> sRGB picture (H, W, 3) composite on white in linear values,
    clipped to [0, 1]."""
    return m.encode(rgba[..., :3] + (1 - np.clip(rgba[..., 3:], 0, 1)))

"""SAMURAI's figures: Boss et al. 2022, Sec. 4 and supplement. Its release computes none; pictures
are composed as its model composes them (and Neural-PIL's before it): sRGB values times the coverage,
white where it is missing; SSIM as TensorFlow's, over pixels whose window lies in the frame.

Cameras: Procrustes on the CENTRES of all training cameras, mean rotation error, mean distance in
units of the reference scene. Held-out photos have their own fitted camera and light.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from relit.conventions import move_points
from relit.errors import UserError
from relit.evaluate import metrics as m
from relit.evaluate.alignment import align_centres, angles_between, turned_cameras
from relit.evaluate.baselines import Baselines, chance, random_rotations
from relit.evaluate.collection import (
    cameras_and_lights,
    load_collection_truth,
    poses_of,
    shown_under,
)
from relit.evaluate.lpips import Lpips
from relit.evaluate.picture_figures import Draw
from relit.evaluate.results import PaperValue, entries, view_means
from relit.evaluate.truth import camera_key, truth_kind
from relit.geometry.se3 import nearest_rotation
from relit.scene import Asset, Camera

KINDS = ("collection",)
MEASURES = "collections with held-out photos or true cameras"
_HELD = (
    "held-out photos from the camera and under the light fitted to them: sRGB pictures times their "
    "coverage on white, whole frame"
)
_POSE = "after Procrustes on the centres of all training cameras that were found"
DEFINITIONS: dict[str, tuple[str, str]] = {
    "novel_psnr": ("dB", f"{_HELD}: PSNR; mean over photos"),
    "novel_ssim": (
        "",
        f"{_HELD}: SSIM (Gaussian 11 x 11, sigma 1.5), without the 5 pixels at the frame's edges",
    ),
    "novel_lpips": ("", f"{_HELD}: LPIPS by the network of --lpips (the paper has none)"),
    "rotation_mean": ("degrees", f"mean rotation error, {_POSE}"),
    "translation_mean": (
        "scene units",
        f"mean distance of the centres, {_POSE}, in units of the reference cameras' frame",
    ),
    "cameras": ("%", "share of the reference cameras that were found"),
}
PAPERS = {
    "novel_psnr": PaperValue(23.46, "SAMURAI Tab. 1", note="poses unknown, its own photos"),
    "novel_ssim": PaperValue(0.90, "SAMURAI Tab. 1", note="poses unknown, its own photos"),
    "rotation_mean": PaperValue(
        0.86, "SAMURAI Tab. 1", note="five posed sets; NAVI in the wild 26.2"
    ),
    "translation_mean": PaperValue(
        8.61, "SAMURAI Tab. 1", note="units of its five reference scenes"
    ),
}


def on_white_encoded(rgba) -> np.ndarray:
    """Premultiplied linear (H, W, 4) -> the object's own colour in sRGB times coverage, on white."""
    alpha = np.clip(rgba[..., 3:], 0, 1)
    own = m.encode(rgba[..., :3] / np.maximum(alpha, 1e-6))
    return own * alpha + 1 - alpha


def samurai_picture_scores(shown, truth, lpips: Lpips | None = None) -> dict[str, float]:
    """Of premultiplied linear pictures (H, W, 4)."""
    a, b, edge = on_white_encoded(shown), on_white_encoded(truth), m.SSIM_RADIUS
    out = {
        "novel_psnr": m.psnr(a, b),
        "novel_ssim": float(m.ssim_map(a, b)[edge:-edge, edge:-edge].mean()),
    }
    return out if lpips is None else out | {"novel_lpips": lpips(a, b)}


def camera_scores(found: dict[str, Camera], train: dict[str, Camera]) -> dict[str, float]:
    """Figures of the training cameras. Raises UserError for fewer than 3, or centres on a line."""
    names = [n for n in train if n in found]
    a, b = poses_of(found, names), poses_of(train, names)
    world_from_found = align_centres(a[:, :3, 3], b[:, :3, 3], robust=False)
    turn = nearest_rotation(world_from_found[:3, :3])
    distance = np.linalg.norm(move_points(world_from_found, a[:, :3, 3]) - b[:, :3, 3], axis=1)
    return {
        "rotation_mean": float(angles_between(turn @ a[:, :3, :3], b[:, :3, :3]).mean()),
        "translation_mean": float(distance.mean()),
        "cameras": 100 * len(names) / len(train),
    }


def camera_chance_of(
    found: dict[str, Camera], train: dict[str, Camera], centre: np.ndarray
) -> Baselines:
    """Of true cameras that are each turned at random about the object."""
    known = {n: c for n, c in train.items() if n in found}

    def drawn(rng: np.random.Generator) -> dict[str, float]:
        turned = turned_cameras(centre, known, random_rotations(len(known), rng))
        scores = camera_scores(turned, known)
        return {k: scores[k] for k in ("rotation_mean", "translation_mean")}

    return chance(drawn)


def evaluate_by_protocol(run: Path, folder: Path, draw: Draw) -> dict[str, Any]:
    """Every figure of DEFINITIONS that the truth or the photos allow. Raises UserError where there
    is neither a held-out photo nor a true camera."""
    from relit.asset.asset import load_asset

    asset = load_asset(run)
    if truth_kind(folder) == "collection":
        truth, found = load_collection_truth(folder), cameras_and_lights(asset)
        train, centre = truth.train, np.zeros(3)
        held = {n: truth.picture(f"test/{n}") for n in truth.test if n in found}
    else:
        found, train, centre, held = _photos(asset, folder, run)
    cameras = {n: c for n, (c, _) in found.items()}
    values: dict[str, float] = {}
    baselines: Baselines = {}
    if sum(n in cameras for n in train) >= 3:
        values = camera_scores(cameras, train)
        baselines = camera_chance_of(cameras, train, centre)
    elif not held:
        raise UserError(
            "there is nothing to measure this collection by",
            "no photo was set aside when it was reconstructed, and the folder holds no true cameras",
            "reconstruct again with --set holdout=16: every 16th photo is kept for testing",
        )
    per_view = {}
    for i, (name, reference) in enumerate(held.items()):
        one = replace(draw, seed=draw.seed + i)
        shown = shown_under(asset, *found[name], reference.shape[:2], one)
        per_view[name] = samurai_picture_scores(shown, reference, draw.lpips)
    values |= view_means(per_view)
    return {"metrics": entries(values, DEFINITIONS, baselines, PAPERS), "per_view": per_view}


def _photos(asset: Asset, folder: Path, run: Path):
    """(cameras and lights, true training cameras, the object's middle, held-out pictures) of a
    collection of photographs."""
    from relit.evaluate.collection_photos import middle_of, reference_of, true_cameras
    from relit.evaluate.photos import capture_of

    found, capture = cameras_and_lights(asset), capture_of(folder, run)
    photos = {camera_key(p.name): p for p in (*capture.photos, *capture.held_out)}
    aside = {camera_key(n) for n in asset.meta.get("held_out", ())}
    held = {n: reference_of(photos[n])[0] for n in aside if n in found and n in photos}
    known = {camera_key(n): c for n, c in true_cameras(capture)[0].items()}
    train = {n: c for n, c in known.items() if n not in aside}
    return found, train, middle_of(train) if train else np.zeros(3), held

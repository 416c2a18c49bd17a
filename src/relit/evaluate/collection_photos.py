"""What is measured on the asset of a collection against photographs: held-out photos, and the
cameras where the capture knows them.

The truth is the capture itself. A held-out photo (`--set holdout=16`, held_out.json) has its own
camera and light in the asset, fitted with shape and material frozen; cameras are compared after
Procrustes, whichever file they stand in.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from relit.capture.readers import llff
from relit.errors import UserError
from relit.evaluate.baselines import Baselines
from relit.evaluate.collection import (
    DEFINITIONS,
    camera_chance,
    camera_pose_figures,
    check_lights,
    picture_figures_on_white,
)
from relit.evaluate.lpips import Lpips
from relit.evaluate.photos import SIDE, capture_of, shrunk_to_camera
from relit.evaluate.picture_figures import Draw
from relit.evaluate.results import entries
from relit.masks.grabcut import centre_cut
from relit.scene import Asset, Camera, Capture, Photo


def evaluate_on_collection(
    asset: Asset,
    folder: Path,
    *,
    run: Path | None = None,
    spp: int = 256,
    seed: int = 0,
    lpips: Lpips | None = None,
) -> dict[str, Any]:
    """The figures of an asset against the photos that it was made from. run: the run folder, whose
    settings say how they were read.

    Returns as `dispatch.evaluate`. Raises UserError when no photo was set aside and no true camera
    is known.
    """
    check_lights(asset)
    capture = capture_of(folder, run)
    photos = {p.name: p for p in (*capture.photos, *capture.held_out)}
    found = {
        name: (camera, light)
        for (name, camera), light in zip(asset.cameras, asset.lights, strict=True)
    }
    if not set(found) & set(photos):
        why = f"the asset's: {', '.join(list(found)[:3])} ...; the folder's: {', '.join(list(photos)[:3])} ..."
        raise UserError(
            "none of the asset's photos is in the folder",
            why,
            f"give the folder that the run was made from: {folder}",
        )
    held = [name for name in asset.meta.get("held_out", ()) if name in found and name in photos]
    truth, source = true_cameras(capture)
    aside = set(asset.meta.get("held_out", ()))
    train = {n: camera for n, camera in truth.items() if n in photos and n not in aside}
    posed = sum(n in found for n in train)
    if not held and posed < 3:
        raise UserError(
            "there is nothing to measure this collection by",
            "no photo was set aside when it was reconstructed, and the folder holds no true cameras",
            f"reconstruct again with --set holdout=16 (every 16th photo is kept for testing), or put a poses_bounds.npy into: {folder}",
        )
    values: dict[str, float] = {}
    per_view: dict[str, dict[str, float]] = {name: {} for name in held}
    notes: dict[str, str] = {}
    baselines: Baselines = {}
    if posed >= 3:
        test = {name: truth[name] for name in held if name in truth}
        cameras, middle = {n: c for n, (c, _) in found.items()}, middle_of(train)
        values, turned = camera_pose_figures(cameras, train, test, middle)
        baselines = camera_chance(cameras, train, test, middle)
        for name, figures in turned.items():
            per_view[name].update(figures)
        notes = dict.fromkeys(
            [*values, "held_out_rotation"],
            f"; the capture's own cameras ({source}) stand for the true ones",
        )
    guessed = 0
    for i, name in enumerate(held):
        reference, cut = reference_of(photos[name])
        guessed += cut
        one = Draw(spp, seed + i, lpips)
        per_view[name].update(picture_figures_on_white(asset, *found[name], reference, one))
    masks = f", {guessed} of {len(held)} guessed by GrabCut as the fit does" if guessed else ""
    for key in (k for k in DEFINITIONS if k.startswith("novel_")):
        notes[key] = (
            f"; photos shrunk to at most {SIDE} pixels a side, their masks for the true coverage{masks}"
        )
    for key in sorted({k for figures in per_view.values() for k in figures}):
        values[key] = float(
            np.nanmean([figures[key] for figures in per_view.values() if key in figures])
        )
    noted = {
        name: (unit, text + notes.get(name, ""))
        for name, (unit, text) in DEFINITIONS.items()
        if name in values
    }
    return {
        "metrics": entries(values, noted, baselines),
        "per_view": per_view,
        "photos": len(held),
        "alignment": "sim3",
    }


def true_cameras(capture: Capture) -> tuple[dict[str, Camera], str]:
    """Cameras by the photos' names and where they come from: the capture's own, else those of a
    poses_bounds.npy that lies beside hints; ({}, '') where there are none. Raises UserError for a
    poses_bounds.npy that is not of these photos."""
    own = {p.name: p.camera for p in (*capture.photos, *capture.held_out) if p.camera is not None}
    if own:
        return own, capture.format
    file = llff.recognise(capture.root)  # quadrants.json goes before it when a folder is read
    return (
        ({}, "")
        if file is None
        else ({f.name: f.camera for f in llff.read(capture.root, file).frames}, file.name)
    )


def middle_of(cameras: dict[str, Camera]) -> np.ndarray:
    """(3,) the point nearest to the axes of all cameras: where the object is that they look at."""
    left, right = np.zeros((3, 3)), np.zeros(3)
    for camera in cameras.values():
        axis = np.asarray(camera.world_from_camera)[:3, 2]
        across = np.eye(3) - np.outer(axis, axis)
        left, right = left + across, right + across @ camera.centre
    return np.linalg.lstsq(left, right, rcond=None)[0]


def reference_of(photo: Photo) -> tuple[np.ndarray, bool]:
    """The photo as (H, W, 4) linear, premultiplied by its mask on black, at most SIDE pixels a
    side; and whether the mask is a guess."""
    pixels = photo.load()
    factor = min(1.0, SIDE / max(photo.width, photo.height))
    size = Camera(
        max(1, round(photo.width * factor)),
        max(1, round(photo.height * factor)),
        1.0,
        1.0,
        0.0,
        0.0,
        np.eye(4),
    )
    rgb, mask = shrunk_to_camera(pixels.rgb, size), shrunk_to_camera(pixels.mask, size)
    guessed = mask is None
    mask = np.clip(centre_cut(rgb) if guessed else mask, 0, 1)[..., None].astype(np.float32)
    return np.concatenate([rgb * mask, mask], -1), guessed

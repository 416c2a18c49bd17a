"""Figures of poses alone, from the stage `poses` of a run that `relit reconstruct --until poses`
stopped after: no material is fitted.

Of a pile: an instance counts as WRONG where its rotation error is large AND the true object, drawn
at the recovered pose, differs from itself at the true one (`evaluate.pose_truth`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from relit.errors import UserError
from relit.evaluate.alignment import LOST, angles_between
from relit.evaluate.collection import DEFINITIONS as COLLECTION
from relit.evaluate.collection import camera_pose_figures, load_collection_truth
from relit.evaluate.lpips import Lpips
from relit.evaluate.pile_alignment import object_turn
from relit.evaluate.pile_views import PileTruth, load_pile_truth
from relit.evaluate.pose_truth import NOISE, PoseJudge, SeenInstance
from relit.evaluate.results import entries
from relit.files import load_arrays, read_json
from relit.geometry.se3 import nearest_rotation
from relit.scene import Camera

TURNED = 10.0  # degrees of rotation error within which a pose is right
UNCERTAIN = 0.5  # stated chance of being wrong from which on a pose counts as called uncertain
MARGIN = 0.1  # of an instance's window around it, as a share of its longer side
SURE = "called sure (registered, stated chance of being wrong below 50 %)"
DEFINITIONS: dict[str, tuple[str, str]] = {
    "rotation_median": (
        "degrees",
        "median rotation error over the instances whose pose the photo determines (the true object at all rival poses differs by more "
        f"than {NOISE:g} of its pixels), after the one turn of the frame that fits best; one that is not registered counts {LOST:g}",
    ),
    "rotation_90": ("degrees", "as rotation_median, the 90th percentile"),
    "determined": ("%", "share of the instances whose pose the photo determines"),
    "determined_sure": ("%", f"share of the determined instances that are {SURE}"),
    "undetermined_unsure": ("%", f"share of the others that are NOT {SURE}"),
    "wrong_sure": (
        "%",
        f"share of all instances that are {SURE} and yet wrong: off by more than {TURNED:g} degrees, where the true object looks different",
    ),
    "wrong": ("%", "share of all instances that are wrong or not registered"),
    "stated_wrong": ("%", "mean stated chance of being wrong, over the registered instances"),
    "seconds_poses": ("s", "wall time of the stage `poses`"),
    **{name: COLLECTION[name] for name in ("rotation_mean", "rotation_within_10")},
    **{name: COLLECTION[name] for name in ("translation_percent", "focal_percent")},
}


@dataclass(frozen=True)
class FoundPile:
    """What the stage has kept. poses: label -> object_from_camera (4, 4) of registered instances.
    chances: label -> stated chance of being wrong, NaN where it was not asked."""

    poses: dict[int, np.ndarray]
    chances: dict[int, float]


def evaluate_registration(
    run: str | Path,
    truth_folder: str | Path,
    *,
    spp: int = 8,
    seed: int = 0,
    lpips: Lpips | None = None,
) -> dict[str, Any]:
    """Figures of a pile or of a collection, as `evaluate.dispatch.evaluate`. spp and lpips stand
    for the call's shape. Raises UserError where the run has no finished stage `poses`."""
    del spp, lpips
    folder, truth_folder = Path(run) / "stages" / "poses", Path(truth_folder)
    if not (folder / "DONE").is_file():
        fix = f"run `relit reconstruct --until poses` first: {run}"
        raise UserError("the run has not found poses", fix=fix)
    arrays = load_arrays(folder / "result.npz")
    if (truth_folder / "transforms_train.json").is_file():
        values, views = pile_figures(found_pile(arrays), load_pile_truth(truth_folder), seed)
    else:
        values, views = collection_figures(arrays, truth_folder), {}
    values["seconds_poses"] = float((read_json(folder / "DONE") or {}).get("seconds", np.nan))
    return {"metrics": entries(values, DEFINITIONS), "per_view": views}


def found_pile(arrays: dict[str, np.ndarray]) -> FoundPile:
    """The instances of the first photo."""
    poses, chances = {}, {}
    for i in range(int(arrays["ids.#"])):
        label = int(arrays[f"ids.{i}.label"])
        if int(arrays[f"ids.{i}.photo"]) == 0 and arrays["registered"][i]:
            poses[label], chances[label] = arrays["poses"][i], float(arrays["chances"][i])
    return FoundPile(poses, chances)


def pile_figures(
    found: FoundPile, truth: PileTruth, seed: int
) -> tuple[dict[str, float], dict[str, dict[str, float]]]:
    """(figures, per instance figures)."""
    judge, seen = true_judge(truth), seen_instances(truth)
    photo = truth.photo.world_from_camera
    ours = {k: photo @ np.linalg.inv(p) for k, p in found.poses.items() if k in truth.poses}
    turn = object_turn(ours, truth.poses)
    rows: dict[str, dict[str, float]] = {}
    for label, one in seen.items():
        true = nearest_rotation(one.world_from_object[:3, :3])
        row = {"determined": float(judge.determined(one, seed)), "error": LOST, "differs": 1.0}
        if label in ours:
            placed = nearest_rotation(ours[label][:3, :3]) @ turn
            row["error"] = float(angles_between(true, placed))
            row["differs"] = judge.difference(one, true.T @ placed)
            row["chance"] = found.chances[label]
        rows[str(label)] = row
    return summary(rows), rows


def summary(rows: dict[str, dict[str, float]]) -> dict[str, float]:
    """The figures of a pile from those of its instances: determined, error, differs, and chance of
    those that are registered."""
    error = np.array([r["error"] for r in rows.values()])
    determined = np.array([r["determined"] > 0 for r in rows.values()])
    registered = np.array(["chance" in r for r in rows.values()])
    chance = np.array([r.get("chance", 1.0) for r in rows.values()])
    sure = registered & ~(chance >= UNCERTAIN)
    differs = np.array([r["differs"] > NOISE for r in rows.values()])
    wrong = ~registered | ((error > TURNED) & differs)
    out = {
        "determined": 100 * determined.mean(),
        "wrong_sure": 100 * (wrong & sure).mean(),
        "wrong": 100 * wrong.mean(),
    }
    if determined.any():
        out["rotation_median"] = np.median(error[determined])
        out["rotation_90"] = np.quantile(error[determined], 0.9)
        out["determined_sure"] = 100 * sure[determined].mean()
    if not determined.all():
        out["undetermined_unsure"] = 100 * (~sure[~determined]).mean()
    if np.isfinite(chance[registered]).any():
        out["stated_wrong"] = 100 * np.nanmean(chance[registered])
    return {name: float(value) for name, value in out.items()}


def true_judge(truth: PileTruth) -> PoseJudge:
    """Draws the true object, as the settings of the capture name it."""
    from relit.asset.gltf import read_asset_file
    from relit.reference.mitsuba_scene import build_scene

    file = truth.folder / "truth" / "object.glb"
    if not file.is_file():
        raise UserError(f"no true object at: {file}", fix="make the capture again")
    mesh, material = read_asset_file(file)
    return PoseJudge(build_scene(mesh, material, np.eye(4), None), mesh.vertices, mesh.faces)


def seen_instances(truth: PileTruth) -> dict[int, SeenInstance]:
    """label -> the instance in its window of the first photo."""
    from relit.images import read_data

    file = truth.folder / "train" / "000_instance_seg.png"
    labels = np.round(read_data(file) * 255).astype(int)
    labels = labels if labels.ndim == 2 else labels[..., 0]
    out = {}
    for label, pose in truth.poses.items():
        own = labels == label
        if own.any():
            camera, rows, columns = window_of(own, truth.photo)
            there = labels[rows, columns]
            out[label] = SeenInstance(camera, pose, (there == label) | (there == 0))
    return out


def window_of(own: np.ndarray, camera: Camera) -> tuple[Camera, slice, slice]:
    """(camera of the window, its rows, its columns) around the pixels (H, W) bool of an instance."""
    rows, columns = np.flatnonzero(own.any(1)), np.flatnonzero(own.any(0))
    grow = round(MARGIN * max(np.ptp(rows), np.ptp(columns))) + 2
    top, left = max(rows[0] - grow, 0), max(columns[0] - grow, 0)
    bottom = min(rows[-1] + grow + 1, own.shape[0])
    right = min(columns[-1] + grow + 1, own.shape[1])
    return (
        replace(
            camera,
            width=int(right - left),
            height=int(bottom - top),
            cx=camera.cx - left,
            cy=camera.cy - top,
        ),
        slice(top, bottom),
        slice(left, right),
    )


def collection_figures(arrays: dict[str, np.ndarray], folder: Path) -> dict[str, float]:
    """Figures of the cameras of a collection; its photos stand in the order of their names."""
    truth = load_collection_truth(folder)
    names = sorted(truth.train)
    if len(names) != len(arrays["poses"]):
        raise UserError(
            f"the run has poses of {len(arrays['poses'])} photos, the truth of {len(names)}",
            "the run is of another capture",
        )
    found = {
        name: replace(truth.train[name], fx=float(f), fy=float(f), world_from_camera=pose)
        for name, pose, f in zip(names, arrays["poses"], arrays["focals"], strict=True)
    }
    values, _ = camera_pose_figures(found, truth.train, {})
    return {name: value for name, value in values.items() if name in DEFINITIONS}

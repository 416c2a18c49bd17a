"""What is measured on a reconstructed asset where the truth is a synthetic multi-view capture.

Pictures are rendered by the same path tracer as the truth. What each figure means:
evaluate/definitions.py.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from relit.conventions import move_pose
from relit.evaluate import metrics as m
from relit.evaluate.alignment import align_named_cameras, aligned, pose_errors, turned_cameras
from relit.evaluate.baselines import Constants, chance, random_rotations
from relit.evaluate.definitions import DEFINITIONS
from relit.evaluate.environments import environment_figures
from relit.evaluate.lpips import Lpips
from relit.evaluate.picture_figures import Draw, picture_figures, prefixed
from relit.evaluate.results import entries, view_means
from relit.evaluate.surfaces import chamfer_figures
from relit.evaluate.truth import Truth, camera_key, ceiling_of
from relit.scene import Asset, Camera


def evaluate_asset(
    asset: Asset, truth: Truth, *, spp: int = 256, seed: int = 0, lpips: Lpips | None = None
) -> dict[str, Any]:
    """As `evaluate`, for an asset in memory; all but the GLB's round trip."""
    from relit.reference.mitsuba_scene import build_scene

    draw, constants = Draw(spp, seed, lpips), Constants()
    recovered = {camera_key(name): camera for name, camera in asset.cameras}
    asset, alignment = aligned(asset, truth.train, recovered)
    world_from_asset = asset.world_from_asset
    values: dict[str, float] = {}
    per_view: dict[str, dict[str, float]] = {name: {} for name in truth.test}

    scene = build_scene(asset.mesh, asset.material, world_from_asset, asset.environment)
    scale = fixed_albedo_scale(scene, truth)
    for name, camera in truth.test.items():
        per_view[name] |= material_figures(scene, camera, truth, name, scale, constants)
    if asset.environment is not None:
        for name, figures in _shown_figures(scene, truth, "test", draw).items():
            per_view[name] |= prefixed("novel", figures)
        light = truth.picture("environment")[..., :3]
        values |= environment_figures(asset.environment, light, scale, constants)
    for name, figures in relit_figures(asset, truth, scale, draw).items():
        per_view[name] |= figures
    values.update(chamfer_figures(asset.mesh, world_from_asset, truth))
    baselines = constants.baselines()
    if alignment == "sim3":
        found = {camera_key(k): c for k, c in asset.cameras}
        values |= _camera_figures(found, truth)
        baselines |= chance(lambda rng: _camera_chance(found, truth, rng))
    values = {**view_means(per_view), **values}
    return {
        "metrics": entries(values, DEFINITIONS, baselines),
        "ceiling": ceiling_of(truth.folder),
        "per_view": per_view,
        "albedo_scale": [float(x) for x in scale],
        "alignment": alignment,
    }


def relit_figures(
    asset: Asset, truth: Truth, scale: np.ndarray, draw: Draw
) -> dict[str, dict[str, float]]:
    """view -> figures under each light of the truth's `relight`, base colour scaled and, with a
    quarter of the samples, not. The asset stands in the truth's frame."""
    from relit.reference.mitsuba_scene import build_scene

    out: dict[str, dict[str, float]] = {name: {} for name in truth.test}
    base = np.clip(asset.material.base_color * scale, 0, 1).astype(np.float32)
    scaled = replace(asset.material, base_color=base)
    for light_name in truth.meta.get("relight", ()):
        light = truth.picture(f"relight/{light_name}")[..., :3]
        for material, tail, samples in (
            (scaled, "", draw),
            (asset.material, "_unscaled", draw.fewer(4)),
        ):
            scene = build_scene(asset.mesh, material, asset.world_from_asset, light)
            shown = _shown_figures(scene, truth, f"relight/{light_name}", samples)
            for name, figures in shown.items():
                out[name] |= prefixed("relit", figures, f"{tail}:{light_name}")
    return out


def _shown_figures(scene, truth: Truth, folder: str, draw: Draw) -> dict[str, dict[str, float]]:
    """view -> `picture_figures` of the scene against the truth's pictures in `folder`."""
    from relit.reference.mitsuba_scene import render

    out = {}
    for i, (name, camera) in enumerate(truth.test.items()):
        shown = render(scene, camera, spp=draw.spp, seed=draw.seed + i)[..., :3]
        reference = truth.picture(f"{folder}/{name}")
        inside = reference[..., 3] >= m.MASK
        out[name] = picture_figures(shown, reference[..., :3], inside, draw.lpips)
    return out


def _camera_figures(cameras: dict[str, Camera], truth: Truth) -> dict[str, float]:
    """Of cameras that stand in the truth's frame."""
    rotations, distances = pose_errors(cameras, truth.train, np.eye(4))
    return {
        "cameras": 100 * len(rotations) / len(truth.train),
        "camera_rotation": float(np.median(rotations)),
        "camera_centre_percent": float(100 * np.median(distances) / (2 * truth.radius)),
    }


def _camera_chance(
    found: dict[str, Camera], truth: Truth, rng: np.random.Generator
) -> dict[str, float]:
    """`_camera_figures` of true cameras that are each turned at random about the object, after the
    same alignment."""
    names = {n: truth.train[n] for n in found if n in truth.train}
    centre = truth.meta["sphere"].get("centre", (0.0, 0.0, 0.0))
    turned = turned_cameras(centre, names, random_rotations(len(names), rng))
    frame = align_named_cameras(turned, truth.train)
    moved = {n: c.with_pose(move_pose(frame, c.world_from_camera)) for n, c in turned.items()}
    values = _camera_figures(moved, truth)
    del values["cameras"]  # chance has no part in it
    return values


def fixed_albedo_scale(scene, truth: Truth) -> np.ndarray:
    """(3,) the albedo scale of the whole evaluation: over the pixels of the kept training views
    that both the truth (coverage >= MASK) and the prediction cover."""
    from relit.reference.mitsuba_scene import render_channels

    predicted, true = [], []
    for name in truth.meta["train_albedo"]:
        channels = render_channels(scene, truth.train[name], spp=16)
        reference = truth.picture(f"train_albedo/{name}")
        inside = (reference[..., 3] >= m.MASK) & (channels["alpha"] > 0)
        predicted.append(channels["albedo"][inside])
        true.append(reference[..., :3][inside])
    return m.albedo_scale(np.concatenate(predicted), np.concatenate(true))


def material_figures(
    scene, camera: Camera, truth: Truth, name: str, scale: np.ndarray, constants: Constants
) -> dict[str, float]:
    """Albedo, normal, roughness, metallic and mask figures of one test view; its truth is added to
    `constants`."""
    from relit.reference.mitsuba_scene import render_channels

    p = render_channels(scene, camera, spp=32)
    albedo, normal = truth.picture(f"test/{name}_albedo"), truth.picture(f"test/{name}_normal")
    inside = albedo[..., 3] >= m.MASK
    t, q = albedo[..., :3], p["albedo"]
    out = {}
    for key, encode, shown in (
        ("albedo_psnr", m.encode, q * scale),
        ("albedo_psnr_linear", lambda x: np.clip(x, 0, 1), q * scale),
        ("albedo_psnr_unscaled", m.encode, q),
    ):
        out[key] = m.psnr(encode(shown), encode(t), inside)
        constants.add(key, encode(t), inside)
    out["normal_mae"] = float(m.normal_angles(p["normal"], normal[..., :3])[inside].mean())
    for key in ("roughness", "metallic"):
        true = truth.picture(f"test/{name}_{key}")
        out[f"{key}_mse"] = float(np.square(p[key] - true)[inside].mean())
        constants.add(f"{key}_mse", true, inside)
    out["mask_iou"] = m.mask_iou(p["alpha"], albedo[..., 3])
    return out

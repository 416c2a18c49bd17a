"""What is measured on a reconstructed asset where the truth is a synthetic multi-view capture.

Pictures are rendered by the same path tracer as the truth. What each figure means:
evaluate/definitions.py.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from relit.evaluate import metrics as m
from relit.evaluate.alignment import aligned, pose_errors
from relit.evaluate.definitions import DEFINITIONS
from relit.evaluate.results import entries, view_means
from relit.evaluate.surfaces import chamfer_figures
from relit.evaluate.truth import Truth, camera_key
from relit.scene import Asset, Camera


def evaluate_asset(asset: Asset, truth: Truth, *, spp: int = 256, seed: int = 0) -> dict[str, Any]:
    """As `evaluate`, for an asset in memory; all but the GLB's round trip."""
    from relit.reference.mitsuba_scene import build_scene

    recovered = {camera_key(name): camera for name, camera in asset.cameras}
    asset, alignment = aligned(asset, truth.train, recovered)
    world_from_asset = asset.world_from_asset
    values: dict[str, float] = {}
    per_view: dict[str, dict[str, float]] = {name: {} for name in truth.test}

    scene = build_scene(asset.mesh, asset.material, world_from_asset, asset.environment)
    scale = fixed_albedo_scale(scene, truth)
    for name, camera in truth.test.items():
        per_view[name].update(material_figures(scene, camera, truth, name, scale))
    if asset.environment is not None:
        for i, (name, camera) in enumerate(truth.test.items()):
            per_view[name].update(
                _picture_figures(
                    "novel", scene, camera, truth.picture(f"test/{name}"), spp, seed + i
                )
            )
        light = truth.picture("environment")[..., :3]
        values["environment_mse"] = m.environment_mse(asset.environment, light)
        values["environment_mse_scaled"] = m.environment_mse(asset.environment / scale, light)
        values["environment_log_rmse"] = m.environment_log_rmse(asset.environment / scale, light)

    scaled = replace(
        asset.material,
        base_color=np.clip(asset.material.base_color * scale, 0, 1).astype(np.float32),
    )
    for light_name in truth.meta["relight"]:
        light = truth.picture(f"relight/{light_name}")[..., :3]
        for material, tail, samples in (
            (scaled, "", spp),
            (asset.material, "_unscaled", max(1, spp // 4)),
        ):
            scene = build_scene(asset.mesh, material, world_from_asset, light)
            for i, (name, camera) in enumerate(truth.test.items()):
                reference = truth.picture(f"relight/{light_name}/{name}")
                figures = _picture_figures("relit", scene, camera, reference, samples, seed + i)
                per_view[name].update(
                    {f"{key}{tail}:{light_name}": value for key, value in figures.items()}
                )

    values.update(chamfer_figures(asset.mesh, world_from_asset, truth))
    if alignment == "sim3":
        rotations, distances = pose_errors(
            {camera_key(k): c for k, c in asset.cameras}, truth.train, np.eye(4)
        )
        values["camera_rotation"] = float(np.median(rotations))
        values["camera_centre_percent"] = float(100 * np.median(distances) / (2 * truth.radius))
    values = {**view_means(per_view), **values}
    return {
        "metrics": entries(values, DEFINITIONS),
        "per_view": per_view,
        "albedo_scale": [float(x) for x in scale],
        "alignment": alignment,
    }


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
    scene, camera: Camera, truth: Truth, name: str, scale: np.ndarray
) -> dict[str, float]:
    """Albedo, normal, roughness, metallic and mask figures of one test view."""
    from relit.reference.mitsuba_scene import render_channels

    p = render_channels(scene, camera, spp=32)
    albedo, normal = truth.picture(f"test/{name}_albedo"), truth.picture(f"test/{name}_normal")
    inside = albedo[..., 3] >= m.MASK
    t, q = albedo[..., :3], p["albedo"]
    return {
        "albedo_psnr": m.psnr(m.encode(q * scale), m.encode(t), inside),
        "albedo_psnr_linear": m.psnr(np.clip(q * scale, 0, 1), np.clip(t, 0, 1), inside),
        "albedo_psnr_unscaled": m.psnr(m.encode(q), m.encode(t), inside),
        "normal_mae": float(m.normal_angles(p["normal"], normal[..., :3])[inside].mean()),
        "roughness_mse": float(
            np.square(p["roughness"] - truth.picture(f"test/{name}_roughness"))[inside].mean()
        ),
        "metallic_mse": float(
            np.square(p["metallic"] - truth.picture(f"test/{name}_metallic"))[inside].mean()
        ),
        "mask_iou": m.mask_iou(p["alpha"], albedo[..., 3]),
    }


def _picture_figures(
    prefix: str, scene, camera: Camera, reference: np.ndarray, spp: int, seed: int
) -> dict[str, float]:
    from relit.reference.mitsuba_scene import render

    a, b = (
        m.encode(render(scene, camera, spp=spp, seed=seed)[..., :3]),
        m.encode(reference[..., :3]),
    )
    inside, s = reference[..., 3] >= m.MASK, m.ssim_map(a, b)
    return {
        f"{prefix}_psnr": m.psnr(a, b),
        f"{prefix}_psnr_masked": m.psnr(a, b, inside),
        f"{prefix}_ssim": float(s.mean()),
        f"{prefix}_ssim_masked": float(s[inside].mean()) if inside.any() else float("nan"),
    }

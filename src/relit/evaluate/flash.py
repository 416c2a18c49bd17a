"""Figures of a flash capture's asset against its truth: PIR's own protocol, and inside the true
mask.

The truth is a folder that `relit synthesize flash` made, or any in IRON's layout whose `test/`
holds diffuse_albedo, specular_albedo and specular_roughness with `light.txt` beside. PIR's
protocol: pictures over the whole frame; albedos linear, times the ratio of the intensities
(predicted over true), within the predicted mask, over the whole frame; roughness (the lobe's width
alpha) over the whole frame.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from relit.errors import UserError
from relit.evaluate import metrics as m
from relit.evaluate.alignment import aligned
from relit.evaluate.results import entries, view_means
from relit.evaluate.surfaces import chamfer_figures
from relit.scene import Asset, Camera, Flash

RATIO = "times the ratio of intensities, predicted over true (albedos and intensity share a factor)"
FRAME = "whole frame, black outside the object's mask (PIR's protocol)"
FLASH_DEFINITIONS: dict[str, tuple[str, str]] = {
    "novel_psnr": ("dB", f"test views under the recovered moving flash: {m.DEFINITIONS['psnr']}"),
    "novel_psnr_masked": (
        "dB",
        f"test views under the recovered moving flash: {m.DEFINITIONS['psnr_masked']}",
    ),
    "novel_ssim": ("", f"test views under the recovered moving flash: {m.DEFINITIONS['ssim']}"),
    "diffuse_psnr": (
        "dB",
        f"diffuse albedo in test views, linear, {RATIO}, {FRAME}; mean of the per-view PSNR",
    ),
    "diffuse_psnr_masked": ("dB", f"as diffuse_psnr, over pixels with truth coverage >= {m.MASK}"),
    "specular_psnr": (
        "dB",
        f"specular albedo in test views, linear, {RATIO}, {FRAME}; mean of the per-view PSNR",
    ),
    "specular_psnr_masked": (
        "dB",
        f"as specular_psnr, over pixels with truth coverage >= {m.MASK}",
    ),
    "roughness_mse": ("", f"width alpha of the lobe in test views, mean squared error, {FRAME}"),
    "roughness_mse_masked": ("", f"as roughness_mse, over pixels with truth coverage >= {m.MASK}"),
    "flash_angle": (
        "degrees",
        "between the true and the recovered direction to the flash as seen from the object, mean over test cameras",
    ),
    "intensity_ratio": (
        "",
        "recovered over true radiant intensity of the flash; direct light cannot settle it",
    ),
    "normal_mae": ("degrees", f"{m.DEFINITIONS['mae']}; mean over test views"),
    "chamfer_percent": (
        "% of diameter",
        "as for multi-view captures, of the true object's bounding sphere",
    ),
}


@dataclass(frozen=True)
class FlashTruth:
    """train, test: cameras by name without folder and extension. flash: the true light. sphere:
    centre (3,) and radius of the object."""

    folder: Path
    train: dict[str, Camera]
    test: dict[str, Camera]
    flash: Flash
    centre: np.ndarray
    radius: float

    def picture(self, folder: str, name: str) -> np.ndarray:
        """Linear content of test/`folder`/`name`.exr or .png."""
        from relit.images import read_data, read_image

        exr = self.folder / "test" / folder / f"{name}.exr"
        if exr.is_file():
            return read_data(exr)
        png = exr.with_suffix(".png")
        if not png.is_file():
            raise UserError(f"the truth has no {folder} of '{name}'", fix=f"it should be at: {exr}")
        return read_image(png).rgb if folder == "image" else read_data(png)


def is_flash_truth(folder: str | Path) -> bool:
    """Whether the folder is in IRON's layout with true maps of its test views."""
    return (Path(folder) / "test" / "diffuse_albedo").is_dir()


def load_flash_truth(folder: str | Path) -> FlashTruth:
    """Read the truth. Raises UserError for what is missing."""
    from relit.capture.readers.iron import read, read_flash_light, recognise

    folder = Path(folder)
    if (folder / "truth" / "settings.json").is_file() and not (
        folder / "truth" / "truth.json"
    ).is_file():
        raise UserError(
            "the folder holds no complete truth",
            "it is unfinished: its rendering was stopped",
            f"render it again: {folder}",
        )
    found = recognise(folder)
    if found is None or not is_flash_truth(folder):
        raise UserError(
            "the folder holds no truth of a flash capture",
            "test/diffuse_albedo is not there",
            f"give another folder: {folder}",
        )
    reading = read(folder, found)
    intensity, offset = read_flash_light(folder)
    if intensity is None:
        raise UserError(
            "light.txt is missing: the true intensity of the flash is not known",
            "albedos are compared times the ratio of intensities, because photos under one light settle only the product",
            f"put the number that the photos were rendered with into: {folder / 'light.txt'}",
        )
    offset = np.zeros(3) if offset is None else offset
    meta = folder / "truth" / "truth.json"
    sphere = (
        json.loads(meta.read_text())["sphere"]
        if meta.is_file()
        else {"centre": [0.0, 0.0, 0.0], "radius": 1.0}
    )
    cameras = [
        {Path(f.name).stem: f.camera for f in reading.frames if f.held_out == held}
        for held in (False, True)
    ]
    return FlashTruth(
        folder,
        *cameras,
        Flash(offset, np.full(3, intensity)),
        np.array(sphere["centre"]),
        float(sphere["radius"]),
    )


def in_true_frame(asset: Asset, truth: FlashTruth) -> Asset:
    """The asset in the frame of the true cameras: as it is where they were given, else moved, with
    its flash, by a similarity."""
    return aligned(asset, truth.train, {Path(name).stem: camera for name, camera in asset.cameras})[
        0
    ]


def evaluate_flash(
    run_or_asset: str | Path, truth_folder: str | Path, *, spp: int = 256, seed: int = 0
) -> dict[str, Any]:
    """Every figure of FLASH_DEFINITIONS: {"metrics": {name: {"value", "unit", "definition"}},
    "per_view": {view: {name: value}}}.

    spp: samples a pixel of the pictures. Call `relit.device.use_device` first. Raises UserError for
    assets without a flash.
    """
    from relit.asset.asset import load_asset

    return evaluate_flash_asset(
        load_asset(run_or_asset), load_flash_truth(truth_folder), spp=spp, seed=seed
    )


def evaluate_flash_asset(
    asset: Asset, truth: FlashTruth, *, spp: int = 256, seed: int = 0
) -> dict[str, Any]:
    """As `evaluate_flash`, for an asset in memory."""
    from relit.lighting.flash import seen_angle
    from relit.reference.flash_scene import build_flash_scene

    if asset.flash is None:
        raise UserError(
            "the asset has no flash",
            "it was not made from a flash capture",
            "reconstruct with --capture flash",
        )
    asset = in_true_frame(asset, truth)
    scene = build_flash_scene(asset.mesh, asset.material, asset.world_from_asset)
    ratio = float(asset.flash.intensity.mean() / truth.flash.intensity.mean())
    per_view = {
        name: view_figures(scene, asset, truth, name, camera, ratio, spp, seed + i)
        for i, (name, camera) in enumerate(truth.test.items())
    }
    values = view_means(per_view)
    values["flash_angle"] = seen_angle(
        asset.flash, truth.flash, list(truth.test.values()), truth.centre
    )
    values["intensity_ratio"] = ratio
    if (truth.folder / "truth" / "mesh.ply").is_file():
        values["chamfer_percent"] = chamfer_figures(asset.mesh, asset.world_from_asset, truth)[
            "chamfer_percent"
        ]
    return {"metrics": entries(values, FLASH_DEFINITIONS), "per_view": per_view}


def view_figures(
    scene,
    asset: Asset,
    truth: FlashTruth,
    name: str,
    camera: Camera,
    ratio: float,
    spp: int,
    seed: int,
) -> dict[str, float]:
    """All figures of one test view."""
    from relit.reference.flash_scene import render_flash, render_maps
    from relit.reference.photographed import FLASH_DEPTH

    picture = render_flash(scene, camera, asset.flash, spp, seed=seed, max_depth=FLASH_DEPTH)[
        ..., :3
    ]
    maps = render_maps(
        scene, camera, spp=256
    )  # primary rays alone; fewer leave noise at outlines that costs half a dB
    a, b = m.encode(picture), m.encode(truth.picture("image", name)[..., :3])
    seen = maps["coverage"][..., None]
    diffuse, specular = (
        truth.picture(folder, name) for folder in ("diffuse_albedo", "specular_albedo")
    )
    alpha = truth.picture("specular_roughness", name)
    specular, alpha = (x if x.ndim == 2 else x[..., 0] for x in (specular, alpha))
    out = {"novel_psnr": m.psnr(a, b), "novel_ssim": m.ssim(a, b)}
    albedo = {
        "diffuse": (maps["diffuse"] * seen * ratio, diffuse[..., :3]),
        "specular": (maps["specular"] * seen[..., 0] * ratio, specular),
    }
    difference = np.square(maps["alpha"] * seen[..., 0] - alpha)
    for key, pair in albedo.items():
        out[f"{key}_psnr"] = m.psnr(*pair)
    out["roughness_mse"] = float(difference.mean())
    normal = truth.folder / "truth" / "normal" / f"{name}.exr"
    if normal.is_file():
        from relit.images import read_data

        true = read_data(normal)
        inside = true[..., 3] >= m.MASK
        out["novel_psnr_masked"] = m.psnr(a, b, inside)
        for key, pair in albedo.items():
            out[f"{key}_psnr_masked"] = m.psnr(*pair, inside)
        out["roughness_mse_masked"] = float(difference[inside].mean())
        out["normal_mae"] = float(m.normal_angles(maps["normal"], true[..., :3])[inside].mean())
    return out

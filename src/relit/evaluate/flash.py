"""Figures of a flash capture's asset against its truth, over the whole frame and inside the true
mask.

The truth is a folder that `relit synthesize flash` made, or any in IRON's layout whose `test/`
holds diffuse_albedo, specular_albedo and specular_roughness with `light.txt` beside. Albedos are
linear and compared times the ratio of the intensities (predicted over true); roughness is the
lobe's width alpha. PIR's own protocol: `evaluate.protocols.pir`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from relit.errors import UserError
from relit.evaluate import metrics as m
from relit.evaluate.alignment import aligned
from relit.evaluate.baselines import Constants
from relit.evaluate.lpips import Lpips
from relit.evaluate.picture_figures import Draw, definitions_of, picture_figures
from relit.evaluate.results import entries, view_means
from relit.evaluate.surfaces import chamfer_figures
from relit.evaluate.truth import ceiling_of
from relit.scene import Asset, Camera, Flash

RATIO = "times the ratio of intensities, predicted over true (albedos and intensity share a factor)"
FRAME = "whole frame, black outside the object's mask"
FLASH_DEFINITIONS: dict[str, tuple[str, str]] = {
    **definitions_of("novel", "test views under the recovered moving flash"),
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
    run_or_asset: str | Path,
    truth_folder: str | Path,
    *,
    spp: int = 256,
    seed: int = 0,
    lpips: Lpips | None = None,
) -> dict[str, Any]:
    """Every figure of FLASH_DEFINITIONS: {"metrics": {name: {"value", "unit", "definition", ...}},
    "per_view": {view: {name: value}}}.

    spp: samples a pixel of the pictures. Call `relit.device.use_device` first. Raises UserError for
    assets without a flash.
    """
    from relit.asset.asset import load_asset

    return evaluate_flash_asset(
        load_asset(run_or_asset), load_flash_truth(truth_folder), spp=spp, seed=seed, lpips=lpips
    )


def evaluate_flash_asset(
    asset: Asset, truth: FlashTruth, *, spp: int = 256, seed: int = 0, lpips: Lpips | None = None
) -> dict[str, Any]:
    """As `evaluate_flash`, for an asset in memory."""
    from relit.lighting.flash import seen_angle

    asset = in_true_frame(asset, truth)
    constants = Constants()
    per_view = {
        view.name: view_figures(view, constants, lpips)
        for view in flash_views(asset, truth, Draw(spp, seed))
    }
    values = view_means(per_view)
    flash = flash_of(asset)
    values["flash_angle"] = seen_angle(flash, truth.flash, list(truth.test.values()), truth.centre)
    values["intensity_ratio"] = intensity_ratio(asset, truth)
    if (truth.folder / "truth" / "mesh.ply").is_file():
        values["chamfer_percent"] = chamfer_figures(asset.mesh, asset.world_from_asset, truth)[
            "chamfer_percent"
        ]
    return {
        "metrics": entries(values, FLASH_DEFINITIONS, constants.baselines()),
        "ceiling": ceiling_of(truth.folder),
        "per_view": per_view,
    }


def flash_of(asset: Asset) -> Flash:
    """The asset's flash. Raises UserError where it has none."""
    if asset.flash is None:
        raise UserError(
            "the asset has no flash",
            "it was not made from a flash capture",
            "reconstruct with --capture flash",
        )
    return asset.flash


def intensity_ratio(asset: Asset, truth: FlashTruth) -> float:
    """Predicted over true intensity of the flash."""
    return float(flash_of(asset).intensity.mean() / truth.flash.intensity.mean())


@dataclass(frozen=True)
class FlashView:
    """A test view. picture, photo: recovered and true linear pictures (H, W, 3) on black.
    coverage: (H, W) of the recovered object. diffuse (H, W, 3), specular, alpha (H, W): pairs
    (recovered, true), linear, the albedos times the ratio of intensities, 0 outside the recovered
    coverage. normals: (recovered (H, W, 3), true (H, W, 4) with coverage), or None where the truth
    has none."""

    name: str
    picture: np.ndarray
    photo: np.ndarray
    coverage: np.ndarray
    diffuse: tuple[np.ndarray, np.ndarray]
    specular: tuple[np.ndarray, np.ndarray]
    alpha: tuple[np.ndarray, np.ndarray]
    normals: tuple[np.ndarray, np.ndarray] | None


def flash_views(asset: Asset, truth: FlashTruth, draw: Draw) -> Iterator[FlashView]:
    """Renders the test views one by one. The asset stands in the truth's frame."""
    from relit.images import read_data
    from relit.reference.flash_scene import build_flash_scene, render_flash, render_maps
    from relit.reference.photographed import FLASH_DEPTH

    flash, ratio = flash_of(asset), intensity_ratio(asset, truth)
    scene = build_flash_scene(asset.mesh, asset.material, asset.world_from_asset)
    for i, (name, camera) in enumerate(truth.test.items()):
        picture = render_flash(
            scene, camera, flash, draw.spp, seed=draw.seed + i, max_depth=FLASH_DEPTH
        )
        # primary rays alone; fewer leave noise at outlines that costs half a dB
        maps = render_maps(scene, camera, spp=256)
        seen = maps["coverage"]
        specular, alpha = (
            x if x.ndim == 2 else x[..., 0]
            for x in (truth.picture(k, name) for k in ("specular_albedo", "specular_roughness"))
        )
        normal = truth.folder / "truth" / "normal" / f"{name}.exr"
        yield FlashView(
            name,
            picture[..., :3],
            truth.picture("image", name)[..., :3],
            seen,
            (
                maps["diffuse"] * seen[..., None] * ratio,
                truth.picture("diffuse_albedo", name)[..., :3],
            ),
            (maps["specular"] * seen * ratio, specular),
            (maps["alpha"] * seen, alpha),
            (maps["normal"], read_data(normal)) if normal.is_file() else None,
        )


def view_figures(
    view: FlashView, constants: Constants, lpips: Lpips | None = None
) -> dict[str, float]:
    """All figures of one test view; its truth is added to `constants`. Figures inside the mask need
    the truth's normals, whose coverage is the mask."""
    coverage = None if view.normals is None else view.normals[1][..., 3]
    inside = np.zeros(view.coverage.shape, bool) if coverage is None else coverage >= m.MASK
    figures = picture_figures(view.picture, view.photo, inside, lpips)
    out = {
        f"novel_{key}": value
        for key, value in figures.items()
        if coverage is not None or not key.endswith("_masked")
    }
    # where no mask is known the object is where its albedo is not black
    shape = (view.diffuse[1].max(-1) > 0) if coverage is None else coverage
    for key, (mine, true) in (("diffuse", view.diffuse), ("specular", view.specular)):
        out[f"{key}_psnr"] = m.psnr(mine, true)
        constants.add(f"{key}_psnr", true, coverage=shape)
        if coverage is not None:
            out[f"{key}_psnr_masked"] = m.psnr(mine, true, inside)
            constants.add(f"{key}_psnr_masked", true, inside)
    difference = np.square(view.alpha[0] - view.alpha[1])
    out["roughness_mse"] = float(difference.mean())
    constants.add("roughness_mse", view.alpha[1], coverage=shape)
    if view.normals is not None:
        out["roughness_mse_masked"] = float(difference[inside].mean())
        constants.add("roughness_mse_masked", view.alpha[1], inside)
        angles = m.normal_angles(view.normals[0], view.normals[1][..., :3])
        out["normal_mae"] = float(angles[inside].mean())
    return out

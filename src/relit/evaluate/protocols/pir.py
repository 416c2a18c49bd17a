"""PIR's figures: Li et al., flash photography with an offset light, as `src/evaluation.py` of its
release computes them: pictures of 8 bits at 1/2.2 over the whole frame; albedos linear, times the
ratio of intensities, black outside the RECOVERED mask in both; roughness (the lobe's width alpha)
over the whole frame.

Two things of that file are easily misread. Its SSIM names a sigma, but without `gaussian_weights`
scikit-image takes a uniform window. Its "aligned" figures scale the truth to the prediction.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from relit.conventions import move_points
from relit.evaluate import metrics as m
from relit.evaluate.baselines import CONSTANT, Constants
from relit.evaluate.flash import (
    FlashTruth,
    FlashView,
    flash_views,
    in_true_frame,
    load_flash_truth,
)
from relit.evaluate.lpips import Lpips
from relit.evaluate.picture_figures import Draw
from relit.evaluate.results import PaperValue, entries, view_means
from relit.scene import Asset

KINDS = ("flash",)
MEASURES = "flash captures with true albedos and roughness of their test views"
WINDOW = 11  # pixels
HALF_COVERED = 0.5  # of a pixel, above which the recovered mask holds it
EPS = 1e-4  # least true value that a ratio is taken with
SAMPLES = 100_000  # points a surface

_FRAME = "mean over the whole frame; mean over views"
_RATIO = (
    "linear, times the ratio of intensities (recovered over true), clipped to [0, 1], black in both "
    f"where the recovered coverage is <= {HALF_COVERED}"
)
_ALIGNED = (
    "instead of the ratio of intensities the TRUTH is scaled per channel and view by the median "
    "ratio recovered / true, and both clipped"
)
DEFINITIONS: dict[str, tuple[str, str]] = {
    "novel_psnr": (
        "dB",
        f"test views under the recovered flash, 8 bits, to the power 1/2.2: PSNR, {_FRAME}",
    ),
    "novel_ssim": (
        "",
        f"pictures of novel_psnr: SSIM (uniform {WINDOW} x {WINDOW}, data range 1), mean of 3 "
        "channels and views",
    ),
    "novel_lpips": ("", "pictures of novel_psnr: LPIPS (the paper's network is AlexNet)"),
    "diffuse_psnr": ("dB", f"diffuse albedo, {_RATIO}: PSNR, {_FRAME}"),
    "diffuse_ssim": ("", "maps of diffuse_psnr: SSIM as novel_ssim"),
    "diffuse_psnr_aligned": ("dB", f"as diffuse_psnr, {_ALIGNED}"),
    "specular_psnr": ("dB", f"specular albedo, {_RATIO}: PSNR, {_FRAME}"),
    "specular_ssim": ("", "maps of specular_psnr: SSIM as novel_ssim, one channel"),
    "specular_psnr_aligned": ("dB", f"as specular_psnr, {_ALIGNED}"),
    "roughness_mse": (
        "",
        f"width alpha of the lobe, 0 outside each object: mean squared error, {_FRAME}",
    ),
    "chamfer": (
        "radii",
        f"half the sum of the two mean distances from {SAMPLES} points uniform by area on one whole "
        "surface to the other surface, in radii of the object's sphere",
    ),
}
PAPERS = {
    "offset": {
        "novel_psnr": PaperValue(31.89, "PIR Tab. 2", note="offset light; IRON 29.05"),
        "diffuse_psnr": PaperValue(35.78, "PIR Tab. 2", note="IRON 33.18"),
        "specular_psnr": PaperValue(29.72, "PIR Tab. 2", note="IRON 25.81"),
        "roughness_mse": PaperValue(0.881e-3, "PIR Tab. 2", note="IRON 1.84e-3"),
    },
    "co-located": {
        "novel_psnr": PaperValue(34.80, "PIR Tab. 3", note="co-located light; IRON 33.83"),
        "diffuse_psnr": PaperValue(35.08, "PIR Tab. 3", note="IRON 33.62"),
        "specular_psnr": PaperValue(33.13, "PIR Tab. 3", note="IRON 31.23"),
        "roughness_mse": PaperValue(0.623e-3, "PIR Tab. 3", note="IRON .826e-3"),
    },
}


def eight_bits(linear) -> np.ndarray:
    """Linear -> to the power 1/2.2, rounded to 255 levels, in [0, 1]."""
    return np.round(m.gamma_encode(linear) * 255) / 255


def masked_pair(shown, truth, mask) -> tuple[np.ndarray, np.ndarray]:
    """(recovered clipped to [0, 1], true), (H, W, C), black outside the recovered mask (H, W)."""
    a, b = (x[..., None] if x.ndim == 2 else x for x in (np.asarray(shown), np.asarray(truth)))
    return np.clip(a, 0, 1) * mask[..., None], b * mask[..., None]


def aligned_psnr(shown, truth, mask) -> float:
    """PSNR over the frame after the truth (H, W, C) is scaled to the recovered map."""
    scaled = np.array(truth, np.float64)
    if mask.any():
        ratio = np.asarray(shown, np.float64)[mask] / np.maximum(scaled[mask], EPS)
        scaled *= np.median(ratio, axis=0)
    return m.psnr(np.clip(shown, 0, 1), np.clip(scaled, 0, 1))


def pir_view_scores(
    view: FlashView, constants: Constants, lpips: Lpips | None = None
) -> dict[str, float]:
    """All figures of one view; its truth is added to `constants`."""
    a, b = eight_bits(view.picture), eight_bits(view.photo)
    out = {"novel_psnr": m.psnr(a, b), "novel_ssim": m.ssim_uniform(a, b, WINDOW)}
    if lpips is not None:
        out["novel_lpips"] = lpips(a, b)
    mask = view.coverage > HALF_COVERED
    full = np.maximum(view.coverage, 1e-9)  # one ray a pixel sees the object or does not
    for key, (shown, true) in (("diffuse", view.diffuse), ("specular", view.specular)):
        whole = shown / (full if shown.ndim == 2 else full[..., None])
        mine, ours = masked_pair(whole, true, mask)
        out[f"{key}_psnr"] = m.psnr(mine, ours)
        out[f"{key}_ssim"] = m.ssim_uniform(mine, ours, WINDOW)
        out[f"{key}_psnr_aligned"] = aligned_psnr(mine, ours, mask)
        constants.add(f"{key}_psnr", ours, coverage=mask)
    alpha = np.where(mask, view.alpha[0] / full, 0)
    out["roughness_mse"] = float(np.square(alpha - view.alpha[1]).mean())
    constants.add("roughness_mse", view.alpha[1], coverage=mask)
    return out


def constant_aligned(view: FlashView) -> dict[str, float]:
    """The `_aligned` figures of maps of one value: the protocol scales the truth to that value, so
    it is set where the truth lies, to its median."""
    mask, out = view.coverage > HALF_COVERED, {}
    for key, true in (("diffuse", view.diffuse[1]), ("specular", view.specular[1])):
        _, ours = masked_pair(true, true, mask)
        if mask.any():
            flat = np.median(ours[mask], axis=0) * mask[..., None]
            out[f"{key}_psnr_aligned"] = aligned_psnr(flat, ours, mask)
    return out


def pir_surface_score(asset: Asset, truth: FlashTruth) -> float:
    """Half the sum of the two mean point-to-mesh distances, in radii."""
    import trimesh

    loaded = trimesh.load(truth.folder / "truth" / "mesh.ply", process=False)
    true = m.sample_surface(loaded.vertices, loaded.faces, SAMPLES, seed=1)
    vertices = move_points(asset.world_from_asset, asset.mesh.vertices)
    own = m.sample_surface(vertices, asset.mesh.faces, SAMPLES, seed=0)
    return m.chamfer(own, true)[0] / truth.radius


def evaluate_by_protocol(run: Path, folder: Path, draw: Draw) -> dict[str, Any]:
    """Every figure of DEFINITIONS that the truth allows. Raises UserError without a truth."""
    from relit.asset.asset import load_asset

    truth = load_flash_truth(folder)
    asset, constants = in_true_frame(load_asset(run), truth), Constants()
    per_view, flat = {}, {}
    for view in flash_views(asset, truth, draw):
        per_view[view.name] = pir_view_scores(view, constants, draw.lpips)
        flat[view.name] = constant_aligned(view)
    values = view_means(per_view)
    if (folder / "truth" / "mesh.ply").is_file():
        values["chamfer"] = pir_surface_score(asset, truth)
    baselines = constants.baselines()
    baselines |= {name: (value, CONSTANT) for name, value in view_means(flat).items()}
    light = "offset" if np.linalg.norm(truth.flash.offset) > 0 else "co-located"
    return {
        "metrics": entries(values, DEFINITIONS, baselines, PAPERS[light]),
        "per_view": per_view,
    }

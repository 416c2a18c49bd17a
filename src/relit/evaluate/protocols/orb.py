"""Stanford-ORB's figures: Kuang et al. 2023, as `orb/utils/{metrics,test,eval_mesh}.py` of its
release compute them: masks eroded by 5 x 5 pixels; per channel and picture the least-squares factor;
errors averaged over the whole frame, black outside the mask; never worse than a picture of one half.

Differences that stay: pictures have the truth's own size (the benchmark's have 512 x 512), and
depth is not measured.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from relit.conventions import move_points
from relit.errors import UserError
from relit.evaluate import metrics as m
from relit.evaluate.alignment import aligned
from relit.evaluate.baselines import CONSTANT
from relit.evaluate.lpips import Lpips
from relit.evaluate.picture_figures import Draw, prefixed
from relit.evaluate.protocols.sfd import true_surface
from relit.evaluate.results import PaperValue, entries, view_means
from relit.evaluate.truth import Truth, camera_key, has_truth, load_truth
from relit.scene import Asset

KINDS = ("multiview",)
MEASURES = "multi-view captures with a truth"
HDR_LIMIT = 4.0  # largest value of pictures in linear space, after their re-normalisation
SAMPLES = 30_000  # points of the recovered surface
RADIUS = 1  # of the Gaussian window of SSIM: kornia's `ssim_loss(..., 3)`

_MASK = "true mask eroded by 5 x 5 pixels"
_SCALE = "per channel and picture the least-squares factor"
_FLOOR = "error averaged over the whole frame, never below the PSNR of a picture of .5"
_HDR = (
    f"linear, both times mean(sRGB) / mean(linear) of the truth, {_SCALE}, clipped to "
    f"[0, {HDR_LIMIT:g}], {_MASK}, {_FLOOR}"
)
_LDR = f"{_SCALE} on linear values, clipped to [0, 1], sRGB, {_MASK}, {_FLOOR}"


def _pictures(prefix: str, what: str) -> dict[str, tuple[str, str]]:
    shown = f"pictures of {prefix}_psnr_ldr, black outside the {_MASK}"
    return {
        f"{prefix}_psnr_hdr": ("dB", f"{what}: PSNR, {_HDR}; mean over pictures"),
        f"{prefix}_psnr_ldr": ("dB", f"{what}: PSNR, {_LDR}; mean over pictures"),
        f"{prefix}_ssim": ("", f"{shown}: SSIM (Gaussian 3 x 3, sigma 1.5)"),
        f"{prefix}_lpips": (
            "",
            f"{shown}: LPIPS (the paper's network is VGG); the release encodes them a second time",
        ),
    }


DEFINITIONS: dict[str, tuple[str, str]] = {
    **_pictures("novel", "test views under the recovered light"),
    **_pictures("relit", "test views under the unseen lights"),
    "normal_cosine": (
        "",
        f"1 - cosine between recovered and true normals, mean over the {_MASK}; mean over views; a "
        "pixel without a normal counts 1",
    ),
    "albedo_psnr": (
        "dB",
        f"base colour, linear, {_SCALE}, clipped to [0, 1], {_MASK}, {_FLOOR}; mean over views",
    ),
    "albedo_ssim": ("", "maps of albedo_psnr: SSIM (Gaussian 3 x 3, sigma 1.5)"),
    "chamfer": (
        "units^2",
        f"mean of the two mean SQUARED distances between {SAMPLES} points uniform by area on the "
        "recovered surface and the VERTICES of the true mesh, world units; vertices that lie far apart "
        "leave a floor (the benchmark's scans are dense)",
    ),
}
PAPERS = {
    "relit_psnr_hdr": PaperValue(
        27.22, "DiffReg-PBIR, Stanford-ORB", note="26.11 without a learned prior"
    ),
    "relit_psnr_ldr": PaperValue(
        34.98, "DiffReg-PBIR, Stanford-ORB", note="33.78 without a learned prior"
    ),
    "novel_psnr_hdr": PaperValue(28.03, "nvdiffrecmc, Stanford-ORB"),
    "novel_psnr_ldr": PaperValue(36.40, "nvdiffrecmc, Stanford-ORB"),
    "normal_cosine": PaperValue(0.044, "nvdiffrecmc, Stanford-ORB"),
    "albedo_psnr": PaperValue(41.60, "nvdiffrecmc, Stanford-ORB"),
}


def eroded(mask) -> np.ndarray:
    """(H, W) bool: pixels whose 5 x 5 neighbours are all above one half."""
    solid = (np.asarray(mask) > 0.5).astype(np.uint8)
    return cv2.erode(solid, np.ones((5, 5), np.uint8)) > 0


def least_squares_scale(shown, truth) -> np.ndarray:
    """(3,) factor of (N, 3) `shown` that brings it nearest to `truth`; of ones where it is black."""
    x = np.asarray(shown, np.float64).copy()
    x[:, (x**2).sum(0) <= 1e-6] = 1.0
    return (np.asarray(truth, np.float64) * x).sum(0) / np.maximum((x**2).sum(0), 1e-12)


def orb_psnr(
    shown, truth, inside, *, limit: float = 1.0, renormalised: bool = False, tone_mapped: bool
) -> tuple[float, np.ndarray, np.ndarray]:
    """(PSNR, recovered, true as compared) of linear pictures (H, W, 3): `calc_PSNR` with
    divide_mask=False. inside: (H, W) bool, the eroded mask."""
    only = np.asarray(inside, np.float64)[..., None]
    a, b = np.asarray(shown, np.float64) * only, np.maximum(np.asarray(truth, np.float64), 0) * only
    if renormalised:
        low = np.clip(b, 0, 1)
        gain = m.encode(low).mean() / low.mean() if low.mean() > 1e-8 else 1.0
        a, b = a * gain, b * gain
    if inside.any():
        a = a * least_squares_scale(a[inside], b[inside])
    a, b = np.clip(a, 0, limit), np.clip(b, 0, limit)
    if tone_mapped:
        a, b = m.encode(a), m.encode(b)
    return max(m.psnr(a, b), m.psnr(0.5 * np.broadcast_to(only, b.shape), b)), a, b


def orb_picture_scores(shown, truth, mask, lpips: Lpips | None = None) -> dict[str, float]:
    """Of linear pictures (H, W, 3). mask: (H, W) true coverage."""
    inside = eroded(mask)
    hdr, _, _ = orb_psnr(
        shown, truth, inside, limit=HDR_LIMIT, renormalised=True, tone_mapped=False
    )
    ldr, a, b = orb_psnr(shown, truth, inside, tone_mapped=True)
    out = {"psnr_hdr": hdr, "psnr_ldr": ldr, "ssim": float(m.ssim_map(a, b, RADIUS).mean())}
    return out if lpips is None else out | {"lpips": lpips(m.encode(a), m.encode(b))}


def orb_albedo_scores(shown, truth, mask) -> dict[str, float]:
    """Of linear base colours (H, W, 3)."""
    value, a, b = orb_psnr(shown, truth, eroded(mask), tone_mapped=False)
    return {"albedo_psnr": value, "albedo_ssim": float(m.ssim_map(a, b, RADIUS).mean())}


def normal_cosine(shown, truth, mask) -> float:
    """Mean of 1 - cosine between normals (H, W, 3) over the eroded mask."""
    a, b = (
        n / (np.linalg.norm(n, axis=-1, keepdims=True) + 1e-6)
        for n in (np.asarray(shown, np.float64), np.asarray(truth, np.float64))
    )
    inside = eroded(mask)
    return float((1 - (a * b).sum(-1))[inside].mean()) if inside.any() else float("nan")


def orb_surface_score(asset: Asset, vertices: np.ndarray) -> float:
    """Mean of the two mean squared distances, world units squared. vertices: (N, 3), true."""
    own = m.sample_surface(asset.mesh.vertices, asset.mesh.faces, SAMPLES).samples
    return m.point_chamfer(move_points(asset.world_from_asset, own), vertices, squared=True)[0]


def evaluate_by_protocol(run: Path, folder: Path, draw: Draw) -> dict[str, Any]:
    """Every figure of DEFINITIONS. Raises UserError without a truth."""
    from relit.asset.asset import load_asset

    if not has_truth(folder):
        raise UserError(
            "the photos have no truth that Stanford-ORB's protocol could use",
            "it compares relit pictures, base colour and shape",
            "give a folder of relit synthesize, or use --protocol relit",
        )
    truth, asset = load_truth(folder), load_asset(run)
    asset, alignment = aligned(asset, truth.train, {camera_key(n): c for n, c in asset.cameras})
    per_view, flat = _views(asset, truth, draw)
    values = view_means(per_view)
    values["chamfer"] = orb_surface_score(asset, true_surface(folder)[0])
    baselines = {name: (value, CONSTANT) for name, value in view_means(flat).items()}
    return {
        "metrics": entries(values, DEFINITIONS, baselines, PAPERS),
        "per_view": per_view,
        "alignment": alignment,
    }


def _views(asset: Asset, truth: Truth, draw: Draw):
    """(figures, figures of a base colour of one value) of each test view."""
    from relit.reference.mitsuba_scene import build_scene, render, render_channels

    lights = {} if asset.environment is None else {"novel": (asset.environment, "test")}
    for light in truth.meta.get("relight", ()):
        radiance = truth.picture(f"relight/{light}")[..., :3]
        lights[f"relit:{light}"] = (radiance, f"relight/{light}")
    scenes = {
        key: (build_scene(asset.mesh, asset.material, asset.world_from_asset, light), folder)
        for key, (light, folder) in lights.items()
    }
    bare = build_scene(asset.mesh, asset.material, asset.world_from_asset, None)
    per_view, flat = {}, {}
    for i, (name, camera) in enumerate(truth.test.items()):
        p, albedo = render_channels(bare, camera, spp=32), truth.picture(f"test/{name}_albedo")
        true, mask = albedo[..., :3], albedo[..., 3]
        figures = orb_albedo_scores(p["albedo"], true, mask)
        flat[name] = orb_albedo_scores(np.ones_like(true), true, mask)
        normal = truth.picture(f"test/{name}_normal")[..., :3]
        figures["normal_cosine"] = normal_cosine(p["normal"], normal, mask)
        for key, (scene, folder) in scenes.items():
            prefix, _, light = key.partition(":")
            shown = render(scene, camera, spp=draw.spp, seed=draw.seed + i)[..., :3]
            reference = truth.picture(f"{folder}/{name}")[..., :3]
            scores = orb_picture_scores(shown, reference, mask, draw.lpips)
            figures |= prefixed(prefix, scores, f":{light}" if light else "")
        per_view[name] = figures
    return per_view, flat

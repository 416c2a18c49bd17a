"""What is measured against photographs: the asset from the cameras of photos that the fit never
saw, under the recovered light: an environment, or the flash that moves with each camera.

The truth is the capture itself. Where it sets photos aside (held-out frames of its format) those
are compared; where it does not, the photos of the fit are, under another name ('seen_'): they show
how well the asset explains what it was made from, not more.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from relit.capture.flash_energy import flash_photos
from relit.conventions import sample_environment
from relit.errors import UserError
from relit.evaluate import metrics as m
from relit.evaluate.alignment import aligned, pose_errors
from relit.evaluate.lpips import Lpips
from relit.evaluate.picture_figures import LPIPS, Draw, picture_figures
from relit.evaluate.results import entries
from relit.evaluate.truth import camera_key
from relit.files import parse_toml
from relit.scene import Asset, Camera, Capture, Photo, Sphere

SIDE = 512  # pixels; longer photos are shrunk by area averaging before they are compared
SEEN = 12  # photos of the fit, evenly chosen, where none is set aside

_SHOWN = f"photos shrunk to at most {SIDE} pixels a side, {{light}}, recovered or given cameras"
_FIGURES = {
    "psnr": ("dB", f"{m.DEFINITIONS['psnr']}; the photo is multiplied with its mask"),
    "psnr_masked": (
        "dB",
        f"PSNR in dB of sRGB-encoded pictures clipped to [0, 1], over the pixels whose mask is >= {m.MASK}",
    ),
    "ssim": ("", f"{m.DEFINITIONS['ssim']}; the photo is multiplied with its mask"),
    "ssim_masked": ("", f"{m.DEFINITIONS['ssim_masked']} (coverage is the photo's mask)"),
    "lpips": ("", f"{LPIPS['lpips']}; the photo is multiplied with its mask"),
    "lpips_masked": ("", f"{LPIPS['lpips_masked']} (coverage is the photo's mask)"),
    "mask_iou": (
        "",
        "intersection over union of the asset's coverage and the photo's mask, both >= .5",
    ),
    "psnr_sphere": (
        "dB",
        "PSNR in dB of sRGB-encoded pictures clipped to [0, 1], over all pixels whose ray meets the object sphere; where the asset does "
        "not cover a pixel it shows the recovered light behind it, which is not made to be looked at: a lower bound",
    ),
    "psnr_covered": (
        "dB",
        f"PSNR in dB of sRGB-encoded pictures clipped to [0, 1], over the pixels that the asset itself covers (>= {m.MASK}) and whose ray "
        "meets the object sphere; read it together with `covered`",
    ),
    "ssim_sphere": ("", "the SSIM map of the pictures of psnr_sphere, over the same pixels"),
    "ssim_covered": ("", "the SSIM map of the pictures of psnr_sphere, over those of psnr_covered"),
    "lpips_sphere": ("", "LPIPS of the pictures of psnr_sphere, black beside the object sphere"),
    "covered": ("", f"share of the object sphere's pixels that the asset covers (>= {m.MASK})"),
}


def definitions(prefix: str, light: str = "recovered light") -> dict[str, tuple[str, str]]:
    """name -> (unit, definition) of the figures over held-out ('held_out') or seen ('seen')
    photos."""
    which = (
        "photos that were set aside and never used in the fit"
        if prefix == "held_out"
        else "photos of the fit itself"
    )
    shown = _SHOWN.format(light=light)
    return {
        f"{prefix}_{name}": (unit, f"{which}; {shown}: {text}; mean over photos")
        for name, (unit, text) in _FIGURES.items()
    }


def evaluate_on_photos(
    asset: Asset,
    folder: Path,
    *,
    run: Path | None = None,
    spp: int = 256,
    seed: int = 0,
    lpips: Lpips | None = None,
) -> dict[str, Any]:
    """The figures of an asset against the photos of its capture. run: the run folder, whose
    settings say how the capture was read.

    Returns as `dispatch.evaluate`. Raises UserError when the folder is no capture, has no cameras,
    or shares no photo with the asset.
    """
    from relit.reference.photographed import as_photographed

    if asset.environment is None and asset.flash is None:
        why = "neither an environment nor a flash: its pictures cannot be compared with photos"
        raise UserError("the asset has no light of its own", why, "use relit relight instead")
    capture = capture_of(folder, run)
    if asset.flash is not None:
        capture = flash_photos(
            capture
        )  # as the fit had them: those that the flash lit, all of one power
    if not capture.has_cameras:
        why = "photos can only be compared from known cameras; those of the run are in a frame of its own"
        raise UserError(
            "the photos have no cameras and no truth",
            why,
            f"give a capture with cameras (docs/formats.md): {folder}",
        )
    given = {camera_key(p.name): p.camera for p in capture.photos}
    asset, alignment = aligned(
        asset, given, {camera_key(name): camera for name, camera in asset.cameras}
    )
    photos, prefix = chosen(capture)
    show = as_photographed(asset)
    per_view = {
        p.name: photo_figures(show, asset, p, capture.sphere, Draw(spp, seed + i, lpips))
        for i, p in enumerate(photos)
    }
    names = [n for n in _FIGURES if any(n in v for v in per_view.values())]
    values = {
        f"{prefix}_{n}": float(np.nanmean([v[n] for v in per_view.values() if n in v]))
        for n in names
    }
    metrics = entries(
        values,
        definitions(
            prefix, "recovered light" if asset.flash is None else "under the recovered moving flash"
        ),
    )
    metrics |= (
        camera_figures({camera_key(name): c for name, c in asset.cameras}, given)
        if alignment == "sim3"
        else {}
    )
    return {"metrics": metrics, "per_view": per_view, "photos": len(photos), "alignment": alignment}


def capture_of(folder: Path, run: Path | None) -> Capture:
    """The capture, read with the masks and the sphere that the run's config.toml names."""
    from relit.capture.open import open_capture

    config = run / "config.toml" if run else None
    said = parse_toml(config.read_text(encoding="utf-8")) if config and config.is_file() else {}
    ball = said.get("sphere")
    sphere = Sphere(np.array(ball[:3], np.float64), float(ball[3])) if ball else None
    return open_capture(folder, sphere=sphere, masks=said.get("masks", "auto"), min_photos=1)


def chosen(capture: Capture) -> tuple[list[Photo], str]:
    """The photos that are compared, and the prefix of their figures."""
    held_out = [p for p in capture.held_out if p.camera is not None]
    if held_out:
        return held_out, "held_out"
    index = np.unique(np.linspace(0, len(capture.photos) - 1, SEEN).round().astype(int))
    return [capture.photos[i] for i in index], "seen"


def photo_figures(
    show, asset: Asset, photo: Photo, sphere: Sphere | None, draw: Draw
) -> dict[str, float]:
    """Figures of one photo, without prefix: the masked ones where its mask is known, else those of
    the object sphere. show: see `reference.photographed.as_photographed`."""
    pixels, camera = photo.load(), photo.camera
    camera = camera.within(SIDE)
    rgb, mask = (shrunk_to_camera(a, camera) for a in (pixels.rgb, pixels.mask))
    shown = show(photo.name, camera, spp=draw.spp, seed=draw.seed)
    alpha = shown[..., 3]
    if mask is not None:
        inside = mask >= m.MASK
        figures = picture_figures(shown[..., :3], rgb * mask[..., None], inside, draw.lpips)
        return figures | {"mask_iou": m.mask_iou(alpha, mask)}
    d = directions(camera)
    behind = (
        0.0
        if asset.environment is None
        else sample_environment(asset.environment, d) * (1 - alpha[..., None])
    )
    a, b = m.encode(shown[..., :3] + behind), m.encode(rgb)
    ball = np.ones(alpha.shape, bool) if sphere is None else meets_sphere(camera, d, sphere)
    covered = ball & (alpha >= m.MASK)
    s = m.ssim_map(a, b)
    out = {
        "psnr_sphere": m.psnr(a, b, ball),
        "psnr_covered": m.psnr(a, b, covered),
        "ssim_sphere": float(s[ball].mean()) if ball.any() else float("nan"),
        "ssim_covered": float(s[covered].mean()) if covered.any() else float("nan"),
        "covered": float(covered.sum() / max(ball.sum(), 1)),
    }
    if draw.lpips is not None:
        out["lpips_sphere"] = draw.lpips(a * ball[..., None], b * ball[..., None])
    return out


def shrunk_to_camera(image: np.ndarray | None, camera: Camera) -> np.ndarray | None:
    """Area-averaged to the camera's size."""
    if image is None or image.shape[:2] == (camera.height, camera.width):
        return image
    return cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)


def directions(camera: Camera) -> np.ndarray:
    """(H, W, 3) unit world directions through the pixel centres."""
    u, v = np.meshgrid(
        (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx,
        (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy,
    )
    d = np.stack([u, v, np.ones_like(u)], -1) @ np.asarray(camera.world_from_camera)[:3, :3].T
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def meets_sphere(camera: Camera, d: np.ndarray, sphere: Sphere) -> np.ndarray:
    """(H, W) bool: pixels whose ray meets the sphere."""
    o = camera.centre - sphere.centre
    along = d @ o
    return (along**2 - (o @ o - sphere.radius**2) > 0) & (sphere.radius - along > 0)


def camera_figures(
    recovered: dict[str, Camera], given: dict[str, Camera]
) -> dict[str, dict[str, Any]]:
    """How far the recovered cameras, already aligned, are from the given ones."""
    rotations, _ = pose_errors(recovered, given, np.eye(4))
    text = "median rotation error of the recovered cameras against the capture's own, after Sim(3) alignment"
    return entries(
        {"camera_rotation": float(np.median(rotations))}, {"camera_rotation": ("degrees", text)}
    )

"""The photos of a capture with cameras, decoded and carried to the unit frame."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from relit.conventions import move_pose
from relit.fit.passes.pixels import SATURATED, PixelBank, make_bank
from relit.scene import Camera, Capture, Pixels


@dataclass(frozen=True)
class UnitPhotos:
    """Photos as the passes use them. bank: their pixels on the device. cameras: in the unit frame.
    masks: (h, w) float32 in [0, 1] each, or None where they are not known. level: (3,) mean
    radiance of the object. names: as messages show them."""

    bank: PixelBank
    cameras: list[Camera]
    masks: list[np.ndarray] | None
    level: np.ndarray
    names: list[str]


def load_pixels(capture: Capture, options, run) -> UnitPhotos:
    """Decode all photos and carry their cameras to the unit frame. options: of the recipe, of which
    max_pixels counts."""
    unit_from_world = np.linalg.inv(capture.sphere.world_from_unit)
    total = sum(p.width * p.height for p in capture.photos)
    shrink = min(1.0, np.sqrt(options.max_pixels / total))
    if shrink < 1:
        size = f"all together {options.max_pixels / 1e6:.0f} megapixels; --set max_pixels=N"
        run.say(f"photos are used at {shrink:.0%} of their size ({size})")
    cameras, images, masks, normals, whites, ignored = [], [], [], [], [], []
    for photo in capture.photos:
        pixels, camera = photo.load(), photo.camera
        rgb, mask, normal = pixels.rgb, pixels.mask, pixels.normal
        if shrink < 1:
            w, h = max(16, round(camera.width * shrink)), max(16, round(camera.height * shrink))
            rgb, mask, normal = (resize(a, w, h) for a in (rgb, mask, normal))
            camera = camera.resized(w, h)
        ignored.append(partly_clipped(pixels, rgb))
        cameras.append(camera.with_pose(move_pose(unit_from_world, camera.world_from_camera)))
        images.append(rgb)
        masks.append(mask)
        normals.append(normal)
        whites.append(None if pixels.clipped is None else pixels.white)
    if any(m is None for m in masks) and not all(m is None for m in masks):
        run.say("note: some photos have no mask; all photos are used without masks")
        masks = [None] * len(masks)
    masked = masks[0] is not None
    weight = (
        sum(float(m.sum()) for m in masks)
        if masked
        else sum(i.shape[0] * i.shape[1] for i in images)
    )
    level = sum(
        (i * (m[..., None] if masked else 1)).sum((0, 1))
        for i, m in zip(images, masks, strict=False)
    ) / max(weight, 1e-6)
    prior = normals if any(n is not None for n in normals) else None
    bank = make_bank(cameras, images, masks, prior, whites, ignored=ignored)
    names = [photo.name for photo in capture.photos]
    return UnitPhotos(bank, cameras, masks if masked else None, np.maximum(level, 1e-3), names)


def partly_clipped(pixels: Pixels, rgb: np.ndarray) -> np.ndarray | None:
    """(h, w) bool: pixels of a shrunken photo `rgb` (h, w, 3) of which only a part was clipped. Their
    mean is darker than what was there, and yet no clipped value: they tell nothing. None where
    the photo's format holds no codes."""
    if pixels.clipped is None:
        return None
    share = resize(pixels.clipped.astype(np.float32), rgb.shape[1], rgb.shape[0])
    return (share > 0) & (rgb.max(-1) < SATURATED * pixels.white)


def resize(image, width: int, height: int):
    """Area-averaged (H, W[, C]) float32, or None for None."""
    return (
        None if image is None else cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    )

"""All training pixels on the device, and batches of rays through them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import binary_dilation

from relit.fit.passes.camera_corrections import (
    CameraCorrections,
    no_corrections,
)
from relit.scene import Camera

SATURATED = 0.99  # of photos whose values end at 1


@dataclass
class PixelBank:
    """views, total: counts of photos and pixels. rgbm: Float [total * 4], linear RGB and mask.
    normals: Float [total * 4] or None (camera axes, last entry 1 where known). cameras: Float
    [views * 16]. offsets, widths: UInt32 [views]. candidates: UInt32, the pixels that batches are
    drawn from. masked: whether masks are known. corrections: of the cameras. saturated: see
    `saturation`; a float, or Float [views] where photos differ.
    drop_saturated: whether such pixels have no say in the volume pass."""

    views: int
    total: int
    rgbm: Any
    normals: Any
    cameras: Any
    offsets: Any
    widths: Any
    candidates: Any
    masked: bool
    corrections: CameraCorrections
    saturated: Any = SATURATED
    drop_saturated: bool = False


@dataclass
class RayBatch:
    """o, d: Vector3f in the unit frame, d unit. rgb: Color3f linear. mask: Float. view, pixel:
    UInt32. normal: Vector3f or None."""

    o: Any
    d: Any
    rgb: Any
    mask: Any
    view: Any
    pixel: Any
    normal: Any = None
    has_normal: Any = None


def camera_rows(cameras: list[Camera]) -> np.ndarray:
    """(views * 16) float32 of `cameras` (unit frame)."""
    rows = [
        np.concatenate([[c.fx, c.fy, c.cx, c.cy], np.asarray(c.world_from_camera)[:3].ravel()])
        for c in cameras
    ]
    return np.concatenate(rows).astype(np.float32)


def make_bank(
    cameras: list[Camera],
    images: list[np.ndarray],
    masks: list[np.ndarray | None],
    normals=None,
    whites=None,
    *,
    radius=1.0,
    ignored=None,
) -> PixelBank:
    """cameras: unit frame. images: (H, W, 3) linear. masks: (H, W) or None each. normals: (H, W, 3)
    or None each, or None. whites: see `saturation`.

    Candidates: pixels whose ray meets the object sphere and, where masks are known, lie within a
    margin of the mask; without those that are ignored, (H, W) bool or None each.
    """
    masked = all(m is not None for m in masks)
    sizes = [im.shape[0] * im.shape[1] for im in images]
    offsets = np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(np.uint32)
    candidates, rgbm, extra = [], [], []
    for k, (camera, image, mask) in enumerate(zip(cameras, images, masks, strict=False)):
        h, w = image.shape[:2]
        near = sphere_pixels(camera, radius)
        if masked:
            grow = max(3, round(0.03 * max(h, w)))
            near &= binary_dilation(mask > 0.02, iterations=grow) if mask.any() else near
        if ignored is not None and ignored[k] is not None:
            near &= ~ignored[k]
        candidates.append(np.flatnonzero(near.ravel()).astype(np.uint32) + offsets[k])
        alpha = np.ones((h, w), np.float32) if mask is None else mask
        rgbm.append(np.concatenate([image, alpha[..., None]], -1).reshape(-1))
        if normals is not None:
            nk = normals[k]
            packed = np.zeros((h, w, 4), np.float32)
            if nk is not None:
                length = np.linalg.norm(nk, axis=-1)  # shrinking a photo averages its normals
                packed[..., :3] = nk / np.maximum(length, 1e-6)[..., None]
                packed[..., 3] = length > 0.1
            extra.append(packed.reshape(-1))
    return PixelBank(
        len(images),
        int(sum(sizes)),
        mi.Float(np.concatenate(rgbm).astype(np.float32)),
        mi.Float(np.concatenate(extra)) if extra else None,
        mi.Float(camera_rows(cameras)),
        mi.UInt32(offsets),
        mi.UInt32(np.array([im.shape[1] for im in images], np.uint32)),
        mi.UInt32(np.concatenate(candidates)),
        masked,
        no_corrections(len(images)),
        saturation(images, whites or [None] * len(images)),
    )


def saturation(images: list[np.ndarray], whites: list[float | None]):
    """The linear value from which on a pixel says only "at least this bright": a float, or Float
    [views] where photos differ.

    whites: what the largest code of each photo stands for (`Pixels.white`), None where its format
    holds no codes or is not known: such photos are taken to end at 1 unless one of them is
    brighter, as pictures in EXR or HDR are that were not made from codes.
    """
    free = (
        max(
            (
                float(im.max(initial=0))
                for im, white in zip(images, whites, strict=True)
                if white is None
            ),
            default=0.0,
        )
        > 1.001
    )
    levels = [
        (np.inf if free else SATURATED) if white is None else SATURATED * white for white in whites
    ]
    return levels[0] if len(set(levels)) == 1 else mi.Float(np.array(levels, np.float32))


def saturated_at(bank: PixelBank, view):
    """`saturation` of the photos `view` (UInt32): a float, or Float."""
    return (
        bank.saturated
        if isinstance(bank.saturated, float)
        else dr.gather(mi.Float, bank.saturated, view)
    )


def sphere_pixels(camera: Camera, radius: float) -> np.ndarray:
    """(H, W) bool: pixels whose ray meets the ball of `radius` around the origin."""
    u, v = np.meshgrid(
        (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx,
        (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy,
    )
    d = np.stack([u, v, np.ones_like(u)], -1)
    d = (d / np.linalg.norm(d, axis=-1, keepdims=True)) @ np.asarray(camera.world_from_camera)[
        :3, :3
    ].T
    o = camera.centre
    b = d @ o
    return (b * b - (o @ o - radius * radius) > 0) & ((-b + radius) > 0)


def rays_through(cameras, view, x, y, corrections: CameraCorrections | None = None):
    """Rays (o, d) through pixel positions x, y (Floats in pixels, centres at +.5) of `view`;
    differentiable in the values of `corrections`."""
    k = [dr.gather(mi.Vector4f, cameras, view * 4 + j) for j in range(4)]
    lx, ly = (x - k[0].z) / k[0].x, (y - k[0].w) / k[0].y
    o = mi.Vector3f(k[1].w, k[2].w, k[3].w)
    if corrections is not None:
        shrink = corrections.inverse_zoom(view)
        lx, ly = lx * shrink, ly * shrink
    d = dr.normalize(mi.Vector3f(*[k[j].x * lx + k[j].y * ly + k[j].z for j in (1, 2, 3)]))
    return (o, d) if corrections is None else corrections.moved(view, o, d)


def place_cameras(bank: PixelBank, cameras: list[Camera]) -> None:
    """Let the bank's rays come from `cameras`, without corrections."""
    bank.cameras, bank.corrections = (
        mi.Float(camera_rows(cameras)),
        no_corrections(bank.views),
    )


def locate(bank: PixelBank, pixel):
    """View, column and row (UInt32) of flat pixel numbers."""
    view = (
        dr.binary_search(
            0, bank.views, lambda k: dr.gather(mi.UInt32, bank.offsets, k, k < bank.views) <= pixel
        )
        - 1
    )
    local = pixel - dr.gather(mi.UInt32, bank.offsets, view)
    width = dr.maximum(
        dr.gather(mi.UInt32, bank.widths, view), 1
    )  # unused lanes of a vector register read 0: a division by it is a crash
    row = local // width
    return view, local - row * width, row


def batch_of(bank: PixelBank, pixel, corrections: CameraCorrections | None = None) -> RayBatch:
    """Rays and targets of flat pixel numbers (UInt32)."""
    view, x, y = locate(bank, pixel)
    o, d = rays_through(bank.cameras, view, mi.Float(x) + 0.5, mi.Float(y) + 0.5, corrections)
    p = dr.gather(mi.Vector4f, bank.rgbm, pixel)
    batch = RayBatch(o, d, mi.Color3f(p.x, p.y, p.z), p.w, view, pixel)
    if bank.normals is not None:
        q = dr.gather(mi.Vector4f, bank.normals, pixel)
        k = [dr.gather(mi.Vector4f, bank.cameras, view * 4 + j) for j in (1, 2, 3)]
        batch.normal = mi.Vector3f(*[r.x * q.x + r.y * q.y + r.z * q.z for r in k])
        batch.has_normal = q.w
    return batch


def well_exposed(rgb, saturated):
    """Bool: no channel of a Color3f is over-exposed; True (a Python bool) where nothing can be.
    saturated: of `saturated_at`."""
    return True if unlimited(saturated) else dr.max(rgb) < saturated


def unlimited(saturated) -> bool:
    """Whether no pixel of any photo can be over-exposed."""
    return isinstance(saturated, float) and np.isinf(saturated)


def draw_pixels(bank: PixelBank, rng, count: int):
    """`count` candidate pixels, uniformly. rng: evaluated PCG32 of size `count`."""
    return drawn_from(bank.candidates, rng)


def drawn_from(pixels, rng):
    """As many of `pixels` (UInt32) as the rng (PCG32) is wide, uniformly."""
    total = dr.width(pixels)
    return dr.gather(
        mi.UInt32, pixels, dr.minimum(mi.UInt32(rng.next_float32() * total), total - 1)
    )

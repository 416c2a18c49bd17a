"""Masks by GrabCut (Rother, Kolmogorov, Blake 2004), seeded by the object sphere. A guess: good before calm backgrounds, poor otherwise."""

from __future__ import annotations

import cv2
import numpy as np

from relit.conventions import srgb_from_linear
from relit.scene import Camera, Sphere

WORK_SIDE = 480  # pixels; the cut is found on a small copy


def sphere_disc(camera: Camera, sphere: Sphere, scale: float = 1.0) -> np.ndarray:
    """(H, W) bool: pixels whose ray meets the sphere (its radius times `scale`)."""
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    gx, gy = np.meshgrid(x, y)
    c = camera.camera_from_world @ np.append(sphere.centre, 1.0)
    along = gx * c[0] + gy * c[1] + c[2]  # of the unnormalised ray direction
    length2 = gx**2 + gy**2 + 1
    distance2 = float(c[:3] @ c[:3]) - along**2 / length2
    return (along > 0) & (distance2 < (scale * sphere.radius) ** 2)


def grabcut(rgb: np.ndarray, camera: Camera, sphere: Sphere, iterations: int = 4) -> np.ndarray:
    """Linear (H, W, 3) and its pinhole camera -> mask (H, W) float32, 0 or 1.

    Outside the projected sphere is background, its inner half probably object, the ring between probably background.
    """
    h, w = rgb.shape[:2]
    s = min(1.0, WORK_SIDE / max(h, w))
    size = (max(8, round(w * s)), max(8, round(h * s)))
    small = cv2.resize((np.clip(srgb_from_linear(rgb), 0, 1) * 255).astype(np.uint8), size, interpolation=cv2.INTER_AREA)
    seen = camera.resized(*size)
    labels = np.full(size[::-1], cv2.GC_BGD, np.uint8)
    labels[sphere_disc(seen, sphere)] = cv2.GC_PR_BGD
    labels[sphere_disc(seen, sphere, 0.6)] = cv2.GC_PR_FGD
    if not ((labels == cv2.GC_PR_FGD).any() and (labels != cv2.GC_PR_FGD).any()):
        return np.zeros((h, w), np.float32)
    cv2.setRNGSeed(0)  # the colour models start from k-means: same photo, same mask
    cv2.grabCut(
        np.ascontiguousarray(small[..., ::-1]), labels, None, np.zeros((1, 65)), np.zeros((1, 65)), iterations, cv2.GC_INIT_WITH_MASK
    )
    mask = np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD)).astype(np.float32)
    return (cv2.resize(mask, (w, h), interpolation=cv2.INTER_LINEAR) > 0.5).astype(np.float32)


def centre_cut(rgb: np.ndarray, iterations: int = 5) -> np.ndarray:
    """Linear (H, W, 3) -> mask (H, W) float32, 0 or 1, of what stands in the middle of a photo of unknown camera: the border is
    background, the middle probably object. The largest connected part is kept."""
    h, w = rgb.shape[:2]
    s = min(1.0, WORK_SIDE / max(h, w))
    size = (max(8, round(w * s)), max(8, round(h * s)))
    small = cv2.resize((np.clip(srgb_from_linear(rgb), 0, 1) * 255).astype(np.uint8), size, interpolation=cv2.INTER_AREA)
    labels = np.full(size[::-1], cv2.GC_PR_BGD, np.uint8)
    y, x = np.mgrid[: size[1], : size[0]]
    r = np.hypot((x + 0.5) / size[0] - 0.5, (y + 0.5) / size[1] - 0.5)
    labels[r < 0.32] = cv2.GC_PR_FGD
    edge = max(2, round(0.03 * max(size)))
    labels[:edge], labels[-edge:], labels[:, :edge], labels[:, -edge:] = (cv2.GC_BGD,) * 4
    cv2.setRNGSeed(0)
    cv2.grabCut(
        np.ascontiguousarray(small[..., ::-1]), labels, None, np.zeros((1, 65)), np.zeros((1, 65)), iterations, cv2.GC_INIT_WITH_MASK
    )
    mask = np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD)).astype(np.uint8)
    _, parts, stats, _ = cv2.connectedComponentsWithStats(mask)
    if len(stats) > 1:
        mask = (parts == 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax())).astype(np.uint8)
    return (cv2.resize(mask.astype(np.float32), (w, h), interpolation=cv2.INTER_LINEAR) > 0.5).astype(np.float32)

"""Masks by GrabCut (Rother, Kolmogorov, Blake 2004), seeded by the object sphere, by a box that
somebody drew, or by the photo's middle.

A guess: good before calm backgrounds, poor otherwise.
"""

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

    Outside the projected sphere is background, its inner half probably object, the ring between
    probably background.
    """
    small = work_copy(rgb)
    seen = camera.resized(small.shape[1], small.shape[0])
    labels = np.full(small.shape[:2], cv2.GC_BGD, np.uint8)
    labels[sphere_disc(seen, sphere)] = cv2.GC_PR_BGD
    labels[sphere_disc(seen, sphere, 0.6)] = cv2.GC_PR_FGD
    return enlarged(cut(small, labels, iterations), rgb)


def centre_cut(rgb: np.ndarray, iterations: int = 5) -> np.ndarray:
    """Linear (H, W, 3) -> mask (H, W) float32, 0 or 1, of what stands in the middle of a photo of
    unknown camera: the border is background, the middle probably object. The largest connected part
    is kept."""
    small = work_copy(rgb)
    h, w = small.shape[:2]
    labels = np.full((h, w), cv2.GC_PR_BGD, np.uint8)
    y, x = np.mgrid[:h, :w]
    r = np.hypot((x + 0.5) / w - 0.5, (y + 0.5) / h - 0.5)
    labels[r < 0.32] = cv2.GC_PR_FGD
    edge = max(2, round(0.03 * max(w, h)))
    labels[:edge], labels[-edge:], labels[:, :edge], labels[:, -edge:] = (cv2.GC_BGD,) * 4
    return enlarged(largest_part(cut(small, labels, iterations)), rgb)


def box_cut(
    rgb: np.ndarray, box: tuple[float, float, float, float], iterations: int = 5
) -> np.ndarray:
    """Linear (H, W, 3) -> mask (H, W) float32, 0 or 1, of the object that a box (x0, y0, x1, y1),
    pixels, is drawn round: outside is background, inside probably object. The largest connected
    part is kept; 0 all over where the cut finds nothing."""
    small = work_copy(rgb)
    h, w = small.shape[:2]
    x0, y0, x1, y1 = np.array(box) * np.tile([w / rgb.shape[1], h / rgb.shape[0]], 2)
    y, x = np.mgrid[:h, :w] + 0.5
    labels = np.full((h, w), cv2.GC_BGD, np.uint8)
    labels[(x > x0) & (x < x1) & (y > y0) & (y < y1)] = cv2.GC_PR_FGD
    return enlarged(largest_part(cut(small, labels, iterations)), rgb)


def work_copy(rgb: np.ndarray) -> np.ndarray:
    """Linear (H, W, 3) -> (h, w, 3) uint8 sRGB, WORK_SIDE at most."""
    h, w = rgb.shape[:2]
    s = min(1.0, WORK_SIDE / max(h, w))
    size = (max(8, round(w * s)), max(8, round(h * s)))
    return cv2.resize(
        (np.clip(srgb_from_linear(rgb), 0, 1) * 255).astype(np.uint8),
        size,
        interpolation=cv2.INTER_AREA,
    )


def cut(small: np.ndarray, labels: np.ndarray, iterations: int) -> np.ndarray:
    """(h, w) uint8, 1 on the object. labels: OpenCV's seeds (h, w); 0 all over where they hold no
    object or nothing else."""
    if not ((labels == cv2.GC_PR_FGD).any() and (labels != cv2.GC_PR_FGD).any()):
        return np.zeros(labels.shape, np.uint8)
    cv2.setRNGSeed(0)  # the colour models start from k-means: same photo, same mask
    cv2.grabCut(  # pyright: ignore[reportCallIssue]
        np.ascontiguousarray(small[..., ::-1]),
        labels,
        None,  # pyright: ignore[reportArgumentType]
        np.zeros((1, 65)),
        np.zeros((1, 65)),
        iterations,
        cv2.GC_INIT_WITH_MASK,
    )
    return np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD)).astype(np.uint8)


def largest_part(mask: np.ndarray) -> np.ndarray:
    """The largest connected part of a mask (h, w) uint8."""
    _, parts, stats, _ = cv2.connectedComponentsWithStats(mask)
    return (
        mask
        if len(stats) < 2
        else (parts == 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax())).astype(np.uint8)
    )


def enlarged(mask: np.ndarray, rgb: np.ndarray) -> np.ndarray:
    """The mask at the size of the photo, (H, W) float32, 0 or 1."""
    h, w = rgb.shape[:2]
    return (
        cv2.resize(mask.astype(np.float32), (w, h), interpolation=cv2.INTER_LINEAR) > 0.5
    ).astype(np.float32)

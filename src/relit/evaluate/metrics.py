"""Every figure that Relit reports, in NumPy, each with the definition it is printed with.

Papers differ by up to 2 dB in what they call the same figure (mask, colour space, scale, window),
so nothing here has a
hidden choice: `DEFINITIONS` holds the sentence that stands beside each number.

Images are (H, W, 3) float32 linear, premultiplied on black. A picture figure is taken after
clipping to [0, 1] and sRGB
encoding, in two conventions: over the whole frame (black outside the object; easy background pixels
raise it) and inside the mask (truth coverage >= MASK; strict).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, uniform_filter
from scipy.spatial import cKDTree

from relit.conventions import environment_solid_angles
from relit.images.fidelity import MASK as MASK
from relit.images.fidelity import encode as encode
from relit.images.fidelity import psnr as psnr

SSIM_SIGMA, SSIM_RADIUS = 1.5, 5  # an 11 x 11 window, as Wang et al. 2004 and PIR

DEFINITIONS = {
    "psnr": "PSNR in dB of sRGB-encoded pictures clipped to [0, 1], peak 1, whole frame on black; mean over views of the per-view figure",
    "psnr_masked": f"as psnr, over the pixels whose truth coverage is >= {MASK}",
    "ssim": "SSIM (Wang 2004: Gaussian window 11x11, sigma 1.5, K = .01, .03) of the sRGB-encoded pictures, mean of 3 channels, "
    "whole frame on black",
    "ssim_masked": f"the SSIM map of the pictures on black, averaged over pixels whose truth coverage is >= {MASK}",
    "mae": f"angle in degrees between predicted and true world shading normals, mean over pixels with truth coverage >= {MASK}; "
    "a pixel without a prediction counts 90",
    "mse": f"mean squared error over pixels with truth coverage >= {MASK}; a pixel without a prediction counts as value 0",
}


def gamma_encode(linear):
    """Linear -> clipped to [0, 1], to the power 1/2.2: how SfD and PIR encode pictures."""
    return np.clip(linear, 0.0, 1.0) ** (1 / 2.2)


def ssim_map(a, b, radius: int = SSIM_RADIUS) -> np.ndarray:
    """Structural similarity (H, W) of two (H, W) or (H, W, C) arrays in [0, 1], mean over channels.

    Wang et al. 2004, Eq. 13: Gaussian window of (2 radius + 1)^2 pixels with sigma 1.5, C1 =
    .01^2, C2 = .03^2, population moments, frame edges reflected.
    """

    def blur(x):
        return gaussian_filter(
            x, (SSIM_SIGMA, SSIM_SIGMA, 0), radius=(radius, radius, 0), mode="reflect"
        )

    return _structural_similarity(a, b, blur).mean(-1)


def ssim_uniform(
    a, b, size: int, data_range: float = 1.0, sample_covariance: bool = False
) -> float:
    """Structural similarity with a uniform window of size^2 pixels, mean over channels and over the
    pixels whose window lies in the frame: scikit-image without `gaussian_weights`, as SfD (7,
    sample covariance) and PIR (11) call it."""
    pad, count = (size - 1) // 2, size * size

    def blur(x):
        return uniform_filter(x, (size, size, 0))

    norm = count / (count - 1) if sample_covariance else 1.0
    s = _structural_similarity(a, b, blur, data_range, norm)
    return float(s[pad:-pad, pad:-pad].mean())


def _structural_similarity(a, b, blur, data_range: float = 1.0, norm: float = 1.0) -> np.ndarray:
    """(H, W, C) map. blur: weighted mean over the window. norm: factor of the covariances."""
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    if a.ndim == 2:
        a, b = a[..., None], b[..., None]
    mu_a, mu_b = blur(a), blur(b)
    var_a, var_b, cov = (
        norm * (blur(x * y) - mx * my)
        for x, y, mx, my in ((a, a, mu_a, mu_a), (b, b, mu_b, mu_b), (a, b, mu_a, mu_b))
    )
    c1, c2 = (0.01 * data_range) ** 2, (0.03 * data_range) ** 2
    return ((2 * mu_a * mu_b + c1) * (2 * cov + c2)) / (
        (mu_a**2 + mu_b**2 + c1) * (var_a + var_b + c2)
    )


def ssim(a, b, where=None) -> float:
    """Mean of `ssim_map`, over `where` (H, W) bool if given."""
    s = ssim_map(a, b)
    return float(s.mean() if where is None else s[np.asarray(where, bool)].mean())


def normal_angles(predicted, truth) -> np.ndarray:
    """Angle (...) in degrees between (..., 3) normals, normalised first; 90 where the prediction is
    zero (no surface there)."""
    p, t = np.asarray(predicted, np.float64), np.asarray(truth, np.float64)
    length = np.linalg.norm(p, axis=-1)
    t = t / np.maximum(np.linalg.norm(t, axis=-1, keepdims=True), 1e-12)
    p = p / np.maximum(length, 1e-12)[..., None]
    # atan2 keeps the precision near 0 that arccos of a float32 dot product loses
    angle = np.degrees(np.arctan2(np.linalg.norm(np.cross(p, t), axis=-1), (p * t).sum(-1)))
    return np.where(length < 1e-6, 90.0, angle)


def albedo_scale(predicted, truth) -> np.ndarray:
    """Per-channel factor (3,) that takes the predicted albedo to the true one: sum(truth) /
    sum(predicted) over (N, 3) samples, linear in Relit's own figures, after x^(1/2.2) in SfD's.
    Albedo and light share a scale that photographs do not determine."""
    p, t = (
        np.asarray(predicted, np.float64).reshape(-1, 3),
        np.asarray(truth, np.float64).reshape(-1, 3),
    )
    total = p.sum(0)
    return np.where(total > 1e-9, t.sum(0) / np.maximum(total, 1e-9), 1.0)


@dataclass(frozen=True)
class SurfacePoints:
    """Points on a triangle mesh. points: (N, 3) float64. triangle: (N,) the face each lies on.
    uniform: (N,) bool, true for samples uniform by area, false for face centres, which make sure
    that a face between samples is found. corners: (F, 3, 3) of the faces."""

    points: np.ndarray
    triangle: np.ndarray
    uniform: np.ndarray
    corners: np.ndarray

    @property
    def samples(self) -> np.ndarray:
        """(N, 3) the points that are uniform by area."""
        return self.points[self.uniform]

    def only(self, keep) -> SurfacePoints:
        """The points where `keep` (N,) is true."""
        return SurfacePoints(
            self.points[keep], self.triangle[keep], self.uniform[keep], self.corners
        )


def sample_surface(vertices, faces, count: int, seed: int = 0) -> SurfacePoints:
    """`count` points uniform by area on a triangle mesh, and the centre of every face."""
    corners = np.asarray(vertices, np.float64)[np.asarray(faces)]
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = np.linalg.norm(np.cross(e1, e2), axis=1)
    rng = np.random.default_rng(seed)
    # stratified over the cumulated area: less noise in a distance between samples than independent
    # draws
    position = (np.arange(count) + rng.random(count)) / count * area.sum()
    index = np.minimum(np.searchsorted(np.cumsum(area), position), len(corners) - 1)
    u, w = rng.random(count), rng.random(count)
    flip = u + w > 1
    u, w = np.where(flip, 1 - u, u), np.where(flip, 1 - w, w)
    samples = corners[index, 0] + u[:, None] * e1[index] + w[:, None] * e2[index]
    return SurfacePoints(
        np.concatenate([samples, corners.mean(1)]),
        np.concatenate([index, np.arange(len(corners))]),
        np.arange(count + len(corners)) < count,
        corners,
    )


def closest_on_triangles(p, a, b, c) -> np.ndarray:
    """Nearest points (..., 3) to p (..., 3) on the triangles a b c (each (..., 3)): the plane's
    foot where it lies inside, else the nearest of the three edges."""

    def dot(x, y):
        return (x * y).sum(-1, keepdims=True)

    def on_edge(x, y):
        d = y - x
        return x + np.clip(dot(p - x, d) / np.maximum(dot(d, d), 1e-30), 0, 1) * d

    edges = np.stack([on_edge(a, b), on_edge(b, c), on_edge(c, a)])
    distance = np.square(edges - p).sum(-1)
    best = np.take_along_axis(edges, distance.argmin(0)[None, ..., None], 0)[0]
    n = np.cross(b - a, c - a)
    foot = p - dot(p - a, n) / np.maximum(dot(n, n), 1e-30) * n
    sides = [dot(np.cross(y - x, foot - x), n) for x, y in ((a, b), (b, c), (c, a))]
    inside = np.minimum(np.minimum(sides[0], sides[1]), sides[2]) >= 0
    return np.where(inside & (dot(n, n) > 1e-30), foot, best)


def distance_to_surface(points, surface: SurfacePoints, candidates: int = 8) -> np.ndarray:
    """(N,) distance from points (N, 3) to the triangles under the `candidates` nearest points of a
    surface, in the points' unit.

    Exact between the surface's points, so a mesh against itself gives nearly 0, not the spacing of
    samples.
    """
    k = min(candidates, len(surface.points))
    near = cKDTree(surface.points).query(points, k=k, workers=-1)[1].reshape(len(points), k)
    a, b, c = (surface.corners[surface.triangle[near], i] for i in range(3))
    p = np.asarray(points, np.float64)[:, None]
    return np.linalg.norm(
        closest_on_triangles(np.broadcast_to(p, a.shape), a, b, c) - p, axis=-1
    ).min(1)


def chamfer(a: SurfacePoints, b: SurfacePoints) -> tuple[float, float, float]:
    """(mean of the two, a to b, b to a): mean distance from the samples of each surface to the
    other surface. Not squared."""
    to_b, to_a = (float(distance_to_surface(x.samples, y).mean()) for x, y in ((a, b), (b, a)))
    return 0.5 * (to_a + to_b), to_b, to_a


def point_chamfer(a, b, squared: bool = False) -> tuple[float, float, float]:
    """(mean of the two, a to b, b to a): mean distance, or squared distance, from each of the
    points (N, 3) to the nearest of the other points (M, 3). Two sets of samples of one surface do
    not reach 0, but about half the spacing of the samples."""
    power = 2 if squared else 1
    to_b, to_a = (
        float((cKDTree(y).query(x, workers=-1)[0] ** power).mean()) for x, y in ((a, b), (b, a))
    )
    return 0.5 * (to_a + to_b), to_b, to_a


def resize_environment(environment, height: int = 256, width: int = 512) -> np.ndarray:
    """Lat-long map (H, W, 3) resampled to height x width: area average where it shrinks, bilinear
    where it grows."""
    import cv2

    e = np.ascontiguousarray(environment, np.float32)
    shrink = e.shape[0] >= height and e.shape[1] >= width
    return cv2.resize(
        e, (width, height), interpolation=cv2.INTER_AREA if shrink else cv2.INTER_LINEAR
    )


def encoded_environment(environment, upper: bool = False) -> np.ndarray:
    """Lat-long map resampled to 256 x 512, clipped to [0, 1] and raised to 1/2.2. upper: only the
    rows of directions above the horizon (+y), (128, 512, 3)."""
    encoded = gamma_encode(resize_environment(environment))
    return encoded[: len(encoded) // 2] if upper else encoded


def environment_mse(predicted, truth, upper: bool = False) -> float:
    """SfD's figure: MSE of two lat-long maps as `encoded_environment` gives them, every texel
    alike."""
    p, t = (encoded_environment(e, upper) for e in (predicted, truth))
    return float(np.mean((p - t) ** 2))


def environment_log_rmse(predicted, truth) -> float:
    """Root mean square of the difference of log2 radiance (in stops), per solid angle, at 32 x 64,
    radiance below 1 % of the truth's mean raised to that. Unlike the clipped figure it sees the
    strength of lamps and the sun."""
    p, t = (resize_environment(e, 32, 64).astype(np.float64) for e in (predicted, truth))
    weight = environment_solid_angles(32, 64)[..., None]
    floor = 0.01 * (t * weight).sum() / (3 * weight.sum())
    d = np.log2(np.maximum(p, floor)) - np.log2(np.maximum(t, floor))
    return float(np.sqrt((d**2 * weight).sum() / (3 * weight.sum())))


def mask_iou(a, b) -> float:
    """Intersection over union of two coverages (H, W), each cut at one half."""
    a, b = np.asarray(a) >= 0.5, np.asarray(b) >= 0.5
    union = (a | b).sum()
    return float((a & b).sum() / union) if union else float("nan")

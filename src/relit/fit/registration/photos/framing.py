"""Photos that the frame cuts: what lies beyond it is unknown, not empty.

A statue photographed without its feet has another silhouette, with another middle and size. Hulls
and fits leave unknown pixels out, and
such a photo is searched for with place and scale free: its visible part is slid over every
rendering, at several sizes.
"""

from __future__ import annotations

import cv2
import mitsuba as mi
import numpy as np

from relit.fit.passes.pixels import PixelBank, make_bank
from relit.fit.registration.register import Crop, Hypotheses, Render, moments, pose_from_match
from relit.geometry.se3 import rotation_angle
from relit.scene import Camera

# pixels along the cut, of the square root of the silhouette's area, from which on a photo counts as
# cut
CUT = 0.3
# pixels of the pictures that are slid over each other; a rendering takes the middle quarter of its
# area
SIZE = 64
SPAN = 10.0  # pixels: spread of a whole silhouette there
SHARES = (1.0, 0.8, 0.64, 0.5, 0.4)  # sizes of the visible part's spread against the whole's
ROLLS = (-16.0, -8.0, 0.0, 8.0, 16.0)  # degrees in the picture
PARTS = (0.6, 1.0, 0.3)  # silhouette, chromaticity, log luminance, as in register.PARTS


def is_cut(crop: Crop) -> bool:
    """Whether the frame cuts the object of a crop."""
    inside = (crop.mask > 0.5) & (crop.weight > 0.5)
    beyond = cv2.dilate((crop.weight <= 0.5).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    return bool(
        (inside & beyond).sum() >= 2 * CUT * np.sqrt(max(inside.sum(), 1))
    )  # the dilated border is two pixels thick


def not_empty(crops: list[Crop]) -> list[np.ndarray]:
    """Masks for a hull: 1 where nothing is known of a cut object."""
    return [
        np.where(c.weight > 0.5, c.mask, 1.0).astype(np.float32) if is_cut(c) else c.mask
        for c in crops
    ]


def crop_bank(crops: list[Crop], cameras: list[Camera], shares=None) -> PixelBank:
    """The crops' pixels; of cut ones only those that are known are drawn, of all in proportion to
    shares (P,) in [0, 1], if there are."""
    bank = make_bank(cameras, [c.rgb for c in crops], [c.mask for c in crops])
    known = [(c.weight > 0.5).ravel() if is_cut(c) else np.ones(c.mask.size, bool) for c in crops]
    candidates = np.array(bank.candidates)
    candidates = candidates[np.concatenate(known)[candidates]]
    if shares is not None:
        view = np.searchsorted(np.array(bank.offsets), candidates, side="right") - 1
        candidates = candidates[
            np.random.default_rng(0).random(len(candidates)) < np.asarray(shares)[view]
        ]
    bank.candidates = mi.UInt32(candidates)
    return bank


def slide(
    crops: list[Crop],
    render: Render,
    cameras: list[Camera],
    keep: int = 3,
    allowed=None,
    prior=None,
    apart: float = 20.0,
) -> Hypotheses:
    """As `register.search` for cut crops of upright photos: the best poses with place, size and a
    little turn free.

    cameras: of the renderings, in the model's frame. allowed: (P, V) bool, prior: (P, V), added to
    the scores that decide.
    """
    rgb, alpha = render(cameras)
    centre, spread = moments(alpha)
    views = np.stack(
        [
            _described(_warped(c, m, None, at, s / SPAN))
            for c, m, at, s in zip(rgb, alpha, centre, spread, strict=True)
        ]
    )
    views = views.transpose(0, 3, 1, 2)
    plain = np.fft.rfft2(views, (2 * SIZE, 2 * SIZE)).astype(np.complex64)
    squares = np.fft.rfft2((views**2).sum(1), (2 * SIZE, 2 * SIZE)).astype(np.complex64)
    p, v = len(crops), len(cameras)
    poses, best, view = (
        np.tile(np.eye(4), (p, keep, 1, 1)),
        np.full((p, keep), -1.0),
        np.zeros((p, keep), int),
    )
    for i, crop in enumerate(crops):
        at, own = (a[0] for a in moments((crop.mask * crop.weight)[None]))
        seen = np.flatnonzero(allowed[i]) if allowed is not None else np.arange(v)
        found = []  # score, view, roll, share, shift
        for share in SHARES:
            for roll in ROLLS:
                picture = _warped(
                    crop.rgb, crop.mask, crop.weight, at, own / (share * SPAN), np.radians(roll)
                )
                scores, shifts = _slid(picture, plain[seen], squares[seen])
                found += [
                    (float(s), int(n), roll, share, d)
                    for s, n, d in zip(scores, seen, shifts, strict=True)
                ]
        extra = np.zeros(v) if prior is None else prior[i]
        kept = 0
        for score, n, roll, share, (dy, dx) in sorted(found, key=lambda f: -(f[0] + extra[f[1]])):
            if kept == keep:
                break
            # the crop's middle lies (dx, dy) off the view's; a pixel of the pictures is spread /
            # SPAN of each
            where = centre[n] + np.array([dx, dy]) * spread[n] / SPAN
            ratio = own / (share * SPAN) / (spread[n] / SPAN)
            pose = pose_from_match(
                crop.camera, cameras[n], where, 1.0, at, ratio, float(np.radians(roll))
            )
            if (
                kept
                and min(rotation_angle(pose[:3, :3].T @ q[:3, :3]) for q in poses[i, :kept]) < apart
            ):
                continue
            poses[i, kept], best[i, kept], view[i, kept] = pose, score, n
            kept += 1
    return Hypotheses(poses, best, view)


def _warped(rgb, mask, weight, centre, pixel: float, roll: float = 0.0):
    """(rgb, mask, weight) of SIZE x SIZE, `centre` in the middle, one pixel `pixel` of the old
    ones, turned back by `roll`."""
    c, s = np.cos(roll) * pixel, np.sin(roll) * pixel
    middle = SIZE / 2
    m = np.array(
        [[c, -s, centre[0] - c * middle + s * middle], [s, c, centre[1] - s * middle - c * middle]]
    )
    m[:, 2] += m[:, :2] @ [0.5, 0.5] - 0.5  # cv2's pixel centres lie at whole numbers
    flags = (
        cv2.INTER_AREA | cv2.WARP_INVERSE_MAP
        if pixel > 1.5
        else cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    )
    weight = np.ones(mask.shape, np.float32) if weight is None else weight
    return tuple(
        cv2.warpAffine(np.asarray(a, np.float32), m, (SIZE, SIZE), flags=flags)
        for a in (rgb, mask, weight)
    )


def _described(picture) -> np.ndarray:
    """(SIZE, SIZE, 5): silhouette, chromaticity and standardised log luminance, as
    register.rings_of."""
    rgb, mask, weight = picture
    inside = (mask > 0.5) * weight
    total = max(float(inside.sum()), 1e-6)
    solid = rgb / np.maximum(mask, 0.05)[..., None]
    tint = (solid * inside[..., None]).sum((0, 1)) / total
    solid = solid / np.maximum(tint, 1e-4)
    chroma = (solid / (solid.sum(-1, keepdims=True) + 0.15) - 1 / 3) * mask[..., None]
    bright = np.log(np.maximum(solid.mean(-1), 0) + 0.06)
    bright = (bright - (bright * inside).sum() / total) * (mask > 0.5)
    bright = np.clip(bright / (np.sqrt((bright**2 * inside).sum() / total) + 0.02), -2.5, 2.5)
    return np.concatenate(
        [PARTS[0] * mask[..., None], PARTS[1] * chroma, PARTS[2] * bright[..., None]], -1
    )


def _slid(picture, plain, squares):
    """Best normalised correlation (V,) of a photo's known pixels with each view, and the shift (V,
    2) (rows, columns) where it is."""
    f, w = _described(picture), picture[2]
    side = (2 * SIZE, 2 * SIZE)
    weighted = np.fft.rfft2((f * w[..., None]).transpose(2, 0, 1), side)
    top = np.fft.irfft2((plain * weighted.conj()).sum(1), side)
    below = np.fft.irfft2(squares * np.fft.rfft2(w, side).conj(), side)
    norm = np.sqrt((f**2 * w[..., None]).sum())
    score = top / (norm * np.sqrt(np.maximum(below, 1e-3)) + 1e-9)
    score[
        below < 0.15 * below.max((1, 2), keepdims=True)
    ] = -1  # next to nothing of the view would be looked at
    flat = score.reshape(len(score), -1)
    k = flat.argmax(1)
    shift = np.stack(np.unravel_index(k, side), 1)
    shift = (shift + SIZE) % (2 * SIZE) - SIZE
    return flat[np.arange(len(k)), k], shift

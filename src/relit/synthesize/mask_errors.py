"""Masks as a segmenter makes them, and things that stand in front of the object.

An error is drawn for each photo by shares: the outline wanders and is soft in all of them, some
miss a piece, some are wrong altogether (of another thing, empty, inverted). An occluder is painted
into the scene's radiance before the camera sees it; the true mask is then what is left of the
object.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from relit.synthesize.camera_model import REFERENCE, check_ranges, parse_settings

WRONG = ("other", "empty", "inverted")
SKIN = (0.45, 0.27, 0.19)  # linear albedo of a hand, times the light of the picture
STAND = (0.05, 0.05, 0.055)  # of a clamp or stand
HAND_WIDTH = (0.10, 0.16)  # of the shorter side of the object's box
STAND_WIDTH = (0.05, 0.09)
REACH = (0.15, 0.4)  # how far into the object's box an occluder comes, of the box
PIECE = (0.12, 0.3)  # radius of a missing piece, of the square root of the mask's area
ANOTHER = (0.15, 0.4)  # radius of another thing, of the shorter side of the photo


@dataclass(frozen=True)
class MaskErrors:
    """Settings of a segmenter; off by default. Pixels are those of a photo with REFERENCE pixels.

    outline: standard deviation by which the outline wanders, pixels, over stretches of `stretch`
    pixels. soft: width of the soft border, pixels. pieces: share of photos whose mask misses a
    piece. wrong: share of photos with a wrong mask, one of WRONG each. occluders: share of photos
    in which a hand or a stand is in front of the object.
    """

    outline: float = 0.0
    stretch: float = 6.0
    soft: float = 0.0
    pieces: float = 0.0
    wrong: float = 0.0
    occluders: float = 0.0

    def __post_init__(self) -> None:
        shares = dict.fromkeys(("pieces", "wrong", "occluders"), (0.0, 1.0))
        check_ranges(self, {"outline": (0, 40), "stretch": (0.5, 100), "soft": (0, 40), **shares})


PRESETS = {
    "off": MaskErrors(),
    "segmenter": MaskErrors(
        outline=1.5, stretch=6.0, soft=2.0, pieces=0.1, wrong=0.05, occluders=0.1
    ),
}


def parse_mask_errors(text: str) -> MaskErrors:
    """`parse_settings` of mask errors: 'segmenter', 'outline=2,wrong=.1'."""
    return parse_settings(text, PRESETS, "mask errors")


@dataclass(frozen=True)
class MaskFault:
    """What is drawn for one photo. piece: the mask misses one. wrong: one of WRONG or ''. occluder:
    'hand', 'stand' or ''. seed: of the shapes."""

    piece: bool
    wrong: str
    occluder: str
    seed: int


def draw_fault(errors: MaskErrors, seed: int) -> MaskFault:
    """The choices for one photo, deterministic."""
    rng = np.random.default_rng([seed, 67])
    u = rng.random(3)
    kind = WRONG[int(rng.integers(len(WRONG)))]
    thing = ("hand", "stand")[int(rng.integers(2))]
    return MaskFault(
        piece=bool(u[0] < errors.pieces),
        wrong=kind if u[1] < errors.wrong else "",
        occluder=thing if u[2] < errors.occluders else "",
        seed=int(seed),
    )


def segmented(mask: np.ndarray, errors: MaskErrors, fault: MaskFault) -> np.ndarray:
    """(H, W) float32 in [0, 1]: the true mask (H, W) with the errors of a segmenter."""
    mask = np.asarray(mask, np.float32)
    scale = max(mask.shape) / REFERENCE
    rng = np.random.default_rng([fault.seed, 68])
    if fault.wrong == "empty":
        return np.zeros_like(mask)
    if fault.wrong == "other":
        mask = _another(mask, rng)
    if fault.piece:
        mask = mask * (1 - _piece(mask, rng))
    if errors.outline or errors.soft:
        mask = wandering(mask, errors, scale, rng)
    return 1 - mask if fault.wrong == "inverted" else mask


def wandering(
    mask: np.ndarray, errors: MaskErrors, scale: float, rng: np.random.Generator
) -> np.ndarray:
    """The mask with an outline that wanders by smooth noise and a border of `soft` pixels."""
    inside = (mask > 0.5).astype(np.uint8)
    signed = cv2.distanceTransform(inside, cv2.DIST_L2, 5)
    signed = signed - cv2.distanceTransform(1 - inside, cv2.DIST_L2, 5)
    signed -= 0.5 * np.sign(signed)  # the outline runs between pixels
    if errors.outline:
        noise = rng.normal(size=mask.shape).astype(np.float32)
        noise = cv2.GaussianBlur(noise, (0, 0), max(errors.stretch * scale, 0.5))
        signed = signed + noise * (errors.outline * scale / max(float(noise.std()), 1e-9))
    width = max(errors.soft * scale, 1.0)
    return np.clip(0.5 + signed / width, 0, 1).astype(np.float32)


def _blob(shape, centre, radius: float, rng: np.random.Generator) -> np.ndarray:
    """(H, W) float32, 1 inside a lumpy disc."""
    y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float64)
    angle = np.arctan2(y - centre[1], x - centre[0])
    lumps = sum(rng.normal() * 0.12 * np.cos(k * angle + rng.uniform(0, 6.28)) for k in (2, 3, 5))
    distance = np.hypot(x - centre[0], y - centre[1])
    return (distance < radius * (1 + lumps)).astype(np.float32)


def _piece(mask: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A lumpy disc around a point of the mask."""
    points = np.argwhere(mask > 0.5)
    if not len(points):
        return np.zeros_like(mask)
    y, x = points[rng.integers(len(points))]
    return _blob(mask.shape, (x, y), rng.uniform(*PIECE) * np.sqrt(len(points)), rng)


def _another(mask: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The mask of something else: a lumpy disc anywhere in the photo, without the object."""
    h, w = mask.shape
    centre = (rng.uniform(0, w), rng.uniform(0, h))
    return _blob(mask.shape, centre, rng.uniform(*ANOTHER) * min(h, w), rng) * (mask < 0.5)


def occluded(
    radiance: np.ndarray, alpha: np.ndarray, fault: MaskFault
) -> tuple[np.ndarray, np.ndarray]:
    """The radiance (H, W, 3) with a hand or stand from the nearest border into the object, and the
    coverage (H, W) of what is left of the object. Unchanged without an occluder or object."""
    points = np.argwhere(alpha > 0.5)
    if not fault.occluder or not len(points):
        return radiance, alpha
    rng = np.random.default_rng([fault.seed, 69])
    cover, across = occluder_shape(alpha.shape, points, fault.occluder, rng)
    colour = np.array(SKIN if fault.occluder == "hand" else STAND, np.float32)
    light = max(float(np.clip(radiance, 0, 4).mean()), 1e-3) / 0.18  # a grey card's irradiance
    shade = np.sqrt(np.clip(1 - across**2, 0.04, 1))[..., None]  # a cylinder lit from the front
    cover = cover[..., None]
    painted = radiance * (1 - cover) + cover * colour * light * shade
    return painted.astype(np.float32), (alpha * (1 - cover[..., 0])).astype(np.float32)


def occluder_shape(
    shape: tuple[int, int], points: np.ndarray, kind: str, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Coverage (H, W) of rods with round ends, and the place across the rod, -1 to 1 (H, W).

    points: (N, 2) rows and columns of the object. A hand is four fingers side by side, a stand one
    straight rod."""
    h, w = shape
    (y0, x0), (y1, x1) = points.min(0), points.max(0)
    box = np.array([x1 - x0, y1 - y0], np.float64) + 1
    side = int(rng.integers(3))  # from the left, the right or below
    inward = np.array([(1.0, 0.0), (-1.0, 0.0), (0.0, -1.0)][side])
    along = np.array([inward[1], inward[0]])
    reach = rng.uniform(*REACH) * abs(box @ inward)
    edge = np.array([(x0, (y0 + y1) / 2), (x1, (y0 + y1) / 2), ((x0 + x1) / 2, y1)][side], float)
    tip = edge + inward * reach + along * rng.uniform(-0.25, 0.25) * abs(box @ along)
    start = tip - inward * (h + w)  # beyond the frame
    hand = kind == "hand"
    width = rng.uniform(*(HAND_WIDTH if hand else STAND_WIDTH)) * box.min()
    y, x = np.mgrid[:h, :w].astype(np.float64)
    cover, across = np.zeros(shape), np.zeros(shape)
    for k in range(4 if hand else 1):
        shift = (k - 1.5) * width * 1.02 if hand else 0.0
        short = inward * width * abs(k - 1.2) * 0.8 if hand else 0.0  # fingers differ in length
        a, b = start + along * shift, tip + along * shift - short
        t = ((x - a[0]) * (b - a)[0] + (y - a[1]) * (b - a)[1]) / ((b - a) @ (b - a))
        t = np.clip(t, 0, 1)
        distance = np.hypot(x - a[0] - t * (b - a)[0], y - a[1] - t * (b - a)[1])
        this = np.clip(width / 2 - distance + 0.5, 0, 1)
        across = np.where(this > cover, 2 * distance / width, across)
        cover = np.maximum(cover, this)
    return cover.astype(np.float32), across.astype(np.float32)


def fault_record(fault: MaskFault) -> dict[str, Any]:
    """For the truth file."""
    return {"piece": fault.piece, "wrong": fault.wrong, "occluder": fault.occluder}

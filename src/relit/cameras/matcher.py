"""Plug-in matchers in the place of SIFT: any function that finds corresponding points of two
pictures.

    relit reconstruct PHOTO -o RUN --capture duplicates --set matcher=mymodule:match

    def match(a, b):            # two (H, W, 3) uint8 sRGB pictures of single objects, grey
                                elsewhere
        return points_a, points_b       # (M, 2) each: corresponding positions in pixels, centres at
                                        +.5

ALIKED with LightGlue, or any other network, fits behind such a function of a few lines
(docs/duplicates.md). Objects in a pile are turned against each other about the line of sight, so
the second picture of each pair is turned before (SfD Sec. 3.1): in steps of `step` degrees, the
counts are smoothed over neighbouring turns, and the correspondences of the best turn are carried
back. SfD's steps are of 4 degrees, 90 calls a pair; steps of STEP, and FINE to both sides of the
best, are 17, and a network is seldom so fast that 90 are borne.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable
from itertools import combinations

import cv2
import numpy as np

from relit.cameras.rotation_sweep import CHANCE, LEAST, SIDE, Features, Link, verified
from relit.conventions import srgb_from_linear
from relit.errors import UserError
from relit.scene import Camera

STEP = 24  # degrees: matchers for upright photos stand half of it
FINE = 8  # degrees away from the best turn, tried on both sides
SAME = 0.5  # pixels of the enlarged window within which two points of a picture are one keypoint

Matcher = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


def load_matcher(setting: str) -> Matcher:
    """The function that 'module:function' names; modules in the working directory are found. Raises
    UserError (code 2)."""
    module, colon, name = setting.partition(":")
    if not (module and colon and name):
        raise UserError(
            f"'{setting}' names no matcher", fix="write matcher=module:function", code=2
        )
    here = os.getcwd()
    sys.path.insert(0, here)
    try:
        found = getattr(importlib.import_module(module), name)
    except Exception as error:  # whatever a user's module raises
        raise UserError(
            f"the matcher '{setting}' could not be loaded",
            f"{type(error).__name__}: {error}",
            "check the module",
            code=2,
        ) from None
    finally:
        sys.path.remove(here)
    if not callable(found):
        raise UserError(f"the matcher '{setting}' is no function", code=2)
    return found  # pyright: ignore[reportReturnType]


def matcher_picture(rgb: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, float]:
    """(picture as matchers take it, its pixels for one of the window)."""
    s = SIDE / max(rgb.shape[:2])
    size = (round(rgb.shape[1] * s), round(rgb.shape[0] * s))
    inside = mask > 0.5
    high = float(np.percentile(rgb[inside].max(-1), 99)) if inside.any() else 1.0
    code = np.where(inside[..., None], srgb_from_linear(np.clip(rgb / max(high, 1e-6), 0, 1)), 0.5)
    return cv2.resize(np.round(code * 255).astype(np.uint8), size, interpolation=cv2.INTER_CUBIC), s


def rotated_picture(picture: np.ndarray, degrees: float) -> tuple[np.ndarray, np.ndarray]:
    """The picture turned about its middle, in a frame that holds it whole, and the (2, 3) map from
    its pixels to the picture's."""
    h, w = picture.shape[:2]
    m = cv2.getRotationMatrix2D((w / 2, h / 2), degrees, 1.0)
    c, s = abs(m[0, 0]), abs(m[0, 1])
    width, height = int(np.ceil(w * c + h * s)), int(np.ceil(w * s + h * c))
    m[:, 2] += (width / 2 - w / 2, height / 2 - h / 2)
    # cv2 counts from pixel middles, the map from pixel corners
    centres = m.copy()
    centres[:, 2] += m[:, :2] @ (0.5, 0.5) - 0.5
    out = cv2.warpAffine(
        picture, centres, (width, height), flags=cv2.INTER_LINEAR, borderValue=(128, 128, 128)
    )
    return out, cv2.invertAffineTransform(m)


def matches_at(
    matcher: Matcher, a: np.ndarray, b: np.ndarray, degrees: float
) -> tuple[np.ndarray, np.ndarray]:
    """Corresponding points (M, 2) of two pictures, b being turned for the matcher. Raises UserError
    for what is no such answer."""
    picture, back = rotated_picture(b, degrees)
    try:
        p, q = (np.asarray(x, np.float64).reshape(-1, 2) for x in matcher(a, picture))
        if len(p) != len(q) or not (np.isfinite(p).all() and np.isfinite(q).all()):
            raise ValueError(f"{len(p)} and {len(q)} points")
    except Exception as error:  # whatever a user's function raises or returns
        raise UserError(
            "the matcher failed",
            f"{type(error).__name__}: {error}",
            "it must return two (M, 2) arrays of points",
        ) from None
    return p, q @ back[:, :2].T + back[:, 2]


def link_by_matcher(
    matcher: Matcher,
    windows: list[tuple],
    cameras: list[Camera],
    error: float,
    *,
    sweep: bool = True,
    step: int = STEP,
) -> tuple[list[Features], dict[tuple[int, int], Link]]:
    """As `find_features` and `link_instances` together. windows: (rgb, mask, offset in the photo)
    of each instance. step: degrees of the sweep, a divisor of 360; FINE degrees to both sides of
    the best turn are tried where steps are longer."""
    pictures = [matcher_picture(rgb, mask) for rgb, mask, _ in windows]
    points: list[list] = [[] for _ in windows]

    def photo_points(k: int, p: np.ndarray) -> np.ndarray:
        return p / pictures[k][1] + np.asarray(windows[k][2])

    def count(i: int, j: int, degrees: float) -> int:
        return len(matches_at(matcher, pictures[i][0], pictures[j][0], degrees)[0])

    def link_at(i: int, j: int, degrees: float) -> tuple[Link | None, np.ndarray, np.ndarray]:
        p, q = matches_at(matcher, pictures[i][0], pictures[j][0], degrees)
        if len(p) < LEAST:
            return None, p, q
        index = np.arange(len(p))
        empty = np.zeros((0, 0, 0), np.float32)
        a, b = Features(photo_points(i, p), empty), Features(photo_points(j, q), empty)
        return verified(Link(index, index, degrees), a, b, cameras[i], error, cameras[j]), p, q

    links = {}
    for i, j in combinations(range(len(windows)), 2):
        best = 0.0
        if sweep:
            turns = np.arange(0, 360, step, dtype=float)
            counts = np.array([count(i, j, t) for t in turns], float)
            best = turns[np.argmax(sum(np.roll(counts, k) for k in (-1, 0, 1)))]
            tries = (
                [best, best - FINE, best + FINE]
                if step > FINE
                else [best - step, best, best + step]
            )
            found = {
                t % 360: n for t, n in zip(turns, counts, strict=True)
            }  # what was counted is not asked again
            best = max(tries, key=lambda t: found[t % 360] if t % 360 in found else count(i, j, t))
        link, p, q = link_at(i, j, best)
        if link is None:
            continue
        wrong = [link_at(i, j, best + away)[0] for away in (90, 180, 270)] if sweep else []
        if len(link.a) < CHANCE * max(
            [LEAST / CHANCE, *(len(w.a) for w in wrong if w is not None)]
        ):
            continue
        a, b = (keypoints(points[k], x[at]) for k, x, at in ((i, p, link.a), (j, q, link.b)))
        links[i, j] = Link(a, b, best % 360, link.rotation)
    empty = np.zeros((0, 0, 0), np.float32)
    return [
        Features(photo_points(k, np.array(p).reshape(-1, 2)), empty) for k, p in enumerate(points)
    ], links


def keypoints(known: list, p: np.ndarray) -> np.ndarray:
    """Numbers of points (M, 2) among the keypoints of a picture, which grows by those that are
    new."""
    out = np.zeros(len(p), int)
    for n, x in enumerate(p):
        away = np.linalg.norm(np.array(known).reshape(-1, 2) - x, axis=1)
        if len(away) and away.min() < SAME:
            out[n] = int(away.argmin())
        else:
            out[n] = len(known)
            known.append(x)
    return out

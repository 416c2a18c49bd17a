"""What one instance shows against what the others show at the same places of the object, by optical flow.

For a pair of views the second one's photo is brought into the first by way of the mesh and the two poses. Where mesh and poses are right
the two pictures lie on each other; where not, dense flow between them (DIS: Kroeger et al. 2016), both freed of brightness and contrast,
says by how many pixels of the first view a place of the surface is off. Only shifts count that the flow back confirms, at places with
structure in two directions whose surroundings then look alike.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import permutations

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from relit.conventions import srgb_from_linear
from relit.fit.outlines import trace
from relit.fit.unseen import seen_points
from relit.rendering.mitsuba_scene import build_geometry
from relit.scene import Camera, Mesh

ACROSS = 100.0  # degrees between two lines of sight up to which pictures are compared
NEIGHBOURS = 6  # views that each is compared with, the nearest ones
GRAZING = 0.25  # cosine, below which a place is not looked up
LOCAL = 6.0  # pixels, the neighbourhood whose brightness and contrast do not count
PATCH = 3.0  # pixels, the neighbourhood that must look alike
ALIKE = 0.6  # correlation of two patches
STRUCTURE = 0.006  # smaller eigenvalue of the structure tensor, in contrasts a pixel, squared
CLEAR = 0.98  # quantile of it, from which on places count in full
BORDER = 0.1, 9  # of the root of the area that both views show, and pixels at most: so much along its border does not count
DIM = 0.15  # of the tint; what is darker has hardly a colour
BACK = 0.7  # pixels by which there and back may miss
FARTHEST = 12.0  # pixels
SAMPLES = 250  # of a pair at most
LEAST = 20  # of a pair, or it is left out
OVERLAP = 400  # pixels that a pair must share


@dataclass(frozen=True)
class Shifts:
    """Places (N,) that view `other` shows as well as view `view`. corners, weights: (N, 3) vertices of the faces there, and their shares.
    point, normal: (N, 3) in the frame of the mesh. shift: (N, 2) pixels of `view` by which the place must move there, x and y. structure:
    (N,) of the picture there, see STRUCTURE."""

    view: int
    other: int
    corners: np.ndarray
    weights: np.ndarray
    point: np.ndarray
    normal: np.ndarray
    shift: np.ndarray
    structure: np.ndarray


@dataclass(frozen=True)
class Shown:
    """What a view shows of the mesh, (h, w) and (h, w, 3): is it hit inside the mask, vertices of the face, their shares, place, normal."""

    hit: np.ndarray
    corners: np.ndarray
    weights: np.ndarray
    point: np.ndarray
    normal: np.ndarray


def texture_shifts(mesh: Mesh, cameras: list[Camera], pictures: list[np.ndarray], masks: list[np.ndarray]) -> list[Shifts]:
    """Of all pairs of views that look from similar sides, in both orders. cameras: in the frame of the mesh. pictures: (h, w, 3) linear.
    masks: (h, w). Pairs that share too little, or hardly any structure, are left out."""
    scene = build_geometry(mesh)
    shown = [shown_by(mesh, scene, c, m) for c, m in zip(cameras, masks, strict=True)]
    tint = tint_of(pictures, masks)
    channels = [channels_of(p, tint) for p in pictures]
    pairs = [(i, j, shown[i], masks[j]) for i, j in neighbours(cameras)]
    return shifts_between(mesh, scene, pairs, cameras, channels)


def shifts_between(mesh: Mesh, scene, pairs: list[tuple[int, int, Shown, np.ndarray]], cameras: list[Camera], channels) -> list[Shifts]:
    """Of each pair of views i, j: what i shows, and the mask (h, w) of j. channels: (h, w, C) of each view; each that has structure
    counts for itself."""
    met = [met_by(scene, shown, cameras[j], mask) for _, j, shown, mask in pairs]
    with ThreadPoolExecutor(os.cpu_count()) as pool:  # OpenCV and numpy let go of the interpreter
        found = list(pool.map(lambda pair, there: flows_of(pair[2], channels[pair[0]], channels[pair[1]], *there), pairs, met))
    return [shifts_of(mesh, scene, i, j, cameras[i], *flow) for (i, j, *_), flows in zip(pairs, found, strict=True) for flow in flows]


def misfit(shifts: list[Shifts]) -> float:
    """Median length of the shifts in pixels, by what they count (see `shares`); 0 where there are none."""
    if not shifts:
        return 0.0
    length, weight = np.concatenate([np.linalg.norm(s.shift, axis=1) for s in shifts]), np.concatenate(shares(shifts))
    order = np.argsort(length)
    return float(length[order][np.searchsorted(np.cumsum(weight[order]), weight.sum() / 2)])


def shares(shifts: list[Shifts]) -> list[np.ndarray]:
    """What each place counts: flow is the surer, and the likelier right at all, the more structure there is. What most weight lies on
    counts 1."""
    clear = clear_of(shifts)
    some = [np.minimum(s.structure / clear, 1) ** 2 for s in shifts]
    every = np.concatenate(some)
    return [s * every.sum() / (every**2).sum() for s in some]


def clear_of(shifts: list[Shifts]) -> float:
    """The structure from which on places count in full."""
    return float(np.quantile(np.concatenate([s.structure for s in shifts]), CLEAR))


def neighbours(cameras: list[Camera]) -> list[tuple[int, int]]:
    """Ordered pairs of views from sides that are near one another. The object is about the origin."""
    sides = np.array([c.centre / np.linalg.norm(c.centre) for c in cameras])
    cosines = sides @ sides.T
    nearest = np.argsort(-cosines - 2 * np.eye(len(cameras)), axis=1)[:, :NEIGHBOURS]
    return [(i, j) for i, j in permutations(range(len(cameras)), 2) if cosines[i, j] > np.cos(np.radians(ACROSS)) and j in nearest[i]]


def shown_by(mesh: Mesh, scene, camera: Camera, mask: np.ndarray) -> Shown:
    """Of all pixels of a view."""
    y, x = np.mgrid[: mask.shape[0], : mask.shape[1]]
    hit, *places = places_of(mesh, scene, camera, x.ravel() + 0.5, y.ravel() + 0.5)
    return Shown(hit.reshape(mask.shape) & (mask > 0.5), *(a.reshape(*mask.shape, 3) for a in places))


def places_of(mesh: Mesh, scene, camera: Camera, x: np.ndarray, y: np.ndarray):
    """hit (N,), corners, weights, points and normals (N, 3) of what positions (N,) in a picture show, as in `Shown`."""
    depth, face, uv = trace(scene, camera, x, y)
    hit = np.isfinite(depth)
    corners, uv = mesh.faces[np.where(hit, face, 0)], np.where(hit[:, None], uv, 0)
    weights = np.stack([1 - uv.sum(1), uv[:, 0], uv[:, 1]], -1)
    point, normal = ((of[corners] * weights[..., None]).sum(1).astype(np.float64) for of in (mesh.vertices, mesh.normals))
    return hit, corners, weights, point, normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)


def flows_of(shown: Shown, here: np.ndarray, there: np.ndarray, both: np.ndarray, x: np.ndarray, y: np.ndarray) -> list:
    """Of a view that shows `shown` against another one; of each of their channels, here and there (h, w, C), that has structure: rows and
    columns (N,) of at most SAMPLES pixels, flow (N, 2) and structure (N,) there. both, x, y: see `met_by`."""
    out = []
    if both.sum() < OVERLAP:
        return out
    (top, bottom), (left, right) = ((a.min(), a.max() + 1) for a in np.nonzero(both))
    box = np.s_[top:bottom, left:right]
    for mine, other in zip(np.moveaxis(here, -1, 0), np.moveaxis(there, -1, 0), strict=True):
        brought = brought_to(shown, other, x, y)
        flow, structure = confirmed_flow(contrasts(mine[box], both[box]), contrasts(brought[box], both[box]), both[box])
        row, column = np.nonzero(structure)
        if len(row) < LEAST:
            continue
        chosen = np.unique(np.linspace(0, len(row) - 1, min(SAMPLES, len(row))).round().astype(int))
        row, column = row[chosen], column[chosen]
        out.append((row + top, column + left, flow[row, column].astype(np.float64), structure[row, column]))
    return out


def shifts_of(mesh: Mesh, scene, i: int, j: int, camera: Camera, row, column, flow: np.ndarray, structure: np.ndarray) -> Shifts:
    """Of view i against view j, from their flow (see `flows_of`). camera: of view i."""
    # where the other shows that place now
    hit, *places = places_of(mesh, scene, camera, column + 0.5 + flow[:, 0], row + 0.5 + flow[:, 1])
    return Shifts(i, j, *(a[hit] for a in (*places, -flow, structure)))


def met_by(scene, shown: Shown, camera: Camera, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """((h, w) bool, which pixels of what a view shows a camera sees too, inside its mask; where it sees all that is hit, x and y (N,))."""
    point = shown.point[shown.hit]
    x, y, _ = camera.project(point).T
    common = seen_points(scene, point, shown.normal[shown.hit], [camera], GRAZING)
    common &= map_coordinates(mask, [y - 0.5, x - 0.5], order=1, mode="constant") > 0.9
    both = np.zeros(shown.hit.shape, bool)
    both[shown.hit] = common
    return both, x, y


def brought_to(shown: Shown, picture: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(h, w) of a view: what a picture has at positions (N,), where the view hits."""
    brought = np.zeros(shown.hit.shape, np.float32)
    brought[shown.hit] = map_coordinates(picture, [y - 0.5, x - 0.5], order=1, mode="nearest")
    return brought


def tint_of(pictures, masks) -> np.ndarray:
    """(3,) mean colour of what pictures (h, w, 3) show inside their masks (h, w)."""
    return np.mean([p[m > 0.5].mean(0) for p, m in zip(pictures, masks, strict=True)], 0)


def channels_of(picture: np.ndarray, tint: np.ndarray) -> np.ndarray:
    """(h, w, 3) of a picture (h, w, 3): its brightness as displays show it, and the shares of red and blue against a tint (3,), which
    shading and what is mirrored in the object's own colour leave alone."""
    solid = np.maximum(picture, 0) / np.maximum(tint, 1e-4)
    red_and_blue = solid[..., [0, 2]] / (solid.sum(-1, keepdims=True) + DIM)
    return np.concatenate([brightness(picture)[..., None], red_and_blue], -1).astype(np.float32)


def brightness(picture: np.ndarray) -> np.ndarray:
    """(h, w) of a picture (h, w, 3), as displays show it."""
    return srgb_from_linear(np.clip(picture, 0, 1)).mean(-1).astype(np.float32)


def contrasts(picture: np.ndarray, where: np.ndarray) -> np.ndarray:
    """The picture (h, w) less its local mean, over its local deviation, 0 outside."""
    inside = where.astype(np.float32)
    share = np.maximum(cv2.GaussianBlur(inside, (0, 0), LOCAL), 1e-3)
    away = (picture - cv2.GaussianBlur(picture * inside, (0, 0), LOCAL) / share) * inside
    return away / (np.sqrt(cv2.GaussianBlur(away**2, (0, 0), LOCAL) / share) + 0.02) * inside


def around(picture: np.ndarray) -> np.ndarray:
    """The mean over each pixel's PATCH."""
    return cv2.GaussianBlur(picture, (0, 0), PATCH)


def structure_of(picture: np.ndarray, where: np.ndarray) -> np.ndarray:
    """(h, w) of a picture of contrasts (h, w): the smaller eigenvalue of its structure tensor, 0 where that is little, and along the border
    of `where`, (h, w) bool: what ends where both pictures do has not moved."""
    right, down = (cv2.Sobel(picture, cv2.CV_32F, *axis) / 8 for axis in ((1, 0), (0, 1)))
    xx, yy, xy = around(right**2), around(down**2), around(right * down)
    structure = (xx + yy) / 2 - np.hypot((xx - yy) / 2, xy)
    border = int(min(BORDER[0] * np.sqrt(where.sum()), BORDER[1]))
    inner = cv2.erode(np.pad(where, 1).astype(np.uint8), np.ones((2 * border + 1, 2 * border + 1), np.uint8))[1:-1, 1:-1] > 0
    return np.where(inner & (structure > STRUCTURE), structure, 0)


def confirmed_flow(a: np.ndarray, b: np.ndarray, where: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(flow (h, w, 2) with a(x) = b(x + flow), structure (h, w) where it is to be believed, else 0) of two pictures of contrasts."""
    structure = structure_of(a, where)
    if np.count_nonzero(structure) < LEAST:
        return np.zeros((*a.shape, 2), np.float32), np.zeros_like(structure)
    dis = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    grey = [np.clip(40 * p + 128, 0, 255).astype(np.uint8) for p in (a, b)]
    flow, back = dis.calc(*grey, None), dis.calc(*grey[::-1], None)
    y, x = np.mgrid[: a.shape[0], : a.shape[1]].astype(np.float32)

    def moved(picture):
        return cv2.remap(picture, x + flow[..., 0], y + flow[..., 1], cv2.INTER_LINEAR)

    returns = np.hypot(flow[..., 0] + moved(back[..., 0]), flow[..., 1] + moved(back[..., 1])) < BACK
    c = moved(b)
    spread = np.maximum((around(a * a) - around(a) ** 2) * (around(c * c) - around(c) ** 2), 1e-6)
    alike = (around(a * c) - around(a) * around(c)) / np.sqrt(spread) > ALIKE
    stays = moved(where.astype(np.float32)) > 0.99
    return flow, np.where(stays & returns & alike & (np.hypot(*np.moveaxis(flow, -1, 0)) < FARTHEST), structure, 0)

"""What one instance shows against what the others show at the same places of the object, by optical flow.

For a pair of views the second one's photo is brought into the first by way of the mesh and the two poses. Where mesh and poses are right
the two pictures lie on each other; where not, dense flow between them (DIS: Kroeger et al. 2016), both freed of brightness and contrast,
says by how many pixels of the first view a place of the surface is off. Only shifts count that the flow back confirms, at places with
structure in two directions whose surroundings then look alike.
"""

from __future__ import annotations

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

ACROSS = 60.0  # degrees between two lines of sight up to which pictures are compared
NEIGHBOURS = 6  # views that each is compared with, the nearest ones
GRAZING = 0.25  # cosine, below which a place is not looked up
LOCAL = 6.0  # pixels, the neighbourhood whose brightness and contrast do not count
PATCH = 3.0  # pixels, the neighbourhood that must look alike
ALIKE = 0.6  # correlation of two patches
STRUCTURE = 0.003  # smaller eigenvalue of the structure tensor, in contrasts a pixel, squared
BACK = 0.7  # pixels by which there and back may miss
FARTHEST = 12.0  # pixels
SAMPLES = 250  # of a pair at most
LEAST = 20  # of a pair, or it is left out
OVERLAP = 400  # pixels that a pair must share


@dataclass(frozen=True)
class Shifts:
    """Places (N,) that view `other` shows as well as view `view`. corners, weights: (N, 3) vertices of the faces there, and their shares.
    point, normal: (N, 3) in the frame of the mesh. shift: (N, 2) pixels of `view` by which the place must move there, x and y."""

    view: int
    other: int
    corners: np.ndarray
    weights: np.ndarray
    point: np.ndarray
    normal: np.ndarray
    shift: np.ndarray


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
    found = [shifts_of(mesh, scene, i, j, shown[i], cameras, pictures, masks[j]) for i, j in neighbours(cameras)]
    return [one for one in found if one is not None]


def misfit(shifts: list[Shifts]) -> float:
    """Median length of the shifts in pixels; 0 where there are none."""
    lengths = [np.linalg.norm(s.shift, axis=1) for s in shifts]
    return float(np.median(np.concatenate(lengths))) if lengths else 0.0


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


def shifts_of(mesh: Mesh, scene, i: int, j: int, shown: Shown, cameras: list[Camera], pictures, mask: np.ndarray) -> Shifts | None:
    """Of view i, which shows `shown`, against view j with its mask."""
    point = shown.point[shown.hit]
    x, y, _ = cameras[j].project(point).T
    common = seen_points(scene, point, shown.normal[shown.hit], [cameras[j]], GRAZING)
    common &= map_coordinates(mask, [y - 0.5, x - 0.5], order=1, mode="constant") > 0.9
    both = np.zeros(shown.hit.shape, bool)
    both[shown.hit] = common
    if both.sum() < OVERLAP:
        return None
    brought = np.zeros(both.shape, np.float32)
    brought[shown.hit] = map_coordinates(brightness(pictures[j]), [y - 0.5, x - 0.5], order=1, mode="nearest")
    a, b = contrasts(brightness(pictures[i]), both), contrasts(brought, both)
    flow, good = confirmed_flow(a, b, both)
    row, column = np.nonzero(good)
    if len(row) < LEAST:
        return None
    chosen = np.unique(np.linspace(0, len(row) - 1, min(SAMPLES, len(row))).round().astype(int))
    row, column = row[chosen], column[chosen]
    shift = flow[row, column].astype(np.float64)
    # where the other shows that place now
    hit, *places = places_of(mesh, scene, cameras[i], column + 0.5 + shift[:, 0], row + 0.5 + shift[:, 1])
    return Shifts(i, j, *(a[hit] for a in (*places, -shift)))


def brightness(picture: np.ndarray) -> np.ndarray:
    """(h, w) of a picture (h, w, 3), as displays show it."""
    return srgb_from_linear(np.clip(picture, 0, 1)).mean(-1).astype(np.float32)


def contrasts(picture: np.ndarray, where: np.ndarray) -> np.ndarray:
    """The picture (h, w) less its local mean, over its local deviation, 0 outside."""
    inside = where.astype(np.float32)
    share = np.maximum(cv2.GaussianBlur(inside, (0, 0), LOCAL), 1e-3)
    away = (picture - cv2.GaussianBlur(picture * inside, (0, 0), LOCAL) / share) * inside
    return away / (np.sqrt(cv2.GaussianBlur(away**2, (0, 0), LOCAL) / share) + 0.02) * inside


def confirmed_flow(a: np.ndarray, b: np.ndarray, where: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(flow (h, w, 2) with a(x) = b(x + flow), where it is to be believed (h, w)) of two pictures of contrasts."""
    dis = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    grey = [np.clip(40 * p + 128, 0, 255).astype(np.uint8) for p in (a, b)]
    flow, back = dis.calc(*grey, None), dis.calc(*grey[::-1], None)
    y, x = np.mgrid[: a.shape[0], : a.shape[1]].astype(np.float32)

    def moved(picture):
        return cv2.remap(picture, x + flow[..., 0], y + flow[..., 1], cv2.INTER_LINEAR)

    def around(picture):
        return cv2.GaussianBlur(picture, (0, 0), PATCH)

    returns = np.hypot(flow[..., 0] + moved(back[..., 0]), flow[..., 1] + moved(back[..., 1])) < BACK
    c = moved(b)
    spread = np.maximum((around(a * a) - around(a) ** 2) * (around(c * c) - around(c) ** 2), 1e-6)
    alike = (around(a * c) - around(a) * around(c)) / np.sqrt(spread) > ALIKE
    right, down = (cv2.Sobel(a, cv2.CV_32F, *axis) / 8 for axis in ((1, 0), (0, 1)))
    xx, yy, xy = around(right**2), around(down**2), around(right * down)
    structured = (xx + yy) / 2 - np.hypot((xx - yy) / 2, xy) > STRUCTURE
    inner = cv2.erode(where.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    stays = moved(where.astype(np.float32)) > 0.99
    return flow, inner & stays & returns & alike & structured & (np.hypot(*np.moveaxis(flow, -1, 0)) < FARTHEST)

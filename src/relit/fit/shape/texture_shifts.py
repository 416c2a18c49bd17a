"""What one instance shows against what the others show at the same places of the object, by optical
flow.

For a pair of views the second one's photo is brought into the first by way of the mesh and the two
poses. Where mesh and poses are right the two pictures lie on each other; where not, dense flow
between them (DIS: Kroeger et al. 2016), both freed of brightness and contrast, says by how many
pixels of the first view a place of the surface is off. Only shifts count that the flow back
confirms, at places with structure in two directions whose surroundings then look alike.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from relit.conventions import srgb_from_linear
from relit.fit.shape.outlines import trace_rays
from relit.fit.shape.unseen import clear, facing, sight_rays
from relit.reference.mitsuba_scene import build_geometry
from relit.scene import Camera, Mesh

ACROSS = 100.0  # degrees between two lines of sight up to which pictures are compared
NEIGHBOURS = 6  # views that each is compared with, the nearest ones
GRAZING = 0.25  # cosine, below which a place is not looked up
LOCAL = 6.0  # pixels, the neighbourhood whose brightness and contrast do not count
PATCH = 3.0  # pixels, the neighbourhood that must look alike
ALIKE = 0.6  # correlation of two patches
STRUCTURE = 0.006  # smaller eigenvalue of the structure tensor, in contrasts a pixel, squared
CLEAR = 0.98  # quantile of it, from which on places count in full
BORDER = (
    0.1,
    9,
    # of the root of the area that both views show, and pixels at most: so much along its border does
    # not count
)
DIM = 0.15  # of the tint; what is darker has hardly a colour
BACK = 0.7  # pixels by which there and back may miss
FARTHEST = 12.0  # pixels
SAMPLES = 500  # of a pair at most
LEAST = 20  # of a pair, or it is left out
OVERLAP = 400  # pixels that a pair must share


@dataclass(frozen=True)
class Shifts:
    """Places (N,) that view `other` shows as well as view `view`. corners, weights: (N, 3) vertices
    of the faces there, and their shares.
    point, normal: (N, 3) in the frame of the mesh. shift: (N, 2) pixels of `view` by which the
    place must move there, x and y. structure: (N,) of the picture there, see STRUCTURE."""

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
    """What a view shows of the mesh. hit: (h, w) bool, where it is hit inside the mask. point,
    normal: (N, 3) there, row by row."""

    hit: np.ndarray
    point: np.ndarray
    normal: np.ndarray


@dataclass(frozen=True)
class Faced:
    """Which pixels of what a view shows another camera may see. pixels: (M,) among those that are
    hit. x, y: (N,) where it sees each of those. rays: see `unseen.sight_rays`, of `pixels`."""

    pixels: np.ndarray
    x: np.ndarray
    y: np.ndarray
    rays: tuple[np.ndarray, np.ndarray, np.ndarray]


def texture_shifts(
    mesh: Mesh, cameras: list[Camera], pictures: list[np.ndarray], masks: list[np.ndarray]
) -> list[Shifts]:
    """Of all pairs of views that look from similar sides. cameras: in the frame of the mesh.
    pictures: (h, w, 3) linear.
    masks: (h, w). Pairs that share too little, or hardly any structure, are left out."""
    scene = build_geometry(mesh)
    shown = [shown_by(mesh, scene, c, m) for c, m in zip(cameras, masks, strict=True)]
    tint = tint_of(pictures, masks)
    channels = [display_channels(p, tint) for p in pictures]
    pairs = [(i, j, shown[i], masks[j]) for i, j in neighbouring_views(cameras)]
    return shifts_between(mesh, scene, pairs, cameras, channels)


def shifts_between(
    mesh: Mesh,
    scene,
    pairs: list[tuple[int, int, Shown, np.ndarray]],
    cameras: list[Camera],
    channels,
) -> list[Shifts]:
    """Of each pair of views i, j: what i shows, and the mask (h, w) of j. channels: (h, w, C) of
    each view; each that has structure counts for itself."""
    with threads_of_pairs() as pool:
        faced = pool.map(lambda pair: faced_by(pair[2], cameras[pair[1]], pair[3]), pairs)
        found = [
            pool.submit(flows_of, shown, channels[i], channels[j], *met_of(scene, shown, one))
            for (i, j, shown, _), one in zip(pairs, faced, strict=True)
        ]
        flows = [one.result() for one in found]
    return [
        shifts_of(mesh, scene, i, j, cameras[i], *flow)
        for (i, j, *_), some in zip(pairs, flows, strict=True)
        for flow in some
    ]


@contextmanager
def threads_of_pairs():
    """A pool in which each pair is looked at by one thread: OpenCV and numpy let go of the
    interpreter, and OpenCV's own threads, by whose number its flow differs, rest meanwhile."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            yield pool
    finally:
        cv2.setNumThreads(before)


def shift_quantile(shifts: list[Shifts], part: float = 0.5) -> float:
    """Length in pixels that so large a part of the shifts does not exceed, by what they count (see
    `flow_weights`), or their median; 0 where there are none."""
    if not shifts:
        return 0.0
    length, weight = (
        np.concatenate([np.linalg.norm(s.shift, axis=1) for s in shifts]),
        np.concatenate(flow_weights(shifts)),
    )
    order = np.argsort(length)
    return float(length[order][np.searchsorted(np.cumsum(weight[order]), part * weight.sum())])


def flow_weights(shifts: list[Shifts]) -> list[np.ndarray]:
    """What each place counts: flow is the surer, and the likelier right at all, the more structure
    there is. What most weight lies on counts 1."""
    clear = clear_of(shifts)
    some = [np.minimum(s.structure / clear, 1) ** 2 for s in shifts]
    every = np.concatenate(some)
    return [s * every.sum() / (every**2).sum() for s in some]


def clear_of(shifts: list[Shifts]) -> float:
    """The structure from which on places count in full."""
    return float(np.quantile(np.concatenate([s.structure for s in shifts]), CLEAR))


def neighbouring_views(cameras: list[Camera]) -> list[tuple[int, int]]:
    """Pairs of views from sides that are near one another, each once: what one shows against the
    other is what the other shows against it. The object is about the origin."""
    sides = np.array([c.centre / np.linalg.norm(c.centre) for c in cameras])
    cosines = sides @ sides.T
    nearest = np.argsort(-cosines - 2 * np.eye(len(cameras)), axis=1)[:, :NEIGHBOURS]
    near = cosines > np.cos(np.radians(ACROSS))
    pairs = [
        (i, j)
        for i, j in combinations(range(len(cameras)), 2)
        if near[i, j] and (j in nearest[i] or i in nearest[j])
    ]
    return [
        (i, j) if (i + j) % 2 else (j, i) for i, j in pairs
    ]  # as often as not into the one that comes first


def shown_by(mesh: Mesh, scene, camera: Camera, mask: np.ndarray) -> Shown:
    """Of all pixels of a view."""
    row, column = np.nonzero(mask > 0.5)
    there, _, _, point, normal = places_of(mesh, scene, camera, column + 0.5, row + 0.5)
    hit = np.zeros(mask.shape, bool)
    hit[row, column] = there
    return Shown(hit, point, normal)


def places_of(mesh: Mesh, scene, camera: Camera, x: np.ndarray, y: np.ndarray):
    """hit (N,), which of N positions in a picture show the mesh; and of these, (M, 3) each, the
    vertices of the face, their shares, the point and the normal."""
    depth, face, uv = trace_rays(scene, camera, x, y)
    hit = np.isfinite(depth)
    corners, (u, v) = mesh.faces[face[hit]], uv[hit].T
    weights = np.stack([1 - u - v, u, v], -1)
    point, normal = (
        np.einsum("ik,ikc->ic", weights, of[corners], dtype=np.float64)
        for of in (mesh.vertices, mesh.normals)
    )
    return (
        hit,
        corners,
        weights,
        point,
        normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9),
    )


def flows_of(
    shown: Shown,
    here: np.ndarray,
    there: np.ndarray,
    both: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
) -> list:
    """Of a view that shows `shown` against another one; of each of their channels, here and there
    (h, w, C), that has structure: rows and columns (N,) of at most SAMPLES pixels, flow (N, 2) and
    structure (N,) there. both, x, y: see `covisible_pixels`."""
    out = []
    if both.sum() < OVERLAP:
        return out
    (top, bottom), (left, right) = ((a.min(), a.max() + 1) for a in np.nonzero(both))
    box = np.s_[top:bottom, left:right]
    for mine, other in zip(np.moveaxis(here, -1, 0), np.moveaxis(there, -1, 0), strict=True):
        contrast = contrasts(mine[box], both[box])
        structure = structure_of(contrast, both[box])
        if np.count_nonzero(structure) < LEAST:
            continue
        brought = brought_to(shown, other, x, y)
        flow, sure = confirmed_flow(contrast, contrasts(brought[box], both[box]), both[box])
        row, column = np.nonzero(structure * sure)
        if len(row) < LEAST:
            continue
        chosen = np.unique(np.linspace(0, len(row) - 1, min(SAMPLES, len(row))).round().astype(int))
        row, column = row[chosen], column[chosen]
        out.append(
            (row + top, column + left, flow[row, column].astype(np.float64), structure[row, column])
        )
    return out


def shifts_of(
    mesh: Mesh,
    scene,
    i: int,
    j: int,
    camera: Camera,
    row,
    column,
    flow: np.ndarray,
    structure: np.ndarray,
) -> Shifts:
    """Of view i against view j, from their flow (see `flows_of`). camera: of view i."""
    # where the other shows that place now
    hit, *places = places_of(mesh, scene, camera, column + 0.5 + flow[:, 0], row + 0.5 + flow[:, 1])
    return Shifts(i, j, *places, -flow[hit], structure[hit])


def covisible_pixels(
    scene, shown: Shown, camera: Camera, mask: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """((h, w) bool, which pixels of what a view shows a camera sees too, inside its mask; where it
    sees all that is hit, x and y (N,))."""
    return met_of(scene, shown, faced_by(shown, camera, mask))


def faced_by(shown: Shown, camera: Camera, mask: np.ndarray) -> Faced:
    """What of `covisible_pixels` needs no scene: pixels that a camera sees where nothing is in between."""
    at = camera.project(shown.point)
    x, y, _ = at.T
    inside = map_coordinates(mask, [y - 0.5, x - 0.5], order=1, mode="constant") > 0.9
    pixels = np.flatnonzero(inside & facing(shown.point, shown.normal, camera, at, GRAZING))
    return Faced(pixels, x, y, sight_rays(shown.point[pixels], shown.normal[pixels], camera))


def met_of(scene, shown: Shown, faced: Faced) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`covisible_pixels` of what a camera may see."""
    common = np.zeros(len(shown.point), bool)
    if len(faced.pixels):
        common[faced.pixels] = clear(scene, *faced.rays)
    both = np.zeros(shown.hit.shape, bool)
    both[shown.hit] = common
    return both, faced.x, faced.y


def brought_to(shown: Shown, picture: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(h, w) of a view: what a picture has at positions (N,), where the view hits."""
    brought = np.zeros(shown.hit.shape, np.float32)
    brought[shown.hit] = map_coordinates(picture, [y - 0.5, x - 0.5], order=1, mode="nearest")
    return brought


def tint_of(pictures, masks) -> np.ndarray:
    """(3,) mean colour of what pictures (h, w, 3) show inside their masks (h, w)."""
    return np.mean([p[m > 0.5].mean(0) for p, m in zip(pictures, masks, strict=True)], 0)


def display_channels(picture: np.ndarray, tint: np.ndarray) -> np.ndarray:
    """(h, w, 3) of a picture (h, w, 3): its brightness as displays show it, and the shares of red
    and blue against a tint (3,), which shading and what is mirrored in the object's own colour
    leave alone."""
    solid = np.maximum(picture, 0) / np.maximum(tint, 1e-4)
    red_and_blue = solid[..., [0, 2]] / (solid.sum(-1, keepdims=True) + DIM)
    return np.concatenate([display_luminance(picture)[..., None], red_and_blue], -1).astype(
        np.float32
    )


def display_luminance(picture: np.ndarray) -> np.ndarray:
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
    """(h, w) of a picture of contrasts (h, w): the smaller eigenvalue of its structure tensor, 0
    where that is little, and along the border of `where`, (h, w) bool: what ends where both
    pictures do has not moved."""
    right, down = (cv2.Sobel(picture, cv2.CV_32F, *axis) / 8 for axis in ((1, 0), (0, 1)))
    xx, yy, xy = around(right**2), around(down**2), around(right * down)
    structure = (xx + yy) / 2 - np.hypot((xx - yy) / 2, xy)
    border = int(min(BORDER[0] * np.sqrt(where.sum()), BORDER[1]))
    inner = (
        cv2.erode(
            np.pad(where, 1).astype(np.uint8), np.ones((2 * border + 1, 2 * border + 1), np.uint8)
        )[1:-1, 1:-1]
        > 0
    )
    return np.where(inner & (structure > STRUCTURE), structure, 0)


def confirmed_flow(
    a: np.ndarray, b: np.ndarray, where: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(flow (h, w, 2) with a(x) = b(x + flow), (h, w) bool, where it is to be believed) of two
    pictures of contrasts."""
    dis = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    grey = [np.clip(40 * p + 128, 0, 255).astype(np.uint8) for p in (a, b)]
    flow, back = dis.calc(*grey, None), dis.calc(*grey[::-1], None)
    y, x = np.mgrid[: a.shape[0], : a.shape[1]].astype(np.float32)

    def moved(picture):
        return cv2.remap(picture, x + flow[..., 0], y + flow[..., 1], cv2.INTER_LINEAR)

    returns = (
        np.hypot(flow[..., 0] + moved(back[..., 0]), flow[..., 1] + moved(back[..., 1])) < BACK
    )
    c = moved(b)
    spread = np.maximum((around(a * a) - around(a) ** 2) * (around(c * c) - around(c) ** 2), 1e-6)
    alike = (around(a * c) - around(a) * around(c)) / np.sqrt(spread) > ALIKE
    stays = moved(where.astype(np.float32)) > 0.99
    return flow, stays & returns & alike & (np.hypot(*np.moveaxis(flow, -1, 0)) < FARTHEST)

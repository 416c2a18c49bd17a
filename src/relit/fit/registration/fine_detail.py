"""Which of several poses a photo was taken from, told by fine detail on the finished surface.

A shape that is alike from several sides (a stool from above) tells its turns apart only by what is
painted on it. Under other lights colours tell little; what is darker or brighter than its
surroundings on the surface stays so. Each photo's logarithmic brightness less that of its
surroundings is laid onto the surface from its pose; the median of the others is what a photo should
show, and it is compared with what the photo does show from each pose in question.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import mitsuba as mi
import numpy as np
from scipy.ndimage import map_coordinates

from relit.reference.mitsuba_scene import build_geometry
from relit.scene import Camera, Mesh

SURROUNDINGS = (
    0.008  # standard deviation of the blur that is taken off, in units of the longer side
)
NOISE = 0.004  # standard deviation of the blur against the noise of photos
SHIFT = 0.03  # of the longer side, by which a pose in question may be off
BORDER = 0.01  # of the longer side: what is closer to the outline is left out
LIMIT = 0.5  # of the detail, in units of the natural logarithm: a highlight is no more than that
FACING = 0.3  # least cosine between normal and ray
LEAST_PHOTOS = 4  # that must see a place for it to count
LEAST_POINTS = 100  # that a photo must see
# of the correlation, by which another pose must be better: right ones gained .15 to .37, wrong ones
# lost .05 and more
GAIN = 0.1
AS_WELL = 0.05  # of the correlation, by which another pose may be worse and still do as well
ROUNDS = 3  # each photo that comes right makes clearer what the others should show


@dataclass(frozen=True)
class DetailPoints:
    """points, normals: (N, 3) unit frame. scene: for ray queries."""

    points: np.ndarray
    normals: np.ndarray
    scene: object


@dataclass(frozen=True)
class Picture:
    """values: (H, W) detail of a photo. depth: (H, W) pixels to the object's outline, 0 outside."""

    values: np.ndarray
    depth: np.ndarray


def surface_of(mesh: Mesh) -> DetailPoints:
    """The vertices of a mesh as places to look at."""
    return DetailPoints(
        np.asarray(mesh.vertices, np.float64),
        np.asarray(mesh.normals, np.float64),
        build_geometry(mesh),
    )


def detail_of(rgb: np.ndarray, mask: np.ndarray) -> Picture:
    """rgb: (H, W, 3) linear. mask: (H, W). The detail is that of the logarithm of the mean of the
    channels."""
    inside = (mask > 0.5).astype(np.float32)
    scale = max(rgb.shape[:2])
    brightness = np.log(np.maximum(rgb.mean(-1), 0.01)).astype(np.float32)

    def blurred(x):
        return cv2.GaussianBlur(x, (0, 0), SURROUNDINGS * scale)

    around = blurred(brightness * inside) / np.maximum(blurred(inside), 1e-3)
    values = cv2.GaussianBlur(brightness, (0, 0), NOISE * scale) - around
    return Picture(
        np.clip(values, -LIMIT, LIMIT),
        cv2.distanceTransform(inside.astype(np.uint8), cv2.DIST_L2, 5),
    )


def seen(surface: DetailPoints, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """(pixel indices (2, N) as (row, column), which of the points (N,) the camera sees), in front
    of it and not too slanted."""
    photo_from_world = np.linalg.inv(camera.world_from_camera)
    at = surface.points @ photo_from_world[:3, :3].T + photo_from_world[:3, 3]
    depth = np.maximum(at[:, 2], 1e-6)
    rows, columns = (
        at[:, 1] / depth * camera.fy + camera.cy - 0.5,
        at[:, 0] / depth * camera.fx + camera.cx - 0.5,
    )
    to = camera.centre - surface.points
    to /= np.linalg.norm(to, axis=1, keepdims=True)
    start = (surface.points + 4e-3 * surface.normals).astype(np.float32)
    blocked = np.array(
        surface.scene.ray_test(mi.Ray3f(mi.Point3f(start.T), mi.Vector3f(to.T.astype(np.float32))))
    )
    return np.array([rows, columns]), (at[:, 2] > 1e-6) & (
        (surface.normals * to).sum(1) > FACING
    ) & ~blocked


def photo_values_at(surface: DetailPoints, camera: Camera, picture: Picture) -> np.ndarray:
    """(N,) what the photo shows at the points; NaN where it does not see them."""
    at, visible = seen(surface, camera)
    inside = map_coordinates(picture.depth, at, order=1, mode="constant") > BORDER * max(
        picture.depth.shape
    )
    return np.where(visible & inside, map_coordinates(picture.values, at, order=1), np.nan)


def expected(laid: np.ndarray, least: int = LEAST_PHOTOS) -> np.ndarray:
    """(N,) the median of what photos show (P, N); NaN where fewer than `least` see them."""
    enough = np.isfinite(laid).sum(0) >= least
    out = np.full(laid.shape[1], np.nan)
    out[enough] = np.nanmedian(laid[:, enough], 0)
    return out


def likeness(surface: DetailPoints, camera: Camera, picture: Picture, shown: np.ndarray) -> float:
    """The correlation of what the photo shows from this pose with `shown` (N,), at the best shift
    of the picture; -1 where too little is seen."""
    at, visible = seen(surface, camera)
    known = visible & np.isfinite(shown)
    at, shown = at[:, known], shown[known]
    border, reach = (
        BORDER * max(picture.depth.shape),
        int(np.ceil(SHIFT * max(picture.depth.shape))),
    )

    def at_shift(row, column):
        moved = at + np.array([[row], [column]])
        inside = map_coordinates(picture.depth, moved, order=0, mode="constant") > border
        if inside.sum() < LEAST_POINTS:
            return -1.0, row, column
        a, b = map_coordinates(picture.values, moved[:, inside], order=1), shown[inside]
        if a.std() < 1e-6 or b.std() < 1e-6:
            return 0.0, row, column
        return float(np.corrcoef(a, b)[0, 1]), row, column

    best = max(
        at_shift(i, j) for i in range(-reach, reach + 1, 2) for j in range(-reach, reach + 1, 2)
    )
    return max(at_shift(best[1] + i, best[2] + j) for i in (-1, 0, 1) for j in (-1, 0, 1))[0]


@dataclass(frozen=True)
class DetailVerdict:
    """moved: photos (by number) that show more of what the others show from another camera than
    their own, and that camera. as_well: photos that show about as much of it from another camera,
    and that one."""

    moved: dict[int, Camera]
    as_well: dict[int, Camera]


def compare_detail(
    surface: DetailPoints,
    pictures: Sequence[Picture],
    cameras: Sequence[Camera],
    choices: Sequence[tuple[int, Camera]],
    laid=None,
) -> DetailVerdict:
    """What fine detail says of the places that photos may have been taken from.

    choices: (photo, another camera it may have been). laid: (P, N) what photos with known cameras
    show, against which these are held, or None: they are held against each other, a photo that has
    moved from its new place.
    """
    now, moved, as_well = list(cameras), {}, {}
    for _ in range(ROUNDS if laid is None else 1):
        shows = laid
        if laid is None:
            shows = np.array(
                [photo_values_at(surface, c, p) for c, p in zip(now, pictures, strict=True)]
            )
        better: dict[int, Camera] = {}
        as_well = {}
        for i in sorted({i for i, _ in choices}):
            shown = expected(shows if laid is not None else np.delete(shows, i, 0))
            own = likeness(surface, now[i], pictures[i], shown)
            found = [
                (likeness(surface, c, pictures[i], shown), k)
                for k, (j, c) in enumerate(choices)
                if j == i and c is not now[i]
            ]
            height, best = max(found, default=(-1.0, -1))
            if height > own + GAIN:
                better[i] = choices[best][1]
            elif own > -1 and height > own - AS_WELL:
                as_well[i] = choices[best][1]
        now = [better.get(i, c) for i, c in enumerate(now)]
        moved |= better
        if not better:
            break
    return DetailVerdict(moved, as_well)


def detail_correlation(
    surface: DetailPoints, pictures: Sequence[Picture], cameras: Sequence[Camera]
) -> np.ndarray:
    """(P,) how much of what each photo shows is what the others show there, as `likeness`; -1 for a
    photo that shares too little with any.

    Of few photos a single other one has to do. Photos of the suite `collection` in their right
    places have .37 to .91, photos in wrong places .31 and .38 where one side is like another, and
    at most .2 where nothing fits.
    """
    laid = np.array(
        [photo_values_at(surface, c, p) for c, p in zip(cameras, pictures, strict=True)]
    )
    least = min(LEAST_PHOTOS, max(1, (len(laid) - 1) // 4))
    shown = [expected(np.delete(laid, i, 0), least) for i in range(len(laid))]
    return np.array([likeness(surface, *of) for of in zip(cameras, pictures, shown, strict=True)])

"""The object sphere and the up direction, from masks, sparse points or camera rays."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from relit.errors import UserError
from relit.geometry.lens import Lens, pixels_from_ideal
from relit.scene import Camera, Sphere

FILL = 0.88  # the object's radius as a share of the sphere's
GRID = 40  # cells per side of the visual hull that is carved for the sphere
MOST_VIEWS = 40  # of the masks of a large capture, so many are carved with


@dataclass(frozen=True)
class SphereView:
    """What the sphere is found from: a camera as calibrated, its lens, a small mask (h, w) of the
    same shape or None, the photo's name."""

    camera: Camera
    lens: Lens | None = None
    mask: np.ndarray | None = None
    name: str = ""


def find_sphere(views: list[SphereView], points: np.ndarray | None = None) -> tuple[Sphere, str]:
    """-> (sphere, how it was found). Masks go first, then sparse points, then the cameras alone.

    Raises UserError when the cameras look away from each other, so that no sphere is seen by most
    of them.
    """
    if sum(v.mask is not None for v in views) >= max(2, 0.5 * len(views)):
        return sphere_from_masks([v for v in views if v.mask is not None]), "the masks"
    sphere = sphere_from_rays([v.camera for v in views])
    if points is not None and len(points) >= 50:
        near = np.linalg.norm(points - sphere.centre, axis=1) < 1.2 * sphere.radius
        if near.mean() > 0.95:  # there is nothing but the object: a turntable, or masked photos
            return sphere_from_points(points[near]), "the sparse points"
    return sphere, "the cameras' viewing directions"


def settled_sphere(
    known: Sphere | None, presumed: bool, views: list[SphereView], points: np.ndarray | None = None
) -> tuple[Sphere, str]:
    """The `known` sphere and "", or as `find_sphere`. presumed: the known one is but a convention,
    so where all views have masks these tell; the convention stands where they contradict one
    another. Raises UserError as `find_sphere`."""
    if known is not None and not (presumed and all(v.mask is not None for v in views)):
        return known, ""
    try:
        return find_sphere(views, points)
    except UserError:
        if known is None:
            raise
        return known, ""


# ---------------------------------------------------------------- rays


def closest_point(
    origins: np.ndarray, directions: np.ndarray, weights: np.ndarray | None = None
) -> np.ndarray:
    """The point (3,) with the least sum of squared distances to rays (N, 3), (N, 3); damped towards
    the mean origin for parallel rays, and that origin where numbers are too large to tell."""
    d = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    across = np.eye(3) - d[:, :, None] * d[:, None, :]
    across = across * (np.ones(len(d)) if weights is None else weights)[:, None, None]
    a, b = across.sum(0), (across @ origins[:, :, None]).sum(0)[:, 0]
    damping = 1e-9 * np.trace(a)
    a, b = a + damping * np.eye(3), b + damping * origins.mean(0)
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        return origins.mean(0)
    return np.linalg.lstsq(a, b, rcond=None)[0]


def robust_closest_point(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """`closest_point`, reweighted ten times by 1 / distance so that a few stray cameras do not move
    it."""
    weights = np.ones(len(origins))
    for _ in range(10):
        c = closest_point(origins, directions, weights)
        off = np.linalg.norm(np.cross(c - origins, directions), axis=1)
        weights = 1.0 / np.maximum(off, 0.1 * np.median(off) + 1e-12)
    return c


def sphere_from_rays(cameras: list[Camera]) -> Sphere:
    """Sphere about the point nearest to all optical axes, as large as the longer side of the median
    picture shows, if no camera stands in it. What it does not hold cannot be reconstructed; what it
    holds besides the object costs only resolution.

    Raises UserError when most cameras do not see that point.
    """
    origins = np.array([c.centre for c in cameras])
    axes = np.array([c.world_from_camera[:3, 2] for c in cameras])
    centre = robust_closest_point(origins, axes)
    seen = _seen(cameras, centre)
    distance = np.linalg.norm(origins - centre, axis=1)[seen]
    half = np.array(
        [
            np.arctan(0.5 * max(c.width / c.fx, c.height / c.fy))
            for c, s in zip(cameras, seen, strict=True)
            if s
        ]
    )
    radius = min(float(np.median(distance * np.sin(half))), 0.8 * float(distance.min()))
    return Sphere(centre, radius)


def _seen(cameras: list[Camera], point: np.ndarray) -> np.ndarray:
    """(N,) bool: which cameras see a point. Raises UserError when fewer than 60 % do."""
    pixels = np.array([c.project(point) for c in cameras])
    size = np.array([(c.width, c.height) for c in cameras])
    seen = (
        (pixels[:, 2] > 0) & (pixels[:, :2] >= 0).all(axis=1) & (pixels[:, :2] <= size).all(axis=1)
    )
    if seen.mean() < 0.6:
        raise UserError(
            f"the cameras look away from each other: only {seen.sum()} of {len(seen)} see the point that their axes approach most",
            "the poses use other axes than the format says (camera_from_world instead of world_from_camera, or y and z flipped), "
            "or the photos do not go around one object",
            "check one pose by hand, or give the object sphere (--sphere X,Y,Z,RADIUS)",
        )
    return seen


# ---------------------------------------------------------------- points


def sphere_from_points(points: np.ndarray) -> Sphere:
    """Sphere about (N, 3) points of the object, the farthest 2 % left out."""
    centre = np.median(points, axis=0)
    near = points[
        np.linalg.norm(points - centre, axis=1)
        <= np.quantile(np.linalg.norm(points - centre, axis=1), 0.98)
    ]
    centre, radius = smallest_ball(near)
    return Sphere(centre, radius / FILL)


def smallest_ball(points: np.ndarray, steps: int = 400) -> tuple[np.ndarray, float]:
    """Smallest enclosing ball of (N, 3) points to about 0.3 %, by Badoiu and Clarkson 2003: step
    1/(i+1) towards the farthest."""
    centre = 0.5 * (points.min(0) + points.max(0))
    for i in range(1, steps + 1):
        far = points[np.argmax(((points - centre) ** 2).sum(1))]
        centre = centre + (far - centre) / (i + 1)
    return centre, float(np.linalg.norm(points - centre, axis=1).max())


# ---------------------------------------------------------------- masks


def sphere_from_masks(views: list[SphereView]) -> Sphere:
    """Sphere about the visual hull: cells of a coarse grid that fall into the mask of (nearly)
    every view that shows them.

    Raises UserError when the masks of different photos have no place in common.
    """
    views = [v for v in views if v.mask is not None and (v.mask > 0.5).any()]
    if len(views) > MOST_VIEWS:
        views = [views[i] for i in np.linspace(0, len(views) - 1, MOST_VIEWS).round().astype(int)]
    origins = np.array([v.camera.centre for v in views])
    rays, spread = zip(*(_mask_cone(v) for v in views), strict=True)
    centre = robust_closest_point(origins, np.array(rays))
    _seen([v.camera for v in views], centre)
    distance = np.linalg.norm(origins - centre, axis=1)
    radius = float(np.quantile(distance * np.tan(np.array(spread)), 0.9))
    grown = [cv2.dilate((v.mask > 0.5).astype(np.uint8), np.ones((3, 3), np.uint8)) for v in views]
    kept, low, high = np.empty((0, 3)), centre - 1.6 * radius, centre + 1.6 * radius
    start = (low, high)
    for _ in range(3):  # each pass carves the box of what the last one left
        kept, cell = _carve(views, grown, low, high)
        if len(kept) == 0:
            raise _disagreement(views, grown, *start)
        low, high = kept.min(0) - 1.5 * cell, kept.max(0) + 1.5 * cell
    centre, reach = smallest_ball(kept)
    return Sphere(centre, (reach + 0.5 * float(np.linalg.norm(cell))) / FILL)


def _disagreement(
    views: list[SphereView], masks: list[np.ndarray], low: np.ndarray, high: np.ndarray
) -> UserError:
    """Names the masks that miss what the others show, where a third of them or fewer does."""
    what = "the masks of different photos have no place in common"
    kept, _ = _carve(views, masks, low, high, spare=1 / 3)
    misses = []
    for view, mask in zip(views, masks, strict=True):
        inside, column, row = _shown(view, mask.shape, kept)
        if inside.any() and mask[row[inside], column[inside]].mean() < 0.5:
            misses.append(view.name)
    if len(kept) and misses and all(misses) and len(misses) <= len(views) / 3:
        named = ", ".join(misses[:6]) + (", ..." if len(misses) > 6 else "")
        why = f"most of them share a place, but these masks do not hold it: {named}"
        return UserError(
            what,
            why,
            "correct those masks (relit inspect INPUT --edit) or leave those photos out, or use --masks none",
        )
    return UserError(
        what,
        "masks and cameras do not belong together, the poses use other axes than the format says, or the masks show different things",
        "check one pose and one mask by hand, or give the object sphere (--sphere X,Y,Z,RADIUS)",
    )


def _mask_cone(view: SphereView) -> tuple[np.ndarray, float]:
    """World direction (3,) through the middle of a mask, and the half angle of the cone that holds
    it."""
    h, w = view.mask.shape
    c = view.camera.resized(w, h)
    rows, cols = np.nonzero(view.mask > 0.5)
    directions = np.stack(
        [(cols + 0.5 - c.cx) / c.fx, (rows + 0.5 - c.cy) / c.fy, np.ones(len(rows))], axis=1
    )
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    middle = 0.5 * (directions.min(0) + directions.max(0))
    middle /= np.linalg.norm(middle)
    angle = float(np.arccos(np.clip((directions @ middle).min(), -1, 1)))
    return c.world_from_camera[:3, :3] @ middle, min(angle, 1.2)


def _shown(
    view: SphereView, shape: tuple[int, int], points: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of points (K, 3): whether they fall into the picture (K,), and the column and row of its (h,
    w) copy that they fall on."""
    h, w = shape
    c = view.camera.resized(w, h)
    m = c.camera_from_world
    q = points @ m[:3, :3].T + m[:3, 3]
    front = q[:, 2] > 1e-9
    xy = q[:, :2] / np.where(front, q[:, 2], 1.0)[:, None]
    front &= (np.abs(xy) < 4).all(axis=1)  # polynomial lenses fold back far off the axis
    pixel = np.floor(pixels_from_ideal(c, view.lens, np.where(front[:, None], xy, 0.0))).astype(int)
    inside = front & (pixel >= 0).all(axis=1) & (pixel[:, 0] < w) & (pixel[:, 1] < h)
    return inside, pixel[:, 0], pixel[:, 1]


def _carve(
    views: list[SphereView], masks: list[np.ndarray], low, high, spare: float = 0.05
) -> tuple[np.ndarray, np.ndarray]:
    """-> (centres (K, 3) of the cells that stay, size (3,) of a cell). A cell must be shown by half
    of the views, and two at least.

    spare: of 20 views or more, so large a share may have a hole in their mask.
    """
    cell = (high - low) / GRID
    axes = [low[i] + (np.arange(GRID) + 0.5) * cell[i] for i in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    shown, hit = np.zeros(len(points), int), np.zeros(len(points), int)
    several = spare * len(views) if len(views) >= 20 or spare > 0.05 else 0
    for view, mask in zip(views, masks, strict=True):
        inside, column, row = _shown(view, mask.shape, points)
        # a mask that keeps off the picture's border shows the whole object: there is none of it
        # outside the picture
        whole = not (mask[[0, -1]].any() or mask[:, [0, -1]].any())
        shown += inside | whole
        hit[inside] += mask[row[inside], column[inside]]
        alive = shown - hit <= several
        points, shown, hit = points[alive], shown[alive], hit[alive]
    return points[shown >= max(2, len(views) / 2)], cell


# ---------------------------------------------------------------- checks and up


def check_sphere(sphere: Sphere, cameras: list[Camera]) -> list[str]:
    """Notes on a sphere that some cameras do not see. Raises UserError when most do not, or when it
    is no sphere."""
    if not (np.isfinite(sphere.centre).all() and np.isfinite(sphere.radius) and sphere.radius > 0):
        raise UserError(
            "the object sphere is not valid",
            f"centre {sphere.centre}, radius {sphere.radius}",
            "give three finite numbers and a positive radius",
        )
    unseen = [i for i, c in enumerate(cameras) if not _touches(c, sphere)]
    if len(unseen) > 0.5 * len(cameras):
        raise UserError(
            f"the object sphere lies outside the view of {len(unseen)} of {len(cameras)} cameras",
            f"its centre is {np.round(sphere.centre, 3).tolist()}, its radius {sphere.radius:.3g}, in the units of the cameras",
            "give another sphere, or leave it out so that it is found",
        )
    notes = (
        [f"the object sphere lies outside the view of {len(unseen)} of {len(cameras)} cameras"]
        if unseen
        else []
    )
    within = sum(np.linalg.norm(c.centre - sphere.centre) < sphere.radius for c in cameras)
    if within:
        notes.append(f"{within} of {len(cameras)} cameras stand inside the object sphere")
    return notes


def _touches(camera: Camera, sphere: Sphere) -> bool:
    """True when the projected sphere's centre, or the point of it nearest to the optical axis,
    falls into the picture."""
    q = (camera.camera_from_world @ np.append(sphere.centre, 1.0))[:3]
    if q[2] + sphere.radius <= 0:
        return False
    if q[2] <= sphere.radius:  # the camera's plane cuts the sphere
        return True
    x, y = camera.fx * q[0] / q[2] + camera.cx, camera.fy * q[1] / q[2] + camera.cy
    reach = max(camera.fx, camera.fy) * sphere.radius / q[2]
    return bool(-reach < x < camera.width + reach and -reach < y < camera.height + reach)


def up_direction(cameras: list[Camera]) -> np.ndarray | None:
    """(3,) unit up direction of the world, or None: normal to the cameras' x axes, which
    photographers hold level.

    Snapped to a coordinate axis within 3 degrees. None when the axes tell nothing (rolled cameras,
    one viewpoint, half upside down).
    """
    x = np.array([c.world_from_camera[:3, 0] for c in cameras])
    image_up = -np.array([c.world_from_camera[:3, 1] for c in cameras])
    mean = image_up.mean(axis=0)
    if np.linalg.norm(mean) < 0.3:
        return None
    values, vectors = np.linalg.eigh(x.T @ x / len(x))
    up = vectors[:, 0] if values[0] < 0.03 and values[1] > 4 * values[0] + 0.01 else mean
    up = up / np.linalg.norm(up)
    up = up if up @ mean > 0 else -up
    if np.mean(image_up @ up > 0) < 0.85:
        return None
    axis = np.argmax(np.abs(up))
    snapped = np.zeros(3)
    snapped[axis] = np.sign(up[axis])
    return snapped if snapped @ up > np.cos(np.radians(3)) else up

"""Bodies of revolution: their silhouettes, and what a single silhouette tells of one.

Of what looks nearly the same from all around an axis, no view tells the turn about that axis, and a
search over all poses goes astray. Its silhouettes tell everything else
(fit/registration/instances/revolution_fit.py). Here each is laid on its own mirror image and turned
about that line under every
tilt: a profile.

Poses are `object_from_camera` as in fit/registration/instances/views.py, the axis is the object's y
axis; the turn about it is arbitrary here (fit/registration/instances/unrolled.py and
fit/registration/instances/protrusions.py find it). A profile is (2 + KNOTS,): the lower and the
upper end on the axis, and the radii at KNOTS heights evenly between them, in the unit frame.
"""

from __future__ import annotations

import cv2
import numpy as np

from relit.conventions import similarity
from relit.fit.registration.instances.views import InstanceView, nearest_pixels
from relit.fit.registration.register import AHEAD, Gallery, moments, rings_of, views_from
from relit.geometry.se3 import rotation_from
from relit.scene import Camera

UP = np.array([0.0, 1.0, 0.0])  # the axis of revolution, in the object's frame
OUTLINE = (1.0, 0.0, 0.0)  # weights of fit.register's descriptor: silhouettes only
KNOTS, HOOPS = 16, 30  # radii of a profile, and circles that it is drawn with
CELLS, AROUND = (
    (48, 32),
    24,
)  # heights and radii, and turns about the axis, in which one silhouette is revolved
ALONG = np.linspace(0, 1, HOOPS)  # the axis, from end to end
CIRCLE = np.stack(
    [f(np.arange(AROUND) * 2 * np.pi / AROUND) for f in (np.sin, np.cos)], -1
)  # across it: x and z
# of its turns in which a circle has to lie inside the silhouette; a handle fills a few of them
SHARE = 0.85
TILTS = np.radians(np.arange(7.5, 91, 7.5))  # of the axis against the line of sight, that are tried


# ---------------------------------------------------------------- the body


def radius_at(profile: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Radii at heights y, -1 beyond the ends."""
    s = (y - profile[0]) / (profile[1] - profile[0])
    return np.where(
        (s >= 0) & (s <= 1),
        np.maximum(np.interp(s, np.linspace(0, 1, KNOTS), profile[2:]), 0.01),
        -1.0,
    )


def hoops_of(profile: np.ndarray, camera_from_object: np.ndarray) -> np.ndarray:
    """(HOOPS, AROUND, 3) circles around the axis, in the camera's axes."""
    m = camera_from_object
    y = profile[0] + (profile[1] - profile[0]) * ALONG
    r = np.maximum(np.interp(ALONG, np.linspace(0, 1, KNOTS), profile[2:]), 0.01)
    return (
        r[:, None, None] * (CIRCLE @ m[:3, [0, 2]].T) + (y[:, None] * m[:3, 1] + m[:3, 3])[:, None]
    )


def drawn(profile: np.ndarray, camera: Camera, finer: int = 2) -> np.ndarray:
    """(H, W) in [0, 1]: the silhouette, as the union of the hulls of neighbouring circles. Most of
    the time of a fit goes here."""
    p = hoops_of(profile, camera.camera_from_world)
    z = np.where(np.abs(p[..., 2]) < 1e-12, 1e-12, p[..., 2])
    q = finer * np.stack(
        [camera.fx * p[..., 0] / z + camera.cx, camera.fy * p[..., 1] / z + camera.cy], -1
    )
    pairs = np.concatenate([q[:-1], q[1:]], 1)
    out = np.zeros((camera.height * finer, camera.width * finer), np.uint8)
    for pair in np.round((pairs - 0.5) * 16).astype(
        np.int32
    ):  # cv2: pixel centres at whole numbers, four bits behind the point
        cv2.fillConvexPoly(out, cv2.convexHull(pair), 255, cv2.LINE_8, 4)
    return (
        cv2.resize(out, (camera.width, camera.height), interpolation=cv2.INTER_AREA).astype(
            np.float32
        )
        / 255
    )


def tilted_gallery(profile: np.ndarray, step: float, distance: float) -> Gallery:
    """The body seen under all tilts, `step` degrees apart."""
    t = np.radians(np.linspace(0.5, 179.5, round(180 / step) + 1))
    cameras = views_from(np.stack([0 * t, np.cos(t), np.sin(t)], -1), distance)
    alpha = np.stack([drawn(profile, c) for c in cameras])
    return Gallery(cameras, rings_of(np.repeat(alpha[..., None], 3, -1), alpha, parts=OUTLINE))


def axis_of(pose: np.ndarray) -> np.ndarray:
    """Unit vector (3,) of the axis in the camera's frame."""
    return pose[:3, :3].T @ UP


def leaning_back(pose: np.ndarray) -> np.ndarray:
    """The pose with the axis mirrored in the picture plane: far away its outline is the same."""
    middle = -pose[:3, :3].T @ pose[:3, 3]
    ray, axis = middle / np.linalg.norm(middle), axis_of(pose)
    turn = pose[:3, :3] @ rotation_from(axis - 2 * (axis @ ray) * ray, axis)
    return similarity(turn, -turn @ middle)


# ---------------------------------------------------------------- first guesses, from one
# silhouette


def mirror_lines(
    view: InstanceView, keep: int = 3, apart: float = 24.0
) -> list[tuple[float, float, float]]:
    """(angle in radians, x, y in pixels) of the lines on which a silhouette is most nearly its own
    mirror image; `apart` degrees."""
    centre, spread = moments((view.mask * view.known)[None])
    (cx, cy), spread = centre[0] - 0.5, float(spread[0])  # cv2's pixel centres lie at whole numbers
    gx, gy = np.meshgrid(*2 * [((np.arange(64) + 0.5) / 32 - 1) * 2.2 * spread])
    angles, offsets = np.arange(45) * np.pi / 45, np.linspace(-0.4, 0.4, 9) * spread
    both, alike = (
        np.stack([view.mask, view.known], -1).astype(np.float32),
        np.zeros((len(angles), len(offsets))),
    )

    def look(angle, offset, side):
        c, s = np.cos(angle), np.sin(angle)
        at = np.stack(
            [cx + c * gx - s * (side * gy + offset), cy + s * gx + c * (side * gy + offset)], -1
        )
        seen = cv2.remap(both, at.astype(np.float32), None, cv2.INTER_LINEAR) > 0.5
        return seen[..., 0], seen[..., 1]

    for i, angle in enumerate(angles):
        for j, offset in enumerate(offsets):
            (a, known), (b, also) = look(angle, offset, 1), look(angle, offset, -1)
            alike[i, j] = (a & b & known & also).sum() / max(((a | b) & known & also).sum(), 1)
    chosen: list[int] = []
    for i in np.argsort(-alike.max(1)).tolist():
        turns = [min(abs(i - j), len(angles) - abs(i - j)) * 180 / len(angles) for j in chosen]
        if len(chosen) < keep and all(t >= apart for t in turns):
            chosen.append(i)
    shifts = offsets[alike.argmax(1)]
    return [
        (
            angles[i],
            cx - np.sin(angles[i]) * shifts[i] + 0.5,
            cy + np.cos(angles[i]) * shifts[i] + 0.5,
        )
        for i in chosen
    ]


def poses_on_lines(view: InstanceView, distance: float) -> list[np.ndarray]:
    """Poses (4, 4) whose axis is seen on one of the silhouette's mirror lines, under every tilt."""
    out = []
    for angle, x, y in mirror_lines(view):
        ray = np.array(
            [(x - view.camera.cx) / view.camera.fx, (y - view.camera.cy) / view.camera.fy, 1.0]
        )
        ahead = rotation_from(AHEAD, ray)
        for t in TILTS:
            turn = rotation_from(
                ahead
                @ np.array([np.cos(angle) * np.sin(t), np.sin(angle) * np.sin(t), -np.cos(t)]),
                UP,
            )
            out.append(similarity(turn, -turn @ (distance * ray)))
    return out


def revolved_silhouette(view: InstanceView, pose: np.ndarray) -> np.ndarray | None:
    """The profile of what stays inside the silhouette in nearly all turns about the axis; None
    where nothing does."""
    heights, radii = CELLS
    y, r = (np.arange(heights) + 0.5) / heights * 2 - 1, (np.arange(radii) + 0.5) / radii
    y3, r3, a3 = np.meshgrid(y, r, np.arange(AROUND) * 2 * np.pi / AROUND, indexing="ij")
    p = np.stack([r3 * np.sin(a3), y3, r3 * np.cos(a3)], -1).reshape(-1, 3)
    u, v, ok = nearest_pixels(view.camera.with_pose(pose), p)
    known = (view.known[v, u] > 0.5).reshape(y3.shape)
    inside = (ok & (view.mask[v, u] > 0.3)).reshape(y3.shape) & known
    full = (known.sum(-1) > 0) & (inside.sum(-1) >= SHARE * known.sum(-1))
    reach = np.cumprod(full, 1).sum(1)
    use = np.flatnonzero(reach > 0)
    if len(use) < 3:
        return None
    lower, upper = y[use[0]] - 1 / heights, y[use[-1]] + 1 / heights
    return np.concatenate(
        [
            [lower, upper],
            np.interp(np.linspace(lower, upper, KNOTS), y[use], (reach[use] + 0.5) / radii),
        ]
    )

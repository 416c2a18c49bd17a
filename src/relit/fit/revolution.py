"""Bodies of revolution: how identical cups, cans and bottles lie, from their silhouettes alone.

Of what looks nearly the same from all around an axis, no view tells the turn about that axis, and a search over all poses goes astray. Its
silhouettes tell everything else. Each is laid on its own mirror image and turned about that line under every tilt: a profile. A profile
that explains the silhouettes of all others is then fitted to all of them together, with their poses (Gauss-Newton on blurred outlines).
What sticks out of a body of revolution, as a handle does, counts little.

    fit_revolution   views -> Revolved: one profile, a pose for each view, how well they fit
    seats_of         further poses of each view that fit about as well: an outline hardly tells which way the axis leans

Poses are `object_from_camera` as in fit/instances.py, the axis is the object's y axis; the turn about it is arbitrary here
(fit/unrolled.py finds it). A profile is (2 + KNOTS,): the lower and the upper end on the axis, and the radii at KNOTS heights evenly
between them, in the unit frame.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import cv2
import numpy as np

from relit.cameras.se3 import exp_so3, rotation_angle, rotation_from
from relit.conventions import similarity
from relit.fit.instances import View, eyes_at, frame_scale, nearest_pixels
from relit.fit.register import AHEAD, Crop, Gallery, Rings, all_scores, crop_rings, moments, rings_of, search, views_from
from relit.scene import Camera

UP = np.array([0.0, 1.0, 0.0])  # the axis of revolution, in the object's frame
OUTLINE = (1.0, 0.0, 0.0)  # weights of fit.register's descriptor: silhouettes only
KNOTS, HOOPS = 16, 30  # radii of a profile, and circles that it is drawn with
CELLS, AROUND = (48, 32), 24  # heights and radii, and turns about the axis, in which one silhouette is revolved
SHARE = 0.85  # of its turns in which a circle has to lie inside the silhouette; a handle fills a few of them
TILTS = np.radians(np.arange(7.5, 91, 7.5))  # of the axis against the line of sight, that are tried
STARTS, EACH, LAST = 20, 4, 6  # first profiles that are fitted, of one view at most, and those of them that are fitted to the end
TRIMMED = (0.5, 0.6, 0.7, 0.8)  # shares of the views, those that fit best, which shape the profile in turn
BLUR = 1.2  # pixels of a crop by which outlines are blurred: as far as they pull
BESIDE = 0.5  # weight of what a silhouette shows beside the body
STEPS = np.array([0.05, 0.05, 0.02, 0.02, 0.02])  # of the finite differences of a pose, see `moved`
DAMPING = 0.02
SMOOTH = 0.02  # of a profile's bends, for each view
AS_WELL = (1.5, 0.001)  # a seat is kept while its misfit is at most so many times the best one's and so much more
APART = 15.0  # degrees between the axes of two seats


@dataclass(frozen=True)
class Revolved:
    """profile: see above. poses: (N, 4, 4). misfits: (N,) of the views, see `misfit`."""

    profile: np.ndarray
    poses: np.ndarray
    misfits: np.ndarray

    @property
    def misfit(self) -> float:
        """Mean of the four fifths of the views that fit best."""
        return float(np.sort(self.misfits)[: max(1, round(TRIMMED[-1] * len(self.misfits)))].mean())


# ---------------------------------------------------------------- the body


def radius_at(profile: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Radii at heights y, -1 beyond the ends."""
    s = (y - profile[0]) / (profile[1] - profile[0])
    return np.where((s >= 0) & (s <= 1), np.maximum(np.interp(s, np.linspace(0, 1, KNOTS), profile[2:]), 0.01), -1.0)


def hoops_of(profile: np.ndarray) -> np.ndarray:
    """(HOOPS, AROUND, 3) circles around the axis."""
    s, a = np.linspace(0, 1, HOOPS), np.arange(AROUND) * 2 * np.pi / AROUND
    y = profile[0] + (profile[1] - profile[0]) * s
    r = np.maximum(np.interp(s, np.linspace(0, 1, KNOTS), profile[2:]), 0.01)
    return np.stack([r[:, None] * np.sin(a), np.broadcast_to(y[:, None], (HOOPS, AROUND)), r[:, None] * np.cos(a)], -1)


def drawn(profile: np.ndarray, camera: Camera, finer: int = 2) -> np.ndarray:
    """(H, W) in [0, 1]: the silhouette, as the union of the hulls of neighbouring circles."""
    q = camera.project(hoops_of(profile).reshape(-1, 3))[:, :2].reshape(HOOPS, AROUND, 2) * finer
    pairs = np.concatenate([q[:-1], q[1:]], 1)
    out = np.zeros((camera.height * finer, camera.width * finer), np.uint8)
    for pair in np.round((pairs - 0.5) * 16).astype(np.int32):  # cv2: pixel centres at whole numbers, four bits behind the point
        cv2.fillConvexPoly(out, cv2.convexHull(pair), 255, cv2.LINE_8, 4)
    return cv2.resize(out, (camera.width, camera.height), interpolation=cv2.INTER_AREA).astype(np.float32) / 255


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


# ---------------------------------------------------------------- first guesses, from one silhouette


def mirror_lines(view: View, keep: int = 3, apart: float = 24.0) -> list[tuple[float, float, float]]:
    """(angle in radians, x, y in pixels) of the lines on which a silhouette is most nearly its own mirror image; `apart` degrees."""
    centre, spread = moments((view.mask * view.known)[None])
    (cx, cy), spread = centre[0] - 0.5, float(spread[0])  # cv2's pixel centres lie at whole numbers
    gx, gy = np.meshgrid(*2 * [((np.arange(64) + 0.5) / 32 - 1) * 2.2 * spread])
    angles, offsets = np.arange(45) * np.pi / 45, np.linspace(-0.4, 0.4, 9) * spread
    both, alike = np.stack([view.mask, view.known], -1).astype(np.float32), np.zeros((len(angles), len(offsets)))

    def look(angle, offset, side):
        c, s = np.cos(angle), np.sin(angle)
        at = np.stack([cx + c * gx - s * (side * gy + offset), cy + s * gx + c * (side * gy + offset)], -1)
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
    return [(angles[i], cx - np.sin(angles[i]) * shifts[i] + 0.5, cy + np.cos(angles[i]) * shifts[i] + 0.5) for i in chosen]


def poses_on_lines(view: View, distance: float) -> list[np.ndarray]:
    """Poses (4, 4) whose axis is seen on one of the silhouette's mirror lines, under every tilt."""
    out = []
    for angle, x, y in mirror_lines(view):
        ray = np.array([(x - view.camera.cx) / view.camera.fx, (y - view.camera.cy) / view.camera.fy, 1.0])
        ahead = rotation_from(AHEAD, ray)
        for t in TILTS:
            turn = rotation_from(ahead @ np.array([np.cos(angle) * np.sin(t), np.sin(angle) * np.sin(t), -np.cos(t)]), UP)
            out.append(similarity(turn, -turn @ (distance * ray)))
    return out


def revolved_silhouette(view: View, pose: np.ndarray) -> np.ndarray | None:
    """The profile of what stays inside the silhouette in nearly all turns about the axis; None where nothing does."""
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
    return np.concatenate([[lower, upper], np.interp(np.linspace(lower, upper, KNOTS), y[use], (reach[use] + 0.5) / radii)])


# ---------------------------------------------------------------- the fit


@dataclass(frozen=True)
class Outline:
    """What a crop is compared by. mask: (S, S) blurred. weight: (S, S), over the root of the silhouette's area."""

    crop: Crop
    mask: np.ndarray
    weight: np.ndarray

    def residual(self, profile: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """(S, S) drawn silhouette - mask, blurred."""
        return blurred(drawn(profile, self.crop.camera.with_pose(pose @ self.crop.camera.world_from_camera))) - self.mask

    def weights(self, residual: np.ndarray) -> np.ndarray:
        return self.weight * np.where(residual < 0, BESIDE, 1.0)

    def slopes(self, residual: np.ndarray, others) -> np.ndarray:
        """(P, S * S) weighted derivatives, of (step, residual there) pairs."""
        w = self.weights(residual)
        return np.array([((w * (r - residual)) / step).ravel() for step, r in others])


def blurred(picture: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(picture.astype(np.float32), (0, 0), BLUR)


def outline_of(crop: Crop) -> Outline:
    known, mask = (crop.weight > 0.5).astype(np.float32), blurred(crop.mask)
    return Outline(crop, mask, known / np.sqrt(max(float((mask * known).sum()), 1.0)))


def misfit(outline: Outline, residual: np.ndarray) -> float:
    """Sum of squared weighted residuals, over the area of the silhouette."""
    return float(((outline.weights(residual) * residual) ** 2).sum())


def moved(pose: np.ndarray, x: np.ndarray) -> np.ndarray:
    """x: turns across the axis (2, radians), shifts across the line of sight (2, unit lengths), log distance."""
    turn, middle = exp_so3(np.array([x[0], 0.0, x[1]])) @ pose[:3, :3], -pose[:3, :3].T @ pose[:3, 3]
    across = np.cross(middle / np.linalg.norm(middle), UP)
    across /= np.linalg.norm(across)
    other = np.cross(middle / np.linalg.norm(middle), across)
    middle = (middle + x[2] * across + x[3] * other) * np.exp(x[4])
    return similarity(turn, -turn @ middle)


def pose_slopes(outline: Outline, profile, pose, residual) -> np.ndarray:
    return outline.slopes(residual, [(s, outline.residual(profile, moved(pose, s * e))) for s, e in zip(STEPS, np.eye(5), strict=True)])


def adjusted_pose(outline: Outline, profile: np.ndarray, pose: np.ndarray, rounds: int = 6) -> tuple[np.ndarray, float]:
    """A pose that fits better, by Gauss-Newton, and its misfit."""
    r = outline.residual(profile, pose)
    best = misfit(outline, r)
    for _ in range(rounds):
        slopes = pose_slopes(outline, profile, pose, r)
        step = -np.linalg.solve(slopes @ slopes.T + 0.2 * DAMPING * np.eye(5), slopes @ (outline.weights(r) * r).ravel())
        before = best
        for part in (1.0, 0.5, 0.25):
            other = moved(pose, np.clip(part * step, -0.3, 0.3))
            there = outline.residual(profile, other)
            if misfit(outline, there) < best:
                pose, r, best = other, there, misfit(outline, there)
                break
        if before - best < 0.005 * before:
            break
    return pose, best


def adjusted(outlines: list[Outline], body: Revolved, rounds: int, share: float = 1.0) -> Revolved:
    """Profile and poses that fit better, by Gauss-Newton on all views together; the profile is shaped by the `share` that fits best."""
    profile, poses, n = body.profile, body.poses, 2 + KNOTS
    use = np.zeros(len(outlines), bool)
    use[np.argsort(body.misfits)[: max(2, round(share * len(outlines)))]] = True
    bends = np.zeros((n, n))
    bends[2:, 2:] = np.diff(np.eye(KNOTS), 2, axis=0).T @ np.diff(np.eye(KNOTS), 2, axis=0)
    bends *= SMOOTH * len(outlines)
    residuals = [o.residual(profile, pose) for o, pose in zip(outlines, poses, strict=True)]
    misfits = np.array([misfit(o, r) for o, r in zip(outlines, residuals, strict=True)])
    for _ in range(rounds):
        normal, right, own = DAMPING * len(outlines) * np.eye(n) + bends, bends @ profile, []
        for o, pose, r, shapes in zip(outlines, poses, residuals, use, strict=True):
            by_pose, weighted = pose_slopes(o, profile, pose, r), (o.weights(r) * r).ravel()
            inverse, down = np.linalg.inv(by_pose @ by_pose.T + DAMPING * np.eye(5)), by_pose @ weighted
            by_shape = o.slopes(r, [(0.02, o.residual(profile + 0.02 * e, pose)) for e in np.eye(n)])
            cross = by_shape @ by_pose.T
            own.append((inverse, cross, down))
            if shapes:  # the poses eliminated (Schur complement)
                normal += by_shape @ by_shape.T - cross @ inverse @ cross.T
                right += by_shape @ weighted - cross @ inverse @ down
        step, before = -np.linalg.solve(normal, right), misfits[use].sum()
        for part in (1.0, 0.5, 0.25):
            shape = profile + part * step
            there = [
                moved(p, np.clip(-part * (inverse @ (down + cross.T @ step)), -0.3, 0.3))
                for p, (inverse, cross, down) in zip(poses, own, strict=True)
            ]
            others = [o.residual(shape, pose) for o, pose in zip(outlines, there, strict=True)]
            levels = np.array([misfit(o, r) for o, r in zip(outlines, others, strict=True)])
            if levels[use].sum() < before:
                profile, poses, residuals, misfits = shape, np.array(there), others, levels
                break
        if before - misfits[use].sum() < 0.003 * before:
            break
    return Revolved(profile, poses, misfits)


def sought(outlines: list[Outline], rings: Rings, body: Revolved, keep: int = 5) -> list[list[tuple[np.ndarray, float]]]:
    """(pose, misfit) of each view, best first: what a search under all tilts finds, adjusted, what leans back, and the pose it has."""
    found = search([o.crop for o in outlines], tilted_gallery(body.profile, 5.0, eyes_at(body.poses)), keep=keep, rings=rings, apart=20.0)
    out = []
    for outline, poses, scores, own in zip(outlines, found.poses, found.scores, body.poses, strict=True):
        tried = [adjusted_pose(outline, body.profile, pose) for pose in (own, *poses[scores > -1])]
        tried += [adjusted_pose(outline, body.profile, leaning_back(pose)) for pose, _ in tried]
        out.append(sorted(tried, key=lambda one: one[1]))
    return out


def fit_revolution(views: list[View], crops: list[Crop], least: float = 0.0, most: float = np.inf) -> Revolved | None:
    """One profile and a pose for each view that explain all silhouettes; None where no silhouette can be revolved.

    least, most: given up where no silhouette, revolved, scores so well against the others, and where no first fit has a smaller misfit.
    """
    rings, outlines, distance = crop_rings(crops, OUTLINE), [outline_of(c) for c in crops], frame_scale(views)
    first = []
    for k, view in enumerate(views):
        for pose in poses_on_lines(view, distance):
            profile = revolved_silhouette(view, pose)
            if profile is not None:
                gallery = tilted_gallery(profile, 7.5, distance)
                first.append((float(all_scores(rings, gallery.rings).max((1, 2)).mean()), k, profile, gallery))
    if not first or max(one[0] for one in first) < least:
        return None
    taken, bodies = Counter(), []
    for _, k, profile, gallery in sorted(first, key=lambda one: -one[0]):
        if taken[k] < EACH and taken.total() < STARTS:
            taken[k] += 1
            poses = search(crops, gallery, keep=1, rings=rings).poses[:, 0]
            bodies.append(adjusted(outlines, Revolved(profile, poses, np.zeros(len(views))), 3))
    best = None
    for body in sorted(bodies, key=lambda one: one.misfit)[:LAST] if min(one.misfit for one in bodies) < most else []:
        for share in TRIMMED:
            body = adjusted(outlines, body, 6, share)
            tops = [one[0] for one in sought(outlines, rings, body)]
            body = Revolved(body.profile, np.array([pose for pose, _ in tops]), np.array([level for _, level in tops]))
        body = adjusted(outlines, body, 8)
        best = body if best is None or body.misfit < best.misfit else best
    return best


def seats_of(crops: list[Crop], body: Revolved, most: int = 8) -> list[list[np.ndarray]]:
    """Poses (4, 4) of each view that fit it about as well as the best one, best first, with axes APART from each other."""
    outlines, out = [outline_of(c) for c in crops], []
    for tried in sought(outlines, crop_rings(crops, OUTLINE), body, keep=6):
        level, kept = AS_WELL[0] * tried[0][1] + AS_WELL[1], []
        for pose, height in tried:
            if height <= level and len(kept) < most and all(turned(pose, other) >= APART for other in kept):
                kept.append(pose)
        out.append(kept)
    return out


def turned(a: np.ndarray, b: np.ndarray) -> float:
    """Degrees between the axes of two poses."""
    return rotation_angle(rotation_from(axis_of(a), axis_of(b)))

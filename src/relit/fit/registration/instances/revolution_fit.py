"""One body of revolution and a pose for each view that explain all silhouettes.

A profile that one silhouette gives (fit/registration/instances/revolution.py) and that explains all
others is fitted to all of them together, with their poses (Gauss-Newton on blurred outlines). What
sticks out of a body of revolution, as a handle does, counts little.

    fit_revolution   views -> Revolved: one profile, a pose for each view, how well they fit
    seats_of         further poses of each view that fit about as well: an outline hardly tells
                     which way the axis leans
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import cv2
import numpy as np

from relit.conventions import similarity
from relit.fit.registration.instances.revolution import (
    KNOTS,
    OUTLINE,
    UP,
    axis_of,
    drawn,
    leaning_back,
    poses_on_lines,
    revolved_silhouette,
    tilted_gallery,
)
from relit.fit.registration.instances.views import InstanceView, best_seen, eyes_at, frame_scale
from relit.fit.registration.register import Crop, Rings, all_scores, crop_rings, search
from relit.geometry.se3 import exp_so3, hat, rotation_angle, rotation_from

REVOLVED = 14  # views whose silhouettes are revolved, those that are seen best
STARTS, EACH, LAST = (
    20,
    4,
    6,
    # first profiles that are fitted, of one view at most, and those of them that are fitted to the end
)
TRIMMED = (
    0.5,
    0.6,
    0.7,
    0.8,
)  # shares of the views, those that fit best, which shape the profile in turn
BLUR = 1.2  # pixels of a crop by which outlines are blurred: as far as they pull
BESIDE = 0.5  # weight of what a silhouette shows beside the body
STEPS = np.array(
    [0.05, 0.05, 0.02, 0.02, 0.02]
)  # of the finite differences of a pose, see `moved_pose`
DAMPING = 0.02
SMOOTH = 0.02  # of a profile's bends, for each view
AS_WELL = (
    1.5,
    0.001,
)  # a seat is kept while its misfit is at most so many times the best one's and so much more
APART = 15.0  # degrees between the axes of two seats


@dataclass(frozen=True)
class Revolved:
    """profile: see fit/registration/instances/revolution.py. poses: (N, 4, 4). misfits: (N,) of the
    views, see `crop_misfit`."""

    profile: np.ndarray
    poses: np.ndarray
    misfits: np.ndarray

    @property
    def misfit(self) -> float:
        """Mean of the four fifths of the views that fit best."""
        return float(np.sort(self.misfits)[: max(1, round(TRIMMED[-1] * len(self.misfits)))].mean())


@dataclass(frozen=True)
class CropOutline:
    """What a crop is compared by. mask: (S, S) blurred. weight: (S, S), over the root of the
    silhouette's area."""

    crop: Crop
    mask: np.ndarray
    weight: np.ndarray

    def residual(self, profile: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """(S, S) drawn silhouette - mask, blurred."""
        return (
            blurred_mask(
                drawn(
                    profile, self.crop.camera.with_pose(pose @ self.crop.camera.world_from_camera)
                )
            )
            - self.mask
        )

    def weights(self, residual: np.ndarray) -> np.ndarray:
        return self.weight * np.where(residual < 0, BESIDE, 1.0)

    def slopes(self, residual: np.ndarray, others) -> np.ndarray:
        """(P, S * S) weighted derivatives, of (step, residual there) pairs."""
        w = self.weights(residual)
        return np.array([((w * (r - residual)) / step).ravel() for step, r in others])


def blurred_mask(picture: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(picture.astype(np.float32), (0, 0), BLUR)


def crop_outline(crop: Crop) -> CropOutline:
    known, mask = (crop.weight > 0.5).astype(np.float32), blurred_mask(crop.mask)
    return CropOutline(crop, mask, known / np.sqrt(max(float((mask * known).sum()), 1.0)))


def crop_misfit(outline: CropOutline, residual: np.ndarray) -> float:
    """Sum of squared weighted residuals, over the area of the silhouette."""
    return float(((outline.weights(residual) * residual) ** 2).sum())


def moved_pose(pose: np.ndarray, x: np.ndarray) -> np.ndarray:
    """x: turns across the axis (2, radians), shifts across the line of sight (2, unit lengths), log
    distance."""
    turn, middle = (
        exp_so3(np.array([x[0], 0.0, x[1]])) @ pose[:3, :3],
        -pose[:3, :3].T @ pose[:3, 3],
    )
    cross = hat(middle / np.linalg.norm(middle))  # np.cross takes ten times as long for one vector
    across = cross @ UP
    across /= np.linalg.norm(across)
    other = cross @ across
    middle = (middle + x[2] * across + x[3] * other) * np.exp(x[4])
    return similarity(turn, -turn @ middle)


def pose_slopes(outline: CropOutline, profile, pose, residual) -> np.ndarray:
    return outline.slopes(
        residual,
        [
            (s, outline.residual(profile, moved_pose(pose, s * e)))
            for s, e in zip(STEPS, np.eye(5), strict=True)
        ],
    )


def adjusted_pose(
    outline: CropOutline, profile: np.ndarray, pose: np.ndarray, rounds: int = 6
) -> tuple[np.ndarray, float]:
    """A pose that fits better, by Gauss-Newton, and its misfit."""
    r = outline.residual(profile, pose)
    best = crop_misfit(outline, r)
    for _ in range(rounds):
        slopes = pose_slopes(outline, profile, pose, r)
        step = -np.linalg.solve(
            slopes @ slopes.T + 0.2 * DAMPING * np.eye(5), slopes @ (outline.weights(r) * r).ravel()
        )
        before = best
        for part in (1.0, 0.5, 0.25):
            other = moved_pose(pose, np.clip(part * step, -0.3, 0.3))
            there = outline.residual(profile, other)
            if crop_misfit(outline, there) < best:
                pose, r, best = other, there, crop_misfit(outline, there)
                break
        if before - best < 0.005 * before:
            break
    return pose, best


def fit_profile_and_poses(
    outlines: list[CropOutline], body: Revolved, rounds: int, share: float = 1.0
) -> Revolved:
    """Profile and poses that fit better, by Gauss-Newton on all views together; the profile is
    shaped by the `share` that fits best."""
    profile, poses, n = body.profile, body.poses, 2 + KNOTS
    use = np.zeros(len(outlines), bool)
    use[np.argsort(body.misfits)[: max(2, round(share * len(outlines)))]] = True
    bends = np.zeros((n, n))
    bends[2:, 2:] = np.diff(np.eye(KNOTS), 2, axis=0).T @ np.diff(np.eye(KNOTS), 2, axis=0)
    bends *= SMOOTH * len(outlines)
    residuals = [o.residual(profile, pose) for o, pose in zip(outlines, poses, strict=True)]
    misfits = np.array([crop_misfit(o, r) for o, r in zip(outlines, residuals, strict=True)])
    for _ in range(rounds):
        normal, right, own = DAMPING * len(outlines) * np.eye(n) + bends, bends @ profile, []
        for o, pose, r, shapes in zip(outlines, poses, residuals, use, strict=True):
            by_pose, weighted = pose_slopes(o, profile, pose, r), (o.weights(r) * r).ravel()
            inverse, down = (
                np.linalg.inv(by_pose @ by_pose.T + DAMPING * np.eye(5)),
                by_pose @ weighted,
            )
            by_shape = o.slopes(
                r, [(0.02, o.residual(profile + 0.02 * e, pose)) for e in np.eye(n)]
            )
            cross = by_shape @ by_pose.T
            own.append((inverse, cross, down))
            if shapes:  # the poses eliminated (Schur complement)
                normal += by_shape @ by_shape.T - cross @ inverse @ cross.T
                right += by_shape @ weighted - cross @ inverse @ down
        step, before = -np.linalg.solve(normal, right), misfits[use].sum()
        for part in (1.0, 0.5, 0.25):
            shape = profile + part * step
            there = [
                moved_pose(p, np.clip(-part * (inverse @ (down + cross.T @ step)), -0.3, 0.3))
                for p, (inverse, cross, down) in zip(poses, own, strict=True)
            ]
            others = [o.residual(shape, pose) for o, pose in zip(outlines, there, strict=True)]
            levels = np.array([crop_misfit(o, r) for o, r in zip(outlines, others, strict=True)])
            if levels[use].sum() < before:
                profile, poses, residuals, misfits = shape, np.array(there), others, levels
                break
        if before - misfits[use].sum() < 0.003 * before:
            break
    return Revolved(profile, poses, misfits)


def sought(
    outlines: list[CropOutline], rings: Rings, body: Revolved, keep: int = 5
) -> list[list[tuple[np.ndarray, float]]]:
    """(pose, misfit) of each view, best first: what a search under all tilts finds, adjusted, what
    leans back, and the pose it has."""
    found = search(
        [o.crop for o in outlines],
        tilted_gallery(body.profile, 5.0, eyes_at(body.poses)),
        keep=keep,
        rings=rings,
        apart=20.0,
    )
    out = []
    for outline, poses, scores, own in zip(
        outlines, found.poses, found.scores, body.poses, strict=True
    ):
        tried = [adjusted_pose(outline, body.profile, pose) for pose in (own, *poses[scores > -1])]
        tried += [adjusted_pose(outline, body.profile, leaning_back(pose)) for pose, _ in tried]
        out.append(sorted(tried, key=lambda one: one[1]))
    return out


def fit_revolution(
    views: list[InstanceView], crops: list[Crop], least: float = 0.0, most: float = np.inf
) -> Revolved | None:
    """One profile and a pose for each view that explain all silhouettes; None where no silhouette
    can be revolved.

    least, most: given up where no silhouette, revolved, scores so well against the others, and
    where no first fit has a smaller misfit.
    """
    rings, outlines, distance = (
        crop_rings(crops, OUTLINE),
        [crop_outline(c) for c in crops],
        frame_scale(views),
    )
    first = []
    for k in best_seen(views)[:REVOLVED]:
        for pose in poses_on_lines(views[k], distance):
            profile = revolved_silhouette(views[k], pose)
            if profile is not None:
                gallery = tilted_gallery(profile, 7.5, distance)
                first.append(
                    (
                        float(all_scores(rings, gallery.rings).max((1, 2)).mean()),
                        k,
                        profile,
                        gallery,
                    )
                )
    if not first or max(one[0] for one in first) < least:
        return None
    taken, bodies = Counter(), []
    for _, k, profile, gallery in sorted(first, key=lambda one: -one[0]):
        if taken[k] < EACH and taken.total() < STARTS:
            taken[k] += 1
            poses = search(crops, gallery, keep=1, rings=rings).poses[:, 0]
            bodies.append(
                fit_profile_and_poses(outlines, Revolved(profile, poses, np.zeros(len(views))), 3)
            )
    if min(one.misfit for one in bodies) >= most:
        return None
    lasts = [
        refine_revolution(outlines, rings, body)
        for body in sorted(bodies, key=lambda one: one.misfit)[:LAST]
    ]
    best = min(lasts, key=lambda one: one.misfit)
    return min(
        best,
        refine_revolution(outlines, rings, leaning_the_other_way(outlines, best)),
        key=lambda one: one.misfit,
    )


def refine_revolution(outlines: list[CropOutline], rings: Rings, body: Revolved) -> Revolved:
    """The body after rounds of Gauss-Newton, and a search for better poses after each; more views
    shape the profile each time."""
    for share in TRIMMED:
        body = fit_profile_and_poses(outlines, body, 6, share)
        tops = [one[0] for one in sought(outlines, rings, body)]
        body = Revolved(
            body.profile,
            np.array([pose for pose, _ in tops]),
            np.array([level for _, level in tops]),
        )
    return fit_profile_and_poses(outlines, body, 8)


def leaning_the_other_way(outlines: list[CropOutline], body: Revolved) -> Revolved:
    """The body with all axes mirrored in the picture plane. From afar all outlines together are the
    same so (Necker's cube), and a fit
    that began there stays there: perspective tells which is right, once both are fitted."""
    tops = [
        adjusted_pose(o, body.profile, leaning_back(pose), 10)
        for o, pose in zip(outlines, body.poses, strict=True)
    ]
    other = Revolved(
        body.profile, np.array([pose for pose, _ in tops]), np.array([level for _, level in tops])
    )
    for share in TRIMMED[1:]:
        other = fit_profile_and_poses(outlines, other, 8, share)
    return other


def seats_of(crops: list[Crop], body: Revolved, most: int = 8) -> list[list[np.ndarray]]:
    """Poses (4, 4) of each view that fit it about as well as the best one, best first, with axes
    APART from each other."""
    outlines, out = [crop_outline(c) for c in crops], []
    for tried in sought(outlines, crop_rings(crops, OUTLINE), body, keep=6):
        level, kept = AS_WELL[0] * tried[0][1] + AS_WELL[1], []
        for pose, height in tried:
            if (
                height <= level
                and len(kept) < most
                and all(axis_angle_between(pose, other) >= APART for other in kept)
            ):
                kept.append(pose)
        out.append(kept)
    return out


def axis_angle_between(a: np.ndarray, b: np.ndarray) -> float:
    """Degrees between the axes of two poses."""
    return rotation_angle(rotation_from(axis_of(a), axis_of(b)))

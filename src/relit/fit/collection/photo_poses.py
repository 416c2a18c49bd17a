"""Where the photos of a collection were taken from: links, search, and the verdict on both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from relit.cameras.links import Group
from relit.errors import UserError
from relit.fit.collection.links import poses_from_links
from relit.fit.collection.options import CollectionOptions
from relit.fit.collection.photos import CollectionPhoto, PhotoSet, collection_crops
from relit.fit.collection.surface import posterior
from relit.fit.registration.photos.growth import find_poses
from relit.fit.registration.photos.poses import cross_validated_share, schedule_of
from relit.geometry.hull import NoShape
from relit.recipe import FitContext
from relit.scene import Camera

CHECKED = 12  # photos from which on the poses are checked by leaving out half of them


@dataclass(frozen=True)
class PhotoPoses:
    """poses: (P, 4, 4) world_from_camera in the object's frame. scores: (P,) of the registration, 1
    is perfect. agreement: share of the photos that find their place in a model of the others, NaN
    where it was not measured. linked: (P,) bool, poses that come from matches."""

    poses: np.ndarray
    scores: np.ndarray
    agreement: float
    linked: np.ndarray

    def cameras(self, shots: Sequence[CollectionPhoto]) -> list[Camera]:
        """The cameras of the photos at these poses."""
        return [s.camera.with_pose(p) for s, p in zip(shots, self.poses, strict=True)]

    def weights(self) -> np.ndarray:
        """(P,) weights of the photos by how well they agree (SAMURAI Eq. 9)."""
        loss = 1 - self.scores
        return posterior(loss, [*loss, *loss][:1000] * (20 // len(loss) + 1))


def pose_stage(photos: PhotoSet, groups: Sequence[Group], fit: FitContext) -> PhotoPoses:
    """Poses of all photos. Raises UserError where they are wrong as a whole; when resumed too."""
    title = "where the photos were taken from"
    found = fit.run.cached(
        "poses", PhotoPoses, lambda stage: find_all(photos, groups, fit), title=title
    )
    judge_poses(found, photos.names, fit.options, fit.run)
    return found


def find_all(photos: PhotoSet, groups: Sequence[Group], fit: FitContext) -> PhotoPoses:
    """Poses from links, hints and search."""
    run, options, seed = fit.run, fit.options, fit.seed
    shots, degrees = photos.shots, photos.degrees
    crops, hints = collection_crops(shots), np.array([s.direction for s in shots])
    schedule, without = schedule_of(options.rounds), options.without
    try:
        begun = (
            None
            if "search" in without
            else poses_from_links(
                crops, groups, shots, hints, degrees, options.hypotheses, seed, run.say
            )
        )
        args = (
            crops,
            hints,
            degrees,
            schedule,
            options.hypotheses,
            options.starts,
            without,
            seed,
            run.say,
            options.polish,
            begun,
        )
        poses, scores = find_poses(
            *args, soft=options.lambda_c if options.assignment == "soft" else None
        )
    except NoShape as error:
        why = f"{error}: the masks belong to different objects, or are wrong"
        raise UserError(
            "no shape agrees with the photos", why, "look at the masks (relit inspect)", code=4
        ) from None
    linked = np.zeros(len(shots), bool) if begun is None else begun[2]
    share = np.nan
    if len(shots) >= CHECKED and "search" not in without and linked.mean() < 0.5:
        share = cross_validated_share(crops, poses, seed)
    return PhotoPoses(poses, scores, float(share), linked)


def judge_poses(found: PhotoPoses, names: Sequence[str], options: CollectionOptions, run) -> None:
    """Say how well the photos agree, and which do not. Raises UserError (code 4) when the poses are
    wrong as a whole."""
    scores, share = found.scores, found.agreement
    mean, least = float(np.mean(scores)), options.least_score
    run.say(f"mean score of the registration {mean:.3f} (1 is perfect; below {least} is a failure)")
    if np.isfinite(share):
        run.say(
            f"{share:.0%} of the photos find their place in a model of the others (below {options.least_agreement:.0%} is a failure)"
        )
    elif len(names) < CHECKED:
        run.say(
            f"note: with fewer than {CHECKED} photos nothing tells whether the poses are right: look at the result"
        )
    worst = np.argsort(scores)
    low = [
        k
        for k in worst
        if scores[k]
        < np.median(scores) - 4 * max(float(np.median(np.abs(scores - np.median(scores)))), 0.004)
    ]
    if low:
        named = ", ".join(f"{names[k]} ({scores[k]:.2f})" for k in low[:5])
        run.say(
            f"note: {len(low)} photos agree badly with the others (another object, a wrong mask or a wrong pose): {named}"
        )
    if mean < least or share < options.least_agreement:
        told = f"score {mean:.3f}, {least} is needed"
        if share < options.least_agreement:
            told = f"{share:.0%} find their place in a model of the others, {options.least_agreement:.0%} are needed"
        raise UserError(
            f"where the photos were taken from could not be found: they agree with no common shape ({told})",
            "too few photos, wrong masks, photos of different objects, quadrants of other photos, or an object alike from all sides",
            "look at the masks; answer `relit quadrants PHOTOS`; add photos between those that are far apart",
            code=4,
        )

"""Where the photos of a collection were taken from: links, search, and the verdict on both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from relit.cameras.links import Group
from relit.errors import UserError
from relit.fit.collection.links import poses_from_links, with_focals
from relit.fit.collection.options import CollectionOptions
from relit.fit.collection.photos import CollectionPhoto, PhotoSet, collection_crops
from relit.fit.collection.surface import posterior
from relit.fit.registration.fine_detail import detail_correlation, detail_of, surface_of
from relit.fit.registration.photos.growth import find_poses
from relit.fit.registration.photos.poses import (
    coarse_model,
    cross_validated_share,
    gauge,
    schedule_of,
)
from relit.geometry.hull import NoShape
from relit.geometry.mesh import extract_mesh
from relit.geometry.sdf import dense_values
from relit.recipe import FitContext
from relit.scene import Camera

CHECKED = 12  # photos from which on the poses are checked by leaving out half of them
BORNE_OUT = 0.25  # correlation of fine detail from which on a photo is taken to be in its place
NODES, STEPS, TOLERANCE = 64, 150, 0.12  # of the coarse model whose surface shows fine detail
FACES = 10_000  # of that surface
CLEAR = 0.8  # agreement and share of borne-out photos from which on no other solution is sought


@dataclass(frozen=True)
class PoseEvidence:
    """What the photos say of a whole set of poses, whatever found them; each in [0, 1].

    score: mean of the registration (silhouettes and colours normalised for light), 1 is perfect.
    agreement: share of the photos that a search without hints puts where they are, in a model of the
    other half of them; NaN where it was not measured. detail: mean correlation of what each photo
    shows in fine detail with what the others show at the same places, negative ones as 0; NaN where
    it was not measured. borne_out: share of the photos whose correlation is BORNE_OUT and more.
    """

    score: float
    agreement: float
    detail: float
    borne_out: float

    @property
    def total(self) -> float:
        """Sum of score, agreement and detail, as far as they were measured."""
        return float(np.nansum([self.score, self.agreement, self.detail]))

    @property
    def clear(self) -> bool:
        """Whether agreement and detail both bear out nearly all poses."""
        return self.agreement >= CLEAR and self.borne_out >= CLEAR

    def __str__(self) -> str:
        share = "not measured" if np.isnan(self.agreement) else f"{self.agreement:.0%}"
        return f"score {self.score:.3f}, agreement {share}, fine detail {self.detail:.2f}"


@dataclass(frozen=True)
class PhotoPoses:
    """poses: (P, 4, 4) world_from_camera in the object's frame. scores: (P,) of the registration, 1
    is perfect. linked: (P,) bool, poses that come from matches. focals: (P,) pixels. source: what
    found them. evidence: for them. margin: by how much the evidence (`PoseEvidence.total`) exceeds
    that of the other solution that was carried to the end, NaN where there was none."""

    poses: np.ndarray
    scores: np.ndarray
    linked: np.ndarray
    focals: np.ndarray
    source: str
    evidence: PoseEvidence
    margin: float = float("nan")

    def cameras(self, shots: Sequence[CollectionPhoto]) -> list[Camera]:
        """The cameras of the photos at these poses."""
        return [
            replace(s.camera, fx=float(f), fy=float(f), world_from_camera=p)
            for s, p, f in zip(shots, self.poses, self.focals, strict=True)
        ]

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
    """Poses from matches and from hints and search. Neither chooses the path: where both give a
    solution, and that of the matches is not clearly borne out, both are carried to the end and the
    one with more evidence is kept."""
    say, solutions = fit.run.say, []
    matched = None if "search" in fit.options.without else solution_by_matches(photos, groups, fit)
    if matched is not None:
        say(f"poses from matches: {matched.evidence}")
        given = all(s.given is not None for s in photos.shots)
        if matched.evidence.clear or given:
            return matched
        solutions.append(matched)
    try:
        searched = solution_by_search(photos, fit)
    except NoShape as error:
        if not solutions:
            why = f"{error}: the masks belong to different objects, or are wrong"
            fix = "look at the masks (relit inspect)"
            raise UserError("no shape agrees with the photos", why, fix, code=4) from None
        say(f"note: search without the matches finds no shape ({error})")
        return solutions[0]
    solutions.append(searched)
    if len(solutions) == 1:
        return searched
    say(f"poses from search: {searched.evidence}")
    other, best = sorted(solutions, key=lambda one: one.evidence.total)
    margin = best.evidence.total - other.evidence.total
    say(f"poses from {best.source} are kept: their evidence is larger by {margin:.2f}")
    return replace(best, margin=margin)


def solution_by_matches(
    photos: PhotoSet, groups: Sequence[Group], fit: FitContext
) -> PhotoPoses | None:
    """The solution that begins with the largest group of linked photos; None where no group carries
    a shape."""
    options, shots = fit.options, with_focals(photos.shots, groups)
    crops, hints = collection_crops(shots), np.array([s.direction for s in shots])
    try:
        begun = poses_from_links(
            crops, groups, shots, hints, photos.degrees, options.hypotheses, fit.seed, fit.run.say
        )
        if begun is None:
            return None
        poses, scores = posed(crops, hints, photos.degrees, fit, begun)
    except NoShape:
        return None
    return supported("matches", shots, crops, (poses, scores, begun[2]), fit)


def solution_by_search(photos: PhotoSet, fit: FitContext) -> PhotoPoses:
    """The solution of hints and search alone. Raises NoShape where there is none."""
    shots = photos.shots
    crops, hints = collection_crops(shots), np.array([s.direction for s in shots])
    poses, scores = posed(crops, hints, photos.degrees, fit, None)
    return supported("search", shots, crops, (poses, scores, np.zeros(len(shots), bool)), fit)


def posed(crops, hints: np.ndarray, degrees: float, fit: FitContext, begun):
    """`find_poses` with the recipe's options."""
    options = fit.options
    return find_poses(
        crops,
        hints,
        degrees,
        schedule_of(options.rounds),
        options.hypotheses,
        options.starts,
        options.without,
        fit.seed,
        fit.run.say,
        options.polish,
        begun,
        soft=options.lambda_c if options.assignment == "soft" else None,
    )


def supported(
    source: str, shots: Sequence[CollectionPhoto], crops, found: tuple, fit: FitContext
) -> PhotoPoses:
    """The solution with its evidence. found: (poses, scores, linked)."""
    poses, scores, linked = found
    searched = "search" not in fit.options.without
    agreement = detail = borne_out = float("nan")
    if searched and len(shots) >= CHECKED:
        agreement = float(cross_validated_share(crops, poses, fit.seed))
    if searched:
        each = shared_detail(shots, crops, poses, fit)
        detail, borne_out = float(np.maximum(each, 0).mean()), float((each >= BORNE_OUT).mean())
    evidence = PoseEvidence(float(np.mean(scores)), agreement, detail, borne_out)
    focals = np.array([s.camera.fx for s in shots])
    return PhotoPoses(poses, scores, linked, focals, source, evidence)


def shared_detail(
    shots: Sequence[CollectionPhoto], crops, poses: np.ndarray, fit: FitContext
) -> np.ndarray:
    """(P,) correlation of what each photo shows in fine detail with what the others show there, on
    the surface of a coarse model of all (`detail_correlation`)."""
    placed = gauge(crops, poses)
    model = coarse_model(crops, placed, NODES, STEPS, TOLERANCE, fit.seed)
    surface = surface_of(extract_mesh(dense_values(model.grid), faces=FACES))
    cameras = [s.camera.with_pose(p) for s, p in zip(shots, placed, strict=True)]
    return detail_correlation(surface, [detail_of(s.rgb, s.mask) for s in shots], cameras)


def judge_poses(found: PhotoPoses, names: Sequence[str], options: CollectionOptions, run) -> None:
    """Say how well the photos agree, and which do not. Raises UserError (code 4) when the poses are
    wrong as a whole."""
    scores, share = found.scores, found.evidence.agreement
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
        run.refuse(
            f"where the photos were taken from could not be found: they agree with no common shape ({told})",
            "too few photos, wrong masks, photos of different objects, quadrants of other photos, or an object alike from all sides",
            "look at the masks; answer `relit quadrants PHOTOS`; add photos between those that are far apart",
        )

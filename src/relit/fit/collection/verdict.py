"""Whether the photos bear out a finished registration of a collection as a whole.

No score of one photo tells that all are wrong: a shape grows around any set of poses. Three kinds of
evidence do not share its assumptions: photos that the model has not seen, fine detail that several
photos show at the same places, and hints of the user. A result that all of them contradict is
refused.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from relit.fit.collection.photos import PhotoSet
from relit.run import Run
from relit.scene import Camera

LEAST = 0.5  # share of the photos below which agreement or fine detail contradict a registration
# of the largest error of hints: median angle above which they contradict it. Errors that are even
# over a cap of that size have a median of .7
ASTRAY = 0.75
LEAST_KINDS = 2  # of evidence that a refusal needs


def hint_error(photos: PhotoSet, cameras: Sequence[Camera]) -> float:
    """Median angle in degrees between the cameras' directions and the hints; NaN where fewer than
    half of the photos have one."""
    hints = np.array([s.direction for s in photos.shots])
    hinted = np.linalg.norm(hints, axis=1) > 0.5
    if hinted.mean() < 0.5:
        return float("nan")
    eyes = np.array([c.centre for c in cameras])
    eyes /= np.linalg.norm(eyes, axis=1, keepdims=True)
    cosine = np.clip((eyes * hints).sum(1)[hinted], -1, 1)
    return float(np.degrees(np.median(np.arccos(cosine))))


def contradictions(
    photos: PhotoSet, cameras: Sequence[Camera], agreement: float, borne_out: float
) -> tuple[list[str], int]:
    """(what speaks against the poses, how many kinds of evidence there are). agreement: see
    `PoseEvidence`. borne_out: share of the photos that fine detail bears out in the finished shape;
    NaN for what was not measured."""
    error, limit = hint_error(photos, cameras), ASTRAY * photos.degrees
    kinds = [
        (
            agreement,
            agreement < LEAST,
            f"{agreement:.0%} of the photos are found again in a model of the others",
        ),
        (borne_out, borne_out < LEAST, f"fine detail confirms {borne_out:.0%}"),
        (
            error,
            error > limit,
            f"viewing directions are {error:.0f} degrees from the hints (median)",
        ),
    ]
    known = [kind for kind in kinds if np.isfinite(kind[0])]
    return [text for _, against, text in known if against], len(known)


def check_borne_out(
    photos: PhotoSet, cameras: Sequence[Camera], agreement: float, borne_out: float, run: Run
) -> None:
    """Refuse poses that every kind of evidence contradicts, where there are LEAST_KINDS of it."""
    against, kinds = contradictions(photos, cameras, agreement, borne_out)
    if kinds >= LEAST_KINDS and len(against) == kinds:
        run.refuse(
            f"the photos contradict the camera poses that were found: {'; '.join(against)}",
            "poses are wrong as a whole, photos show different objects, or the object is plain and alike from several sides",
            "add photos between those that are far apart, answer `relit quadrants PHOTOS`, or look at the masks",
        )

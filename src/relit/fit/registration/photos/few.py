"""Where each of a few photos was taken from: several ways, and the one whose poses explain the
photos best.

What a search finds is worth what its model is worth, and a model of a few photos is worth little
while their poses are wrong: the search then scatters photos whose hints were nearly right. With few
photos descent comes first, from the hints themselves, and the search second, in the sharper model.
Neither order is always the better one, so both are gone, and a fit with the poses free tells which:
a score of the registration does not, as a model of wrong poses is vague and agrees with many.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from relit.fit.passes.optimiser import NoStage
from relit.fit.registration.photos.depth import depth_limit
from relit.fit.registration.photos.poses import (
    Schedule,
    fit_with_free_poses,
    gauge,
    polish,
    pose_towards,
    poses_from_hints,
)
from relit.fit.registration.register import Crop
from relit.geometry.hull import NoShape

FEW = 24  # photos below which the ways are held against each other
NODES, STEPS = 48, 200  # of the fit that tells
# mean score by which poses may lie behind others and still be taken: photos that a search lost fit
# nothing
BEHIND = 0.05

Way = Callable[[], tuple[np.ndarray, np.ndarray]]


def photometric_misfit(crops: list[Crop], poses: np.ndarray, seed: int) -> float:
    """How badly one shape with one light per photo explains the photos, from these poses (P, 4, 4)
    on: the geometric mean of the volume pass's colour and mask losses, so that neither counts for
    its scale."""
    heard = NoStage()
    fit_with_free_poses(
        crops,
        poses,
        NODES,
        STEPS,
        seed,
        None,
        depth_limit(crops, gauge(crops, poses), NODES),
        heard,
    )
    return float(np.sqrt(heard.mean_loss("colour") * heard.mean_loss("mask")))


def best_way(
    crops: list[Crop], ways: dict[str, Way], seed: int, say
) -> tuple[np.ndarray, np.ndarray]:
    """Poses (P, 4, 4) and scores (P,) of the way with the least misfit, of those that are not
    BEHIND. Ways that raise NoShape are passed over; raises NoShape when all do."""
    found, failed = [], None
    for name, way in ways.items():
        try:
            poses, scores = way()
            wrong = photometric_misfit(crops, poses, seed)
        except NoShape as error:
            say(f"{name}: {error}")
            failed = error
            continue
        say(f"{name}: mean score {scores.mean():.3f}, misfit {wrong:.4f}")
        found.append((wrong, poses, scores))
    if not found:
        raise failed or NoShape("there is no way")
    most = max(scores.mean() for *_, scores in found)
    return min((f for f in found if f[2].mean() >= most - BEHIND), key=lambda f: f[0])[1:]


def polished(
    crops: list[Crop],
    poses,
    directions: np.ndarray,
    degrees: float,
    keep: int,
    seed: int,
    say,
    cycles: int,
):
    """As `collection_poses.polish`, but a cycle whose search loses photos (the mean score falls by
    more than BEHIND) is taken back, and is the last one."""
    best = None
    for i in range(cycles):
        poses, scores = polish(
            crops, poses, directions, degrees, keep, seed, say, i + 1, limited=True, begun=i
        )
        if best is not None and scores.mean() < best[1].mean() - BEHIND:
            say("the last search lost photos and is taken back")
            return best
        best = (poses, scores)
    return poses, scores


def few_from_hints(
    crops: list[Crop],
    directions: np.ndarray,
    degrees: float,
    schedule: Schedule,
    keep: int,
    seed: int,
    say,
    cycles: int,
    soft=None,
):
    """As `collection_poses.poses_from_hints` with `polish` after it, for few photos, all of which
    have hints."""

    def descent_first():
        begun = gauge(
            crops, np.array([pose_towards(c, d) for c, d in zip(crops, directions, strict=True)])
        )
        return polished(crops, begun, directions, degrees, keep, seed, say, cycles)

    def search_first():
        begun = poses_from_hints(
            crops, directions, degrees, schedule, seed, say, keep, soft, limited=True
        )[0]
        return polished(crops, begun, directions, degrees, keep, seed, say, cycles)

    return best_way(
        crops, {"descent first": descent_first, "search first": search_first}, seed, say
    )

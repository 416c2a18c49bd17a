"""The search for poses of identical objects that are bodies of revolution, or nearly: bottles,
cans, vases, cups.

Their silhouettes tell where the axis of each points (fit/registration/instances/revolution_fit.py),
what sticks out of them (fit/registration/instances/protrusions.py) or their decoration
(fit/registration/instances/unrolled.py) the turn about it. Of several answers a model of all says
which holds. Those who are not sure of their turns are asked as growth asks them
(`instance_regrowth.confirmed`); where that tells nothing, the axes are still right, and with them
the shape.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from relit.fit.registration.instances.options import DETAILED, Search
from relit.fit.registration.instances.protrusions import turned_by_outline
from relit.fit.registration.instances.regrowth import Placed
from relit.fit.registration.instances.revolution_fit import fit_revolution, seats_of
from relit.fit.registration.instances.rounds import model_of_all
from relit.fit.registration.instances.unrolled import turned_by_decoration
from relit.fit.registration.instances.views import InstanceView, albedo_render, carved, fit_model
from relit.fit.registration.register import Crop, crop_rings, refine
from relit.geometry.hull import NoShape

FEWEST = (
    4  # objects: of fewer, silhouettes that something else has can be those of a body of revolution
)
# score of the best silhouette, revolved, against all others, below which nothing is fitted
LIKELY = 0.96
FIRST, NEARLY, EXACT = (
    0.006,
    0.004,
    0.001,
)  # misfit (`Revolved.misfit`) of a first fit, of a body with a handle, and of one without
# seats of the median object, from which on the silhouettes do not tell the axis: those of a ball
OPEN = 5
LONGER, CLOSE = (
    3,
    0.05,
    # times the steps of a first fit that decide between answers whose agreements lie so near to the
    # best one
)
DECORATION = (
    0.0,
    2.0,
    0.0,
    1.0,
)  # weights of fit.register's descriptor: silhouettes agree in every turn
LAID, FLAT = (
    6,
    0.4,
    # objects from which on a plane tells, and how far from it (root mean square, unit lengths) their
    # middles may lie
)


@dataclass(frozen=True)
class RevolvedPlaces:
    """What outlines and maps tell. placed: where all stand. axes: their outlines are those of a
    body of revolution, so that the axes hold whatever the turns. certain: nothing else has these
    outlines where it is: a triaxial ellipsoid has them, if from other distances, so most have to be
    sure of their turn, or all to lie on one plane. What has a handle is certain where most are
    sure."""

    placed: Placed
    axes: bool
    certain: bool


def place_revolved(
    views: list[InstanceView], crops: list[Crop], o: Search, *, seed: int = 0, say=lambda text: None
) -> RevolvedPlaces | None:
    """Where bodies of revolution stand, and which are not sure of their turn about the axis; None
    where the objects are none, or their silhouettes do not tell the axis."""
    if len(views) < FEWEST:
        return None
    body = fit_revolution(views, crops, LIKELY, FIRST)
    if body is None or body.misfit > NEARLY:
        return None
    seats = seats_of(crops, body)
    exact = body.misfit <= EXACT
    if exact and np.median([len(some) for some in seats]) >= OPEN:
        return None
    answers = turned_by_decoration(views, body.profile, seats) if exact else {}
    beside = turned_by_outline(views, body.profile, np.array([some[0] for some in seats]))
    if beside is not None:
        answers["what sticks out"] = beside
    told = most_likely_set(
        views, crops, {name: answer.poses for name, answer in answers.items()}, o, seed
    )
    if told is None:
        return None
    poses, sure = answers[told].poses, answers[told].sure
    say(
        f"bodies of revolution: one profile fits the outlines (misfit {body.misfit:.5f} of a silhouette's area)"
    )
    say(f"turned about their axes by {told}: {sure.sum()} of {len(views)} are sure")
    own = model_of_all(views, poses, o, seed=seed)[1]
    placed = Placed(
        poses,
        own,
        tuple(np.flatnonzero(sure).tolist()),
        tuple(np.flatnonzero(~sure).tolist()),
        DETAILED,
    )
    return RevolvedPlaces(placed, exact, mostly_sure(placed) or (exact and lies_on_plane(poses)))


def mostly_sure(placed: Placed) -> bool:
    return len(placed.firm) >= max(FEWEST, len(placed.own) / 2)


def lies_on_plane(poses: np.ndarray) -> bool:
    """Whether the middles of LAID objects or more lie on one plane."""
    middles = np.array([-p[:3, :3].T @ p[:3, 3] for p in poses])
    return len(poses) >= LAID and np.linalg.svd(middles - middles.mean(0))[1][2] <= FLAT * np.sqrt(
        len(poses)
    )


def most_likely_set(
    views, crops, answers: dict[str, np.ndarray], o: Search, seed: int
) -> str | None:
    """Which of several sets of poses (N, 4, 4) agrees best with a model of all of it; None where
    none does at all. Where others come close,
    longer fits decide: wrong turns make the model of all better for a while as well."""
    levels = {
        name: decoration_agreement(views, crops, poses, o, seed, 2 * o.steps)
        for name, poses in answers.items()
    }
    best = max(levels.values(), default=-np.inf)
    if best == -np.inf:
        return None
    close = [name for name, level in levels.items() if level >= best - CLOSE]
    if len(close) > 1:
        levels = {
            name: decoration_agreement(views, crops, answers[name], o, seed, LONGER * 2 * o.steps)
            for name in close
        }
    return max(levels, key=levels.get)


def decoration_agreement(
    views, crops, poses: np.ndarray, o: Search, seed: int, steps: int
) -> float:
    """Median score of all against a model of all, without silhouettes; -inf where these have
    nothing in common. steps: of the fit."""
    try:
        values = carved(views, poses, o.nodes + 8, 0.15, o.depth, crossed=True)
    except NoShape:
        return -np.inf
    o.effort.spend(steps)
    model, poses = fit_model(
        views, poses, values, steps, refine_cameras=o.rate, hold=o.steps // 2, seed=seed
    )
    scores = refine(
        crops,
        poses,
        albedo_render(model),
        rings=crop_rings(crops, DECORATION),
        steps=(0, 2.0),
        parts=DECORATION,
    )[1]
    return float(np.median(scores))

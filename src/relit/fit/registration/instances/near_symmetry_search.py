"""Which of the turns by which an object nearly looks like itself each instance has.

A teapot with the same flowers on either side: matching links its instances half a turn off as
readily as right, and what grows on such links agrees with itself. Pictures of the body say the same
either way, but spout and handle cannot both be on one side. So for the turns by which a model of
all looks most like itself (fit/registration/instances/near_symmetry.py) the set is sought whose
silhouettes are of one body (fit/registration/instances/silhouette_turns.py); a model of all is
fitted to it anew, as the turns may have blurred it, and it is sought again. Those whose silhouettes
tell little, as spout and handle point at the camera, are then turned one at a time, and models
fitted to all say which is better, by paint and by silhouettes.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import minimize

from relit.conventions import similarity
from relit.fit.registration.instances.bodies import CoarseBody, body_of
from relit.fit.registration.instances.growth import ANOTHER, registered
from relit.fit.registration.instances.near_symmetry import AlikeTurn, alike_turns, as_turn
from relit.fit.registration.instances.options import DETAILED, Search
from relit.fit.registration.instances.regrowth import NO_GAIN
from relit.fit.registration.instances.rounds import model_of_all
from relit.fit.registration.instances.silhouette_turns import FINE, NODES, Silhouettes
from relit.fit.registration.instances.views import InstanceView, eyes_at, overlaps
from relit.fit.registration.register import (
    Crop,
    Rings,
    chosen_rings,
    directions_around,
    refine,
    views_from,
)
from relit.fit.shape.alignment import tangents
from relit.geometry.hull import NoShape
from relit.geometry.se3 import nearest_rotation, rotation_angle

TRIED = 3  # turns by which the model looks most like itself
ROUNDS = 4  # of silhouettes and models of all, until the silhouettes ask for no more
# degrees within which instances that are turned are registered about where the turn puts them
NEAR = 20.0
ASKED = 8  # instances that are turned one at a time: those for whom the silhouettes mind it least
SWEEPS, SETTLED = 2, 2  # of these, and models of all on which poses settle before they are judged
GAIN = 0.01  # of `Turned.value`, by which turns are worth it
# of the gap, that turns must close to be looked into: of a body of revolution any turn is as good
CLEARLY = 0.005
MOVED, TRIES = (
    0.05,
    30,
)  # unit lengths by which the turn's axis moves first, and how often it is looked at


@dataclass(frozen=True)
class Turned:
    """Poses (N, 4, 4), and scores (N,) of all against a model of all. value: their mean, and the
    mean overlap of the silhouettes with that model, less what those of one body leave out
    (`Silhouettes.gap`). rotations: (S, 3, 3) that were asked, the first none."""

    poses: np.ndarray
    own: np.ndarray
    value: float
    rotations: np.ndarray = field(default_factory=lambda: np.eye(3)[None])


@dataclass(frozen=True)
class Asked:
    """Whose turns are asked. rings: of the crops under DETAILED. exact: the poses are those of a
    fine model, which coarse ones would lead
    away: they are turned, but do not move."""

    views: list[InstanceView]
    crops: list[Crop]
    rings: Rings
    options: Search
    seed: int
    exact: bool

    @property
    def nodes(self) -> int:
        """Of the body that silhouettes are held against, a side."""
        return FINE if self.exact else NODES

    def model(self, poses: np.ndarray, trial: int = 0) -> CoarseBody:
        """A model of all, fitted to poses (N, 4, 4). Raises NoShape."""
        return model_at(self.views, poses, self.options, self.seed + trial)

    def settled(self, body: CoarseBody, poses: np.ndarray) -> np.ndarray:
        """Poses (N, 4, 4) after a descent against a model."""
        return refine(
            self.crops, poses, body.render, rings=self.rings, steps=(0, 4.0, 2.0), parts=DETAILED
        )[0]


def coherent_turns(
    views: list[InstanceView],
    crops: list[Crop],
    rings: Rings,
    poses: np.ndarray,
    o: Search,
    *,
    seed: int,
    exact=False,
    say=lambda text: None,
) -> Turned | None:
    """The instances, some of them turned by one of the turns by which the object nearly looks like
    itself; None where none had to be.
    rings, exact: see `Asked`."""
    asked = Asked(views, crops, rings, o, seed, exact)
    try:
        body = asked.model(poses)
    except NoShape:
        return None
    first: Turned | None = None
    for turn in alike_turns(body.gallery, TRIED):
        if o.effort.over:
            break
        try:
            sought = by_silhouettes(asked, body, poses if exact else body.poses, turn)
            if sought is None:
                continue
            first = first or score_settled_poses(asked, poses)
            best = one_at_a_time(asked, sought, turn)
        except NoShape:  # turned so, the silhouettes have nothing in common
            continue
        if best.value > first.value + GAIN:
            moved = int(
                sum(
                    rotation_angle(a[:3, :3].T @ b[:3, :3]) > NEAR
                    for a, b in zip(best.poses, poses, strict=True)
                )
            )
            say(
                f"{min(moved, len(views) - moved)} of {len(views)} were turned by a turn by which the object looks like itself (a "
                f"circle's part of {turn.order}): they agree better by {best.value - first.value:.3f}"
            )
            return replace(best, rotations=motions_about(turn, np.zeros(3))[:, :3, :3])
    return None


def stands(
    views, crops, rings: Rings, turned: Turned, k: int, o: Search, seed: int, links=()
) -> bool:
    """Whether an instance, asked against a model of the others, stands where it does, up to the
    turns that were told apart: every other place scores less by `o.growth.sure`."""
    rest = [j for j in range(len(views)) if j != k]
    try:
        body = model_at([views[j] for j in rest], turned.poses[rest], o, seed)
    except NoShape:
        return False
    poses = turned.poses.copy()
    poses[rest] = body.poses
    places, heights = registered(
        views, crops, rings, DETAILED, body, poses, rest, [k], o.growth, links
    )
    _, height = refine(
        [crops[k]],
        poses[[k]],
        body.render,
        rings=chosen_rings(rings, [k]),
        steps=(0, 4.0, 2.0),
        parts=DETAILED,
    )
    own = turned.rotations @ poses[k][:3, :3]
    away = np.array(
        [min(rotation_angle(a.T @ p[0, :3, :3]) for a in own) >= ANOTHER for p in places]
    )
    return bool(
        max([float(height[0]), *heights[~away, 0]]) - max([*heights[away, 0], 0.0]) >= o.growth.sure
    )


def model_at(views, poses: np.ndarray, o: Search, seed: int) -> CoarseBody:
    cameras = views_from(directions_around(o.growth.viewpoints, seed), eyes_at(poses))
    return body_of(views, poses, cameras, DETAILED, o.growth, steps=o.growth.steps, seed=seed)


def by_silhouettes(
    asked: Asked, body: CoarseBody, poses: np.ndarray, turn: AlikeTurn
) -> np.ndarray | None:
    """Poses (N, 4, 4) after the turns that silhouettes ask for; None where they ask for none. body:
    a model of all, `poses` those in it."""
    moved = False
    for trial in range(ROUNDS):
        poses = poses if asked.exact else asked.settled(body, poses)
        placed, point = placed_axis(asked, body, poses, turn)
        motions = motions_about(placed, point)
        shapes = Silhouettes(asked.views, poses, motions, asked.nodes)
        gap, turns = shapes.most_coherent(asked.seed + trial)
        if trial == 0 and turns.any():
            motions = motions_about(placed, axis_moved(asked.views, poses, placed, point, turns))
            shapes = Silhouettes(asked.views, poses, motions, asked.nodes)
            gap, turns = shapes.most_coherent(asked.seed + trial)
        if not turns.any() or (trial == 0 and gap > shapes.gap(0 * turns) - CLEARLY):
            break
        moved, poses = True, motions[turns] @ poses
        body = asked.model(poses, trial + 1)
        poses = poses if asked.exact else body.poses
    return poses if moved else None


def motions_about(turn: AlikeTurn, point: np.ndarray) -> np.ndarray:
    """(S, 4, 4) the turn about an axis through a point, done none, one, ... times."""
    rotations = [turn.rotation(k) for k in range(turn.order)]
    return np.array([similarity(r, point - r @ point) for r in rotations])


def placed_axis(
    asked: Asked, body: CoarseBody, poses: np.ndarray, turn: AlikeTurn
) -> tuple[AlikeTurn, np.ndarray]:
    """The turn, and a point of its axis, by which the model looks most like itself: all instances
    are registered from where it puts them."""
    there = asked.settled(
        body, np.array([similarity(turn.rotation(), np.zeros(3)) @ p for p in poses])
    )
    each = there @ np.linalg.inv(poses)
    near = np.array([rotation_angle(turn.rotation().T @ m[:3, :3]) < NEAR for m in each])
    if near.any():
        turn = replace(
            turn, axis=as_turn(nearest_rotation(each[near, :3, :3].sum(0)), turn.likeness).axis
        )
    moves = np.median(each[near] if near.any() else each, axis=0)[:3, 3]
    return turn, np.linalg.pinv(np.eye(3) - turn.rotation()) @ moves


def axis_moved(
    views, poses: np.ndarray, turn: AlikeTurn, point: np.ndarray, turns: np.ndarray
) -> np.ndarray:
    """A point of the axis, moved across itself, for which the turns that the silhouettes ask for
    leave the smallest gap."""
    across = tangents(turn.axis[None])[0]

    def gap(by: np.ndarray) -> float:
        there = motions_about(turn, point + across @ by)[turns] @ poses
        return Silhouettes(views, there, np.eye(4)[None]).gap(0 * turns)

    simplex = np.concatenate([np.zeros((1, 2)), MOVED * np.eye(2)])
    found = minimize(
        gap,
        np.zeros(2),
        method="Nelder-Mead",
        options={"maxfev": TRIES, "initial_simplex": simplex},
    )
    return point + across @ found.x


def score_settled_poses(asked: Asked, poses: np.ndarray) -> Turned:
    """What a model of all says of poses, after they have settled on models of all unless they are
    exact."""
    for trial in range(0 if asked.exact else SETTLED):
        body = asked.model(poses, trial)
        poses = asked.settled(body, body.poses)
    render, own = model_of_all(asked.views, poses, asked.options, seed=asked.seed)
    overlap = np.mean(
        [overlaps(render, v, p[None])[0] for v, p in zip(asked.views, poses, strict=True)]
    )
    gap = Silhouettes(asked.views, poses, np.eye(4)[None], asked.nodes).gap(
        np.zeros(len(poses), int)
    )
    return Turned(poses, own, float(own.mean() + overlap - gap))


def one_at_a_time(asked: Asked, poses: np.ndarray, turn: AlikeTurn) -> Turned:
    """The best of those that differ in the turn of a single instance, again and again."""
    count = len(poses)
    best, none = score_settled_poses(asked, poses), np.zeros(count, int)
    for _ in range(SWEEPS):
        before = best
        motions = motions_about(*placed_axis(asked, asked.model(best.poses), best.poses, turn))
        shapes = Silhouettes(asked.views, best.poses, motions, asked.nodes)
        ways = [(k, s) for k in range(count) for s in range(1, len(motions))]
        ways.sort(key=lambda way: shapes.gap(np.where(np.arange(count) == way[0], way[1], none)))
        for k, s in ways[:ASKED]:
            if asked.options.effort.over:
                return best
            other = best.poses.copy()
            other[k] = motions[s] @ other[k]
            tried = score_settled_poses(asked, other)
            if tried.value > best.value + NO_GAIN:
                best = tried
        if best is before:
            break
    return best

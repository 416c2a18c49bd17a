"""Turns by which a model nearly looks like itself: half a turn of a teapot with the same flowers on
either side, a quarter of a stool.

Poses that matching or growth have found may be off by just these. Renderings of the model from all
around are compared with each other: a turn A is one of them where the rendering from each side v
looks like that from A v, turned in the picture as A has it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from relit.fit.registration.register import TURNS, Gallery, all_scores, directions_around
from relit.geometry.se3 import exp_so3, log_so3, nearest_rotation, rotation_angle

AXES = 300  # that are tried, 12 degrees apart
ORDERS = (2, 3, 4, 5, 6)  # turns of a circle's half, third, ...
NEXT = 3  # renderings next to A v, of which the best counts
SETTLED = 10  # turns that are made exact
ANOTHER = 20.0  # degrees between two of these
STEP, FARTHEST = 0.08, 0.3  # radians by which they move first, and at most
TRIES = 60  # how often they are looked at


@dataclass(frozen=True)
class AlikeTurn:
    """axis: (3,) unit. order: the turn is a circle's order-th part. likeness: mean correlation of
    what the model shows with and without."""

    axis: np.ndarray
    order: int
    likeness: float

    def rotation(self, times: int = 1) -> np.ndarray:
        return exp_so3(2 * np.pi * times / self.order * self.axis)


def alike_turns(gallery: Gallery, count: int) -> list[AlikeTurn]:
    """The turns (at most `count`, the likest first) by which the model of a gallery looks most like
    itself."""
    likeness = likeness_in(gallery)
    tried = []
    for axis in directions_around(AXES):
        if axis[1] >= 0:  # the others' turns are these turns' inverses
            tried += [
                (likeness(rotation), rotation)
                for rotation in (exp_so3(2 * np.pi / order * axis) for order in ORDERS)
            ]
    settled: list[tuple[float, np.ndarray]] = []
    for _, start in distinct_rotations(tried, SETTLED):
        simplex = np.concatenate([np.zeros((1, 3)), STEP * np.eye(3)])
        found = minimize(
            lambda w, start=start: (
                -likeness(exp_so3(w) @ start) if np.linalg.norm(w) < FARTHEST else 1.0
            ),
            np.zeros(3),
            method="Nelder-Mead",
            options={"maxfev": TRIES, "initial_simplex": simplex},
        )
        settled.append((-found.fun, exp_so3(found.x) @ start))
    return [as_turn(rotation, value) for value, rotation in distinct_rotations(settled, count)]


def distinct_rotations(
    found: list[tuple[float, np.ndarray]], count: int
) -> list[tuple[float, np.ndarray]]:
    """The best `count` of (value, rotation) that are turned against each other, and against each
    other's inverses, by ANOTHER or more."""
    kept: list[tuple[float, np.ndarray]] = []
    for value, rotation in sorted(found, key=lambda one: -one[0]):
        if len(kept) < count and all(
            min(rotation_angle(rotation.T @ r), rotation_angle(rotation @ r)) >= ANOTHER
            for _, r in kept
        ):
            kept.append((value, rotation))
    return kept


def as_turn(rotation: np.ndarray, likeness: float) -> AlikeTurn:
    """The part of a circle that is nearest to a rotation (3, 3) about its axis."""
    w = log_so3(nearest_rotation(rotation))
    angle = float(np.linalg.norm(w))
    return AlikeTurn(
        w / angle, int(np.clip(round(2 * np.pi / angle), min(ORDERS), max(ORDERS))), likeness
    )


def likeness_in(gallery: Gallery):
    """What tells, of a rotation (3, 3), how much the model of a gallery looks like itself when it
    is turned so: the mean over the renderings of their correlation (-1 to 1) with that from where
    the rotation puts the camera."""
    scores = all_scores(gallery.rings, gallery.rings)
    frames = np.array([c.world_from_camera[:3, :3] for c in gallery.cameras])
    sides = np.array([c.centre / np.linalg.norm(c.centre) for c in gallery.cameras])
    own, tree = np.arange(len(sides)), cKDTree(sides)

    def likeness(rotation: np.ndarray) -> float:
        there, turned = tree.query(sides @ rotation.T, NEXT)[1], rotation @ frames
        best = np.full(len(sides), -1.0)
        for j in there.T:
            relative = np.einsum("vij,vik->vjk", frames[j], turned)
            roll = np.arctan2(
                relative[:, 1, 0] - relative[:, 0, 1], relative[:, 0, 0] + relative[:, 1, 1]
            )
            best = np.maximum(
                best, scores[own, j, np.round(-roll * TURNS / (2 * np.pi)).astype(int) % TURNS]
            )
        return float(best.mean())

    return likeness

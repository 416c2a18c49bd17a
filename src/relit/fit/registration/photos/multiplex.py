"""SAMURAI's camera multiplex as a soft assignment: several poses of each photo take part in the
fit, each by its share.

S_j = softmax(-λ_s L_j) over the hypotheses of a photo, L = 1 - score of the registration, λ_s from
1 to 10 over the rounds (Boss et al. 2022, Sec. 3.1), in units of SCALE. A memory follows S with
momentum; from round to round a hypothesis keeps its memory where the search finds it again (within
SAME degrees). In the fit a hypothesis is looked at in proportion to its memory.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from relit.fit.registration.register import Crop, Hypotheses
from relit.geometry.se3 import rotation_angle

MOMENTUM, RATE = 0.75, 0.3  # of the memory
SHARPNESS = (1.0, 10.0)  # λ_s in the first and in the last round
# of scores: registration scores of right and wrong poses differ by so much where the paper's losses
# differ by 1
SCALE = 0.05
SAME = 25.0  # degrees
HEARD = 0.15  # share from which on a hypothesis takes part
MOST = 2  # hypotheses of a photo that take part in a fit: each costs as much as a photo


@dataclass(frozen=True)
class Multiplex:
    """poses: (P, K, 4, 4). memory: (P, K), sums to 1 for each photo. velocity: (P, K) of the
    memory."""

    poses: np.ndarray
    memory: np.ndarray
    velocity: np.ndarray

    @property
    def best(self) -> np.ndarray:
        """(P, 4, 4): of each photo the hypothesis with the largest share."""
        return self.poses[np.arange(len(self.poses)), self.memory.argmax(1)]


def shares_of(scores: np.ndarray, sharpness: float) -> np.ndarray:
    """S (P, K) of scores (P, K); hypotheses of score -1 are none."""
    power = sharpness * (scores - scores.max(1, keepdims=True)) / SCALE
    s = np.where(scores > -1, np.exp(power), 0)
    return s / np.maximum(s.sum(1, keepdims=True), 1e-12)


def updated(
    before: Multiplex | None, found: Hypotheses, progress: float, sharpness=SHARPNESS
) -> Multiplex:
    """The multiplex after a search. progress: 0 in the first round, 1 in the last."""
    first, last = sharpness
    shares = shares_of(found.scores, first + (last - first) * progress)
    if before is None:
        return Multiplex(found.poses, shares, np.zeros_like(shares))
    memory, velocity = np.empty_like(shares), np.zeros_like(shares)
    for i, poses in enumerate(found.poses):
        for j, pose in enumerate(poses):
            angles = [rotation_angle(pose[:3, :3].T @ q[:3, :3]) for q in before.poses[i]]
            k = int(np.argmin(angles))
            known = angles[k] < SAME
            memory[i, j] = before.memory[i, k] if known else shares[i, j]
            velocity[i, j] = before.velocity[i, k] if known else 0.0
    velocity = MOMENTUM * velocity + RATE * (shares - memory)
    memory = np.maximum(memory + velocity, 0) * (found.scores > -1)
    empty = memory.sum(1, keepdims=True) <= 1e-9
    memory = np.where(empty, shares, memory / np.maximum(memory.sum(1, keepdims=True), 1e-9))
    return Multiplex(found.poses, memory, velocity)


def with_refined(multiplex: Multiplex, poses: np.ndarray) -> Multiplex:
    """The multiplex, the hypothesis next to each refined pose (P, 4, 4) replaced by it."""
    out = multiplex.poses.copy()
    for i, pose in enumerate(poses):
        angles = [rotation_angle(pose[:3, :3].T @ q[:3, :3]) for q in out[i]]
        out[i, int(np.argmin(angles))] = pose
    return Multiplex(out, multiplex.memory, multiplex.velocity)


def expanded(crops: list[Crop], multiplex: Multiplex) -> tuple[list[Crop], np.ndarray, np.ndarray]:
    """(crops, poses (N, 4, 4), shares (N,)) for a fit: of each photo its MOST likeliest hypotheses,
    the best one always."""
    taken = []
    for i, memory in enumerate(multiplex.memory):
        order = np.argsort(-memory)[:MOST]
        taken += [(i, int(j)) for n, j in enumerate(order) if n == 0 or memory[j] > HEARD]
    poses = np.array([multiplex.poses[i, j] for i, j in taken])
    return [crops[i] for i, _ in taken], poses, np.array([multiplex.memory[i, j] for i, j in taken])

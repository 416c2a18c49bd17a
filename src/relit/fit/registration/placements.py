"""What a search for poses has found of each view."""

from __future__ import annotations

import enum
from dataclasses import dataclass

import numpy as np


class Status(enum.IntEnum):
    """PLACED: the pose is the search's answer. CONTESTED: the model of the other views puts it
    elsewhere than that of all; its pose is deferred until the final model. AXIS_ONLY: the pose is
    right up to a turn about the object's y axis."""

    PLACED = 0
    CONTESTED = 1
    AXIS_ONLY = 2


@dataclass(frozen=True)
class Placements:
    """poses: (N, 4, 4) object_from_camera. scores: (N,) of the registration, 1 is perfect. status:
    (N,) int8, values of `Status`. sure: nearly all views were sure of their places and agree about
    as well as the others, or another search would find the same."""

    poses: np.ndarray
    scores: np.ndarray
    status: np.ndarray
    sure: bool

    def having(self, status: Status) -> np.ndarray:
        """(N,) bool: views of this status."""
        return self.status == status


def all_placed(poses: np.ndarray, scores: np.ndarray, sure: bool = False) -> Placements:
    """Placements of which none is in doubt."""
    return Placements(poses, scores, np.full(len(poses), Status.PLACED, np.int8), sure)

"""Two objects on a ground, lit from one side."""

from __future__ import annotations

import numpy as np

from relit.conventions import similarity
from relit.scene import Ground
from relit.synthesize.procedural import pawn


def two_pawns():
    """(mesh, material, poses of both, ground, environment)."""
    mesh, material = pawn(rows=24, columns=24, texture=32)
    poses = [similarity(np.eye(3), [x, 0, 0]) for x in (-1.0, 1.0)]
    ground = Ground(np.zeros(3), np.array([0.0, 1.0, 0.0]), 12.0, np.array([0.4, 0.4, 0.4]))
    environment = np.full((8, 16, 3), 0.3, np.float32)
    environment[1:3, 2:5] = 6.0
    return mesh, material, poses, ground, environment

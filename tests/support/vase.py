"""A body of revolution about the y axis."""

import numpy as np

from relit.geometry.revolution_axis import Axis
from relit.scene import Mesh
from support.painted_lump import lump

AXIS = Axis(np.zeros(3), np.array([0.0, 1.0, 0.0]))


def vase() -> Mesh:
    """A body of revolution about the y axis."""
    egg = lump()
    v = egg.vertices / np.linalg.norm(egg.vertices, axis=1, keepdims=True)
    radius = 0.4 + 0.08 * np.sin(4 * v[:, 1:2])
    v = v * [1, 1.4, 1] * radius
    across = egg.vertices / np.linalg.norm(egg.vertices, axis=1, keepdims=True)
    return Mesh(v.astype(np.float32), egg.faces, across.astype(np.float32))

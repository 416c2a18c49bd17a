"""Bodies of revolution: their shape, once it is known that the object is one.

What a pass builds from poses that are half a degree off is a body that every outline is right for,
and whose bumps make up for what the poses are wrong by; a metal shows them. So it is made round
(`geometry.rounded`).
"""

from __future__ import annotations

import numpy as np

from relit.fit.duplicates.options import DuplicatesOptions
from relit.fit.duplicates.vessels import body_axis
from relit.fit.registration.instances.views import InstanceView
from relit.fit.shape.outlines import outline_misfit
from relit.geometry.rounded import rounded
from relit.scene import Mesh

# pixels that outlines may move away from the labels by as a body is made round: not an oval
OVAL = 0.6


def made_round(
    mesh: Mesh, views: list[InstanceView], poses: np.ndarray, run, options: DuplicatesOptions
) -> Mesh:
    """The mesh, made round if it is a body of revolution; as it is if not, or if outlines say that
    it is oval. poses: (N, 4, 4)."""
    axis = None if "rounding" in options.without else body_axis(mesh)
    if axis is None:
        return mesh
    cameras = [v.camera.with_pose(p) for v, p in zip(views, poses, strict=True)]
    masks, known = [v.mask for v in views], [v.known for v in views]
    even = rounded(mesh, axis, 2 / (options.levels[-1] - 1))
    before, after = (outline_misfit(one, cameras, masks, known) for one in (mesh, even))
    if after > before + OVAL:
        return mesh
    run.say(
        f"a body of revolution: its bumps are smoothed all around (outlines were {before:.2f} pixels off, now {after:.2f})"
    )
    return even

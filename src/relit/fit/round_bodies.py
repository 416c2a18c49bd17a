"""Bodies of revolution: shape and poses, once it is known that the object is one.

What a pass builds from poses that are half a degree off is a body that every outline is right for, and whose bumps make up for what the
poses are wrong by. Made round (`geometry.rounded`), it cannot, and outlines tell the axes and the distances of all instances: bottle,
N = 10, axes from .38 to .07 degree, distances from .3 to .05 per cent (medians). They leave the turns about the axis as textures have them.
"""

from __future__ import annotations

import numpy as np

from relit.fit.duplicates_options import DuplicatesOptions
from relit.fit.instances import View
from relit.fit.outlines import follow_with_poses, outline_misfit
from relit.fit.vessels import body_axis
from relit.geometry.rounded import rounded
from relit.scene import Mesh

OVAL = 0.6  # pixels that outlines may move away from the labels by as a body is made round, its instances where they are: not an oval
LARGE = 40.0  # pixels, root of the area of what views show: outlines of smaller ones tell no axes


def placed_round(mesh: Mesh, views: list[View], poses: np.ndarray, run, options: DuplicatesOptions) -> tuple[Mesh, np.ndarray] | None:
    """(mesh, poses (N, 4, 4)) of a body of revolution, made round, with its instances where outlines have them then; None of others, and of
    one that outlines say is oval. For poses that textures do not tell better: where these lie on one another they do, and mesh and outlines
    agree as they are."""
    large = np.median([np.sqrt(v.mask.sum()) for v in views]) >= LARGE
    axis = body_axis(mesh) if large and "rounding" not in options.without else None
    if axis is None:
        return None
    cameras = [v.camera.with_pose(p) for v, p in zip(views, poses, strict=True)]
    masks, known = [v.mask for v in views], [v.known for v in views]
    even = rounded(mesh, axis, 2 / (options.levels[-1] - 1))
    before, after = (outline_misfit(one, cameras, masks, known) for one in (mesh, even))
    if after > before + OVAL:
        return None
    placed = follow_with_poses(even, cameras, masks, known, options.outlines, still=True, held=axis.direction)[1]
    there = outline_misfit(even, [c.with_pose(p) for c, p in zip(cameras, placed, strict=True)], masks, known)
    run.say(f"a body of revolution: its bumps are smoothed all around (outlines {before:.2f}, {after:.2f}, then {there:.2f} pixels off)")
    return even, placed

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


def made_round(mesh: Mesh, views: list[View], poses: np.ndarray, run, options: DuplicatesOptions) -> Mesh | None:
    """A body of revolution, made round; None of others, and of one that outlines say is oval. poses: (N, 4, 4)."""
    axis = None if "rounding" in options.without else body_axis(mesh)
    if axis is None:
        return None
    cameras, masks, known = seen_by(views, poses)
    even = rounded(mesh, axis, 2 / (options.levels[-1] - 1))
    before, after = (outline_misfit(one, cameras, masks, known) for one in (mesh, even))
    if after > before + OVAL:
        return None
    run.say(f"a body of revolution: its bumps are smoothed all around (outlines were {before:.2f} pixels off, now {after:.2f})")
    return even


def placed_round(mesh: Mesh, views: list[View], poses: np.ndarray, run, options: DuplicatesOptions) -> tuple[Mesh, np.ndarray] | None:
    """(mesh, poses (N, 4, 4)) of `made_round`, its instances where outlines have them then; None as there. For poses that textures do not
    tell better: where these lie on one another they do, as the profile has errors of its own."""
    even = made_round(mesh, views, poses, run, options)
    if even is None:
        return None
    return even, follow_with_poses(even, *seen_by(views, poses), options.outlines, still=True, held=body_axis(mesh).direction)[1]


def seen_by(views: list[View], poses: np.ndarray):
    """Cameras at the poses, masks and what is known of them, for `fit.outlines`."""
    cameras = [v.camera.with_pose(p) for v, p in zip(views, poses, strict=True)]
    return cameras, [v.mask for v in views], [v.known for v in views]

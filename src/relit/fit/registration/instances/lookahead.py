"""Who joins, and where, when no instance is sure of its place: what becomes of the others tells.

Two instances that share next to no side can be laid together in many ways, and the score of one of
them against a model of the other says little. But a right way makes the model better for all the
rest, and a wrong one worse. So ways are tried: a quick model of the members with the one that
joins, and the rest registered against it (a search one step ahead).
"""

from __future__ import annotations

import numpy as np

from relit.fit.registration.instances.bodies import body_of
from relit.fit.registration.instances.mirror_plane import Flipped, Plane
from relit.fit.registration.instances.options import Growth
from relit.fit.registration.instances.views import InstanceView, eyes_at
from relit.fit.registration.register import (
    Crop,
    Rings,
    chosen_rings,
    directions_around,
    refine,
    search,
    views_from,
)
from relit.geometry.hull import NoShape

Branch = tuple[list[int], np.ndarray]  # members, and poses (N, 4, 4) of which theirs count


def branch_values(
    views: list[InstanceView],
    crops: list[Crop],
    rings: Rings,
    parts,
    branches: list[Branch],
    o: Growth,
    seed: int,
    flipped: Flipped | None = None,
    plane: Plane | None = None,
) -> np.ndarray:
    """(B,) by how much better those who are no members are registered against a model of each
    branch than on the mean of the branches that leave them out, their mean; -inf where the
    silhouettes of the members have nothing in common, 0 where nobody is left.

    plane: in which the object is its own mirror image; where none is known each branch seeks one,
    if all views are there flipped.
    """
    table = np.full((len(branches), len(views)), np.nan)
    fits = np.ones(len(branches), bool)
    for b, (members, poses) in enumerate(branches):
        rest = [k for k in range(len(views)) if k not in members]
        try:
            table[b, rest] = (
                heights_of(
                    views, crops, rings, parts, members, poses, rest, o, seed, flipped, plane
                )
                if rest
                else np.nan
            )
        except NoShape:
            fits[b] = False
    gain = table - mean_of_known(table, 0)
    return np.where(fits, np.nan_to_num(mean_of_known(gain, 1)), -np.inf)


def mean_of_known(a: np.ndarray, axis: int) -> np.ndarray:
    """Mean along an axis of what is not NaN; NaN where nothing is known."""
    known = ~np.isnan(a)
    count = known.sum(axis)
    return np.where(count > 0, np.where(known, a, 0).sum(axis) / np.maximum(count, 1), np.nan)


def heights_of(
    views,
    crops,
    rings: Rings,
    parts,
    members: list[int],
    poses: np.ndarray,
    rest: list[int],
    o: Growth,
    seed: int,
    flipped=None,
    plane=None,
) -> np.ndarray:
    """(R,) scores of the best places of `rest` against a quick model of the members. flipped,
    plane: as `branch_values`."""
    some, theirs, others = (
        [views[k] for k in members],
        chosen_rings(rings, rest),
        [crops[k] for k in rest],
    )
    cameras = views_from(directions_around(o.ahead_views, seed), eyes_at(poses[members]))
    pictures = flipped.of(members) if flipped is not None and plane is None else None
    body = body_of(
        some,
        poses[members],
        cameras,
        parts,
        o,
        steps=o.ahead_steps,
        seed=seed,
        pictures=pictures,
        plane=plane,
    )
    found = search(others, body.gallery, keep=1, rings=theirs)
    return refine(
        others, found.poses[:, 0], body.render, rings=theirs, steps=(0, 4.0, 2.0), parts=parts
    )[1]

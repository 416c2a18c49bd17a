"""Who joins, and where, when no instance is sure of its place: what becomes of the others tells.

Two instances that share next to no side can be laid together in many ways, and the score of one of them against a model of the other says
little. But a right way makes the model better for all the rest, and a wrong one worse. So ways are tried: a quick model of the members
with the one that joins, and the rest registered against it (a search one step ahead).
"""

from __future__ import annotations

import numpy as np

from relit.fit.instance_options import Growth
from relit.fit.instances import View, albedo_render, carved, fit_model
from relit.fit.register import Crop, Gallery, Rings, chosen_rings, directions_around, refine, rings_of, search, views_from
from relit.geometry.hull import NoShape

Branch = tuple[list[int], np.ndarray]  # members, and poses (N, 4, 4) of which theirs count


def branch_values(views: list[View], crops: list[Crop], rings: Rings, parts, branches: list[Branch], o: Growth, seed: int) -> np.ndarray:
    """(B,) by how much better those who are no members are registered against a model of each branch than on the mean of the branches that
    leave them out, their mean; -inf where the silhouettes of the members have nothing in common, 0 where nobody is left."""
    table = np.full((len(branches), len(views)), np.nan)
    fits = np.ones(len(branches), bool)
    for b, (members, poses) in enumerate(branches):
        rest = [k for k in range(len(views)) if k not in members]
        try:
            table[b, rest] = heights_of(views, crops, rings, parts, members, poses, rest, o, seed) if rest else np.nan
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
    views, crops, rings: Rings, parts, members: list[int], poses: np.ndarray, rest: list[int], o: Growth, seed: int
) -> np.ndarray:
    """(R,) scores of the best places of `rest` against a quick model of the members."""
    some = [views[k] for k in members]
    values = carved(some, poses[members], o.nodes, o.tolerance, o.depth, crossed=len(members) > 3)
    model, _ = fit_model(some, poses[members], values, o.ahead_steps, refine_cameras=o.rate, rays=o.rays, seed=seed)
    render = albedo_render(model)
    far = float(np.median(np.linalg.norm(poses[members][:, :3, 3], axis=1)))
    cameras = views_from(directions_around(o.ahead_views, seed), far)
    theirs, others = chosen_rings(rings, rest), [crops[k] for k in rest]
    found = search(others, Gallery(cameras, rings_of(*render(cameras), parts=parts)), keep=1, rings=theirs)
    return refine(others, found.poses[:, 0], render, rings=theirs, steps=(0, 4.0, 2.0), parts=parts)[1]

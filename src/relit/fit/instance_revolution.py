"""The search for poses of identical objects that are bodies of revolution: bottles, cans, vases.

Their silhouettes tell where the axis of each points (fit/revolution.py), their decoration the turn about it (fit/unrolled.py). Of several
answers a model of all says which holds. Where most are sure of their turns, the others are asked as growth asks them
(`instance_regrowth.confirmed`); where they are not, the axes are still right, and with them the shape.
"""

from __future__ import annotations

import numpy as np

from relit.fit.instance_options import DETAILED, Search
from relit.fit.instance_regrowth import Placed
from relit.fit.instance_rounds import model_of_all
from relit.fit.instances import View, albedo_render, carved, fit_model
from relit.fit.register import Crop, crop_rings, refine
from relit.fit.revolution import fit_revolution, seats_of
from relit.fit.unrolled import turned_by_decoration
from relit.geometry.hull import NoShape

FEWEST = 4  # objects: of fewer, silhouettes that something else has can be those of a body of revolution
LIKELY = 0.96  # score of the best silhouette, revolved, against all others, below which nothing is fitted
NEARLY, EXACT = 0.004, 0.001  # misfit (`revolution.misfit`) of a first fit, and of a body of revolution
OPEN = 5  # seats of the median object, from which on the silhouettes do not tell the axis: those of a ball
DECORATION = (0.0, 2.0, 0.0, 1.0)  # weights of fit.register's descriptor: silhouettes agree in every turn
CLEAR = 0.3  # `unrolled.Told.leads` of an object that is sure of its turn


def place_revolved(views: list[View], crops: list[Crop], o: Search, *, seed: int = 0, say=lambda text: None) -> Placed | None:
    """Where bodies of revolution stand, and which are not sure of their turn about the axis; None where the objects are none, or their
    silhouettes do not tell the axis."""
    if len(views) < FEWEST:
        return None
    body = fit_revolution(views, crops, LIKELY, NEARLY)
    if body is None or body.misfit > EXACT:
        return None
    seats = seats_of(crops, body)
    if np.median([len(some) for some in seats]) >= OPEN:
        return None
    say(f"bodies of revolution: one profile fits the outlines (misfit {body.misfit:.5f} of a silhouette's area)")
    best, height, told = None, -np.inf, ""
    for channel, answer in turned_by_decoration(views, body.profile, seats).items():
        level = decoration_agreement(views, crops, answer.poses, o, seed)
        if level > height:
            best, height, told = answer, level, channel
    if best is None:
        return None
    unsure = np.flatnonzero(best.leads < CLEAR).tolist()
    say(f"turned about their axes by {told}: {len(views) - len(unsure)} of {len(views)} are sure")
    own = model_of_all(views, best.poses, o, seed=seed)[1]
    sure = tuple(k for k in range(len(views)) if k not in unsure)
    return Placed(best.poses, own, sure, tuple(unsure), DETAILED)


def decoration_agreement(views, crops, poses: np.ndarray, o: Search, seed: int) -> float:
    """Median score of all against a model of all, without silhouettes; -inf where these have nothing in common."""
    try:
        values = carved(views, poses, o.nodes + 8, 0.15, o.depth, crossed=True)
    except NoShape:
        return -np.inf
    model, poses = fit_model(views, poses, values, 2 * o.steps, refine_cameras=o.rate, hold=o.steps // 2, seed=seed)
    scores = refine(crops, poses, albedo_render(model), rings=crop_rings(crops, DECORATION), steps=(0, 2.0), parts=DECORATION)[1]
    return float(np.median(scores))

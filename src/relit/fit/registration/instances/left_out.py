"""Leave-one-out evidence for the pose of each instance.

An instance at a wrong pose bends the model that is fitted to it, and then agrees with that model.
So each instance is registered against a model that was fitted without it. The difference between
the score of its own pose there and that of the best other pose is the evidence for its pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from relit.fit.registration.instances.growth import ANOTHER
from relit.fit.registration.instances.lookup import look_for
from relit.fit.registration.instances.options import DETAILED, Search
from relit.fit.registration.instances.rounds import model_of_all
from relit.fit.registration.instances.views import (
    InstanceView,
    albedo_render,
    eyes_at,
    fit_model,
    instance_crops,
    taut_body,
)
from relit.fit.registration.register import (
    chosen_rings,
    crop_rings,
    directions_around,
    make_gallery,
    refine,
    views_from,
)
from relit.geometry.hull import NoShape
from relit.geometry.se3 import rotation_angle

FOLDS = 10  # groups that are left out one after the other, at most
TRIES = 3  # other poses of each that are refined
WRONG = 15.0  # degrees from which on a pose counts as wrong
# logistic regression of wrong poses on (1, lead), on rendered piles of eight objects with none, some
# and all poses wrong (docs/research/instances.md); leads count up to MOST
LOGIT = (-0.34, -12.75)
MOST = 0.3
# mean loss of score and mean lead beyond which poses are contradicted: of those piles, all with right
# poses lost less (.08 to .21), those with all poses wrong lost .15 to .33
LOSS, BEHIND = 0.24, -0.04


@dataclass(frozen=True)
class LeftOut:
    """within: (N,) score of each instance against a model of all. own: (N,) near its pose, against a
    model of the others. other: (N,) of its best pose ANOTHER degrees and more away, there. away: (N,)
    degrees by which that one is turned. The scores are -1 where the others have no shape."""

    within: np.ndarray
    own: np.ndarray
    other: np.ndarray
    away: np.ndarray

    @property
    def lead(self) -> np.ndarray:
        """(N,) by how much the own pose scores better than the best other one."""
        return self.own - np.maximum(self.other, 0)

    @property
    def chance_wrong(self) -> np.ndarray:
        """(N,) of a pose being wrong by more than WRONG degrees, by its lead."""
        always, slope = LOGIT
        return 1 / (1 + np.exp(-(always + slope * np.clip(self.lead, -MOST, MOST))))

    @property
    def contradicted(self) -> bool:
        """Whether the photo contradicts the poses as a whole: left out, instances agree much less
        than with a model that was fitted to them, and better at other poses. The lead alone does not
        decide: of a plain body of revolution the model of the others lacks just the side that an
        instance shows."""
        loss = float(np.mean(self.within - self.own))
        lead = np.clip(self.lead, -MOST, MOST).mean()
        return loss > LOSS and lead < BEHIND


def leave_out(views: list[InstanceView], poses: np.ndarray, o: Search, seed: int = 0) -> LeftOut:
    """Register each instance against a model of the others. poses: (N, 4, 4) object_from_camera,
    N >= 3. Raises NoShape where the silhouettes have nothing in common."""
    count = len(views)
    own, other, away = np.full(count, -1.0), np.full(count, -1.0), np.zeros(count)
    crops = instance_crops(views)
    rings = crop_rings(crops, DETAILED)
    within = model_of_all(views, poses, o, seed=seed)[1]
    groups = min(FOLDS, count)
    order = np.random.default_rng(seed).permutation(count)
    for fold in range(groups):
        left = order[fold::groups].tolist()
        rest = [k for k in range(count) if k not in left]
        some = [views[k] for k in rest]
        try:
            values = taut_body(some, poses[rest], o.nodes, 0.15, o.depth, crossed=len(rest) > 3)
        except NoShape:
            continue
        o.effort.spend(2 * o.steps)
        model, _ = fit_model(some, poses[rest], values, 2 * o.steps, seed=seed)
        render = albedo_render(model)
        cameras = views_from(directions_around(o.viewpoints, seed), eyes_at(poses[rest]))
        gallery = make_gallery(render, cameras, DETAILED)
        theirs, mine = [crops[k] for k in left], chosen_rings(rings, left)
        refined = {"rings": mine, "parts": DETAILED}
        near, own[left] = refine(theirs, poses[left], render, steps=(0, 4.0, 2.0), **refined)
        found = look_for([views[k] for k in left], theirs, gallery, mine, DETAILED, keep=TRIES + 1)
        for n in range(found.poses.shape[1]):
            there, score = refine(theirs, found.poses[:, n], render, steps=(0, 4.0, 2.0), **refined)
            for i, k in enumerate(left):
                turned = rotation_angle(there[i, :3, :3].T @ near[i, :3, :3])
                if turned < ANOTHER:
                    own[k] = max(own[k], score[i])
                elif score[i] > other[k]:
                    other[k], away[k] = score[i], turned
    return LeftOut(within, own, other, away)

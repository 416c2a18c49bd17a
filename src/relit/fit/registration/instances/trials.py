"""The search of few identical objects, repeated from the start.

Of six objects two in wrong places can bear each other out: the model of all takes them up, and no
score within one search tells. A search in which nearly all were sure of their places is believed.
Otherwise another seed begins from other viewpoints and ends elsewhere, unless
the poses are right: searches that come to the same poses are believed, and where no two do, the one
whose objects agree best, each with a model of the others.
"""

from __future__ import annotations

import numpy as np

from relit.fit.registration.instances.left_out import leave_out
from relit.fit.registration.instances.options import Search
from relit.fit.registration.instances.search import place
from relit.fit.registration.instances.views import InstanceView
from relit.fit.registration.placements import Placements
from relit.geometry.hull import NoShape
from relit.geometry.se3 import turns_apart

FEW = 8  # objects up to which one search is not enough
SAME = 15.0  # degrees within which two searches have put all objects alike


def place_few(
    views: list[InstanceView], o: Search, *, seed: int = 0, links=(), say=lambda text: None
) -> Placements:
    """`place`, for few objects up to `o.searches` times. Raises NoShape where every search does."""
    if not 2 < len(views) <= FEW or not o.descents or o.searches < 2:
        return place(views, o, seed=seed, links=links, say=say)
    found: list[tuple[float, Placements]] = []
    for trial in range(o.searches):
        try:
            one = place(views, o, seed=seed + 1000 * trial, links=links, say=say)
        except NoShape:
            if trial == o.searches - 1 and not found:
                raise
            continue
        if one.sure or o.effort.over:
            return one
        agreement = float(leave_out(views, one.poses, o, seed).own.mean())
        like = [other for other in found if turned_apart(one.poses, other[1].poses) < SAME]
        found.append((agreement, one))
        say(
            f"search {trial + 1} of at most {o.searches}: mean agreement of each with a model of the others {agreement:.3f}"
        )
        if like:
            say("two searches have come to the same poses")
            return max([*like, found[-1]], key=lambda one: one[0])[1]
    agreement, best = max(found, key=lambda one: one[0])
    say(
        f"note: no two of {o.searches} searches come to the same poses: the best is taken (agreement {agreement:.3f}); look at the result"
    )
    return best


def turned_apart(a: np.ndarray, b: np.ndarray) -> float:
    """Degrees by which that object is turned which two sets of poses (N, 4, 4) object_from_camera
    put most differently."""
    return float(turns_apart(a, b).max())

"""The search for poses of identical objects: guesses for pairs, growth from the best of them, rounds of fit and search.

pair_guesses   every instance's silhouette is inflated to a crude model, and every other one registered against it (fit/instance_guesses.py)
grow           one instance after another joins those that stand already (fit/instance_growth.py); from several pairs, the best counts
improved       where instances were not sure of their places: taken out and grown again, another way each time (fit/instance_regrowth.py)
settled        rounds of a coarse model of all and a search for all poses by rendering it, descents, doubt (fit/instance_rounds.py)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from relit.fit.instance_growth import grow
from relit.fit.instance_guesses import Guesses, first_pairs, pair_guesses
from relit.fit.instance_lookahead import Branch, branch_values
from relit.fit.instance_options import DETAILED, Search
from relit.fit.instance_regrowth import Placed, believed, confirmed, improved, judged
from relit.fit.instance_rounds import crops_of, settled
from relit.fit.instances import View, first_pose, frame_scale
from relit.fit.register import Rings, crop_rings
from relit.geometry.hull import NoShape


@dataclass(frozen=True)
class Found:
    """What a search has found. poses: (N, 4, 4) object_from_camera, scores: (N,) of all instances. sure: nearly all of them were sure of
    their places, and none agrees much less than the others."""

    poses: np.ndarray
    scores: np.ndarray
    sure: bool


def first_starts(views, crops, rings: Rings, parts, guesses: Guesses, chosen: list[int], links, o: Search, seed: int) -> list[Branch]:
    """Pairs to grow from, as branches, those first after which all others agree best: of the guesses with the largest margins, and of what
    matching says."""
    branches = []
    for s, j in first_pairs(guesses, chosen, o.pairs):
        poses = np.tile(np.eye(4), (len(views), 1, 1))
        pair = [chosen[s], j]
        poses[pair] = guesses.poses[s, pair, 0]
        branches.append((pair, poses))
    value = branch_values(views, crops, rings, parts, branches, o.growth, seed)
    return [branches[b] for b in np.argsort(-value, kind="stable")]


def place(views: list[View], o: Search, *, seed: int = 0, links=(), say=lambda text: None, step=lambda done, total: None) -> Found:
    """Where all views stand, from nothing but the photo and its labels.

    links: ((i, j, rotation of i onto j in the photo), ...) from matching: growth tries them beside its own guesses. Raises NoShape where
    no set of poses agrees with the silhouettes.
    """
    distance = frame_scale(views)
    if len(views) == 1:
        return Found(first_pose(views[0], distance)[None], np.ones(1), True)
    crops = crops_of(views)
    order = sorted(range(len(views)), key=lambda k: -views[k].seen * np.sqrt(views[k].mask.sum()) / views[k].camera.fx)
    chosen = order[: o.models]
    guesses = pair_guesses(views, crops, chosen, o, distance, seed, step)
    rings = {parts: crop_rings(crops, parts) for parts in guesses}
    starts = {parts: first_starts(views, crops, rings[parts], parts, some, chosen, links, o, seed) for parts, some in guesses.items()}
    best: Placed | None = None
    for turn in range(o.starts):
        for parts in starts:
            if turn >= len(starts[parts]) or believed(best, o):
                continue
            pair, poses = starts[parts][turn]
            try:
                grown = grow(views, crops, rings[parts], parts, pair, poses, o.growth, seed=seed, links=links)
            except NoShape:  # the silhouettes have nothing in common
                continue
            placed = judged(views, grown, parts, o, seed)
            if placed is None:
                continue
            placed = confirmed(views, crops, rings[parts], placed, o, seed=seed, links=links)
            say(
                f"grown from {views[pair[0]].label} and {views[pair[1]].label}: {len(views) - len(placed.unsure)} sure of their places, "
                f"agreement of all with a model of all {placed.agreement:.3f}"
            )
            if best is None or believed(placed, o) or placed.agreement > best.agreement:
                best = placed
    if best is None:
        raise NoShape("no set of poses agrees with the silhouettes")
    if not believed(best, o) and len(views) > 3:
        best = improved(views, crops, rings[DETAILED], best, o, seed=seed + 60, links=links, say=say)
    if not believed(best, o):
        doubtful = f"{len(best.unsure)} of {len(views)} were not sure of their places"
        say(f"note: the poses are uncertain: {doubtful}: is the object nearly symmetric?")
    poses, scores = settled(views, crops, rings[best.parts], best.poses, best.own, o, seed=seed, parts=best.parts, say=say)
    return Found(poses, scores, believed(best, o))

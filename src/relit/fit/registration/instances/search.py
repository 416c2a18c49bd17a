"""The search for poses of identical objects: guesses for pairs, growth, rounds of fit and search.

place_revolved  bodies of revolution, by their outlines and decoration: revolution_search.py;
                all other objects go through the following
pair_guesses    the silhouette of each instance is inflated to a crude model, and every other
                instance registered against it: guesses.py
verified_links  what matching has linked, as far as silhouettes and colours agree: links.py
grow_instances  one instance after another joins the registered ones; from several pairs, of
                which the best counts: growth.py
up_to_turns     contested instances are turned where silhouettes call for it, if the object is
                nearly symmetric: near_symmetry_search.py
improved        contested instances are taken out and grown again: regrowth.py
refine_and_verify  rounds of a coarse model of all and a search by rendering it: rounds.py
coherent_turns  as up_to_turns, of the final poses
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from relit.fit.registration.instances.growth import grow_instances
from relit.fit.registration.instances.guesses import Guesses, first_pairs, pair_guesses
from relit.fit.registration.instances.links import linked_sets, verified_links
from relit.fit.registration.instances.lookahead import Branch, branch_values
from relit.fit.registration.instances.mirror_plane import flipped_views
from relit.fit.registration.instances.near_symmetry_search import coherent_turns, stands
from relit.fit.registration.instances.options import DETAILED, Search
from relit.fit.registration.instances.regrowth import (
    NO_GAIN,
    Placed,
    believed,
    confirmed,
    improved,
    mostly_firm,
    score_growth,
)
from relit.fit.registration.instances.revolution_search import mostly_sure, place_revolved
from relit.fit.registration.instances.rounds import refine_and_verify, refine_jointly
from relit.fit.registration.instances.views import (
    InstanceView,
    best_seen,
    first_pose,
    frame_scale,
    instance_crops,
)
from relit.fit.registration.register import Rings, crop_rings
from relit.geometry.hull import NoShape

SPARED, ENOUGH = (
    0.2,
    8,
    # share of the instances that can be left to the end, and those whose model is to say where they
    # stand
)
TORN = -3.0  # score of such an instance
# score of an instance whose turn about a known axis is not told; that of a place that shows nothing
# is -1
LEFT_OUT = -2.0


@dataclass(frozen=True)
class SearchResult:
    """What a search has found. poses: (N, 4, 4) object_from_camera, scores: (N,) of all instances,
    LEFT_OUT where the turn about the axis is not told. sure: nearly all of them were sure of their
    places and agree about as well as the others (`instance_regrowth.believed`), or another search
    would find the same."""

    poses: np.ndarray
    scores: np.ndarray
    sure: bool


def first_starts(
    views,
    crops,
    rings: Rings,
    parts,
    guesses: Guesses,
    chosen: list[int],
    links,
    o: Search,
    seed: int,
) -> list[Branch]:
    """What to grow from: pairs, of the guesses with the largest margins, and what matching has
    linked. Those first after which all others agree best (see `branch_values`), but the best of
    either kind among the first two."""
    distance, guessed = frame_scale(views), []
    for s, j in first_pairs(guesses, chosen, o.pairs):
        poses = np.tile(np.eye(4), (len(views), 1, 1))
        pair = [chosen[s], j]
        poses[pair] = guesses.poses[s, pair, 0]
        guessed.append((pair, poses))
    told = [
        verified_links(views, crops, rings, parts, one, links, o.growth, seed)
        for one in linked_sets(views, links, distance)[: o.pairs]
    ]
    value = branch_values(
        views, crops, rings, parts, [*guessed, *told], o.growth, seed, flipped_views(views, parts)
    )
    order = np.argsort(-value, kind="stable").tolist()
    kinds = [b >= len(guessed) for b in order]
    if len(set(kinds)) == 2:
        other = order[kinds.index(not kinds[0])]
        order = [order[0], other, *(b for b in order[1:] if b != other)]
    return [[*guessed, *told][b] for b in order]


def by_axes(revolved: Placed, say) -> SearchResult:
    """Bodies of revolution as outlines and decoration have them: a search over all poses would lose
    the axes. Where most are sure of their turn the others are left out, to be sought in the
    finished model of these."""
    scores, unsure = revolved.own.copy(), list(revolved.unsure)
    if unsure and mostly_sure(revolved):
        scores[unsure] = LEFT_OUT
        say(
            f"note: {len(unsure)} of {len(scores)} are not sure of their turn about the axis: they are left to the end"
        )
    elif unsure:
        say(
            f"note: {len(unsure)} of {len(scores)} are not sure of their turn about the axis: their decoration may be mixed"
        )
    return SearchResult(revolved.poses, scores, True)


def place(
    views: list[InstanceView],
    o: Search,
    *,
    seed: int = 0,
    links=(),
    say=lambda text: None,
    step=lambda done, total: None,
) -> SearchResult:
    """Where all views stand, from nothing but the photo and its labels.

    links: ((i, j, rotation of i onto j in the photo), ...) from matching: growth tries them beside
    its own guesses. Raises NoShape where no set of poses agrees with the silhouettes.
    """
    if len(views) == 1:
        return SearchResult(first_pose(views[0], frame_scale(views))[None], np.ones(1), True)
    crops = instance_crops(views)
    best: Placed | None = None
    revolved = place_revolved(views, crops, o, seed=seed, say=say)
    if revolved is not None and revolved.certain and mostly_sure(revolved.placed):
        return by_axes(revolved.placed, say)
    if revolved is not None:
        best = confirmed(
            views, crops, crop_rings(crops, DETAILED), revolved.placed, o, seed=seed, links=links
        )
        if revolved.certain and not believed(best, o):
            return by_axes(revolved.placed, say)
    if not believed(best, o):
        best = grown_from_pairs(
            views,
            crops,
            None if revolved and revolved.axes else best,
            o,
            seed=seed,
            links=links,
            say=say,
            step=step,
        )
        if revolved is not None and revolved.axes and not believed(best, o):
            return by_axes(revolved.placed, say)
    if best is None:
        raise NoShape("no set of poses agrees with the silhouettes")
    if not believed(best, o) and len(views) > 3:
        best = up_to_turns(views, crops, best, o, seed=seed + 50, links=links, say=say)
    if not believed(best, o) and len(views) > 3:
        best = improved(
            views, crops, crop_rings(crops, DETAILED), best, o, seed=seed + 60, links=links, say=say
        )
    if not believed(best, o):
        doubtful = f"{len(best.unsure)} of {len(views)} were not sure of their places"
        say(f"note: the poses are uncertain: {doubtful}: is the object nearly symmetric?")
    rings = crop_rings(crops, best.parts)
    poses, scores, torn = refine_and_verify(
        views, crops, rings, best.poses, best.own, o, seed=seed, parts=best.parts, say=say
    )
    turned = (
        coherent_turns(views, crops, crop_rings(crops, DETAILED), poses, o, seed=seed + 70, say=say)
        if len(views) > 3
        else None
    )
    if turned is not None:
        poses, scores = refine_jointly(
            views,
            crops,
            rings,
            turned.poses,
            turned.own,
            o,
            seed=seed + 80,
            parts=best.parts,
            say=say,
        )
    return SearchResult(poses, without_torn(views, scores, torn, say), believed(best, o))


def without_torn(views: list[InstanceView], scores: np.ndarray, torn: set[int], say) -> np.ndarray:
    """The scores (N,), TORN of those who agree better elsewhere with the others while all agree
    less for it (`settled`): one in a wrong place has bent the others towards itself. Where these
    few can be spared, their place is for the finished model of the others to say."""
    if not torn or len(torn) > SPARED * len(views) or len(views) - len(torn) < ENOUGH:
        return scores
    labels = ", ".join(str(views[k].label) for k in sorted(torn))
    say(
        f"note: {labels} may stand wrong, as the model of the others says and that of all denies: left to the end"
    )
    return np.where(np.isin(np.arange(len(views)), list(torn)), TORN, scores)


def up_to_turns(
    views, crops, placed: Placed, o: Search, *, seed: int, links=(), say=lambda text: None
) -> Placed:
    """The set, where the object nearly looks like itself when it is turned with those turned for
    whom silhouettes and paint ask for it. Who was not sure of its place is asked again up to such
    turns."""
    rings = crop_rings(crops, DETAILED)
    turned = coherent_turns(views, crops, rings, placed.poses, o, seed=seed, say=say)
    if turned is None:
        return placed
    unsure = tuple(
        k for k in placed.unsure if not stands(views, crops, rings, turned, k, o, seed, links)
    )
    return Placed(turned.poses, turned.own, (), unsure, placed.parts)


def grown_from_pairs(
    views: list[InstanceView],
    crops,
    best: Placed | None,
    o: Search,
    *,
    seed: int = 0,
    links=(),
    say=lambda text: None,
    step=lambda done, total: None,
) -> Placed | None:
    """What growth makes of pairs, as far as it is better than `best`; None where nothing agrees
    with the silhouettes. Where one is not believed, but most of it stood before the first doubt,
    the others are grown again before another start is made."""
    chosen = best_seen(views)[: o.models]
    guesses = pair_guesses(views, crops, chosen, o, frame_scale(views), seed, step)
    rings = {parts: crop_rings(crops, parts) for parts in {*guesses, DETAILED}}
    starts = {
        parts: first_starts(views, crops, rings[parts], parts, some, chosen, links, o, seed)
        for parts, some in guesses.items()
    }
    for turn in range(o.starts):
        for parts in starts:
            if turn >= len(starts[parts]) or believed(best, o):
                continue
            start, poses = starts[parts][turn]
            try:
                grown = grow_instances(
                    views,
                    crops,
                    rings[parts],
                    parts,
                    start,
                    poses,
                    o.growth,
                    seed=seed,
                    links=links,
                )
            except NoShape:  # the silhouettes have nothing in common
                continue
            placed = score_growth(views, grown, parts, o, seed)
            if placed is None:
                continue
            placed = confirmed(views, crops, rings[parts], placed, o, seed=seed, links=links)
            say(
                f"grown from {' and '.join(str(views[k].label) for k in start)}: {len(views) - len(placed.unsure)} sure of their places, "
                f"agreement of all with a model of all {placed.agreement:.3f}"
            )
            if not believed(placed, o) and mostly_firm(placed):
                placed = improved(
                    views,
                    crops,
                    rings[DETAILED],
                    placed,
                    o,
                    seed=seed + 40 + turn,
                    tries=1,
                    links=links,
                    say=say,
                )
            if best is None or placed.agreement > best.agreement - (
                NO_GAIN if believed(placed, o) else 0
            ):
                best = placed
    return best

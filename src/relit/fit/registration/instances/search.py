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

from dataclasses import replace

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
from relit.fit.registration.instances.revolution_search import (
    LONGER,
    decoration_agreement,
    mostly_sure,
    place_revolved,
)
from relit.fit.registration.instances.rounds import refine_and_verify, refine_jointly
from relit.fit.registration.instances.views import (
    InstanceView,
    best_seen,
    first_pose,
    frame_scale,
    instance_crops,
)
from relit.fit.registration.placements import Placements, Status, all_placed
from relit.fit.registration.register import Rings, crop_rings
from relit.geometry.hull import NoShape

SPARED, ENOUGH = (
    0.2,
    8,
    # share of the instances that can be left to the end, and those whose model is to say where they
    # stand
)


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


def by_axes(revolved: Placed, say) -> Placements:
    """Bodies of revolution as outlines and decoration have them: a search over all poses would lose
    the axes. Where most are sure of their turn the others are deferred to the final model."""
    scores, unsure = revolved.own, list(revolved.unsure)
    found = all_placed(revolved.poses, scores, True)
    if unsure and mostly_sure(revolved):
        found.status[unsure] = Status.AXIS_ONLY
        say(
            f"note: {len(unsure)} of {len(scores)} azimuths about the axis are uncertain: deferred until the final model"
        )
    elif unsure:
        say(
            f"note: {len(unsure)} of {len(scores)} azimuths about the axis are uncertain: their decoration may be mixed"
        )
    return found


def place(
    views: list[InstanceView],
    o: Search,
    *,
    seed: int = 0,
    links=(),
    say=lambda text: None,
    step=lambda done, total: None,
) -> Placements:
    """Where all views stand, from nothing but the photo and its labels.

    links: ((i, j, rotation of i onto j in the photo), ...) from matching: growth tries them beside
    its own guesses. Raises NoShape where no set of poses agrees with the silhouettes.
    """
    if len(views) == 1:
        return all_placed(first_pose(views[0], frame_scale(views))[None], np.ones(1), True)
    crops = instance_crops(views)
    best: Placed | None = None
    revolved = place_revolved(views, crops, o, seed=seed, say=say)
    if revolved is not None and links:
        matched = better_by_matches(
            views, crops, revolved.placed, o, seed=seed, links=links, say=say
        )
        if matched is not None:
            return rounds_verified(views, crops, matched, o, seed=seed, say=say)[0]
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
    found, rings = rounds_verified(views, crops, best, o, seed=seed, say=say)
    if len(views) > 3:
        detailed = crop_rings(crops, DETAILED)
        turned = coherent_turns(views, crops, detailed, found.poses, o, seed=seed + 70, say=say)
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
            return replace(found, poses=poses, scores=scores)
    return found


def rounds_verified(
    views: list[InstanceView],
    crops,
    best: Placed,
    o: Search,
    *,
    seed: int,
    say=lambda text: None,
) -> tuple[Placements, Rings]:
    """The set after rounds of a model of all and a search by rendering it, with contested instances
    deferred where they can be spared; and the descriptors of the crops."""
    sure = believed(best, o)
    if not sure:
        doubtful = f"{len(best.unsure)} of {len(views)} were not sure of their places"
        say(f"note: the poses are uncertain: {doubtful}: is the object nearly symmetric?")
    rings = crop_rings(crops, best.parts)
    poses, scores, contested = refine_and_verify(
        views, crops, rings, best.poses, best.own, o, seed=seed, parts=best.parts, say=say
    )
    found = all_placed(poses, scores, sure)
    found.status[deferred_until_the_end(views, contested, say)] = Status.CONTESTED
    return found, rings


def better_by_matches(
    views: list[InstanceView], crops, revolved: Placed, o: Search, *, seed: int, links, say
) -> Placed | None:
    """What grows from the largest set of instances that matches hold together, where their
    decoration agrees better in it than in `revolved`; None where it does not, or matches hold
    together fewer than half. Outlines agree in every turn about the axis, so that decoration alone
    decides (`decoration_agreement`)."""
    sets = linked_sets(views, links, frame_scale(views))
    if not sets or len(sets[0][0]) < max(3, len(views) / 2):
        return None
    members, poses = sets[0]
    rings = crop_rings(crops, DETAILED)
    try:
        grown = grow_instances(
            views, crops, rings, DETAILED, members, poses, o.growth, seed=seed, links=links
        )
    except NoShape:
        return None
    placed = score_growth(views, grown, DETAILED, o, seed)
    if placed is None:
        return None
    steps = LONGER * 2 * o.steps
    by_matches, by_axes = (
        decoration_agreement(views, crops, one.poses, o, seed, steps) for one in (placed, revolved)
    )
    kept = "matches" if by_matches > by_axes else "axes"
    say(
        f"turns by matches of {len(members)} of {len(views)} and by axes: their decoration agrees by {by_matches:.3f} and {by_axes:.3f}; "
        f"those by {kept} are kept"
    )
    return placed if by_matches > by_axes else None


def deferred_until_the_end(views: list[InstanceView], contested: set[int], say) -> list[int]:
    """Those of the `contested` instances (`settled`) whose pose is deferred until the final model of
    the others: all of them where they can be spared, since one in a wrong place bends the others
    towards itself; else none."""
    count = len(views)
    if not contested or len(contested) > SPARED * count or count - len(contested) < ENOUGH:
        return []
    labels = ", ".join(str(views[k].label) for k in sorted(contested))
    say(f"note: the poses of {labels} are contested: deferred until the final model")
    return sorted(contested)


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
            spent = best is not None and o.effort.over
            if turn >= len(starts[parts]) or believed(best, o) or spent:
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

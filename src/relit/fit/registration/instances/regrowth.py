"""Sets of poses of identical objects that have grown, and what agrees better: instances are taken
out and grown again.

judged       what a model of all says of a set
confirmed    those who were not sure of their places, asked again once all others stand
improved     an iterated local search: others are taken out each time, and another way over the gaps
             is tried
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from relit.fit.registration.instances.growth import Grown, grow_instances, viewing_directions
from relit.fit.registration.instances.options import DETAILED, Search
from relit.fit.registration.instances.rounds import LOW, SLACK, model_of_all
from relit.fit.registration.register import Rings
from relit.geometry.hull import NoShape

KEPT = (
    0.3,
    0.7,
)  # shares of the instances that stay while the others are grown again, see `improved`
WAVER = 0.03  # standard deviation of what is added to the scores that say which
# instances from which on fewer tries are made: they take longer, and growth goes wrong less often
TEN = 10
NO_GAIN = 0.001  # of the mean agreement: too little to go on for


@dataclass(frozen=True)
class Placed:
    """A set of poses. own: (N,) scores against a model of all (`model_of_all`). firm: see `Grown`.
    unsure: instances that were not sure of their places. parts: the descriptor that it grew
    under."""

    poses: np.ndarray
    own: np.ndarray
    firm: tuple[int, ...]
    unsure: tuple[int, ...]
    parts: tuple[float, ...]

    @property
    def agreement(self) -> float:
        return float(self.own.mean())


def score_growth(views, grown: Grown, parts, o: Search, seed: int) -> Placed | None:
    """What a model of all says of what has grown; None where the silhouettes have nothing in
    common."""
    try:
        own = model_of_all(views, grown.poses, o, seed=seed)[1]
    except NoShape:
        return None
    return Placed(grown.poses, own, grown.firm, grown.unsure, parts)


def believed(placed: Placed | None, o: Search) -> bool:
    """Whether at most the share `o.leaps` of the instances were unsure of their places or agree
    much less than the others: of many a few in wrong places spoil no model, and doubt finds them
    (see `instance_rounds.settled`)."""
    if placed is None:
        return False
    low = np.flatnonzero(placed.own < np.median(placed.own) - LOW)
    return len({*placed.unsure, *low.tolist()}) <= o.leaps * len(placed.own)


def grown_again(
    views,
    crops,
    rings: Rings,
    placed: Placed,
    stay: list[int],
    parts,
    o: Search,
    *,
    seed: int,
    links=(),
    rng=None,
) -> Placed | None:
    """The set with all but those who stay taken out and grown again; None where the silhouettes
    have nothing in common."""
    try:
        grown = grow_instances(
            views,
            crops,
            rings,
            parts,
            stay,
            placed.poses.copy(),
            o.growth,
            seed=seed,
            links=links,
            rng=rng,
        )
    except NoShape:
        return None
    again = score_growth(views, grown, parts, o, seed)
    if again is None:
        return None
    doubtful = set(stay) & set(placed.unsure)
    return replace(
        again,
        unsure=(*again.unsure, *sorted(doubtful)),
        firm=tuple(k for k in grown.firm if k not in doubtful),
    )


def confirmed(
    views, crops, rings: Rings, placed: Placed, o: Search, *, seed: int, links=()
) -> Placed:
    """The set with those who were unsure taken out and asked again once all others stand, as long
    as fewer are unsure each time."""
    while not believed(placed, o) and not o.effort.over:
        stay = [k for k in range(len(views)) if k not in placed.unsure]
        if len(stay) < max(2, len(views) / 2) or not placed.unsure:
            break
        again = grown_again(
            views, crops, rings, placed, stay, placed.parts, o, seed=seed, links=links
        )
        if again is None or again.agreement < placed.agreement - SLACK:
            break
        fewer = len(again.unsure) < len(placed.unsure)
        placed = again
        if not fewer:
            break
    return placed


def mostly_firm(placed: Placed) -> bool:
    """Whether most stood before the first that was not sure of its place: what came after is grown
    again in less time than all."""
    return len(placed.own) / 2 <= len(placed.firm) < len(placed.own)


def improved(
    views,
    crops,
    rings: Rings,
    best: Placed,
    o: Search,
    *,
    seed: int,
    tries: int | None = None,
    links=(),
    say=lambda text: None,
) -> Placed:
    """Take instances out and let them join again, over and over; what agrees better with a model of
    all is kept (an iterated local search).
    tries: times, at most; by default as many as `o.regrowths` has for the number of instances.

    Who stays: those that were sure of their place before any was not; then, in turns, those that
    agree best, and those that show nearly the same side, around one that is drawn. Where none is
    sure who joins next, a draw decides.
    """
    rng, idle = np.random.default_rng(seed), 0
    for turn in range(tries or max(2, round(o.regrowths * min(1.0, TEN / len(views))))):
        if o.effort.over:
            break
        stay = staying(best, turn, rng)
        again = grown_again(
            views, crops, rings, best, stay, DETAILED, o, seed=seed + turn, links=links, rng=rng
        )
        if again is None:
            continue
        again = confirmed(views, crops, rings, again, o, seed=seed + turn, links=links)
        idle = 0 if again.agreement > best.agreement + NO_GAIN else idle + 1
        if again.agreement > best.agreement or (
            believed(again, o) and again.agreement > best.agreement - SLACK
        ):
            say(
                f"{len(views) - len(stay)} of {len(views)} grown again: agreement {best.agreement:.3f} -> {again.agreement:.3f}"
            )
            best = again
        if idle == o.idle or believed(best, o):
            break
    return best


def staying(placed: Placed, turn: int, rng) -> list[int]:
    """Indices of those that stay when the others join again."""
    own, count = placed.own, len(placed.own)
    if turn % 2 == 0 and 2 <= len(placed.firm) < count:
        return list(placed.firm)
    stay = max(2, int(rng.integers(round(KEPT[0] * count), round(KEPT[1] * count) + 1)))
    if turn % 4 == 1:
        return np.argsort(-(own + WAVER * rng.standard_normal(count)))[:stay].tolist()
    sides = viewing_directions(placed.poses)
    likely = np.exp((own - own.max()) / WAVER)
    return np.argsort(-(sides @ sides[rng.choice(count, p=likely / likely.sum())]))[:stay].tolist()

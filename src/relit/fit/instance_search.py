"""The search for poses of identical objects: guesses for pairs, growth from the best of them, rounds of fit and search.

pair_guesses   every instance's silhouette is inflated to a crude model, and every other one registered against it (fit/instance_guesses.py)
grow           one instance after another joins those that stand already (fit/instance_growth.py); from several pairs, the best counts
improved       where instances were not sure of their places: taken out and grown again, another way each time
settle         rounds of a coarse model of all and a search for all poses by rendering it, and what follows (fit/instance_rounds.py)
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from relit.cameras.se3 import rotation_angle
from relit.fit.instance_growth import Grown, grow, seen_from
from relit.fit.instance_guesses import first_pairs, pair_guesses
from relit.fit.instance_options import DETAILED, Search
from relit.fit.instance_rounds import crops_of, descend, model_of_all, reconsider, regrown, settle
from relit.fit.instances import View, first_pose, frame_scale
from relit.fit.register import Rings, crop_rings
from relit.geometry.hull import NoShape

STILL = 0.5  # degrees; descents that turn instances by less have arrived
KEPT = (0.3, 0.7)  # shares of the instances that stay while the others are grown again, see `improved`
WAVER = 0.03  # standard deviation of what is added to the scores that say which
TEN = 10  # instances from which on fewer tries are made: they take longer, and growth goes wrong less often
NO_GAIN = 0.001  # of the mean agreement: too little to go on for


@dataclass(frozen=True)
class Placed:
    """A set of poses. own: (N,) scores against a model of all (`model_of_all`). firm: see `Grown`. leaps: instances that were not sure of
    their places. parts: the descriptor that it grew under."""

    poses: np.ndarray
    own: np.ndarray
    firm: tuple[int, ...]
    leaps: int
    parts: tuple[float, ...]

    @property
    def agreement(self) -> float:
        return float(self.own.mean())


def judged(views, grown: Grown, parts, o: Search, seed: int) -> Placed | None:
    """What a model of all says of what has grown; None where the silhouettes have nothing in common."""
    try:
        own = model_of_all(views, grown.poses, o, seed=seed)[1]
    except NoShape:
        return None
    return Placed(grown.poses, own, grown.firm, grown.leaps, parts)


def improved(views, crops, rings: Rings, best: Placed, o: Search, *, seed: int, links=(), say=lambda text: None) -> Placed:
    """Take instances out and let them join again, over and over; what agrees better with a model of all is kept (an iterated local search).

    Who stays: those that were sure of their place; then, in turns, those that agree best, and those that show nearly the same side, around
    one that is drawn. Where none is sure who joins next, a draw decides.
    """
    rng, idle = np.random.default_rng(seed), 0
    for turn in range(max(2, round(o.regrowths * min(1.0, TEN / len(views))))):
        stay = staying(best, turn, rng)
        try:
            grown = grow(views, crops, rings, DETAILED, stay, best.poses.copy(), o.growth, seed=seed + turn, links=links, rng=rng)
        except NoShape:
            continue
        again = judged(views, grown, DETAILED, o, seed)
        if again is None:
            continue
        doubtful = set(stay) - set(best.firm)
        again = replace(again, leaps=grown.leaps + len(doubtful), firm=tuple(k for k in grown.firm if k not in doubtful))
        idle = 0 if again.agreement > best.agreement + NO_GAIN else idle + 1
        if again.agreement > best.agreement:
            say(f"{len(views) - len(stay)} of {len(views)} grown again: agreement {best.agreement:.3f} -> {again.agreement:.3f}")
            best = again
        if idle == o.idle or best.leaps <= o.leaps * len(views):
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
    sides = seen_from(placed.poses)
    likely = np.exp((own - own.max()) / WAVER)
    return np.argsort(-(sides @ sides[rng.choice(count, p=likely / likely.sum())]))[:stay].tolist()


def nearer(pose: np.ndarray, a: np.ndarray, b: np.ndarray) -> bool:
    """Whether a pose (4, 4) is turned less against a than against b."""
    return rotation_angle(pose[:3, :3].T @ a[:3, :3]) < rotation_angle(pose[:3, :3].T @ b[:3, :3])


def place(views: list[View], o: Search, *, seed: int = 0, links=(), say=lambda text: None, step=lambda done, total: None):
    """Poses (N, 4, 4) object_from_camera of all views and their scores (N,), from nothing but the photo and its labels.

    links: ((i, j, rotation of i onto j in the photo), ...) from matching: growth tries them beside its own guesses. Raises NoShape where
    no set of poses agrees with the silhouettes.
    """
    distance = frame_scale(views)
    if len(views) == 1:
        return first_pose(views[0], distance)[None], np.ones(1)
    crops = crops_of(views)
    order = sorted(range(len(views)), key=lambda k: -views[k].seen * np.sqrt(views[k].mask.sum()) / views[k].camera.fx)
    chosen = order[: o.models]
    guesses = pair_guesses(views, crops, chosen, o, distance, seed, step)
    rings = {parts: crop_rings(crops, parts) for parts in guesses}
    pairs = {parts: first_pairs(some, chosen, o.starts) for parts, some in guesses.items()}
    best: Placed | None = None
    for turn in range(o.starts):
        for parts in pairs:
            if turn >= len(pairs[parts]) or (best is not None and best.leaps <= o.leaps * len(views)):
                continue
            s, j = pairs[parts][turn]
            pair = [chosen[s], j]
            poses = np.tile(np.eye(4), (len(views), 1, 1))
            poses[pair] = guesses[parts].poses[s, pair, 0]
            try:
                grown = grow(views, crops, rings[parts], parts, pair, poses, o.growth, seed=seed, links=links)
            except NoShape:  # the silhouettes have nothing in common
                continue
            placed = judged(views, grown, parts, o, seed)
            if placed is None:
                continue
            say(
                f"grown from {views[pair[0]].label} and {views[j].label}: {len(views) - grown.leaps} sure of their places, "
                f"agreement of all with a model of all {placed.agreement:.3f}"
            )
            if best is None or placed.agreement > best.agreement:
                best = placed
    if best is None:
        raise NoShape("no set of poses agrees with the silhouettes")
    if best.leaps > o.leaps * len(views) and len(views) > 3:
        best = improved(views, crops, rings[DETAILED], best, o, seed=seed + 60, links=links, say=say)
    if best.leaps > o.leaps * len(views):
        say(f"note: the poses are uncertain: {best.leaps} of {len(views)} were not sure of their places: is the object nearly symmetric?")
    poses, scores, parts = best.poses, best.own, best.parts
    poses, scores = settle(views, crops, rings[parts], poses, scores, o, o.rounds, seed=seed + 10, parts=parts, say=say)
    poses, scores = descend(views, crops, rings[parts], poses, scores, o, seed=seed + 20, parts=parts, say=say)
    poses, scores = regrown(views, crops, rings[parts], poses, scores, o, seed=seed + 100, parts=parts, say=say)
    detail = crop_rings(crops, DETAILED)  # colour alone puts a spotted cow on any of its white sides
    late, sure = False, set()
    for turn in range(o.rounds_doubted if o.descents and len(views) > 2 else 0):
        before = poses.copy()
        poses, scores, moved = reconsider(views, crops, detail, poses, scores, o, seed=seed + 30 + turn, parts=DETAILED, sure=sure, say=say)
        if not moved:
            break
        late, sent = True, poses.copy()
        poses, scores = descend(views, crops, rings[parts], poses, scores, o, seed=seed + 40 + turn, parts=parts, say=say)
        sure |= {k for k in moved if nearer(poses[k], before[k], sent[k])}  # brought back: asked again, they would be sent again
    for turn in range(o.late if late else 0):  # those that came late have had the fewest descents, and hold the others back
        before = poses.copy()
        poses, scores = descend(views, crops, rings[parts], poses, scores, o, seed=seed + 50 + turn, parts=parts, say=say)
        if np.median([rotation_angle(a[:3, :3].T @ b[:3, :3]) for a, b in zip(before, poses, strict=True)]) < STILL:
            break
    return regrown(views, crops, rings[parts], poses, scores, o, seed=seed + 200, parts=parts, say=say) if late else (poses, scores)

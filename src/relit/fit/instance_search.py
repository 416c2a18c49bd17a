"""The search for poses of identical objects: guesses for pairs, growth from the best of them, rounds of fit and search.

pair_guesses   every instance's silhouette is inflated to a crude model, and every other instance registered against it, several ways
grow           one instance after another joins those that stand already (fit/instance_growth.py); from several pairs, the best counts
improved       where instances were not sure of their places: taken out and grown again, another way each time
settle         a coarse model is fitted to all instances, all poses are searched again by rendering it; a few rounds
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from relit.cameras.se3 import rotation_angle
from relit.fit.instance_growth import ANOTHER, Grown, Growth, chosen_rings, grow, seen_from
from relit.fit.instance_lookup import look_for
from relit.fit.instances import View, albedo_render, carved, first_pose, fit_model, frame_scale, inflated
from relit.fit.register import (
    Crop,
    Gallery,
    Rings,
    crop_photo,
    crop_rings,
    directions_around,
    make_gallery,
    refine,
    rings_of,
    search,
    views_from,
)
from relit.geometry.hull import NoShape

# weights in fit.register's descriptors: decoration tells most, and of an object without it colour
DETAILED, COLOURFUL = (0.6, 1.0, 0.1, 0.6), (0.6, 2.0, 0.1)
STILL = 0.5  # degrees; descents that turn instances by less have arrived
UNSURE = 0.3  # see `ambiguous`
GAP = 0.1  # an instance's score may lie so much below those of the best third
LOW = 0.1  # see `regrown`: so much below the median
REGROWN = 2  # times at most
KEPT = (0.3, 0.7)  # shares of the instances that stay while the others are grown again, see `improved`
WAVER = 0.03  # standard deviation of what is added to the scores that say which
TEN = 10  # instances from which on fewer tries are made: they take longer, and growth goes wrong less often
NO_GAIN = 0.001  # of the mean agreement: too little to go on for


@dataclass(frozen=True)
class Search:
    """How poses are searched.

    nodes, steps: of the coarse models, a side and of each fit. viewpoints: all around. cone: degrees from what a single instance has shown
    within which another can be recognised. models: instances that are inflated, at most. keep: guesses for each pair. starts: pairs that
    poses are grown from, at most, for each descriptor. leaps: share of the instances that may have been unsure of their places in what is
    believed at once. regrowths, idle: times that instances are grown again where it is not, at most, and in a row without gain. rounds: of
    fit and search for all instances. descents, descent_rate: fits of shape and poses together that follow, and the step of the poses in
    them. rate: of the pose corrections in other coarse fits. depth: see `carved`. doubted, rounds_doubted: instances that are searched once
    more against a model of the others, and how often at most. late: descents that follow where one has moved, at most.
    """

    nodes: int = 40
    steps: int = 50
    viewpoints: int = 1500
    cone: float = 65.0
    models: int = 14
    keep: int = 2
    starts: int = 2
    leaps: float = 0.1
    regrowths: int = 12
    idle: int = 5
    rounds: int = 1
    descents: int = 5
    descent_rate: float = 0.012
    rate: float = 0.004
    depth: float = 2.5
    doubted: int = 12
    rounds_doubted: int = 5
    late: int = 3
    growth: Growth = field(default_factory=Growth)


def crops_of(views: list[View]) -> list[Crop]:
    return [crop_photo(v.rgb, v.mask, v.camera.with_pose(np.eye(4)), v.known) for v in views]


@dataclass(frozen=True)
class Guesses:
    """What inflated instances say of the others under one descriptor. poses: (S, N, K, 4, 4) object_from_camera of instance j in the model
    of instance chosen[s]; scores: (S, N, K), -1 for itself."""

    poses: np.ndarray
    scores: np.ndarray

    @property
    def margins(self) -> np.ndarray:
        """(S, N) by how much the best guess of a pair is better than the next; -1 for itself. It tells right guesses better than the score,
        which an object that looks like a disc from every side has anywhere."""
        first, second = self.scores[..., 0], self.scores[..., 1]
        return np.where(first > -1, first - np.maximum(second, 0), -1.0)


def pair_guesses(views: list[View], crops, chosen: list[int], o: Search, distance: float, seed: int, say) -> dict[tuple, Guesses]:
    """Guesses under each of two descriptors (DETAILED, COLOURFUL): every chosen instance is inflated to a model, and every other one is
    registered against it, `o.keep` ways."""
    rings = {parts: crop_rings(crops, parts) for parts in (DETAILED, COLOURFUL)}
    shape = (len(chosen), len(views), o.keep)
    out = {parts: Guesses(np.tile(np.eye(4), (*shape, 1, 1)), np.full(shape, -1.0)) for parts in rings}
    directions = directions_around(o.viewpoints, seed)
    for s, k in enumerate(chosen):
        pose = first_pose(views[k], distance)
        model, _ = fit_model([views[k]], pose[None], inflated(views[k], pose, o.nodes), o.steps, seed=seed)
        close = directions @ seen_from(pose[None])[0] >= np.cos(np.radians(o.cone))
        cameras = views_from(directions[close], max(2.0, distance))
        rgb, alpha = albedo_render(model)(cameras)
        for parts, guesses in out.items():
            gallery = Gallery(cameras, rings_of(rgb, alpha, parts=parts))
            found = search(crops, gallery, keep=o.keep, rings=rings[parts], apart=ANOTHER)
            guesses.poses[s], guesses.scores[s] = found.poses, found.scores
            guesses.poses[s, k], guesses.scores[s, k] = pose, -1.0
        say(s + 1, len(chosen))
    return out


def first_pairs(guesses: Guesses, chosen: list[int], most: int) -> list[tuple[int, int]]:
    """(row s, instance j) of the guesses with the largest margins, no pair twice."""
    margins = guesses.margins
    used: set[frozenset[int]] = set()
    pairs = []
    for at in np.argsort(-margins, axis=None):
        s, j = divmod(int(at), margins.shape[1])
        pair = frozenset({chosen[s], j})
        if margins[s, j] > -1 and pair not in used:
            pairs.append((s, j))
            used.add(pair)
        if len(pairs) == most:
            break
    return pairs


def settle(views, crops, rings, poses, scores, o: Search, rounds: int, *, seed: int, parts=DETAILED, say=lambda text: None):
    """Rounds of a coarse fit and a search, over all viewpoints, for better poses by rendering it; (poses, scores).

    Only instances that agree well shape the model (see `trusted`), so that one in a wrong place does not spoil the model that is to put it
    right.
    """
    for turn in range(rounds):
        use = trusted(scores)
        nodes = o.nodes if turn < 2 else round(1.3 * o.nodes)
        some = [views[k] for k in use]
        values = carved(some, poses[use], nodes, 0.15, o.depth)
        model, poses[use] = fit_model(some, poses[use], values, 2 * o.steps, refine_cameras=o.rate, seed=seed + turn)
        render = albedo_render(model)
        poses, scores = refine(crops, poses, render, rings=rings, steps=(0, 8.0, 4.0, 2.0), parts=parts)
        moved = np.zeros(len(views), bool)
        far = float(np.median(np.linalg.norm(poses[:, :3, 3], axis=1)))
        gallery = make_gallery(render, views_from(directions_around(o.viewpoints, seed + turn), far), parts)
        found = look_for(views, crops, gallery, rings, parts, keep=3)
        for k in range(3):
            other, also = refine(crops, found.poses[:, k], render, rings=rings, steps=(0, 4.0, 2.0), parts=parts)
            better = also > scores + 0.004
            poses, scores = np.where(better[:, None, None], other, poses), np.where(better, also, scores)
            moved |= better
        say(f"round {turn + 1}: {len(use)} shape the model, mean score {scores.mean():.3f}, lowest {scores.min():.3f}, {moved.sum()} moved")
    return poses, scores


def descend(views, crops, rings, poses, scores, o: Search, *, seed: int, parts=DETAILED, say=lambda text: None):
    """Short fits of shape and poses together, each from the hull of the poses so far; (poses, scores).

    Poses that move with a shape that began wrong are held back by it: beginning anew is quicker than one long fit. Poses stay for the first
    steps of each, until the shape is that of the hull. Instances that do not agree (see `trusted`) take no part; they are registered
    against the last model.
    """
    if o.descents == 0:
        return poses, scores
    use = trusted(scores, 2 * GAP)
    some, others = [views[k] for k in use], np.setdiff1d(np.arange(len(views)), use)
    for turn in range(o.descents):
        values = carved(some, poses[use], o.nodes + 8, 0.15, o.depth, crossed=True)
        model, poses[use] = fit_model(
            some, poses[use], values, 2 * o.steps, refine_cameras=o.descent_rate, hold=o.steps // 2, seed=seed + turn
        )
    render = albedo_render(model)
    again, scores = refine(crops, poses, render, rings=rings, steps=(0, 4.0, 2.0), parts=parts)
    poses[others] = again[others]
    say(f"shape and poses together: mean score {scores.mean():.3f}, lowest {scores.min():.3f}")
    return poses, scores


def reconsider(views, crops, rings, poses, scores, o: Search, *, seed: int, parts=DETAILED, sure=frozenset(), say=lambda text: None):
    """Search the instances that agree least once more, each against a model of all others; (poses, scores, indices of those that moved).

    An instance in a wrong place has shaped the model that it is compared with, and so agrees with it; a model without it has no such
    opinion. sure: indices of instances that are not asked.
    """
    moved = []
    for turn, k in enumerate([k for k in np.argsort(scores)[: o.doubted].tolist() if k not in sure]):
        rest = [j for j in range(len(views)) if j != k]
        some = [views[j] for j in rest]
        values = carved(some, poses[rest], o.nodes, 0.15, o.depth, crossed=len(rest) > 3)
        model, _ = fit_model(some, poses[rest], values, 2 * o.steps, seed=seed + turn)
        render, own = albedo_render(model), chosen_rings(rings, [k])
        best, score = refine([crops[k]], poses[[k]], render, rings=own, steps=(0, 4.0, 2.0), parts=parts)
        before = float(score[0])
        gallery = make_gallery(
            render, views_from(directions_around(o.viewpoints, seed + turn), float(np.linalg.norm(poses[k][:3, 3]))), parts
        )
        found = look_for([views[k]], [crops[k]], gallery, own, parts)
        for n in range(4):
            other, also = refine([crops[k]], found.poses[:, n], render, rings=own, steps=(0, 5.0, 2.5), parts=parts)
            if also[0] > score[0]:
                best, score = other, also
        if score[0] > before + 0.01 and rotation_angle(best[0][:3, :3].T @ poses[k][:3, :3]) > 8:
            say(f"{views[k].label} agrees better elsewhere with the model of the others: {before:.3f} -> {score[0]:.3f}")
            poses[k] = best[0]
            moved.append(k)
    return poses, scores, moved


def regrown(views, crops, rings, poses, scores, o: Search, *, seed: int, parts=DETAILED, say=lambda text: None):
    """Take all instances out that agree badly with a model of all, descend without them, and let them join again; (poses, scores).

    Two in wrong places bear each other out: either is asked against a model that the other has spoilt (see `reconsider`). What comes out is
    kept where all agree better with a model of all, in detail.
    """
    if len(views) < 4 or o.descents == 0:
        return poses, scores
    try:
        detail, own = crop_rings(crops, DETAILED), model_of_all(views, poses, o, seed=seed)[1]
        for turn in range(REGROWN):
            low = own < np.median(own) - LOW
            if not low.any():
                break
            rest, again = np.flatnonzero(~low).tolist(), poses.copy()
            some, theirs, own_rings = [views[k] for k in rest], [crops[k] for k in rest], chosen_rings(rings, rest)
            again[rest], _ = descend(some, theirs, own_rings, again[rest], np.ones(len(rest)), o, seed=seed + turn, parts=parts)
            back = grow(views, crops, detail, DETAILED, rest, again, o.growth, seed=seed + 10 + turn)
            again, level = descend(views, crops, rings, back.poses, back.scores, o, seed=seed + 20 + turn, parts=parts)
            better = model_of_all(views, again, o, seed=seed)[1]
            names = ", ".join(str(views[k].label) for k in np.flatnonzero(low))
            say(f"{names} taken out together and grown again: agreement of all with a model of all {own.mean():.3f} -> {better.mean():.3f}")
            if better.mean() <= own.mean():
                break
            poses, scores, own = again, level, better
    except NoShape:  # those that are left have nothing in common: it was not they
        pass
    return poses, scores


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


def ambiguous(views: list[View], poses: np.ndarray, o: Search, *, seed: int = 0) -> np.ndarray:
    """(N,) degrees by which another pose of an instance that the pictures hardly tell from its own is turned against it, 0 where there is
    none: it agrees with the model of all so well that what the own one falls short of 1 grows by less than the share UNSURE."""
    parts, crops = DETAILED, crops_of(views)
    rings = crop_rings(crops, parts)
    render, own = model_of_all(views, poses, o, seed=seed)
    far = float(np.median(np.linalg.norm(poses[:, :3, 3], axis=1)))
    gallery = make_gallery(render, views_from(directions_around(o.viewpoints, seed), far), parts)
    found = look_for(views, crops, gallery, rings, parts, keep=3, apart=ANOTHER)
    best, angle = own - UNSURE * (1 - own), np.zeros(len(views))
    for n in range(found.poses.shape[1]):
        other, score = refine(crops, found.poses[:, n], render, rings=rings, steps=(0, 4.0, 2.0), parts=parts)
        away = np.array([rotation_angle(a[:3, :3].T @ b[:3, :3]) for a, b in zip(other, poses, strict=True)])
        better = (away >= ANOTHER) & (score > best)
        best, angle = np.where(better, score, best), np.where(better, away, angle)
    return angle


def model_of_all(views: list[View], poses: np.ndarray, o: Search, *, seed: int = 0):
    """What renders a model that is fitted to all views, and the scores (N,) of all against it."""
    crops = crops_of(views)
    values = carved(views, poses, o.nodes + 8, 0.15, o.depth, crossed=True)
    model, _ = fit_model(views, poses, values, 2 * o.steps, seed=seed)
    render = albedo_render(model)
    return render, refine(crops, poses, render, rings=crop_rings(crops, DETAILED), steps=(0, 2.0), parts=DETAILED)[1]


def trusted(scores: np.ndarray, gap: float = GAP) -> np.ndarray:
    """Indices of the instances whose score lies within `gap` of the mean of the best third; at least three."""
    best = np.sort(scores)[::-1]
    level = best[: max(1, round(len(scores) / 3))].mean() - gap
    return np.flatnonzero(scores >= min(level, best[min(2, len(scores) - 1)]))


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

"""Poses of identical objects that stand roughly: a model of all is fitted to them, and they are
searched again by rendering it.

settle, descend     all poses, by search over the viewpoints and by descent with the shape
reconsider, regrown one at a time against a model of the others; all that agree badly, taken out
together and grown again
model_of_all        the judge: what a model that is fitted to all says of each; ambiguous: where
                    another pose says as much
"""

from __future__ import annotations

import numpy as np

from relit.fit.registration.instances.growth import grow_instances
from relit.fit.registration.instances.lookup import look_for
from relit.fit.registration.instances.options import DETAILED, Search
from relit.fit.registration.instances.views import (
    InstanceView,
    albedo_render,
    carved,
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

GAP = 0.1  # an instance's score may lie so much below those of the best third
LOW = 0.1  # see `regrown`: so much below the median
REGROWN = 2  # times at most
STILL = 0.5  # degrees; descents that turn instances by less have arrived
SLACK = 0.005  # of the mean agreement by which two fits of the same poses may differ


def settle_instances(
    views,
    crops,
    rings,
    poses,
    scores,
    o: Search,
    rounds: int,
    *,
    seed: int,
    parts=DETAILED,
    say=lambda text: None,
):
    """Rounds of a coarse fit and a search, over all viewpoints, for better poses by rendering it;
    (poses, scores).

    Only instances that agree well shape the model (see `trusted`), so that one in a wrong place
    does not spoil the model that is to put it right.
    """
    for turn in range(rounds):
        use = trusted(scores)
        nodes = o.nodes if turn < 2 else round(1.3 * o.nodes)
        some = [views[k] for k in use]
        values = taut_body(some, poses[use], nodes, 0.15, o.depth)
        o.effort.spend(2 * o.steps)
        model, poses[use] = fit_model(
            some, poses[use], values, 2 * o.steps, refine_cameras=o.rate, seed=seed + turn
        )
        render = albedo_render(model)
        poses, scores = refine(
            crops, poses, render, rings=rings, steps=(0, 8.0, 4.0, 2.0), parts=parts
        )
        moved = np.zeros(len(views), bool)
        far = eyes_at(poses)
        gallery = make_gallery(
            render, views_from(directions_around(o.viewpoints, seed + turn), far), parts
        )
        found = look_for(views, crops, gallery, rings, parts, keep=3)
        for k in range(3):
            other, also = refine(
                crops, found.poses[:, k], render, rings=rings, steps=(0, 4.0, 2.0), parts=parts
            )
            better = also > scores + 0.004
            poses, scores = (
                np.where(better[:, None, None], other, poses),
                np.where(better, also, scores),
            )
            moved |= better
        say(
            f"round {turn + 1}: {len(use)} shape the model, mean score {scores.mean():.3f}, lowest {scores.min():.3f}, {moved.sum()} moved"
        )
    return poses, scores


def refine_jointly(
    views,
    crops,
    rings,
    poses,
    scores,
    o: Search,
    *,
    seed: int,
    parts=DETAILED,
    say=lambda text: None,
):
    """Short fits of shape and poses together, each from the hull of the poses so far; (poses,
    scores).

    Poses that move with a shape that began wrong are held back by it: beginning anew is quicker
    than one long fit. Poses stay for the first steps of each, until the shape is that of the hull.
    Instances that do not agree (see `trusted`) take no part; they are registered against the last
    model.
    """
    if o.descents == 0:
        return poses, scores
    use = trusted(scores, 2 * GAP)
    some, others = [views[k] for k in use], np.setdiff1d(np.arange(len(views)), use)
    for turn in range(o.descents):
        values = carved(some, poses[use], o.nodes + 8, 0.15, o.depth, crossed=True)
        o.effort.spend(2 * o.steps)
        model, poses[use] = fit_model(
            some,
            poses[use],
            values,
            2 * o.steps,
            refine_cameras=o.descent_rate,
            hold=o.steps // 2,
            seed=seed + turn,
        )
    render = albedo_render(model)
    again, scores = refine(crops, poses, render, rings=rings, steps=(0, 4.0, 2.0), parts=parts)
    poses[others] = again[others]
    say(f"shape and poses together: mean score {scores.mean():.3f}, lowest {scores.min():.3f}")
    return poses, scores


def refine_and_verify(
    views,
    crops,
    rings,
    poses,
    scores,
    o: Search,
    *,
    seed: int,
    parts=DETAILED,
    say=lambda text: None,
):
    """Poses that have grown, made exact, and doubted; (poses, scores, torn). What doubt moves is
    kept where all agree no worse for it.
    torn: indices of those who agree better elsewhere with the model of the others, while all agree
    less for it."""
    poses, scores = settle_instances(
        views, crops, rings, poses, scores, o, o.rounds, seed=seed + 10, parts=parts, say=say
    )
    poses, scores = refine_jointly(
        views, crops, rings, poses, scores, o, seed=seed + 20, parts=parts, say=say
    )
    poses, scores = regrown(
        views, crops, rings, poses, scores, o, seed=seed + 100, parts=parts, say=say
    )
    if not o.descents or len(views) < 3 or not o.rounds_doubted:
        return poses, scores, set()
    detail = crop_rings(
        crops, DETAILED
    )  # colour alone puts a spotted cow on any of its white sides
    late, sure, torn, agreement = False, set(), set(), agreement_of(views, poses, o, seed)
    for turn in range(o.rounds_doubted):
        sent, _, moved = reconsider(
            views,
            crops,
            detail,
            poses.copy(),
            scores,
            o,
            seed=seed + 30 + turn,
            parts=DETAILED,
            sure=sure,
            say=say,
        )
        if not moved or o.effort.over:
            break
        again, level = refine_jointly(
            views, crops, rings, sent.copy(), scores, o, seed=seed + 40 + turn, parts=parts, say=say
        )
        better = agreement_of(views, again, o, seed)
        if better < agreement - SLACK:
            say(
                f"all agree less for it ({agreement:.3f} -> {better:.3f}): they stay where they were"
            )
            sure |= set(moved)
            torn |= set(moved)
            continue
        sure |= {
            k for k in moved if nearer(again[k], poses[k], sent[k])
        }  # brought back: asked again, they would be sent again
        late, poses, scores, agreement = True, again, level, max(agreement, better)
    for turn in range(
        o.late if late and not o.effort.over else 0
    ):  # those that came late have had the fewest descents, and hold the others back
        before = poses.copy()
        poses, scores = refine_jointly(
            views, crops, rings, poses, scores, o, seed=seed + 50 + turn, parts=parts, say=say
        )
        if (
            np.median(
                [
                    rotation_angle(a[:3, :3].T @ b[:3, :3])
                    for a, b in zip(before, poses, strict=True)
                ]
            )
            < STILL
        ):
            break
    if late:
        poses, scores = regrown(
            views, crops, rings, poses, scores, o, seed=seed + 200, parts=parts, say=say
        )
    return poses, scores, torn


def agreement_of(views, poses: np.ndarray, o: Search, seed: int) -> float:
    """Mean score of all against a model of all; 0 where the silhouettes have nothing in common."""
    try:
        return float(model_of_all(views, poses, o, seed=seed)[1].mean())
    except NoShape:
        return 0.0


def nearer(pose: np.ndarray, a: np.ndarray, b: np.ndarray) -> bool:
    """Whether a pose (4, 4) is turned less against a than against b."""
    return rotation_angle(pose[:3, :3].T @ a[:3, :3]) < rotation_angle(pose[:3, :3].T @ b[:3, :3])


def reconsider(
    views,
    crops,
    rings,
    poses,
    scores,
    o: Search,
    *,
    seed: int,
    parts=DETAILED,
    sure=frozenset(),
    say=lambda text: None,
):
    """Search the instances that agree least once more, each against a model of all others; (poses,
    scores, indices of those that moved).

    An instance in a wrong place has shaped the model that it is compared with, and so agrees with
    it; a model without it has no such opinion. sure: indices of instances that are not asked.
    """
    moved = []
    for turn, k in enumerate(
        [k for k in np.argsort(scores)[: o.doubted].tolist() if k not in sure]
    ):
        rest = [j for j in range(len(views)) if j != k]
        some = [views[j] for j in rest]
        values = taut_body(some, poses[rest], o.nodes, 0.15, o.depth, crossed=len(rest) > 3)
        o.effort.spend(2 * o.steps)
        model, _ = fit_model(some, poses[rest], values, 2 * o.steps, seed=seed + turn)
        render, own = albedo_render(model), chosen_rings(rings, [k])
        best, score = refine(
            [crops[k]], poses[[k]], render, rings=own, steps=(0, 4.0, 2.0), parts=parts
        )
        before = float(score[0])
        gallery = make_gallery(
            render,
            views_from(
                directions_around(o.viewpoints, seed + turn), float(np.linalg.norm(poses[k][:3, 3]))
            ),
            parts,
        )
        found = look_for([views[k]], [crops[k]], gallery, own, parts)
        for n in range(4):
            other, also = refine(
                [crops[k]], found.poses[:, n], render, rings=own, steps=(0, 5.0, 2.5), parts=parts
            )
            if also[0] > score[0]:
                best, score = other, also
        if score[0] > before + 0.01 and rotation_angle(best[0][:3, :3].T @ poses[k][:3, :3]) > 8:
            say(
                f"{views[k].label} agrees better elsewhere with the model of the others: {before:.3f} -> {score[0]:.3f}"
            )
            poses[k] = best[0]
            moved.append(k)
    return poses, scores, moved


def regrown(
    views,
    crops,
    rings,
    poses,
    scores,
    o: Search,
    *,
    seed: int,
    parts=DETAILED,
    say=lambda text: None,
):
    """Take all instances out that agree badly with a model of all, descend without them, and let
    them join again; (poses, scores).

    Two in wrong places bear each other out: either is asked against a model that the other has
    spoilt (see `reconsider`). What comes out is kept where all agree better with a model of all, in
    detail.
    """
    if len(views) < 4 or o.descents == 0:
        return poses, scores
    try:
        detail, own = crop_rings(crops, DETAILED), model_of_all(views, poses, o, seed=seed)[1]
        for turn in range(REGROWN):
            low = own < np.median(own) - LOW
            if not low.any() or o.effort.over:
                break
            rest, again = np.flatnonzero(~low).tolist(), poses.copy()
            some, theirs, own_rings = (
                [views[k] for k in rest],
                [crops[k] for k in rest],
                chosen_rings(rings, rest),
            )
            again[rest], _ = refine_jointly(
                some,
                theirs,
                own_rings,
                again[rest],
                np.ones(len(rest)),
                o,
                seed=seed + turn,
                parts=parts,
            )
            back = grow_instances(
                views, crops, detail, DETAILED, rest, again, o.growth, seed=seed + 10 + turn
            )
            again, level = refine_jointly(
                views, crops, rings, back.poses, back.scores, o, seed=seed + 20 + turn, parts=parts
            )
            better = model_of_all(views, again, o, seed=seed)[1]
            names = ", ".join(str(views[k].label) for k in np.flatnonzero(low))
            say(
                f"{names} taken out together and grown again: agreement of all with a model of all {own.mean():.3f} -> {better.mean():.3f}"
            )
            if better.mean() <= own.mean():
                break
            poses, scores, own = again, level, better
    except NoShape:  # those that are left have nothing in common: it was not they
        pass
    return poses, scores


def model_of_all(views: list[InstanceView], poses: np.ndarray, o: Search, *, seed: int = 0):
    """What renders a model that is fitted to all views, and the scores (N,) of all against it."""
    crops = instance_crops(views)
    values = carved(views, poses, o.nodes + 8, 0.15, o.depth, crossed=True)
    o.effort.spend(2 * o.steps)
    model, _ = fit_model(views, poses, values, 2 * o.steps, seed=seed)
    render = albedo_render(model)
    return render, refine(
        crops, poses, render, rings=crop_rings(crops, DETAILED), steps=(0, 2.0), parts=DETAILED
    )[1]


def trusted(scores: np.ndarray, gap: float = GAP) -> np.ndarray:
    """Indices of the instances whose score lies within `gap` of the mean of the best third; at
    least three."""
    best = np.sort(scores)[::-1]
    level = best[: max(1, round(len(scores) / 3))].mean() - gap
    return np.flatnonzero(scores >= min(level, best[min(2, len(scores) - 1)]))

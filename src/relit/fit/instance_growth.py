"""Poses of identical objects by growth: from the pair that looks most alike, one instance after another is registered against a coarse
model of those that stand already.

The guesses for pairs that score best (fit.instance_search.pair_guesses) are right far more often than the rest. So poses are believed in
the order of their scores, as in incremental structure from motion, and each instance that joins makes the model better for the next.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, fields

import numpy as np

from relit.conventions import similarity
from relit.fit.instances import View, albedo_render, carved, first_pose, fit_model
from relit.fit.register import Crop, Gallery, Render, Rings, directions_around, refine, rings_of, search, views_from


@dataclass(frozen=True)
class Growth:
    """How a set of placed instances grows. nodes, steps, rate, depth: of the coarse models, as `Search`. viewpoints: all around. cone:
    degrees around what the placed ones have shown within which others are looked for. keep: guesses for each that are refined. gap: those
    join together whose scores lie within it of the best. astray: a member whose score lies so much below the median is taken out again."""

    nodes: int = 40
    steps: int = 50
    rate: float = 0.004
    depth: float = 2.5
    viewpoints: int = 1500
    cone: float = 60.0
    keep: int = 3
    gap: float = 0.02
    astray: float = 0.15


def seen_from(poses: np.ndarray) -> np.ndarray:
    """Unit vectors (N, 3) from the object's middle to the cameras."""
    c = poses[:, :3, 3]
    return c / np.linalg.norm(c, axis=1, keepdims=True)


def grow(
    views: list[View], crops: list[Crop], rings: Rings, parts, members: list[int], poses: np.ndarray, o: Growth, *, seed: int = 0, links=()
) -> tuple[np.ndarray, np.ndarray]:
    """Poses (N, 4, 4) and scores (N,) of all instances, grown from `members`, whose entries of `poses` count.

    links: ((i, j, rotation of i onto j in the photo), ...) from matching, tried beside the guesses of the search. Raises NoShape where
    the silhouettes of the members have nothing in common.
    """
    poses, scores = np.array(poses, np.float64), np.full(len(views), -1.0)
    members, expelled, turn = list(members), Counter(), 0
    while True:
        turn += 1
        some = [views[k] for k in members]
        values = carved(some, poses[members], o.nodes, 0.3 if len(members) > 3 else 0.15, o.depth)
        model, poses[members] = fit_model(some, poses[members], values, o.steps, refine_cameras=o.rate, seed=seed)
        render = albedo_render(model)
        poses[members], scores[members] = refine(
            [crops[k] for k in members], poses[members], render, rings=chosen_rings(rings, members), steps=(0, 4.0, 2.0), parts=parts
        )
        if len(members) > 2:
            level = np.median(scores[members]) - o.astray
            astray = [k for k in members if scores[k] < level and expelled[k] < 2]
            expelled.update(astray)
            members = [k for k in members if k not in astray]
        rest = [k for k in range(len(views)) if k not in members]
        if not rest:
            return poses, scores
        poses[rest], scores[rest] = registered(views, crops, rings, parts, render, poses, members, rest, o, seed + turn, links)
        order = sorted(rest, key=lambda k: -scores[k])
        alike = sum(scores[k] >= scores[order[0]] - o.gap for k in rest)
        members += order[: max(1, min(alike, len(members) // 2))]


def registered(views, crops, rings: Rings, parts, render: Render, poses, members: list[int], rest: list[int], o: Growth, seed: int, links):
    """Poses and scores of `rest` against the model of `members`: the best of what near-by viewpoints show and of what links say."""
    far = float(np.median(np.linalg.norm(poses[members][:, :3, 3], axis=1)))
    directions = directions_around(o.viewpoints, seed)
    close = (directions @ seen_from(poses[members]).T).max(1) > np.cos(np.radians(o.cone))
    cameras = views_from(directions[close], far)
    rgb, alpha = render(cameras)
    theirs, some = chosen_rings(rings, rest), [crops[k] for k in rest]
    # not look_for: what is hidden in part would fit early, and wrongly
    found = search(some, Gallery(cameras, rings_of(rgb, alpha, parts=parts)), keep=o.keep, rings=theirs)
    tries = [found.poses[:, j] for j in range(o.keep)]
    told = linked_poses(views, poses, members, rest, links, far)
    if told:
        tries.append(np.array([told.get(k, tries[0][i]) for i, k in enumerate(rest)]))
    best_poses, best = tries[0], np.full(len(rest), -1.0)
    for start in tries:
        other, score = refine(some, start, render, rings=theirs, steps=(0, 5.0, 2.5), parts=parts)
        better = score > best
        best_poses, best = np.where(better[:, None, None], other, best_poses), np.where(better, score, best)
    return best_poses, best


def linked_poses(views, poses, members: list[int], rest: list[int], links, distance: float) -> dict[int, np.ndarray]:
    """Poses of those of `rest` that a link joins with a member, each in the middle of its silhouette."""
    out = {}
    for i, j, turn in (*links, *((j, i, turn.T) for i, j, turn in links)):
        if i in members and j in rest and j not in out:
            own = poses[i][:3, :3] @ turn.T
            out[j] = similarity(own, own @ first_pose(views[j], distance)[:3, 3])
    return out


def chosen_rings(rings: Rings, chosen: list[int]) -> Rings:
    """The rings of some of the pictures."""
    return Rings(*(getattr(rings, f.name)[chosen] for f in fields(Rings)))

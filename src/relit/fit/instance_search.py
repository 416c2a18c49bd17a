"""The search for poses of identical objects: guesses for pairs, orientations that agree with them, rounds of fit and search.

pair_hypotheses   every instance's silhouette is inflated to a crude model, and every other instance registered against it, several ways
consistent        the orientations of all that agree with as many of these guesses as possible
settle            a coarse model is fitted to all instances, all poses are searched again by rendering it; a few rounds
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from relit.cameras.se3 import nearest_rotation
from relit.conventions import similarity
from relit.fit.instances import View, albedo_render, carved, first_pose, fit_model, frame_scale, inflated
from relit.fit.register import (
    Crop,
    Gallery,
    crop_photo,
    crop_rings,
    directions_around,
    make_gallery,
    refine,
    rings_of,
    search,
    views_from,
)

# weights in fit.register's descriptors: one photo, one light, so brightness tells more than across photos; colourful objects do with less
# of it
PARTS, COLOURFUL = (0.5, 2.0, 0.6), (0.6, 2.0, 0.1)


@dataclass(frozen=True)
class Search:
    """How poses are searched. nodes: of the coarse models, a side. steps: of each coarse fit. viewpoints: all around. cone: degrees from
    what a single instance has shown within which another can be recognised. models: instances that are inflated, at most. keep:
    hypotheses of each pair. tolerance: degrees within which hypotheses agree. settled: sets of poses that are fitted and compared.
    rounds: of fit and search for all instances at the end. rate: step of the pose corrections in coarse fits. depth: see `carved`."""

    nodes: int = 40
    steps: int = 50
    viewpoints: int = 1500
    cone: float = 65.0
    models: int = 14
    keep: int = 4
    tolerance: float = 22.0
    settled: int = 2
    rounds: int = 3
    rate: float = 0.004
    depth: float = 2.5


def crops_of(views: list[View]) -> list[Crop]:
    return [crop_photo(v.rgb, v.mask, v.camera.with_pose(np.eye(4)), v.known) for v in views]


def seen_from(poses: np.ndarray) -> np.ndarray:
    """Unit vectors (N, 3) from the object's middle to the cameras."""
    c = poses[:, :3, 3]
    return c / np.linalg.norm(c, axis=1, keepdims=True)


def pair_hypotheses(views: list[View], crops, chosen: list[int], o: Search, distance: float, seed: int, say) -> dict:
    """For each of two descriptors (PARTS, COLOURFUL): rotations (S, N, K, 3, 3) that carry instance chosen[s] onto instance j in the
    photo, and their scores (S, N, K).

    Every chosen instance is inflated to a model, and every other one registered against it, `o.keep` ways. The scores of a descriptor are
    shifted so that one in ten pairs has more than 0.9: then the two can be compared.
    """
    rings = {parts: crop_rings(crops, parts) for parts in (PARTS, COLOURFUL)}
    shape = (len(chosen), len(views), o.keep)
    out = {parts: (np.tile(np.eye(3), (*shape, 1, 1)), np.full(shape, -1.0)) for parts in rings}
    directions = directions_around(o.viewpoints, seed)
    for s, k in enumerate(chosen):
        pose = first_pose(views[k], distance)
        model, _ = fit_model([views[k]], pose[None], inflated(views[k], pose, o.nodes), o.steps, seed=seed)
        close = directions @ seen_from(pose[None])[0] >= np.cos(np.radians(o.cone))
        cameras = views_from(directions[close], max(2.0, distance))
        rgb, alpha = albedo_render(model)(cameras)
        for parts, (rotations, scores) in out.items():
            gallery = Gallery(cameras, rings_of(rgb, alpha, parts=parts))
            found = search(crops, gallery, keep=o.keep, rings=rings[parts], apart=25.0)
            rotations[s] = np.swapaxes(found.poses[..., :3, :3], -1, -2)  # the model's axes are the photo's: pose^-1 turns k onto j
            scores[s] = found.scores
            scores[s, k] = -1.0
        say(s + 1, len(chosen))
    for _, scores in out.values():
        scores[scores > -1] += 0.9 - np.quantile(scores[..., 0][scores[..., 0] > -1], 0.9)
    return out


def consistent(rotations: np.ndarray, scores: np.ndarray, chosen: list[int], tolerance: float, links=()) -> list[tuple[float, np.ndarray]]:
    """Orientations (N, 3, 3) photo_from_object of all instances that agree with as many pair hypotheses as possible, one set from each
    start, best first: [(support, orientations)].

    Support of a set: sum over pairs of the best hypothesis' weight times a Gauss curve of its disagreement. links: ((i, j, rotation of i
    onto j, weight), ...) from matching.
    """
    n, sigma = rotations.shape[1], np.radians(tolerance)
    weight = np.exp((scores - 1) / 0.06)  # a good score means much: that of a wrong pose is often near-by
    edges: dict[tuple[int, int], list[tuple[np.ndarray, float]]] = {}
    for s, k in enumerate(chosen):
        for j in range(n):
            if j != k:
                edges.setdefault((k, j), []).extend(zip(rotations[s, j], weight[s, j], strict=True))
    for i, j, r, w in links:
        edges.setdefault((i, j), []).append((r, w))
    around: list[list[tuple[int, np.ndarray, np.ndarray]]] = [[] for _ in range(n)]  # of j: (i, rotations i onto j, weights)
    for (i, j), some in edges.items():
        r, w = np.array([x[0] for x in some]), np.array([x[1] for x in some])
        around[j].append((i, r, w))
        around[i].append((j, np.swapaxes(r, 1, 2), w))

    def votes(j: int, placed: dict[int, np.ndarray]) -> tuple[np.ndarray, float]:
        """The orientation of j with the most support from those placed, and that support."""
        candidates, owners = [], []
        for i, r, w in around[j]:
            if i in placed:
                candidates.append(r @ placed[i])
                owners.append(np.stack([np.full(len(r), len(owners)), w], 1))
        if not candidates:
            return np.eye(3), 0.0
        groups = len(candidates)
        c, own = np.concatenate(candidates), np.concatenate(owners)
        cosine = np.clip((np.einsum("aij,bij->ab", c, c) - 1) / 2, -1, 1)
        agree = np.exp(-0.5 * (np.arccos(cosine) / sigma) ** 2) * own[None, :, 1]
        best = np.zeros((len(c), groups))
        for g in range(groups):
            best[:, g] = agree[:, own[:, 0] == g].max(1)
        total = best.sum(1)
        a = int(total.argmax())
        near_by = agree[a] > 0.3 * own[:, 1]  # the mean of those that agree is better than any one
        return nearest_rotation((c[near_by] * agree[a][near_by][:, None, None]).sum(0)), float(total[a])

    out = []
    for start in chosen:
        placed = {start: np.eye(3)}
        while len(placed) < n:
            options = {j: votes(j, placed) for j in range(n) if j not in placed}
            j = max(options, key=lambda k: options[k][1])
            placed[j] = options[j][0]
        support = 0.0
        for _ in range(6):
            support = 0.0
            for j in range(n):
                rest = {i: r for i, r in placed.items() if i != j}
                placed[j], vote = votes(j, rest)
                support += vote
        out.append((support, np.array([placed[k] for k in range(n)])))
    return sorted(out, key=lambda x: -x[0])


def poses_of(views: list[View], orientations: np.ndarray, distance: float) -> np.ndarray:
    """object_from_camera (N, 4, 4) of given orientations photo_from_object, each instance in the middle of its silhouette."""
    out = []
    for view, r in zip(views, orientations, strict=True):
        pose = first_pose(view, distance)
        out.append(similarity(r.T, r.T @ pose[:3, 3]))
    return np.array(out)


def settle(views, crops, rings, poses, scores, o: Search, rounds: int, *, wide: bool, seed: int, parts=PARTS, say=lambda text: None):
    """Rounds of a coarse fit and a search for better poses by rendering it; (poses, scores).

    scores: of the poses so far, or None: then all instances shape the model. Otherwise only those that agree well do (see `trusted`), so
    that one in a wrong place does not spoil the model that is to put it right. wide: search all viewpoints in each round, else only
    around the present poses.
    """
    n = len(views)
    for turn in range(rounds):
        use = np.arange(n) if scores is None else trusted(scores)
        nodes = o.nodes if turn < 2 else round(1.3 * o.nodes)
        some = [views[k] for k in use]
        # a hull that is too fat misleads more than one that is too thin
        values = carved(some, poses[use], nodes, 0.3 if scores is None else 0.15, o.depth)
        steps = o.steps + 10 * turn
        model, poses[use] = fit_model(some, poses[use], values, steps, refine_cameras=o.rate, seed=seed + turn)
        render = albedo_render(model)
        poses, scores = refine(crops, poses, render, rings=rings, steps=(0, 8.0, 4.0, 2.0), parts=parts)
        moved = np.zeros(n, bool)
        if wide:
            far = float(np.median(np.linalg.norm(poses[:, :3, 3], axis=1)))
            gallery = make_gallery(render, views_from(directions_around(o.viewpoints, seed + turn), far), parts)
            found = search(crops, gallery, keep=3, rings=rings)
            for k in range(3):
                other, also = refine(crops, found.poses[:, k], render, rings=rings, steps=(0, 4.0, 2.0), parts=parts)
                better = also > scores + 0.004
                poses, scores = np.where(better[:, None, None], other, poses), np.where(better, also, scores)
                moved |= better
        say(f"round {turn + 1}: {len(use)} shape the model, mean score {scores.mean():.3f}, lowest {scores.min():.3f}, {moved.sum()} moved")
    return poses, scores


def trusted(scores: np.ndarray, gap: float = 0.1) -> np.ndarray:
    """Indices of the instances whose score lies within `gap` of the mean of the best third; at least three."""
    best = np.sort(scores)[::-1]
    level = best[: max(1, round(len(scores) / 3))].mean() - gap
    return np.flatnonzero(scores >= min(level, best[min(2, len(scores) - 1)]))


def place(views: list[View], o: Search, *, seed: int = 0, links=(), say=lambda text: None, step=lambda done, total: None):
    """Poses (N, 4, 4) object_from_camera of all views and their scores (N,), from nothing but the photo and its labels.

    links: see `consistent`.
    """
    distance = frame_scale(views)
    if len(views) == 1:
        return first_pose(views[0], distance)[None], np.ones(1)
    crops = crops_of(views)
    order = sorted(range(len(views)), key=lambda k: -views[k].seen * np.sqrt(views[k].mask.sum()) / views[k].camera.fx)
    chosen = order[: o.models]
    guesses = pair_hypotheses(views, crops, chosen, o, distance, seed, step)
    judged = [(parts, consistent(*guesses[parts], chosen, o.tolerance, links)) for parts in guesses]
    parts, sets = max(judged, key=lambda x: x[1][0][0])  # the descriptor whose guesses agree more suits the object
    rings = crop_rings(crops, parts)
    best = None
    for support, orientations in distinct([sets[0], *stars(*guesses[parts]), *sets[1:]], o.settled):
        start = poses_of(views, orientations, distance)
        try:
            poses, agreed = settle(views, crops, rings, start, None, o, 2, wide=False, seed=seed, parts=parts)
        except ValueError:  # the silhouettes have nothing in common
            continue
        say(f"a set of poses with support {support:.2f}: mean score {agreed.mean():.3f}")
        if best is None or agreed.mean() > best[1].mean():
            best = poses, agreed
    if best is None:
        raise ValueError("no set of poses agrees with the silhouettes")
    return settle(views, crops, rings, *best, o, o.rounds, wide=True, seed=seed + 10, parts=parts, say=say)


def stars(rotations: np.ndarray, scores: np.ndarray) -> list[tuple[float, np.ndarray]]:
    """The orientations that one inflated instance alone says, best guesses only: [(mean score, (N, 3, 3))], best first. Where all are
    seen from about one side this is better than any vote."""
    best = scores.argmax(2)
    mean = np.take_along_axis(scores, best[..., None], 2)[..., 0].sum(1) + 1  # its own score is -1
    picked = np.take_along_axis(rotations, best[..., None, None, None], 2)[:, :, 0]
    own = np.take_along_axis(scores, best[..., None], 2)[..., 0] <= -1
    picked[own] = np.eye(3)
    return [(float(mean[s] / max(scores.shape[1] - 1, 1)), picked[s]) for s in np.argsort(-mean)]


def distinct(sets: list[tuple[float, np.ndarray]], most: int) -> list[tuple[float, np.ndarray]]:
    """The first sets of orientations that differ from each other by more than their frame: a median of 8 degrees or more."""
    kept: list[tuple[float, np.ndarray]] = []
    for support, r in sets:
        different = True
        for _, q in kept:
            frame = nearest_rotation(np.einsum("nji,njk->ik", q, r))
            angles = np.arccos(np.clip((np.einsum("nij,nij->n", r, q @ frame) - 1) / 2, -1, 1))
            different &= bool(np.median(angles) > np.radians(8))
        if different:
            kept.append((support, r))
        if len(kept) == most:
            break
    return kept

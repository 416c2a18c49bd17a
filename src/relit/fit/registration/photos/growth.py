"""Where each photo of a collection was taken from when nothing is known: the shape grows outward.

It begins with the photos that pairs hold together (collection_pairs.py), or, where these are too
few, as one inflated silhouette. Only viewpoints near those that the model has seen are trusted, and
the photos that match best join first. Of single photos several are tried as the beginning; those
that others agree with least are dropped early.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from relit.conventions import similarity
from relit.fit.registration.photos.depth import ONE_SIDE, depth_limit, inflated_occupancy
from relit.fit.registration.photos.few import FEW, best_way, few_from_hints, polished
from relit.fit.registration.photos.pairs import largest_consistent_set, pairs_of, placed_towards
from relit.fit.registration.photos.poses import (
    HOPELESS,
    Schedule,
    best_refined,
    coarse_model,
    fit_with_free_poses,
    gauge,
    polish,
    pose_towards,
    poses_from_hints,
)
from relit.fit.registration.register import (
    TURNS,
    Crop,
    Gallery,
    crop_rings,
    crop_views,
    directions_around,
    make_gallery,
    near,
    refine,
    search,
    turn_angles,
    views_from,
    volume_render,
)
from relit.geometry.hull import NoShape
from relit.geometry.se3 import rotation_from
from relit.rendering.appearance.light_per_photo import shade_plain

PARTS = (
    0.6,
    1.0,
    0.15,
    0.3,
)  # of register.PARTS: without hints decoration tells more than what is dark and what is bright
FEWEST = 6  # photos of a set that growth begins from
FASTER = 1.3  # by which the set grows each round
AROUND = 40.0  # degrees from viewpoints of the set within which others are trusted
ROLL = 30.0  # degrees by which photos may be out of upright, where those of the set are upright
# weight of that in the search: photos that were turned all the way cost four times as much
UPRIGHT = 0.03
ABOVE = 20.0  # degrees from which objects are photographed from above, most of the time
LEVELLED = 0.3  # mean of the photos' upward directions below which they have none in common


def upright(poses: np.ndarray) -> np.ndarray:
    """The poses (P, 4, 4) turned about the origin so that the pictures' own upward directions have
    +y as their mean: cameras are held upright more often than not, and tilts forward cancel over
    photos from all sides. Unchanged where the directions cancel, as for photos that are rolled at
    random."""
    mean = -poses[:, :3, 1].mean(0)
    length = float(np.linalg.norm(mean))
    if length < LEVELLED:
        return poses
    return similarity(rotation_from(mean / length, np.array([0.0, 1.0, 0.0])), np.zeros(3)) @ poses


def rolls(poses: np.ndarray) -> np.ndarray:
    """(P,) degrees in [0, 180] by which pictures are out of upright, +y being up."""
    ahead, down = poses[:, :3, 2], np.array([0.0, -1.0, 0.0])
    hanging = down - ahead * (ahead @ down)[:, None]
    cosine = (hanging * poses[:, :3, 1]).sum(1) / np.maximum(np.linalg.norm(hanging, axis=1), 1e-9)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def upright_prior(gallery: Gallery) -> np.ndarray:
    """(V, TURNS), added to scores: photos are upright to within ROLL degrees or so; next to the
    poles there is no upright."""
    seen = np.array([c.centre / np.linalg.norm(c.centre) for c in gallery.cameras])
    turn = np.degrees(turn_angles(np.arange(TURNS))) / ROLL
    return -UPRIGHT * (1 - seen[:, 1] ** 2)[:, None] * np.minimum(turn**2, 4)


def grow_set(
    crops: list[Crop],
    poses: np.ndarray,
    used: list[int],
    seed: int,
    say,
    rings,
    nodes: int = 48,
    steps: int = 150,
    views: int = 400,
):
    """Poses (P, 4, 4) and scores (P,) from the photos `used` on, whose poses are known roughly.
    Each round descends with their poses free, each under a light of its own, registers all photos
    in the model that comes of it, and takes more of them.

    Where the photos of the set are upright by and large, so are the others: most wrong matches are
    not."""
    count, sizes = len(crops), [len(used)] * 3
    while sizes[-1] < count:
        sizes.append(min(count, int(np.ceil(sizes[-1] * FASTER))))
    poses, scores = np.array(poses), np.zeros(count)
    for i, size in enumerate([*sizes, count]):
        poses[used] = upright(poses[used])
        hangs = bool(
            np.median(rolls(poses[used])) < ROLL
            and np.linalg.norm(poses[used][:, :3, 1].mean(0)) >= LEVELLED
        )
        some = [crops[k] for k in used]
        limit = depth_limit(some, gauge(some, poses[used]), nodes)
        if i == 0:
            model = coarse_model(some, gauge(some, poses[used]), nodes, steps, 0.2, seed, limit)
        else:
            model, moved = fit_with_free_poses(
                some, poses[used], nodes, steps, seed + i, None, limit
            )
            poses[used] = gauge(some, moved)
            model = replace(model, appearance=shade_plain)
        render = volume_render(model)
        gallery = make_gallery(render, views_from(directions_around(views, seed + i)), PARTS)
        centres = poses[used][:, :3, 3] / np.linalg.norm(
            poses[used][:, :3, 3], axis=1, keepdims=True
        )
        allowed = np.tile(near(gallery, centres, AROUND).any(0), (count, 1))
        prior = (
            np.broadcast_to(upright_prior(gallery), (count, len(gallery.cameras), TURNS))
            if hangs
            else None
        )
        found = search(crops, gallery, 1, rings=rings, allowed=allowed, prior=prior)
        poses, scores = refine(
            crops,
            found.poses[:, 0],
            render,
            rings=rings,
            steps=(0, 4.0, 2.0) if i else (0,),
            parts=PARTS,
        )
        poses = gauge(crops, poses)
        used = sorted(np.argsort(-scores)[:size].tolist())
        say(
            f"grown from a set: {len(used)} of {count} photos, mean score {scores[used].mean():.3f}",
            poses,
            scores,
        )
    return poses, scores


def grow_photos(
    crops: list[Crop],
    first: int,
    sizes: list[int],
    seed: int,
    say,
    rings=None,
    nodes: int = 40,
    above: float | None = None,
):
    """Poses (P, 4, 4) and scores (P,) from one photo on: round i registers all photos and keeps the
    sizes[i] best for the next model.
    above: degrees from which the first photo is taken to look down; all are then taken to be
    upright. None: nothing is known of either."""
    rings = crop_rings(crops, PARTS) if rings is None else rings
    height = np.radians(above or 0.0)
    poses = np.array(
        [pose_towards(c, np.array([0.0, np.sin(height), np.cos(height)])) for c in crops]
    )
    used, scores = [first], np.zeros(len(crops))
    anchor = poses[first]
    for i, size in enumerate(sizes):
        some = [crops[k] for k in used]
        centres = np.array([poses[k][:3, 3] / np.linalg.norm(poses[k][:3, 3]) for k in used])
        spread = np.degrees(np.arccos(np.clip((centres @ centres[used.index(first)]).min(), -1, 1)))
        camera = crop_views([crops[first]], anchor[None])[0]
        limit = (
            inflated_occupancy(crops[first], camera, nodes, 1 + spread / 40)
            if spread < ONE_SIDE
            else None
        )
        tolerance = 0.4 if len(used) < 5 else 0.2 if i < len(sizes) - 2 else 0.12
        model = coarse_model(
            some, poses[used], nodes, 60 if len(used) < 10 else 90, tolerance, seed + i, limit
        )
        render = volume_render(model)
        gallery = make_gallery(render, views_from(directions_around(400, seed + i)), PARTS)
        seen = near(gallery, centres, 55).any(0)
        prior = (
            None
            if above is None
            else np.broadcast_to(upright_prior(gallery), (len(crops), len(gallery.cameras), TURNS))
        )
        found = search(
            crops, gallery, 1, rings=rings, allowed=np.tile(seen, (len(crops), 1)), prior=prior
        )
        poses, scores = found.poses[:, 0], found.scores[:, 0]
        if i >= 4:
            poses, scores = refine(
                crops, poses, render, rings=rings, steps=(0, 4.0, 2.0), parts=PARTS
            )
        poses = gauge(crops, poses)
        used = sorted(set(np.argsort(-scores)[:size].tolist()) | {first})
        say(
            f"grown from photo {first}: {len(used)} of {len(crops)} photos, mean score {scores[used].mean():.3f}",
            poses,
            scores,
        )
        anchor = poses[first]
    return poses, scores


def find_poses(
    crops,
    directions,
    degrees: float,
    schedule: Schedule,
    keep: int,
    starts: int,
    without,
    seed: int,
    say,
    cycles: int = 0,
    linked=None,
    soft=False,
):
    """Poses (P, 4, 4) and scores (P,), from hints where half of the photos have them, else by
    growth. cycles: of `polish` after that.
    without: names of `collection.WITHOUT`. linked: (poses, scores, held) of
    `collection_links.poses_from_links`, which then come first.
    soft: see `poses_from_hints`."""
    hinted = (np.linalg.norm(directions, axis=1) > 0.5).mean()
    few = len(crops) < FEW and cycles > 0
    if "search" in without:
        front = np.array([0.0, 0.0, 1.0])
        poses = [
            pose_towards(c, d if d.any() else front) for c, d in zip(crops, directions, strict=True)
        ]
        return np.array(poses), np.ones(len(crops))

    def tell(text, *_):
        say(text)

    if few and linked is None and hinted == 1:
        return few_from_hints(
            crops,
            directions,
            degrees,
            schedule,
            keep,
            seed,
            tell,
            cycles,
            soft if keep > 1 else None,
        )
    if (
        few and linked is None and hinted < 0.5 and len(crops) < 2 * FEWEST
    ):  # of more, pairs may hold enough together to begin with
        poses, scores = few_by_growth(crops, starts, keep, seed, tell, cycles)
        return upright(poses), scores
    held = None
    if linked is not None:
        poses, scores, held = linked
    elif hinted >= 0.5:
        poses, scores = poses_from_hints(
            crops, directions, degrees, schedule, seed, tell, keep, soft if keep > 1 else None
        )
    else:
        poses, scores = poses_by_growth(crops, starts, keep, seed, tell)
    if cycles > 0:
        poses, scores = polish(
            crops, poses, directions, degrees, keep, seed, tell, cycles, held, limited=few
        )
    return (poses if hinted >= 0.5 else upright(poses)), scores


def poses_by_growth(crops: list[Crop], starts: int, keep: int, seed: int, say):
    """Grow from a set that pairs hold together. Where it is too small grow from several photos for
    a few rounds, and go on with the one that agrees best, and settle with all photos."""
    rings, count = crop_rings(crops, PARTS), len(crops)
    placed = (
        largest_consistent_set(pairs_of(crops, rings, PARTS, seed), count)
        if count >= 2 * FEWEST
        else {}
    )
    if len(placed) >= FEWEST:
        say(f"pairs hold {len(placed)} of {count} photos together")
        poses = np.array([placed_towards(c, placed.get(k, np.eye(3))) for k, c in enumerate(crops)])
        return grow_set(crops, poses, sorted(placed), seed, say, rings)
    first = start_photos(crops, rings, starts)
    early = sorted({min(count, max(3, round(count * f))) for f in (0.07, 0.1, 0.14, 0.2)})
    tried = []
    for photo in first:
        state = grow_photos(crops, photo, early, seed, say, rings)
        tried.append((float(np.mean(np.sort(state[1])[-early[-1] :])), photo))
    score, best = max(tried)
    if score < HOPELESS:
        raise NoShape(
            f"from none of {len(tried)} photos could a shape be grown that others agree with (best score {score:.2f})"
        )
    late = [
        min(count, max(3, round(count * f)))
        for f in (0.07, 0.1, 0.14, 0.2, 0.27, 0.37, 0.47, 0.57, 0.75, 1, 1, 1)
    ]
    poses, scores = grow_photos(crops, best, late, seed, say, rings)
    return settle_photos(crops, poses, scores, rings, keep, seed, say)


def few_by_growth(crops: list[Crop], starts: int, keep: int, seed: int, say, cycles: int):
    """Poses (P, 4, 4) and scores (P,) of few photos: grown to the end from each of `starts` photos,
    and the best way taken."""
    rings, count, none = crop_rings(crops, PARTS), len(crops), np.zeros((len(crops), 3))
    sizes = [min(count, size) for size in (2, 3, 4, 5, 6, 8, 10, 13, 17)]
    sizes = (
        [*sizes[: sizes.index(count) + 1], count, count]
        if count in sizes
        else [*sizes, count, count]
    )

    def grown_from(photo: int):
        poses, _ = settle_photos(
            crops,
            *grow_photos(crops, photo, sizes, seed, say, rings, above=ABOVE),
            rings,
            keep,
            seed,
            say,
            limited=True,
        )
        return polished(crops, poses, none, 45.0, keep, seed, say, cycles)

    ways = {
        f"grown from photo {k}": lambda k=k: grown_from(k)
        for k in start_photos(crops, rings, starts)
    }
    return best_way(crops, ways, seed, say)


def start_photos(crops: list[Crop], rings, count: int) -> list[int]:
    """Photos to start from: seen large and unlike each other, by the descriptors' own distances."""
    from relit.fit.registration.register import all_scores

    alike = all_scores(rings, rings).max(2)
    chosen = [int(np.argsort(-alike.mean(1))[0])]  # the one most like the others
    while len(chosen) < min(count, len(crops)):
        gain = alike.mean(1) - 0.7 * alike[:, chosen].max(1)
        gain[chosen] = -np.inf
        chosen.append(int(gain.argmax()))
    return chosen


def settle_photos(
    crops: list[Crop],
    poses: np.ndarray,
    scores: np.ndarray,
    rings,
    keep: int,
    seed: int,
    say,
    rounds: int = 3,
    limited=False,
):
    """A few rounds with all photos and no restriction on the viewpoints; the best on average
    counts, be it the beginning: a handful of photos is worse off without restriction. limited: see
    `depth_limit`."""
    best = (float(scores.mean()), poses, scores)
    for i in range(rounds):
        limit = depth_limit(crops, gauge(crops, poses), 48) if limited else None
        model = coarse_model(crops, gauge(crops, poses), 48, 120, 0.12, seed + 100 + i, limit)
        render = volume_render(model)
        gallery = make_gallery(render, views_from(directions_around(500, seed + 100 + i)), PARTS)
        found = search(crops, gallery, keep, rings=rings)
        poses, scores = best_refined(
            crops, found, render, rings, keep if i == rounds - 1 else 1, parts=PARTS
        )
        say(f"settling, round {i + 1} of {rounds}: mean score {scores.mean():.3f}", poses, scores)
        if scores.mean() > best[0]:
            best = (float(scores.mean()), poses, scores)
    return gauge(crops, best[1]), best[2]

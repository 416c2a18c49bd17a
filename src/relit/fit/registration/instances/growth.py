"""Poses of identical objects by growth: from the pair that looks most alike, one instance after
another is registered against a coarse model of those that stand already.

A place that leads clearly over every other one is nearly always right (`lead`). So such instances
join first, as in incremental structure from motion, and each that joins makes the model better for
the next; where none leads, one joins unsure of its place.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from relit.conventions import similarity
from relit.fit.registration.instances.bodies import CoarseBody, body_of
from relit.fit.registration.instances.lookahead import branch_values
from relit.fit.registration.instances.mirror_plane import flipped_views
from relit.fit.registration.instances.options import Growth
from relit.fit.registration.instances.views import InstanceView, eyes_at, first_pose
from relit.fit.registration.register import (
    Crop,
    Rings,
    chosen_rings,
    directions_around,
    refine,
    search,
    views_from,
)
from relit.geometry.se3 import rotation_angle

ANOTHER = 25.0  # degrees from which on a pose is another one
TRUST = 1.0  # of what becomes of the others, in the lead of the one that joins
FEW = 4  # members; fewer than that, which do not tell a plane of symmetry, need larger leads
# members for each further one that may join unsure of its place at the same time: one does not
# spoil a model of many
AT_ONCE = 12


def viewing_directions(poses: np.ndarray) -> np.ndarray:
    """Unit vectors (N, 3) from the object's middle to the cameras."""
    c = poses[:, :3, 3]
    return c / np.linalg.norm(c, axis=1, keepdims=True)


@dataclass(frozen=True)
class Grown:
    """What growth has given. poses: (N, 4, 4), scores: (N,) of all instances. firm: those that
    stood or joined before the first that was not sure of its place. unsure: those that were not."""

    poses: np.ndarray
    scores: np.ndarray
    firm: tuple[int, ...]
    unsure: tuple[int, ...]


def grow_instances(
    views: list[InstanceView],
    crops: list[Crop],
    rings: Rings,
    parts,
    members: list[int],
    poses: np.ndarray,
    o: Growth,
    *,
    seed: int = 0,
    links=(),
    rng=None,
) -> Grown:
    """All instances, grown from `members`, whose entries of `poses` count.

    links: ((i, j, rotation of i onto j in the photo), ...) from matching, tried beside the guesses
    of the search. rng: draws who joins where none is sure; without it the best score does. Raises
    NoShape where the silhouettes of the members have nothing in common.
    """
    poses, scores = np.array(poses, np.float64), np.full(len(views), -1.0)
    flipped = flipped_views(views, parts)
    members, expelled, turn = list(members), Counter(), 0
    firm, unsure = list(members), []
    body: CoarseBody | None = None
    while True:
        turn += 1
        some, cameras = (
            [views[k] for k in members],
            views_from(directions_around(o.viewpoints, seed + turn), eyes_at(poses[members])),
        )
        body = body_of(
            some,
            poses[members],
            cameras,
            parts,
            o,
            steps=o.steps,
            seed=seed,
            pictures=flipped.of(members),
            plane=body and body.plane,
        )
        own = chosen_rings(rings, members)
        poses[members], scores[members] = refine(
            [crops[k] for k in members],
            body.poses,
            body.render,
            rings=own,
            steps=(0, 4.0, 2.0),
            parts=parts,
        )
        if len(members) > 2:
            level = np.median(scores[members]) - o.astray
            astray = [k for k in members if scores[k] < level and expelled[k] < 2]
            expelled.update(astray)
            members = [k for k in members if k not in astray]
        rest = [k for k in range(len(views)) if k not in members]
        if not rest:
            return Grown(
                poses, scores, tuple(dict.fromkeys(k for k in firm if k in members)), tuple(unsure)
            )  # some left and came back
        places, heights = registered(
            views, crops, rings, parts, body, poses, members, rest, o, links
        )
        best = heights.argmax(0)
        margins = lead(places, heights)
        order = sorted(range(len(rest)), key=lambda i: -margins[i])
        few = body.plane is None and len(members) < FEW
        join = [i for i in order if margins[i] >= (o.sure_of_few if few else o.sure)][
            : max(1, len(members) // 2)
        ]
        leap = not join
        if leap:
            place, first = ahead(
                views,
                crops,
                rings,
                parts,
                members,
                poses,
                rest,
                places,
                heights,
                o,
                seed + turn,
                rng,
                flipped,
                body.plane,
            )
            best[first] = place
            others = [i for i in np.argsort(-heights.max(0)).tolist() if i != first]
            join = [first, *others[: len(members) // AT_ONCE]]
        joined = [rest[i] for i in join]
        unsure = [k for k in unsure if k not in joined] + (
            joined if leap else []
        )  # some come back, and are sure then
        firm += [] if unsure else joined
        for i, k in zip(join, joined, strict=True):
            poses[k], scores[k] = places[best[i], i], heights[best[i], i]
            members.append(k)


def lead_over_second(places: np.ndarray, heights: np.ndarray, chosen: int) -> float:
    """By how much one of the places (K, 4, 4) of an instance scores better than the best that is
    ANOTHER degrees away from it or more."""
    away = [rotation_angle(places[chosen, :3, :3].T @ p[:3, :3]) >= ANOTHER for p in places]
    return float(heights[chosen] - max([*heights[away], 0.0]))


def lead(places: np.ndarray, heights: np.ndarray) -> np.ndarray:
    """(R,) by how much the best of the places (K, R, 4, 4) of each scores better than the best one
    that is ANOTHER degrees away from it or more; heights: (K, R) their scores."""
    return np.array(
        [
            lead_over_second(places[:, i], heights[:, i], best)
            for i, best in enumerate(heights.argmax(0))
        ]
    )


def ahead(
    views,
    crops,
    rings: Rings,
    parts,
    members,
    poses,
    rest,
    places,
    heights,
    o: Growth,
    seed: int,
    rng,
    flipped=None,
    plane=None,
) -> tuple[int, int]:
    """(place, instance of `rest`) after which all others agree best (see `branch_values`), with
    what it leads by itself, of the `o.ahead` whose scores are best; an rng draws, the likelier the
    better."""
    order = np.argsort(-heights, axis=None)[: o.ahead]
    found = [at for at in order if heights.flat[at] > -1] or order[:1]
    tried = [
        (int(place), int(i))
        for place, i in zip(*np.unravel_index(found, heights.shape), strict=True)
    ]
    if len(rest) == 1 or o.effort.over:
        return tried[0]
    branches = []
    for place, i in tried:
        joined = poses.copy()
        joined[rest[i]] = places[place, i]
        branches.append(([*members, rest[i]], joined))
    value = branch_values(views, crops, rings, parts, branches, o, seed, flipped, plane)
    value = value + TRUST * np.array(
        [lead_over_second(places[:, i], heights[:, i], place) for place, i in tried]
    )
    if rng is not None:
        value = value + o.leap * rng.gumbel(size=len(value))
    return tried[int(value.argmax())]


def registered(
    views,
    crops,
    rings: Rings,
    parts,
    body: CoarseBody,
    poses,
    members: list[int],
    rest: list[int],
    o: Growth,
    links,
):
    """Places (K, R, 4, 4) of `rest` against the model of `members` and their scores (K, R): what
    all viewpoints show and links say."""
    theirs, some = chosen_rings(rings, rest), [crops[k] for k in rest]
    # not look_for: what is hidden in part would fit early, and wrongly
    found = search(some, body.gallery, keep=o.keep, rings=theirs, apart=ANOTHER)
    tries = [found.poses[:, j] for j in range(o.keep)]
    told = linked_poses(views, poses, members, rest, links, eyes_at(poses[members]))
    if told:
        tries.append(np.array([told.get(k, tries[0][i]) for i, k in enumerate(rest)]))
    refined = [
        refine(some, start, body.render, rings=theirs, steps=(0, 5.0, 2.5), parts=parts)
        for start in tries
    ]
    return np.array([poses for poses, _ in refined]), np.array([height for _, height in refined])


def linked_poses(
    views, poses, members: list[int], rest: list[int], links, distance: float
) -> dict[int, np.ndarray]:
    """Poses of those of `rest` that a link joins with a member, each in the middle of its
    silhouette."""
    out = {}
    for i, j, turn in (*links, *((j, i, turn.T) for i, j, turn in links)):
        if i in members and j in rest and j not in out:
            out[j] = linked_pose(views[j], poses[i], turn, distance)
    return out


def linked_pose(
    view: InstanceView, pose: np.ndarray, turn: np.ndarray, distance: float
) -> np.ndarray:
    """Pose of `view`, in the middle of its silhouette, turned in the photo by `turn` against an
    instance in `pose`."""
    own = pose[:3, :3] @ turn.T
    return similarity(own, own @ first_pose(view, distance)[:3, 3])

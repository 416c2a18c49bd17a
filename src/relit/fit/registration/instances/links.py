"""Sets of instances that matching has linked, for the search to begin from.

Matches of a pattern that repeats, as on both sides of a teapot, tell a turn that is wrong by what
the pattern repeats by; and a model of who stands right and who stands wrong is a third object,
which others then fit either way. So a set is asked first whether its silhouettes and its paint bear
the links out.
"""

from __future__ import annotations

import numpy as np

from relit.fit.registration.instances.bodies import body_of
from relit.fit.registration.instances.growth import (
    ANOTHER,
    lead_over_second,
    linked_pose,
    registered,
)
from relit.fit.registration.instances.lookahead import Branch
from relit.fit.registration.instances.options import Growth
from relit.fit.registration.instances.views import InstanceView, eyes_at, first_pose
from relit.fit.registration.register import Crop, Rings, directions_around, views_from
from relit.geometry.hull import NoShape
from relit.geometry.se3 import rotation_angle

ALIKE = 15.0  # degrees within which links tell the same turn
ASKED = 8  # members of a set that are asked, at most: those that are seen best


def linked_sets(views, links, distance: float) -> list[Branch]:
    """Sets of instances that links of matching join, the largest first: each begins with a link,
    and who joins has links to two members or more that tell the same turn. A link whose instances a
    set holds is not begun from again."""
    either = [*links, *((j, i, turn.T) for i, j, turn in links)]
    sets: list[Branch] = []
    for first, second, turn in links:
        if any({first, second} <= set(members) for members, _ in sets):
            continue
        poses = np.tile(np.eye(4), (len(views), 1, 1))
        poses[first] = first_pose(views[first], distance)
        poses[second] = linked_pose(views[second], poses[first], turn, distance)
        members = [first, second]
        for k in range(len(views)):
            ways = [
                linked_pose(views[k], poses[i], r, distance)
                for i, j, r in either
                if j == k and i in members and k not in members
            ]
            if len(ways) > 1 and all(
                rotation_angle(ways[0][:3, :3].T @ w[:3, :3]) < ALIKE for w in ways[1:]
            ):
                poses[k] = ways[0]
                members.append(k)
        sets.append((members, poses))
    return sorted(sets, key=lambda one: -len(one[0]))


def verified_links(
    views: list[InstanceView],
    crops: list[Crop],
    rings: Rings,
    parts,
    linked: Branch,
    links,
    o: Growth,
    seed: int,
) -> Branch:
    """The set as it is where most of its members, each asked against a model of the others, stand
    clearly best where links have them (by `o.sure`); its first link alone where they do not. Sets
    of two are not asked: who joins them tells."""
    members, poses = linked
    asked = sorted(members, key=lambda k: -views[k].seen * views[k].mask.sum())[:ASKED]
    if len(members) < 3 or 2 * sum(
        leads_there(views, crops, rings, parts, linked, k, links, o, seed) for k in asked
    ) > len(asked):
        return linked
    return members[:2], poses


def leads_there(
    views, crops, rings: Rings, parts, linked: Branch, k: int, links, o: Growth, seed: int
) -> bool:
    """Whether member k stands where links have it by the model of the others, and every other place
    scores less by `o.sure`."""
    members, poses = linked
    rest = [j for j in members if j != k]
    cameras = views_from(directions_around(o.viewpoints, seed), eyes_at(poses[rest]))
    try:
        body = body_of(
            [views[j] for j in rest], poses[rest], cameras, parts, o, steps=o.steps, seed=seed
        )
    except NoShape:
        return False
    now = poses.copy()
    now[rest] = body.poses
    places, heights = registered(views, crops, rings, parts, body, now, rest, [k], o, links)
    best = int(heights[:, 0].argmax())
    there = rotation_angle(places[best, 0, :3, :3].T @ poses[k][:3, :3]) < ANOTHER
    return bool(there and lead_over_second(places[:, 0], heights[:, 0], best) >= o.sure)

"""Which photos of a collection were taken from where, told by pairs: the beginning of growth when
nothing is known.

Each photo alone gives a rough solid, its inflated silhouette; every other photo is registered
against it. Most of what that finds is wrong. But where two photos find each other in the same
relation, most is right, and a set of photos held together by many such pairs is a beginning that a
shape can grow from.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from relit.conventions import similarity
from relit.fit.registration.photos.depth import inflated_occupancy
from relit.fit.registration.photos.poses import coarse_model, distance_for, pose_towards
from relit.fit.registration.register import (
    AHEAD,
    Crop,
    crop_views,
    directions_around,
    make_gallery,
    search,
    views_from,
    volume_render,
)
from relit.geometry.hull import NoShape
from relit.geometry.se3 import nearest_rotation

FRONT = np.array([0.0, 0.0, 1.0])  # where the one photo of a rough solid looks from
REACH = 57.0  # degrees from there up to which the solid is looked at
MOST = 80  # photos that become solids, so that a large collection takes no longer
NEAR = 25.0  # degrees within which two rotations say the same
CLOSE = 20.0  # the same for the places that several pairs give one photo
# pairs per photo that are trusted, the best ones: of the 60 best of 60 photos nine in ten were
# right, of the 100 best seven
PAIRS = 1.35
KEPT = 3  # hypotheses of each photo against each solid


@dataclass(frozen=True)
class RelativePose:
    """rotation: (3, 3) axes of camera `first` from those of camera `second`. score: mean of both
    registrations."""

    score: float
    first: int
    second: int
    rotation: np.ndarray


def angles(rotations: np.ndarray) -> np.ndarray:
    """Degrees of rotations (..., 3, 3)."""
    return np.degrees(np.arccos(np.clip((np.trace(rotations, axis1=-2, axis2=-1) - 1) / 2, -1, 1)))


def pairs_of(crops: list[Crop], rings, parts, seed: int, nodes: int = 40) -> list[RelativePose]:
    """Pairs of photos that find each other in the same relation, best first. rings: of the crops,
    made with `parts`."""
    count = len(crops)
    solids = np.sort(np.random.default_rng(seed).permutation(count)[:MOST])
    directions = directions_around(300, seed)
    views = views_from(directions[directions @ FRONT > np.cos(np.radians(REACH))])
    scores, rotations = (
        np.full((count, count, KEPT), -1.0),
        np.tile(np.eye(3), (count, count, KEPT, 1, 1)),
    )
    for i in solids:
        pose = pose_towards(crops[i], FRONT)
        camera = crop_views([crops[i]], pose[None])[0]
        try:
            model = coarse_model(
                [crops[i]],
                pose[None],
                nodes,
                60,
                0.4,
                seed,
                inflated_occupancy(crops[i], camera, nodes, 1.0),
            )
        except NoShape:  # next to nothing is left of a thin silhouette
            continue
        found = search(crops, make_gallery(volume_render(model), views, parts), KEPT, rings=rings)
        scores[i], rotations[i] = found.scores, pose[:3, :3].T @ found.poses[..., :3, :3]
    return mutual_pairs(scores, rotations)


def mutual_pairs(scores: np.ndarray, rotations: np.ndarray) -> list[RelativePose]:
    """scores: (P, P, K), rotations: (P, P, K, 3, 3), of photo j in the solid of photo i. The pairs
    whose two registrations say the same."""
    out = []
    for i in range(len(scores)):
        for j in range(i + 1, len(scores)):
            there, back = rotations[i, j], rotations[j, i]
            same = angles(np.einsum("kab,lbc->klac", there, back)) < NEAR
            both = np.where(
                same & (scores[i, j][:, None] > 0) & (scores[j, i] > 0),
                0.5 * (scores[i, j][:, None] + scores[j, i]),
                -1,
            )
            k, m = np.unravel_index(both.argmax(), both.shape)
            if both[k, m] > 0:
                out.append(
                    RelativePose(float(both[k, m]), i, j, nearest_rotation(there[k] + back[m].T))
                )
    return sorted(out, key=lambda pair: -pair.score)


def largest_consistent_set(pairs: list[RelativePose], count: int) -> dict[int, np.ndarray]:
    """The largest set of photos that the best pairs hold together: {photo: (3, 3) rotation, world
    from camera}. count: of all photos.

    From each photo on, the one joins next whose place most pairs agree upon; from the fourth on two
    must. The set whose pairs agree most counts.
    """
    trusted = pairs[: max(6, round(PAIRS * count))]
    if not trusted:
        return {}
    least = trusted[-1].score - 0.01
    links: dict[int, list[tuple[int, np.ndarray, float]]] = {}
    for p in trusted:
        links.setdefault(p.first, []).append((p.second, p.rotation, p.score - least))
        links.setdefault(p.second, []).append((p.first, p.rotation.T, p.score - least))
    sets = [_joined(links, first) for first in sorted(links)]
    worth = [sum((p.score - least) * _holds(p, s) for p in trusted) for s in sets]
    best = sets[int(np.argmax(worth))]
    for _ in range(5):
        for photo in best:
            places = [best[other] @ turn.T for other, turn, _ in links[photo] if other in best]
            places = [r for r in places if angles(best[photo].T @ r) < NEAR]
            best[photo] = nearest_rotation(np.sum(places, 0)) if places else best[photo]
    return best


def _holds(pair: RelativePose, placed: dict[int, np.ndarray]) -> bool:
    if pair.first not in placed or pair.second not in placed:
        return False
    return bool(angles(placed[pair.first].T @ placed[pair.second] @ pair.rotation.T) < NEAR)


def _joined(links, first: int) -> dict[int, np.ndarray]:
    placed = {first: np.eye(3)}
    while True:
        best = None
        for photo in sorted({other for p in placed for other, _, _ in links[p]} - placed.keys()):
            told = [
                (placed[other] @ turn.T, w) for other, turn, w in links[photo] if other in placed
            ]
            places, weights = np.array([t[0] for t in told]), np.array([t[1] for t in told])
            same = angles(np.einsum("aji,bjk->abik", places, places)) < CLOSE
            held = same @ weights
            at = int(held.argmax())
            if (best is None or held[at] > best[0]) and same[at].sum() >= (
                1 if len(placed) < 4 else 2
            ):
                best = (
                    held[at],
                    photo,
                    nearest_rotation((places * (weights * same[at])[:, None, None]).sum(0)),
                )
        if best is None:
            return placed
        placed[best[1]] = best[2]


def placed_towards(crop: Crop, rotation: np.ndarray) -> np.ndarray:
    """model_from_photo (4, 4): the photo with this rotation (3, 3), the silhouette's middle at the
    origin."""
    ahead = np.asarray(crop.camera.world_from_camera)[:3, :3] @ AHEAD
    return similarity(rotation, -distance_for(crop) * (rotation @ ahead))

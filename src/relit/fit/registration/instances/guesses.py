"""Guesses for pairs of identical objects: every silhouette is inflated to a crude model, and every
other object registered against it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from relit.fit.registration.instances.growth import ANOTHER, viewing_directions
from relit.fit.registration.instances.options import COLOURFUL, DETAILED, Search
from relit.fit.registration.instances.views import (
    InstanceView,
    albedo_render,
    first_pose,
    fit_model,
    inflate_silhouette,
)
from relit.fit.registration.register import (
    crop_rings,
    directions_around,
    make_galleries,
    search,
    views_from,
)


@dataclass(frozen=True)
class Guesses:
    """What inflated instances say of the others under one descriptor. poses: (S, N, K, 4, 4)
    object_from_camera of instance j in the model of instance chosen[s]; scores: (S, N, K), -1 for
    itself."""

    poses: np.ndarray
    scores: np.ndarray

    @property
    def margins(self) -> np.ndarray:
        """(S, N) by how much the best guess of a pair is better than the next; -1 for itself. It
        tells right guesses better than the score, which an object that looks like a disc from every
        side has anywhere."""
        first, second = self.scores[..., 0], self.scores[..., 1]
        return np.where(first > -1, first - np.maximum(second, 0), -1.0)


def pair_guesses(
    views: list[InstanceView], crops, chosen: list[int], o: Search, distance: float, seed: int, say
) -> dict[tuple, Guesses]:
    """Guesses under each of two descriptors (DETAILED, COLOURFUL): every chosen instance is
    inflated to a model, and every other one is registered against it, `o.keep` ways."""
    rings = {parts: crop_rings(crops, parts) for parts in (DETAILED, COLOURFUL)}
    shape = (len(chosen), len(views), o.keep)
    out = {
        parts: Guesses(np.tile(np.eye(4), (*shape, 1, 1)), np.full(shape, -1.0)) for parts in rings
    }
    directions = directions_around(o.viewpoints, seed)
    for s, k in enumerate(chosen):
        pose = first_pose(views[k], distance)
        o.effort.spend(o.steps)
        model, _ = fit_model(
            [views[k]], pose[None], inflate_silhouette(views[k], pose, o.nodes), o.steps, seed=seed
        )
        close = directions @ viewing_directions(pose[None])[0] >= np.cos(np.radians(o.cone))
        cameras = views_from(directions[close], max(2.0, distance))
        galleries = make_galleries(albedo_render(model), cameras, out)
        for gallery, (parts, guesses) in zip(galleries, out.items(), strict=True):
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

"""Flat lids of a visual hull: the space under a seat, in a box or a shelf, which no silhouette
shows.

Silhouettes close such a space with a flat face from rim to rim, and the volume pass does not leave
it (see hollows.py). There the lid of a cup is found where the photos are explained badly; a lid in
deep shade is dark, and nothing of it is explained badly. So here every large
flat face of the hull is asked: what lies under it, but for a wall along all other skin, is taken
away, the shape is fitted for as long as without, and stays open if the rays that meet the face are
then clearly better explained. A solid face loses by it.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.ndimage import (
    binary_dilation,
    distance_transform_edt,
    gaussian_filter,
    label,
    uniform_filter,
)

from relit.fit.passes.optimiser import NoStage
from relit.fit.passes.pixels import PixelBank
from relit.fit.passes.ray_errors import RayErrors, ray_errors
from relit.fit.passes.volume import VolumeModel
from relit.fit.shape.hollows import (
    HollowOptions,
    briefly_fitted,
    left_without,
    nearest_node,
    skin_of,
)
from relit.geometry.hull import distance_of
from relit.geometry.sdf import node_positions, resample
from relit.scene import Camera

FIRST = HollowOptions(nodes=64, steps=200, gain=0.05, least=150)  # all faces are asked so,
THEN = HollowOptions(
    nodes=96, steps=400, gain=0.2
)  # and those that gain by it again: only finer grids tell a hollow from a gloss
FLAT = 0.9  # cosine between normals of one face
THICK = 1.5  # voxels from the plane of a face
SEEDS = 60  # faces are grown from so many places at most
# the hull of fewer is made of facets of their silhouettes' cones, which the volume pass wears down
# by itself
PHOTOS = 24
RAYS = 500  # of the probes must meet a face that is asked


def open_lids(
    bank: PixelBank,
    cameras: list[Camera],
    values: np.ndarray,
    start: Callable[[np.ndarray], VolumeModel],
    say: Callable[[str], None],
    seed: int = 0,
    faces: int = 3,
    first: HollowOptions = FIRST,
    then: HollowOptions = THEN,
    progress: Callable[[int], None] | None = None,
) -> np.ndarray | None:
    """What is to be taken away from a visual hull: (n, n, n) distances, negative in the hollows, or
    None where there are none.

    values: (n, n, n) distances of the hull, n = first.nodes. cameras: unit frame. start: distances
    -> a fresh model of the capture kind.
    faces: how many are asked, the largest first. progress: told how many steps of all trials are
    over.
    """
    if len(cameras) < PHOTOS:
        return None
    stage, whole, hull = NoStage(progress), values, values < 0
    some = cameras[:: max(1, len(cameras) // 40)]

    def errors(v: np.ndarray, o: HollowOptions):
        return ray_errors(bank, briefly_fitted(bank, start(v), o, stage, seed), o.probes, seed)

    known: dict[int, RayErrors] = {}  # errors of the shape as it is, by nodes

    def change(trial: np.ndarray, mouth: np.ndarray, o: HollowOptions):
        """What the error of the rays that meet the mouth is multiplied by, in the mean or the
        median, whichever falls less; the errors."""
        old, new = (v if o is first else resample(v, o.nodes) for v in (values, trial))
        if o.nodes not in known:
            known[o.nodes] = errors(old, o)
        now = known[o.nodes]
        rays = now.hit & binary_dilation(mouth).ravel()[nearest_node(now.x, first.nodes)]
        if rays.sum() < RAYS:
            return np.inf, None
        found = errors(new, o)
        return max(
            f(found.value[rays]) / max(f(now.value[rays]), 1e-12) for f in (np.mean, np.median)
        ), found

    asked = [
        (lid, found) for lid in flat_faces(values) if (found := opened_at(hull, lid, some, first))
    ]
    for lid, found in sorted(asked, key=lambda pair: -pair[1][1].sum())[:faces]:
        opened = found if values is whole else opened_at(values < 0, lid, some, first)
        if opened is None:
            continue
        gain, coarse = change(*opened, first)
        if gain > 1 - first.gain:
            continue
        gain, fine = change(*opened, then)
        if gain > 1 - then.gain:
            continue
        values, known = opened[0], {first.nodes: coarse, then.nodes: fine}
        say(
            f"a hollow is opened that no silhouette shows: the error of the photos there falls to {gain:.0%}"
        )
    gone = hull & (values >= 0)
    return distance_of(gone) if gone.any() else None


def opened_at(
    inside: np.ndarray, lid: np.ndarray, cameras: list[Camera], o: HollowOptions
) -> tuple[np.ndarray, np.ndarray] | None:
    """Distances of a shape that is opened through a flat face, and the part of the face that is
    gone; None where nothing can be opened. No deeper than the radius of the mouth: little further
    in is seen, and a small dent would cost the whole inside."""
    trial = left_without(inside, lid & inside, skin_of(inside) & ~lid, cameras, o)
    if trial is None:
        return None
    mouth = lid & (trial >= 0)
    gone = inside & (trial >= 0) & (distance_transform_edt(~mouth) <= np.sqrt(mouth.sum() / np.pi))
    return (distance_of(inside & ~gone), mouth) if gone.sum() >= o.least else None


def flat_faces(values: np.ndarray) -> list[np.ndarray]:
    """Flat pieces (n, n, n) bool of the skin of a shape given by distances, grown from the flattest
    places first."""
    n = values.shape[0]
    inside = values < 0
    skin = skin_of(inside)
    smooth = gaussian_filter(values, 1.0)
    normal = np.stack(np.gradient(smooth)[::-1], -1)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
    weight = uniform_filter(skin.astype(np.float32), 5)
    mean = np.stack(
        [uniform_filter(np.where(skin, normal[..., c], 0).astype(np.float32), 5) for c in range(3)],
        -1,
    )
    flatness = np.where(skin, np.linalg.norm(mean, axis=-1) / np.maximum(weight, 1e-6), -1)
    position, h = node_positions(n), 2.0 / (n - 1)
    free, faces = skin.copy(), []
    for _ in range(SEEDS):
        at = np.unravel_index(np.argmax(np.where(free, flatness, -1)), skin.shape)
        if not free[at]:
            break
        direction = mean[at] / max(np.linalg.norm(mean[at]), 1e-9)
        level = np.abs((position - position[at]) @ direction) < THICK * h
        parts, _ = label(skin & level & (normal @ direction > FLAT), np.ones((3, 3, 3)))
        face = parts == parts[at] if parts[at] else np.zeros_like(skin)
        faces.append(face & free)
        free &= ~binary_dilation(face, iterations=1)
        free[at] = False
    return [face for face in faces if face.sum() > 4]

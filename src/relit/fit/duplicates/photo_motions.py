"""Several photos of one pile: how the photos stand to each other, told by the poses of the
instances in each.

In COLMAP's words an instance is a frame of a rig and a photo one of its sensors: what leads from
one photo to another is the same for every instance. Each photo's instances are registered like
those of one photo, all together against one model. Two poses of one instance in two photos give the
whole motion between them, so the motion that brings most instances of one photo onto those of
another is the right one; then all of them are brought to agree. One object in several photos is the
same case with one instance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from relit.conventions import similarity
from relit.geometry.se3 import nearest_rotation, rotation_angle

TURNED = 15.0  # degrees within which two poses of one instance agree
# unit lengths within which they do: objects are about 0.85 in radius and do not stand in one
# another
APART = 0.6
DEPTH = 12.0  # times as uncertain along the line of sight as across


@dataclass(frozen=True)
class SharedScene:
    """What several photos show together. motions: for each photo first_from_photo (4, 4), or None
    where it could not be related. standing: (K, 4, 4) first_from_object of the instances. of_view:
    (N,) which of them each view shows, -1 for views of photos without a motion."""

    motions: list
    standing: np.ndarray
    of_view: np.ndarray


def motion_or_none(motion: np.ndarray | None) -> np.ndarray:
    """The motion, or none at all where it is not known."""
    return np.eye(4) if motion is None else motion


def gather(standing: np.ndarray, photo: np.ndarray) -> SharedScene:
    """The scene of views at photo_from_object `standing` (N, 4, 4), from photos number `photo`
    (N,). The first photo's frame is the scene's."""
    standing, photo = np.asarray(standing, np.float64), np.asarray(photo)
    count = int(photo.max()) + 1
    motions: list = [np.eye(4) if p == 0 else None for p in range(count)]
    of_view = np.full(len(standing), -1)
    of_view[photo == 0] = np.arange((photo == 0).sum())
    known = [standing[k] for k in np.flatnonzero(photo == 0)]
    waiting = [p for p in range(1, count) if (photo == p).any()]
    while waiting:
        tried = {
            p: motion_of([standing[k] for k in np.flatnonzero(photo == p)], known) for p in waiting
        }
        best = max(waiting, key=lambda p: len(tried[p][1]))
        motion, pairs = tried[best]
        if motion is None:
            break
        waiting.remove(best)
        motions[best] = motion
        rows = np.flatnonzero(photo == best)
        for i, k in enumerate(rows):
            if i in pairs:
                of_view[k] = pairs[i]
            else:
                of_view[k] = len(known)
                known.append(motion @ standing[k])
    return SharedScene(motions, agreed(standing, photo, motions, of_view, len(known)), of_view)


def motion_of(
    theirs: list[np.ndarray], known: list[np.ndarray]
) -> tuple[np.ndarray | None, dict[int, int]]:
    """(known_from_theirs (4, 4), {number in theirs: number in known}) from poses of instances in
    two photos; (None, {}) where no motion brings two instances onto two others. A single instance
    that both show is enough."""
    best, pairs = None, {}
    least = 1 if len(theirs) == len(known) == 1 else 2
    error = np.inf
    for a in theirs:
        for b in known:
            found, off = matched(b @ np.linalg.inv(a), theirs, known)
            if len(found) >= least and (len(found), -off) > (len(pairs), -error):
                best, pairs, error = b @ np.linalg.inv(a), found, off
    for _ in range(3 if best is not None else 0):
        best = motion_from([theirs[i] for i in pairs], [known[j] for j in pairs.values()])
        found, _ = matched(best, theirs, known)
        if len(found) < len(pairs):
            break
        pairs = found
    return best, pairs


def matched(motion: np.ndarray, theirs, known) -> tuple[dict[int, int], float]:
    """Pairs that `motion` brings together, each instance once, and their mean distance."""
    scored = []
    for i, a in enumerate(theirs):
        moved = motion @ a
        for j, b in enumerate(known):
            away = float(np.linalg.norm(moved[:3, 3] - b[:3, 3]))
            if away < APART and rotation_angle(moved[:3, :3].T @ b[:3, :3]) < TURNED:
                scored.append((away, i, j))
    pairs: dict[int, int] = {}
    total = 0.0
    for away, i, j in sorted(scored):
        if i not in pairs and j not in pairs.values():
            pairs[i] = j
            total += away
    return pairs, total / max(len(pairs), 1)


def motion_from(a: list[np.ndarray], b: list[np.ndarray]) -> np.ndarray:
    """The rigid motion (4, 4) that carries poses `a` onto poses `b` best: by their turns and by
    where they stand."""
    x, y = np.array([m[:3, 3] for m in a]), np.array([m[:3, 3] for m in b])
    turns = sum(q[:3, :3] @ p[:3, :3].T for p, q in zip(a, b, strict=True))
    turn = nearest_rotation(turns + (y - y.mean(0)).T @ (x - x.mean(0)))
    return similarity(turn, y.mean(0) - turn @ x.mean(0))


def agreed(standing, photo, motions, of_view, count: int) -> np.ndarray:
    """(count, 4, 4) poses in the first photo's frame: means over the views of an instance, each
    trusted less along its line of sight."""
    out = np.tile(np.eye(4), (count, 1, 1))
    for n in range(count):
        left, right, turn = np.zeros((3, 3)), np.zeros(3), np.zeros((3, 3))
        for k in np.flatnonzero(of_view == n):
            m = motions[photo[k]] @ standing[k]
            ray = m[:3, 3] - motions[photo[k]][:3, 3]
            ray /= np.linalg.norm(ray)
            trust = np.eye(3) - (1 - 1 / DEPTH**2) * np.outer(ray, ray)
            left, right, turn = left + trust, right + trust @ m[:3, 3], turn + m[:3, :3]
        out[n] = similarity(nearest_rotation(turn), np.linalg.solve(left, right))
    return out

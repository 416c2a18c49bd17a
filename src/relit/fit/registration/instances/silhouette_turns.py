"""Turns of instances by which their silhouettes are of one body.

Each instance stands as it does, or turned by one of a few turns about an axis of the object. What
lies inside all silhouettes must fill each of them (silhouette coherence, Hernandez et al. 2007): a
spout that others say is not there leaves a gap. A node of a grid is seen at the same pixel of a
view whatever the others do, so looking it up once for each turn of each view makes a set of turns
cheap to judge.
"""

from __future__ import annotations

import cv2
import numpy as np

from relit.fit.registration.instances.views import InstanceView, nearest_pixels
from relit.geometry.sdf import node_positions

NODES, FINE = 64, 96  # a side; of poses that are exact
STRICT = 0.02  # share of the views that may show background where the body is
STARTS, FEWEST = (
    12,
    2,
    # sets of turns that are descended from, all but the first drawn; fewer of many views, down to these
)
ASKED = 120  # turns of single views, of all sets together in one sweep
SWEEPS = 8  # of each descent, at most


class Silhouettes:
    """Views at poses (N, 4, 4), each under the motions (S, 4, 4) of the object, of which the first
    leaves it as it is."""

    def __init__(
        self, views: list[InstanceView], poses: np.ndarray, motions: np.ndarray, nodes: int = NODES
    ):
        p = node_positions(nodes).reshape(-1, 3)
        p = p[(p**2).sum(1) < 0.98]
        self.views, self.count = views, len(motions)
        self.kernels = [
            closing(v, float(np.linalg.norm(pose[:3, 3])), nodes)
            for v, pose in zip(views, poses, strict=True)
        ]
        shape = (len(views), len(motions), len(p))
        self.pixel, self.told, self.out = (
            np.zeros(shape, np.int32),
            np.zeros(shape, bool),
            np.zeros(shape, bool),
        )
        for k, (view, pose) in enumerate(zip(views, poses, strict=True)):
            for s, motion in enumerate(motions):
                u, v, ok = nearest_pixels(view.camera.with_pose(motion @ pose), p)
                self.pixel[k, s] = v * view.mask.shape[1] + u
                self.told[k, s] = view.known[v, u] > 0.5
                self.out[k, s] = ~(ok & (view.mask[v, u] > 0.3)) & self.told[k, s]

    def sums(self, turns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """For each node the views that tell of it, and those that show background there."""
        own = np.arange(len(self.views))
        return self.told[own, turns].sum(0), self.out[own, turns].sum(0)

    def gap(self, turns: np.ndarray) -> float:
        """Mean over the views of the share, of silhouette and body together, that one of the two
        lacks; turns: (N,) the motion of each."""
        return float(np.mean(self.gaps(turns, *self.sums(turns))))

    def gaps(self, turns: np.ndarray, told: np.ndarray, out: np.ndarray) -> list[float]:
        inside, found = np.flatnonzero((told > 0) & (out <= STRICT * told)), []
        for k, view in enumerate(self.views):
            body = np.zeros(view.mask.size, np.uint8)
            body[self.pixel[k, turns[k], inside]] = 1
            body = (
                cv2.morphologyEx(body.reshape(view.mask.shape), cv2.MORPH_CLOSE, self.kernels[k])
                > 0
            )
            own, known = view.mask > 0.5, view.known > 0.5
            found.append(((own ^ body) & known).sum() / max(((own | body) & known).sum(), 1))
        return found

    def descended(self, turns: np.ndarray) -> tuple[float, np.ndarray]:
        """(gap, turns) where no other turn of a single view leaves less; the first view stays."""
        turns, (told, out) = turns.copy(), self.sums(turns)
        best = float(np.mean(self.gaps(turns, told, out)))
        for _ in range(SWEEPS):
            before = best
            for k in range(1, len(turns)):
                for s in set(range(self.count)) - {int(turns[k])}:
                    other = turns.copy()
                    other[k] = s
                    there = (
                        told - self.told[k, turns[k]] + self.told[k, s],
                        out - self.out[k, turns[k]].astype(int) + self.out[k, s],
                    )
                    value = float(np.mean(self.gaps(other, *there)))
                    if value < best:
                        turns, best = other, value
                        told, out = there
            if best == before:
                break
        return best, turns

    def most_coherent(self, seed: int) -> tuple[float, np.ndarray]:
        """(gap, turns (N,)) with the smallest gap that descents from the views as they are and from
        drawn turns come to."""
        rng, n = np.random.default_rng(seed), len(self.views)
        count = int(np.clip(ASKED // (n * max(1, self.count - 1)), FEWEST, STARTS))
        starts = [np.zeros(n, int)] + [
            np.concatenate([[0], rng.integers(0, self.count, n - 1)]) for _ in range(count - 1)
        ]
        return min((self.descended(s) for s in starts), key=lambda one: one[0])


def closing(view: InstanceView, distance: float, nodes: int) -> np.ndarray:
    """What closes the pixels between the nodes of a grid of so many a side, seen from that
    distance."""
    apart = int(np.ceil(2 / (nodes - 1) * view.camera.fx / distance))
    return np.ones((2 * (apart // 2 + 1) + 1,) * 2, np.uint8)

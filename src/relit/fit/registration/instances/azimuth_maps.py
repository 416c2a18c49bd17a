"""Turns of identical bodies about their axes, from what comes to lie on what when their maps are
shifted.

What each shows is a map around the axis (fit/registration/instances/unrolled.py: paint;
fit/registration/instances/protrusions.py: what sticks out). Two maps of one object then differ by a
shift. All shifts are sought together, with the seats of each
(fit/registration/instances/revolution_fit.py): a map is laid where it adds most to the evidence
that its readings and those that lie there already are of one thing.

What one more reading adds to the evidence of a cell is a sum of products, of what the reading is
and of what lies there. So what a map adds under all shifts is a few circular correlations along the
turn, which are products of Fourier transforms.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.fft import irfft, rfft

from relit.conventions import similarity

SWEEPS = 4  # in which each is laid again


@dataclass(frozen=True)
class Evidence:
    """That the readings of a cell are of one thing: a function E of their number n and their total.

    features: values (C,) of readings -> (K, C). gains: number and total (...) in each cell -> (K,
    ...), such that the sum over K of features(v) gains(n, total) is E(n + 1, total + v) - E(n,
    total)."""

    features: Callable[[np.ndarray], np.ndarray]
    gains: Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Cells:
    """What a view in a seat shows of the map. row, column: (C,) of its cells, the columns evenly
    around the axis. values: (C,), what was read there. spectrum: (K, R, F), the features of the
    readings times what they count, transformed along the turn."""

    row: np.ndarray
    column: np.ndarray
    values: np.ndarray
    spectrum: np.ndarray


def cells_read(
    evidence: Evidence, shape: tuple[int, int], row, column, values: np.ndarray, weights: np.ndarray
) -> Cells:
    """weights: (C,), what the readings count: a cell near the axis is small. shape: rows and
    columns of the map."""
    told = evidence.features(values) * weights
    features = np.zeros((len(told), *shape))
    features[:, row, column] = told
    return Cells(row, column, values, rfft(features))


@dataclass
class Board:
    """What has been laid down: number and total of the readings in each cell, (R, T). spectrum: (K,
    R, F) of what further ones gain, None where it is not known."""

    evidence: Evidence
    count: np.ndarray
    total: np.ndarray
    spectrum: np.ndarray | None = None

    def lay(self, cells: Cells, turn: int, sign: int = 1) -> None:
        at = cells.row, (cells.column + turn) % self.count.shape[1]
        self.count[at] += sign
        self.total[at] += sign * cells.values
        self.spectrum = None

    def gains(self, cells: Cells) -> np.ndarray:
        """(T,) of the evidence, for every shift."""
        if self.spectrum is None:
            self.spectrum = rfft(self.evidence.gains(self.count, self.total))
        return irfft((cells.spectrum.conj() * self.spectrum).sum((0, 1)), self.count.shape[1])

    def best(self, seats: list[Cells]) -> tuple[float, int, int]:
        """Gain, seat and turn of a view's best place."""
        gains = [self.gains(cells) for cells in seats]
        return max((float(g.max()), seat, int(g.argmax())) for seat, g in enumerate(gains))


@dataclass(frozen=True)
class AzimuthEstimate:
    """What maps tell. poses: (N, 4, 4) with seat and turn put in. sure: (N,) bool, whose turn leads
    clearly over all others."""

    poses: np.ndarray
    sure: np.ndarray


def empty_board(evidence: Evidence, shape: tuple[int, int]) -> Board:
    return Board(evidence, np.zeros(shape), np.zeros(shape))


def laid(
    views: list[list[Cells]],
    first: int,
    group: list[int],
    evidence: Evidence,
    shape: tuple[int, int],
) -> tuple[float, np.ndarray, np.ndarray]:
    """(evidence, seats (N,), turns (N,)): the view `first`, then those of the group, each time the
    one that gains most, then all others; and sweeps in which each is laid again."""
    board, seat, turn = (
        empty_board(evidence, shape),
        np.zeros(len(views), int),
        np.zeros(len(views), int),
    )
    level = float(board.gains(views[first][0])[0])
    board.lay(views[first][0], 0)

    def put(k, found):
        seat[k], turn[k] = found[1:]
        board.lay(views[k][seat[k]], turn[k])

    rest = [k for k in group if k != first]
    while rest:
        found = {k: board.best(views[k]) for k in rest}
        k = max(rest, key=lambda k: found[k][0])
        level += found[k][0]
        put(k, found[k])
        rest.remove(k)
    others = [k for k in range(len(views)) if k not in group and k != first]
    for k in others:
        found = board.best(views[k])
        level += found[0]
        put(k, found)
    for _ in range(SWEEPS):
        before = level
        for k in range(len(views)):
            cells = views[k][seat[k]]
            board.lay(cells, turn[k], -1)
            level -= board.gains(cells)[turn[k]]
            found = board.best(views[k])
            level += found[0]
            put(k, found)
        if level - before < 1e-6 * abs(before):
            break
    return level, seat, turn


def best_laid(
    views: list[list[Cells]], group: list[int], evidence: Evidence, shape: tuple[int, int]
) -> tuple[float, np.ndarray, np.ndarray]:
    """(evidence, seats (N,), turns (N,)) of `laid` from the best first one of the group. shape:
    rows and columns of the map."""
    return max((laid(views, k, group, evidence, shape) for k in group), key=lambda one: one[0])


def leads_of(
    views: list[list[Cells]],
    seat: np.ndarray,
    turn: np.ndarray,
    evidence: Evidence,
    shape: tuple[int, int],
    apart: float,
) -> np.ndarray:
    """(N,) by how much the evidence of each view, all others laid, is larger than in any other
    seat, or turned by `apart` degrees or more."""
    board, out = empty_board(evidence, shape), []
    for cells, i, t in zip(views, seat, turn, strict=True):
        board.lay(cells[i], t)
    for cells, i, t in zip(views, seat, turn, strict=True):
        board.lay(cells[i], t, -1)
        gains = [board.gains(one) for one in cells]
        own, count = gains[i][t], len(gains[i])
        away = (
            np.abs((np.arange(count) - t + count // 2) % count - count // 2) * 360 / count >= apart
        )
        gains[i] = gains[i][away]
        out.append(own - max(g.max() for g in gains))
        board.lay(cells[i], t)
    return np.array(out)


def turned_about(pose: np.ndarray, angle: float) -> np.ndarray:
    """The pose with the object turned about its axis, by radians."""
    c, s = np.cos(angle), np.sin(angle)
    about = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    return similarity(about @ pose[:3, :3], about @ pose[:3, 3])

"""What a figure is worth: the score of the best constant map on the same pixels, and the score of
random rotations under the same protocol.

A map of one value has no texture, no gloss map and no metal. A material figure that does not beat
the best such map carries no information about the material.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

Baselines = dict[str, tuple[float, str]]  # figure -> (value, definition)

CONSTANT = (
    "the same figure of the best constant: the one value per channel, chosen with the truth at "
    "hand, that minimises this figure's own error over all views, on the same pixels"
)
CHANCE = (
    "the same figure, expected for uniformly random rotations under the same protocol: mean of {} "
    "draws with a fixed seed"
)
DRAWS = 20  # the median of 10 instances varies by about 10 degrees a draw; its mean by 2
ROUNDS = 50  # of the fixed point below, which converges in about 10


@dataclass(frozen=True)
class Moments:
    """Means per channel over the pixels of one view: a a, a t, t t (C,), of the truth t and the
    coverage a that a constant is multiplied with (1 inside a mask)."""

    aa: np.ndarray
    at: np.ndarray
    tt: np.ndarray


def moments_of(truth, where=None, coverage=None) -> Moments:
    """Of one view's truth (H, W) or (H, W, C). where: (H, W) bool, the pixels that count, default
    all. coverage: (H, W) of the constant, default 1."""
    t = np.asarray(truth, np.float64)
    t = t[..., None] if t.ndim == 2 else t
    a = np.ones(t.shape[:2]) if coverage is None else np.asarray(coverage, np.float64)
    keep = np.ones(t.shape[:2], bool) if where is None else np.asarray(where, bool)
    t, a = t[keep], a[keep][:, None]
    return Moments(np.repeat((a * a).mean(0), t.shape[-1]), (a * t).mean(0), (t * t).mean(0))


def best_constant(views: list[Moments], psnr: bool) -> tuple[np.ndarray, float]:
    """(constant (C,), figure). The figure is the mean over views of the PSNR (peak 1, at most 100
    dB), or of the mean squared error.

    The mean of logarithms has its optima where each view is weighted with the inverse of its own
    error: a fixed point, iterated from the least-squares solution and from each view's own best
    constant, since there may be several; the best is kept.
    """
    aa, at, tt = (np.array([getattr(v, name) for v in views]) for name in ("aa", "at", "tt"))

    def errors(constant: np.ndarray) -> np.ndarray:
        squares = aa * constant**2 - 2 * at * constant + tt
        return np.maximum(squares.mean(1), 0.0)

    least = at.sum(0) / np.maximum(aa.sum(0), 1e-30)
    if not psnr:
        return least, float(errors(least).mean())
    found = []
    for start in (least, *(at / np.maximum(aa, 1e-30))):
        constant = start
        for _ in range(ROUNDS):
            weight = 1 / np.maximum(errors(constant), 1e-12)[:, None]
            constant = (weight * at).sum(0) / np.maximum((weight * aa).sum(0), 1e-30)
        values = np.minimum(100.0, -10 * np.log10(np.maximum(errors(constant), 1e-12)))
        found.append((float(values.mean()), constant))
    value, constant = max(found, key=lambda f: f[0])
    return constant, value


@dataclass(frozen=True)
class Constants:
    """Collects the truth of material figures view by view; `baselines` gives the best constants'
    scores. Figures whose name has 'psnr' are PSNRs, all others mean squared errors."""

    views: dict[str, list[Moments]] = field(default_factory=dict)

    def add(self, figure: str, truth, where=None, coverage=None) -> None:
        """One view's truth in the space in which the figure compares; see `moments_of`. Views
        without a pixel are left out."""
        if where is None or np.any(where):
            self.views.setdefault(figure, []).append(moments_of(truth, where, coverage))

    def baselines(self) -> Baselines:
        """figure -> (score of the best constant, CONSTANT)."""
        return {
            name: (best_constant(views, "psnr" in name)[1], CONSTANT)
            for name, views in self.views.items()
        }


def random_rotations(count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, 3, 3) uniformly distributed rotations."""
    return Rotation.from_quat(rng.normal(size=(count, 4))).as_matrix()


def chance(
    figures: Callable[[np.random.Generator], Mapping[str, float]],
    draws: int = DRAWS,
    seed: int = 0,
) -> Baselines:
    """figure -> (mean over draws, CHANCE). figures(rng): the protocol's figures of one draw."""
    rng = np.random.default_rng(seed)
    drawn = [figures(rng) for _ in range(draws)]
    text = CHANCE.format(draws)
    return {name: (float(np.mean([d[name] for d in drawn])), text) for name in drawn[0]}

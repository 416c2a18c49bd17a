"""The only optimisation loop, and the only optimiser."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np


class Adam:
    """Adam (Kingma & Ba 2015) on one flat Dr.Jit array, with a step that may change without
    compiling a new kernel."""

    def __init__(self, size: int, beta1: float = 0.9, beta2: float = 0.99, floor: float = 0.0):
        """floor: adds floor * mean(v) to each entry's second moment, so that entries whose gradient
        is small noise stay where they are (plain Adam moves them as fast as any other)."""
        self.floor = floor
        # arrays in memory, not literal zeros: the first step runs the kernels of all others
        self.m, self.v = dr.opaque(mi.Float, 0.0, size), dr.opaque(mi.Float, 0.0, size)
        self.beta1, self.beta2, self.t = beta1, beta2, 0

    def step(self, parameter, gradient, rate: float, ratio=1.0):
        """The next value of `parameter` (Float, same size). rate: largest move of one entry per
        step, times `ratio` (1 or Float)."""
        self.t += 1
        b1, b2 = self.beta1, self.beta2
        size = dr.opaque(mi.Float, rate / (1 - b1**self.t))
        correction = dr.opaque(mi.Float, 1 / (1 - b2**self.t))
        self.m = b1 * self.m + (1 - b1) * gradient
        self.v = b2 * self.v + (1 - b2) * dr.square(gradient)
        second = self.v
        if self.floor > 0:
            dr.eval(self.m, self.v)
            second = self.v + self.floor * dr.mean(self.v)
        out = parameter - size * ratio * self.m / (dr.sqrt(second * correction) + 1e-12)
        dr.schedule(out, self.m, self.v)
        return out


@dataclass
class Variable:
    """One array that a fit optimises: where its value is, how fast it moves.

    The value is the attribute `attribute` of `owner` (Float). rate: step -> largest move of an
    entry; None where the owner moves it by other means than Adam, and only its gradient is wanted.
    ratio: factor on the rate, 1 or Float, entry by entry. floor: see `Adam`. until: step from which
    on it stays fixed, None for never. kept: whether a checkpoint holds it.
    """

    name: str
    owner: Any
    attribute: str
    rate: Callable[[int], float] | None = None
    ratio: Any = 1.0
    floor: float = 0.0
    until: int | None = None
    kept: bool = True
    adam: Adam | None = field(init=False, default=None)

    def __post_init__(self):
        if self.rate is not None:
            self.adam = Adam(dr.width(self.value), floor=self.floor)

    @property
    def value(self):
        return getattr(self.owner, self.attribute)

    def moves(self, i: int) -> bool:
        """Whether it is optimised in step i."""
        return self.until is None or i < self.until

    def step(self, i: int, gradient) -> None:
        """Take Adam's step i, where it is Adam that moves the value."""
        if self.adam is not None and self.rate is not None:
            new = self.adam.step(dr.detach(self.value), gradient, self.rate(i), self.ratio)
            setattr(self.owner, self.attribute, new)

    def restore(self, saved: Mapping[str, np.ndarray]) -> None:
        """Take the value from a checkpoint."""
        if self.kept:
            setattr(self.owner, self.attribute, mi.Float(saved[self.name]))


def memory(rng, adam: dict[str, Adam]) -> dict[str, np.ndarray]:
    """What a checkpoint keeps beside the parameters, so that a fit goes on as if it had not been
    stopped: the state of the random numbers (PCG32) and the moments of each optimiser."""
    out = {"rng": np.array(rng.state)}
    for name, a in adam.items():
        out |= {f"{name}_m": np.array(a.m), f"{name}_v": np.array(a.v), f"{name}_t": np.array(a.t)}
    return out


def recall(saved: dict[str, np.ndarray] | None, rng, adam: dict[str, Adam]) -> None:
    """Put back what `memory` kept. What a checkpoint does not hold begins anew."""
    if not saved:
        return
    if "rng" in saved and len(saved["rng"]) == dr.width(rng.state):
        rng.state = mi.UInt64(saved["rng"])
    for name, a in adam.items():
        if f"{name}_t" in saved and len(saved[f"{name}_m"]) == dr.width(a.m):
            a.m, a.v, a.t = (
                mi.Float(saved[f"{name}_m"]),
                mi.Float(saved[f"{name}_v"]),
                int(saved[f"{name}_t"]),
            )


class NoStage:
    """Stands where a stage of a run is asked for: nothing is kept but the losses of the last steps.
    Fits that have it one after the other tell `shown` how many steps they have taken together."""

    def __init__(self, shown: Callable[[int], None] | None = None):
        self.shown, self.steps, self.losses = shown, 0, deque(maxlen=50)

    def mean_loss(self, name: str) -> float:
        """Of the last 50 steps."""
        return float(np.mean([losses[name]() for losses in self.losses]))

    def load(self, name):
        return None

    def save(self, name, **arrays):
        pass

    def step(self, i, **losses):
        self.steps += 1
        self.losses.append(losses)
        if self.shown is not None:
            self.shown(self.steps)

    def checkpoint_due(self):
        return False

    def preview_due(self):
        return False

    def preview(self, picture):
        pass


def cosine_decay(e: float, final: float) -> float:
    """1 at e = 0, `final` at e = 1."""
    import math

    return final + (1 - final) * 0.5 * (1 + math.cos(math.pi * min(max(e, 0.0), 1.0)))


def run_steps(
    stage,
    first: int,
    last: int,
    step: Callable[[int], dict],
    save: Callable[[], dict] | None = None,
    name: str = "checkpoint",
    preview: Callable[[], Any] | None = None,
):
    """Call step(i) for i in [first, last), report its losses, save a checkpoint when one is due,
    and a picture, `preview`, now and then."""
    for i in range(first, last):
        losses = step(i)
        stage.step(i + 1, **{name: (lambda v=value: float(v[0])) for name, value in losses.items()})
        if preview is not None and (i == first or i + 1 == last or stage.preview_due()):
            stage.preview(preview)
        if save is not None and stage.checkpoint_due():
            stage.save(name, step=i + 1, **save())

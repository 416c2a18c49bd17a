"""A recipe: how one kind of capture is reconstructed, and what the command line says about it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from relit.run import Run
from relit.scene import Asset, Capture


@dataclass(frozen=True)
class ObjectCost:
    """How the cost grows with the number of identical objects in a photo.

    measured_with: objects that the recipe's cost was measured with. seconds, memory: what one more
    adds, as shares of that cost.
    """

    measured_with: int
    seconds: float
    memory: float


@dataclass(frozen=True)
class Recipe:
    """How one kind of capture is reconstructed.

    name: the kind, as `--capture` knows it. light: the light that is assumed, a sentence for
    `relit inspect`. options: quality ('draft', 'standard', 'high') -> the recipe's options, a flat
    frozen dataclass. run: (capture, run, options, seed) -> the asset; stages that are done are read
    back. stages: their names, in order. cost: quality -> (seconds, peak bytes) on 2 cores with 60
    photos of 400 x 400 pixels, cold start. finds_cameras: whether photos without cameras come as
    they are; otherwise structure from motion runs first. min_photos: fewer are refused.
    object_cost: see `ObjectCost`. ablations: names that `without` takes -> what the part brings.
    """

    name: str
    light: str
    options: Callable[[str], Any]
    run: Callable[[Capture, Run, Any, int], Asset]
    stages: tuple[str, ...]
    cost: Mapping[str, tuple[float, float]]
    finds_cameras: bool = False
    min_photos: int = 3
    object_cost: ObjectCost | None = None
    ablations: Mapping[str, str] = field(default_factory=dict[str, str])


@dataclass(frozen=True)
class FitContext:
    """What every stage of a recipe needs. options: of the recipe."""

    run: Run
    options: Any
    seed: int

"""Settings of the search for poses of identical objects."""

from __future__ import annotations

from dataclasses import dataclass, field

# weights in fit.register's descriptors: decoration tells most, and of an object without it colour
DETAILED, COLOURFUL = (0.6, 1.0, 0.1, 0.6), (0.6, 2.0, 0.1)

STEPS = 100  # of a fit that counts as one model


class Effort:
    """Work of one search. limit: fits of STEPS steps after which nothing is begun any more that the
    poses can do without."""

    def __init__(self, limit: float = float("inf")):
        self.limit, self.spent = limit, 0.0

    def spend(self, steps: int) -> None:
        """Count a fit of so many steps."""
        self.spent += steps / STEPS

    @property
    def over(self) -> bool:
        return self.spent >= self.limit


@dataclass(frozen=True)
class Growth:
    """How a set of placed instances grows.

    nodes, steps, rate, depth: of the coarse models, as `Search`. tolerance: see `carved`; a body
    that is too fat agrees with wrong places as well, and with more of them at every turn. rays: of
    a step of a fit. viewpoints: all around. keep: places of each that are refined.
    sure: an instance whose best place scores by so much better than any other is nearly always
    right; while there are such, they join first. sure_of_few: the same, of two or three that stand
    and do not tell the plane of symmetry (fit/registration/instances/mirror_plane.py). ahead,
    ahead_steps, ahead_views: where there are none, so many ways to join are tried, each with a fit
    of so many steps and so many views of it (fit/registration/instances/lookahead.py). leap: spread
    of their values within which a draw decides, when instances are grown again.
    astray: a member whose score lies so much below the median is taken out again. effort: of the
    whole search.
    """

    nodes: int = 40
    steps: int = 100
    rate: float = 0.004
    depth: float = 2.5
    viewpoints: int = 600
    keep: int = 5
    astray: float = 0.15
    tolerance: float = 0.15
    rays: int = 2048
    ahead: int = 14
    ahead_steps: int = 40
    ahead_views: int = 300
    sure: float = 0.06
    sure_of_few: float = 0.1
    leap: float = 0.01
    effort: Effort = field(default_factory=Effort, compare=False)


@dataclass(frozen=True)
class Search:
    """How poses are searched.

    nodes, steps: of the coarse models, a side and of each fit. viewpoints: all around. cone:
    degrees from what a single instance has shown within which another can be recognised. models:
    instances that are inflated, at most. keep: guesses for each pair. pairs: that are tried by what
    becomes of the others (fit/registration/instances/lookahead.py). starts: of these that poses are
    grown from, at most, for each descriptor.
    leaps: share of the instances that may have been unsure of their places in what is believed.
    searches: of few instances, until two come to the same poses. regrowths, idle: times that
    instances are grown again where it is not, at most, and in a row without gain. rounds: of fit
    and search for all instances. descents, descent_rate: fits of shape and poses together that
    follow, and the step of the poses in them. rate: of the pose corrections in other coarse fits.
    depth: see `carved`. doubted, rounds_doubted: instances that are searched once more against a
    model of the others, and how often at most. late: descents that follow where one has moved, at
    most.
    """

    nodes: int = 40
    steps: int = 50
    viewpoints: int = 1500
    cone: float = 65.0
    models: int = 14
    keep: int = 2
    pairs: int = 8
    starts: int = 2
    leaps: float = 0.1
    searches: int = 3
    regrowths: int = 12
    idle: int = 5
    rounds: int = 1
    descents: int = 5
    descent_rate: float = 0.012
    rate: float = 0.004
    depth: float = 2.5
    doubted: int = 12
    rounds_doubted: int = 5
    late: int = 3
    growth: Growth = field(default_factory=Growth)

    @property
    def effort(self) -> Effort:
        """Of the whole search; growth counts on the same one."""
        return self.growth.effort

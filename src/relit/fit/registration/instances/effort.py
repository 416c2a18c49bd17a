"""How much a search for poses may do: an anytime search ends with the best that it has found.

Work is counted in fits of coarse models, which take most of the time, not in seconds: the same
photo gives the same poses on every machine.
"""

from __future__ import annotations

STEPS = 100  # of a fit that counts as one


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

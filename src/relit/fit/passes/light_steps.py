"""Steps of an environment map by cells of several widths at once.

A texel of the map is met by few of a step's samples, so that its gradient is mostly noise, and Adam
moves what is noise as fast as what is
not: dark and even parts end in coloured specks, most of all near the poles, where texels are
slivers. Over wider cells the same gradients add up to what they have in common. So each texel moves
with the cells that it lies in, and by itself more slowly.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from relit.fit.passes.optimiser import Adam
from relit.lighting.environment import cells_of_texels

SIDES = {4: 1.0, 2: 1.0, 1: 0.25}  # texels that a cell is wide: its share of the rate


class LightSteps:
    """Moves log radiance, Float [rows * 2 rows * 3], lat-long. adam: the optimisers, by name."""

    def __init__(self, rows: int):
        self.texels = 2 * rows * rows
        cells = {side: cells_of_texels(rows, 2 * rows, side) for side in SIDES}
        self.cells = {side: (mi.UInt32(cell), int(cell.max()) + 1) for side, cell in cells.items()}
        self.adam = {f"light_{side}": Adam(3 * count) for side, (_, count) in self.cells.items()}

    def step(self, log_light, gradient, rate: float):
        """The next log radiance. gradient: of the loss in it, the same size. rate: largest move of
        a cell of share 1."""
        texel = dr.arange(mi.UInt32, self.texels)
        pull = dr.gather(mi.Color3f, gradient, texel)
        moved = dr.gather(mi.Color3f, log_light, texel)
        for side, (cell, count) in self.cells.items():
            together = dr.zeros(mi.Float, 3 * count)
            dr.scatter_add(together, pull, cell)
            move = self.adam[f"light_{side}"].step(
                dr.zeros(mi.Float, 3 * count), together, rate * SIDES[side]
            )
            dr.eval(move)
            moved += dr.gather(mi.Color3f, move, cell)
        return dr.ravel(moved)

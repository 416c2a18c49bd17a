"""Sums over blocks of entries, such as the directions of each point, and the reverse: entries
repeated.

Dr.Jit evaluates what it sums, each array by itself: six sums of what one computation gives would
make it six times. Here all arrays are evaluated together first, or there is no sum.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def block_sums(values: tuple, count: int) -> tuple:
    """The sum of each `count` entries, of each of the values (Floats, or arrays of such);
    differentiable."""
    dr.eval(values)
    return tuple(_each(v, lambda c: dr.block_sum(c, count)) for v in values)


def repeat(values: tuple, count: int) -> tuple:
    """Each entry `count` times, of each of the values (Floats, or arrays of such); differentiable.
    The adjoint is a block sum, not a scatter."""
    return dr.custom(_RepeatOp, values, count)


def everywhere(kind, values, index: int, width: int):
    """Entry `index` of the flat `values` as an array of the given kind (Color3f counts in threes),
    `width` times; differentiable. With one index for all the adjoint would be a sum for each
    number; so it is a scatter."""
    return dr.gather(kind, values, dr.full(mi.UInt32, index, width))


class _RepeatOp(dr.CustomOp):
    """Dr.Jit glue: the adjoint has all gradients at once."""

    def eval(self, values, count):
        self.count = count
        return tuple(_each(v, lambda c: dr.repeat(c, count)) for v in values)

    def backward(self):
        self.set_grad_in("values", block_sums(self.grad_out(), self.count))

    def forward(self):
        raise NotImplementedError("repeated entries have a backward derivative only")

    def name(self):
        return "relit.repeat"


def _each(value, of):
    return of(value) if isinstance(value, mi.Float) else type(value)(*[of(c) for c in value])

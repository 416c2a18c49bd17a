"""The optimisation loop of the surface pass, for any light and material.

A step draws pixels and the surface points that they show, shades the points, and moves every
variable against the gradient of the loss. What is shaded, by which light and under which priors is
the `Terms` of a capture: one environment (fit/passes/surface.py), a light per photo
(fit/collection/surface.py), a flash beside the lens (fit/flash/surface.py).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from relit.fit.passes.optimiser import Adam, Variable, memory, recall, run_steps
from relit.fit.passes.pixels import PixelBank, batch_of, draw_pixels
from relit.fit.passes.preview import surface_preview
from relit.rendering.transport import Points, TraceableMesh, first_hits

LEAST_MASK = 0.99  # of a pixel that counts as all object
LEAST_COSINE = 0.1  # between a point's normal and the line of sight


class Terms(Protocol):
    """Material, light and priors of a surface pass."""

    bank: PixelBank
    mesh: TraceableMesh

    def variables(self) -> Sequence[Variable]:
        """All that is optimised, in the order in which they move."""
        ...

    def begin(self, i: int, rng: Any) -> Any:
        """The sample of step i: pixels, points and whatever is drawn without gradient."""
        ...

    def loss(self, i: int, sample: Any) -> tuple[Any, Any]:
        """(the data term, the whole loss), Floats of width 1."""
        ...

    def finish(self, i: int, sample: Any, gradients: Mapping[str, Any]) -> None:
        """After the variables have moved: projections, updates by other means than Adam."""
        ...

    def textures(self, uv: Any, valid: Any) -> list[Any]:
        """What the preview shows at texture coordinates."""
        ...

    def state(self) -> dict[str, np.ndarray]:
        """What a checkpoint keeps besides variables and optimisers."""
        ...

    def restore(self, saved: Mapping[str, np.ndarray]) -> None:
        """Inverse of `state`, before the first step; the variables are restored by then."""
        ...

    def optimisers(self) -> dict[str, Adam]:
        """Optimisers besides those of the variables."""
        ...


def run_surface(terms: Terms, steps: int, rng: Any, stage: Any) -> None:
    """Run the pass, from the stage's checkpoint where there is one. rng: PCG32, one state a
    point."""
    variables = terms.variables()
    optimisers = {v.name: v.adam for v in variables if v.adam is not None} | terms.optimisers()
    saved = stage.load("checkpoint")
    if saved:
        for variable in variables:
            variable.restore(saved)
        terms.restore(saved)
    recall(saved, rng, optimisers)

    def step(i: int) -> dict:
        sample = terms.begin(i, rng)
        moving = [v for v in variables if v.moves(i)]
        values = [v.value for v in moving]
        dr.enable_grad(*values)
        fit, loss = terms.loss(i, sample)
        dr.backward(loss)
        gradients = {v.name: dr.grad(value) for v, value in zip(moving, values, strict=True)}
        dr.disable_grad(*values)
        dr.eval(gradients, fit)
        for variable in moving:
            variable.step(i, gradients[variable.name])
        terms.finish(i, sample, gradients)
        return {"colour": fit}

    def state() -> dict:
        kept = {v.name: np.array(v.value) for v in variables if v.kept}
        return kept | terms.state() | memory(rng, optimisers)

    preview = surface_preview(terms.bank, terms.mesh, terms.textures)
    run_steps(stage, int(saved["step"]) if saved else 0, steps, step, state, preview=preview)


def drawn_points(
    bank: PixelBank, mesh: TraceableMesh, rng, count: int, draw: Callable = draw_pixels
):
    """`count` drawn pixels (RayBatch) and the surface they show (Points), valid where a pixel is
    all object and not seen too flat. draw: what draws them, called as `draw_pixels`."""
    pixel = draw(bank, rng, count)
    dr.eval(pixel, rng)
    batch = batch_of(bank, pixel)
    points = first_hits(mesh, batch.o, batch.d)
    facing = dr.dot(points.n, points.v) > LEAST_COSINE
    points.valid = points.valid & (batch.mask > LEAST_MASK) & facing
    dr.eval(points, batch.rgb)
    return batch, points


def neighbour_points(mesh: TraceableMesh, points: Points, reach: float, rng) -> Points:
    """For each point another one on the same stretch of surface, up to `reach` away (log-uniform in
    its tangent plane). Detached."""
    with dr.suspend_grad():
        phi = dr.two_pi * rng.next_float32()
        r = reach * dr.exp(-4 * rng.next_float32())
        frame = mi.Frame3f(points.n)
        offset = (frame.s * dr.cos(phi) + frame.t * dr.sin(phi)) * r
        return first_hits(mesh, points.x + offset + points.n * r, -points.n)

"""A mouth or a lid: what a body of revolution ends in, by the light of the place.

A lid with the paint of a hollow looks like the hollow in one view, and not in the others: light
falls into a hollow, its wall throws a shadow into it, its floor lies deeper than its rim. So the
surface pass is begun from both, shortly and coarsely, and the pixels that meet the mouth tell.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from relit.fit.duplicates.lit_pile import LitPile
from relit.fit.duplicates.vessels import End, body_axis, ends_of, hollowed, mouths
from relit.fit.passes.first_material import TRIAL, fewer_points
from relit.fit.passes.losses import dual_values
from relit.fit.passes.material_priors import SurfaceOptions
from relit.fit.passes.optimiser import NoStage
from relit.fit.passes.pixels import saturated_at
from relit.fit.passes.surface import (
    EnvironmentTerms,
    SurfaceModel,
    TexelStart,
    fit_surface,
    start_surface,
)
from relit.fit.passes.surface_loop import drawn_points
from relit.fit.registration.instances.views import InstanceView
from relit.geometry.atlas import unwrap
from relit.geometry.bake import rasterise_atlas
from relit.geometry.mesh import extract_mesh
from relit.geometry.revolution_axis import Axis
from relit.geometry.sdf import redistance
from relit.materials.field import material_at
from relit.rendering.transport import reflected, sample_lights
from relit.scene import Mesh

STEPS = 200  # of each fit, but at most half of those of the pass
FACES = 8000
GAIN = 0.2  # part of the error of the pixels that meet it which a mouth must take away
FLOORS = (
    0.0,
    0.2,
    0.4,
)  # how high the floor of a hollow may lie, of the way from the lowest place to the rim
BATCHES = 8  # of pixels that the fits are judged by
PIXELS = 200  # of them must meet a mouth that is asked


def vessel_of(
    values: np.ndarray,
    views: list[InstanceView],
    poses: np.ndarray,
    lit: Callable[[Mesh], LitPile],
    options: SurfaceOptions,
    say: Callable[[str], None],
    seed: int = 0,
    progress: Callable[[int], None] | None = None,
) -> np.ndarray | None:
    """Distances of a body of revolution with its ends cut off square, and hollow under each end
    that is a mouth; None where it is none, or its ends are as they should be. values: (n, n, n) of
    the shape so far. lit: the pile of instances of a mesh. options: of the surface pass."""
    axis = body_axis(extract_mesh(values))
    if axis is None:
        return None
    cameras = [v.camera.with_pose(p) for v, p in zip(views, poses, strict=True)]
    flat, ends = ends_of(values, axis, views, cameras)
    o = replace(
        options, steps=min(STEPS, options.steps // 2), light_cells=False, light_tint=0.0, **TRIAL
    )  # as GAIN was measured
    best, stage = flat, NoStage(progress)
    shape, closed, fitted = (
        flat,
        None,
        False,
    )  # what an end is asked of: as `best`, with the floor of a hollow where one of FLOORS has it
    for end in mouths(flat, axis, ends):
        hollows = [hollowed(values, shape, axis, end, raised) for raised in FLOORS]
        if any(h is None for h in hollows):
            continue
        closed = closed or TrialShape.of(shape, lit, o)
        lid = closed.texels_of(lid_of(closed.mesh, axis, end, 2 / (len(values) - 1)))
        if pixels_on_texels(closed, lid, o, seed) < PIXELS:
            continue
        if not fitted:
            closed.fit(o, stage, seed)
            fitted = True
        changes: list[float] = []
        for trial in hollows:
            opened = TrialShape.of(trial, lit, o)
            opened.fit(o, stage, seed)
            changes.append(change_of_error(closed, opened, lid, o, seed))
            if changes[0] > 1 - GAIN:
                break
            if changes[-1] == min(changes):
                likeliest = trial, opened
        else:
            say(
                f"the object is hollow under one end: the error of the photos there falls to {min(changes):.0%}"
            )
            shape, closed = likeliest
            deepened = hollowed(values, best, axis, end, lowest_of(changes))
            best = (
                shape if deepened is None else deepened
            )  # None: where another hollow lies deeper than in what was asked
    return redistance(best) if (best > values).any() else None


def lowest_of(changes: list[float]) -> float:
    """Where the parabola through what the FLOORS give is lowest, between the first and the last of
    them; the best one where it has no lowest point."""
    bend, slope, _ = np.polyfit(FLOORS, changes, 2)
    return (
        float(np.clip(-slope / (2 * bend), FLOORS[0], FLOORS[-1]))
        if bend > 0
        else FLOORS[int(np.argmin(changes))]
    )


@dataclass
class TrialShape:
    """A shape that is tried. mesh: of the object, with its atlas. face: (S, S), in which one each
    texel lies, -1 for none. pile: of its instances. model: of the surface pass."""

    mesh: Mesh
    face: np.ndarray
    pile: LitPile
    model: SurfaceModel

    @staticmethod
    def of(values: np.ndarray, lit: Callable[[Mesh], LitPile], o: SurfaceOptions) -> TrialShape:
        mesh, _ = unwrap(extract_mesh(redistance(values), faces=FACES), o.texture)
        pile, face = lit(mesh), rasterise_atlas(mesh, o.texture)[0]
        even = TexelStart(np.ones((*face.shape, 3), np.float32), face >= 0, pile.level)
        model = start_surface(even, o)
        return TrialShape(mesh, face, pile, model)

    def fit(self, o: SurfaceOptions, stage, seed: int) -> None:
        """A few steps of the surface pass, from one grey."""
        terms = EnvironmentTerms(
            self.pile.bank, self.pile.traced, self.model, fewer_points(o), seed
        )
        fit_surface(terms, stage)

    def texels_of(self, faces: np.ndarray) -> np.ndarray:
        """(S, S) bool: texels of faces (F,) bool."""
        return (self.face >= 0) & faces[np.maximum(self.face, 0)]

    def drawn(self, batch: int, o: SurfaceOptions, seed: int):
        """A batch of pixels, the same for every body, and what they show."""
        rng = mi.PCG32(size=o.points, initstate=seed * 7919 + 31 + batch)
        return *drawn_points(self.pile.bank, self.pile.traced, rng, o.points), rng

    def errors(self, batch, points, rng, o: SurfaceOptions) -> np.ndarray:
        """(N,) errors of display values of drawn pixels."""
        surface = material_at(self.model.material, points.uv, points.valid)
        dr.eval(surface.base, surface.roughness, surface.metallic)
        lights = sample_lights(
            self.pile.traced, points, surface, self.model.environment, o.directions, rng
        )
        a, b = reflected(points, lights, surface, self.model.environment)
        return np.array(dual_values(a, b, batch.rgb, saturated_at(self.pile.bank, batch.view)))


def lid_of(mesh: Mesh, axis: Axis, end: End, voxel: float) -> np.ndarray:
    """(F,) bool: faces of the flat end inside the rim."""
    middle = mesh.vertices[mesh.faces].mean(1)
    return (end.sign * axis.heights(middle) > end.height - voxel) & (
        axis.radii(middle) < end.radius - voxel
    )


def on_texels(points, texels: np.ndarray) -> np.ndarray:
    """(N,) bool: which points lie on texels (S, S) bool."""
    size = len(texels)
    u, v = np.clip((np.array(points.uv) * size).astype(int), 0, size - 1)
    return np.array(points.valid) & texels[v, u]


def pixels_on_texels(body: TrialShape, texels: np.ndarray, o: SurfaceOptions, seed: int) -> int:
    """How many pixels of all batches meet texels (S, S) bool."""
    return sum(
        int(on_texels(body.drawn(batch, o, seed)[1], texels).sum()) for batch in range(BATCHES)
    )


def change_of_error(
    closed: TrialShape, opened: TrialShape, lid: np.ndarray, o: SurfaceOptions, seed: int
) -> float:
    """What the error of the pixels that meet the lid, texels (S, S) bool of the closed one, is
    multiplied by when it is opened."""
    sums = np.zeros(2)
    for number in range(BATCHES):
        (batch, points, rng), (same, inside, other) = (
            closed.drawn(number, o, seed),
            opened.drawn(number, o, seed),
        )
        met = on_texels(points, lid) & np.array(inside.valid)
        sums += (
            closed.errors(batch, points, rng, o)[met].sum(),
            opened.errors(same, inside, other, o)[met].sum(),
        )
    return float(sums[1] / max(sums[0], 1e-12))

"""What each place of the object may be made of, before the surface pass begins: metal or paint,
glossy or dull.

Metal or not is a choice between two explanations of the same photos: colour that the surface
scatters, or colour that it reflects. Between them lies a barrier that a descent does not cross: a
metal that starts as paint ends as glossy paint under a wrong light. Roughness is much the same: a
dull surface that starts glossy keeps its highlights small and pays with the light. So the whole
object is fitted a few times, shortly and coarsely, from different sides, and each group of like
colours begins on the side that explains its pixels better.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.cluster.vq import kmeans2, vq

from relit.fit.passes.losses import dual_values
from relit.fit.passes.material_priors import SurfaceOptions
from relit.fit.passes.optimiser import NoStage
from relit.fit.passes.pixels import PixelBank, saturated_at
from relit.fit.passes.surface import EnvironmentTerms, TexelStart, fit_surface, start_surface
from relit.fit.passes.surface_loop import drawn_points
from relit.materials.field import material_at
from relit.rendering.transport import TraceableMesh, reflected, sample_lights

PAINT, METAL = 0.1, 0.9  # first metallic of the pass itself
DULL = 0.65  # first roughness of what is explained better so than with the usual first roughness
SIDES = (
    (PAINT, None),
    (0.5, None),
    (PAINT, DULL),
)  # first metallic and roughness (None: the options') of the short fits
GROUPS = 6  # of like colours
# metal: the error must fall by this share; from the wrong side it rises, or falls by less than a
# tenth
GAIN = 0.13
# and by so much of what falls for the group that gains most: paint gains too by the light that a
# metal beside it tells
OF_BEST = 0.35
DULL_GAIN = 0.04  # dull: less is enough, since roughness alone is at stake and can still move
FLOOR = 0.005  # of the error of a pixel: what is explained so well needs no other explanation
ROSE = 0.54  # mean metallic of a group that is metal, after the short fit from .5
STEPS = 300  # of each fit, but at most half of those of the pass
TEXTURE = 128  # texels a side
TRIAL = {  # of the short fits
    "texture": TEXTURE,
    "light_steps": 0,
    "slope_rate": 0.0,
    "exchange_mirrored": False,
    "metallic_sparse": 0.003,
    "metallic_binary": 0.003,
}
MOST_EXCHANGE = 0.02  # of exchange_rate
POINTS = 2048  # of a step, at most: the fits are coarse
BATCHES = 8  # of pixels that the fits are judged by


def first_material(
    bank: PixelBank,
    mesh: TraceableMesh,
    texels: TexelStart,
    options: SurfaceOptions,
    seed: int = 0,
    progress: Callable[[int], None] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Metallic and roughness to begin with, (S, S) float32 each. progress: called with how many
    steps of all short fits are over. Texels without normals of their own stand in many places under
    the light, so that roughness finds its way from anywhere: where none of them may be metal, the
    fit that tells dull paint is spared."""
    base, known, normals = texels.base, texels.known, texels.normals
    stage = NoStage(progress)
    o = replace(
        options,
        steps=min(STEPS, options.steps // 2),
        exchange_rate=min(options.exchange_rate, MOST_EXCHANGE),
        **TRIAL,
    )
    given = (base, known) if normals is None else (base, known, normals)
    small = [
        cv2.resize(np.asarray(a, np.float32), (TEXTURE, TEXTURE), interpolation=cv2.INTER_AREA)
        for a in given
    ]
    colour = np.sqrt(np.maximum(base, 0) / max(float(base[known].mean()), 1e-6))
    centres, group = groups_of(colour, known)

    def errors_from(side: tuple[float, float | None]) -> np.ndarray:
        metallic, roughness = side
        first = o if roughness is None else replace(o, roughness_start=roughness)
        coarse = TexelStart(
            small[0], small[1] > 0.5, texels.radiance, None if normals is None else small[2]
        )
        terms = EnvironmentTerms(
            bank, mesh, start_surface(coarse, first, metallic), fewer_points(o), seed
        )
        fit_surface(terms, stage)
        return errors(terms, o, centres, colour, seed)

    paint, metal = errors_from(SIDES[0]), errors_from(SIDES[1])
    if normals is None and not may_be_metal(paint, metal).any():
        return np.full(known.shape, PAINT, np.float32), np.full(
            known.shape, options.roughness_start, np.float32
        )
    dull = errors_from(SIDES[2])
    is_metal, is_dull = explained_better(paint, metal, dull)
    metallic = np.where(is_metal[group] & known, METAL, PAINT)
    return metallic.astype(np.float32), np.where(
        is_dull[group] & known, DULL, options.roughness_start
    ).astype(np.float32)


def fewer_points(options: SurfaceOptions) -> SurfaceOptions:
    """Options of a short fit; it is judged by as many points as the pass has."""
    return replace(options, points=min(POINTS, options.points))


def describe(metallic: np.ndarray, roughness: np.ndarray, known: np.ndarray) -> str:
    """What `first_material` found, as a line for the log."""
    metal, dull = (f"{part[known].mean():.0%}" for part in (metallic > 0.5, roughness >= DULL))
    return f"{metal} of the surface begins as metal, {dull} as dull paint"


def groups_of(colour: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centres (G, 3) of at most GROUPS groups of like colours, and the group of each texel (S,
    S)."""
    some = colour[known]
    some = some[:: max(1, len(some) // 20000)].astype(np.float64)
    distinct = np.unique(some.round(2), axis=0)
    centres = (
        kmeans2(some, GROUPS, minit="++", rng=0)[0] if len(distinct) > 2 * GROUPS else distinct
    )
    return centres, vq(colour.reshape(-1, 3), centres)[0].reshape(known.shape)


def errors(terms: EnvironmentTerms, o: SurfaceOptions, centres, colour, seed: int) -> np.ndarray:
    """(G, 3), for each group: the error of display values and the metallic, both summed over drawn
    pixels, and the pixels counted."""
    bank, mesh, model = terms.bank, terms.mesh, terms.model
    size, groups = colour.shape[0], len(centres)
    rng = mi.PCG32(size=o.points, initstate=seed * 7919 + 29)
    out = np.zeros((groups, 3))
    for _ in range(BATCHES):
        batch, points = drawn_points(bank, mesh, rng, o.points)
        surface = material_at(model.material, points.uv, points.valid)
        dr.eval(surface.base, surface.roughness, surface.metallic)
        lights = sample_lights(mesh, points, surface, model.environment, o.directions, rng)
        a, b = reflected(points, lights, surface, model.environment)
        value = dual_values(a, b, batch.rgb, saturated_at(bank, batch.view))
        keep = np.array(points.valid)
        uv = np.clip((np.array(points.uv).T * size).astype(int), 0, size - 1)[keep]
        group = vq(colour[uv[:, 1], uv[:, 0]], centres)[0]
        for column, values in enumerate(
            (np.array(value)[keep], np.array(surface.metallic)[keep], np.ones(len(group)))
        ):
            out[:, column] += np.bincount(group, values, groups)
    return out


def explained_better(
    paint: np.ndarray, metal: np.ndarray, dull: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Which groups are metal and which are dull paint, (G,) bool each, from the `errors` of the
    three fits. Metal: explained clearly better from that side, also beside what gains most, and
    become more of a metal; dull: no metal, and explained better so. Fits as short as these leave
    the gain of one group uncertain by several hundredths; paint of one object is mostly alike, so
    half of what counts is the gain of all paint together. What clearly loses stays."""
    is_metal = may_be_metal(paint, metal) & (metal[:, 0] < dull[:, 0])
    together = gain(*(fit[~is_metal].sum(0, keepdims=True) for fit in (paint, dull)))
    alone = gain(paint, dull)
    return is_metal, ((alone + together) / 2 > DULL_GAIN) & (alone > -DULL_GAIN) & ~is_metal


def may_be_metal(paint: np.ndarray, metal: np.ndarray) -> np.ndarray:
    """(G,) which groups are metal unless dull paint explains them better: see
    `explained_better`."""
    gained = gain(paint, metal)
    return (gained > max(GAIN, OF_BEST * gained.max())) & (metal[:, 1] > ROSE * metal[:, 2])


def gain(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(G,) the share of its error that a group loses with the other of two fits, from their
    `errors`."""
    return (one[:, 0] - other[:, 0]) / (one[:, 0] + FLOOR * one[:, 2] + 1e-9)

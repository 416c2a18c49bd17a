"""Instances that were left out (fit/registration/instances/outliers.py), sought once more in the
model of the others, which is sharp by then.

The search of fit/registration/instances/search.py compares crops with coarse models, and what is
mostly hidden may agree better in a wrong place. Against
the finished model several places of such an instance are tried at once: each is a camera of its own
that descends while shape and paint stay, and what it shows then agrees with the model about as well
as what the others show, or the instance stays out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import mitsuba as mi
import numpy as np

from relit.fit.passes.optimiser import NoStage
from relit.fit.passes.volume import VolumeModel, VolumeOptions, fit_volume
from relit.fit.registration.instances.azimuth import all_turns
from relit.fit.registration.instances.growth import ANOTHER
from relit.fit.registration.instances.lookup import look_for
from relit.fit.registration.instances.options import DETAILED
from relit.fit.registration.instances.outliers import view_errors
from relit.fit.registration.instances.revolution import UP
from relit.fit.registration.instances.views import (
    InstanceView,
    albedo_render,
    instance_crops,
    move_poses,
    moved_poses,
    overlaps,
    pixel_bank,
)
from relit.fit.registration.register import (
    Gallery,
    crop_rings,
    directions_around,
    make_galleries,
    refine,
    views_from,
    volume_render,
)
from relit.geometry.revolution_axis import Axis
from relit.geometry.se3 import rotation_angle
from relit.rendering.appearance.world_light import SHADE, SHADOW_RATE, shade_world

VIEWPOINTS = 2500
PLACED = (
    DETAILED,
    (0.5, 2.0, 0.6),
)  # weights of fit.register's descriptors: one light, so brightness tells
# places of an instance that are tried, half of them under each and these at least APART degrees
# from each other
TRIES = 12
APART = 12.0
# times the median error of the others at most: paint that this instance alone shows is not in the
# model
AGREES = 8.0
CLEARLY = 2.0  # times as much it is at any other place
# overlap of silhouettes from which on a place of a body of revolution is right up to a turn about
# the axis,
OUTLINE = 0.95
AS_WELL = 1.5  # where what it leaves over is at most so many times what the best place leaves
TURNS = 24  # about an axis that is known
# times the others' error at most, or FAR times where any other place leaves LEADS times as much:
# worth a trial. Of two trucks that showed what no other did the right places left 9 to 12 (all
# others 2 times as much); cows and cups among them 15 to 50 (1.0 to 1.4 times)
GUESS, FAR, LEADS = 12.0, 20.0, 1.6
HOPELESS = 40.0  # times it at all places that were tried first: no guess is sought on
MORE, LONGER = (
    3,
    600,
)  # places that are looked into for that, and steps: what shades them is slow to find
# other places are tried so often where none agrees: the right one may be too far from all of them
# to descend there
ROUNDS = 3
STEPS, RAYS, RATE = 250, 8192, 0.006  # of their descent


def sought_again(
    view: InstanceView,
    guide: InstanceView,
    guide_pose: np.ndarray,
    model: VolumeModel,
    level: float,
    turns: Callable | None,
    galleries: Callable[[int], list[Gallery]],
    seed: int = 0,
    on_axis: np.ndarray | None = None,
    turned: Callable[[InstanceView, np.ndarray], np.ndarray] | None = None,
    guess: bool = False,
):
    """(pose (4, 4) of `view` in the model or None, is that certain): None where what it shows
    agrees with the model nowhere, or in several places.

    guide: a view that the model was fitted to, and its pose; it stays and tells where the scene is.
    level: median error of such views (see `view_errors`). turns: what tells views their `turns` of
    `shade_world`; None for one photo. galleries: see `galleries_of`, by seed.
    on_axis: a pose that is right up to a turn about the object's y axis: all turns are tried, and
    the best is taken, certain or not.
    turned: for an object that is a body of revolution, handles aside, whose silhouette tells all
    but the turn about the axis: of a view and its pose (4, 4), the pose with which it shows what
    the others show (`turn_guess.turned_alike`); where nothing is certain the best place whose
    silhouette agrees is taken then. guess: where none is certain the best place is looked into, and
    taken if it is worth a trial.
    """
    for turn in range(ROUNDS if on_axis is None else 1):
        poses = (
            candidates(view, model, galleries(seed + turn))
            if on_axis is None
            else all_turns(on_axis, Axis(np.zeros(3), UP), TURNS)
        )
        if len(poses) == 0:
            continue
        poses, errors = refine_candidates(
            view, guide, guide_pose, poses, model, turns, STEPS, seed + turn
        )
        if np.isnan(errors).all():  # none of its pixels is whole: it tells nothing
            break
        pose, certain = most_likely_pose(poses, errors, level)
        if certain:
            return pose, True
        if on_axis is not None:
            return pose if turned is None else turned(view, pose), False
        if turned is not None:
            there = where_outlines_agree(errors, view, poses, model)
            if np.isfinite(there).any():
                return turned(view, most_likely_pose(poses, there, level)[0]), False
        if guess:
            if np.nanmin(errors) > HOPELESS * level:
                break
            best = best_places(poses, errors)[:MORE]
            poses, errors = refine_candidates(
                view, guide, guide_pose, poses[best], model, turns, LONGER, seed + turn
            )
            pose, certain = most_likely_pose(poses, errors, level)
            if certain or worth_a_trial(poses, errors, level):
                return pose, certain
        if np.nanmin(errors) <= AGREES * level:
            break
    return None, False


def most_likely_pose(
    poses: np.ndarray, errors: np.ndarray, level: float
) -> tuple[np.ndarray, bool]:
    """(the pose with the least of the errors (K,), is it certain: it agrees, and clearly better
    than any other place does). level: see `sought_again`."""
    best, *others = best_places(poses, errors)
    return poses[best], bool(
        errors[best] <= AGREES * level and all(errors[others] >= CLEARLY * errors[best])
    )


def worth_a_trial(poses: np.ndarray, errors: np.ndarray, level: float) -> bool:
    """Whether the place with the least of the errors (K,) may be right, see GUESS. level: see
    `sought_again`."""
    best, *others = best_places(poses, errors)
    leads = errors[best] <= FAR * level and all(errors[others] >= LEADS * errors[best])
    return bool(leads or errors[best] <= GUESS * level)


def best_places(poses: np.ndarray, errors: np.ndarray) -> list[int]:
    """Indices of the places (K, 4, 4) that are ANOTHER degrees or more from those with smaller
    errors (K,); the smallest first."""
    chosen: list[int] = []
    for k in np.argsort(errors)[: np.isfinite(errors).sum()]:
        if all(rotation_angle(poses[k][:3, :3].T @ poses[j][:3, :3]) > ANOTHER for j in chosen):
            chosen.append(int(k))
    return chosen


def where_outlines_agree(
    errors: np.ndarray, view: InstanceView, poses: np.ndarray, model: VolumeModel
) -> np.ndarray:
    """The errors (K,) of places whose silhouettes agree with the view's, and about as well as the
    best of them, nan for others."""
    left = 1 - overlaps(volume_render(model), view, poses)
    return np.where(left <= min(1 - OUTLINE, AS_WELL * left.min()), errors, np.nan)


def galleries_of(model: VolumeModel, distance: float, seed: int) -> list[Gallery]:
    """The model seen from all sides, from a distance, as each of PLACED describes it. They serve
    all who are sought."""
    return make_galleries(
        albedo_render(model), views_from(directions_around(VIEWPOINTS, seed), distance), PLACED
    )


def candidates(view: InstanceView, model: VolumeModel, galleries: list[Gallery]) -> np.ndarray:
    """(at most TRIES, 4, 4) places that look most like the view, by rendering."""
    crops, render = instance_crops([view]), albedo_render(model)
    found = []
    for parts, gallery in zip(PLACED, galleries, strict=True):
        rings = crop_rings(crops, parts)
        looked = look_for([view], crops, gallery, rings, parts, keep=TRIES // 2, apart=APART)
        for k in range(TRIES // 2):
            if looked.scores[0, k] > -1:
                pose, _ = refine(
                    crops, looked.poses[:, k], render, rings=rings, steps=(0, 4.0, 2.0), parts=parts
                )
                found.append(pose[0])
    return np.array(found)


def refine_candidates(
    view: InstanceView,
    guide: InstanceView,
    guide_pose: np.ndarray,
    poses: np.ndarray,
    model: VolumeModel,
    turns,
    steps: int,
    seed: int,
):
    """(poses (K, 4, 4), errors (K,)) after the descent of all places at once, shape and paint as
    they are."""
    views = [guide] + [view] * len(poses)
    poses = np.concatenate([guide_pose[None], poses])
    bank = pixel_bank(views, poses)
    shared = np.array(model.reflections)[:SHADE]
    learnt = np.concatenate([shared, np.zeros(4 * len(views))]).astype(np.float32)
    rates = np.concatenate([np.zeros(SHADE + 4), np.full(4 * len(views) - 4, SHADOW_RATE)]).astype(
        np.float32
    )
    appearance = shade_world if turns is None else partial(shade_world, turns=turns(views))
    still = replace(
        model,
        reflections=mi.Float(learnt),
        rates=mi.Float(rates),
        appearance=appearance,
        correction_ratios=None,
    )
    move_poses(bank, still)
    moves = np.array(still.correction_ratios).reshape(-1, 8)
    moves[0] = 0
    still.correction_ratios = mi.Float(moves.ravel())
    sharp = model.inv_s * model.grid.h
    frozen = {
        "sdf_rate": 0.0,
        "feature_rate": 0.0,
        "eikonal": 0.0,
        "diffusion": 0.0,
        "sharpness": (sharp, sharp),
    }
    o = VolumeOptions((model.grid.n,), (steps,), RAYS, refine_cameras=RATE, **frozen)
    fit_volume(bank, still, o, NoStage(), seed)
    return moved_poses(bank, views, poses)[1:], view_errors(bank, still, seed)[1:]

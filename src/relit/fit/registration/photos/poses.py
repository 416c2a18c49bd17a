"""Where each photo of a collection was taken from: coarse models and registration by rendering, in
turns.

No pose is known, or only its quadrant. A coarse model is fitted to crops of 64 pixels with the
present poses, every photo is registered
against renderings of it from all around, and so on, from frequency to frequency: what the photos
agree on sharpens, and a photo whose pose was wrong finds its place by search, not by descent. With
hints (quadrants) all photos take part from the start. Without,
the model starts as one inflated silhouette and grows: only viewpoints near those that it has seen
are trusted, the photos that match best join first.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import mitsuba as mi
import numpy as np

from relit.conventions import similarity
from relit.fit.passes.camera_corrections import CorrectionModel, corrected, no_corrections
from relit.fit.passes.optimiser import NoStage
from relit.fit.passes.volume import VolumeModel, VolumeOptions, fit_volume, start_model
from relit.fit.registration.photos.depth import depth_limit
from relit.fit.registration.photos.framing import crop_bank, is_cut, not_empty
from relit.fit.registration.photos.multiplex import expanded, updated, with_refined
from relit.fit.registration.register import (
    REFINE,
    Crop,
    crop_rings,
    crop_views,
    directions_around,
    hint_prior,
    make_gallery,
    near,
    refine,
    search,
    views_from,
    volume_render,
)
from relit.geometry.hull import NoShape, distance_of, visual_hull
from relit.geometry.se3 import look_at, rotation_angle
from relit.rendering.appearance.light_per_photo import shade_photos, shade_plain, start_photo_lights
from relit.scene import Camera

PARTS = (
    0.6,
    1.0,
    0.3,
    # of register.PARTS: under other lights a colour is worth less than what is dark and what is bright
)
COARSE = (0, 6.0, 3.0)  # degrees; of refinements before the last
HOPELESS = 0.8  # mean score of the first photos below which growth is given up
# by which a pose far away must score better: sides that look alike differ by .01 from light alone
ELSEWHERE = 0.012
SLACK = 15.0  # degrees that a photo may stand beyond what its hint allows, once the shape is known
HINT = 0.05  # weight of the hints' prior on scores in the first round, falling to 0
SPREAD = 0.36  # root mean square radius of silhouettes, unit frame: the gauge of scale
GREY = 0.3  # mean colour of every crop


@dataclass(frozen=True)
class Schedule:
    """One entry per round. nodes: a side of the coarse model. steps: of its fit. views: of the
    gallery. tolerance: share of photos that may contradict a point of the hull."""

    nodes: tuple[int, ...] = (32, 32, 40, 48, 48, 56)
    steps: tuple[int, ...] = (60, 60, 80, 100, 120, 140)
    views: tuple[int, ...] = (300, 300, 400, 400, 500, 500)
    tolerance: tuple[float, ...] = (0.45, 0.35, 0.25, 0.2, 0.12, 0.1)


def schedule_of(rounds: int) -> Schedule:
    """The default schedule stretched or shortened to so many rounds."""
    full = Schedule()
    at = np.linspace(0, len(full.nodes) - 1, rounds).round().astype(int)
    return Schedule(
        *(
            tuple(getattr(full, name)[i] for i in at)
            for name in ("nodes", "steps", "views", "tolerance")
        )
    )


def even_colours(crops: list[Crop]) -> list[Crop]:
    """The crops with the mean colour of the object at GREY: exposure and white of each photo go,
    shading stays."""
    out = []
    for c in crops:
        inside = (c.mask > 0.5) & (c.weight > 0.5)
        tint = c.rgb[inside].mean(0) if inside.any() else np.ones(3)
        out.append(
            replace(
                c, rgb=np.clip(c.rgb * (GREY / np.maximum(tint, 1e-4)), 0, 4).astype(np.float32)
            )
        )
    return out


def distance_for(crop: Crop) -> float:
    """At which the silhouette's spread is SPREAD."""
    from relit.fit.registration.register import moments

    spread = moments((crop.mask * crop.weight)[None])[1][0]
    return float(SPREAD * crop.camera.fx / spread)


def pose_towards(crop: Crop, direction: np.ndarray) -> np.ndarray:
    """model_from_photo (4, 4): the photo seen from `direction`, upright, the silhouette's middle at
    the origin."""
    virtual = look_at(np.asarray(direction) / np.linalg.norm(direction) * distance_for(crop))
    rotation = virtual[:3, :3] @ np.asarray(crop.camera.world_from_camera)[:3, :3].T
    return similarity(rotation, virtual[:3, 3])


def gauge(crops: list[Crop], poses: np.ndarray) -> np.ndarray:
    """The poses scaled so that silhouettes have SPREAD on average: alternating fits would drift in
    scale. Only whole ones count, where there are some."""
    whole = [k for k, c in enumerate(crops) if not is_cut(c)]
    counted = whole if len(whole) >= 3 else range(len(crops))
    scale = np.median([np.linalg.norm(poses[k][:3, 3]) / distance_for(crops[k]) for k in counted])
    out = np.array(poses)
    out[:, :3, 3] /= scale
    return out


def hull_by_vote(
    cameras: list[Camera], masks: list[np.ndarray], nodes: int, tolerance: float, limit=None
) -> np.ndarray:
    """(n, n, n) distances of the hull at the tolerance, or at a larger one where that is next to
    empty. Raises NoShape when all are."""
    for more in (tolerance, 0.5 * (tolerance + 0.6), 0.6, 0.75):
        try:
            values = visual_hull(cameras, masks, nodes, tolerance=more)
            if limit is not None:
                values = distance_of((values < 0) & limit)
        except NoShape:
            continue
        if (values < 0).sum() > 50:
            return values
    raise NoShape("the silhouettes have nothing in common")


def coarse_model(
    crops: list[Crop],
    poses,
    nodes: int,
    steps: int,
    tolerance: float,
    seed: int,
    limit=None,
    shares=None,
) -> VolumeModel:
    """Hull by vote and a short volume fit. limit: (n, n, n) bool, where the object may be, or None.
    shares: (P,) how much each crop is looked at, or None for all alike."""
    cameras = crop_views(crops, poses)
    values = hull_by_vote(cameras, not_empty(crops), nodes, tolerance, limit)
    model = start_model(values, np.full(3, GREY), None, full=False)
    bank = crop_bank(crops, cameras, shares)
    options = VolumeOptions(
        (nodes,), (steps,), 4096, sdf_rate=0.1, feature_rate=0.03, sharpness=(0.7, 1.5), step=0.8
    )
    return fit_volume(bank, model, options, NoStage(), seed)


def poses_from_hints(
    crops: list[Crop],
    directions: np.ndarray,
    degrees: float,
    schedule: Schedule,
    seed: int,
    say,
    keep=3,
    soft=None,
    limited=False,
):
    """Poses (P, 4, 4) and scores (P,) when each photo's direction is known to within `degrees`.
    directions: (P, 3) unit, zeros where a
    photo has none: such photos are registered from the second round on, wherever they fit. soft:
    sharpness of a soft assignment, or None: then only the best hypothesis of a photo takes part in
    the fits (see collection_multiplex.py). limited: see `depth_limit`."""
    rings = crop_rings(crops, PARTS)
    hinted = np.linalg.norm(directions, axis=1) > 0.5
    poses = np.array(
        [
            pose_towards(c, d if h else [0, 0, 1.0])
            for c, d, h in zip(crops, directions, hinted, strict=True)
        ]
    )
    rounds, used, scores = len(schedule.nodes), np.flatnonzero(hinted), np.zeros(len(crops))
    multiplex = None
    for i in range(rounds):
        some, own, shares = [crops[k] for k in used], gauge(crops, poses)[used], None
        if multiplex is not None and len(used) == len(crops):
            some, own, shares = expanded(crops, multiplex)
            own = gauge(some, own)
        limit = depth_limit(some, own, schedule.nodes[i]) if limited else None
        model = coarse_model(
            some,
            own,
            schedule.nodes[i],
            schedule.steps[i],
            schedule.tolerance[i],
            seed + i,
            limit,
            shares,
        )
        render = volume_render(model)
        gallery = make_gallery(
            render, views_from(directions_around(schedule.views[i], seed + i)), PARTS
        )
        prior = (
            HINT
            * (1 - i / rounds)
            * hint_prior(gallery, directions, degrees, 15.0)
            * hinted[:, None, None]
        )
        allowed = near(gallery, directions, degrees) | ~hinted[:, None]
        found = search(crops, gallery, keep, rings=rings, prior=prior, allowed=allowed)
        poses, scores = found.poses[:, 0], found.scores[:, 0]
        if i > 0:
            last = i == rounds - 1
            poses, scores = best_refined(
                crops, found, render, rings, keep if last else 1, REFINE if last else COARSE
            )
        if soft:
            multiplex = with_refined(updated(multiplex, found, i / max(rounds - 1, 1), soft), poses)
        used = (
            np.arange(len(crops))
            if len(used) == len(crops)
            else np.flatnonzero(hinted | (scores > np.median(scores[hinted])))
        )
        say(f"round {i + 1} of {rounds}: mean score {scores.mean():.3f}", poses, scores)
    return gauge(crops, poses), scores


def best_refined(crops, found, render, rings, keep: int, steps=REFINE, parts=PARTS):
    """Refine the first `keep` hypotheses of each photo, and take the best. rings: of the crops,
    made with `parts`."""
    best, score = found.poses[:, 0].copy(), np.full(len(crops), -1.0)
    for k in range(min(keep, found.poses.shape[1])):
        poses, scores = refine(
            crops, found.poses[:, k], render, rings=rings, steps=steps, parts=parts
        )
        better = (scores > score) & (found.scores[:, k] > -1)
        best[better], score[better] = poses[better], scores[better]
    return best, score


def fit_with_free_poses(
    crops: list[Crop],
    poses: np.ndarray,
    nodes: int,
    steps: int,
    seed: int,
    held=None,
    limit=None,
    stage=None,
) -> tuple[VolumeModel, np.ndarray]:
    """A model (VolumeModel) with one small light per photo, fitted with the poses free, but for
    those of `held` photos (P,); and the poses. Focal lengths stay. limit: as in `coarse_model`.
    stage: hears the losses, or None."""
    cameras = crop_views(crops, gauge(crops, poses))
    model = start_model(
        hull_by_vote(cameras, not_empty(crops), nodes, 0.12, limit),
        np.full(3, GREY),
        None,
        full=False,
    )
    model.reflections, model.rates = start_photo_lights(np.full((len(crops), 3), GREY), GREY)
    model.appearance = shade_photos
    bank = crop_bank(crops, cameras)
    bank.corrections = no_corrections(bank.views, CorrectionModel.ABOUT_ORIGIN)
    if held is not None:
        model.correction_ratios = mi.Float(np.repeat(1.0 - np.asarray(held, np.float32), 7))
    options = VolumeOptions(
        (nodes,),
        (steps,),
        4096,
        feature_rate=0.03,
        sharpness=(1.0, 3.0),
        step=0.8,
        refine_cameras=0.005,
    )
    fit_volume(bank, model, options, stage or NoStage(), seed)
    numbers = bank.corrections.numbers
    numbers[:, 6] = 0
    found = corrected(cameras, replace(bank.corrections, values=mi.Float(numbers.ravel())))
    moved = [
        c.world_from_camera @ np.linalg.inv(crop.camera.world_from_camera)
        for c, crop in zip(found, crops, strict=True)
    ]
    return model, np.array(moved)


def polish(
    crops: list[Crop],
    poses,
    directions: np.ndarray,
    degrees: float,
    keep: int,
    seed: int,
    say,
    cycles: int,
    held=None,
    limited=False,
    begun: int = 0,
):
    """Descend, then search again in the sharper model: descent brings most photos to within a
    degree or two, the search the others.
    held: (P,) bool, photos that only descend, or None. limited: see `depth_limit`. begun: cycles
    that are over."""
    rings, scores = crop_rings(crops, PARTS), np.zeros(len(crops))
    held = np.zeros(len(crops), bool) if held is None else held
    still = (
        np.array([is_cut(c) for c in crops]) | held
    )  # a search by whole silhouettes tells nothing of cut ones
    hinted = np.linalg.norm(directions, axis=1) > 0.5
    for i in range(begun, cycles):
        limit = depth_limit(crops, gauge(crops, poses), 48) if limited else None
        model, poses = fit_with_free_poses(crops, poses, 48, 200, seed + 200 + i, held, limit)
        render = volume_render(replace(model, appearance=shade_plain))
        gallery = make_gallery(render, views_from(directions_around(500, seed + 200 + i)), PARTS)
        prior = 0.5 * HINT * hint_prior(gallery, directions, degrees, 45.0) * hinted[:, None, None]
        allowed = near(gallery, directions, degrees + SLACK) | ~hinted[:, None]
        found = search(crops, gallery, keep, rings=rings, prior=prior, allowed=allowed)
        own, height = refine(crops, poses, render, rings=rings, steps=(0, 1.5), parts=PARTS)
        other, scores = best_refined(crops, found, render, rings, keep, COARSE)
        stays = (height + ELSEWHERE >= scores) | still
        poses = np.where(held[:, None, None], poses, np.where(stays[:, None, None], own, other))
        scores = np.where(still, height, scores)
        scores = np.maximum(height, scores)
        say(
            f"descent and search, round {i + 1}: mean score {scores.mean():.3f}, {(~stays).sum()} photos found elsewhere",
            poses,
            scores,
        )
    return gauge(crops, poses), scores


def cross_validated_share(
    crops: list[Crop], poses: np.ndarray, seed: int, within=20.0, nodes=40, steps=90, views=400
) -> float:
    """Share of photos that a search without hints puts within so many degrees of their pose, in a
    model of the other half of the photos.

    A score alone does not tell a mush that all photos went into from a shape: photos that the model
    has not seen do. Right poses of Spot, BoomBox and a stool (alike from four sides) gave 1.0, .50
    and .35, wrong ones of BoomBox .08, at scores of .96, .93, .95 and .87.
    """
    order, found = np.random.default_rng(seed).permutation(len(crops)), 0
    whole = gauge(crops, poses)
    for half in (0, 1):
        seen, unseen = np.sort(order[half::2]), np.sort(order[1 - half :: 2])
        model = coarse_model([crops[k] for k in seen], whole[seen], nodes, steps, 0.15, seed + half)
        gallery = make_gallery(
            volume_render(model), views_from(directions_around(views, seed + half)), PARTS
        )
        some = [crops[k] for k in unseen]
        again = search(some, gallery, 1, rings=crop_rings(some, PARTS)).poses[:, 0]
        found += sum(
            rotation_angle(p[:3, :3].T @ q[:3, :3]) < within
            for p, q in zip(again, poses[unseen], strict=True)
        )
    return found / len(crops)

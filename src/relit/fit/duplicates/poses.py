"""The first stage of the recipe `duplicates`: the views of all photos, and where each instance
stands.

Instances of several photos of one pile are views of the same object like those of one photo: all
are registered together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree

from relit.errors import EXIT_FAILED, UserError
from relit.fit.duplicates.options import DuplicatesOptions
from relit.fit.duplicates.verdict import UNCERTAIN, judge_pile_poses
from relit.fit.registration.instances.growth import viewing_directions
from relit.fit.registration.instances.left_out import leave_out
from relit.fit.registration.instances.options import Effort, Growth, Search
from relit.fit.registration.instances.trials import place_few
from relit.fit.registration.instances.views import COARSE, InstanceView, ViewId, carved, views_of
from relit.fit.registration.placements import Placements, Status
from relit.geometry.hull import NoShape
from relit.geometry.se3 import rotation_angle
from relit.recipe import FitContext
from relit.scene import Camera, Pixels

APART = 100.0  # degrees between two groups of sides from which on hardly anything is shown by both
# half instances that are added to the number of them where the effort of the search is limited: few
# take more tries than many
ALWAYS = 10
AGREES = 0.2  # an instance whose score lies further below the median did not find its place

Shot = tuple[Pixels, Camera]  # a decoded photo and its camera in its own frame (identity pose)


def all_views(shots: list[Shot], side: int, options: DuplicatesOptions) -> list[InstanceView]:
    """The views of all photos, in windows of at most `side` pixels."""
    out = []
    for number, (pixels, camera) in enumerate(shots):
        normal = None if "normals" in options.without else pixels.normal
        out += views_of(pixels.rgb, pixels.labels, camera, side, normal, number)
    return out


@dataclass(frozen=True)
class PilePoses:
    """Poses of all views. ids: names of the views. poses: (N, 4, 4) object_from_camera, in a frame
    whose unit sphere holds the object. registered: (N,) bool. axis_only: (N,) bool, not registered
    but right up to a turn about the object's y axis. scores: (N,). turns: (N,) degrees by which a
    registered instance agrees about as well or better with a model of the others, 0 where it does not.
    chances: (N,) of a pose being wrong (`LeftOut.chance_wrong`), NaN where it is unknown.
    contradicted: see `LeftOut`."""

    ids: tuple[ViewId, ...]
    poses: np.ndarray
    registered: np.ndarray
    axis_only: np.ndarray
    scores: np.ndarray
    turns: np.ndarray
    chances: np.ndarray
    contradicted: bool


def poses_stage(shots: list[Shot], fit: FitContext) -> PilePoses:
    """Poses of all views of all photos. Raises UserError where hardly any can be placed."""
    title = "poses of the instances"
    found = fit.run.cached(
        "poses", PilePoses, lambda stage: find_pile_poses(shots, fit), title=title
    )
    names = [f"label {i.label}" + photo_suffix(i.photo) for i in found.ids]
    chosen = np.flatnonzero(found.registered)
    judge_pile_poses([names[k] for k in chosen], found.chances[chosen], found.contradicted, fit.run)
    return found


def find_pile_poses(shots: list[Shot], fit: FitContext) -> PilePoses:
    """Matching, search, and the adjustment over guided matches."""
    run, options, seed = fit.run, fit.options, fit.seed
    views = all_views(shots, COARSE, options)
    matched = None if "matching" in options.without else match_instances(shots, run, options, seed)
    descents = {"descents": 0} if "refinement" in options.without else {}
    effort = Effort(options.search_effort * (len(views) / 2 + ALWAYS))
    search = Search(
        rounds=options.search_rounds,
        searches=options.searches,
        regrowths=options.regrowths,
        growth=Growth(effort=effort),
        **descents,
    )
    links = matched.told if matched else ()
    try:
        found = place_few(views, search, seed=seed, links=links, say=run.say)
    except NoShape:
        raise UserError(
            "no poses of the instances fit together",
            "the objects are not identical, the labels are wrong, or too few are seen from near-by sides",
            "check the label image; more instances, or a photo in which they are larger, help",
            code=EXIT_FAILED,
        ) from None
    run.log.note(f"the search has fitted {effort.spent:.0f} coarse models")
    if effort.over:
        run.say(
            f"note: the search has ended at its limit of {effort.limit:.0f} coarse models, with the best poses so far; --set search_effort={2 * options.search_effort:g} doubles it"
        )
    registered = registered_of(views, found, links, fit)
    some = [v for v, ok in zip(views, registered, strict=True) if ok]
    poses, turns = found.poses, np.zeros(len(views))
    chances, contradicted = np.full(len(views), np.nan), False
    if registered.sum() > 2 and "refinement" not in options.without:
        asked = leave_out(some, poses[registered], search, seed)
        chances[registered], contradicted = asked.chance_wrong, asked.contradicted
        turns[registered] = np.where(asked.chance_wrong >= UNCERTAIN, asked.away, 0)
    say_groups(some, poses[registered], run)
    if matched and not {"guided", "refinement"} & set(options.without):
        poses = adjusted_poses(matched, poses, registered, run)
    return PilePoses(
        ids=tuple(v.id for v in views),
        poses=centre_poses(views, poses, registered),
        registered=registered,
        axis_only=found.having(Status.AXIS_ONLY),
        scores=found.scores,
        turns=turns,
        chances=chances,
        contradicted=contradicted,
    )


def registered_of(
    views: list[InstanceView], found: Placements, links: tuple, fit: FitContext
) -> np.ndarray:
    """(N,) bool: views whose placement counts. Those that agree too little with the model are named;
    raises UserError where hardly any is left."""
    placed, scores = found.having(Status.PLACED), found.scores
    least = np.median(scores[placed]) - AGREES if placed.any() else np.inf
    registered = placed & (scores >= least)
    if "search" in fit.options.without and len(views) > 1:
        registered &= linked_together(len(views), links)
    if registered.sum() < min(2, len(views)):
        raise UserError(
            "hardly any instance could be placed",
            "see the scores in the log",
            "check the label image",
            code=EXIT_FAILED,
        )
    for k in np.flatnonzero(~registered & placed):
        fit.run.say(
            f"note: the object with {instance_name(views[k])} is not registered: it agrees with the model of the others by {scores[k]:.2f} only"
        )
    return registered


def linked_together(count: int, told: tuple) -> np.ndarray:
    """(count,) bool: the largest set of instances that links of pairs, (i, j, ...), hold together;
    none where there are no links. How two sets lie to each other is for the search to find."""
    if not told:
        return np.zeros(count, bool)
    i, j = np.array([link[:2] for link in told]).T
    _, member = connected_components(
        coo_matrix((np.ones(len(i)), (i, j)), (count, count)), directed=False
    )
    return member == np.bincount(member).argmax()


def say_groups(views: list[InstanceView], poses: np.ndarray, run) -> None:
    """Say where the objects, at poses (N, 4, 4), fall into two groups that share no side: each bears
    its own poses out, whatever those of the other are."""
    if len(views) < 3:
        return
    sides = viewing_directions(poses)
    gap, group = widest_gap(np.degrees(np.arccos(np.clip(sides @ sides.T, -1, 1))))
    if gap <= APART:
        return
    one, other = (
        ", ".join(
            instance_name(v).removeprefix("label ")
            for v, g in zip(views, group, strict=True)
            if g == n
        )
        for n in (0, 1)
    )
    run.say(
        f"note: labels {one} and labels {other} are placed as showing opposite sides of the object, {gap:.0f} degrees apart with none "
        "between: each group may agree with itself and yet be turned against the other; look at the object in the report; more objects "
        "or another photo of the pile help"
    )


def widest_gap(away: np.ndarray) -> tuple[float, np.ndarray]:
    """(degrees, group (N,) 0 or 1): the widest step that going from each side to the next cannot
    avoid, and what lies on its two ends.
    away: (N, N) degrees between the sides of N >= 2 objects."""
    tree = minimum_spanning_tree(np.maximum(away, 1e-3)).toarray()  # 0 would be no edge
    gap = tree.max()
    tree[np.unravel_index(tree.argmax(), tree.shape)] = 0
    return float(gap), connected_components(tree, directed=False)[1]


def instance_name(view: InstanceView) -> str:
    """How messages call an instance."""
    return f"label {view.label}" + photo_suffix(view.photo)


def photo_suffix(photo: int) -> str:
    """What is added to a label of a further photo. photo: its number, from 0."""
    return f" in photo {photo + 1}" if photo else ""


@dataclass(frozen=True)
class Matched:
    """What matching says. features: of each instance. links: matches of pairs. told: (i, j,
    rotation of i onto j in the photo) of pairs.
    cameras: of each instance, the whole photo's. error: pixels within which matches agree."""

    features: list
    links: dict
    told: tuple
    cameras: list[Camera]
    error: float


def match_instances(shots: list[Shot], run, options: DuplicatesOptions, seed: int) -> Matched:
    """Links of pairs by rotation-swept feature matching."""
    from relit.cameras.matcher import link_by_matcher, load_matcher
    from relit.cameras.rotation_sweep import find_features, link_instances, map_instances
    from relit.cameras.sfm import quiet
    from relit.device import load_pycolmap

    full = all_views(shots, 10**6, options)
    cameras = [shots[v.photo][1] for v in full]
    offsets = [(c.cx - v.camera.cx, c.cy - v.camera.cy) for v, c in zip(full, cameras, strict=True)]
    error = max(0.5, float(np.median([max(v.mask.shape) for v in full])) / 250)
    sweep = "rotation_sweep" not in options.without
    windows = [(v.rgb, v.mask, offset) for v, offset in zip(full, offsets, strict=True)]
    with quiet(load_pycolmap()):
        if options.matcher:
            matcher, step = load_matcher(options.matcher), options.matcher_step
            features, links = link_by_matcher(
                matcher, windows, cameras, error, sweep=sweep, step=step
            )
        else:
            features = [find_features(*w) for w in windows]
            links = link_instances(features, cameras, error, sweep=sweep)
        clusters = map_instances(features, links, cameras, seed)
    for i, j in links:
        count, turn = len(links[i, j].a), links[i, j].turn
        run.log.note(
            f"{count} matches link {instance_name(full[i])} and {instance_name(full[j])}, turned by {turn:.0f} degrees"
        )
    out, together = [], set()
    for cluster in clusters:
        members = sorted(cluster)
        run.say(
            f"matching links the instances {', '.join(instance_name(full[k]).removeprefix('label ') for k in members)}"
        )
        together |= {(i, j) for i in members for j in members if i < j}
        out += [
            (i, j, cluster[j][:3, :3] @ cluster[i][:3, :3].T)
            for i in members
            for j in members
            if i < j
        ]
    out += [
        (i, j, link.rotation)
        for (i, j), link in links.items()
        if link.rotation is not None and (i, j) not in together
    ]
    return Matched(features, links, tuple(out), cameras, error)


def adjusted_poses(matched: Matched, poses: np.ndarray, registered: np.ndarray, run) -> np.ndarray:
    """The poses after matches were sought again, guided by them, and adjusted over these (SfD Sec.
    3.1, after the search)."""
    from relit.cameras.guided import guided
    from relit.cameras.sfm import quiet
    from relit.device import load_pycolmap

    chosen = np.flatnonzero(registered).tolist()
    number = {k: n for n, k in enumerate(chosen)}
    links = {
        (number[i], number[j]): link
        for (i, j), link in matched.links.items()
        if i in number and j in number
    }
    out = poses.copy()
    with quiet(load_pycolmap()):
        out[chosen], count = guided(
            [matched.features[k] for k in chosen],
            links,
            poses[chosen],
            [matched.cameras[k] for k in chosen],
            matched.error,
        )
    if count:
        turns = [
            rotation_angle(a[:3, :3].T @ b[:3, :3])
            for a, b in zip(out[chosen], poses[chosen], strict=True)
        ]
        run.say(
            f"matches guided by the poses link {count} pairs; bundle adjustment turns the instances by {np.median(turns):.1f} degrees"
        )
    return out


def centre_poses(
    views: list[InstanceView], poses: np.ndarray, registered: np.ndarray
) -> np.ndarray:
    """The poses in a frame whose unit sphere holds the object: its middle at the origin, its
    farthest point at 0.85."""
    chosen = [k for k in range(len(views)) if registered[k]]
    inside = carved([views[k] for k in chosen], poses[chosen], 64, 0.2)
    z, y, x = np.nonzero(inside < 0)
    p = np.stack([x, y, z], -1) * (2 / 63) - 1
    middle = (p.min(0) + p.max(0)) / 2
    s = 0.85 / np.linalg.norm(p - middle, axis=1).max()
    out = poses.copy()
    out[:, :3, 3] = s * (poses[:, :3, 3] - middle)
    return out

"""The shape of identical objects: the volume pass in the object's frame with the poses of all
instances, who is left out of it and who is found again, the mesh, and the ground that they stand
on. For the recipe `duplicates`.
"""

from __future__ import annotations

import enum
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import mitsuba as mi
import numpy as np

from relit.fit.duplicates.lit_pile import LitPile, lit_pile, pile_surface_options
from relit.fit.duplicates.mirrored_silhouettes import Symmetry
from relit.fit.duplicates.options import DuplicatesOptions
from relit.fit.duplicates.photo_motions import motion_or_none
from relit.fit.duplicates.placed_pile import PlacedPile, placed_pile
from relit.fit.duplicates.pose_passes import (
    Pass,
    followed,
    joint_stages,
    placed_by_outlines,
    pose_rate,
    related,
    shape_and_poses,
)
from relit.fit.duplicates.poses import Shot
from relit.fit.duplicates.recover_unregistered import carried, joiners, with_found
from relit.fit.duplicates.round_bodies import made_round
from relit.fit.duplicates.scene import distance_in, find_ground, set_down
from relit.fit.duplicates.unseen_sides import closed_where_unseen, moved_along, told_at
from relit.fit.duplicates.vessel_trial import vessel_of
from relit.fit.duplicates.vessels import body_axis
from relit.fit.passes.optimiser import NoStage
from relit.fit.passes.volume import VolumeResult, volume_result
from relit.fit.registration.instances.views import InstanceView, ViewId
from relit.fit.shape.loose_parts import without_loose_parts
from relit.fit.shape.mesh_stage import with_atlas
from relit.geometry.mesh import extract_mesh
from relit.geometry.sdf import dense_values, redistance, resample
from relit.recipe import FitContext
from relit.rendering.appearance.world_light import instance_radiance
from relit.scene import Mesh


def shape_stages(shots: list[Shot], found: FoundViews, fit: FitContext) -> PlacedPile:
    """Volume passes, mesh, ground."""
    shape = volume_stage(shots, found, fit)
    return fit.run.cached(
        "mesh", PlacedPile, lambda stage: pile_of(shape, found, fit), title="mesh, atlas, ground"
    )


def pile_of(shape: PileShape, found: FoundViews, fit: FitContext) -> PlacedPile:
    """Mesh and ground of the fitted shape, with the radiance and base colour of the vertices."""
    run, options, volume = fit.run, fit.options, shape.volume
    surface = placed_surface(shape, found, run, options)
    mesh, views = with_atlas(surface.mesh, options.texture, run.say), surface.views
    grid, reflections = volume.grid(), mi.Float(volume.reflections)
    scene = related(views, surface.poses)
    to_first = scene.motions if len(scene.motions) > 1 else [np.eye(4)]
    told = mesh.vertices
    if surface.placed is not None:
        told = told_at(mesh.vertices, surface.placed, len(surface.values))
    seen = [
        instance_radiance(
            grid,
            volume.features,
            reflections,
            told,
            mesh.normals,
            motion_or_none(to_first[v.photo]) @ np.linalg.inv(p),
            k,
        )
        for k, (v, p) in enumerate(zip(views, surface.poses, strict=True))
    ]
    pile = placed_pile(mesh, views, scene, [one[0] for one in seen])
    poses = pile.poses
    plane = None if "ground" in options.without else find_ground(mesh.vertices, poses)
    if plane is not None and pose_rate(views, options) > 0 and len(scene.motions) == 1:
        poses, plane, count = set_down(mesh.vertices, poses, plane, distance_in(surface.values))
        if count:
            run.say(
                f"{count} instances were moved along their lines of sight towards the ground, or what they rest on"
            )
    if plane is None:
        run.say(
            "note: no ground was found that the instances rest on; only they themselves cast shadows"
        )
    return replace(pile, poses=poses, base=seen[0][1], plane=plane, guessed=shape.guessed)


@dataclass(frozen=True)
class PlacedSurface:
    """mesh, and poses (N, 4, 4) of the views, where outlines and textures have them. values: (n, n,
    n) distances. placed: where the mesh is closed over what is seen, the vertices (V', 3) of what
    the volume pass has built, else None."""

    mesh: Mesh
    views: list[InstanceView]
    poses: np.ndarray
    values: np.ndarray
    placed: np.ndarray | None


def placed_surface(
    shape: PileShape, found: FoundViews, run, options: DuplicatesOptions
) -> PlacedSurface:
    """The surface of the fitted shape, and the guessed instances among the views."""
    views, poses, values = found.named(shape.ids), shape.poses, shape.volume.values
    follow = FOLLOW[shape.follow]
    cameras = [v.camera.with_pose(p) for v, p in zip(views, poses, strict=True)]
    masks, known = [v.mask for v in views], [v.known for v in views]
    mesh, loose = without_loose_parts(
        extract_mesh(values, faces=options.faces), cameras, masks, known
    )
    if loose:
        run.say(
            f"left out of the shape: {loose} loose part{'s' * (loose > 1)} that no silhouette asks for"
        )
    built, gone = mesh.vertices, 0.0
    if "unseen" not in options.without:
        values, gone = closed_where_unseen(values, views, poses)
    if gone:
        run.say(
            f"note: all views are from one side; the shape of the other is a guess ({gone:.0%} less than silhouettes allow)"
        )
        closed, _ = without_loose_parts(
            extract_mesh(values, faces=options.faces), cameras, masks, known
        )
    if follow is not None:
        mesh, poses, _ = follow(mesh, views, poses, run, options)
    if (
        follow is not placed_by_outlines
    ):  # where textures lie on one another, poses have left no bumps
        mesh = made_round(mesh, views, poses, run, options)
    if shape.guessed:
        there, turned = found.named(shape.guessed), shape.guessed_poses
        if follow is not None:
            _, turned, _ = placed_by_outlines(mesh, there, turned, run, options, still=True)
        views, poses = [*views, *there], np.concatenate([poses, turned])
    if not gone:
        return PlacedSurface(mesh, views, poses, values, None)
    placed = mesh.vertices  # poses have followed what silhouettes have made, not the guess
    return PlacedSurface(moved_along(closed, built, placed), views, poses, values, placed)


@dataclass(frozen=True)
class FoundViews:
    """Views that the search has placed at poses (N, 4, 4), `others` without poses, and on_axes: poses
    of such of these as are right up to a turn about the object's y axis."""

    views: list[InstanceView]
    poses: np.ndarray
    others: list[InstanceView]
    on_axes: dict[ViewId, np.ndarray]

    def named(self, ids: Sequence[ViewId]) -> list[InstanceView]:
        """The views of these names."""
        views = {v.id: v for v in (*self.views, *self.others)}
        return [views[name] for name in ids]


class Follow(enum.Enum):
    """What brings mesh and poses to where the pictures have them after the volume pass."""

    NOTHING = 0
    OUTLINES = 1
    OUTLINES_AND_TEXTURES = 2


FOLLOW = {
    Follow.NOTHING: None,
    Follow.OUTLINES: placed_by_outlines,
    Follow.OUTLINES_AND_TEXTURES: followed,
}


@dataclass(frozen=True)
class PileShape:
    """volume: the fitted shape. ids: of the views that it shows, with poses (N, 4, 4). follow: see
    `Follow`. guessed: views whose axis alone is known, with guessed_poses (M, 4, 4)."""

    volume: VolumeResult
    ids: tuple[ViewId, ...]
    poses: np.ndarray
    follow: Follow
    guessed: tuple[ViewId, ...]
    guessed_poses: np.ndarray


@dataclass(frozen=True)
class PileStart:
    """What the last volume pass begins with. views, poses (N, 4, 4): that take part. others: views
    to seek in the finished model. last: the pass for the poses before, or None. arrived: the poses
    stay. vessel: see `OpenedVessel`."""

    views: list[InstanceView]
    poses: np.ndarray
    others: list[InstanceView]
    last: Pass | None = None
    arrived: bool = False
    vessel: np.ndarray | None = None

    @property
    def follow(self) -> Follow:
        """Outlines and textures count already by the shape of the pass before; where they agree,
        this one may follow both."""
        if self.last is None:
            return Follow.NOTHING
        if not self.arrived:
            return Follow.OUTLINES_AND_TEXTURES
        return Follow.OUTLINES if self.last.exact else Follow.NOTHING


def volume_stage(shots: list[Shot], found: FoundViews, fit: FitContext) -> PileShape:
    """Passes for the poses, and the volume pass from these. Instances that do not agree with their
    model are left out; they, and those that the search could not place, are then sought in the
    finished model."""
    start = joint_passes(shots, found, fit)
    levels = fit.options.level_steps
    return fit.run.cached(
        "volume",
        PileShape,
        lambda stage: shaped_from(start, found, stage, fit),
        steps=sum(levels) if start.vessel is None else sum(levels[1:]),
        title="shape and poses (volume pass)",
    )


def joint_passes(shots: list[Shot], found: FoundViews, fit: FitContext) -> PileStart:
    """The passes for the poses, and the ends of a vessel."""
    run, options = fit.run, fit.options
    views, poses, others = found.views, found.poses, found.others
    if pose_rate(views, options) <= 0:
        return PileStart(views, poses, others)
    seek = partial(joiners, run=run, options=options, seed=fit.seed)
    views, poses, odd, arrived, last = joint_stages(views, poses, others, seek, fit)
    within = {v.id for v in views}
    others = [
        *(v for v in others if v.id not in within),
        *(views[k] for k in np.flatnonzero(odd)),
    ]
    views, poses = [views[k] for k in np.flatnonzero(~odd)], poses[~odd]
    vessel = vessel_stage(shots, views, poses, last, fit)
    return PileStart(views, poses, others, last, arrived, vessel)


def shaped_from(start: PileStart, found: FoundViews, stage, fit: FitContext) -> PileShape:
    """The volume pass, and the views that are found in its model."""
    run, options, seed, views = fit.run, fit.options, fit.seed, start.views
    before = {v.id: p for v, p in zip(found.views, found.poses, strict=True)}
    model, bank, poses = shape_and_poses(
        views,
        start.poses,
        run,
        stage,
        options,
        seed,
        start.last and start.last.symmetry,
        still=start.arrived,
        vessel=start.vessel,
    )
    guessed: list[tuple[InstanceView, np.ndarray]] = []
    if start.others and pose_rate(views, options) > 0 and "search" not in options.without:
        stayed = [k for k, v in enumerate(views) if v.id in before]
        earlier = np.array([before[views[k].id] for k in stayed])
        on_axes = carried(found.on_axes, earlier, poses[stayed])
        views, poses, guessed = with_found(
            views, poses, start.others, on_axes, model, bank, run, seed
        )
    return PileShape(
        volume_result(model, bank),
        tuple(v.id for v in views),
        poses,
        start.follow,
        tuple(v.id for v, _ in guessed),
        np.array([p for _, p in guessed]).reshape(-1, 4, 4),
    )


@dataclass(frozen=True)
class OpenedVessel:
    """values: (n, n, n) distances that the finer levels of the volume pass begin with, or None."""

    values: np.ndarray | None


def vessel_stage(
    shots: list[Shot], views: list[InstanceView], poses: np.ndarray, last: Pass, fit: FitContext
) -> np.ndarray | None:
    """Distances that the finer levels of the volume pass begin with, where the object is a body of
    revolution whose ends silhouettes do not show as they are (`vessel_of`); None for others. last:
    the pass before."""
    options = fit.options
    if "vessels" in options.without or len(options.levels) < 2:
        return None
    found = fit.run.cached(
        "vessel",
        OpenedVessel,
        lambda stage: OpenedVessel(opened_vessel(shots, views, poses, last, fit)),
        title="mouths and lids",
    )
    return found.values


def opened_vessel(
    shots: list[Shot], views: list[InstanceView], poses: np.ndarray, last: Pass, fit: FitContext
) -> np.ndarray | None:
    """See `vessel_stage`."""
    run, options, seed = fit.run, fit.options, fit.seed
    values = redistance(resample(last.values, options.levels[1]))
    if body_axis(extract_mesh(values)) is not None:
        # the last pass has built it where the poses were before
        values = built_again(views, poses, last.symmetry, run, options, seed)
    scene = related(views, poses)
    inside = [v.rgb[v.mask > 0.99].mean(0) for v in views]

    def lit(mesh: Mesh) -> LitPile:
        even = [np.tile(level, (len(mesh.vertices), 1)) for level in inside]
        pile = placed_pile(mesh, views, scene, even)
        if "ground" not in options.without:
            pile = replace(pile, plane=find_ground(mesh.vertices, pile.poses))
        alone = "visibility" in options.without
        return lit_pile(shots, shots[0][1], pile, options.max_pixels, alone=alone)

    o, show = pile_surface_options(options), run.progress("mouths and lids")
    return vessel_of(values, views, poses, lit, o, run.say, seed, show)


def built_again(
    views: list[InstanceView],
    poses: np.ndarray,
    symmetry: Symmetry | None,
    run,
    options: DuplicatesOptions,
    seed: int,
) -> np.ndarray:
    """Distances (n, n, n) of the shape where the poses are now, which stay, on the middle level."""
    coarse = replace(options, levels=options.levels[:2], level_steps=options.level_steps[:2])
    model, _, _ = shape_and_poses(views, poses, run, NoStage(), coarse, seed, symmetry, still=True)
    return redistance(dense_values(model.grid))

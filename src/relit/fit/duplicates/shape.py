"""The shape of identical objects: the volume pass in the object's frame with the poses of all
instances, who is left out of it and who is found again, the mesh, and the ground that they stand
on. For the recipe `duplicates`.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from relit.fit.duplicates.lit_pile import LitPile, lit_pile, pile_surface_options
from relit.fit.duplicates.mirrored_silhouettes import Symmetry
from relit.fit.duplicates.options import DuplicatesOptions
from relit.fit.duplicates.photo_motions import SharedScene
from relit.fit.duplicates.pose_passes import (
    JOINT,
    followed,
    joint_stages,
    motion_or_none,
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
from relit.fit.registration.instances.views import InstanceView
from relit.fit.shape.loose_parts import without_loose_parts
from relit.geometry.atlas import unwrap
from relit.geometry.mesh import extract_mesh
from relit.geometry.sdf import dense_values, redistance, resample, row_features
from relit.recipe import FitContext
from relit.rendering.appearance.world_light import instance_radiance
from relit.run import run_arrays
from relit.scene import Mesh


def shape_stages(
    shots: list[Shot],
    views: list[InstanceView],
    poses: np.ndarray,
    others: list[InstanceView],
    on_axes: dict[int, np.ndarray],
    fit: FitContext,
) -> dict[str, np.ndarray]:
    """Volume pass, mesh, ground. shots: the photos. others: views without poses; on_axes: by key,
    poses of such as are right up to a turn about the object's y axis. Returns (and keeps) vertices,
    faces, normals, uvs, base (V, 3), plane (point, normal) or empty; for each instance poses (K, 4,
    4) object_from_first_photo, radiance (K, V, 3) and key (that of its first view); motions (P, 4,
    4) first_from_photo and related (P,) bool; view_keys (N,) of what is shown by the related
    photos, and view_instances (N,) which of the instances it is; vague, keys of those whose turn
    about the axis is a guess."""
    run, options = fit.run, fit.options
    views, poses, model, follow, vague = volume_stage(shots, views, poses, others, on_axes, fit)
    rate = pose_rate(views, options)
    with run.stage("mesh", title="mesh, atlas, ground") as stage:
        mesh, views, poses, values, placed = placed_surface(
            dense_values(model.grid), views, poses, follow, vague, run, options
        )
        mesh, how = unwrap(mesh, options.texture)
        if how != "xatlas":
            run.say(
                "note: the mesh was too difficult for charts; its atlas has one cell for every two faces"
            )
        rows = row_features(model.grid)
        scene = related(views, poses)
        to_first = scene.motions if len(scene.motions) > 1 else [np.eye(4)]
        told = mesh.vertices if placed is None else told_at(mesh.vertices, placed, len(values))
        seen = [
            instance_radiance(
                model.grid,
                rows,
                model.reflections,
                told,
                mesh.normals,
                motion_or_none(to_first[v.photo]) @ np.linalg.inv(p),
                k,
            )
            for k, (v, p) in enumerate(zip(views, poses, strict=True))
        ]
        parts = parts_of(mesh, views, scene, [one[0] for one in seen])
        poses = parts["poses"]
        plane = (
            np.zeros((0, 3)) if "ground" in options.without else find_ground(mesh.vertices, poses)
        )
        if len(plane) and rate > 0 and len(scene.motions) == 1:
            poses, plane, count = set_down(mesh.vertices, poses, plane, distance_in(values))
            if count:
                run.say(
                    f"{count} instances were moved along their lines of sight towards the ground, or what they rest on"
                )
        if len(plane) == 0:
            run.say(
                "note: no ground was found that the instances stand on; nothing but they themselves casts shadows"
            )
        parts |= {
            "faces": mesh.faces,
            "normals": mesh.normals,
            "uvs": mesh.uvs,
            "base": seen[0][1],
            "poses": poses,
            "plane": plane,
            "vague": np.array([v.key for v, _ in vague], int),
        }
        stage.save("mesh", **parts)
    return parts


def placed_surface(
    values: np.ndarray,
    views: list[InstanceView],
    poses: np.ndarray,
    follow,
    vague,
    run,
    options: DuplicatesOptions,
):
    """(mesh, views, poses, values, placed) of the shape `values` (n, n, n), with mesh and poses
    where outlines and textures have them, and the vague ones (see `volume_stage`) among the views.
    values, placed: where the mesh is closed over what is seen, the distances of that and the
    vertices (V', 3) of what the volume pass has built; else as they were, and None."""
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
    if vague:
        there, turned = [v for v, _ in vague], np.array([p for _, p in vague])
        if follow is not None:
            _, turned, _ = placed_by_outlines(mesh, there, turned, run, options, still=True)
        views, poses = [*views, *there], np.concatenate([poses, turned])
    if not gone:
        return mesh, views, poses, values, None
    placed = mesh.vertices  # poses have followed what silhouettes have made, not the guess
    return moved_along(closed, built, placed), views, poses, values, placed


def parts_of(
    mesh: Mesh, views: list[InstanceView], scene: SharedScene, radiance: list[np.ndarray]
) -> dict[str, np.ndarray]:
    """Which instances stand where, and which views show them, as `shape_stages` returns it.
    radiance: (V, 3) of the mesh's vertices in each view."""
    shown = [np.flatnonzero(scene.of_view == n) for n in range(len(scene.standing))]
    return {
        "vertices": mesh.vertices,
        "radiance": np.stack([np.mean([radiance[k] for k in some], 0) for some in shown]),
        "poses": np.linalg.inv(scene.standing),
        "keys": np.array([views[some[0]].key for some in shown]),
        "view_keys": np.array([v.key for v, n in zip(views, scene.of_view, strict=True) if n >= 0]),
        "view_instances": scene.of_view[scene.of_view >= 0],
        "motions": np.array([motion_or_none(m) for m in scene.motions]),
        "related": np.array([m is not None for m in scene.motions]),
    }


def volume_stage(
    shots: list[Shot],
    views: list[InstanceView],
    poses: np.ndarray,
    others: list[InstanceView],
    on_axes: dict[int, np.ndarray],
    fit: FitContext,
):
    """(views, poses, model, follow, vague) after the volume pass, from the poses of the first ones.
    Instances that do not agree with their model are left out; they, and `others`, which the search
    could not place, are then sought in the finished model. follow: what brings mesh and poses to
    where outlines have them, `followed` or `placed_by_outlines`, or None where they stay. vague:
    (view, pose) of those whose axis alone is told, by `on_axes` (see `shape_stages`) or by the
    silhouette in the model."""
    run, options, seed = fit.run, fit.options, fit.seed
    arrived, symmetry, vessel, follow, vague = False, None, None, None, []
    before = {v.key: p for v, p in zip(views, poses, strict=True)}
    if pose_rate(views, options) > 0:
        seek = partial(joiners, run=run, options=options, seed=seed)
        views, poses, odd, arrived, last = joint_stages(views, poses, others, seek, fit)
        symmetry, follow = last.symmetry, followed
        # outlines and textures have had their say by the shape of the pass before; where they
        # agree, this one may follow both
        if arrived:
            follow = placed_by_outlines if last.exact else None
        within = {v.key for v in views}
        others = [
            *(v for v in others if v.key not in within),
            *(views[k] for k in np.flatnonzero(odd)),
        ]
        views, poses = [views[k] for k in np.flatnonzero(~odd)], poses[~odd]
        vessel = vessel_stage(shots, views, poses, symmetry, fit)
    steps = sum(options.level_steps) if vessel is None else sum(options.level_steps[1:])
    with run.stage("volume", steps=steps, title="shape and poses (volume pass)") as stage:
        model, bank, poses = shape_and_poses(
            views, poses, run, stage, options, seed, symmetry, still=arrived, vessel=vessel
        )
        if others and pose_rate(views, options) > 0 and "search" not in options.without:
            stayed = [k for k, v in enumerate(views) if v.key in before]
            on_axes = carried(
                on_axes, np.array([before[views[k].key] for k in stayed]), poses[stayed]
            )
            views, poses, vague = with_found(views, poses, others, on_axes, model, bank, run, seed)
        return views, poses, model, follow, vague


def vessel_stage(
    shots: list[Shot],
    views: list[InstanceView],
    poses: np.ndarray,
    symmetry: Symmetry | None,
    fit: FitContext,
) -> np.ndarray | None:
    """Distances that the finer levels of the volume pass begin with, where the object is a body of
    revolution whose ends silhouettes do not show as they are (`fit.duplicates.vessel_trial.vessel_of`); None
    for others."""
    run, options, seed = fit.run, fit.options, fit.seed
    if "vessels" in options.without or len(options.levels) < 2:
        return None
    if run.done("vessel"):
        found = run_arrays(run, "vessel", "vessel")["values"]
        return found if found.size else None
    last = [name for name in JOINT if run.done(name)][-1]
    with run.stage("vessel", title="mouths and lids") as stage:
        values = redistance(
            resample(run_arrays(run, last, "checkpoint")["values"], options.levels[1])
        )
        if (
            body_axis(extract_mesh(values)) is not None
        ):  # the last pass has built it where the poses were before
            values = built_again(views, poses, symmetry, run, options, seed)
        scene = related(views, poses)
        inside = [v.rgb[v.mask > 0.99].mean(0) for v in views]

        def lit(mesh: Mesh) -> LitPile:
            parts = parts_of(
                mesh, views, scene, [np.tile(level, (len(mesh.vertices), 1)) for level in inside]
            )
            parts["plane"] = (
                np.zeros((0, 3))
                if "ground" in options.without
                else find_ground(mesh.vertices, parts["poses"])
            )
            return lit_pile(
                shots,
                shots[0][1],
                mesh,
                parts,
                options.max_pixels,
                alone="visibility" in options.without,
            )

        found = vessel_of(
            values,
            views,
            poses,
            lit,
            pile_surface_options(options),
            run.say,
            seed,
            run.progress("mouths and lids"),
        )
        stage.save("vessel", values=np.zeros((0, 0, 0), np.float32) if found is None else found)
    return found


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

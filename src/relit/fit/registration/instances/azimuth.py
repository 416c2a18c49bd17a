"""The turn of an instance about the axis of its body, by what the others show.

The silhouette of a body of revolution tells all but that turn, and one that is mostly hidden may
have been placed by it alone. A pattern matches itself within a few degrees, and only where the axis
is right too. So the evidence of all turns names a few places (`pattern_evidence`), each of these is laid
on its outline and descends then by what the others show too (one Gauss-Newton step of
`fit.shape.alignment` after another, for the pose of this view alone): textures that are met from an
axis that leans by two degrees would hold it there. Of where they end the one is taken at which the
pictures are most likely of the same thing (`likelihood`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import mitsuba as mi
import numpy as np

from relit.conventions import similarity
from relit.fit.registration.instances.views import InstanceView
from relit.fit.shape.alignment import LABELS, has_converged, outline_rows, solved, texture_rows
from relit.fit.shape.outlines import follow_with_poses
from relit.fit.shape.texture_shifts import (
    ACROSS,
    NEIGHBOURS,
    OVERLAP,
    PATCH,
    Shown,
    around,
    brought_to,
    clear_of,
    contrasts,
    covisible_pixels,
    display_channels,
    shifts_between,
    shown_by,
    structure_of,
    texture_shifts,
    tint_of,
)
from relit.geometry.revolution_axis import Axis
from relit.geometry.se3 import exp_so3
from relit.reference.mitsuba_scene import build_geometry
from relit.scene import Camera, Mesh

TURNS, SHRUNK = 120, 2  # that are compared, and by what pictures are smaller then
PLACES = 8  # that descend
OUTLINED, ROUNDS = 4, 8  # rounds of their descent: by outlines alone, then by both
# degrees by which the axis leans after a descent that was led astray: the silhouette had told it
# better
ASTRAY = 3.0
# correlation of what two views show of the same place: of views at their true poses .4 to .7
EXPECTED = 0.6


@dataclass(frozen=True)
class Others:
    """What views at known poses show of a mesh, (h, w, 3) `channels` as
    `texture_shifts.display_channels` has them against `tint`. clear: the structure from which on places
    count in full, see `texture_shifts.flow_weights`."""

    mesh: Mesh
    scene: mi.Scene
    cameras: list[Camera]
    masks: list[np.ndarray]
    channels: list[np.ndarray]
    tint: np.ndarray
    clear: float


def others_of(mesh: Mesh, views: list[InstanceView], poses: np.ndarray) -> Others | None:
    """Of views at poses (N, 4, 4); None where they do not tell the same place from another one: no
    texture."""
    cameras = [v.camera.with_pose(p) for v, p in zip(views, poses, strict=True)]
    pictures, masks = [v.rgb for v in views], [v.mask for v in views]
    shifts = texture_shifts(mesh, cameras, pictures, masks)
    if not shifts:
        return None
    scene, tint = build_geometry(mesh), tint_of(pictures, masks)
    return Others(
        mesh,
        scene,
        cameras,
        masks,
        [display_channels(p, tint) for p in pictures],
        tint,
        clear_of(shifts),
    )


def turned_alike(others: Others, view: InstanceView, pose: np.ndarray, axis: Axis) -> np.ndarray:
    """The pose (4, 4) of a view, right up to a turn about the axis, with which it shows what the
    others show. A guess even where one place
    is clearly the likeliest: half a turn of a pattern that repeats can look more alike than its
    own."""
    turns = all_turns(pose, axis, TURNS)
    evidence = pattern_evidence(shrunk_others(others), shrunk_view(view), turns)
    peaks = np.flatnonzero((evidence >= np.roll(evidence, 1)) & (evidence >= np.roll(evidence, -1)))
    starts = [
        on_outline(others, view, turns[k]) for k in peaks[np.argsort(-evidence[peaks])[:PLACES]]
    ]
    ends = [descended_alike(others, view, start) for start in starts]
    ends = [
        end if leaning(end, start, axis) < ASTRAY else start
        for start, end in zip(starts, ends, strict=True)
    ]
    return ends[int(np.argmax([likelihood(others, view, p) for p in ends]))]


def shrunk_view(view: InstanceView) -> InstanceView:
    """The view, its pictures SHRUNK: a pattern that is laid on itself within a few degrees is not
    told by its finest detail."""
    picture, mask, known = (smaller(a) for a in (view.rgb, view.mask, view.known))
    return replace(
        view,
        camera=view.camera.resized(mask.shape[1], mask.shape[0]),
        rgb=picture,
        mask=mask,
        known=known,
    )


def shrunk_others(others: Others) -> Others:
    """As `shrunk_view`."""
    masks, channels = [smaller(m) for m in others.masks], [smaller(c) for c in others.channels]
    cameras = [
        c.resized(m.shape[1], m.shape[0]) for c, m in zip(others.cameras, masks, strict=True)
    ]
    return replace(others, cameras=cameras, masks=masks, channels=channels)


def smaller(picture: np.ndarray) -> np.ndarray:
    """(h / SHRUNK, w / SHRUNK, ...) of a picture (h, w, ...)."""
    height, width = (max(1, round(side / SHRUNK)) for side in picture.shape[:2])
    return cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)


def leaning(one: np.ndarray, other: np.ndarray, axis: Axis) -> float:
    """Degrees between the axis in the picture as two poses (4, 4) have it."""
    a, b = (p[:3, :3].T @ axis.direction for p in (one, other))
    return float(np.degrees(np.arccos(np.clip(a @ b, -1, 1))))


def all_turns(pose: np.ndarray, axis: Axis, count: int) -> np.ndarray:
    """(count, 4, 4): the pose with the object turned about its axis."""
    return np.array([turned_by(pose, axis, a) for a in np.arange(count) * 2 * np.pi / count])


def turned_by(pose: np.ndarray, axis: Axis, angle: float) -> np.ndarray:
    """The pose with the object turned about an axis, by radians."""
    turn = exp_so3(angle * axis.direction)
    return similarity(turn, axis.point - turn @ axis.point) @ pose


def pattern_evidence(others: Others, view: InstanceView, poses: np.ndarray) -> np.ndarray:
    """(K,) evidence, for each of poses (K, 4, 4) of a view, that it shows the same pattern as those
    of the others that look from the
    nearest sides: - n / 2 log(1 - ρ²) for each, ρ the correlation of their brightness, freed of
    what is local, and n the patches that both show."""
    own, out = display_channels(view.rgb, others.tint)[..., 0], []
    for pose in poses:
        evidence = 0.0
        camera, shown = view_at_pose(others, view, pose)
        for j in np.argsort(-cosines_to(others, camera))[:NEIGHBOURS]:
            both, x, y = covisible_pixels(others.scene, shown, others.cameras[j], others.masks[j])
            if both.sum() < OVERLAP:
                continue
            theirs = brought_to(shown, others.channels[j][..., 0], x, y)
            rho, n = correlation(contrasts(own, both), contrasts(theirs, both), both)
            evidence -= np.sign(rho) * n / 2 * np.log1p(-(rho**2))
        out.append(evidence)
    return np.array(out)


def likelihood(others: Others, view: InstanceView, pose: np.ndarray) -> float:
    """How much likelier it is that the view at a pose (4, 4) shows the same places as the others
    than that it shows unrelated ones, as a
    logarithm: each patch of each channel is a pair of normal variables, of the correlation EXPECTED
    or of none, and counts by its structure. So what one view shows clearly and another one does not
    speaks against the pose."""
    own, total = display_channels(view.rgb, others.tint), 0.0
    camera, shown = view_at_pose(others, view, pose)
    for j in np.flatnonzero(cosines_to(others, camera) > np.cos(np.radians(ACROSS))):
        both, x, y = covisible_pixels(others.scene, shown, others.cameras[j], others.masks[j])
        if both.sum() < OVERLAP:
            continue
        for a, theirs in zip(
            np.moveaxis(own, -1, 0), np.moveaxis(others.channels[j], -1, 0), strict=True
        ):
            a, b = contrasts(a, both), contrasts(brought_to(shown, theirs, x, y), both)
            structure = np.maximum(structure_of(a, both), structure_of(b, both))
            rho, n = correlation(
                a, b, around(np.minimum(structure / others.clear, 1).astype(np.float32) ** 2)
            )
            total += n * (
                (rho - EXPECTED) * EXPECTED / (1 - EXPECTED**2) - 0.5 * np.log1p(-(EXPECTED**2))
            )
    return total


def correlation(a: np.ndarray, b: np.ndarray, weight: np.ndarray) -> tuple[float, float]:
    """(of two pictures of contrasts (h, w), by weights (h, w); the patches that it rests on)."""
    size = np.sqrt((weight * a * a).sum() * (weight * b * b).sum())
    return float(np.clip((weight * a * b).sum() / max(size, 1e-6), -0.99, 0.99)), float(
        weight.sum() / (np.pi * PATCH**2)
    )


def on_outline(others: Others, view: InstanceView, pose: np.ndarray) -> np.ndarray:
    """The pose (4, 4) with which the mesh's outline lies on the view's mask where that is known;
    from one that is off by a few pixels."""
    camera, scene = view.camera.with_pose(pose), others.scene
    return follow_with_poses(
        others.mesh, [camera], [view.mask], [view.known], OUTLINED, still=True, scene=scene
    )[1][0]


def descended_alike(others: Others, view: InstanceView, pose: np.ndarray) -> np.ndarray:
    """The pose (4, 4) of a view after at most ROUNDS steps by which what it shows comes to lie on
    what the others show, and its outline on the mask; the mesh and the others stay."""
    camera, mask = view.camera.with_pose(pose), view.mask * view.known
    channels = [display_channels(view.rgb, others.tint), *others.channels]
    for _ in range(ROUNDS):
        before, shown = camera, shown_by(others.mesh, others.scene, camera, mask)
        cameras, cosines = [camera, *others.cameras], cosines_to(others, camera)
        near = [
            k + 1
            for k in np.argsort(-cosines)[:NEIGHBOURS]
            if cosines[k] > np.cos(np.radians(ACROSS))
        ]
        pairs = [(0, k, shown, others.masks[k - 1]) for k in near]
        shifts = shifts_between(others.mesh, others.scene, pairs, cameras, channels)
        rows, _ = outline_rows(
            others.mesh, [camera], [view.mask], [view.known], LABELS, others.scene
        )
        rows += [
            replace(r, poses=[one for one in r.poses if one[0][0] == 0])
            for r in (texture_rows(shifts, cameras) if shifts else [])
        ]
        camera = solved(others.mesh, [camera], rows, still=True)[1][0]
        if has_converged([before], [camera]):
            break
    return np.asarray(camera.world_from_camera)


def view_at_pose(others: Others, view: InstanceView, pose: np.ndarray) -> tuple[Camera, Shown]:
    """The view's camera at a pose (4, 4), and what it shows of the mesh."""
    camera = view.camera.with_pose(pose)
    return camera, shown_by(others.mesh, others.scene, camera, view.mask * view.known)


def cosines_to(others: Others, camera: Camera) -> np.ndarray:
    """(N,) of the angles between a camera's line of sight and theirs."""
    sides = np.array([c.centre / np.linalg.norm(c.centre) for c in others.cameras])
    return sides @ camera.centre / np.linalg.norm(camera.centre)

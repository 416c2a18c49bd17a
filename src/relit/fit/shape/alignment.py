"""Poses and mesh as outlines and textures have them together, where the two disagree.

`fit.shape.outlines` believes the labels to a tenth of a pixel, and poses follow them. Labels that
people or networks draw leave out wheels, cut corners and waver by a pixel or two; poses that follow
those blur the texture, as each instance paints it in another place. So the textures are asked
(`fit.shape.texture_shifts`): where they lie clearly off, labels or shape are wrong, and outlines
and textures are solved for together, each weighted by what its samples scatter. Labels that agree
are left alone: they know more than optical flow does. Where no poses bring textures to lie on one
another, it is the shape that is wrong, often by the depth of a whole side, and from where labels
have left it it may bend further.

One Gauss-Newton step for all poses and the displacements d of the vertices along their normals n. A
place X that view j shows where view i shows it too moves in view i by

    J_i δξ_i - M J_j δξ_j + (J_i n - M J_j n) d,    M = (J_i T) (J_j T)^-1

with J the derivatives of the projections and T (3, 2) the tangents of the surface there: what moves
in view j takes another piece of the surface, M brings that into view i.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import bmat, coo_matrix, diags, identity

from relit.fit.shape.outlines import (
    FAR,
    FARTHEST,
    REST,
    STIFF,
    after_motion,
    by_motion,
    follow_with_poses,
    laplacian,
    moved_along_normals,
    outline_of,
    precision,
    spread_of,
)
from relit.fit.shape.sparse import solved_symmetric
from relit.fit.shape.texture_shifts import Shifts, flow_weights, shift_quantile, texture_shifts
from relit.geometry.se3 import turns_apart
from relit.reference.mitsuba_scene import build_geometry
from relit.scene import Camera, Mesh

EXACT = 0.7  # pixels by which textures may be off before they have a part in it
TEXTURES, BOTH, SOFT = (
    6,
    8,
    16,
    # rounds: poses as textures have them, then poses and mesh as both have them, or both of a softer
    # mesh
)
SETTLED = 0.02  # degrees by which a pose turns in the last one
# of the shifts: a wrong shape can bring most of them, by poses that are far off, within half a
# pixel, but leaves these 2
NEARLY_ALL = 0.9
SHARP, WHOLLY = (
    1.0,
    0.2,
    # pixels that textures alone may leave of these, and share of what labels leave, before the shape is
    # doubted
)
YIELDING = 150.0, 0.1  # of a softer mesh, in the place of STIFF and REST
LABELS = 0.7  # pixels; what has contradicted textures is told no better than this
FAINTEST = 0.15  # pixels; flow is told no better than this
OUTLIER = 3.0  # spreads; a shift of so much counts a quarter
TWO_WAYS = 2.0  # what a pair counts, that is looked at once: for each of its views
SLANTED = 4.0  # size of M up to which a place is told
DAMPED = 1e-4  # of the diagonal: the frame of all poses is free
TURN = np.radians(3.0)  # of a pose, in one round


@dataclass(frozen=True)
class Rows:
    """Linear equations in pixels. poses: [(views (N,), (N, 6) derivatives)]. corners, along: (N, 3)
    vertices and derivatives by their displacements. shift: (N,) what is asked for. trust: (N,) its
    weight."""

    poses: list[tuple[np.ndarray, np.ndarray]]
    corners: np.ndarray
    along: np.ndarray
    shift: np.ndarray
    trust: np.ndarray


def follow_views(
    mesh: Mesh, cameras: list[Camera], pictures, masks, known, rounds: int
) -> tuple[Mesh, np.ndarray, tuple[float, float] | None]:
    """(mesh, poses (N, 4, 4), off) as outlines have them, and where these contradict the textures
    as both have them. off: pixels by which textures do not lie on one another (median), as outlines
    alone have it and as both; None where textures have no part in it.

    mesh: welded, with normals. cameras: in its frame, whose origin the object is about. pictures:
    (h, w, 3) linear, masks, known: (h, w) of each view, see `outlines.follow_with_poses`. rounds:
    of outlines alone.
    """
    outlined, poses = follow_with_poses(mesh, cameras, masks, known, rounds)
    start = with_poses(cameras, poses)
    shifts = texture_shifts(outlined, start, pictures, masks)
    before = shift_quantile(shifts)
    if before <= EXACT:
        return outlined, poses, None
    placed, left = by_textures(outlined, start, shifts, pictures, masks)
    if shift_quantile(left, NEARLY_ALL) < min(SHARP, WHOLLY * shift_quantile(shifts, NEARLY_ALL)):
        found, placed, left = by_both(outlined, placed, left, pictures, masks, known, BOTH)
    else:  # not the labels, then: the shape
        found, placed, left = by_both(
            outlined, start, shifts, pictures, masks, known, SOFT, YIELDING
        )
    after = shift_quantile(left)
    if not 0 < after < before:
        return outlined, poses, None
    return found, np.array([c.world_from_camera for c in placed]), (before, after)


def by_textures(
    mesh: Mesh, placed: list[Camera], shifts: list[Shifts], pictures, masks
) -> tuple[list[Camera], list[Shifts]]:
    """(cameras, shifts) after at most TEXTURES rounds in which textures alone move the cameras.
    shifts: as all stands."""
    for _ in range(TEXTURES):
        if not shifts:
            break
        before = placed
        placed = solved(mesh, placed, texture_rows(shifts, placed), still=True)[1]
        shifts = texture_shifts(mesh, placed, pictures, masks)
        if has_converged(before, placed):
            break
    return placed, shifts


def by_both(
    mesh: Mesh,
    placed: list[Camera],
    shifts: list[Shifts],
    pictures,
    masks,
    known,
    rounds: int,
    softer: tuple[float, float] | None = None,
) -> tuple[Mesh, list[Camera], list[Shifts]]:
    """(mesh, cameras, shifts) after at most so many rounds in which outlines and textures move
    both. shifts: as all stands. softer: in the place of STIFF and REST; outlines then count however
    far they are off."""
    spread = 0.0
    for _ in range(rounds):
        if not shifts:
            break
        before, rows = placed, texture_rows(shifts, placed)
        outlines, spread = outline_rows(
            mesh, placed, masks, known, max(spread, LABELS) if softer else 0.0
        )
        mesh, placed = solved(mesh, placed, rows + outlines, stiffness=softer or (STIFF, REST))
        shifts = texture_shifts(mesh, placed, pictures, masks)
        if has_converged(before, placed):
            break
    return mesh, placed, shifts


def has_converged(before: list[Camera], after: list[Camera]) -> bool:
    """Whether a round has turned no camera by more than SETTLED."""
    turns = turns_apart(
        *(np.array([c.world_from_camera for c in cameras]) for cameras in (before, after))
    )
    return bool(np.max(turns) <= SETTLED)


def with_poses(cameras: list[Camera], poses: np.ndarray) -> list[Camera]:
    return [c.with_pose(p) for c, p in zip(cameras, poses, strict=True)]


def projection(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives (N, 2, 3) of the pixel by the point, and (N, 2, 6) by a motion of the camera's
    frame: a turn about the object's origin and a translation, both in the camera's axes."""
    m = camera.camera_from_world
    q = points @ m[:3, :3].T + m[:3, 3]
    by_place = np.zeros((len(q), 2, 3))
    by_place[:, 0, 0], by_place[:, 1, 1] = camera.fx / q[:, 2], camera.fy / q[:, 2]
    by_place[:, 0, 2], by_place[:, 1, 2] = (
        -camera.fx * q[:, 0] / q[:, 2] ** 2,
        -camera.fy * q[:, 1] / q[:, 2] ** 2,
    )
    return by_place @ m[:3, :3], np.concatenate(
        [np.cross((q - m[:3, 3])[:, None], by_place), by_place], -1
    )


def tangents(normals: np.ndarray) -> np.ndarray:
    """(N, 3, 2) two unit tangents of unit normals (N, 3)."""
    other = np.where(np.abs(normals[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]])
    first = np.cross(normals, other)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(normals, first)], -1)


def texture_rows(shifts: list[Shifts], cameras: list[Camera]) -> list[Rows]:
    """Two equations for each place, x and y."""
    spread = max(
        1.48 * shift_quantile(shifts) / 1.18, FAINTEST
    )  # of one coordinate: the median length is 1.18 deviations
    out = []
    for s, share in zip(shifts, flow_weights(shifts), strict=True):
        here, turn_here = projection(cameras[s.view], s.point)
        there, turn_there = projection(cameras[s.other], s.point)
        t = tangents(s.normal)
        m = (here @ t) @ np.linalg.pinv(there @ t)
        along = ((here - m @ there) @ s.normal[..., None])[..., 0]
        far = np.linalg.norm(s.shift, axis=1) / (OUTLIER * spread)
        trust = (
            TWO_WAYS
            * (np.linalg.norm(m, axis=(1, 2)) < SLANTED)
            * share
            / (spread * (1 + far**2)) ** 2
        )
        views = np.full(len(far), s.view), np.full(len(far), s.other)
        for axis in (0, 1):
            poses = [(views[0], turn_here[:, axis]), (views[1], -(m @ turn_there)[:, axis])]
            out.append(
                Rows(poses, s.corners, s.weights * along[:, axis, None], s.shift[:, axis], trust)
            )
    return out


def outline_rows(
    mesh: Mesh, cameras: list[Camera], masks, known, least: float = 0.0, scene=None
) -> tuple[list[Rows], float]:
    """One equation for each sample of the outlines, across them; and their spread in pixels.

    least: spread that is taken at least; where it is given nearly all samples count, however far
    they are off: those that are farthest off tell most of a wrong shape. Without, they are outliers
    (`outlines.precision`). scene: of `build_geometry`, where there is one.
    """
    scene = scene or build_geometry(mesh)
    found = [
        outline_of(mesh, scene, c, m, k) for c, m, k in zip(cameras, masks, known, strict=True)
    ]
    shift = np.concatenate([o.shift for o in found])
    spread = max(spread_of(shift) if len(shift) else 0.0, least)
    trust = precision(shift, spread, max(FAR, OUTLIER * spread) if least else FAR)
    trust = np.split(trust, np.cumsum([len(o.shift) for o in found])[:-1])
    out = []
    for i, (camera, o, weight) in enumerate(zip(cameras, found, trust, strict=True)):
        across = by_motion(camera, o, camera.camera_from_world[:3, 3])
        out.append(
            Rows(
                [(np.full(len(weight), i), across)],
                o.corners,
                o.weights * o.scale[:, None],
                o.shift,
                weight,
            )
        )
    return out, spread


def solved(
    mesh: Mesh,
    cameras: list[Camera],
    rows: list[Rows],
    still: bool = False,
    stiffness: tuple[float, float] = (STIFF, REST),
) -> tuple[Mesh, list[Camera]]:
    """Mesh and cameras after one weighted least-squares step. still: the mesh stays. stiffness: as
    `outlines.STIFF` and `outlines.REST`."""
    n, vertices = len(cameras), len(mesh.vertices)
    starts = np.cumsum([0, *(len(r.shift) for r in rows)])
    line, column, value = [], [], []
    for r, start in zip(rows, starts[:-1], strict=True):
        number = start + np.arange(len(r.shift))
        parts = [(6 * views[:, None] + np.arange(6), by_motion) for views, by_motion in r.poses]
        for columns, values in parts if still else [*parts, (6 * n + r.corners, r.along)]:
            line.append(np.repeat(number, columns.shape[1]))
            column.append(columns.ravel())
            value.append(values.ravel())
    unknowns = 6 * n + (0 if still else vertices)
    a = coo_matrix(
        (np.concatenate(value), (np.concatenate(line), np.concatenate(column))),
        (starts[-1], unknowns),
    ).tocsr()
    trust, shift = (np.concatenate([getattr(r, name) for r in rows]) for name in ("trust", "shift"))
    normal = a.T @ diags(trust) @ a
    damping = diags(DAMPED * normal.diagonal()[: 6 * n] + 1e-9)
    pixels = float(
        np.median([c.fx / np.linalg.norm(c.centre) for c in cameras])
    )  # of a unit length
    if not still:
        smooth = pixels * laplacian(mesh.faces, vertices)
        stiff, rest = stiffness
        damping = bmat(
            [
                [damping, None],
                [None, stiff * (smooth.T @ smooth) + rest * pixels**2 * identity(vertices)],
            ]
        )
    step = solved_symmetric(normal + damping, a.T @ (trust * shift))
    placed = [
        camera_after_motion(c, s) for c, s in zip(cameras, step[: 6 * n].reshape(n, 6), strict=True)
    ]
    return (
        mesh
        if still
        else moved_along_normals(
            mesh, np.clip(step[6 * n :], -FARTHEST / pixels, FARTHEST / pixels)
        )
    ), placed


def camera_after_motion(camera: Camera, step: np.ndarray) -> Camera:
    """The camera after a motion (6,) of what it sees, see `projection`; a turn of more than TURN
    shortens it."""
    shorter = min(1.0, TURN / max(float(np.linalg.norm(step[:3])), 1e-12))
    return camera.with_pose(after_motion(camera, shorter * step, camera.camera_from_world[:3, 3]))

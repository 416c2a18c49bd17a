"""A mesh that is nearly a body of revolution, made one where it is nearly that.

Few photos tell the height of every bump, and what a pass makes of gloss that it does not explain is
ripples: small in distances, but by their normals a metal mirrors other things. A body of revolution
says the same place of its profile many times, once for every turn. So all vertices are looked at in
the half plane of the axis, and each is moved along its normal there onto the curve that most of
those near
it lie on: robust moving least squares (Fleishman et al. 2005, "Robust moving least-squares fitting
with sharp features", for surfaces). What stands out of that curve, handles and windows, or is not
all around, stays.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from relit.geometry.mesh import vertex_areas
from relit.geometry.revolution_axis import Axis
from relit.geometry.tangents import vertex_normals
from relit.scene import Mesh

CENTRED, ROUNDS = 3, 2  # steps of the axis, then of the vertices
SPARSE = 4  # of so many vertices one is asked about the axis
WIDE = 2.0  # steps of the grid, along the profile
NEAR, FARTHEST = (
    0.8,
    1.5,
)  # steps beside it: what lies so far counts little; no vertex is moved so far
FITS = 5  # of each parabola, the first two with twice NEAR
TURNS = 24  # bins about the axis
AROUND = (
    0.4,
    0.65,
)  # share of the bins that show the curve, below which a vertex stays and from which on it is moved
ON_IT = 0.75, 0.9  # the same of what lies near along the profile, by area
ALONG = (
    0.9,
    0.98,
)  # the same of the length of a normal that lies in the half plane: others are of no profile
FLAT = np.array([0.0, 1e-3, 1e-2])  # of a parabola's slope and bend, what is not told otherwise
AT_ONCE, CLOUD = 2000, 4000  # vertices that are moved at once; that tell the curves, at most


def rounded(mesh: Mesh, axis: Axis, step: float) -> Mesh:
    """The mesh, its vertices moved by less than FARTHEST steps, and its normals as they are then.
    axis: nearly that of the body. step: of the grid that the mesh was extracted from, in its
    units."""
    for _ in range(CENTRED):
        axis = refine_axis(mesh, axis, step)
    for _ in range(ROUNDS):
        shift, normal, *_ = along_profile(mesh, axis, step)
        moved = replace(mesh, vertices=(mesh.vertices + shift[:, None] * normal).astype(np.float32))
        mesh = replace(moved, normals=vertex_normals(moved))
    return mesh


def refine_axis(mesh: Mesh, axis: Axis, step: float) -> Axis:
    """The axis after one Gauss-Newton step: moved and leant so that least is left to move the
    vertices by, as whatever stands out on one side pulls at the normals (`revolution_axis`). A body
    that is moved by a + ω x r against its axis asks for -n . (a + ω x r)."""
    shift, normal, weight, some = along_profile(mesh, axis, step, SPARSE)
    across = np.linalg.svd(axis.direction[None])[2][
        1:
    ]  # along the axis and about it nothing is told
    arm = np.cross(mesh.vertices[some] - axis.point, normal)
    rows = np.concatenate([normal @ across.T, arm @ across.T], 1)
    normal_matrix = (rows * weight[:, None]).T @ rows
    found = np.linalg.solve(
        normal_matrix + 1e-9 * np.trace(normal_matrix) * np.eye(4), -rows.T @ (weight * shift)
    )
    direction = axis.direction + np.cross(found[2:] @ across, axis.direction)
    return Axis(axis.point + found[:2] @ across, direction / np.linalg.norm(direction))


def along_profile(mesh: Mesh, axis: Axis, step: float, every: int = 1):
    """(shift (N,) of some vertices along their normals in the half plane onto the curve, those (N,
    3), weight (N,) by area, 0 for what stays; the vertices (N,)). every: one of so many is
    asked."""
    place, normal, in_plane, turn, away = half_plane(mesh, axis)
    area, some = vertex_areas(mesh), np.arange(0, len(place), every)
    weight = (
        area / np.maximum(place[:, 0], WIDE * step) * ramp(in_plane, ALONG)
    )  # so every turn counts the same
    cloud = np.random.default_rng(0).permutation(len(place))[:CLOUD]
    tree, chunks = cKDTree(place[cloud]), np.array_split(some, max(1, len(some) // AT_ONCE))
    found = np.concatenate(
        [towards_curve(tree, cloud, place, normal, weight, turn, chunk, step) for chunk in chunks]
    )
    part = found[:, 1] * ramp(in_plane[some], ALONG)
    along = normal[some, :1] * away[some] + normal[some, 1:] * axis.direction
    return found[:, 0] * part, along, area[some] * part, some


def half_plane(mesh: Mesh, axis: Axis):
    """(place (V, 2) radius and height, normal (V, 2) unit in the half plane, in_plane (V,) length
    of the normal's part there, turn (V,) bin about the axis, away (V, 3) unit from the axis)."""
    from_axis = np.asarray(mesh.vertices, np.float64) - axis.point
    height = from_axis @ axis.direction
    away = from_axis - height[:, None] * axis.direction
    radius = np.linalg.norm(away, axis=1)
    away /= np.maximum(radius, 1e-9)[:, None]
    n = np.asarray(vertex_normals(mesh), np.float64)
    normal = np.stack([(n * away).sum(1), n @ axis.direction], 1)
    in_plane = np.linalg.norm(normal, axis=1)
    across = np.linalg.svd(axis.direction[None])[2][1:]
    turn = (
        np.floor(
            (np.arctan2(away @ across[0], away @ across[1]) / (2 * np.pi) + 0.5) * TURNS
        ).astype(int)
        % TURNS
    )
    return (
        np.stack([radius, height], 1),
        normal / np.maximum(in_plane, 1e-9)[:, None],
        in_plane,
        turn,
        away,
    )


def towards_curve(
    tree: cKDTree, cloud, place, normal, weight, turn, some: np.ndarray, step: float
) -> np.ndarray:
    """(len(some), 2) by how much these vertices lie beside the curve, along their normals in the
    half plane, and what part of it they are moved by. tree: of the places of the vertices `cloud`.
    Others as `half_plane` has them."""
    near = tree.query_ball_point(place[some], 2.5 * WIDE * step)
    of, j = (
        np.repeat(np.arange(len(some)), [len(n) for n in near]),
        cloud[np.concatenate([np.asarray(n, int) for n in near])],
    )
    n, d = normal[some][of], place[j] - place[some][of]
    off = (d * n).sum(1)
    s = (n[:, 0] * d[:, 1] - n[:, 1] * d[:, 0]) / (WIDE * step)
    alike = weight[j] * np.exp(-(s**2) / 2) * np.maximum((normal[j] * n).sum(1), 0) ** 4
    powers, curve = np.cumprod([np.ones_like(s), s, s, s, s], axis=0), np.zeros((len(some), 3))
    total = np.maximum(np.bincount(of, alike, len(some)), 1e-12)
    for k in range(FITS):
        left = off - (powers[:3].T * curve[of]).sum(1)
        w = alike / total[of] * np.exp(-((left / (NEAR * step * (2 if k < 2 else 1))) ** 2) / 2)
        moment = np.stack([np.bincount(of, w * power, len(some)) for power in powers], -1)
        asked = np.stack([np.bincount(of, w * off * power, len(some)) for power in powers[:3]], -1)
        held = moment[:, :1, None] * np.diag(FLAT) + 1e-9 * np.eye(3)
        curve = np.linalg.solve(
            moment[:, np.add.outer(np.arange(3), np.arange(3))] + held, asked[..., None]
        )[..., 0]
    on_it = np.abs(off - (powers[:3].T * curve[of]).sum(1)) < 2 * NEAR * step
    share = np.bincount(of, alike * on_it, len(some)) / total
    each, all_ = (
        np.bincount(of * TURNS + turn[j], alike * w, len(some) * TURNS).reshape(-1, TURNS)
        for w in (on_it, 1.0)
    )
    around = ((each > 0.3 * all_) & (all_ > 0)).mean(1)
    shift = curve[:, 0]
    return np.stack(
        [
            shift,
            ramp(share, ON_IT)
            * ramp(around, AROUND)
            * ramp(-np.abs(shift) / (FARTHEST * step), (-1.0, -0.7)),
        ],
        1,
    )


def ramp(x: np.ndarray, ends: tuple[float, float]) -> np.ndarray:
    """0 below the first end, 1 from the second on, even in between."""
    return np.clip((x - ends[0]) / (ends[1] - ends[0]), 0, 1)

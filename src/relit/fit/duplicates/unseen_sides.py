"""Sides of a shape that no view shows: closed over what is seen.

Silhouettes bound a shape across the lines of sight only. Where all views look from one side (a pile
of things that stand on a table, seen from above) nothing bounds it behind: a keel hangs down as far
as the cones of all silhouettes reach. Inside of a closed surface is where it hides the whole sky;
of an open one, what is seen of the object, the share of the sky that it hides falls from the inside
outwards (the generalized winding number: Jacobson, Kavan, Sorkine-Hornung 2013, Sec. 3). A point of
the shape stays where it hides a third or more. A half would be flat from rim to rim; a third bulges
under a round rim by .35 of its radius, as bodies do.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import distance_transform_edt, gaussian_filter
from scipy.spatial import cKDTree

from relit.fit.registration.instances.views import InstanceView
from relit.fit.shape.unseen import face_pairs, part_areas, points_on, seen_points
from relit.geometry.hull import distance_of
from relit.geometry.mesh import extract_mesh, face_areas
from relit.geometry.sdf import node_positions, resample
from relit.reference.mitsuba_scene import build_geometry
from relit.scene import Mesh

# along a side: of the shape on which seen and unseen are told apart, and for the hidden share of
# the sky, which changes slowly
NODES = 96
# cosine from which on a face is seen: walls along the lines of sight are where silhouettes end, not
# what they show
SEEN = 0.1
AROUND = 60  # neighbours that decide with a face whether it is seen: the rim must not be ragged
SMALL = 0.01  # of the area: smaller parts are as what is around them
# of the surface that nobody sees, from which on; where views look from all sides silhouettes bound
# the rest
ONE_SIDED = 0.25
HIDDEN = 1 / 3  # of the sky
# grid steps under a seen surface that stay, so that thin parts do and every ray of a silhouette
# meets them
SKIN = 3
NEAR = 6  # vertices that tell how one next to them moves
BLEND = 1.5  # grid steps, standard deviation of what smooths the new surface


def closed_where_unseen(
    values: np.ndarray, views: list[InstanceView], poses: np.ndarray
) -> tuple[np.ndarray, float]:
    """(signed distance (n, n, n), share of the volume that is gone) of the shape `values` (n, n, n,
    negative inside) with the sides that no view shows closed over what is seen; as it is where
    views look from all around, or it is too thin to tell. poses: (N, 4, 4) object_from_photo of the
    views, in the unit frame."""
    coarse = resample(values, NODES)
    if coarse.min() >= 0:  # too thin for that grid
        return values, 0.0
    mesh = extract_mesh(coarse)  # not decimated: neighbours lie at even distances
    seen, areas = seen_in(mesh, views, poses), face_areas(mesh)
    if areas[~seen].sum() < ONE_SIDED * areas.sum() or not seen.any():
        return values, 0.0
    inside = values < 0
    gone = inside & (resample(hidden_sky(mesh, seen, coarse), len(values)) < HIDDEN)
    on_seen = points_on(mesh.vertices[mesh.faces[seen]].astype(np.float64))
    points, step = node_positions(len(values))[gone], 2 / (len(values) - 1)
    gone[gone] = np.isinf(
        cKDTree(on_seen.reshape(-1, 3)).query(points, distance_upper_bound=SKIN * step)[0]
    )
    share = float(gone.sum() / inside.sum())
    if share == 0:
        return values, 0.0
    nearest = distance_transform_edt(~inside, return_distances=False, return_indices=True)
    gone = gone[
        tuple(nearest)
    ]  # with the space outside next to it, or a film of the old surface would stay
    return np.maximum(values, gaussian_filter(-distance_of(gone), BLEND)).astype(np.float32), share


def seen_in(mesh: Mesh, views: list[InstanceView], poses: np.ndarray) -> np.ndarray:
    """(F,) bool: faces that some view shows in front, in pixels of the object; with a smooth rim
    and without small parts."""
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    scene, middle, normal = build_geometry(mesh), corners.mean(1), twice_areas(corners)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    seen = np.zeros(len(mesh.faces), bool)
    for view, pose in zip(views, poses, strict=True):
        camera = view.camera.with_pose(pose)
        shown = np.flatnonzero(~seen & seen_points(scene, middle, normal, [camera], SEEN))
        column, row = camera.project(middle[shown])[:, :2].astype(int).T
        seen[shown] = view.mask[row, column] > 0.5
    areas, pairs = face_areas(mesh), face_pairs(mesh.faces)
    around = cKDTree(middle).query(middle, min(AROUND, len(middle)))[1]
    seen = (seen[around] * areas[around]).sum(1) > 0.5 * areas[around].sum(1)
    least = SMALL * areas.sum()
    seen &= part_areas(seen, pairs, areas) >= least
    return seen | (part_areas(~seen, pairs, areas) < least)


def hidden_sky(mesh: Mesh, seen: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(n, n, n) the share of the sky that the seen faces (F,) hide, from inside, at the nodes of
    the shape `values` and at those within two steps of it; 0 elsewhere. Each face counts as a point
    with its area, so next to the surface it is not exact."""
    n, step = len(values), 2 / (len(values) - 1)
    at = np.flatnonzero(values.ravel() < 2 * step)
    p = node_positions(n).reshape(-1, 3)[at].astype(np.float32)
    corners = mesh.vertices[mesh.faces[seen]].astype(np.float64)
    q, a = corners.mean(1).astype(np.float32), (twice_areas(corners) / 2).astype(np.float32)
    share = np.zeros(n**3, np.float32)
    for k in range(0, len(at), 512):
        some = p[k : k + 512]
        across = (q * a).sum(1) - some @ a.T
        squared = (q**2).sum(1) - 2 * some @ q.T + (some**2).sum(1)[:, None]
        share[at[k : k + 512]] = (across / np.maximum(squared, step**2 / 4) ** 1.5).sum(1) / (
            4 * np.pi
        )
    return share.reshape(n, n, n)


def moved_along(mesh: Mesh, built: np.ndarray, placed: np.ndarray) -> Mesh:
    """The mesh, its vertices moved as those of another one next to them: from built (V', 3) to
    placed (V', 3)."""
    away, near = cKDTree(built).query(mesh.vertices, NEAR)
    weight = 1 / np.maximum(away, 1e-6) ** 2
    shift = (weight[..., None] * (placed - built)[near]).sum(1) / weight.sum(1, keepdims=True)
    return replace(mesh, vertices=(mesh.vertices + shift).astype(np.float32))


def told_at(vertices: np.ndarray, built: np.ndarray, nodes: int) -> np.ndarray:
    """(V, 3) where the volume pass knows how the vertices look: there, or in the surface that it
    has built (V', 3) where this is farther away than two of its nodes, as the shape was made
    smaller there."""
    away, nearest = cKDTree(built).query(vertices)
    return np.where((away > 4 / (nodes - 1))[:, None], built[nearest], vertices).astype(
        vertices.dtype
    )


def twice_areas(corners: np.ndarray) -> np.ndarray:
    """(F, 3) normals of triangles (F, 3, 3), twice their areas long."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])

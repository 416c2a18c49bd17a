"""Photos without masks: what no photo sees is no part of the object's mesh.

A signed distance field is closed, so behind what the photos show it closes somewhere: at the object
sphere, as a rule, as a ball. Nothing was measured there. The faces that no camera sees are left out
and the mesh stays open, as from other ways of photogrammetry; small gaps between seen faces stay
filled.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from relit.geometry.mesh import KEEP, face_areas
from relit.geometry.tangents import edges
from relit.reference.mitsuba_scene import build_geometry
from relit.rendering.transport import OFFSET
from relit.scene import Camera, Mesh

FILLED = 0.01  # of the mesh's area: unseen parts smaller than this stay
RIM = 2  # rings of unseen faces beside seen ones that stay


def without_unseen(mesh: Mesh, cameras: list[Camera]) -> Mesh:
    """The welded mesh (unit frame) without the parts that none of the cameras (unit frame) sees.
    Everything, where nothing is seen."""
    seen = seen_faces(mesh, cameras)
    areas, pairs = face_areas(mesh), face_pairs(mesh.faces)
    keep = seen | (part_areas(~seen, pairs, areas) < FILLED * areas.sum())
    for _ in range(RIM):
        a, b = pairs[:, 0], pairs[:, 1]
        keep[np.concatenate([b[keep[a]], a[keep[b]]])] = True
    parts = part_areas(keep, pairs, areas)
    keep &= parts >= KEEP * parts.max()
    if not seen.any() or keep.all():
        return mesh
    used, faces = np.unique(mesh.faces[keep], return_inverse=True)
    normals = None if mesh.normals is None else mesh.normals[used]
    return Mesh(mesh.vertices[used], faces.reshape(-1, 3).astype(np.int32), normals)


def seen_faces(mesh: Mesh, cameras: list[Camera], cosine: float = 0.0) -> np.ndarray:
    """(F,) bool: faces that some camera sees from outside, under a cosine above `cosine`, in their
    middle or near one of their corners."""
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    points = points_on(corners).reshape(-1, 3)
    seen = seen_points(build_geometry(mesh), points, np.repeat(normals, 4, axis=0), cameras, cosine)
    return seen.reshape(-1, 4).any(1)


def points_on(corners: np.ndarray) -> np.ndarray:
    """(F, 4, 3) of triangles (F, 3, 3): their middles, and a point near each of their corners."""
    middle = corners.mean(1, keepdims=True)
    return np.concatenate([middle, 0.7 * corners + 0.3 * middle], 1)


def seen_points(
    scene: mi.Scene,
    points: np.ndarray,
    normals: np.ndarray,
    cameras: list[Camera],
    cosine: float = 0.0,
) -> np.ndarray:
    """(N,) bool: points (N, 3) of the scene's surface, with unit normals (N, 3), that some camera
    sees under a cosine above `cosine`."""
    seen = np.zeros(len(points), bool)
    for camera in cameras:
        asked = np.flatnonzero(
            facing(points, normals, camera, camera.project(points), cosine) & ~seen
        )
        if len(asked):
            seen[asked] = clear(scene, *sight_rays(points[asked], normals[asked], camera))
    return seen


def facing(
    points: np.ndarray, normals: np.ndarray, camera: Camera, at: np.ndarray, cosine: float
) -> np.ndarray:
    """(N,) bool: which of points (N, 3), with unit normals, lie within the picture, at (N, 3) of
    `Camera.project`, and are turned to the camera by more than a cosine."""
    x, y, depth = at.T
    to = camera.centre - points
    turned = np.einsum("ij,ij->i", normals, to) > cosine * np.sqrt(np.einsum("ij,ij->i", to, to))
    return turned & (depth > 0) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)


def sight_rays(
    points: np.ndarray, normals: np.ndarray, camera: Camera
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(origins (3, N), directions (3, N), lengths (N,)), float32, from just above points (N, 3) to
    a camera."""
    to = camera.centre - points
    far = np.sqrt(np.einsum("ij,ij->i", to, to))
    return (
        (points + OFFSET * normals).T.astype(np.float32),
        (to / far[:, None]).T.astype(np.float32),
        far.astype(np.float32),
    )


def clear(
    scene: mi.Scene, origins: np.ndarray, directions: np.ndarray, lengths: np.ndarray
) -> np.ndarray:
    """(N,) bool: rays, see `sight_rays`, that meet nothing. Their number compiles nothing: launches
    of any width share a kernel."""
    ray = mi.Ray3f(mi.Point3f(origins), mi.Vector3f(directions))
    ray.maxt = mi.Float(lengths)
    return ~np.array(scene.ray_test(ray))


def face_pairs(faces: np.ndarray) -> np.ndarray:
    """(E, 2) faces that share an edge."""
    sides = np.sort(edges(faces), axis=1)
    owner = np.tile(np.arange(len(faces)), 3)
    order = np.lexsort(sides.T)
    sides, owner = sides[order], owner[order]
    same = (sides[1:] == sides[:-1]).all(1)
    return np.stack([owner[:-1][same], owner[1:][same]], -1)


def part_areas(chosen: np.ndarray, pairs: np.ndarray, areas: np.ndarray) -> np.ndarray:
    """(F,) the area of the connected part that each chosen face belongs to; 0 for the others."""
    inside = pairs[chosen[pairs].all(1)]
    links = coo_matrix(
        (np.ones(len(inside)), (inside[:, 0], inside[:, 1])), shape=(len(chosen), len(chosen))
    )
    part = connected_components(links, directed=False)[1]
    return np.where(chosen, np.bincount(part, areas * chosen)[part], 0.0)

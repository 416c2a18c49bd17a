"""Photos without masks: what no photo sees is no part of the object's mesh.

A signed distance field is closed, so behind what the photos show it closes somewhere: at the object sphere, as a rule, as a ball. Nothing
was measured there. The faces that no camera sees are left out and the mesh stays open, as from other ways of photogrammetry; small gaps
between seen faces stay filled.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from relit.fit.pixels import camera_rows, rays_through
from relit.geometry.mesh import KEEP, face_areas
from relit.geometry.tangents import edges
from relit.rendering.mitsuba_scene import build_geometry
from relit.scene import Camera, Mesh

PIXELS = 160_000  # rays through each photo, about
FILLED = 0.01  # of the mesh's area: unseen parts smaller than this stay
RIM = 2  # rings of unseen faces beside seen ones that stay


def without_unseen(mesh: Mesh, cameras: list[Camera]) -> Mesh:
    """The welded mesh (unit frame) without the parts that none of the cameras (unit frame) sees. Everything, where nothing is seen."""
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


def seen_faces(mesh: Mesh, cameras: list[Camera]) -> np.ndarray:
    """(F,) bool: faces that some camera sees from outside."""
    scene, seen = build_geometry(mesh), np.zeros(len(mesh.faces), bool)
    rows = mi.Float(camera_rows(cameras))
    for view, camera in enumerate(cameras):
        scale = np.sqrt(PIXELS / (camera.width * camera.height))  # small photos: several rays a pixel, so that each face is met
        w, h = max(8, round(camera.width * scale)), max(8, round(camera.height * scale))
        index = dr.arange(mi.UInt32, w * h)
        step = dr.opaque(mi.Float, camera.width / w), dr.opaque(mi.Float, camera.height / h)
        row = index // dr.opaque(mi.UInt32, w)
        x, y = (mi.Float(index - row * dr.opaque(mi.UInt32, w)) + 0.5) * step[0], (mi.Float(row) + 0.5) * step[1]
        o, d = rays_through(rows, dr.opaque(mi.UInt32, view, w * h), x, y)
        ray = mi.Ray3f(mi.Point3f(o), d)
        si = scene.ray_intersect(ray, mi.RayFlags.Minimal, True)
        front = np.array(si.is_valid() & (dr.dot(si.n, d) < 0))
        seen[np.array(si.prim_index)[front]] = True
    return seen


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
    links = coo_matrix((np.ones(len(inside)), (inside[:, 0], inside[:, 1])), shape=(len(chosen), len(chosen)))
    part = connected_components(links, directed=False)[1]
    return np.where(chosen, np.bincount(part, areas * chosen)[part], 0.0)

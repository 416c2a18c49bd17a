"""Parts of a shape that hang loose beside it and that no silhouette asks for.

Where no view looks past the object a lump can stay that nothing bounds: in every silhouette it lies
before or behind the rest, and views that disagree paint it. What is fastened to nothing, and covers
nothing of the silhouettes that the rest does not cover too, is no part of the object. What the
object really has beside it (a lid in the air, a handle whose ends were lost) stands out of the rest
in some view.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from relit.reference.mitsuba_scene import build_geometry
from relit.scene import Camera, Mesh

# share of what a part covers of the silhouettes, all together, that must be its own for it to stay:
# outlines are a pixel off
ASKED = 0.1
SIDE = 200  # pixels that are looked at, the longer side of a view


def without_loose_parts(mesh: Mesh, cameras: list[Camera], masks, known) -> tuple[Mesh, int]:
    """(the mesh without loose parts that no silhouette asks for, how many these were). The largest
    part by area stays.

    cameras: of the views, in the mesh's frame. masks, known: (H, W) of each: the silhouette, and
    where it is known.
    """
    part = faces_by_part(mesh)
    count = part.max() + 1
    if count < 2:
        return mesh, 0
    scenes = [build_geometry(of_faces(mesh, part == k)) for k in range(count)]
    rays = [silhouette_rays(*view) for view in zip(cameras, masks, known, strict=True)]
    covered = np.concatenate(
        [np.array([np.array(scene.ray_test(ray)) for scene in scenes]) for ray in rays], 1
    )  # (parts, rays)
    stays = [0]
    for k in range(1, count):
        own = covered[k] & ~covered[stays].any(0)
        if own.sum() > ASKED * covered[k].sum():
            stays.append(k)
    return (
        (mesh, 0)
        if len(stays) == count
        else (of_faces(mesh, np.isin(part, stays)), int(count) - len(stays))
    )


def faces_by_part(mesh: Mesh) -> np.ndarray:
    """(F,) the number of the part that each face hangs together with; the largest part by area is
    0, the next one 1."""
    a, b, c = mesh.faces.T
    links = coo_matrix(
        (np.ones(2 * len(a)), (np.r_[a, b], np.r_[b, c])), (len(mesh.vertices), len(mesh.vertices))
    )
    _, part = np.unique(
        connected_components(links, directed=False)[1][a], return_inverse=True
    )  # vertices without faces are none
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    area = np.bincount(
        part,
        np.linalg.norm(
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
        ),
    )
    return np.argsort(np.argsort(-area))[part]


def of_faces(mesh: Mesh, chosen: np.ndarray) -> Mesh:
    """What some faces (F,) bool of a mesh are made of."""
    used, faces = np.unique(mesh.faces[chosen], return_inverse=True)
    return Mesh(
        mesh.vertices[used], faces.reshape(-1, 3).astype(mesh.faces.dtype), mesh.normals[used]
    )


def silhouette_rays(camera: Camera, mask: np.ndarray, known: np.ndarray) -> mi.Ray3f:
    """Rays through pixels of a silhouette."""
    step = max(1, round(max(mask.shape) / SIDE))
    y, x = np.nonzero((mask[::step, ::step] > 0.5) & (known[::step, ::step] > 0.5))
    at = np.stack([x * step + 0.5, y * step + 0.5], -1)
    d = np.concatenate(
        [(at - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.ones((len(at), 1))], 1
    )
    d = d @ camera.world_from_camera[:3, :3].T
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    o = np.broadcast_to(camera.centre, d.shape)
    return mi.Ray3f(mi.Point3f(o.T.astype(np.float32)), mi.Vector3f(d.T.astype(np.float32)))

"""From the signed distance field to a triangle mesh: extraction, cleaning, decimation, normals."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import trimesh
from scipy.ndimage import map_coordinates
from skimage.measure import marching_cubes

from relit.device import load_pycolmap
from relit.errors import EXIT_FAILED, UserError
from relit.scene import Mesh

KEEP = (
    0.02  # components with less than this share of the largest one's area are dropped as floaters
)


def extract_mesh(values: np.ndarray, *, faces: int | None = None) -> Mesh:
    """The zero level set of distances (n, n, n) [z, y, x] over [-1, 1]^3, as a closed mesh in the
    unit frame.

    faces: decimate to about this many by quadric error, or None. Normals come from the field, so
    they stay smooth.
    Raises UserError (exit code 4) when the field has no surface.
    """
    n = values.shape[0]
    h = 2.0 / (n - 1)
    closed = values.copy()  # a surface that would leave the cube is capped just inside
    for axis in range(3):
        for side in (0, -1):
            index: list = [slice(None)] * 3
            index[axis] = side
            closed[tuple(index)] = np.maximum(closed[tuple(index)], h)
    if closed.min() >= 0:
        raise UserError(
            "the reconstruction has no surface left",
            "the photos, masks and cameras contradict each other, or the object lies outside the object sphere",
            "look at `relit inspect INPUT`: cameras, masks and the object sphere",
            code=EXIT_FAILED,
        )
    vertices, triangles, _, _ = marching_cubes(closed, 0.0)
    mesh = trimesh.Trimesh(vertices[:, ::-1] * h - 1.0, triangles[:, ::-1], process=True)
    mesh = _without_floaters(mesh)
    if faces is not None and len(mesh.faces) > faces:
        mesh = _decimate(mesh, faces / len(mesh.faces))
    v = np.asarray(mesh.vertices, np.float32)
    return Mesh(v, np.asarray(mesh.faces, np.int32), field_normals(closed, v))


def _without_floaters(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    parts = mesh.split(only_watertight=False)
    if len(parts) < 2:
        return mesh
    areas = np.array([p.area for p in parts])
    return trimesh.util.concatenate(  # pyright: ignore[reportReturnType]
        [p for p, a in zip(parts, areas, strict=False) if a >= KEEP * areas.max()]
    )


def _decimate(mesh: trimesh.Trimesh, ratio: float) -> trimesh.Trimesh:
    """Quadric edge collapse (Garland & Heckbert 1997), by pycolmap; degenerate and doubled faces
    are removed after it."""
    pycolmap = load_pycolmap()

    pycolmap.logging.minloglevel = 2
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "in.ply", Path(folder) / "out.ply"
        mesh.export(source)
        options = pycolmap.MeshSimplificationOptions()
        options.target_face_ratio = float(ratio)
        options.num_threads = 2
        pycolmap.simplify_mesh(source, target, options)
        out = trimesh.load(target, process=False, force="mesh")
    out = trimesh.Trimesh(out.vertices, out.faces, process=True)  # pyright: ignore[reportAttributeAccessIssue]
    out.update_faces(out.nondegenerate_faces() & out.unique_faces())
    out.remove_unreferenced_vertices()
    return out


def field_gradient(values: np.ndarray, points: np.ndarray) -> np.ndarray:
    """∇S of distances (n, n, n) [z, y, x] at points (N, 3) of the unit frame: central differences,
    trilinear."""
    n = values.shape[0]
    h = 2.0 / (n - 1)
    at = ((points[:, ::-1] + 1.0) / h).T
    return np.stack(
        [
            map_coordinates(np.gradient(values, h, axis=2 - k), at, order=1, mode="nearest")
            for k in range(3)
        ],
        -1,
    )


def field_normals(values: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Unit outward normals (N, 3) float32 of the level sets at points (N, 3)."""
    g = field_gradient(values, points)
    return (g / np.maximum(np.linalg.norm(g, axis=1, keepdims=True), 1e-9)).astype(np.float32)


def face_areas(mesh: Mesh) -> np.ndarray:
    """(F,) areas."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


def vertex_areas(mesh: Mesh) -> np.ndarray:
    """(V,) a third of the area of the faces around each vertex."""
    out = np.zeros(len(mesh.vertices))
    np.add.at(out, mesh.faces.ravel(), np.repeat(face_areas(mesh) / 3, 3))
    return out

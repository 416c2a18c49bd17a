"""UV atlases: xatlas in a process of its own that can be stopped, and a simple one that always
works."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from relit.scene import Mesh

XATLAS_FACES = 60_000  # above it xatlas takes minutes
BUSY = 10  # a busy machine may take so many times longer by the clock than in processor time
SCRIPT = """
import sys, numpy as np, xatlas
try:
    import resource
    resource.setrlimit(resource.RLIMIT_CPU, (int(sys.argv[3]), int(sys.argv[3]) + 5))
except (ImportError, ValueError, OSError):
    pass
d = np.load(sys.argv[1], allow_pickle=False)
atlas = xatlas.Atlas()
atlas.add_mesh(d["vertices"], d["faces"], d["normals"])
chart, pack = xatlas.ChartOptions(), xatlas.PackOptions()
pack.resolution, pack.padding, pack.bilinear = int(d["resolution"]), int(d["padding"]), True
atlas.generate(chart_options=chart, pack_options=pack, verbose=False)
mapping, faces, uvs = atlas[0]
np.savez(sys.argv[2], mapping=mapping, faces=faces, uvs=uvs)
"""


def unwrap(
    mesh: Mesh, resolution: int, *, padding: int = 3, seconds: float = 90.0
) -> tuple[Mesh, str]:
    """Give a mesh texture coordinates; vertices are doubled along seams. Returns the mesh and how
    it was done ('xatlas' or 'cells').

    resolution: texels a side that the padding refers to. xatlas can hang or crash on difficult
    meshes: it runs in a process of its own for at most `seconds` of processor time (BUSY times that
    by the clock), and a mesh that it does not manage gets an atlas of cells, two faces in each.
    """
    if len(mesh.faces) <= XATLAS_FACES:
        found = _xatlas(mesh, resolution, padding, seconds)
        if found is not None:
            return found, "xatlas"
    return cells(mesh, resolution), "cells"


def _xatlas(mesh: Mesh, resolution: int, padding: int, seconds: float) -> Mesh | None:
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "in.npz", Path(folder) / "out.npz"
        normals = mesh.normals if mesh.normals is not None else np.zeros_like(mesh.vertices)
        np.savez(
            source,
            vertices=mesh.vertices.astype(np.float32),
            faces=mesh.faces.astype(np.uint32),
            normals=normals.astype(np.float32),
            resolution=resolution,
            padding=padding,
        )
        try:
            command = [sys.executable, "-c", SCRIPT, source, target, str(max(1, round(seconds)))]
            subprocess.run(command, check=True, timeout=BUSY * seconds, capture_output=True)
            with np.load(target, allow_pickle=False) as d:
                mapping, faces, uvs = (
                    d["mapping"].astype(np.int64),
                    d["faces"].astype(np.int32),
                    d["uvs"].astype(np.float32),
                )
        except (subprocess.SubprocessError, OSError, KeyError, ValueError):
            return None
    if (
        len(faces) != len(mesh.faces)
        or not np.isfinite(uvs).all()
        or uvs.min() < -1e-4
        or uvs.max() > 1 + 1e-4
    ):
        return None
    return replace(
        mesh,
        vertices=mesh.vertices[mapping],
        faces=faces,
        normals=None if mesh.normals is None else mesh.normals[mapping],
        uvs=np.clip(uvs, 0, 1),
    )


def cells(mesh: Mesh, resolution: int) -> Mesh:
    """An atlas of equal square cells with two faces each: no shared texels between faces, no chart
    shapes to fail on."""
    count = len(mesh.faces)
    side = int(np.ceil(np.sqrt((count + 1) // 2)))
    size = 1.0 / side
    gap = min(0.75 / resolution, 0.2 * size)
    k = np.arange(count)
    corner = np.stack([(k // 2) % side, (k // 2) // side], -1) * size
    lower = np.array([[gap, gap], [size - 3 * gap, gap], [gap, size - 3 * gap]])
    upper = size - lower
    uvs = np.where((k % 2 == 0)[:, None, None], lower[None], upper[None]) + corner[:, None]
    flat = mesh.faces.reshape(-1)
    return replace(
        mesh,
        vertices=mesh.vertices[flat],
        faces=np.arange(3 * count, dtype=np.int32).reshape(-1, 3),
        normals=None if mesh.normals is None else mesh.normals[flat],
        uvs=np.clip(uvs.reshape(-1, 2), 0, 1).astype(np.float32),
    )

"""Model files in and out: `read_asset_file` and `write_glb`."""

from __future__ import annotations

from pathlib import Path

from relit.asset.gltf_read import read_gltf
from relit.asset.obj import read_obj
from relit.errors import UserError
from relit.scene import Material, Mesh


def read_asset_file(path: str | Path) -> tuple[Mesh, Material]:
    """Mesh and material of a .glb, .gltf or .obj file, in the file's coordinates after its node transforms.

    Factors are multiplied into the textures, several primitives become one mesh, several materials one atlas. Vertex colours,
    occlusion and emission are ignored. Raises UserError for a missing, damaged or unsupported file.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError("the model file does not exist", fix=f"check the path: {path}")
    suffix = path.suffix.lower()
    if suffix in (".glb", ".gltf"):
        return read_gltf(path)
    if suffix == ".obj":
        return read_obj(path)
    raise UserError(f"'{suffix}' is not a model format that can be read", fix=f"use .glb, .gltf or .obj: {path}")

"""Model files in and out: `read_asset_file` and `write_glb`."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from relit import __version__
from relit.asset.gltf_read import read_gltf
from relit.asset.obj import read_obj
from relit.errors import UserError
from relit.geometry.tangents import edges, vertex_normals, vertex_tangents
from relit.images import encode_png, write_bytes
from relit.scene import Material, Mesh

FLOAT, UINT = 5126, 5125
VERTEX_BUFFER, INDEX_BUFFER = 34962, 34963


def read_asset_file(path: str | Path, nodes=()) -> tuple[Mesh, Material]:
    """Mesh and material of a .glb, .gltf or .obj file, in the file's coordinates after its node
    transforms.

    Factors are multiplied into the textures, several primitives become one mesh, several materials
    one atlas. Vertex colours, occlusion and emission are ignored. nodes: names of the glTF nodes
    whose meshes are taken; all where empty.
    Raises UserError for a missing, damaged or unsupported file.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError("the model file does not exist", fix=f"check the path: {path}")
    suffix = path.suffix.lower()
    if suffix in (".glb", ".gltf"):
        with np.errstate(
            all="ignore"
        ):  # damaged files: values that are not finite are refused at the end
            return read_gltf(path, tuple(nodes))
    if suffix == ".obj":
        if nodes:
            raise UserError(
                "an OBJ file has no nodes to choose", fix=f"give none, or a .glb: {path}"
            )
        return read_obj(path)
    raise UserError(
        f"'{suffix}' is not a model format that can be read", fix=f"use .glb, .gltf or .obj: {path}"
    )


# ---------------------------------------------------------------- writing


class _Document:
    """The JSON and the binary chunk of a GLB that is being put together."""

    def __init__(self, name: str):
        self.blob = bytearray()
        self.json: dict = {
            "asset": {"version": "2.0", "generator": f"relit {__version__}"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0, "name": name}],
            "meshes": [],
            "materials": [],
            "accessors": [],
            "bufferViews": [],
        }

    def view(self, data: bytes, target: int | None = None) -> int:
        self.blob += b"\0" * (-len(self.blob) % 4)
        entry = {"buffer": 0, "byteOffset": len(self.blob), "byteLength": len(data)}
        self.json["bufferViews"].append(entry if target is None else {**entry, "target": target})
        self.blob += data
        return len(self.json["bufferViews"]) - 1

    def accessor(self, array: np.ndarray, *, bounds: bool = False) -> int:
        indices = array.ndim == 1
        array = np.ascontiguousarray(array, np.uint32 if indices else np.float32)
        entry = {
            "bufferView": self.view(array.tobytes(), INDEX_BUFFER if indices else VERTEX_BUFFER),
            "componentType": UINT if indices else FLOAT,
            "count": len(array),
            "type": "SCALAR" if indices else f"VEC{array.shape[1]}",
        }
        if bounds:
            entry |= {"min": array.min(0).tolist(), "max": array.max(0).tolist()}
        self.json["accessors"].append(entry)
        return len(self.json["accessors"]) - 1

    def texture(self, png: bytes) -> dict:
        images, textures = self.json.setdefault("images", []), self.json.setdefault("textures", [])
        self.json.setdefault(
            "samplers", [{"magFilter": 9729, "minFilter": 9987, "wrapS": 10497, "wrapT": 10497}]
        )
        images.append({"bufferView": self.view(png), "mimeType": "image/png"})
        textures.append({"source": len(images) - 1, "sampler": 0})
        return {"index": len(textures) - 1}

    def extension(self, material: dict, name: str, value: dict) -> None:
        material.setdefault("extensions", {})[name] = value
        self.json.setdefault("extensionsUsed", []).append(name)

    def bytes(self) -> bytes:
        self.blob += b"\0" * (-len(self.blob) % 4)
        self.json["buffers"] = [{"byteLength": len(self.blob)}]
        text = json.dumps(self.json, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        total = 12 + 8 + len(text) + 8 + len(self.blob)
        head = struct.pack("<4sII", b"glTF", 2, total) + struct.pack("<I4s", len(text), b"JSON")
        return head + text + struct.pack("<I4s", len(self.blob), b"BIN\0") + bytes(self.blob)


def _constant(a: np.ndarray) -> bool:
    """True where an array (H, W[, C]) has one value (per channel) all over: it becomes a factor,
    not a texture."""
    a = np.asarray(a)
    return bool(np.all(a == a[:1, :1]))


def _data_png(array: np.ndarray) -> bytes:
    """(H, W, 3) in [0, 1] -> bytes of an 8-bit PNG without a transfer curve."""
    codes = (np.clip(np.asarray(array, np.float32), 0, 1) * 255 + 0.5).astype(np.uint8)
    return cv2.imencode(".png", codes[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 4])[1].tobytes()


def _pbr(doc: _Document, m: Material) -> dict:
    """pbrMetallicRoughness of a material: G is the roughness, B the metallic of one packed texture
    (glTF 2.0, Sec. 3.9.2)."""
    p: dict = {}
    if _constant(m.base_color):
        p["baseColorFactor"] = [*np.clip(m.base_color[0, 0], 0, 1).astype(float).tolist(), 1.0]
    else:
        p["baseColorTexture"] = doc.texture(encode_png(m.base_color))
    planes = []
    for key, plane in (("roughnessFactor", m.roughness), ("metallicFactor", m.metallic)):
        p[key] = float(np.clip(plane[0, 0], 0, 1)) if _constant(plane) else 1.0
        planes.append(
            np.ones((1, 1), np.float32) if _constant(plane) else np.asarray(plane, np.float32)
        )
    size = np.max([x.shape for x in planes], axis=0)
    if size.max() > 1:
        g, b = (
            x if x.shape == tuple(size) else cv2.resize(x, (int(size[1]), int(size[0])))
            for x in planes
        )
        p["metallicRoughnessTexture"] = doc.texture(
            _data_png(np.stack([np.ones_like(g), g, b], -1))
        )
    return p


def has_border(mesh: Mesh) -> bool:
    """Whether some edge belongs to one face only; vertices at the same place count as one."""
    _, place = np.unique(np.asarray(mesh.vertices), axis=0, return_inverse=True)
    faces = place.reshape(-1)[np.asarray(mesh.faces)]
    sides = np.sort(edges(faces), axis=1)
    return bool((np.unique(sides, axis=0, return_counts=True)[1] == 1).any())


def write_glb(
    path: str | Path,
    mesh: Mesh,
    material: Material,
    root_transform=None,
    name: str = "object",
    instances=(),
) -> None:
    """Write a binary glTF 2.0 file, atomically: one node, one primitive, NORMAL always, TANGENT
    with a normal map. An open mesh (of photos without masks) is doubleSided.

    root_transform: (4, 4) matrix of the node, or None: the file's coordinates are root_transform @
    mesh. Textures are 8-bit PNGs (base colour and specular colour in sRGB); an array with one value
    becomes a factor. Material.specular becomes specularColor of KHR_materials_specular, an ior
    other than 1.5 becomes KHR_materials_ior. instances: (name, (4, 4)) pairs, one node for each,
    all with the same mesh.
    """
    if len(mesh.faces) == 0:
        raise UserError(
            "an empty mesh cannot be exported",
            "the reconstruction has no surface",
            f"look at its stages before: {path}",
        )
    if mesh.uvs is None:
        mapped = [
            material.base_color,
            material.roughness,
            material.metallic,
            material.specular,
            material.normal,
        ]
        if any(a is not None and not _constant(a) for a in mapped):
            raise UserError(
                "a textured material needs a mesh with texture coordinates",
                fix="unwrap the mesh first, or use constant textures",
            )
        material = replace(material, normal=None)
    doc = _Document(name)
    if root_transform is not None and not np.allclose(root_transform, np.eye(4), atol=1e-12):
        doc.json["nodes"][0]["matrix"] = np.asarray(root_transform, np.float64).T.ravel().tolist()
    if instances:
        nodes = [
            {"mesh": 0, "name": n, "matrix": np.asarray(m, np.float64).T.ravel().tolist()}
            for n, m in instances
        ]
        doc.json["nodes"], doc.json["scenes"] = nodes, [{"nodes": list(range(len(nodes)))}]
    normals = np.asarray(
        mesh.normals if mesh.normals is not None else vertex_normals(mesh), np.float64
    )
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    if (length < 1e-6).any():
        normals = np.where(length < 1e-6, vertex_normals(mesh), normals)
        length = np.linalg.norm(normals, axis=-1, keepdims=True)
    mesh = replace(mesh, normals=(normals / length).astype(np.float32))
    attributes = {
        "POSITION": doc.accessor(mesh.vertices, bounds=True),
        "NORMAL": doc.accessor(mesh.normals),  # pyright: ignore[reportArgumentType]
    }
    m: dict = {"name": name, "pbrMetallicRoughness": _pbr(doc, material)}
    if has_border(mesh):
        m["doubleSided"] = True
    if material.normal is not None:
        m["normalTexture"] = doc.texture(_data_png(np.asarray(material.normal) * 0.5 + 0.5))
        attributes["TANGENT"] = doc.accessor(vertex_tangents(mesh))
    if mesh.uvs is not None and ("textures" in doc.json or material.specular is not None):
        attributes["TEXCOORD_0"] = doc.accessor(mesh.uvs)
    if abs(material.ior - 1.5) > 1e-6:
        doc.extension(m, "KHR_materials_ior", {"ior": float(material.ior)})
    if material.specular is not None:
        s = np.asarray(material.specular, np.float32)
        s = np.repeat(s[..., None], 3, -1) if s.ndim == 2 else s
        top = max(float(s.max()), 1e-6)
        if _constant(s):
            doc.extension(
                m, "KHR_materials_specular", {"specularColorFactor": s[0, 0].astype(float).tolist()}
            )
        else:
            texture = doc.texture(encode_png(s / top))
            doc.extension(
                m,
                "KHR_materials_specular",
                {"specularColorFactor": [top] * 3, "specularColorTexture": texture},
            )
    indices = doc.accessor(np.asarray(mesh.faces).ravel())
    doc.json["materials"].append(m)
    doc.json["meshes"].append(
        {
            "name": name,
            "primitives": [{"attributes": attributes, "indices": indices, "material": 0}],
        }
    )
    write_bytes(path, doc.bytes())

"""Reading glTF 2.0 (.glb, .gltf): nodes applied, primitives merged, one material out."""

from __future__ import annotations

import base64
import io
import json
import struct
import warnings
from pathlib import Path
from urllib.parse import unquote

import cv2
import numpy as np
from PIL import Image as PilImage

from relit.asset.parts import Part, merge_parts
from relit.conventions import linear_from_srgb
from relit.errors import UserError
from relit.images.opencv import decode_bytes
from relit.scene import Material, Mesh

MAX_BYTES = 2 << 30
MAX_TEXELS = 128_000_000  # of one texture
COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
UNDERSTOOD = {
    "KHR_materials_ior",
    "KHR_materials_specular",
    "KHR_texture_transform",
    "KHR_mesh_quantization",
}


def _size(data: bytes) -> tuple[int, int] | None:
    """(width, height) that a picture claims, before it is decoded; None for what is no picture."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with PilImage.open(io.BytesIO(data)) as image:
                return image.size
    except PilImage.DecompressionBombError:
        return 1 << 20, 1 << 20
    except (OSError, ValueError, SyntaxError, struct.error):
        return None


class _File:
    """A parsed document with its binary buffers and a cache of decoded images."""

    def __init__(self, path: Path):
        self.path = path
        if path.stat().st_size > MAX_BYTES:
            raise UserError("the model file is larger than 2 GB", fix=f"make it smaller: {path}")
        data = path.read_bytes()
        self.chunk = None
        try:
            if data[:4] == b"glTF":
                _, version, _ = struct.unpack_from("<4sII", data)
                if version != 2:
                    raise UserError(
                        f"glTF version {version} is not supported",
                        fix=f"convert it to glTF 2.0: {path}",
                    )
                size, _ = struct.unpack_from("<II", data, 12)
                self.json = json.loads(data[20 : 20 + size])
                at = 20 + size
                if at + 8 <= len(data):
                    size, _ = struct.unpack_from("<II", data, at)
                    self.chunk = data[at + 8 : at + 8 + size]
            else:
                self.json = json.loads(data)
        except (ValueError, struct.error, RecursionError) as e:
            raise UserError(
                "this is not a readable glTF file", str(e), f"export it again: {path}"
            ) from None
        unknown = set(self.json.get("extensionsRequired", [])) - UNDERSTOOD
        if unknown:
            raise UserError(
                f"the model needs glTF extensions that are not supported: {', '.join(sorted(unknown))}",
                fix=f"export it without them: {path}",
            )
        if not isinstance(self.json, dict):
            raise UserError(
                "this is not a readable glTF file",
                "its JSON is no object",
                f"export it again: {path}",
            )
        self.buffers: dict[int, bytes] = {}
        self.images: dict[int, np.ndarray] = {}

    def resource(self, uri: str) -> bytes:
        if uri.startswith("data:"):
            return base64.b64decode(uri.split(",", 1)[1])
        file = file_below(self.path.parent, unquote(uri))
        if not file.is_file():
            raise UserError(
                "a file that the model refers to is missing", fix=f"put it beside the model: {file}"
            )
        if file.stat().st_size > MAX_BYTES:
            raise UserError(
                "a file that the model refers to is larger than 2 GB",
                fix=f"make it smaller: {file}",
            )
        return file.read_bytes()

    def view(self, index: int) -> tuple[bytes, int]:
        """Bytes and stride (0: packed) of a buffer view."""
        v = self.json["bufferViews"][index]
        b = v["buffer"]
        if b not in self.buffers:
            uri = self.json["buffers"][b].get("uri")
            self.buffers[b] = self.resource(uri) if uri else (self.chunk or b"")
        start, length, stride = v.get("byteOffset", 0), v["byteLength"], v.get("byteStride", 0)
        if not (
            start >= 0
            and length >= 0
            and 0 <= stride <= 252
            and start + length <= len(self.buffers[b])
        ):
            raise ValueError("a buffer view lies outside its buffer")
        return self.buffers[b][start : start + length], stride

    def accessor(self, index: int) -> np.ndarray:
        """(count, width) array; normalised integers become floats."""
        a = self.json["accessors"][index]
        if "sparse" in a:
            raise UserError(
                "sparse accessors are not supported",
                fix=f"export the model without them: {self.path}",
            )
        dtype, width = np.dtype(COMPONENTS[a["componentType"]]), WIDTHS[a["type"]]
        if "bufferView" not in a:
            return np.zeros((a["count"], width), dtype)
        data, stride = self.view(a["bufferView"])
        item, start, count = dtype.itemsize * width, a.get("byteOffset", 0), a["count"]
        stride = stride or item
        if not (count > 0 and start >= 0 and start + stride * (count - 1) + item <= len(data)):
            raise ValueError("an accessor lies outside its buffer view")
        out = np.ndarray((count, width), dtype, data, start, (stride, dtype.itemsize))
        if a.get("normalized") and dtype.kind in "iu":
            return np.maximum(out.astype(np.float32) / np.iinfo(dtype).max, -1.0)
        return out

    def image(self, texture: dict) -> np.ndarray:
        """(H, W, C) float32 in [0, 1], channels RGB(A) or grey, as encoded."""
        index = self.json["textures"][texture["index"]].get("source")
        if index is None:
            raise UserError(
                "a texture has no PNG or JPEG image",
                "other image formats are not supported",
                f"export it with PNG images: {self.path}",
            )
        if index not in self.images:
            entry = self.json["images"][index]
            data = (
                self.resource(entry["uri"]) if "uri" in entry else self.view(entry["bufferView"])[0]
            )
            self.images[index] = decode_image(data, str(self.path))
        return self.images[index]


def file_below(folder: Path, name: str) -> Path:
    """The file `name` in `folder` or below. Raises UserError for one that lies elsewhere: a model
    must not read the user's other files."""
    file = folder / name
    if "\0" in name or not file.resolve().is_relative_to(folder.resolve()):
        raise UserError(
            "the model refers to a file outside its folder",
            "such files are not read",
            f"put it beside the model: {file}",
        )
    return file


def decode_image(data: bytes, name: str) -> np.ndarray:
    """PNG or JPEG bytes -> (H, W, C) float32 in [0, 1], channels in RGB order, no transfer curve
    removed."""
    size = _size(data)
    if size is not None and size[0] * size[1] > MAX_TEXELS:
        what = f"a texture of {size[0]} x {size[1]} pixels is too large"
        raise UserError(
            what,
            f"at most {MAX_TEXELS // 10**6} million pixels are read",
            f"make it smaller: {name}",
        )
    a = decode_bytes(data, cv2.IMREAD_UNCHANGED)
    if a is None:
        raise UserError(
            "a texture cannot be decoded",
            "it is neither PNG nor JPEG, or it is damaged",
            f"export it again: {name}",
        )
    a = a[..., None] if a.ndim == 2 else a
    out = a.astype(np.float32) / (np.iinfo(a.dtype).max if a.dtype.kind == "u" else 1.0)
    return out[..., [2, 1, 0, *range(3, a.shape[2])]] if a.shape[2] >= 3 else out


def _rgb(image: np.ndarray) -> np.ndarray:
    return image[..., :3] if image.shape[2] >= 3 else np.repeat(image[..., :1], 3, 2)


def _material(file: _File, index: int | None) -> tuple[Material, int, dict]:
    """Material, TEXCOORD set and texture transform of a glTF material (the default one for
    None)."""
    m = file.json["materials"][index] if index is not None else {}
    p = m.get("pbrMetallicRoughness", {})
    ext = m.get("extensions", {})
    used = [
        x
        for x in (
            p.get("baseColorTexture"),
            p.get("metallicRoughnessTexture"),
            m.get("normalTexture"),
        )
        if x
    ]
    uses = {
        (
            x.get("extensions", {})
            .get("KHR_texture_transform", {})
            .get("texCoord", x.get("texCoord", 0)),
            _transform_key(x),
        )
        for x in used
    }
    if len(uses) > 1:
        raise UserError(
            "the textures of one material use different texture coordinates",
            fix=f"bake them to one set: {file.path}",
        )
    texcoord, transform = next(iter(uses), (0, ()))

    base = np.asarray(p.get("baseColorFactor", [1, 1, 1, 1]), np.float32)[:3] * np.ones(
        (1, 1, 3), np.float32
    )
    if "baseColorTexture" in p:
        base = base * linear_from_srgb(_rgb(file.image(p["baseColorTexture"])))
    rough, metal = (
        np.full((1, 1), p.get("roughnessFactor", 1.0), np.float32),
        np.full((1, 1), p.get("metallicFactor", 1.0), np.float32),
    )
    if "metallicRoughnessTexture" in p:
        image = _rgb(file.image(p["metallicRoughnessTexture"]))
        rough, metal = rough * image[..., 1], metal * image[..., 2]  # glTF 2.0, Sec. 3.9.2: G and B
    normal = None
    if "normalTexture" in m:
        scale = m["normalTexture"].get("scale", 1.0)
        normal = (_rgb(file.image(m["normalTexture"])) * 2 - 1) * np.array(
            [scale, scale, 1], np.float32
        )
        normal = normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)
    specular = None
    if "KHR_materials_specular" in ext:
        s = ext["KHR_materials_specular"]
        specular = (
            s.get("specularFactor", 1.0)
            * np.asarray(s.get("specularColorFactor", [1, 1, 1]), np.float32)
            * np.ones((1, 1, 3), np.float32)
        )
        if "specularTexture" in s:
            image = file.image(s["specularTexture"])
            specular = specular * (image[..., 3:4] if image.shape[2] == 4 else 1.0)
        if "specularColorTexture" in s:
            colour = linear_from_srgb(_rgb(file.image(s["specularColorTexture"])))
            if specular.shape[:2] not in ((1, 1), colour.shape[:2]):
                specular = cv2.resize(specular, colour.shape[1::-1])
            specular = specular * colour
        if np.all(specular == 1):
            specular = None
    ior = float(ext.get("KHR_materials_ior", {}).get("ior", 1.5))
    f = lambda a: None if a is None else np.ascontiguousarray(a, np.float32)  # noqa: E731
    return (
        Material(f(base), f(rough), f(metal), ior, f(specular), f(normal)),  # pyright: ignore[reportArgumentType]
        texcoord,
        dict(transform),
    )


def _transform_key(texture: dict) -> tuple:
    t = texture.get("extensions", {}).get("KHR_texture_transform", {})
    return tuple(
        (k, tuple(t[k]) if isinstance(t[k], list) else t[k])
        for k in ("offset", "rotation", "scale")
        if k in t
    )


def _transformed(uv: np.ndarray, t: dict) -> np.ndarray:
    """KHR_texture_transform: translation * rotation * scale."""
    s, c = np.sin(t.get("rotation", 0.0)), np.cos(t.get("rotation", 0.0))
    return (uv * t.get("scale", (1, 1))) @ np.array([[c, s], [-s, c]]).T + t.get("offset", (0, 0))


def _local(node: dict) -> np.ndarray:
    """(4, 4) parent_from_node."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    x, y, z, w = np.array(node.get("rotation", [0, 0, 0, 1]), np.float64)
    r = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    out = np.eye(4)
    out[:3, :3] = r * np.array(node.get("scale", [1, 1, 1]), np.float64)
    out[:3, 3] = node.get("translation", [0, 0, 0])
    return out


def _parts(
    file: _File, primitive: dict, asset_from_node: np.ndarray, materials: dict
) -> Part | None:
    mode = primitive.get("mode", 4)
    if mode < 4:
        return None  # points and lines have no surface
    if mode != 4:
        raise UserError(
            "triangle strips and fans are not supported",
            fix=f"export the model as plain triangles: {file.path}",
        )
    attributes = primitive["attributes"]
    v = file.accessor(attributes["POSITION"]).astype(np.float64)
    if "indices" in primitive:
        faces = file.accessor(primitive["indices"]).astype(np.int32).reshape(-1, 3)
    else:
        faces = np.arange(len(v), dtype=np.int32).reshape(-1, 3)
    if len(faces) and (faces.max() >= len(v) or faces.min() < 0):
        raise UserError(
            "the model's triangles refer to vertices that are not there",
            fix=f"export it again: {file.path}",
        )
    key = primitive.get("material")
    if key not in materials:
        materials[key] = _material(file, key)
    material, texcoord, transform = materials[key]
    name = f"TEXCOORD_{texcoord}"
    uv = file.accessor(attributes[name]).astype(np.float64) if name in attributes else None
    if uv is not None and transform:
        uv = _transformed(uv, transform)
    linear = asset_from_node[:3, :3]
    if np.linalg.det(linear) < 0:
        faces = faces[:, ::-1]
    normals = None
    if "NORMAL" in attributes:
        normals = file.accessor(attributes["NORMAL"]).astype(np.float64) @ np.linalg.inv(linear)
        normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    return Part(v @ linear.T + asset_from_node[:3, 3], faces, normals, uv, key, material)


def read_gltf(path: Path, nodes: tuple[str, ...] = ()) -> tuple[Mesh, Material]:
    """Mesh in the coordinates after the node transforms, and its material. Vertex colours,
    occlusion and emission are ignored.

    nodes: names of the nodes whose meshes are taken; all where empty."""
    file = _File(path)
    doc = file.json
    parts, materials, names = [], {}, set()
    try:
        scene = (
            doc["scenes"][doc.get("scene", 0)]
            if doc.get("scenes")
            else {"nodes": list(range(len(doc["nodes"])))}
        )
        stack = [(n, np.eye(4), 0) for n in reversed(scene.get("nodes", []))]
        while stack:
            index, asset_from_parent, depth = stack.pop()
            if depth > 1000:
                raise UserError("the model's nodes form a loop", fix=f"export it again: {path}")
            node = doc["nodes"][index]
            asset_from_node = asset_from_parent @ _local(node)
            names |= {str(node.get("name"))} if "mesh" in node else set()
            taken = "mesh" in node and (not nodes or node.get("name") in nodes)
            for primitive in doc["meshes"][node["mesh"]]["primitives"] if taken else []:
                parts.append(_parts(file, primitive, asset_from_node, materials))
            stack += [(c, asset_from_node, depth + 1) for c in reversed(node.get("children", []))]
    except (
        KeyError,
        IndexError,
        TypeError,
        ValueError,
        AttributeError,
        ArithmeticError,
        MemoryError,
    ) as e:
        raise UserError(
            "the glTF file is damaged", f"{type(e).__name__}: {e}", f"export it again: {path}"
        ) from None
    missing = [n for n in nodes if n not in names]
    if missing:
        raise UserError(
            f"the model has no node '{missing[0]}' with a mesh",
            f"it has: {', '.join(sorted(names))}",
            f"choose of these: {path}",
        )
    return merge_parts([p for p in parts if p is not None and len(p.faces)], path)

"""Wavefront OBJ with its MTL: reading (the commonest entries and the PBR ones Pr, Pm, map_Pr,
map_Pm) and writing."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np

from relit.asset.gltf_read import decode_image, file_below
from relit.asset.parts import Part, merge_parts
from relit.conventions import linear_from_srgb
from relit.errors import UserError
from relit.geometry.tangents import vertex_normals
from relit.images import write_data, write_srgb
from relit.scene import Material, Mesh

DEFAULT_ROUGHNESS = 0.4  # MTL files seldom say


def read_obj(path: Path) -> tuple[Mesh, Material]:
    """Mesh and material of an OBJ file. Kd and map_Kd are the base colour (a map replaces Kd);
    without PBR entries roughness is .4, metallic 0. Without vn the normals are smooth."""
    v, vt, vn, materials, groups = [], [], [], {}, {}
    current = None
    try:
        for line in path.read_text(errors="replace").splitlines():
            w = line.split()
            if not w or w[0].startswith("#"):
                continue
            if w[0] == "v":
                v.append([float(x) for x in w[1:4]])
            elif w[0] == "vt":
                vt.append(
                    [float(w[1]), 1.0 - float(w[2]) if len(w) > 2 else 0.0]
                )  # OBJ's v = 0 is the bottom row
            elif w[0] == "vn":
                vn.append([float(x) for x in w[1:4]])
            elif w[0] == "mtllib":
                materials.update(_read_mtl(file_below(path.parent, " ".join(w[1:]))))
            elif w[0] == "usemtl":
                current = " ".join(w[1:])
            elif w[0] == "f":
                corners = [
                    tuple(
                        _index(x, n)
                        for x, n in zip(
                            (*c.split("/"), "", "")[:3], (len(v), len(vt), len(vn)), strict=True
                        )
                    )
                    for c in w[1:]
                ]
                groups.setdefault(current, []).extend(
                    (corners[0], a, b) for a, b in pairwise(corners[1:])
                )
        if any(len(x) != 3 for x in (*v, *vn)):
            raise ValueError("a vertex or a normal has not three coordinates")
        v, vt, vn = (np.array(a, np.float64).reshape(-1, n) for a, n in ((v, 3), (vt, 2), (vn, 3)))
        groups = {
            name: np.array(triangles, np.int64).reshape(-1, 3) for name, triangles in groups.items()
        }
    except (ValueError, IndexError, OverflowError) as e:
        raise UserError(
            "the OBJ file cannot be read", f"{type(e).__name__}: {e}", f"export it again: {path}"
        ) from None
    parts = []
    for name, c in groups.items():
        unique, faces = np.unique(c, axis=0, return_inverse=True)
        if (unique[:, 0] < 0).any() or (unique >= (len(v), max(len(vt), 1), max(len(vn), 1))).any():
            raise UserError(
                "the OBJ file's faces refer to vertices that are not there",
                fix=f"export it again: {path}",
            )
        faces = faces.reshape(-1, 3).astype(np.int32)
        points = v[unique[:, 0]]
        uvs = vt[unique[:, 1]] if len(vt) and (unique[:, 1] >= 0).all() else None
        if len(vn) and (unique[:, 2] >= 0).all():
            normals = vn[unique[:, 2]] / np.maximum(
                np.linalg.norm(vn[unique[:, 2]], axis=-1, keepdims=True), 1e-12
            )
        else:
            normals = vertex_normals(Mesh(points.astype(np.float32), faces)).astype(np.float64)
        material = materials.get(name) or _material(path, {})
        parts.append(Part(points, faces, normals, uvs, name, material))
    return merge_parts(_same_material(parts), path)


def _index(word: str, count: int) -> int:
    """1-based, negative from the end, '' -> -1 (absent)."""
    if not word:
        return -1
    i = int(word)
    return i - 1 if i > 0 else count + i


def _same_material(parts: list[Part]) -> list[Part]:
    """Parts whose materials are the same content share one key, so that they need no atlas."""
    out: list[Part] = []
    for p in parts:
        twin = next((q for q in out if _equal(q.material, p.material)), None)
        out.append(
            p
            if twin is None
            else Part(p.vertices, p.faces, p.normals, p.uvs, twin.key, twin.material)
        )
    return out


def _equal(a: Material, b: Material) -> bool:
    return all(
        np.array_equal(getattr(a, k), getattr(b, k))
        for k in ("base_color", "roughness", "metallic")
    )


def _read_mtl(path: Path) -> dict[str, Material]:
    if not path.is_file():
        raise UserError(
            "the OBJ file's material library is missing", fix=f"put it beside the OBJ: {path}"
        )
    entries: dict[str, dict] = {}
    current: dict = {}
    for line in path.read_text(errors="replace").splitlines():
        w = line.split()
        if w and w[0] == "newmtl":
            current = entries.setdefault(" ".join(w[1:]), {})
        elif w and not w[0].startswith("#"):
            current[w[0].lower()] = w[1:]
    return {name: _material(path, e) for name, e in entries.items()}


def _map(path: Path, words: list[str]) -> np.ndarray:
    """The image that a map_* entry names; options (-s 1 1 1 and the like) come before the file
    name."""
    file = file_below(path.parent, words[-1] if words else "")
    if not file.is_file():
        file = file_below(path.parent, " ".join(words))
    if not file.is_file():
        raise UserError(
            "a texture that the material library names is missing",
            fix=f"put it beside the OBJ: {file}",
        )
    image = decode_image(file.read_bytes(), str(file))
    return image[..., :3] if image.shape[2] >= 3 else np.repeat(image[..., :1], 3, 2)


def _material(path: Path, e: dict) -> Material:
    base = np.array([float(x) for x in e.get("kd", ["0.8"] * 3)], np.float32).reshape(
        1, 1, -1
    ) * np.ones(3, np.float32)
    if "map_kd" in e:
        base = linear_from_srgb(_map(path, e["map_kd"]))
    one = lambda key, default: np.full((1, 1), float(e.get(key, [default])[0]), np.float32)  # noqa: E731
    rough = _map(path, e["map_pr"])[..., 0] if "map_pr" in e else one("pr", DEFAULT_ROUGHNESS)
    metal = _map(path, e["map_pm"])[..., 0] if "map_pm" in e else one("pm", 0.0)
    normal = None
    if "norm" in e or "map_kn" in e:
        n = _map(path, e.get("norm") or e["map_kn"]) * 2 - 1
        normal = (n / np.maximum(np.linalg.norm(n, axis=-1, keepdims=True), 1e-6)).astype(
            np.float32
        )
    ior = float(e.get("ni", [1.5])[0])
    return Material(
        base.astype(np.float32), rough, metal, ior if 1.0 < ior < 3.0 else 1.5, None, normal
    )


def write_obj(path: Path, mesh: Mesh, material: Material) -> list[Path]:
    """Write PATH.obj, its .mtl and textures beside it; returns the files. MTL has no entry for a
    specular map: it is left out."""
    path = Path(path)
    stem = path.stem
    files = [path, path.with_suffix(".mtl")]
    texture = lambda kind: path.with_name(f"{stem}_{kind}.png")  # noqa: E731
    write_srgb(texture("base_color"), material.base_color)
    write_data(texture("roughness"), material.roughness)
    write_data(texture("metallic"), material.metallic)
    files += [texture(k) for k in ("base_color", "roughness", "metallic")]
    mtl = [
        "newmtl relit",
        "Kd 1 1 1",
        f"Ni {material.ior:.6g}",
        f"map_Kd {stem}_base_color.png",
        "Pr 1",
        "Pm 1",
    ]
    mtl += [f"map_Pr {stem}_roughness.png", f"map_Pm {stem}_metallic.png"]
    if material.normal is not None:
        write_data(texture("normal"), np.asarray(material.normal) * 0.5 + 0.5)
        mtl.append(f"norm {stem}_normal.png")
        files.append(texture("normal"))
    path.with_suffix(".mtl").write_text("\n".join(mtl) + "\n")
    normals = mesh.normals if mesh.normals is not None else vertex_normals(mesh)
    uvs = mesh.uvs if mesh.uvs is not None else np.zeros((len(mesh.vertices), 2))
    lines = [f"mtllib {stem}.mtl", "usemtl relit"]
    lines += [f"v {x:.7g} {y:.7g} {z:.7g}" for x, y, z in mesh.vertices.tolist()]
    lines += [f"vt {u:.7g} {1 - v:.7g}" for u, v in uvs.tolist()]
    lines += [f"vn {x:.6g} {y:.6g} {z:.6g}" for x, y, z in normals.tolist()]
    lines += [
        f"f {a}/{a}/{a} {b}/{b}/{b} {c}/{c}/{c}"
        for a, b, c in (np.asarray(mesh.faces) + 1).tolist()
    ]
    path.write_text("\n".join(lines) + "\n")
    return files

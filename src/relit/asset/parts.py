"""Merging the pieces of a model file (primitives, groups) into one mesh with one material."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from relit.errors import UserError
from relit.geometry.tangents import vertex_normals
from relit.scene import Material, Mesh

GUTTER = 8  # pixels of wrapped texture round each cell of an atlas
MAX_REPEATS = (
    8  # how often a texture may be tiled over its part when several materials go into one atlas
)
MAX_ATLAS = 8192  # pixels


@dataclass(frozen=True)
class Part:
    """vertices (V, 3), faces (F, 3), normals (V, 3) or None (flat shading), uvs (V, 2) or None with
    v = 0 at the top row; key names the material."""

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None
    uvs: np.ndarray | None
    key: Hashable
    material: Material


def flat_shaded(part: Part) -> Part:
    """Each face gets its own corners and its own normal: what glTF means by missing normals."""
    corners = part.vertices[part.faces]
    n = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    n = n / np.maximum(np.linalg.norm(n, axis=-1, keepdims=True), 1e-20)
    uvs = None if part.uvs is None else part.uvs[part.faces].reshape(-1, 2)
    faces = np.arange(3 * len(part.faces), dtype=np.int32).reshape(-1, 3)
    return replace(
        part, vertices=corners.reshape(-1, 3), faces=faces, normals=np.repeat(n, 3, 0), uvs=uvs
    )


def merge_parts(parts: list[Part], path: Path) -> tuple[Mesh, Material]:
    """One mesh and one material; several materials are packed into an atlas. Raises UserError when
    nothing is there."""
    if not parts:
        raise UserError("the model has no triangles", fix=f"check the file: {path}")
    parts = [p if p.normals is not None else flat_shaded(p) for p in parts]
    keys = list(dict.fromkeys(p.key for p in parts))
    if len(keys) > 1:
        parts, material = _atlas(parts, keys, path)
    else:
        material = parts[0].material
    start, faces = 0, []
    for p in parts:
        faces.append(p.faces + start)
        start += len(p.vertices)
    textured = any(p.uvs is not None for p in parts)
    if not textured and material.normal is not None:
        material = replace(material, normal=None)
    uvs = (
        np.concatenate(
            [p.uvs if p.uvs is not None else np.zeros((len(p.vertices), 2)) for p in parts]
        )
        if textured
        else None
    )
    mesh = Mesh(
        np.concatenate([p.vertices for p in parts]).astype(np.float32),
        np.concatenate(faces).astype(np.int32),
        np.concatenate([p.normals for p in parts]).astype(np.float32),  # pyright: ignore[reportArgumentType, reportCallIssue]
        None if uvs is None else uvs.astype(np.float32),
    )
    if not (np.isfinite(mesh.vertices).all() and (uvs is None or np.isfinite(uvs).all())):
        raise UserError(
            "the model has coordinates that are not numbers", fix=f"export it again: {path}"
        )
    maps = (
        material.base_color,
        material.roughness,
        material.metallic,
        material.specular,
        material.normal,
    )
    if not all(a is None or np.isfinite(a).all() for a in maps):
        raise UserError(
            "the model has a material value that is not a number", fix=f"export it again: {path}"
        )
    lost = ~(np.abs(np.linalg.norm(mesh.normals, axis=-1) - 1) < 0.01)  # pyright: ignore[reportArgumentType, reportCallIssue]
    if lost.any():  # zero normals in the file
        mesh = replace(mesh, normals=np.where(lost[:, None], vertex_normals(mesh), mesh.normals))  # pyright: ignore[reportArgumentType, reportCallIssue]
    return mesh, material


def _atlas(parts: list[Part], keys: list, path: Path) -> tuple[list[Part], Material]:
    """Grid atlas: each material gets a cell that holds as many repeats of its textures as its
    coordinates use."""
    materials, spans = {}, {}
    for key in keys:
        own = [p for p in parts if p.key == key]
        uv = np.concatenate([p.uvs for p in own if p.uvs is not None] or [np.zeros((1, 2))])
        low = np.floor(uv.min(0) + 1e-6)
        repeats = np.maximum(np.ceil(uv.max(0) - 1e-6) - low, 1)
        if repeats.max() > MAX_REPEATS:
            raise UserError(
                f"a texture is repeated {int(repeats.max())} times over its part, among several materials",
                f"Relit packs several materials into one atlas, with at most {MAX_REPEATS} repeats",
                f"bake the model to one texture: {path}",
            )
        materials[key], spans[key] = own[0].material, (low, repeats)
    columns = int(np.ceil(np.sqrt(len(keys))))
    rows = -(-len(keys) // columns)
    wanted = max(max(_size(materials[k])) * int(spans[k][1].max()) for k in keys)
    side = int(min(max(wanted, 16), MAX_ATLAS // columns - 2 * GUTTER))
    cell = side + 2 * GUTTER
    size = np.array([columns * cell, rows * cell])

    def pack(get, channels):
        if all(get(materials[k]) is None for k in keys):
            return None
        out = np.zeros((rows * cell, columns * cell, channels), np.float32)
        for i, k in enumerate(keys):
            a = get(materials[k])
            a = (
                np.asarray(
                    [0, 0, 1] if channels == 3 and get is _normal else [1] * channels, np.float32
                )[None, None]
                if a is None
                else a
            )
            a = a[..., None] if a.ndim == 2 else a
            a = np.broadcast_to(a, (*a.shape[:2], channels)) if a.shape[2] == 1 else a
            a = (
                np.tile(a, (int(spans[k][1][1]), int(spans[k][1][0]), 1))
                if a.shape[:2] != (1, 1)
                else a
            )
            shrinking = a.shape[0] > side
            a = cv2.resize(
                np.ascontiguousarray(a),
                (side, side),
                interpolation=cv2.INTER_AREA if shrinking else cv2.INTER_LINEAR,
            )
            a = np.pad(
                a.reshape(side, side, channels),
                ((GUTTER, GUTTER), (GUTTER, GUTTER), (0, 0)),
                mode="wrap",
            )
            y, x = divmod(i, columns)
            out[y * cell : (y + 1) * cell, x * cell : (x + 1) * cell] = a
        return out[..., 0] if channels == 1 else out

    iors = {m.ior for m in materials.values()}
    if len(iors) > 1:
        raise UserError(
            f"the model's materials have different indices of refraction: {sorted(iors)}",
            fix=f"give them one: {path}",
        )
    normal = pack(_normal, 3)
    if normal is not None:
        normal = normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)
        normal = np.where(
            np.abs(normal).sum(-1, keepdims=True) > 0.1, normal, np.array([0, 0, 1], np.float32)
        )
    merged = Material(
        pack(lambda m: m.base_color, 3),  # pyright: ignore[reportArgumentType]
        pack(lambda m: m.roughness, 1),  # pyright: ignore[reportArgumentType]
        pack(lambda m: m.metallic, 1),  # pyright: ignore[reportArgumentType]
        iors.pop(),
        pack(lambda m: m.specular, 3),
        normal,
    )
    out = []
    for p in parts:
        y, x = divmod(keys.index(p.key), columns)
        low, repeats = spans[p.key]
        uv = p.uvs if p.uvs is not None else np.full((len(p.vertices), 2), 0.5)
        out.append(
            replace(p, uvs=((uv - low) / repeats * side + GUTTER + np.array([x, y]) * cell) / size)
        )
    return out, merged


def _normal(m: Material):
    return m.normal


def _size(m: Material) -> tuple[int, int]:
    shapes = [
        a.shape[:2]
        for a in (m.base_color, m.roughness, m.metallic, m.specular, m.normal)
        if a is not None
    ]
    return max(s[0] for s in shapes), max(s[1] for s in shapes)

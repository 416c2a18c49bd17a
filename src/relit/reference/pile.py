"""Many copies of one object and the ground under them, as one mesh with one set of textures:
everything that renders a mesh renders it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from relit.conventions import move_points, scale_of
from relit.geometry.se3 import rotation_from
from relit.geometry.tangents import vertex_normals
from relit.reference.mitsuba_scene import Scene, camera_rays
from relit.scene import Camera, Ground, Material, Mesh

LEAST_ROWS = (
    512  # of each half of a stacked texture: the blend between the halves is one texel wide
)


@dataclass(frozen=True)
class Pile:
    """mesh: in the world frame, copy after copy, the ground last. material: of both. faces_each:
    faces of one copy. count: of copies."""

    mesh: Mesh
    material: Material
    faces_each: int
    count: int


def build_pile(
    mesh: Mesh,
    material: Material,
    world_from_object: Sequence[np.ndarray],
    ground: Ground | None = None,
) -> Pile:
    """Copies of `mesh` at the similarities `world_from_object` (N, 4, 4), on `ground` or in the
    air."""
    normals = np.asarray(
        mesh.normals if mesh.normals is not None else vertex_normals(mesh), np.float64
    )
    uvs = (
        np.zeros((len(mesh.vertices), 2), np.float32)
        if mesh.uvs is None
        else np.asarray(mesh.uvs, np.float32)
    )
    vertices, turned, faces = [], [], []
    for k, pose in enumerate(world_from_object):
        pose = np.asarray(pose, np.float64)
        vertices.append(move_points(pose, mesh.vertices))
        turned.append(normals @ (pose[:3, :3] / scale_of(pose)).T)
        faces.append(np.asarray(mesh.faces, np.int64) + k * len(mesh.vertices))
    coordinates = [uvs] * len(vertices)
    if ground is not None:
        uvs = np.stack([uvs[:, 0], np.clip(uvs[:, 1], 0, 1) * 0.5], -1).astype(np.float32)
        coordinates = [uvs] * len(vertices)
        v, f = ground_square(ground)
        faces.append(f + sum(map(len, vertices)))
        vertices.append(v)
        turned.append(np.repeat(np.asarray(ground.normal, np.float64)[None], len(v), 0))
        coordinates.append(np.full((len(v), 2), (0.5, 0.75), np.float32))
        material = stacked(material, ground)
    whole = Mesh(
        np.concatenate(vertices).astype(np.float32),
        np.concatenate(faces).astype(np.int32),
        np.concatenate(turned).astype(np.float32),
        np.concatenate(coordinates),
    )
    return Pile(whole, material, len(mesh.faces), len(world_from_object))


def ground_square(ground: Ground, rows: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Vertices ((rows + 1)^2, 3) and faces (2 rows^2, 3) of the square of the ground, its normal
    up."""
    turn = rotation_from(np.array([0.0, 1.0, 0.0]), np.asarray(ground.normal, np.float64))
    a = np.linspace(-ground.radius, ground.radius, rows + 1)
    x, z = np.meshgrid(a, a)
    v = np.stack([x, np.zeros_like(x), z], -1).reshape(-1, 3) @ turn.T + np.asarray(
        ground.point, np.float64
    )
    i = (np.arange(rows)[:, None] * (rows + 1) + np.arange(rows)).ravel()
    a, b, c, d = i, i + 1, i + rows + 1, i + rows + 2
    return v, np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)]).astype(np.int64)


def stacked(m: Material, ground: Ground) -> Material:
    """The object's maps in the upper half of each texture, the ground's constants in the lower."""

    def stack(plane, value):
        a = np.asarray(plane, np.float32)
        a = np.repeat(a, -(-LEAST_ROWS // a.shape[0]), 0)
        return np.concatenate([a, np.broadcast_to(np.asarray(value, np.float32), a.shape)], 0)

    return replace(
        m,
        base_color=stack(m.base_color, ground.colour),
        roughness=stack(m.roughness, ground.roughness),
        metallic=stack(m.metallic, 0.0),
        specular=None if m.specular is None else stack(m.specular, 1.0),
        normal=None if m.normal is None else stack(m.normal, (0.0, 0.0, 1.0)),
    )


def instance_ids(scene: Scene, pile: Pile, camera: Camera, samples: int = 9) -> np.ndarray:
    """(H, W) int32: the copy that covers most of each pixel (0 ... count - 1), -1 where that is the
    ground or nothing.

    samples: rays a pixel, jittered.
    """
    pixels = camera.width * camera.height
    votes = np.zeros((pixels, pile.count + 1), np.uint8)
    index = np.arange(pixels)
    for k in range(samples):
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(dr.opaque(mi.UInt32, 1000 + k), pixels)
        with dr.suspend_grad():
            ray, _ = camera_rays(scene, camera, dr.arange(mi.UInt32, pixels), sampler)
            pi = scene.mi_scene.ray_intersect_preliminary(mi.Ray3f(ray), coherent=True)
            which = dr.select(pi.is_valid(), pi.prim_index // pile.faces_each, pile.count)
        votes[index, np.minimum(which.numpy().astype(np.int64), pile.count)] += 1
    best = votes.argmax(1)
    return (
        np.where(best == pile.count, -1, best).astype(np.int32).reshape(camera.height, camera.width)
    )


def joined(a: Mesh, material_a: Material, b: Mesh, material_b: Material) -> tuple[Mesh, Material]:
    """Two objects with a material each as one mesh with one set of textures, `a` in the upper half.
    Both meshes in one frame; the index of refraction is that of `a`."""
    import cv2

    def halves(name: str, missing):
        planes = [getattr(m, name) for m in (material_a, material_b)]
        if all(p is None for p in planes):
            return None
        planes = [
            np.full((1, 1, *np.shape(missing)), missing, np.float32)
            if p is None
            else np.asarray(p, np.float32)
            for p in planes
        ]
        if planes[0].ndim != planes[1].ndim:
            planes = [np.repeat(p[..., None], 3, -1) if p.ndim == 2 else p for p in planes]
        height, width = (max(p.shape[k] for p in planes) for k in (0, 1))
        size = (width, max(height, LEAST_ROWS))
        return np.concatenate(
            [cv2.resize(p, size, interpolation=cv2.INTER_NEAREST) for p in planes], 0
        )

    uvs = [
        np.zeros((len(m.vertices), 2), np.float32)
        if m.uvs is None
        else np.asarray(m.uvs, np.float32)
        for m in (a, b)
    ]
    uvs = [
        np.stack([uv[:, 0], np.clip(uv[:, 1], 0, 1) * 0.5 + 0.5 * k], -1)
        for k, uv in enumerate(uvs)
    ]
    normals = [m.normals if m.normals is not None else vertex_normals(m) for m in (a, b)]
    mesh = Mesh(
        np.concatenate([a.vertices, b.vertices]).astype(np.float32),
        np.concatenate([a.faces, np.asarray(b.faces) + len(a.vertices)]).astype(np.int32),
        np.concatenate(normals).astype(np.float32),
        np.concatenate(uvs).astype(np.float32),
    )
    specular = halves("specular", 1.0)
    material = Material(
        halves("base_color", (0.5, 0.5, 0.5)),
        halves("roughness", 0.5),
        halves("metallic", 0.0),
        material_a.ior,
        specular,
        halves("normal", (0.0, 0.0, 1.0)),
    )
    return mesh, material

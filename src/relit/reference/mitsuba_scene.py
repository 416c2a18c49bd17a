"""Reference renderings by Mitsuba 3: full path tracing of a mesh with a metallic-roughness material
under an environment map.

The only file that knows Mitsuba's parameter names. Camera rays are made here from opaque
parameters, so one compiled kernel serves every view of a scene.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from relit.conventions import f0_from_ior, move_points, move_pose, scale_of, similarity
from relit.errors import UserError
from relit.geometry.tangents import vertex_normals, vertex_tangents
from relit.reference import bsdf as relit_bsdf
from relit.reference.path import SmoothOrigins, trace_path
from relit.scene import Camera, Material, Mesh

RAYS_PER_PASS = 1 << 21  # bounds the memory of a pass: about 50 bytes a ray


@dataclass(frozen=True)
class Scene:
    """What `build_scene` returns.

    mi_scene: the Mitsuba scene, moved and scaled (not turned) so that the object fills the unit
    ball: Mitsuba's ray offsets have a fixed size. textures: Mitsuba textures by name (base_color,
    roughness, metallic, specular, normalmap; the last two may be None).
    unit_from_world: (4, 4), scale and translation. origins: where rays leave from, None to leave
    that to Mitsuba's own `path`.
    """

    mi_scene: Any
    textures: dict
    unit_from_world: np.ndarray
    origins: SmoothOrigins | None


def mitsuba_texture(array, *, color=False):
    """Mitsuba texture (float32, no transfer curve) of an (H, W) or (H, W, 3) array with row 0 at v
    = 0."""
    a = np.asarray(array, np.float32)
    a = a[..., None] if a.ndim == 2 else a
    if color and a.shape[2] == 1:
        a = np.repeat(a, 3, 2)
    bitmap = mi.Bitmap(np.ascontiguousarray(a))
    return mi.load_dict(
        {
            "type": "bitmap",
            "bitmap": bitmap,
            "raw": True,
            "format": "variant",
            "filter_type": "bilinear",
            "wrap_mode": "repeat",
        }
    )


def environment_bitmap(environment):
    """Lat-long map (H, W, 3) -> the (2H + 1, W, 3) map whose interpolation by Mitsuba equals
    `conventions.sample_environment`.

    Mitsuba puts the first and the last row AT the poles, Relit puts texel centres at (row + .5) /
    H. Rows at every multiple of half a texel make both the same piecewise linear function.
    """
    e = np.asarray(environment, np.float32)
    out = np.empty((2 * e.shape[0] + 1, *e.shape[1:]), np.float32)
    out[1::2] = e
    out[2:-1:2] = 0.5 * (e[1:] + e[:-1])
    out[0], out[-1] = e[0], e[-1]
    return out


def unit_ball(mesh: Mesh, world_from_asset) -> np.ndarray:
    """unit_from_world (4, 4), scale and translation, with which the mesh fills the unit ball."""
    points = move_points(world_from_asset, mesh.vertices)
    low, high = points.min(0), points.max(0)
    centre, radius = (low + high) / 2, max(np.linalg.norm(high - low) / 2, 1e-12)
    return similarity(np.eye(3), -centre / radius, 1 / radius)


def moved_mesh(mesh: Mesh, unit_from_asset) -> Mesh:
    """The mesh, with smooth normals where it has none, in the unit frame."""
    m = np.asarray(unit_from_asset, np.float64)
    normals = (
        np.asarray(mesh.normals if mesh.normals is not None else vertex_normals(mesh), np.float64)
        @ (m[:3, :3] / scale_of(m)).T
    )
    return replace(
        mesh,
        vertices=move_points(m, mesh.vertices).astype(np.float32),
        normals=normals.astype(np.float32),
    )


def mitsuba_mesh(mesh: Mesh, bsdf, tangents: np.ndarray | None = None):
    """Mitsuba's mesh of a mesh with normals. tangents: (V, 4) of `vertex_tangents`, which become
    attributes for normal maps."""
    props = mi.Properties()
    props["mesh_bsdf"] = bsdf
    out = mi.Mesh("object", len(mesh.vertices), len(mesh.faces), props, True, mesh.uvs is not None)
    p = mi.traverse(out)
    p["vertex_positions"] = mi.Float(mesh.vertices.ravel())
    p["vertex_normals"] = mi.Float(mesh.normals.ravel())
    if mesh.uvs is not None:
        p["vertex_texcoords"] = mi.Float(np.asarray(mesh.uvs, np.float32).ravel())
    p["faces"] = mi.UInt32(np.asarray(mesh.faces, np.uint32).ravel())
    p.update()
    if tangents is not None:
        out.add_attribute("vertex_tangent", 3, np.ascontiguousarray(tangents[:, :3]).ravel())
        out.add_attribute("vertex_handedness", 1, np.ascontiguousarray(tangents[:, 3]))
    return out


def build_scene(
    mesh: Mesh, material: Material, world_from_asset=None, environment=None, *, bsdf: str = "relit"
) -> Scene:
    """A Mitsuba scene in the world frame.

    world_from_asset: (4, 4) similarity or None for the identity. environment: (H, W, 3) lat-long
    radiance in the world frame, or None for darkness. bsdf: 'relit' (materials.brdf and
    rendering.path, what fits use) or 'principled' (Mitsuba's own BSDF and path tracer, for ground
    truth that Relit did not write).
    """
    if bsdf not in ("relit", "principled"):
        raise UserError(f"unknown bsdf '{bsdf}'", fix="choose relit or principled", code=2)
    if material.normal is not None and mesh.uvs is None:
        raise UserError(
            "the material has a normal map but the mesh has no texture coordinates",
            fix="give it uvs, or drop the map",
        )
    world_from_asset = (
        np.eye(4) if world_from_asset is None else np.asarray(world_from_asset, np.float64)
    )
    t = {
        "base_color": mitsuba_texture(material.base_color, color=True),
        "roughness": mitsuba_texture(material.roughness),
        "metallic": mitsuba_texture(material.metallic),
        "specular": None
        if material.specular is None
        else mitsuba_texture(material.specular, color=True),
        "normalmap": None
        if material.normal is None
        else mitsuba_texture(np.asarray(material.normal, np.float32) * 0.5 + 0.5),
    }
    unit_from_world = unit_ball(mesh, world_from_asset)
    unit = moved_mesh(mesh, unit_from_world @ world_from_asset)
    tangents = None if t["normalmap"] is None else vertex_tangents(unit)
    scene: dict[str, Any] = {"type": "scene"}
    if bsdf == "relit":
        own = {"type": relit_bsdf.register_bsdf(), "int_ior": float(material.ior)}
        own |= {k: v for k, v in t.items() if v is not None}
        scene["object"] = mitsuba_mesh(unit, mi.load_dict(own), tangents)
    else:
        mirrored = np.zeros(len(unit.faces), bool) if tangents is None else mirrored_faces(unit)
        for name, chosen in (("object", ~mirrored), ("mirrored", mirrored)):
            if chosen.any():
                part = replace(unit, faces=np.ascontiguousarray(unit.faces[chosen]))
                plugin = mi.load_dict(principled_plugin(material, t, name == "mirrored"))
                scene[name] = mitsuba_mesh(part, plugin, tangents)
    if environment is not None:
        scene["environment"] = {
            "type": "envmap",
            "bitmap": mi.Bitmap(environment_bitmap(environment)),
        }
    return Scene(
        mi.load_dict(scene), t, unit_from_world, SmoothOrigins(unit) if bsdf == "relit" else None
    )


def mirrored_faces(mesh: Mesh) -> np.ndarray:
    """(F,) bool: faces whose texture is mirrored (a handedness of -1 in glTF)."""
    v, uv = np.asarray(mesh.vertices, np.float64)[mesh.faces], np.asarray(mesh.uvs)[mesh.faces]
    facet = np.cross(v[:, 1] - v[:, 0], v[:, 2] - v[:, 0])
    side = np.sign((facet * np.asarray(mesh.normals)[mesh.faces].sum(1)).sum(-1))
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    return (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) * side > 0  # v points down in the texture


def principled_plugin(material: Material, textures: dict, mirrored: bool) -> dict:
    """Mitsuba's `principled` with the material's textures, as a dictionary for `load_dict`.

    mirrored: for faces of `mirrored_faces`. Mitsuba's `normalmap` has no handedness (its bitangent
    is cross(n, t)), so the second component of the map is negated there.
    """
    d = {
        "type": "principled",
        "eta": principled_eta(material),
        **{k: textures[k] for k in ("base_color", "roughness", "metallic")},
    }
    if material.normal is not None:
        normal = np.asarray(material.normal, np.float32) * (1, -1 if mirrored else 1, 1)
        d = {"type": "normalmap", "normalmap": mitsuba_texture(normal * 0.5 + 0.5), "bsdf": d}
    return {"type": "twosided", "bsdf": d}


def principled_eta(material: Material) -> float:
    """Index of refraction with the material's dielectric F0, a constant grey specular factor
    included. Raises UserError for a specular texture or colour, which `principled` lacks."""
    if material.specular is None:
        return float(material.ior)
    factor = np.asarray(material.specular)
    if np.ptp(factor) > 1e-3:
        raise UserError(
            "Mitsuba's principled BSDF takes no specular texture or colour",
            "the material has one",
            "use the own renderer or cycles",
            code=2,
        )
    root = np.sqrt(min(f0_from_ior(float(material.ior)) * float(factor.mean()), 0.9))
    return float(max((1 + root) / (1 - root), 1.0001))


def build_geometry(mesh: Mesh):
    """A Mitsuba scene of the mesh alone, in its own frame, for ray queries (no material, no
    light)."""
    return mi.load_dict(
        {"type": "scene", "object": mitsuba_mesh(mesh, mi.load_dict({"type": "diffuse"}))}
    )


def camera_rays(scene: Scene, camera: Camera, index, sampler):
    """A ray through each pixel of `index` (UInt32, row by row), uniformly jittered (a box filter),
    in the unit frame; also the cosine to the optical axis, which turns distance into depth."""
    if camera.distortion and np.any(np.asarray(camera.distortion)):
        raise UserError(
            "a camera with lens distortion cannot be rendered",
            "pictures are pinhole pictures",
            "undistort the camera first",
        )
    jitter = sampler.next_2d()
    o = lambda x: dr.opaque(mi.Float, float(x))  # noqa: E731  values that change per view must not become literals
    x = (mi.Float(index % camera.width) + jitter.x - o(camera.cx)) / o(camera.fx)
    y = (mi.Float(index // camera.width) + jitter.y - o(camera.cy)) / o(camera.fy)
    m = [
        [o(v) for v in row]
        for row in move_pose(scene.unit_from_world, camera.world_from_camera)[:3]
    ]
    inv = dr.rsqrt(dr.fma(x, x, dr.fma(y, y, 1)))
    d = mi.Vector3f(*[(r[0] * x + r[1] * y + r[2]) * inv for r in m])
    return mi.RayDifferential3f(mi.Point3f(m[0][3], m[1][3], m[2][3]), dr.normalize(d)), inv


def sample_sums(
    scene,
    camera: Camera,
    spp: int,
    seed: int,
    sample: Callable,
    where=None,
    progress: Callable | None = None,
) -> np.ndarray:
    """(N, C) float64: sums over the samples of each pixel, row by row; of the pixels of `where`,
    (H, W) bool, alone where that is given.

    sample(ray, cosine, sampler): C Floats for rays of `camera_rays`. progress: called with (samples
    of a pixel that are done, spp). The memory of one pass is bounded.
    """
    chosen = None if where is None else np.flatnonzero(where).astype(np.uint32)
    pixels = camera.width * camera.height if chosen is None else len(chosen)
    per_pass = max(1, min(spp, RAYS_PER_PASS // max(pixels, 1)))
    total, done, k = 0.0, 0, 0
    with dr.suspend_grad():
        while done < spp:
            n = min(per_pass, spp - done)
            sampler = mi.load_dict({"type": "independent"})
            sampler.seed(dr.opaque(mi.UInt32, (seed * 9973 + k) & 0xFFFFFFFF), n * pixels)
            # an array in memory, not a remainder: how many pixels there are is no literal of the
            # kernel
            index = (
                dr.arange(mi.UInt32, n * pixels) % pixels
                if chosen is None
                else mi.UInt32(np.tile(chosen, n))
            )
            values = sample(*camera_rays(scene, camera, index, sampler), sampler)
            dr.eval(values)
            total = total + np.stack(
                [v.numpy().reshape(n, pixels).sum(0, dtype=np.float64) for v in values], -1
            )
            done, k = done + n, k + 1
            if progress is not None:
                progress(done, spp)
    return total


def render(
    scene: Scene,
    camera: Camera,
    *,
    spp: int,
    seed: int = 0,
    max_depth: int = 6,
    where=None,
    progress=None,
) -> np.ndarray:
    """(H, W, 4) float32: linear radiance premultiplied on black, and alpha. Box filter; the
    environment lights but is not seen.

    max_depth: longest path in edges (2 = direct light only, 6 = four inter-reflections). where,
    progress: see `sample_sums`; 0 elsewhere. Not differentiable.
    """
    depth = dr.opaque(mi.UInt32, max_depth)
    if scene.origins is None:
        path = mi.load_dict(
            {"type": "path", "max_depth": max_depth, "rr_depth": 1000, "hide_emitters": True}
        )

    def sample(ray, _, sampler):
        if scene.origins is None:
            color, hit, _ = path.sample(scene.mi_scene, sampler, ray)
        else:
            color, hit = trace_path(
                scene.mi_scene,
                scene.mi_scene.shapes()[0].bsdf(),
                scene.origins,
                sampler,
                mi.Ray3f(ray),
                depth,
            )
        return [*color, dr.select(hit, mi.Float(1), 0)]

    return as_picture(
        sample_sums(scene, camera, spp, seed, sample, where, progress) / spp, camera, where
    )


def as_picture(values: np.ndarray, camera: Camera, where=None) -> np.ndarray:
    """(H, W, C) float32 of the values (N, C) of pixels, see `sample_sums`; what is no number
    becomes 0."""
    out = np.zeros((camera.height, camera.width, values.shape[-1]), np.float32)
    out[np.ones(out.shape[:2], bool) if where is None else where] = np.where(
        np.isfinite(values), values, 0
    )
    return out


def render_channels(
    scene: Scene, camera: Camera, spp: int = 16, seed: int = 0
) -> dict[str, np.ndarray]:
    """Material and geometry as the camera sees them, means over the covered part of each pixel, 0
    where nothing is hit.

    albedo: (H, W, 3) linear base colour. roughness, metallic: (H, W). normal: (H, W, 3) unit
    shading normals in the WORLD frame.
    depth: (H, W) along the optical axis in world units. alpha: (H, W) coverage.
    """
    t = scene.textures

    def sample(ray, cosine, _):
        si = scene.mi_scene.ray_intersect(ray)
        hit = si.is_valid()
        normal = si.to_world(mi.Vector3f(relit_bsdf.shading_normal(si, t["normalmap"], hit)))
        base = mi.Color3f(t["base_color"].eval(si, hit))
        values = [
            *base,
            t["roughness"].eval_1(si, hit),
            t["metallic"].eval_1(si, hit),
            *normal,
            si.t * cosine,
            mi.Float(1),
        ]
        return [dr.select(hit, v, 0) for v in values]

    total = sample_sums(scene, camera, spp, seed, sample)
    count = np.maximum(total[:, 9:], 1e-9)
    mean = (total / count).reshape(camera.height, camera.width, 10).astype(np.float32)
    normal = mean[..., 5:8]
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    alpha = (total[:, 9] / spp).reshape(camera.height, camera.width).astype(np.float32)
    return {
        "albedo": mean[..., :3],
        "roughness": mean[..., 3],
        "metallic": mean[..., 4],
        "normal": normal / np.maximum(length, 1e-9),
        "depth": mean[..., 8] / np.float32(scale_of(scene.unit_from_world)),
        "alpha": alpha,
    }

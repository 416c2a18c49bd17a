"""Monte Carlo light transport on a mesh under an environment: what the surface pass differentiates.

SfD Eq. (3): L_o(w_o; x) = ∫ L_i(w_i) f_r(w_i, w_o; x) (w_i·n) dw_i, with many directions at each of
few surface points. Half of the directions follow the light, half the BRDF (balance heuristic over
the mixture). Visibility is traced. Where a direction is blocked, the
light that arrives is the radiance of the surface that blocks it: the mean radiance that the photos
show there, so every inter-reflection is in it, and it is a constant of the fit. Directions,
visibility and densities are detached (no boundary term: this pass cannot move silhouettes or shadow
edges).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from relit.geometry.tangents import vertex_tangents
from relit.lighting.environment import Environment
from relit.materials.brdf import Surface, brdf_pdf, evaluate_brdf, sample_brdf
from relit.reference.mitsuba_scene import build_geometry
from relit.reference.path import SmoothOrigins
from relit.rendering.blocks import block_sums, repeat
from relit.scene import Mesh

OFFSET = 1e-3  # of the unit frame, along the normal


@dataclass(frozen=True)
class Blockers:
    """A mesh without texels, which only blocks light and reflects its own, and the linear radiance
    (V, 3) of its vertices."""

    mesh: Mesh
    radiance: np.ndarray


class TraceableMesh:
    """A mesh with uvs, normals and one RGB radiance per vertex, in the unit frame, ready for ray
    queries, and what else is in the scene.

    mesh, radiance: of the textured mesh, followed by the blockers. textured_faces,
    textured_vertices: how many of the faces and vertices are not blockers.
    """

    def __init__(self, mesh: Mesh, radiance: np.ndarray, blockers: Blockers | None = None):
        self.textured_faces, self.textured_vertices = len(mesh.faces), len(mesh.vertices)
        if blockers is not None:
            mesh = textured_and_blockers(mesh, blockers.mesh)
            radiance = np.concatenate([radiance, blockers.radiance])
        self.mesh, self.scene = mesh, build_geometry(mesh)
        self.origins = SmoothOrigins(mesh)
        self.faces, self.normals = self.origins.faces, self.origins.normals
        self.uvs = mi.Float(np.ascontiguousarray(mesh.uvs, np.float32).ravel())
        self.tangents = mi.Float(vertex_tangents(mesh).ravel())
        self.radiance = mi.Float(np.ascontiguousarray(radiance, np.float32).ravel())

    @property
    def only_blocks(self) -> np.ndarray:
        """(V,) bool: vertices of the blockers."""
        return np.arange(len(self.mesh.vertices)) >= self.textured_vertices


def textured_and_blockers(one: Mesh, other: Mesh) -> Mesh:
    """Both meshes, with normals and uvs, as one."""
    return Mesh(
        np.concatenate([one.vertices, other.vertices]),
        np.concatenate([one.faces, other.faces + len(one.vertices)]),
        np.concatenate([one.normals, other.normals]),
        np.concatenate([one.uvs, other.uvs]),
    )


@dataclass
class Points:
    """Surface points seen along rays. valid: Bool. x: Point3f on the smooth surface. n: Vector3f
    unit shading normal. geometric: Vector3f.
    v: Vector3f to the viewer. uv: Point2f, v = 0 at the top row of textures. t, b: Vector3f unit
    tangent and bitangent of normal maps, orthogonal to the interpolated normal (glTF 2.0, Sec.
    3.9.3)."""

    valid: Any
    x: Any
    n: Any
    geometric: Any
    v: Any
    uv: Any
    t: Any
    b: Any


def first_hits(mesh: TraceableMesh, o, d) -> Points:
    """Where rays (o, d) meet the mesh from outside. Detached."""
    with dr.suspend_grad():
        ray = mi.Ray3f(mi.Point3f(o), d)
        pi = mesh.scene.ray_intersect_preliminary(ray, coherent=False)
        si = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal)
        hit = si.is_valid() & dr.isfinite(
            pi.prim_uv.x + pi.prim_uv.y
        )  # a sliver can give barycentric coordinates that are no numbers
        b = (1 - pi.prim_uv.x - pi.prim_uv.y, pi.prim_uv.x, pi.prim_uv.y)
        corner = [dr.gather(mi.UInt32, mesh.faces, pi.prim_index * 3 + k, hit) for k in range(3)]
        n = sum(b[k] * dr.gather(mi.Vector3f, mesh.normals, corner[k], hit) for k in range(3))
        n = dr.select(
            hit, dr.normalize(n), mi.Vector3f(0, 0, 1)
        )  # a miss must not become a NaN that meets a zero weight
        uv = dr.select(
            hit, sum(b[k] * dr.gather(mi.Point2f, mesh.uvs, corner[k], hit) for k in range(3)), 0
        )
        x = dr.select(hit, mi.Point3f(mesh.origins.shifted(si, pi.prim_uv, hit)), 0)
        t = sum(b[k] * dr.gather(mi.Vector4f, mesh.tangents, corner[k], hit) for k in range(3))
        along = mi.Vector3f(t.x, t.y, t.z)
        along = along - n * dr.dot(n, along)
        length = dr.norm(along)
        along = dr.select(hit & (length > 1e-6), along / dr.maximum(length, 1e-6), mi.Frame3f(n).s)
        across = dr.select(t.w < 0, -1.0, 1.0) * dr.cross(n, along)
        geometric = dr.select(hit, mi.Vector3f(si.n), mi.Vector3f(0, 0, 1))
        seen = hit & (dr.dot(si.n, d) < 0) & (pi.prim_index < mesh.textured_faces)
        return Points(seen, x, n, geometric, -mi.Vector3f(d), uv, along, across)


def bent_normal(points: Points, slope):
    """The normal of a normal map, n + slope.x t + slope.y b made unit (Vector3f); differentiable in
    slope (Point2f or Vector2f)."""
    return dr.normalize(points.n + slope.x * points.t + slope.y * points.b)


@dataclass
class Lights:
    """`count` directions for each point, point-major. l: Vector3f. weight: Float, 1 / (count *
    density), 0 where a direction is useless.
    visible: Float, 1 where nothing blocks. blocked: Color3f, radiance of the blocker, 0 where
    visible. point: UInt32."""

    count: int
    l: Any
    weight: Any
    visible: Any
    blocked: Any
    point: Any


def low_discrepancy(count: int) -> np.ndarray:
    """(count, 3) points of the R3 sequence (Roberts 2018)."""
    g = 1.2207440846057596
    return ((np.arange(count)[:, None] + 0.5) * np.array([1 / g, 1 / g**2, 1 / g**3]) % 1.0).astype(
        np.float32
    )


def sample_lights(
    mesh: TraceableMesh, points: Points, surface: Surface, environment: Environment, count: int, rng
) -> Lights:
    """Draw and trace `count` (a multiple of 4) directions per point. rng: PCG32 with one lane per
    point. Detached."""
    with dr.suspend_grad():
        total = dr.width(points.x)
        quarter = count // 4
        base = mi.Float(low_discrepancy(quarter).T.ravel())
        shifts = [
            mi.Vector3f(rng.next_float32(), rng.next_float32(), rng.next_float32())
            for _ in range(4)
        ]
        dr.eval(shifts, rng)
        index = dr.arange(mi.UInt32, total * count)
        point, j = index // count, index % count
        odd, k = (j & 1) == 1, j >> 1
        from_light = k < quarter
        k = dr.select(from_light, k, k - quarter)
        s = [
            dr.gather(mi.Vector3f, c, point) for c in shifts
        ]  # independent for the even and the odd half, and for the two strategies
        s = dr.select(odd, dr.select(from_light, s[0], s[1]), dr.select(from_light, s[2], s[3]))
        u = [dr.gather(mi.Float, base, k + quarter * c) for c in range(3)]
        u = [dr.minimum(a - dr.floor(a), 0.9999999) for a in (u[0] + s.x, u[1] + s.y, u[2] + s.z)]
        n, v = dr.gather(mi.Vector3f, points.n, point), dr.gather(mi.Vector3f, points.v, point)
        m = surface_at(surface, point)
        l_light, _ = environment.sample(mi.Point2f(u[0], u[1]))
        l_brdf = sample_brdf(m, n, v, u[2], mi.Point2f(u[0], u[1]))
        l = dr.select(from_light, l_light, l_brdf)
        density = 0.5 * environment.pdf(l) + 0.5 * brdf_pdf(m, n, v, l)
        useful = (dr.dot(n, l) > 0) & dr.gather(mi.Bool, points.valid, point)
        weight = dr.select(useful, 1 / (count * dr.maximum(density, 1e-6)), 0)
        g = dr.gather(mi.Vector3f, points.geometric, point)
        x = dr.gather(mi.Point3f, points.x, point) + g * OFFSET
        ray = mi.Ray3f(x, l)
        pi = mesh.scene.ray_intersect_preliminary(ray, coherent=False, active=useful)
        hit = pi.is_valid() & useful
        known = hit & dr.isfinite(pi.prim_uv.x + pi.prim_uv.y)
        b = (1 - pi.prim_uv.x - pi.prim_uv.y, pi.prim_uv.x, pi.prim_uv.y)
        corner = [dr.gather(mi.UInt32, mesh.faces, pi.prim_index * 3 + c, known) for c in range(3)]
        blocked = mi.Color3f(0)
        for c in range(3):
            blocked += b[c] * dr.gather(mi.Color3f, mesh.radiance, corner[c], known)
        blocked = dr.select(known, blocked, 0)
        out = Lights(count, l, weight, dr.select(hit, mi.Float(0), 1), blocked, point)
        dr.eval(out.l, out.weight, out.visible, out.blocked, out.point)
        return out


def surface_at(surface: Surface, point) -> Surface:
    """The material of each direction's point."""
    return Surface(
        dr.gather(mi.Color3f, surface.base, point),
        dr.gather(mi.Float, surface.roughness, point),
        dr.gather(mi.Float, surface.metallic, point),
        surface.f0,
    )


def reflected(points: Points, lights: Lights, surface: Surface, environment: Environment):
    """Radiance towards the viewer (two Color3f, estimated from the even and from the odd directions
    of each point).

    Differentiable in the surface's material, in points.n and in environment.radiance. The product
    of the two residuals is an unbiased estimate of the squared error; the square of one estimate
    would pull towards materials with less noise.
    """
    v = dr.gather(mi.Vector3f, points.v, lights.point)
    n, *material = repeat(
        (points.n, surface.base, surface.roughness, surface.metallic), lights.count
    )
    m = Surface(*material, surface.f0)
    arriving = environment.eval(lights.l) * lights.visible + lights.blocked
    value = evaluate_brdf(m, n, v, lights.l) * arriving * (2 * lights.weight)
    odd = (dr.arange(mi.UInt32, dr.width(lights.weight)) & 1) == 1
    zero = mi.Color3f(0)
    first, second = dr.select(odd, zero, value), dr.select(odd, value, zero)
    return block_sums((first, second), lights.count)

"""A path tracer like Mitsuba's `path` (next-event estimation, multiple importance sampling), with
the shadow terminator mended.

Rays leave from the smooth surface that the vertex normals describe, not from the flat triangle, so
that facets do not shade themselves (Hanika 2021, "Hacking the shadow terminator", Ray Tracing Gems
II, ch. 4). Reference renderings only: not differentiable.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from relit.materials import brdf
from relit.reference.bsdf import shading_normal
from relit.scene import Mesh

# of the triangle's longest edge; a sphere of 30 facets round needs .025, a cube with averaged
# normals would want .25
MAX_SHIFT = 0.05


class SmoothOrigins:
    """What `shifted` needs of a mesh with normals, in the scene's frame. A plain class: Dr.Jit
    would carry the fields of a dataclass through its loops as variables."""

    def __init__(self, mesh: Mesh):
        flat = lambda a: np.ascontiguousarray(a, np.float32).ravel()  # noqa: E731
        self.faces = mi.UInt32(np.asarray(mesh.faces, np.uint32).ravel())
        self.positions, self.normals = mi.Float(flat(mesh.vertices)), mi.Float(flat(mesh.normals))
        dr.eval(self.faces, self.positions, self.normals)

    def shifted(self, si, prim_uv, active):
        """`si.p` moved onto the smooth surface, on the side that is seen. prim_uv: barycentric
        coordinates of corners 1 and 2."""
        b = (1 - prim_uv.x - prim_uv.y, prim_uv.x, prim_uv.y)
        corner = [dr.gather(mi.UInt32, self.faces, si.prim_index * 3 + k, active) for k in range(3)]
        p = [dr.gather(mi.Point3f, self.positions, c, active) for c in corner]
        n = [dr.gather(mi.Vector3f, self.normals, c, active) for c in corner]
        side = dr.select(dr.dot(si.n, si.to_world(si.wi)) < 0, -1.0, 1.0)
        shift = mi.Vector3f(0)
        for k in range(3):
            outward = side * n[k]
            shift -= b[k] * dr.minimum(dr.dot(si.p - p[k], outward), 0) * outward
        edge = dr.sqrt(
            dr.maximum(
                dr.maximum(dr.squared_norm(p[1] - p[0]), dr.squared_norm(p[2] - p[1])),
                dr.squared_norm(p[0] - p[2]),
            )
        )
        length = dr.norm(shift)
        return si.p + shift * dr.minimum(1, MAX_SHIFT * edge / dr.maximum(length, 1e-12))


def _balance(a, b):
    """Power heuristic (beta = 2)."""
    a2 = dr.square(a)
    return dr.select(a > 0, a2 / (a2 + dr.square(b)), 0)


@dr.syntax
def trace_path(scene, bsdf, origins, sampler, ray, max_depth):
    """Radiance (Color3f) along `ray` and whether it meets the object (Bool). The light is not seen
    by the camera.

    bsdf: the object's, from `reference.bsdf`; called without Mitsuba's dispatch, so that its
    textures are looked up once a bounce.
    max_depth: longest path in edges, as Mitsuba counts (2 = direct light only); mi.UInt32, opaque.
    """
    L = mi.Color3f(0)  # radiance so far
    beta = mi.Color3f(1)  # path throughput
    depth = mi.UInt32(0)
    hit = mi.Bool(False)
    previous = dr.zeros(mi.Interaction3f)
    previous_pdf = mi.Float(1)
    active = mi.Bool(True)
    while active:
        pi = scene.ray_intersect_preliminary(ray, coherent=depth == 0, active=active)
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
        valid = active & si.is_valid()
        hit |= valid & (depth == 0)

        # ---- light that the last BSDF sample ran into
        escaped = active & ~si.is_valid() & (depth > 0)
        ds = mi.DirectionSample3f(scene, si, previous)
        light_pdf = scene.pdf_emitter_direction(previous, ds, escaped)
        L += dr.select(
            escaped, beta * _balance(previous_pdf, light_pdf) * ds.emitter.eval(si, escaped), 0
        )

        # ---- light sampled directly
        go_on = valid & (depth + 1 < max_depth)
        si.p = dr.select(go_on, origins.shifted(si, pi.prim_uv, go_on), si.p)
        m, n = bsdf.surface(si, go_on), shading_normal(si, bsdf.normalmap, go_on)
        ds, light = scene.sample_emitter_direction(si, sampler.next_2d(), True, go_on)
        lit = go_on & (ds.pdf > 0)
        wl = si.to_local(ds.d)
        L += dr.select(
            lit,
            beta
            * brdf.evaluate_brdf(m, n, si.wi, wl)
            * light
            * _balance(ds.pdf, brdf.brdf_pdf(m, n, si.wi, wl)),
            0,
        )

        # ---- the next direction
        wo = brdf.sample_brdf(m, n, si.wi, sampler.next_1d(), sampler.next_2d())
        pdf = brdf.brdf_pdf(m, n, si.wi, wo)
        go_on &= pdf > 0
        beta *= dr.select(go_on, brdf.evaluate_brdf(m, n, si.wi, wo) / dr.select(go_on, pdf, 1), 0)
        ray = si.spawn_ray(si.to_world(wo))
        previous = mi.Interaction3f(si)
        previous_pdf = pdf
        depth += 1
        active = go_on & (dr.max(beta) > 0)
    return L, hit

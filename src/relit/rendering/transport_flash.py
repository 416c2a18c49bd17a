"""Light transport on a mesh under the flash: what the surface pass of flash captures differentiates
(PIR Eq. 2).

    I(w_o; x) = L_i(w_i; x) f_r(w_o, w_i; x) (w_i·n) f_v(w_i; x) + f_ir(w_o; x)

The light is a point, so one shadow ray a pixel makes f_v exact: direct light has no noise. f_ir
(Eq. 6) follows one or more directions drawn from the lobe around the mirror direction and from the
cosine; the secondary hit is lit by the offset flash with its own shadow, with the whole BRDF and
Fresnel term at both ends. Departs from PIR: no learnt blending factor γ, the estimate is unbiased.
Visibility and directions are detached: this pass cannot move shadow edges.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from relit.lighting.flash import incident
from relit.materials.plastic_field import PlasticField, plastic_at
from relit.materials.rough_plastic import Coat, evaluate_plastic, plastic_pdf, sample_plastic
from relit.rendering.transport import OFFSET, Points, TraceableMesh, bent_normal, first_hits

# cosine of a light's direction over the flat triangle below which a point lies in its own shadow
LOWEST = 0.02


def lit(mesh: TraceableMesh, points: Points, position, active):
    """1 where the light at `position` is seen from a point (Float), else 0. Detached."""
    with dr.suspend_grad():
        start = mi.Point3f(points.x + points.geometric * OFFSET)
        to = dr.detach(mi.Vector3f(position)) - mi.Vector3f(start)
        length = dr.norm(to)
        blocked = mesh.scene.ray_test(
            mi.Ray3f(start, to / length, length, 0.0, []), coherent=False, active=active
        )
        return dr.select(active & ~blocked, mi.Float(1), 0)


def direct(points: Points, plastic, coat: Coat, n, position, intensity, seen):
    """Eq. (2), first term: Color3f. n: Vector3f, the normal to shade with. seen: Float, f_v.
    Differentiable in all but the points."""
    l, inverse = incident(position, points.x)
    return evaluate_plastic(plastic, coat, n, points.v, l) * (inverse * intensity * seen)


def indirect(
    mesh: TraceableMesh,
    field: PlasticField,
    coat: Coat,
    points: Points,
    plastic,
    n,
    position,
    intensity,
    rng,
    bounces: int = 1,
    shadow: bool = True,
):
    """Eq. (6) with one direction per point: Color3f, an unbiased estimate of light over one to
    `bounces` inter-reflections.

    Differentiable in the plastic and the normal at the points; what arrives there is a constant.
    rng: PCG32 with one lane a point. shadow: False lights what is hit as if nothing stood before
    it.
    """
    with dr.suspend_grad():
        flash = dr.detach(mi.Vector3f(position))
        at_first = dr.detach(plastic)
        n_first = dr.detach(n)
        l_first = sample_plastic(
            at_first,
            n_first,
            points.v,
            rng.next_float32(),
            mi.Point2f(rng.next_float32(), rng.next_float32()),
        )
        density = plastic_pdf(at_first, n_first, points.v, l_first)
        active = points.valid & (density > 1e-6) & (dr.dot(n_first, l_first) > 0)
        throughput, arriving = mi.Color3f(1), mi.Color3f(0)
        here, l, more = points, l_first, active
        for bounce in range(bounces):
            hit = first_hits(mesh, here.x + here.geometric * OFFSET, l)
            more = more & hit.valid
            m, slope = plastic_at(field, hit.uv, more)
            bent = bent_normal(hit, slope)
            seen = lit(mesh, hit, flash, more) if shadow else dr.select(more, mi.Float(1), 0)
            value = direct(hit, m, coat, bent, flash, dr.detach(intensity), seen)
            arriving += dr.select(more, throughput * value, 0)
            if bounce + 1 < bounces:
                l = sample_plastic(
                    m,
                    bent,
                    hit.v,
                    rng.next_float32(),
                    mi.Point2f(rng.next_float32(), rng.next_float32()),
                )
                p = plastic_pdf(m, bent, hit.v, l)
                more = more & (p > 1e-6)
                throughput *= dr.select(
                    more, evaluate_plastic(m, coat, bent, hit.v, l) / dr.maximum(p, 1e-6), 0
                )
                here = hit
        weight = dr.select(active, dr.rcp(dr.maximum(density, 1e-6)), 0)
        dr.eval(arriving, weight, l_first, rng)
    return evaluate_plastic(plastic, coat, n, points.v, l_first) * (arriving * weight)

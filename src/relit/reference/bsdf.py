"""`relit_metallic_roughness`: the BRDF of `materials.brdf` as a Mitsuba plugin, for reference
renderings.

Textures: base_color, roughness, metallic, specular (factor on the dielectric F0, optional),
normalmap (tangent space, encoded as (n + 1) / 2, optional; needs the mesh attributes vertex_tangent
and vertex_handedness). Parameter: int_ior. Both sides of the surface reflect. All Mitsuba classes
are made after the variant is set: call `register()` first.
"""

from __future__ import annotations

from functools import cache

import drjit as dr
import mitsuba as mi

from relit.conventions import f0_from_ior
from relit.materials import brdf

PLUGIN = "relit_metallic_roughness"


def shading_normal(si, normalmap, active=True):
    """Shading normal in the LOCAL shading frame of `si` (Normal3f), turned to the side of the
    surface that is seen.

    normalmap: a Mitsuba texture or None. The bitangent is w * cross(n, t), up in the texture (glTF
    2.0, Sec. 3.9.3).
    """
    n = mi.Normal3f(0, 0, 1)
    if normalmap is not None:
        m = 2 * mi.Vector3f(normalmap.eval_3(si, active)) - 1
        t = si.shape.eval_attribute_3("vertex_tangent", si, active)
        w = si.shape.eval_attribute_1("vertex_handedness", si, active)
        t = si.to_local(mi.Vector3f(t))
        t = mi.Vector3f(t.x, t.y, 0)
        length = dr.norm(t)
        t = dr.select(length > 1e-6, t / dr.maximum(length, 1e-6), mi.Vector3f(1, 0, 0))
        b = dr.select(w < 0, -1.0, 1.0) * mi.Vector3f(-t.y, t.x, 0)  # cross((0, 0, 1), t)
        n = mi.Normal3f(
            dr.normalize(m.x * t + m.y * b + dr.maximum(m.z, 1e-3) * mi.Vector3f(0, 0, 1))
        )
    seen_from_behind = dr.dot(si.n, si.to_world(si.wi)) < 0
    return dr.select(seen_from_behind, -n, n)


def register_bsdf() -> str:
    """Make the plugin known to the present Mitsuba variant; returns its name."""
    _register(mi.variant())
    return PLUGIN


@cache
def _register(variant: str) -> None:
    class MetallicRoughness(mi.BSDF):
        """See the module's text. Evaluates and samples `materials.brdf`."""

        def __init__(self, props):
            mi.BSDF.__init__(self, props)
            self.base_color = props.get_texture("base_color", 0.5)
            self.roughness = props.get_texture("roughness", 0.5)
            self.metallic = props.get_texture("metallic", 0.0)
            self.specular = props.get_texture("specular", 1.0)
            self.normalmap = (
                props.get_texture("normalmap") if props.has_property("normalmap") else None
            )
            self.f0 = f0_from_ior(float(props.get("int_ior", 1.5)))
            flags = mi.BSDFFlags
            self.m_components = [
                flags.DiffuseReflection | flags.GlossyReflection | flags.FrontSide | flags.BackSide
            ]
            self.m_flags = self.m_components[0]

        def surface(self, si, active=True):
            return brdf.Surface(
                base=mi.Color3f(self.base_color.eval(si, active)),
                roughness=self.roughness.eval_1(si, active),
                metallic=self.metallic.eval_1(si, active),
                f0=self.f0 * mi.Color3f(self.specular.eval(si, active)),
            )

        def eval(self, ctx, si, wo, active=True):
            n = shading_normal(si, self.normalmap, active)
            return dr.select(active, brdf.evaluate_brdf(self.surface(si, active), n, si.wi, wo), 0)

        def pdf(self, ctx, si, wo, active=True):
            n = shading_normal(si, self.normalmap, active)
            return dr.select(active, brdf.brdf_pdf(self.surface(si, active), n, si.wi, wo), 0)

        def eval_pdf(self, ctx, si, wo, active=True):
            m, n = self.surface(si, active), shading_normal(si, self.normalmap, active)
            return dr.select(active, brdf.evaluate_brdf(m, n, si.wi, wo), 0), dr.select(
                active, brdf.brdf_pdf(m, n, si.wi, wo), 0
            )

        def sample(self, ctx, si, sample1, sample2, active=True):
            m, n = self.surface(si, active), shading_normal(si, self.normalmap, active)
            bs = mi.BSDFSample3f()
            bs.wo = brdf.sample_brdf(m, n, si.wi, sample1, sample2)
            bs.pdf = dr.select(active, brdf.brdf_pdf(m, n, si.wi, bs.wo), 0)
            bs.eta = 1.0
            bs.sampled_type = mi.UInt32(+mi.BSDFFlags.GlossyReflection)
            bs.sampled_component = mi.UInt32(0)
            ok = active & (bs.pdf > 0)
            weight = brdf.evaluate_brdf(m, n, si.wi, bs.wo) / dr.select(ok, bs.pdf, 1)
            return bs, dr.select(ok, weight, 0)

        def traverse(self, cb):
            for name in ("base_color", "roughness", "metallic", "specular"):
                cb.put(name, getattr(self, name), mi.ParamFlags.Differentiable)

        def to_string(self):
            return f"{PLUGIN}[]"

    mi.register_bsdf(PLUGIN, lambda props: MetallicRoughness(props))

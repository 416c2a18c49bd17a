"""The metallic-roughness BRDF, as glTF 2.0 and the SfD and SAMURAI papers use it, for Dr.Jit
arrays.

f = (1 - metallic) * ((1 - F_d) * base / pi + F_d-weighted GGX) + metallic * GGX with F0 = base,
written as one GGX lobe with F0 = lerp(f0, base, metallic) and a Lambertian base under it. Departs
from a plain glTF reference in two ways, both
measured: the lobe is compensated for multiple scattering (Turquin 2019: a white furnace gives .99
on rough metal instead of .5), and the viewer's cosine is clamped instead of returning black where
an interpolated normal looks away from the viewer.

Directions point away from the surface: `v` to the viewer, `l` to the light, `n` the shading normal.
All unit.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

MIN_ALPHA = 0.0064  # roughness .08: below it a lobe is narrower than any light map that Relit fits
MIN_COS = 0.02  # clamp of the viewer's cosine
TABLE = 32


@dataclass
class Surface:
    """Material at shading points. base: Color3f in [0, 1], roughness and metallic: Float in [0, 1],
    f0: dielectric reflectance at normal incidence (Float, .04 for ior 1.5)."""

    base: Any
    roughness: Any
    metallic: Any
    f0: Any = 0.04

    @property
    def alpha(self):
        return dr.maximum(dr.square(self.roughness), MIN_ALPHA)

    @property
    def specular_f0(self):
        """SfD Sec. 3.2: F = (1 - m) F0 + m a, per channel."""
        return dr.lerp(mi.Color3f(self.f0), self.base, self.metallic)


def ggx_d(n_dot_h, alpha):
    """GGX normal distribution D(h)."""
    a2 = dr.square(alpha)
    return a2 / (dr.pi * dr.square(dr.fma(dr.square(n_dot_h), a2 - 1, 1)))


def smith_v(n_dot_l, n_dot_v, alpha):
    """Height-correlated Smith visibility G2 / (4 n.l n.v)."""
    a2 = dr.square(alpha)
    gv = n_dot_l * dr.sqrt(dr.fma(dr.square(n_dot_v), 1 - a2, a2))
    gl = n_dot_v * dr.sqrt(dr.fma(dr.square(n_dot_l), 1 - a2, a2))
    return 0.5 / dr.maximum(gv + gl, 1e-7)


def schlick(f0, v_dot_h):
    """Schlick's Fresnel term."""
    c = dr.maximum(1 - v_dot_h, 0)
    c2 = c * c
    return f0 + (1 - f0) * (c2 * c2 * c)


@lru_cache(maxsize=1)
def albedo_table() -> np.ndarray:
    """Directional albedo E(n.v, roughness) of the lobe with F = 1, (TABLE, TABLE) float32, rows
    roughness from 0 to 1, columns n.v at the centres of equal cells; VNDF-sampled: E = mean of G2 /
    G1(v) over 64 x 64 stratified samples."""
    c = (np.arange(TABLE) + 0.5) / TABLE
    u = (np.arange(64) + 0.5) / 64
    u1, u2 = (x.ravel()[None] for x in np.meshgrid(u, u))
    out = np.zeros((TABLE, TABLE))
    mu = c[:, None]
    v = np.stack([np.sqrt(1 - mu**2), 0 * mu, mu], -1)  # [TABLE, 1, 3]
    for row, rough in enumerate(np.linspace(0, 1, TABLE)):
        a = max(rough**2, MIN_ALPHA)
        vh = v * [a, a, 1]
        vh /= np.linalg.norm(vh, axis=-1, keepdims=True)
        phi, z = (
            2 * np.pi * u1,
            (1 - u2) * (1 + vh[..., 2]) - vh[..., 2],
        )  # Dupuy & Benyoub 2023: spherical caps
        s = np.sqrt(np.clip(1 - z**2, 0, 1))
        h = np.stack([s * np.cos(phi), s * np.sin(phi), z], -1) + vh
        h = h * [a, a, 1]
        h /= np.linalg.norm(h, axis=-1, keepdims=True)
        l = 2 * (v * h).sum(-1, keepdims=True) * h - v
        nl = np.maximum(l[..., 2], 0)
        lam = lambda x, a=a: 0.5 * (np.sqrt(1 + a**2 * (1 / np.maximum(x, 1e-6) ** 2 - 1)) - 1)  # noqa: E731
        out[row] = np.where(nl > 0, (1 + lam(mu)) / (1 + lam(mu) + lam(nl)), 0).mean(1)
    return out.astype(np.float32)


def lobe_albedo(n_dot_v, roughness):
    """Bilinear look-up of `albedo_table`; differentiable in both arguments."""
    table = mi.Float(albedo_table().ravel())
    x, y = dr.clip(n_dot_v * TABLE - 0.5, 0, TABLE - 1), dr.clip(roughness, 0, 1) * (TABLE - 1)
    x0, y0 = (
        dr.minimum(mi.UInt32(dr.detach(x)), TABLE - 2),
        dr.minimum(mi.UInt32(dr.detach(y)), TABLE - 2),
    )
    fx, fy = x - mi.Float(x0), y - mi.Float(y0)
    i = y0 * TABLE + x0
    g = lambda k: dr.gather(mi.Float, table, i + k)  # noqa: E731
    return dr.lerp(dr.lerp(g(0), g(1), fx), dr.lerp(g(TABLE), g(TABLE + 1), fx), fy)


def evaluate_brdf(m: Surface, n, v, l):
    """BRDF times the light's cosine, f(v, l) max(n.l, 0): Color3f. Differentiable in m, n, v, l."""
    n_dot_l, n_dot_v = dr.maximum(dr.dot(n, l), 0), dr.maximum(dr.dot(n, v), MIN_COS)
    h = dr.normalize(v + l)
    n_dot_h, v_dot_h = dr.clip(dr.dot(n, h), 0, 1), dr.clip(dr.dot(v, h), 0, 1)
    alpha, f0 = m.alpha, m.specular_f0
    fresnel = schlick(f0, v_dot_h)
    energy = lobe_albedo(n_dot_v, m.roughness)
    compensation = 1 + f0 * (1 / dr.maximum(energy, 0.05) - 1)  # Turquin 2019, Eq. 15
    specular = fresnel * compensation * (ggx_d(n_dot_h, alpha) * smith_v(n_dot_l, n_dot_v, alpha))
    diffuse = m.base * ((1 - m.metallic) * (1 - schlick(m.f0, v_dot_h)) * dr.inv_pi)
    return mi.Color3f((diffuse + specular) * n_dot_l)


def specular_share(m: Surface, n, v):
    """Probability of sampling the GGX lobe, detached, in [.15, .95]."""
    with dr.suspend_grad():
        n_dot_v = dr.maximum(dr.dot(n, v), MIN_COS)
        s = mi.luminance(mi.Color3f(schlick(m.specular_f0, n_dot_v)))
        d = mi.luminance(mi.Color3f(m.base)) * (1 - m.metallic)
        return mi.Float(dr.clip(s / dr.maximum(s + d, 1e-4), 0.15, 0.95))


def _seen(n, v):
    """`v` in the frame of `n`, lifted to MIN_COS where an interpolated normal looks away from the
    viewer."""
    wo = mi.Frame3f(n).to_local(v)
    wo.z = dr.maximum(wo.z, MIN_COS)
    return dr.normalize(wo)


def sample_brdf(m: Surface, n, v, u_lobe, u2):
    """Direction l drawn from `brdf_pdf`; u_lobe: Float, u2: Point2f, uniform in [0, 1). May fall below
    the horizon (pdf 0)."""
    with dr.suspend_grad():
        frame = mi.Frame3f(n)
        wo = _seen(n, v)
        a = m.alpha
        vh = dr.normalize(mi.Vector3f(wo.x * a, wo.y * a, wo.z))
        z = dr.fma(1 - u2.y, 1 + vh.z, -vh.z)
        s, (sin_phi, cos_phi) = dr.safe_sqrt(1 - z * z), dr.sincos(dr.two_pi * u2.x)
        hh = mi.Vector3f(s * cos_phi, s * sin_phi, z) + vh
        h = dr.normalize(mi.Vector3f(hh.x * a, hh.y * a, dr.maximum(hh.z, 1e-6)))
        l_spec = 2 * dr.dot(wo, h) * h - wo
        l_diff = mi.warp.square_to_cosine_hemisphere(u2)
        return frame.to_world(dr.select(u_lobe < specular_share(m, n, v), l_spec, l_diff))


def brdf_pdf(m: Surface, n, v, l):
    """Density of `sample_brdf` in solid angle (Float, detached)."""
    with dr.suspend_grad():
        wo = _seen(n, v)
        n_dot_l, n_dot_v = dr.dot(n, l), wo.z
        h = dr.normalize(mi.Frame3f(n).to_world(wo) + l)
        a = m.alpha
        a2 = dr.square(a)
        g1_over_4nv = 0.5 / (
            n_dot_v + dr.sqrt(dr.fma(dr.square(n_dot_v), 1 - a2, a2))
        )  # G1(v) / (4 n.v) * 1 / (v.h) * (v.h)
        p_spec = ggx_d(dr.clip(dr.dot(n, h), 0, 1), a) * g1_over_4nv
        w = specular_share(m, n, v)
        return dr.select(n_dot_l > 0, w * p_spec + (1 - w) * n_dot_l * dr.inv_pi, 0)

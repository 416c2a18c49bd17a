"""The rough plastic of PIR: a GGX dielectric coat over a diffuse base, as Mitsuba's `roughplastic`
(nonlinear = False) computes it.

    f cos θ_l = k_s F D G / (4 cos θ_v)  +  k_d / (1 - R_int) / π  T(θ_v) T(θ_l) / η²  cos θ_l

with the true dielectric Fresnel term F, Smith's separable G (Walter et al. 2007), and k_s, k_d the
specular and the diffuse albedo. T(θ) = the share of light that enters the coat from outside, R_int
= the mean share that it throws back from inside: both depend on alpha, are integrated here
(`transmittance_tables`) and interpolated, so that roughness receives its gradient through them.
PIR's released code divides the specular part by the light's cosine and multiplies the diffuse one
by the viewer's; here they stand in their right places.

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

IOR = 1.49  # polypropylene, PIR Sec. 3.2
MIN_ALPHA = 0.02
MIN_COS = 0.02  # clamp of the viewer's cosine at the rims of a mesh
# of the directions that are drawn from the lobe: what inter-reflection is about (PIR Sec. 3.4) is
# in it
LOBE_SHARE = 0.5
COSINES, WIDTHS = (
    64,
    33,
)  # of the tables: cos θ evenly from 0 to 1, sqrt(alpha) evenly from sqrt(MIN_ALPHA) to 1


@dataclass
class Plastic:
    """Material at shading points. diffuse: Color3f, specular: Float (a grey factor on the coat),
    alpha: Float, width of the GGX lobe."""

    diffuse: Any
    specular: Any
    alpha: Any


def fresnel(cos, ior: float = IOR):
    """Reflectance of an interface between air and a dielectric, unpolarised, for light from the
    air; cos >= 0 (Float)."""
    t = dr.sqrt(1 - (1 - dr.square(cos)) / ior**2)
    s, p = (cos - ior * t) / (cos + ior * t), (ior * cos - t) / (ior * cos + t)
    return 0.5 * (dr.square(s) + dr.square(p))


def _fresnel_numpy(cos: np.ndarray, eta: float) -> np.ndarray:
    """As `fresnel`; eta < 1 for light from inside, 1 where it is totally reflected."""
    t2 = 1 - (1 - cos**2) / eta**2
    t = np.sqrt(np.maximum(t2, 0))
    s, p = (cos - eta * t) / (cos + eta * t), (eta * cos - t) / (eta * cos + t)
    return np.where(t2 <= 0, 1.0, 0.5 * (s**2 + p**2))


def crossing(mu: np.ndarray, alpha: float, eta: float, nodes: int, through: bool) -> np.ndarray:
    """Share of light (N,) that the GGX interface reflects, or lets through, from directions with
    cosines mu (N,).

    Gauss-Legendre over the square that visible normals are drawn from: the mean of F G1(l) or (1 -
    F) G1(t). What bounces twice is lost.

    eta: index of the far side over that of the near side.
    """
    x, w = np.polynomial.legendre.leggauss(nodes)
    u1, u2 = (a.ravel() for a in np.meshgrid(0.5 + 0.5 * x, 0.5 + 0.5 * x))
    weight = np.outer(w, w).ravel() / 4
    v = np.stack([np.sqrt(1 - mu**2), 0 * mu, mu], -1)[:, None]  # (N, 1, 3)
    vh = v * [alpha, alpha, 1]
    vh /= np.linalg.norm(vh, axis=-1, keepdims=True)
    phi, z = (
        np.pi * u1,
        (1 - u2) * (1 + vh[..., 2]) - vh[..., 2],
    )  # half the azimuths: the other half mirrors them
    s = np.sqrt(np.clip(1 - z**2, 0, 1))
    h = (np.stack([s * np.cos(phi), s * np.sin(phi), z], -1) + vh) * [alpha, alpha, 1]
    h /= np.linalg.norm(h, axis=-1, keepdims=True)
    vdoth = np.clip((v * h).sum(-1), 0, 1)
    share = _fresnel_numpy(vdoth, eta)
    if through:
        cos_t = np.sqrt(np.maximum(1 - (1 - vdoth**2) / eta**2, 0))
        leaves = (cos_t - vdoth / eta) * h[..., 2] + v[
            ..., 2
        ] / eta  # -t·n of Snell's direction t = (v·h / eta - cos_t) h - v / eta
        share = 1 - share
    else:
        leaves = 2 * vdoth * h[..., 2] - v[..., 2]
    tan2 = (1 - np.minimum(leaves, 1) ** 2) / np.maximum(leaves, 1e-9) ** 2
    g1 = 2 / (1 + np.sqrt(1 + alpha**2 * tan2))
    return (np.where(leaves > 0, g1 * share, 0) * weight).sum(-1)


@lru_cache(maxsize=4)
def transmittance_tables(ior: float = IOR) -> tuple[np.ndarray, np.ndarray]:
    """T (WIDTHS, COSINES) float32 and R_int (WIDTHS,) float32: see the module's text.

    R_int is the plain mean over the table's cosines, end points at full weight, as Mitsuba takes
    it: 1.6 % below the integral.
    """
    mu = np.maximum(np.arange(COSINES) / (COSINES - 1), 1e-6)
    t, r = np.zeros((WIDTHS, COSINES), np.float32), np.zeros(WIDTHS, np.float32)
    for i, root in enumerate(np.linspace(np.sqrt(MIN_ALPHA), 1, WIDTHS)):
        t[i] = crossing(mu, root**2, ior, 32, through=True)
        r[i] = 2 * (crossing(mu, root**2, 1 / ior, 64, through=False) * mu).mean()
    return t, r


class Coat:
    """The tables of one index of refraction on the device. A plain class: Dr.Jit would carry the
    fields of a dataclass through its loops as variables."""

    def __init__(self, ior: float = IOR):
        t, r = transmittance_tables(float(ior))
        self.ior = float(ior)
        self.transmittances, self.internals = mi.Float(t.ravel()), mi.Float(r)
        dr.eval(self.transmittances, self.internals)

    def _row(self, alpha):
        low = float(np.sqrt(MIN_ALPHA))
        y = dr.clip((dr.sqrt(alpha) - low) * ((WIDTHS - 1) / (1 - low)), 0, WIDTHS - 1)
        row = dr.minimum(mi.UInt32(dr.detach(y)), WIDTHS - 2)
        return row, y - mi.Float(row)

    def transmittance(self, cos, alpha):
        """T(θ, alpha), bilinear; differentiable in both."""
        row, fy = self._row(alpha)
        x = dr.clip(cos, 0, 1) * (COSINES - 1)
        column = dr.minimum(mi.UInt32(dr.detach(x)), COSINES - 2)
        fx, i = x - mi.Float(column), row * COSINES + column
        g = lambda k: dr.gather(mi.Float, self.transmittances, i + k)  # noqa: E731
        return dr.lerp(dr.lerp(g(0), g(1), fx), dr.lerp(g(COSINES), g(COSINES + 1), fx), fy)

    def mean_transmittance(self, alpha: float) -> float:
        """Share of diffuse light from outside that enters: 2 ∫ T(θ) cos θ d(cos θ)."""
        mu = mi.Float(((np.arange(COSINES) + 0.5) / COSINES).astype(np.float32))
        return float(2 * dr.mean(self.transmittance(mu, mi.Float(alpha)) * mu)[0])

    def internal(self, alpha):
        """R_int(alpha), linear; differentiable."""
        row, fy = self._row(alpha)
        return dr.lerp(
            dr.gather(mi.Float, self.internals, row),
            dr.gather(mi.Float, self.internals, row + 1),
            fy,
        )


def walter_ggx_d(n_dot_h, alpha):
    """GGX: Walter et al. 2007, Eq. 33."""
    a2 = dr.square(alpha)
    return a2 / (dr.pi * dr.square(dr.fma(dr.square(n_dot_h), a2 - 1, 1)))


def smith_g1(cos, alpha):
    """Walter et al. 2007, Eq. 34; cos > 0."""
    tan2 = dr.maximum(dr.rcp(dr.square(cos)) - 1, 0)
    return 2 / (1 + dr.sqrt(1 + dr.square(alpha) * tan2))


def base_radiance(diffuse, coat: Coat, cos_v, alpha, entered):
    """Radiance of the diffuse base through the coat, Color3f. entered: Color3f or Float, irradiance
    that came through the coat.
    cos_v: Float, of the viewer's direction."""
    return (
        diffuse
        * entered
        * (
            coat.transmittance(cos_v, alpha)
            / (1 - coat.internal(alpha))
            * (dr.inv_pi / coat.ior**2)
        )
    )


def evaluate_plastic(m: Plastic, coat: Coat, n, v, l):
    """BRDF times the light's cosine, f(v, l) max(n.l, 0): Color3f. Differentiable in m, n, v, l."""
    n_dot_l, n_dot_v = dr.dot(n, l), dr.maximum(dr.dot(n, v), MIN_COS)
    lit = n_dot_l > 1e-4
    n_dot_l = dr.select(lit, n_dot_l, 1)
    alpha = dr.maximum(m.alpha, MIN_ALPHA)
    h = dr.normalize(v + l)
    n_dot_h, v_dot_h = dr.clip(dr.dot(n, h), 0, 1), dr.clip(dr.dot(v, h), 0, 1)
    lobe = (
        fresnel(v_dot_h, coat.ior)
        * walter_ggx_d(n_dot_h, alpha)
        * smith_g1(n_dot_l, alpha)
        * smith_g1(n_dot_v, alpha)
        / (4 * n_dot_v)
    )
    base = base_radiance(
        m.diffuse, coat, n_dot_v, alpha, coat.transmittance(n_dot_l, alpha) * n_dot_l
    )
    return mi.Color3f(dr.select(lit, base + m.specular * lobe, 0))


def sample_plastic(m: Plastic, n, v, u_lobe, u2):
    """Direction l drawn from `plastic_pdf`: visible normals of the lobe, or the cosine; u_lobe: Float, u2:
    Point2f. May fall below the horizon."""
    with dr.suspend_grad():
        frame = mi.Frame3f(n)
        wo = frame.to_local(v)
        wo.z = dr.maximum(wo.z, MIN_COS)
        wo = dr.normalize(wo)
        a = dr.maximum(m.alpha, MIN_ALPHA)
        vh = dr.normalize(mi.Vector3f(wo.x * a, wo.y * a, wo.z))
        z = dr.fma(1 - u2.y, 1 + vh.z, -vh.z)
        s, (sin_phi, cos_phi) = dr.safe_sqrt(1 - z * z), dr.sincos(dr.two_pi * u2.x)
        hh = mi.Vector3f(s * cos_phi, s * sin_phi, z) + vh  # Dupuy & Benyoub 2023: spherical caps
        h = dr.normalize(mi.Vector3f(hh.x * a, hh.y * a, dr.maximum(hh.z, 1e-6)))
        l_spec = 2 * dr.dot(wo, h) * h - wo
        return frame.to_world(
            dr.select(u_lobe < LOBE_SHARE, l_spec, mi.warp.square_to_cosine_hemisphere(u2))
        )


def plastic_pdf(m: Plastic, n, v, l):
    """Density of `sample_plastic` in solid angle (Float, detached)."""
    with dr.suspend_grad():
        wo = mi.Frame3f(n).to_local(v)
        wo.z = dr.maximum(wo.z, MIN_COS)
        wo = dr.normalize(wo)
        a = dr.maximum(m.alpha, MIN_ALPHA)
        h = dr.normalize(mi.Frame3f(n).to_world(wo) + l)
        lobe = walter_ggx_d(dr.clip(dr.dot(n, h), 0, 1), a) * smith_g1(wo.z, a) / (4 * wo.z)
        cos = dr.dot(n, l)
        return dr.select(cos > 0, LOBE_SHARE * lobe + (1 - LOBE_SHARE) * cos * dr.inv_pi, 0)

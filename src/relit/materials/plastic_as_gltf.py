"""A rough plastic (materials/rough_plastic.py) as the dielectric of glTF 2.0: which base colour
looks like which diffuse albedo.

The two diffuse terms, for a diffuse albedo k_d and a base colour b, with s = (1 - v·h)^5 and F0 the
coat's reflectance at normal incidence:

    plastic   k_d T(θ_v) T(θ_l) / ((1 - R_int) η²) / π
    glTF      b (1 - F) / π = b (1 - k_s F0) (1 - s) / π      Schlick's F, with KHR_materials_ior
                                                              and KHR_materials_specular

Light that enters the plastic's coat loses what is reflected on the way in and out, and the more the
rougher the coat is; glTF's base loses little. So the same number is brighter as a base colour than
as a diffuse albedo: by 1.05 where alpha is .05, by 2.4 where it is .8. b is k_d times the factor
that makes the terms agree best, by least squares over both cosine-weighted hemispheres of
directions. Both terms are linear in their colour and 1 - F splits into (1 - k_s F0) (1 - s), so the
factor depends on alpha, k_s and the index of refraction alone:

    b / k_d = ⟨T T (1 - s)⟩ / ⟨(1 - s)²⟩ / ((1 - R_int) η² (1 - k_s F0))

The coats need no factor: k_s is the colour factor of KHR_materials_specular and roughness² is
alpha, so that both reflect k_s F0 at normal incidence. Towards grazing angles the plastic reflects
k_s, glTF all light.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from relit.materials.rough_plastic import COSINES, MIN_ALPHA, WIDTHS, transmittance_tables

NODES = 24  # of the integration, for each cosine and the azimuth


@lru_cache(maxsize=4)
def factors(ior: float) -> np.ndarray:
    """(WIDTHS,) base colour over diffuse albedo where k_s = 0, for the rows of
    `transmittance_tables`."""
    transmittance, internal = transmittance_tables(float(ior))
    x, w = np.polynomial.legendre.leggauss(NODES)
    cosine, weight = np.sqrt(0.5 + 0.5 * x), 0.5 * w  # even in cos² is even by the cosine
    azimuth = np.pi * (np.arange(NODES) + 0.5) / NODES
    v, l, phi = np.meshgrid(cosine, cosine, azimuth, indexing="ij")
    v_dot_l = v * l + np.sqrt((1 - v**2) * (1 - l**2)) * np.cos(phi)
    left = 1 - (1 - np.sqrt(np.clip(0.5 + 0.5 * v_dot_l, 0, 1))) ** 5  # 1 - s
    weight = weight[:, None] * weight
    once, twice = (weight * left.mean(-1)), (weight * np.square(left).mean(-1)).sum()
    through = np.stack(
        [np.interp(cosine, np.linspace(0, 1, COSINES), row) for row in transmittance]
    )  # (WIDTHS, NODES)
    return np.einsum("av,al,vl->a", through, through, once) / twice / ((1 - internal) * ior**2)


def base_over_diffuse(alpha: np.ndarray, specular: np.ndarray, ior: float) -> np.ndarray:
    """The factor from a diffuse albedo to the base colour that looks like it. alpha: width of the
    lobe; specular: k_s; shapes broadcast."""
    f0 = ((ior - 1) / (ior + 1)) ** 2
    rows = np.linspace(np.sqrt(MIN_ALPHA), 1, WIDTHS)
    smooth = np.interp(np.sqrt(np.maximum(alpha, 0)), rows, factors(float(ior)))
    return smooth / (1 - np.minimum(np.asarray(specular) * f0, 0.9))


def base_colour(
    diffuse: np.ndarray, roughness: np.ndarray, specular: np.ndarray | None, ior: float
) -> np.ndarray:
    """(H, W, 3) float32 base colour in [0, 1] of a diffuse albedo (H, W, 3). roughness: (H, W),
    sqrt(alpha). specular: (H, W) or (H, W, 3) k_s, 1 where None. Maps of one texel stand for any
    size.

    What comes out above 1 is clipped: under glTF such places are darker than the plastic. That
    takes a k_s above 1 on a smooth coat over a nearly white base.
    """
    k_s = np.ones((1, 1), np.float32) if specular is None else np.asarray(specular, np.float32)
    k_s = k_s.mean(-1) if k_s.ndim == 3 else k_s
    if diffuse.shape[:2] == (1, 1):  # one colour under a coat that varies
        diffuse = np.broadcast_to(diffuse, (*max((np.shape(roughness), k_s.shape), key=np.prod), 3))
    factor = base_over_diffuse(
        np.square(_sized(roughness, diffuse.shape)), _sized(k_s, diffuse.shape), ior
    )
    return np.clip(np.asarray(diffuse, np.float32) * factor[..., None], 0, 1).astype(np.float32)


def diffuse_albedo(
    base: np.ndarray, roughness: np.ndarray, specular: np.ndarray | None, ior: float
) -> np.ndarray:
    """The inverse of `base_colour`, clipped to [0, 1]: the diffuse albedo (H, W, 3) whose plastic
    looks like the base colour."""
    one = np.full(np.shape(base), 1e-3, np.float32)
    return np.clip(
        np.asarray(base, np.float32) / (base_colour(one, roughness, specular, ior) / 1e-3), 0, 1
    ).astype(np.float32)


def _sized(plane: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """(H, W) of a map of any size."""
    plane = np.asarray(plane, np.float32)
    if plane.shape in (tuple(shape[:2]), (1, 1)):
        return plane
    return cv2.resize(plane, (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR)

"""Slow NumPy twin of `relit.materials.brdf`, written from the papers' formulas in their textbook
form."""

import numpy as np

MIN_ALPHA, MIN_COS = 0.0064, 0.02


def fresnel(f0, cos):
    """Schlick 1994."""
    return f0 + (1 - f0) * (1 - cos) ** 5


def distribution(n_dot_h, alpha):
    """GGX: Walter et al. 2007, Eq. 33, with tan written out."""
    tan2 = 1 / n_dot_h**2 - 1
    return alpha**2 / (np.pi * n_dot_h**4 * (alpha**2 + tan2) ** 2)


def smith_lambda(cos, alpha):
    return (np.sqrt(1 + alpha**2 * (1 / cos**2 - 1)) - 1) / 2


def masking_shadowing(n_dot_l, n_dot_v, alpha):
    """Height-correlated Smith G2: Heitz 2014, Eq. 99."""
    return 1 / (1 + smith_lambda(n_dot_v, alpha) + smith_lambda(n_dot_l, alpha))


def single_scattering(n, v, l, alpha, f0):
    """D F G2 / (4 n.l n.v), without the energy compensation; (..., 3) for f0 (..., 3)."""
    h = (v + l) / np.linalg.norm(v + l, axis=-1, keepdims=True)
    nl, nv = (n * l).sum(-1), np.maximum((n * v).sum(-1), MIN_COS)
    d = distribution(np.clip((n * h).sum(-1), 1e-4, 1), alpha)
    return (
        fresnel(f0, (v * h).sum(-1)[..., None])
        * (d * masking_shadowing(nl, nv, alpha) / (4 * nl * nv))[..., None]
    )


def evaluate(base, roughness, metallic, f0, n, v, l, energy):
    """f(v, l) max(n.l, 0), (N, 3); energy: function (n.v, roughness) -> directional albedo of the
    lobe with F = 1."""
    alpha = np.maximum(roughness**2, MIN_ALPHA)
    nl, nv = (n * l).sum(-1), np.maximum((n * v).sum(-1), MIN_COS)
    h = (v + l) / np.linalg.norm(v + l, axis=-1, keepdims=True)
    tint = (1 - metallic)[:, None] * f0 + metallic[:, None] * base
    compensation = 1 + tint * (1 / energy(nv, roughness) - 1)[:, None]
    diffuse = base * ((1 - metallic) * (1 - fresnel(f0, (v * h).sum(-1))) / np.pi)[:, None]
    up = nl > 0
    safe = np.where(up[:, None], l, n)
    return np.where(
        up[:, None],
        (diffuse + compensation * single_scattering(n, v, safe, alpha, tint)) * nl[:, None],
        0,
    )

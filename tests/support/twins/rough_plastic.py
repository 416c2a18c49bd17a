"""Slow NumPy twin of `relit.materials.rough_plastic`: the formulas of Walter et al. 2007 in
textbook form, integrals by brute force."""

import numpy as np


def fresnel(cos, eta):
    """By Snell's law and the two polarisations; eta = index of the far side over that of the near
    side."""
    sin_t = np.sqrt(np.maximum(1 - cos**2, 0)) / eta
    cos_t = np.sqrt(np.maximum(1 - sin_t**2, 0))
    s = ((cos - eta * cos_t) / (cos + eta * cos_t)) ** 2
    p = ((eta * cos - cos_t) / (eta * cos + cos_t)) ** 2
    return np.where(sin_t >= 1, 1, (s + p) / 2)


def distribution(cos, alpha):
    tan2 = 1 / cos**2 - 1
    return alpha**2 / (np.pi * cos**4 * (alpha**2 + tan2) ** 2)


def g1(cos, alpha):
    return 2 / (1 + np.sqrt(1 + alpha**2 * (1 / cos**2 - 1)))


def reflection(v, l, alpha, eta):
    """f cos θ_l of the interface for directions (..., 3) around n = z."""
    h = v + l
    h = h / np.linalg.norm(h, axis=-1, keepdims=True)
    f = fresnel((v * h).sum(-1), eta)
    return (
        f
        * distribution(h[..., 2], alpha)
        * g1(v[..., 2], alpha)
        * g1(l[..., 2], alpha)
        / (4 * v[..., 2])
    )


def albedo(mu, alpha, eta, steps=300):
    """∫ f cos θ_l dl for cosines mu (N,), by the midpoint rule over the hemisphere."""
    z, phi = np.meshgrid(
        (np.arange(steps) + 0.5) / steps, (np.arange(steps) + 0.5) / steps * 2 * np.pi
    )
    r = np.sqrt(1 - z**2)
    l = np.stack([r * np.cos(phi), r * np.sin(phi), z], -1)
    return np.array(
        [
            reflection(np.array([np.sqrt(1 - m**2), 0, m]), l, alpha, eta).mean() * 2 * np.pi
            for m in mu
        ]
    )


def entering(mu, alpha, eta, steps=300):
    """Share of light that crosses the interface, by the midpoint rule over facets h: Walter et al.
    2007, Eq. 21 integrated over t. (N,)"""
    z, phi = np.meshgrid(
        (np.arange(steps) + 0.5) / steps, (np.arange(steps) + 0.5) / steps * 2 * np.pi
    )
    r = np.sqrt(1 - z**2)
    h = np.stack([r * np.cos(phi), r * np.sin(phi), z], -1)
    out = []
    for m in mu:
        v = np.array([np.sqrt(1 - m**2), 0, m])
        c = (h * v).sum(-1)
        ct = np.sqrt(np.maximum(1 - (1 - c**2) / eta**2, 0))
        t = (c / eta - ct)[..., None] * h - v / eta
        seen = (c > 0) & (t[..., 2] < 0)
        weight = (
            g1(m, alpha) * np.maximum(c, 0) * distribution(z, alpha) / m
        )  # density of visible facets
        crossing = (
            weight * (1 - fresnel(np.maximum(c, 0), eta)) * g1(np.maximum(-t[..., 2], 1e-6), alpha)
        )
        out.append(np.where(seen, crossing, 0).mean() * 2 * np.pi)
    return np.array(out)


def plastic(kd, ks, alpha, ior, v, l):
    """f cos θ_l (N, 3) for directions (N, 3)."""
    grid = np.linspace(0.02, 0.999, 40)
    outside = entering(grid, alpha, ior)
    nodes = np.arange(1, 64) / 63
    r_int = (
        2 * (albedo(np.minimum(nodes, 0.9999), alpha, 1 / ior, 200) * nodes).sum() / 64
    )  # as Mitsuba averages
    through = np.interp(v[:, 2], grid, outside) * np.interp(l[:, 2], grid, outside)
    base = through / (1 - r_int) / ior**2 * l[:, 2] / np.pi
    return np.array(kd) * base[:, None] + ks * reflection(v, l, alpha, ior)[:, None]

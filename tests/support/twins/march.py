"""The slow NumPy twin of rendering/march.py: the same quadrature, one ray after another, no
adjoint."""

import numpy as np

MAX_STEPS, MIN_ALPHA, MIN_TRANSMITTANCE, ACCELERATE = 600, 1e-3, 1e-3, 5.0


def cell_of(p, n):
    """Low corner (x, y, z) and position in the cell; outside the cube the border cell is continued
    linearly."""
    q = p * (0.5 * (n - 1)) + 0.5 * (n - 1)
    low = np.clip(np.floor(q).astype(int), 0, n - 2)
    return low, q - low


def corner_weights(low, f):
    for corner in np.ndindex(2, 2, 2):  # (z, y, x)
        c = np.array(corner)[::-1]
        yield tuple((low + c)[::-1]), np.where(c, f, 1 - f)


def distance(values, p):
    """Trilinear look-up of (n, n, n) [z, y, x] at p (3,) and its gradient."""
    n = values.shape[0]
    low, f = cell_of(p, n)
    s, gradient = 0.0, np.zeros(3)
    for node, w in corner_weights(low, f):
        s += values[node] * w.prod()
        side = np.where(np.array(node)[::-1] > low, 1.0, -1.0)
        for k in range(3):
            gradient[k] += values[node] * side[k] * np.delete(w, k).prod() * 0.5 * (n - 1)
    return s, gradient


def feature(features, p):
    """Trilinear look-up of (n, n, n, C); nodes outside the band must hold row 0's value."""
    low, f = cell_of(p, features.shape[0])
    return sum(features[node] * w.prod() for node, w in corner_weights(low, f))


def phi(x):
    return 1 / (1 + np.exp(-np.clip(x, -80, 80)))


def march_one(values, features, o, d, t0, t1, inv_s, dt):
    """NeuS Eq. (13) along one ray: (Σ w f (C,), Σ w ∇s (3,), Σ w t, T)."""
    F, N, D, T = np.zeros(features.shape[-1]), np.zeros(3), 0.0, 1.0
    t, steps = float(t0), 0
    s0, _ = distance(values, o + d * t)
    while t < t1 and T > MIN_TRANSMITTANCE and steps < MAX_STEPS:
        step = max(dt, s0 - ACCELERATE / inv_s)
        s1, normal = distance(values, o + d * (t + step))
        a0, a1 = phi(s0 * inv_s), phi(s1 * inv_s)
        alpha = np.clip((a0 - a1) / (a0 + 1e-5), 0, 1)
        if alpha > MIN_ALPHA:
            F += T * alpha * feature(features, o + d * (t + step))
            N += T * alpha * normal
            D += T * alpha * (t + 0.5 * step)
        T, t, s0, steps = T * (1 - alpha), t + step, s1, steps + 1
    return F, N, D, T


def march(values, features, o, d, t0, t1, inv_s, dt):
    """Rays (R, 3): features (R, C), normal (R, 3), depth (R,), transmittance (R,)."""
    rays = [march_one(values, features, *ray, inv_s, dt) for ray in zip(o, d, t0, t1, strict=False)]
    return tuple(np.array(x) for x in zip(*rays, strict=False))

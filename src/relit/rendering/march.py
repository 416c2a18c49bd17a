"""Volume rendering of a signed distance field: one custom operation with a hand-written adjoint.

NeuS (Wang et al. 2021, Eq. 13): along a ray, between two samples with signed distances s_i and
s_{i+1},

    α_i = max((Φ(s_i) - Φ(s_{i+1})) / Φ(s_i), 0),   Φ(x) = 1 / (1 + exp(-x / width)),   T_i =
    Π_{j<i} (1 - α_j),   w_i = T_i α_i

and the operation returns per ray Σ w f (features), Σ w (opacity), Σ w t (depth) and Σ w ∇s (normal,
not normalised).

The adjoint replays the march instead of storing samples. With v_i = gF·f_i + gD t_i + gN·∇s_i (f
and ∇s at the END of step i, t in its middle) the loss is Σ w_i v_i + gT T_end, so

    ∂L/∂α_i = T_i v_i - (Σ_{j>i} w_j v_j + gT T_end) / (1 - α_i),

and Σ_{j>i} w_j v_j is the known total (from the outputs of the forward pass) minus a running sum.
Gradients go to the rows of the field and to ray origins and directions. Sample positions t along a
ray are constants of the quadrature; `inv_s`, `t0`, `t1` and `dt` receive no gradient. The trilinear
∇s jumps from cell to cell: of a normal that changes because the ray moves (not because the field
does) only the change within cells reaches o and d.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from relit.geometry.sdf import SdfGrid, sums_into

MAX_STEPS = 600
MIN_ALPHA = 1e-3  # samples below it contribute nothing and are not shaded
MIN_TRANSMITTANCE = 1e-3
# in empty space a step reaches to where |s| inv_s = ACCELERATE, where Φ is within 1 % of 0 or 1
ACCELERATE = 5.0


@dataclass
class Cell:
    """One trilinear cell. base: UInt32, flat index of its low corner. f: (fx, fy, fz) in [0, 1]."""

    base: Any
    f: Any


def _cell(p, n: int) -> Cell:
    half = 0.5 * (n - 1)
    q = [dr.fma(c, half, half) for c in (p.x, p.y, p.z)]
    i = [dr.clip(mi.Int32(dr.floor(c)), 0, n - 2) for c in q]
    return Cell(
        mi.UInt32((i[2] * n + i[1]) * n + i[0]),
        [c - mi.Float(k) for c, k in zip(q, i, strict=False)],
    )


def _corners(cell: Cell, n: int):
    """The eight corners: (flat index, weight)."""
    fx, fy, fz = cell.f
    for dz in (0, 1):
        for dy in (0, 1):
            wzy = (fz if dz else 1 - fz) * (fy if dy else 1 - fy)
            for dx in (0, 1):
                yield cell.base + (dz * n + dy) * n + dx, wzy * (fx if dx else 1 - fx)


def _fetch8(values, cell: Cell, n: int):
    return [
        dr.gather(mi.Float, values, cell.base + (dz * n + dy) * n + dx)
        for dz in (0, 1)
        for dy in (0, 1)
        for dx in (0, 1)
    ]


def _trilinear(c, f):
    fx, fy, fz = f
    x = [dr.lerp(c[2 * k], c[2 * k + 1], fx) for k in range(4)]
    return dr.lerp(dr.lerp(x[0], x[1], fy), dr.lerp(x[2], x[3], fy), fz)


def _trilinear_gradient(c, f, n: int):
    """∂s/∂p of the trilinear interpolant, in unit-frame lengths."""
    fx, fy, fz = f
    k = 0.5 * (n - 1)
    dx = dr.lerp(dr.lerp(c[1] - c[0], c[3] - c[2], fy), dr.lerp(c[5] - c[4], c[7] - c[6], fy), fz)
    dy = dr.lerp(dr.lerp(c[2] - c[0], c[3] - c[1], fx), dr.lerp(c[6] - c[4], c[7] - c[5], fx), fz)
    dz = dr.lerp(dr.lerp(c[4] - c[0], c[5] - c[1], fx), dr.lerp(c[6] - c[2], c[7] - c[3], fx), fy)
    return mi.Vector3f(dx * k, dy * k, dz * k)


def _trilinear_hessian_times(c, f, g, n: int):
    """H g with H the (off-diagonal) second derivatives of the trilinear interpolant."""
    fx, fy, fz = f
    k2 = (0.5 * (n - 1)) ** 2
    xy = dr.lerp(c[3] - c[2] - c[1] + c[0], c[7] - c[6] - c[5] + c[4], fz)
    xz = dr.lerp(c[5] - c[4] - c[1] + c[0], c[7] - c[6] - c[3] + c[2], fy)
    yz = dr.lerp(c[6] - c[4] - c[2] + c[0], c[7] - c[5] - c[3] + c[1], fx)
    return mi.Vector3f(xy * g.y + xz * g.z, xy * g.x + yz * g.z, xz * g.x + yz * g.y) * k2


def _fetch_features(features, rows8, weights, packets: int):
    """Trilinear features from band rows: list of 4 * packets Floats."""
    out = []
    for k in range(packets):
        acc = mi.Vector4f(0)
        for row, w in zip(rows8, weights, strict=False):
            acc = dr.fma(dr.gather(mi.Vector4f, features, row * packets + k), w, acc)
        out += [acc.x, acc.y, acc.z, acc.w]
    return out


def _phi(x):
    return 1 / (1 + dr.exp(-x))


@dr.syntax
def _march(grid: SdfGrid, features, o, d, t0, t1, inv_s, dt):
    n, packets = grid.n, grid.channels // 4
    F = [mi.Float(0) for _ in range(grid.channels)]  # Σ w f
    N = mi.Vector3f(0)  # Σ w ∇s
    D = mi.Float(0)  # Σ w t
    T = mi.Float(1)  # transmittance
    t = mi.Float(t0)
    i = mi.UInt32(0)
    cell = _cell(o + d * t, n)
    s0 = _trilinear(_fetch8(grid.values, cell, n), cell.f)
    while (t < t1) & (T > MIN_TRANSMITTANCE) & (i < MAX_STEPS):
        step = dr.maximum(dt, s0 - ACCELERATE / inv_s)
        tn = t + step
        cell = _cell(o + d * tn, n)
        c8 = _fetch8(grid.values, cell, n)
        s1 = _trilinear(c8, cell.f)
        a0, a1 = _phi(s0 * inv_s), _phi(s1 * inv_s)
        alpha = dr.clip((a0 - a1) / (a0 + 1e-5), 0, 1)
        if alpha > MIN_ALPHA:
            rows8, weights = [], []
            for k, w in _corners(cell, n):
                rows8.append(dr.gather(mi.UInt32, grid.index, k))
                weights.append(w)
            f = _fetch_features(features, rows8, weights, packets)
            weight = T * alpha
            for k in range(len(F)):
                F[k] = dr.fma(weight, f[k], F[k])
            N = dr.fma(_trilinear_gradient(c8, cell.f, n), weight, N)
            D = dr.fma(weight, t + 0.5 * step, D)
        T = T * (1 - alpha)
        t = tn
        s0 = s1
        i = i + 1
    return F, N, D, T, i


def _scatter_point(grid, gs, cell, g, g_gradient, active):
    """Carry ∂L/∂s = g and ∂L/∂(∇s) = g_gradient at a point to the eight rows of its cell."""
    n = grid.n
    fx, fy, fz = cell.f
    k = 0.5 * (n - 1)
    for dz in (0, 1):
        wz, sz = (fz, k) if dz else (1 - fz, -k)
        for dy in (0, 1):
            wy, sy = (fy, k) if dy else (1 - fy, -k)
            for dx in (0, 1):
                wx, sx = (fx, k) if dx else (1 - fx, -k)
                value = g * (wx * wy * wz)
                value += (
                    g_gradient.x * (sx * wy * wz)
                    + g_gradient.y * (wx * sy * wz)
                    + g_gradient.z * (wx * wy * sz)
                )
                row = dr.gather(mi.UInt32, grid.index, cell.base + (dz * n + dy) * n + dx, active)
                dr.scatter_add(gs, value, row, active, mode=sums_into(grid.rows))


@dr.syntax
def _replay(grid: SdfGrid, features, o, d, t0, t1, inv_s, dt, total, T_end, gF, gN, gD, gT, gs, gf):
    n, packets = grid.n, grid.channels // 4
    remainder = mi.Float(total)  # Σ_{j>i} w_j v_j once sample i is taken off
    T = mi.Float(1)
    t = mi.Float(t0)
    i = mi.UInt32(0)
    go, gd = mi.Vector3f(0), mi.Vector3f(0)
    cell = _cell(o + d * t, n)
    c8 = _fetch8(grid.values, cell, n)
    s0 = _trilinear(c8, cell.f)
    n0 = _trilinear_gradient(c8, cell.f, n)
    pending, pendingN = (
        mi.Float(0),
        mi.Vector3f(0),
    )  # ∂L/∂s_0 and ∂L/∂∇s_0 left by the step before: one scatter per point
    # One turn more than the march where a point still waits for its scatter: a scatter after the
    # loop would run the loop twice.
    while ((t < t1) & (T > MIN_TRANSMITTANCE) & (i < MAX_STEPS)) | (pending != 0):
        alive = (t < t1) & (T > MIN_TRANSMITTANCE) & (i < MAX_STEPS)
        step = dr.maximum(dt, s0 - ACCELERATE / inv_s)
        tn = t + step
        end = _cell(o + d * tn, n)
        c8 = _fetch8(grid.values, end, n)
        s1 = _trilinear(c8, end.f)
        n1 = _trilinear_gradient(c8, end.f, n)
        a0, a1 = _phi(s0 * inv_s), _phi(s1 * inv_s)
        alpha = dr.clip((a0 - a1) / (a0 + 1e-5), 0, 1)
        g0, g1, gN1 = mi.Float(pending), mi.Float(0), mi.Vector3f(0)
        shaded = alive & (alpha > MIN_ALPHA)
        if shaded | (pending != 0):
            rows8, weights = [], []
            for k, w in _corners(end, n):
                rows8.append(dr.gather(mi.UInt32, grid.index, k))
                weights.append(w)
            f = _fetch_features(features, rows8, weights, packets)
            v = gD * (t + 0.5 * step) + dr.dot(gN, n1)
            for k in range(len(f)):
                v = dr.fma(gF[k], f[k], v)
            w = dr.select(shaded, T * alpha, 0)
            remainder -= w * v
            rest = dr.maximum(1 - alpha, 1e-3)
            galpha = T * v - (remainder + gT * T_end) / rest
            galpha = dr.select(
                shaded & (alpha < 1), galpha, 0
            )  # the clip passes no gradient outside
            ga1 = -galpha / (a0 + 1e-5)
            ga0 = galpha * (a1 + 1e-5) / dr.square(a0 + 1e-5)
            g1 = ga1 * a1 * (1 - a1) * inv_s
            g0 += ga0 * a0 * (1 - a0) * inv_s
            gN1 = gN * w
            # features and normal at the end of the step
            gp = _trilinear_hessian_times(c8, end.f, gN1, n)
            for k in range(packets):
                gfk = mi.Vector4f(
                    gF[4 * k] * w, gF[4 * k + 1] * w, gF[4 * k + 2] * w, gF[4 * k + 3] * w
                )
                for row, weight in zip(rows8, weights, strict=False):
                    dr.scatter_add(
                        gf,
                        gfk * weight,
                        row * packets + k,
                        shaded,
                        mode=sums_into(grid.rows * grid.channels),
                    )
                gp += _feature_position_gradient(features, rows8, end.f, gfk, packets, k, n)
            go += gp
            gd += gp * tn
            _scatter_point(grid, gs, cell, g0, pendingN, g0 != 0)
        go += n0 * g0
        gd += n0 * (g0 * t)
        pending, pendingN = mi.Float(g1), mi.Vector3f(gN1)
        T = T * (1 - alpha)
        t = tn
        s0 = s1
        n0 = n1
        cell.base, cell.f = end.base, end.f
        i = i + 1
    return go, gd


def _feature_position_gradient(features, rows8, f, g4, packets, k, n):
    """∂/∂p of g4 · (trilinear feature packet k)."""
    c = [dr.dot(dr.gather(mi.Vector4f, features, row * packets + k), g4) for row in rows8]
    return _trilinear_gradient(c, f, n)


class _MarchOp(dr.CustomOp):
    """Dr.Jit glue: `_march` forward, `_replay` backward."""

    def eval(self, grid, row_values, features, o, d, t0, t1, inv_s, dt):
        del row_values  # stands for grid.values, which holds the same numbers
        self.args = (
            grid,
            dr.detach(features),
            dr.detach(o),
            dr.detach(d),
            dr.detach(t0),
            dr.detach(t1),
            inv_s,
            dt,
        )
        with dr.suspend_grad():
            F, N, D, T, steps = _march(*self.args)
            dr.eval(F, N, D, T, steps)  # or the adjoint would march twice
        self.out = (F, N, D, T)
        return F, N, D, T, steps

    def backward(self):
        grid, features, o, d, t0, t1, inv_s, dt = self.args
        F, N, D, T = self.out
        gF, gN, gD, gT, _ = self.grad_out()
        with dr.suspend_grad():
            total = gD * D + dr.dot(gN, N)
            for k in range(len(F)):
                total = dr.fma(gF[k], F[k], total)
            gs = dr.zeros(mi.Float, grid.rows)
            gf = dr.zeros(mi.Float, grid.rows * grid.channels)
            dr.eval(total, gF, gN, gD, gT, T)
            go, gd = _replay(
                grid, features, o, d, t0, t1, inv_s, dt, total, T, gF, gN, gD, gT, gs, gf
            )
        self.set_grad_in("row_values", gs)
        self.set_grad_in("features", gf)
        self.set_grad_in("o", go)
        self.set_grad_in("d", gd)

    def forward(self):
        raise NotImplementedError("the march has a backward derivative only")

    def name(self):
        return "relit.march"


@dataclass
class Marched:
    """Per ray: features (list of Floats, Σ w f), normal (Vector3f, Σ w ∇s, not normalised), depth
    (Float, Σ w t), transmittance (Float; opacity = 1 - transmittance), steps (UInt32, not
    differentiable)."""

    features: list
    normal: Any
    depth: Any
    transmittance: Any
    steps: Any

    @property
    def opacity(self):
        return 1 - self.transmittance

    @property
    def unit_normal(self):
        """Vector3f; shorter where nothing is hit."""
        return self.normal * dr.rsqrt(dr.maximum(dr.squared_norm(self.normal), 1e-8))

    def surface_point(self, o, d):
        """Where the rays meet the surface: at their mean depth."""
        return o + d * (self.depth / dr.maximum(self.opacity, 0.05))


def march(grid: SdfGrid, o, d, t0, t1, inv_s, dt) -> Marched:
    """Render `grid` along rays o + t d, t in [t0, t1] (unit frame; an empty interval gives opacity
    0).

    o: Point3f or Vector3f, d: Vector3f (unit), t0, t1: Float. inv_s: opaque Float, 1 / width of Φ.
    dt: opaque Float, the smallest step. Differentiable with respect to grid.row_values,
    grid.features, o and d.
    """
    return Marched(
        *dr.custom(
            _MarchOp, grid, grid.row_values, grid.features, mi.Vector3f(o), d, t0, t1, inv_s, dt
        )
    )


def sphere_interval(o, d, radius=1.0):
    """Entry and exit distances (Float, Float) of rays through the sphere around the origin; t1 <=
    t0 where they miss."""
    b = dr.dot(o, d)
    disc = b * b - (dr.dot(o, o) - radius * radius)
    root = dr.sqrt(dr.maximum(disc, 0))
    t0, t1 = dr.maximum(-b - root, 0), -b + root
    return dr.select(disc > 0, t0, 0), dr.select(disc > 0, t1, 0)

"""Steps along which light and base colour change against each other.

Where a surface is diffuse, light that is brighter from some side and base colour that is darker on
what faces that side look the same: steps of single texels crawl along these valleys. Here they are
walked along directly. What is not diffuse (where a reflection comes from, shadows, priors) tells
where in a valley the truth is.
"""

from __future__ import annotations

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np

from relit.conventions import environment_directions, environment_solid_angles
from relit.fit.passes.optimiser import Adam

ROWS = 16  # of the table of normals, and of the light that it is made for
REFRESH = 20  # steps after which the table follows the light


class Exchange:
    """Moves c (hats x 3) with log L += Σ_k c_k φ_k(ω) and a + s *= exp(-Σ_k c_k ψ_k(n)). φ_k are
    the bilinear hats of a lat-long map of `hats` rows, ψ_k(n) = ∫ L φ_k (n·ω)+ dω / ∫ L (n·ω)+ dω
    is what share of the irradiance of a surface with normal n they bring; s is what a surface
    reflects besides its base colour a, see `mirrored`: without it black paint under a light that is
    too dim would have to stay grey. Both φ and ψ sum to 1 over k, so the exchange of one scale per
    channel is among the moves."""

    def __init__(self, normals: np.ndarray | None, texels: int, light_rows: int, hats: int = 4):
        """normals: (S, S, 3) unit normal of each of `texels` = S² texels; None where a texel stands
        in many places and faces all sides."""
        self.count, self.light_rows = 2 * hats * hats, light_rows
        d = environment_directions(ROWS, 2 * ROWS).reshape(-1, 3)
        cosines = np.maximum(d @ d.T, 0) * environment_solid_angles(ROWS, 2 * ROWS).reshape(-1)
        if normals is None:
            cosines[:] = environment_solid_angles(ROWS, 2 * ROWS).reshape(-1)
            normals = np.tile([0.0, 1.0, 0.0], (texels, 1))
        self._cosines = mi.Float(cosines.astype(np.float32).ravel())
        self._hats = mi.Float(hat_weights(ROWS, hats).astype(np.float32).ravel())
        self._shrink = area_means(light_rows)
        n = normals.reshape(-1, 3)
        u = np.arctan2(n[:, 0], -n[:, 2]) / (2 * np.pi)
        v = np.arccos(np.clip(n[:, 1], -1, 1)) / np.pi
        column = np.floor((u - np.floor(u)) * 2 * ROWS).astype(int) % (2 * ROWS)
        self.bin = mi.UInt32(
            (np.minimum((v * ROWS).astype(int), ROWS - 1) * 2 * ROWS + column).astype(np.uint32)
        )
        self._corners = corners(light_rows, hats)
        self.adam = Adam(3 * self.count)
        self.light = self.share = None

    def refresh(self, radiance) -> None:
        """Follow the light, Float [rows * 2 rows * 3], which `light` keeps."""
        self.light = dr.detach(radiance)
        texel, weight = self._shrink
        c = dr.gather(mi.Color3f, self.light, texel)
        light = (
            dr.block_sum((c.x + c.y + c.z) * weight, dr.width(texel) // (2 * ROWS * ROWS)) / 3
            + 1e-6
        )
        dr.eval(light)
        self.share = basis_shares(self._cosines, self._hats, light, self.count)
        dr.eval(self.share)

    def step(self, colour, log_light, colour_gradient, light_gradient, rate: float, metallic=None):
        """(colour, log_light) after one step. colour: Float [S² · 4] base colour and roughness;
        log_light: Float [rows · 2 rows · 3];
        metallic: Float [S²], None: what is mirrored does not count."""
        bins, n, lanes = 2 * ROWS * ROWS, self.count, 3 * self.count
        gradient = dr.zeros(mi.Float, lanes)
        texel = dr.arange(mi.UInt32, 2 * self.light_rows**2)
        g = dr.gather(mi.Color3f, light_gradient, texel)
        for index, weight in self._corners:
            dr.scatter_add(gradient, g * weight, index)
        base, pull = dr.unravel(mi.Vector4f, colour), dr.unravel(mi.Vector4f, colour_gradient)
        besides = mi.Float(0) if metallic is None else mirrored(base.w) * (1 - metallic)
        whole = mi.Color3f(base.x, base.y, base.z) + besides
        binned = dr.zeros(mi.Float, 3 * bins)
        dr.scatter_add(
            binned, mi.Color3f(whole.x * pull.x, whole.y * pull.y, whole.z * pull.z), self.bin
        )
        i = dr.arange(mi.UInt32, lanes * bins)
        b, lane = i % bins, i // bins
        k, c = lane // 3, lane % 3
        terms = dr.gather(mi.Float, binned, b * 3 + c) * dr.gather(mi.Float, self.share, b * n + k)
        gradient -= dr.block_sum(terms, bins)
        move = self.adam.step(dr.zeros(mi.Float, lanes), gradient, rate)
        dr.eval(move)
        for index, weight in self._corners:
            g = dr.gather(mi.Color3f, move, index) * weight
            dr.scatter_add(log_light, g, texel)
        i = dr.arange(mi.UInt32, 3 * bins * n)
        k, lane = i % n, i // n
        terms = dr.gather(mi.Float, move, k * 3 + lane % 3) * dr.gather(
            mi.Float, self.share, (lane // 3) * n + k
        )
        factor = dr.gather(mi.Color3f, dr.exp(-dr.block_sum(terms, n)), self.bin)
        whole = whole * factor - besides
        return dr.ravel(mi.Vector4f(whole.x, whole.y, whole.z, base.w)), log_light


@dr.syntax
def basis_shares(cosines, hats, light, count):
    """ψ_k(n), Float [normals * count], for the light (Float, a value for each direction of the
    table). cosines: Float [normals * directions], hats: Float [directions * count]. Each lane sums
    over the directions: no larger array is made, and none leaves the device."""
    bins = 2 * ROWS * ROWS
    lane = dr.arange(mi.UInt32, bins * count)
    first, k = (lane // count) * bins, lane % count
    j, part, whole = mi.UInt32(0), mi.Float(0), mi.Float(0)
    while j < bins:
        w = dr.gather(mi.Float, cosines, first + j) * dr.gather(mi.Float, light, j)
        part += w * dr.gather(mi.Float, hats, j * count + k)
        whole += w
        j += 1
    return part / whole


def area_means(rows: int):
    """How a lat-long map of `rows` is brought to ROWS, each texel the mean over its area (OpenCV's
    INTER_AREA): (index UInt32, weight Float), as many entries for each of the ROWS * 2 ROWS
    texels."""
    along = [
        cv2.resize(np.eye(n), (n, m), interpolation=cv2.INTER_AREA)
        for n, m in ((rows, ROWS), (2 * rows, 2 * ROWS))
    ]  # (m, n) each
    used = [
        np.argsort(a == 0, axis=1, kind="stable")[:, : (a != 0).sum(1).max()] for a in along
    ]  # zeros fill up
    weights = [np.take_along_axis(a, u, 1) for a, u in zip(along, used, strict=True)]
    index = used[0][:, None, :, None] * 2 * rows + used[1][None, :, None, :]
    weight = weights[0][:, None, :, None] * weights[1][None, :, None, :]
    return mi.UInt32(index.astype(np.uint32).ravel()), mi.Float(weight.astype(np.float32).ravel())


def mirrored(roughness):
    """What a dielectric of F0 = .04 reflects besides its base colour under even light, mean over
    the hemisphere of views (Float): .085 of what is glossy to .02 of what is dull. Fitted to
    materials.brdf, within .006."""
    return 0.053 + 0.033 * dr.cos(dr.pi * roughness)


def hat_weights(rows: int, coarse: int) -> np.ndarray:
    """(2 rows², 2 coarse²) bilinear weight of each texel of a coarse map at each texel of a finer
    one; rows sum to 1."""
    out = np.zeros((2 * rows * rows, 2 * coarse * coarse))
    y, x = np.mgrid[:rows, : 2 * rows]
    x, y = (x.ravel() + 0.5) * coarse / rows - 0.5, (y.ravel() + 0.5) * coarse / rows - 0.5
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    for dy in (0, 1):
        for dx in (0, 1):
            weight = np.abs(1 - dx - (x - x0)) * np.abs(1 - dy - (y - y0))
            row, column = np.clip(y0 + dy, 0, coarse - 1), (x0 + dx) % (2 * coarse)
            np.add.at(out, (np.arange(len(x)), row * 2 * coarse + column), weight)
    return out


def corners(rows: int, coarse: int):
    """The same as four pairs (index UInt32, weight Float) for each texel."""
    w = hat_weights(rows, coarse)
    order = np.argsort(-w, axis=1)[:, :4]
    weights = np.take_along_axis(w, order, 1).astype(np.float32)
    return [
        (
            mi.UInt32(np.ascontiguousarray(order[:, j], np.uint32)),
            mi.Float(np.ascontiguousarray(weights[:, j])),
        )
        for j in range(4)
    ]

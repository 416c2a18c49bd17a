"""One environment per photo: low-dimensional, with a prior learnt from real HDRIs.

log L_v = mean + gain_v + Σ_k c_vk σ_k B_k on a small lat-long map, c ~ N(0, 1): principal
components of log environments under all turns about the vertical (tools/light_prior.py makes the
file that is read here). gain_v is the photo's exposure and white balance.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from relit.conventions import environment_solid_angles
from relit.lighting.environment import FLOOR, invert_cdf, latlong_uv, lookup_latlong

ROWS, COLUMNS = 16, 32
TEXELS = ROWS * COLUMNS


@lru_cache(maxsize=1)
def load_light_prior() -> tuple[np.ndarray, np.ndarray]:
    """(mean (TEXELS * 3,), basis (K, TEXELS * 3)), float32: row-major log RGB; components scaled by
    their standard deviations."""
    with (
        (files("relit.lighting") / "light_prior.npz").open("rb") as file,
        np.load(file, allow_pickle=False) as data,
    ):
        return data["mean"].astype(np.float32), data["basis"].astype(np.float32)


@dataclass(frozen=True)
class LightComponents:
    """The shipped family of lights. mean: (TEXELS * 3,) log radiance, basis: (K, TEXELS * 3).
    `neural_pil.NeuralPil` is another one, with the same methods."""

    mean: np.ndarray
    basis: np.ndarray

    @property
    def size(self) -> int:
        """Numbers of a photo."""
        return len(self.basis)

    def log_maps(self, numbers: np.ndarray) -> np.ndarray:
        """(V, TEXELS * 3) log radiance of the maps of numbers (V, size), before any gain."""
        return (self.mean + numbers @ self.basis).astype(np.float32)

    def pull_back(self, numbers: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        """Gradient with respect to numbers (V, size) of a loss whose gradient with respect to
        `log_maps` is (V, TEXELS * 3)."""
        return gradient @ self.basis.T


def log_lights(numbers: np.ndarray, gains: np.ndarray, family=None) -> np.ndarray:
    """(V, TEXELS * 3) log radiance of numbers (V, K) and log gains (V, 3). family: of lights, by
    default the shipped one."""
    family = LightComponents(*load_light_prior()) if family is None else family
    return (family.log_maps(numbers) + np.tile(gains, (1, TEXELS))).astype(np.float32)


def mean_level(family) -> np.ndarray:
    """(3,) mean radiance of the family's middle light."""
    return (
        np.exp(family.log_maps(np.zeros((1, family.size), np.float32))).reshape(TEXELS, 3).mean(0)
    )


class PhotoLights:
    """`count` lat-long maps of ROWS x COLUMNS in one Float. radiance: Float [count * TEXELS * 3];
    assign to it at any time and call `rebuild` now and then, so that sampling follows (as for
    `Environment`)."""

    def __init__(self, radiance, count: int):
        self.count, self.radiance = count, mi.Float(radiance)
        angles = environment_solid_angles(ROWS, COLUMNS).astype(np.float32).ravel()
        self._solid_angle = mi.Float(np.tile(angles, count))
        dr.eval(self.radiance, self._solid_angle)
        self.rebuild()

    def rebuild(self) -> None:
        """Refit the sampling tables to the present texels."""
        with dr.suspend_grad():
            n = self.count * TEXELS
            i = dr.arange(mi.UInt32, n)
            base, row, column = (i // TEXELS) * TEXELS, (i % TEXELS) // COLUMNS, i % COLUMNS
            lum = mi.Float(0)
            for dy, fy in ((-1, 0.25), (0, 0.5), (1, 0.25)):  # as in `Environment`
                y = mi.UInt32(dr.clip(mi.Int32(row) + dy, 0, ROWS - 1))
                for dx, fx in ((COLUMNS - 1, 0.25), (0, 0.5), (1, 0.25)):
                    texel = dr.gather(
                        mi.Color3f, self.radiance, base + y * COLUMNS + (column + dx) % COLUMNS
                    )
                    lum += fy * fx * mi.luminance(dr.maximum(texel, 0))
            weight = lum * self._solid_angle
            dr.eval(weight)
            mean = dr.block_sum(weight, TEXELS) * dr.rcp(4 * dr.pi)
            mean = dr.repeat(dr.select(mean > 0, mean, 1), TEXELS)
            weight = dr.lerp(weight, mean * self._solid_angle, FLOOR)
            self._within_row = dr.block_prefix_reduce(
                dr.ReduceOp.Add, weight, COLUMNS, exclusive=False
            )
            dr.eval(self._within_row)
            rows = dr.gather(
                mi.Float,
                self._within_row,
                dr.arange(mi.UInt32, self.count * ROWS) * COLUMNS + (COLUMNS - 1),
            )
            dr.eval(rows)
            self._rows = dr.block_prefix_reduce(dr.ReduceOp.Add, rows, ROWS, exclusive=False)
            dr.eval(self._rows)
            total = dr.gather(mi.Float, self._rows, (i // TEXELS) * ROWS + (ROWS - 1))
            self._density = weight / (self._solid_angle * total)
            dr.eval(self._density)

    def of(self, light) -> LightOf:
        """The environments that lanes stand under. light: UInt32, one number per lane."""
        return LightOf(self, light)

    def images(self) -> np.ndarray:
        """(count, ROWS, COLUMNS, 3) float32."""
        return np.array(dr.detach(self.radiance)).reshape(self.count, ROWS, COLUMNS, 3)


class LightOf:
    """`PhotoLights` with one light chosen per lane: eval, pdf and sample as `Environment` has
    them."""

    def __init__(self, lights: PhotoLights, light: Any):
        self.lights, self.light = lights, light

    def eval(self, d, active=True):
        """Radiance (Color3f) from unit directions; differentiable in the texels."""
        return lookup_latlong(self.lights.radiance, ROWS, COLUMNS, d, active, self.light * TEXELS)

    def pdf(self, d):
        """Density of `sample` per steradian (Float, detached)."""
        with dr.suspend_grad():
            u, v = latlong_uv(d)
            x, y = (
                dr.minimum(mi.UInt32(u * COLUMNS), COLUMNS - 1),
                dr.minimum(mi.UInt32(v * ROWS), ROWS - 1),
            )
            return dr.gather(mi.Float, self.lights._density, self.light * TEXELS + y * COLUMNS + x)

    def sample(self, u2):
        """Direction (Vector3f) and density (Float) from `u2` (Point2f). Detached."""
        t = self.lights
        with dr.suspend_grad():
            first = self.light * ROWS
            total = dr.gather(mi.Float, t._rows, first + (ROWS - 1))
            row, at = invert_cdf(t._rows, first, ROWS, u2.y * total)
            start = (first + row) * COLUMNS
            span = dr.gather(mi.Float, t._within_row, start + (COLUMNS - 1))
            column, across = invert_cdf(t._within_row, start, COLUMNS, u2.x * span)
            phi = (mi.Float(column) + across) * (2 * dr.pi / COLUMNS)
            cos_theta = dr.lerp(
                dr.cos(mi.Float(row) * (dr.pi / ROWS)),
                dr.cos(mi.Float(row + 1) * (dr.pi / ROWS)),
                at,
            )
            s, (sin_phi, cos_phi) = dr.safe_sqrt(1 - cos_theta * cos_theta), dr.sincos(phi)
            return mi.Vector3f(s * sin_phi, cos_theta, -s * cos_phi), dr.gather(
                mi.Float, t._density, start + column
            )

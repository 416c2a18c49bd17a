"""A lat-long environment map in Dr.Jit: bilinear look-up with gradients, and importance sampling.

Axes as in `conventions`: the row is the polar angle from +Y, u(+Z) = .5, texel centres at (+.5,
+.5), radiance is linear.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from relit.conventions import environment_solid_angles

# part of the samples that follow the solid angle alone, so that no direction is lost while texels
# change
FLOOR = 0.02


def latlong_uv(d):
    """Position in the map, (u, v) in [0, 1), of unit directions:
    `conventions.uv_from_direction`."""
    u = dr.atan2(d.x, -d.z) * dr.inv_two_pi
    return u - dr.floor(dr.detach(u)), dr.safe_acos(d.y) * dr.inv_pi


def lookup_latlong(texels, height: int, width: int, d, active=True, first=0):
    """Bilinear look-up of a lat-long Float [height * width * 3] in unit directions d -> Color3f.
    Wraps in u, clamps in v. Differentiable in `texels` and in `d` (except at the poles, where the
    gradient in d is zero). first: texel where the map begins."""
    polar = dr.square(d.x) + dr.square(d.z) < 1e-10
    d = dr.select(polar, mi.Vector3f(0, dr.detach(d.y), -1e-6), d)
    u, v = latlong_uv(d)
    x, y = u * width - 0.5, dr.clip(v * height - 0.5, 0, height - 1)
    x0, y0 = dr.floor(dr.detach(x)), dr.minimum(dr.floor(dr.detach(y)), max(height - 2, 0))
    fx, fy = x - x0, y - y0
    left = mi.UInt32(mi.Int32(x0) + width) % width
    right, top = (left + 1) % width, mi.UInt32(y0) * width
    below = top + (width if height > 1 else 0)
    g = lambda k: dr.gather(mi.Color3f, texels, k + first, active)  # noqa: E731
    return dr.lerp(
        dr.lerp(g(top + left), g(top + right), fx),
        dr.lerp(g(below + left), g(below + right), fx),
        fy,
    )


def cells_of_texels(height: int, width: int, side: int = 1) -> np.ndarray:
    """(height * width,) uint32: texels of a lat-long map gathered into cells that are `side` texels
    high and about as wide everywhere as `side` texels are at the horizon; near the poles, where
    texels are slivers, many share one."""
    rows = -(-height // side)
    sine = np.sin((np.arange(rows) + 0.5) * np.pi / rows)
    count = np.maximum(np.round(width / side * sine), 1).astype(int)
    row = np.arange(height) // side
    cell = np.arange(width) * count[row, None] // width + (np.cumsum(count) - count)[row, None]
    return cell.ravel().astype(np.uint32)


class Environment:
    """Radiance from infinitely far away.

    radiance: mi.Float of height * width * 3 values, row-major RGB; assign new texels to it at any
    time (gradients flow through `eval` to what is assigned) and call `rebuild` now and then, so
    that sampling follows. Sampling and its density are detached and belong to the texels of the
    last `rebuild`: estimates stay unbiased in between.
    """

    def __init__(self, radiance, height: int, width: int):
        self.height, self.width = int(height), int(width)
        self.radiance = mi.Float(radiance)
        if dr.width(self.radiance) != 3 * self.height * self.width:
            raise ValueError(f"{dr.width(self.radiance)} values for a {height} x {width} RGB map")
        self._solid_angle = mi.Float(
            environment_solid_angles(self.height, self.width).astype(np.float32).ravel()
        )
        dr.eval(self.radiance, self._solid_angle)
        self.rebuild()

    @classmethod
    def from_image(cls, image) -> Environment:
        """From a lat-long picture (H, W, 3), linear."""
        image = np.ascontiguousarray(image, dtype=np.float32)
        return cls(mi.Float(image.ravel()), image.shape[0], image.shape[1])

    def image(self) -> np.ndarray:
        """(H, W, 3) float32 copy of the texels."""
        return np.array(dr.detach(self.radiance), dtype=np.float32).reshape(
            self.height, self.width, 3
        )

    def rebuild(self) -> None:
        """Refit the sampling tables to the present texels. Compiles nothing after the first
        call."""
        h, w = self.height, self.width
        with dr.suspend_grad():
            i = dr.arange(mi.UInt32, h * w)
            row, column = i // w, i % w
            lum = mi.Float(0)
            for dy, fy in (
                (-1, 0.25),
                (0, 0.5),
                (1, 0.25),
            ):  # mean of the bilinear look-up over the texel, nearly: a 3 x 3 tent
                y = mi.UInt32(dr.clip(mi.Int32(row) + dy, 0, h - 1))
                for dx, fx in ((w - 1, 0.25), (0, 0.5), (1, 0.25)):
                    texel = dr.gather(mi.Color3f, self.radiance, y * w + (column + dx) % w)
                    lum += fy * fx * mi.luminance(dr.maximum(texel, 0))
            weight = lum * self._solid_angle
            dr.eval(weight)
            mean = dr.sum(weight) * dr.rcp(4 * dr.pi)
            dr.eval(mean)
            mean = dr.select(mean > 0, mean, 1)
            weight = dr.lerp(weight, mean * self._solid_angle, FLOOR)
            self._within_row = dr.block_prefix_reduce(dr.ReduceOp.Add, weight, w, exclusive=False)
            rows = dr.gather(mi.Float, self._within_row, dr.arange(mi.UInt32, h) * w + (w - 1))
            self._rows = dr.prefix_reduce(dr.ReduceOp.Add, rows, exclusive=False)
            dr.eval(self._within_row, self._rows)
            self._density = weight / (
                self._solid_angle * dr.gather(mi.Float, self._rows, mi.UInt32(h - 1))
            )
            dr.eval(self._density)

    def eval(self, d, active=True):
        """Radiance (Color3f) from the unit direction `d`: `lookup_latlong`, equal to
        `conventions.sample_environment`."""
        return lookup_latlong(self.radiance, self.height, self.width, d, active)

    # ---------------------------------------------------------------- sampling

    def pdf(self, d):
        """Density of `sample` in solid angle at the unit direction `d` (Float, detached)."""
        with dr.suspend_grad():
            u, v = latlong_uv(d)
            x = dr.minimum(mi.UInt32(u * self.width), self.width - 1)
            y = dr.minimum(mi.UInt32(v * self.height), self.height - 1)
            return dr.gather(mi.Float, self._density, y * self.width + x)

    def sample(self, u2):
        """Direction (Vector3f) and its density per steradian (Float) from `u2`, Point2f uniform in
        [0, 1). Detached."""
        h, w = self.height, self.width
        with dr.suspend_grad():
            total = dr.gather(mi.Float, self._rows, mi.UInt32(h - 1))
            row, at = invert_cdf(self._rows, mi.UInt32(0), h, u2.y * total)
            span = dr.gather(mi.Float, self._within_row, row * w + (w - 1))
            column, across = invert_cdf(self._within_row, row * w, w, u2.x * span)
            phi = (mi.Float(column) + across) * (2 * dr.pi / w)
            cos_theta = dr.lerp(
                dr.cos(mi.Float(row) * (dr.pi / h)), dr.cos(mi.Float(row + 1) * (dr.pi / h)), at
            )
            s, (sin_phi, cos_phi) = dr.safe_sqrt(1 - cos_theta * cos_theta), dr.sincos(phi)
            d = mi.Vector3f(s * sin_phi, cos_theta, -s * cos_phi)
            return d, dr.gather(mi.Float, self._density, row * w + column)


def invert_cdf(cdf, start, n: int, x):
    """Cell (0 .. n - 1) of the running sum `cdf[start : start + n]` in which `x` falls, and the
    position within it in [0, 1)."""
    k = dr.binary_search(0, n - 1, lambda i: dr.gather(mi.Float, cdf, start + i) <= x)
    k = dr.minimum(mi.UInt32(k), n - 1)
    low = dr.select(k > 0, dr.gather(mi.Float, cdf, start + dr.maximum(k, 1) - 1), 0)
    high = dr.gather(mi.Float, cdf, start + k)
    return k, dr.clip((x - low) / dr.maximum(high - low, 1e-30), 0, 1)

"""An environment of spherical Gaussians that can be optimised: SfD's model of the light (Sec. 3.3,
Eq. (2)), beside the map of texels.

L(w) = sum_k mu_k exp(lambda_k (w . phi_k - 1)), rendered to a lat-long map that everything else
samples; gradients flow through the map to phi, log lambda and log mu.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from relit.conventions import environment_directions
from relit.lighting.spherical_gaussians import SHARPEST, SOFTEST, SphericalGaussians, fibonacci

FLOATS = 7  # of a lobe: phi, log lambda, log mu
FLOOR = 1e-5  # radiance under all lobes
# a start's lobes overlap so that neighbours fall to about this share of their peak between them
SHARE = 0.5


class GaussianLight:
    """parameters: Float [count * FLOATS]. rates: Float as wide, how fast each moves against the
    others."""

    def __init__(self, count: int, rows: int, radiance: float):
        """An even light of about `radiance` from `count` lobes; `rows` of the map that they are
        rendered to."""
        half_gap = np.sqrt(4 * np.pi / count) / 2
        sharpness = float(np.clip(-np.log(SHARE) / (1 - np.cos(half_gap)), SOFTEST, SHARPEST))
        axes = fibonacci(count)
        sums = (
            count / (2 * sharpness) * -np.expm1(-2 * sharpness)
        )  # mean over the sphere for lobes of amplitude 1
        start = np.column_stack(
            [
                axes,
                np.full(count, np.log(sharpness)),
                np.full((count, 3), np.log(max(radiance, 1e-4) / sums)),
            ]
        )
        self.count, self.rows = count, rows
        self.parameters = mi.Float(start.astype(np.float32).ravel())
        self.rates = mi.Float(np.tile(np.array([0.2, 0.2, 0.2, 0.5, 1, 1, 1], np.float32), count))
        self._directions = mi.Float(
            environment_directions(rows, 2 * rows).astype(np.float32).ravel()
        )

    def log_radiance(self):
        """Float [rows * 2 rows * 3], differentiable in `parameters`."""
        texels = 2 * self.rows * self.rows
        lane = dr.arange(mi.UInt32, texels * self.count)
        texel, k = lane // self.count, lane % self.count
        d = dr.gather(mi.Vector3f, self._directions, texel)
        p = [dr.gather(mi.Float, self.parameters, k * FLOATS + i) for i in range(FLOATS)]
        lobe = dr.exp(dr.exp(p[3]) * (dr.dot(d, dr.normalize(mi.Vector3f(p[0], p[1], p[2]))) - 1))
        sums = [dr.block_sum(lobe * dr.exp(p[4 + c]), self.count) for c in range(3)]
        return dr.ravel(mi.Color3f(*[dr.log(s + FLOOR) for s in sums]))

    def project(self) -> None:
        """Back to unit axes and sharpness that the map can hold."""
        p = np.array(self.parameters).reshape(self.count, FLOATS)
        p[:, :3] /= np.maximum(np.linalg.norm(p[:, :3], axis=1, keepdims=True), 1e-6)
        p[:, 3] = np.clip(p[:, 3], np.log(SOFTEST), np.log(SHARPEST))
        self.parameters = mi.Float(p.ravel())

    def lobes(self) -> SphericalGaussians:
        p = np.array(self.parameters, np.float64).reshape(self.count, FLOATS)
        return SphericalGaussians(p[:, :3], np.exp(p[:, 3]), np.exp(p[:, 4:]))

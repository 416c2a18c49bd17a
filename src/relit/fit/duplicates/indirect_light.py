"""What the sides of a pile that no photo shows throw onto the others.

In the surface pass a blocked direction brings the radiance of the blocker, which the photos show,
for all that they show. Of backs, undersides, crevices and the ground beneath, it was what the
volume pass made of them without shadows, and the median of the free
ground: far too bright where many objects stand close together. Here it is gathered anew, a few
times during the pass, under the light and
with the material of then: SfD Eq. (3) at every vertex that is not seen, towards its normal. The
ground is diffuse; its reflectance follows from where it is seen.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from relit.fit.shape.unseen import seen_points
from relit.lighting.environment import Environment
from relit.materials.brdf import Surface
from relit.materials.field import MaterialField, material_at
from relit.rendering.transport import Points, TraceableMesh, reflected, sample_lights
from relit.scene import Camera

AT = (0.0, 0.1, 0.25, 0.5, 0.75)  # shares of the pass at which it is gathered
BOUNCES = 2  # gatherings at a time: what is hidden lights what is hidden
DIRECTIONS = 32
CHUNK = 1 << 15  # vertices at once
ASLANT = 0.1  # cosine under which what a photo shows of a surface is not trusted


@dataclass
class HiddenLight:
    """mesh: whose radiance is kept up to date. hidden: (V,) bool. ground: (V,) bool, vertices of
    the ground."""

    mesh: TraceableMesh
    hidden: np.ndarray
    ground: np.ndarray

    def __post_init__(self):
        self._vertices = mi.Float(np.ascontiguousarray(self.mesh.mesh.vertices, np.float32).ravel())

    def before(
        self, step: int, steps: int, material: MaterialField, environment: Environment, seed: int
    ) -> None:
        """Gather it where it is due before this step of so many."""
        if step in {int(a * steps) for a in AT}:
            self.gather(material, environment, seed + step)

    def gather(self, material: MaterialField, environment: Environment, seed: int) -> None:
        """Replace the radiance of the hidden vertices by what they reflect under `environment`."""
        radiance = np.array(self.mesh.radiance).reshape(-1, 3)
        for bounce in range(BOUNCES):
            own = np.flatnonzero(self.hidden & ~self.ground)
            radiance[own] = self._reflected(own, material, environment, seed + bounce)
            floor = np.flatnonzero(self.ground)
            if len(floor):
                white = self._reflected(floor, None, environment, seed + bounce)
                seen = ~self.hidden[floor]
                share = (
                    radiance[floor[seen]].sum(0) / np.maximum(white[seen].sum(0), 1e-6)
                    if seen.any()
                    else np.full(3, 0.3)
                )
                radiance[floor[~seen]] = np.clip(share, 0.02, 0.95) * white[~seen]
            self.mesh.radiance = mi.Float(radiance.ravel())
            dr.eval(self.mesh.radiance)

    def _reflected(
        self, which: np.ndarray, material: MaterialField | None, environment: Environment, seed: int
    ) -> np.ndarray:
        """(n, 3) radiance along the normal of the vertices `which`; of a white diffuse surface
        where material is None."""
        out = [np.zeros((0, 3), np.float32)]
        rng = mi.PCG32(size=CHUNK, initstate=seed * 7919 + 29)
        one = dr.full(mi.Float, 1, CHUNK)
        for first in range(0, len(which), CHUNK):
            some = which[first : first + CHUNK]
            with dr.suspend_grad():
                points = self._points(mi.UInt32(np.resize(some, CHUNK).astype(np.uint32)))
                surface = (
                    Surface(mi.Color3f(one), one, 0 * one, 0.0)
                    if material is None
                    else material_at(material, points.uv)
                )
                lights = sample_lights(self.mesh, points, surface, environment, DIRECTIONS, rng)
                a, b = reflected(points, lights, surface, environment)
                out.append(np.array((a + b) * 0.5).T[: len(some)])
        return np.concatenate(out)

    def _points(self, index: Any) -> Points:
        """Vertices as points that are looked at along their normals."""
        x = dr.gather(mi.Point3f, self._vertices, index)
        n = dr.normalize(dr.gather(mi.Vector3f, self.mesh.normals, index))
        frame = mi.Frame3f(n)
        return Points(
            dr.full(mi.Bool, True, CHUNK),
            x,
            n,
            n,
            n,
            dr.gather(mi.Point2f, self.mesh.uvs, index),
            frame.s,
            frame.t,
        )


def hidden_from(mesh: TraceableMesh, cameras: list[Camera]) -> np.ndarray:
    """(V,) bool: vertices that none of the cameras sees, or only aslant."""
    return ~seen_points(mesh.scene, mesh.mesh.vertices, mesh.mesh.normals, cameras, ASLANT)

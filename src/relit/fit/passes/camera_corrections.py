"""Corrections of cameras that a fit moves, and the motion that all cameras have in common.

Shape and cameras, turned, moved or grown together, give the same pictures. Left free, this common
motion drifts by a little with every step, and the shape, which is bound to its grid, is dragged
behind it: from true poses ten instances of an object ended .6 degree off, and the farther the longer
the pass was. Taken out at every step the same pass stays within .3 degree.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from relit.geometry.se3 import exp_so3
from relit.scene import Camera

CAMERA_FLOATS = 16  # fx fy cx cy, then the 3x4 pose row by row


class CorrectionModel(enum.Enum):
    """What a correction of a camera is made of; the value is its count of numbers. All begin with a
    rotation vector w (3, radians) and a translation (3, unit lengths).

    ABOUT_CAMERA: exp(hat(w)) turns the camera about its own centre; then it is moved.
    ABOUT_ORIGIN: the camera turns about the origin of the unit frame, so that a wrong viewpoint is
    corrected without moving the picture; then it is moved. The seventh number is the logarithm of a
    factor on the focal lengths and on the distance from the origin together: what stands at the
    origin keeps its size in the picture, the perspective changes.
    WITH_DISTANCE: as ABOUT_ORIGIN; the eighth number is the logarithm of a factor on the distance
    alone, which among the translations, in the axes of the unit frame, would be lost beside what
    moves the picture aside.
    """

    ABOUT_CAMERA = 6
    ABOUT_ORIGIN = 7
    WITH_DISTANCE = 8


@dataclass
class CameraCorrections:
    """values: Float [views * model.value]."""

    model: CorrectionModel
    values: Any

    @property
    def numbers(self) -> np.ndarray:
        """(views, model.value) float32 on the host."""
        return np.array(self.values).reshape(-1, self.model.value)

    def entry(self, view, j: int):
        """The j-th number of `view` (UInt32)."""
        return dr.gather(mi.Float, self.values, view * self.model.value + j)

    def inverse_zoom(self, view):
        """1 over the factor on the focal lengths of `view`: 1 or Float."""
        return 1.0 if self.model is CorrectionModel.ABOUT_CAMERA else dr.exp(-self.entry(view, 6))

    def moved(self, view, o, d):
        """The rays of `view` with origins o and directions d (Vector3f, unit frame), corrected."""
        c = [self.entry(view, j) for j in range(6)]
        w = mi.Vector3f(c[0], c[1], c[2])
        theta2 = dr.squared_norm(w)

        def turn(v):
            """Rodrigues' formula by its series, right to 1e-6 for |w| below half a radian."""
            turned = dr.cross(w, v)
            return (
                v
                + (1 - theta2 / 6 * (1 - theta2 / 20)) * turned
                + (0.5 - theta2 / 24 * (1 - theta2 / 30)) * dr.cross(w, turned)
            )

        d = turn(d)
        if self.model is not CorrectionModel.ABOUT_CAMERA:
            o = turn(o) / self.inverse_zoom(view)
        if self.model is CorrectionModel.WITH_DISTANCE:
            o = o * dr.exp(self.entry(view, 7))
        return o + mi.Vector3f(c[3], c[4], c[5]), d


def no_corrections(
    views: int, model: CorrectionModel = CorrectionModel.ABOUT_CAMERA
) -> CameraCorrections:
    """Corrections of `views` cameras that change nothing."""
    # in memory, not literal zeros: the first step runs the kernels of all others
    return CameraCorrections(model, dr.opaque(mi.Float, 0.0, model.value * views))


def corrected(cameras: list[Camera], corrections: CameraCorrections) -> list[Camera]:
    """The cameras with their corrections built in."""
    out = []
    for camera, c in zip(cameras, corrections.numbers.astype(np.float64), strict=True):
        pose = np.array(camera.world_from_camera, np.float64)
        turn, zoom = exp_so3(c[:3]), 1.0
        pose[:3, :3] = turn @ pose[:3, :3]
        if corrections.model is not CorrectionModel.ABOUT_CAMERA:
            zoom = float(np.exp(c[6]))
            pose[:3, 3] = zoom * (turn @ pose[:3, 3])
        if corrections.model is CorrectionModel.WITH_DISTANCE:
            pose[:3, 3] *= np.exp(c[7])
        pose[:3, 3] += c[3:6]
        out.append(
            replace(camera, fx=camera.fx * zoom, fy=camera.fy * zoom, world_from_camera=pose)
        )
    return out


def without_common_motion(corrections: CameraCorrections, cameras) -> CameraCorrections:
    """The corrections without the small turn, growth and shift that they share. What cameras are to
    each other stays, but for terms of second order. cameras: as `PixelBank.cameras`."""
    each = corrections.model.value
    k = dr.arange(mi.UInt32, dr.width(cameras) // CAMERA_FLOATS)
    w, t = (mi.Vector3f(*[corrections.entry(k, first + j) for j in range(3)]) for first in (0, 3))
    o = mi.Vector3f(*[dr.gather(mi.Vector4f, cameras, k * 4 + j).w for j in (1, 2, 3)])
    turn = _mean(w)
    w = w - turn
    if corrections.model is CorrectionModel.ABOUT_CAMERA:  # a turn of the scene moves them as well
        t = t - dr.cross(turn, o)
    spread = o - _mean(o)
    growth = dr.mean(dr.dot(t - _mean(t), spread)) / dr.maximum(
        dr.mean(dr.squared_norm(spread)), 1e-12
    )
    t = t - growth * o
    t = t - _mean(t)
    out = mi.Float(corrections.values)
    for first, vector in ((0, w), (3, t)):
        for j in range(3):
            dr.scatter(out, vector[j], k * each + first + j)
    if corrections.model is CorrectionModel.WITH_DISTANCE:
        log_distance = corrections.entry(k, 7)
        dr.scatter(out, log_distance - dr.mean(log_distance), k * each + 7)
    return CameraCorrections(corrections.model, out)


def _mean(v):
    return mi.Vector3f(*[dr.mean(c) for c in v])

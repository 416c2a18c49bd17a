"""What a flash capture tells of each place of the surface before any fit of the material (PIR Sec.
3.5, without a network's features).

Divided by the diffuse shading of the flash, every photo gives a shading-free colour of the place:
too bright where a highlight or an inter-reflection lies, right elsewhere. Low in its distribution
over photos that look at the place from the side (a flash at the camera puts the highlight where one
looks straight down) is the diffuse albedo. Places of like colour are likely of one material; the
features hold the colour as it is displayed, and how bright the place gets at most above it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from relit.conventions import srgb_from_linear
from relit.fit.flash.dino import DinoNetwork, dino_features
from relit.fit.passes.pixels import PixelBank
from relit.lighting.flash import incident, light_position
from relit.materials.rough_plastic import Coat, base_radiance
from relit.rendering.transport import OFFSET, TraceableMesh
from relit.scene import Camera

LOW = (
    0.15,
    0.4,
    # quantiles over photos that are taken for the diffuse part: of all photos, and of those from the
    # side
)
LEAST_COSINE, SIDE = (
    0.35,
    0.82,
    # of the viewer's direction: photos below the first do not count, below the second are from the side
)
ALPHA = 0.2  # of the coat that the diffuse light passes


@dataclass(frozen=True)
class FlashLamp:
    """offset: (3,) unit frame, OpenCV camera axes. intensity: radiant. shadow: whether it throws
    any."""

    offset: np.ndarray
    intensity: float
    shadow: bool = True


@dataclass(frozen=True)
class FlashPhotos:
    """Photos under the flash, and the surface that they show. cameras: unit frame. mesh: in the unit
    frame."""

    bank: PixelBank
    cameras: list[Camera]
    mesh: TraceableMesh
    coat: Coat
    flash: FlashLamp


@dataclass(frozen=True)
class TexelEvidence:
    """albedo: (N, 3) diffuse, for the given intensity. seen: (N,) bool, enough photos. features:
    (N, 4) float32."""

    albedo: np.ndarray
    seen: np.ndarray
    features: np.ndarray


def capture_features(
    scene: FlashPhotos, x: np.ndarray, n: np.ndarray, ambient: Any = None
) -> TexelEvidence:
    """The features of N surface points x with normals n, both (N, 3), unit frame. ambient:
    fit.flash_ambient.Ambient, light from the surface itself, none where None."""
    bank = scene.bank
    values = np.full((bank.views, len(x), 3), np.nan, np.float16)
    aside = np.zeros((bank.views, len(x)), bool)
    n = n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-9)
    point, normal = (mi.Vector3f(np.ascontiguousarray(a.T, np.float32)) for a in (x, n))
    dr.eval(point, normal)
    near = None if ambient is None else ambient.near(x, n)
    with dr.suspend_grad():
        for view in range(bank.views):
            around = (
                0.0 if near is None else (ambient.light[view][near[0]] * near[1][..., None]).sum(1)
            )
            values[view], cosine = shading_free(scene, view, point, normal, around)
            aside[view] = np.isfinite(values[view, :, 0]) & (cosine < SIDE)
    seen, enough = np.isfinite(values[..., 0]).sum(0) >= 3, aside.sum(0) >= 4
    albedo = np.full((len(x), 3), 0.5, np.float32)
    for quantile, which in zip(LOW, (seen & ~enough, enough), strict=True):
        for part in np.array_split(np.flatnonzero(which), max(1, len(x) // 20_000)):
            v = values[:, part].astype(np.float32)
            if which is enough:
                v[~aside[:, part]] = np.nan
            albedo[part] = np.nanquantile(v, quantile, axis=0) if len(part) else 0
    shown = srgb_from_linear(np.clip(albedo, 0, 1.5))
    return TexelEvidence(
        albedo, seen, np.concatenate([shown, np.zeros((len(x), 1))], 1).astype(np.float32)
    )


@dataclass(frozen=True)
class Seen:
    """How one photo sees N points. ok: Bool, in the picture, and neither camera nor flash is
    hidden. column, row: Float, pixels.
    cos_v, cos_l: of the directions to the camera and to the flash, Float. inverse: 1 / distance² to
    the flash, Float."""

    ok: Any
    column: Any
    row: Any
    cos_v: Any
    cos_l: Any
    inverse: Any


def flash_views_of(scene: FlashPhotos, view: int, x, n, lit_only: bool = False) -> Seen:
    """x, n: Vector3f, unit frame. lit_only: `ok` tells of the flash alone, not of the camera."""
    bank, camera, flash = scene.bank, scene.cameras[view], scene.flash
    number = dr.opaque(mi.UInt32, view)
    eye = light_position(bank.cameras, number, mi.Vector3f(0))
    light = light_position(bank.cameras, number, mi.Vector3f(*[float(v) for v in flash.offset]))
    v, _ = incident(eye, x)
    l, inverse = incident(light, x)
    k = [dr.gather(mi.Vector4f, bank.cameras, number * 4 + j) for j in range(4)]
    d = x - eye
    r = [mi.Vector3f(k[1][c], k[2][c], k[3][c]) for c in range(3)]  # columns of world_from_camera
    z = dr.dot(r[2], d)
    column = k[0].x * dr.dot(r[0], d) / z + k[0].z
    row = k[0].y * dr.dot(r[1], d) / z + k[0].w
    cos_v, cos_l = dr.dot(n, v), dr.dot(n, l)
    ok = cos_l > 0
    if not lit_only:
        ok &= (
            (z > 0)
            & (column >= 0)
            & (row >= 0)
            & (column < camera.width)
            & (row < camera.height)
            & (cos_v > 0)
        )
    start = mi.Point3f(x + n * (2 * OFFSET))
    for end in (*(() if lit_only else (eye,)), *((light,) if flash.shadow else ())):
        to = end - mi.Vector3f(start)
        length = dr.norm(to)
        ok &= ~scene.mesh.scene.ray_test(
            mi.Ray3f(start, to / length, length, 0.0, []), coherent=False, active=ok
        )
    return Seen(ok, column, row, cos_v, cos_l, inverse)


def shading_free(scene: FlashPhotos, view: int, x, n, around=0.0):
    """The photo's value at the points over what a white diffuse base would show there, (N, 3), NaN
    where the photo does not show them; and the cosine of the viewer's direction (N,). around: (N,
    3) irradiance from the surface itself over the flash's intensity, or 0."""
    bank, camera, coat = scene.bank, scene.cameras[view], scene.coat
    seen = flash_views_of(scene, view, x, n)
    ok, cos_v, cos_l = (
        seen.ok & (seen.cos_v > LEAST_COSINE) & (seen.cos_l > LEAST_COSINE),
        seen.cos_v,
        seen.cos_l,
    )
    pixel = mi.UInt32(dr.clip(seen.row, 0, camera.height - 1)) * camera.width + mi.UInt32(
        dr.clip(seen.column, 0, camera.width - 1)
    )
    p = dr.gather(
        mi.Vector4f,
        bank.rgbm,
        pixel + dr.gather(mi.UInt32, bank.offsets, dr.opaque(mi.UInt32, view)),
        ok,
    )
    ok &= p.w > 0.99
    alpha = mi.Float(ALPHA)
    enters = mi.Color3f(coat.transmittance(cos_l, alpha) * cos_l * seen.inverse)
    if np.ndim(around):
        enters += mi.Color3f(np.ascontiguousarray(around.T, np.float32)) * coat.mean_transmittance(
            ALPHA
        )
    base = base_radiance(mi.Color3f(1), coat, cos_v, alpha, enters)
    out = mi.Color3f(p.x, p.y, p.z) / dr.maximum(base * scene.flash.intensity, 1e-6)
    out = dr.select(ok, out, dr.nan)
    return np.array(out).T, np.array(cos_v)


def network_features(
    scene: FlashPhotos, x: np.ndarray, n: np.ndarray, network: DinoNetwork
) -> np.ndarray:
    """(N, 4) float32: the network's features on the points, for `Found.features`; 0 where no photo
    shows them."""
    n = n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-9)
    point, normal = (mi.Vector3f(np.ascontiguousarray(a.T, np.float32)) for a in (x, n))
    dr.eval(point, normal)
    bank, cameras, offsets = scene.bank, scene.cameras, np.array(scene.bank.offsets)

    def photo(view: int) -> np.ndarray:
        c = cameras[view]
        pixels = dr.arange(mi.UInt32, c.width * c.height) + int(offsets[view])
        return np.array(dr.gather(mi.Vector4f, bank.rgbm, pixels)).T.reshape(c.height, c.width, 4)[
            ..., :3
        ]

    def places(view: int):
        seen = flash_views_of(scene, view, point, normal)
        return (
            np.array(seen.column),
            np.array(seen.row),
            np.array(dr.select(seen.ok, seen.cos_v, 0)),
        )

    with dr.suspend_grad():
        return dino_features(network, photo, places=places, cameras=cameras, count=len(x))[0]

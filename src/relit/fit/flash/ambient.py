"""Light that a surface throws on itself under the moving flash, before any fit of the material:
radiosity (Goral et al. 1984).

What shows an inter-reflection is brighter than the flash alone makes it, in a cup by 40 %. Taken
for albedo, it is a wrong first colour, makes unlike paints look alike, and bends shape and offset.
Here the surface is some thousand places; which places each sees is traced once (directions by the
cosine); then the light to and fro is a few products with a sparse matrix for each photo. The
places' albedos come from the photos, divided by the light that this tells, in turn. The coat counts
by its transmittances; what it mirrors is taken for diffuse. The exact term is that of the surface
pass (rendering/transport_flash.py).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from relit.fit.flash.features import ALPHA, FlashLamp, FlashPhotos, capture_features, flash_views_of
from relit.fit.passes.pixels import PixelBank
from relit.geometry.bake import fill_gutters
from relit.geometry.sdf import node_positions
from relit.materials.rough_plastic import Coat
from relit.rendering.appearance.flash_light import Around, AroundTexels
from relit.rendering.transport import OFFSET, TraceableMesh, first_hits
from relit.scene import Camera, Mesh

PLACES, DIRECTIONS, ROUNDS, BOUNCES = 3000, 128, 3, 6
# how much a normal counts beside a unit length when places are compared: a wall has two sides
TURN = 0.1
NEAREST = 4
MIRRORED = 0.5  # specular albedo that is assumed


@dataclass(frozen=True)
class Ambient:
    """tree: of the places. light: (views, places, 3), irradiance from the surface itself over the
    flash's radiant intensity."""

    tree: Any
    light: np.ndarray

    def near(
        self, x: np.ndarray, n: np.ndarray, count: int = NEAREST
    ) -> tuple[np.ndarray, np.ndarray]:
        """Indices and weights (N, count) of the places that points x with unit normals n, both (N,
        3), take their light from."""
        distance, index = self.tree.query(np.concatenate([x, TURN * n], 1), count)
        weight = 1 / (np.square(distance.reshape(len(x), -1)) + 1e-6)
        return index.reshape(len(x), -1), weight / weight.sum(1, keepdims=True)

    def on_texels(
        self, x: np.ndarray, n: np.ndarray, known: np.ndarray, coat: Coat
    ) -> AroundTexels:
        """For the surface pass. x, n: (N, 3) unit frame, points and normals of the known texels.
        known: (S, S) bool."""
        place = np.zeros(known.shape, np.int64)
        place[known] = self.near(
            x, n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-9), 1
        )[0][:, 0]
        place = mi.UInt32(fill_gutters(place, known).astype(np.uint32).ravel())
        return AroundTexels(
            mi.Float(self.light.ravel()),
            place,
            known.shape[0],
            self.light.shape[1],
            coat.mean_transmittance(ALPHA),
        )

    def around(self, values: np.ndarray, coat: Coat) -> Around:
        """For the volume pass. values: (n, n, n) signed distances, unit frame."""
        n = values.shape[0]
        band = np.abs(values) < 6 * 2 / (n - 1)
        slope = np.stack([g[band] for g in np.gradient(values)][::-1], 1)
        slope /= np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-9)
        x = node_positions(n)[band] - values[band][:, None] * slope
        place = np.zeros(values.shape, np.uint32)
        place[band] = self.near(x, slope, 1)[0][:, 0]
        light = mi.Float(self.light.ravel())
        return Around(
            light, mi.UInt32(place.ravel()), n, self.light.shape[1], coat.mean_transmittance(ALPHA)
        )


def find_ambient(
    bank: PixelBank,
    cameras: list[Camera],
    mesh: Mesh,
    coat: Coat,
    flash: FlashLamp,
    brightest: float,
) -> Ambient:
    """mesh: unit frame. brightest: the 99th percentile of the diffuse albedo that is assumed: how
    much light comes back rests on it."""
    traceable = TraceableMesh(with_any_uvs(mesh), np.zeros_like(mesh.vertices))
    x, n = spread_places(mesh, PLACES)
    tree = cKDTree(np.concatenate([x, TURN * n], 1))
    share = exchange(traceable, x, n, tree)
    enters, leaves_base = (
        coat.mean_transmittance(ALPHA),
        1 / ((1 - float(coat.internal(mi.Float(ALPHA))[0])) * coat.ior**2),
    )
    scene = FlashPhotos(bank, cameras, traceable, coat, flash)
    straight = np.zeros((bank.views, len(x)))
    entering = np.zeros_like(straight)
    point, normal = (mi.Vector3f(np.ascontiguousarray(a.T, np.float32)) for a in (x, n))
    with dr.suspend_grad():
        for view in range(bank.views):
            seen = flash_views_of(scene, view, point, normal, lit_only=True)
            falls = dr.select(seen.ok, seen.cos_l * seen.inverse, 0)
            straight[view], entering[view] = (
                np.array(falls),
                np.array(falls * coat.transmittance(seen.cos_l, mi.Float(ALPHA))),
            )
    ambient = Ambient(tree, np.zeros((bank.views, len(x), 3), np.float32))
    _, blur = tree.query(tree.data, 8)
    for _ in range(ROUNDS):
        found = capture_features(scene, x, n, ambient)
        if found.seen.sum() < 0.1 * len(x):
            return ambient
        albedo = np.where(
            found.seen[:, None], found.albedo, np.median(found.albedo[found.seen], axis=0)
        )
        albedo = np.clip(
            albedo * (brightest / max(float(np.percentile(albedo.max(1), 99)), 1e-6)), 0, 1
        )
        base = albedo.T[:, :, None] * (enters * leaves_base)  # (3, places, 1)
        mirrored = MIRRORED * (1 - enters)
        light = np.zeros((3, len(x), bank.views))
        for _ in range(BOUNCES):
            leaves = base * (entering.T + enters * light) + mirrored * (straight.T + light)
            light = np.stack([share @ channel for channel in leaves])
        smooth = light[:, blur].mean(2)
        ambient = Ambient(tree, np.ascontiguousarray(smooth.transpose(2, 1, 0), np.float32))
    return ambient


def spread_places(mesh: Mesh, count: int, seed: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """`count` points on the mesh, evenly by area, and their unit normals, (count, 3) each."""
    rng = np.random.default_rng(seed)
    corner = np.asarray(mesh.vertices, np.float64)[mesh.faces]
    area = np.linalg.norm(
        np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1
    )
    at = (np.arange(count) + rng.random(count)) * (area.sum() / count)
    face = np.minimum(np.searchsorted(np.cumsum(area), at), len(area) - 1)
    u, v = np.sqrt(rng.random(count)), rng.random(count)
    b = np.stack([1 - u, u * (1 - v), u * v], 1)[..., None]
    n = (np.asarray(mesh.normals, np.float64)[mesh.faces[face]] * b).sum(1)
    return (corner[face] * b).sum(1), n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-9)


def exchange(mesh: TraceableMesh, x: np.ndarray, n: np.ndarray, tree) -> csr_matrix:
    """(places, places): what share of the cosine-weighted directions of one place meets another."""
    count, k = len(x), DIRECTIONS
    rng = np.random.default_rng(5)
    i = np.arange(count * k)
    u = np.stack([(i % k + 0.5) / k, (i % k) * 0.6180339887498949], 1)
    u[:, 1] += np.repeat(rng.random(count), k)
    point, normal = (np.repeat(a, k, axis=0).T.astype(np.float32) for a in (x, n))
    local = mi.warp.square_to_cosine_hemisphere(
        mi.Point2f(u[:, 0].astype(np.float32), (u[:, 1] % 1).astype(np.float32))
    )
    normal = mi.Vector3f(np.ascontiguousarray(normal))
    hit = first_hits(
        mesh,
        mi.Vector3f(np.ascontiguousarray(point)) + normal * (2 * OFFSET),
        mi.Frame3f(normal).to_world(local),
    )
    ok = np.array(hit.valid)
    there = np.concatenate([np.array(hit.x).T, TURN * np.array(hit.n).T], 1)[ok]
    _, j = tree.query(there)
    return csr_matrix((np.full(len(j), 1 / k), (i[ok] // k, j)), (count, count))


def with_any_uvs(mesh: Mesh) -> Mesh:
    """The mesh with texture coordinates of some kind, which ray queries ask for."""
    return (
        mesh
        if mesh.uvs is not None
        else replace(mesh, uvs=np.zeros((len(mesh.vertices), 2), np.float32))
    )

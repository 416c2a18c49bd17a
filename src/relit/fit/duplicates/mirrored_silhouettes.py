"""Silhouettes count twice where the object is its own mirror image.

Few views leave the sides of an object open that none of them shows in outline. A ray of a photo,
mirrored in the plane of symmetry, meets the object as often as the ray itself does, so every
silhouette bounds the shape from a second side. What an object looks like need not be even, so
mirrored rays tell of the shape alone. Where one side has something that the other has not (a
handle, a crank), the shape of the
pass before misses the silhouettes, mirrored, by more than their usual few pixels: there they do not
count. Where many views stand all around the object, mirrored ones have nothing left to tell, and
there are none.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh
from scipy.ndimage import binary_dilation, binary_erosion

from relit.fit.passes.pixels import PixelBank, RayBatch, drawn_from
from relit.fit.registration.instances.growth import viewing_directions
from relit.fit.registration.instances.views import InstanceView
from relit.fit.shape.outlines import trace_rays
from relit.geometry.symmetry import Plane, symmetry_plane
from relit.reference.mitsuba_scene import build_geometry
from relit.scene import Mesh

SAMPLES = 20_000  # points of the surface
# unit lengths from its mirror image, on the mean, that a surface may lie to be taken for even
EVEN = 0.02
SHARE = 3  # of so many rays one is mirrored
# pixels that THICK must be: smaller pictures do not tell an uneven object from a shape that is
# wrong
LEAST = 2
# of a window's side: what misses a silhouette by less is the shape's error, not the object's
# unevenness
THICK = 0.015
# of a window's side, along outlines: these are for the rays that are not mirrored, for a plane is
# never quite right
BAND = 0.006
AROUND = 3  # times as far around what is uneven mirrored rays do not count
APART = 15.0  # degrees from the next view at which a mirrored view tells nothing new


@dataclass(frozen=True)
class Symmetry:
    """plane: of symmetry. mesh: the surface that told it, in the same frame."""

    plane: Plane
    mesh: Mesh


@dataclass(frozen=True)
class MirroredRays:
    """For a bank with masks. normal (Vector3f), offset: of the plane. pixels: UInt32, of the bank,
    from which mirrored rays are drawn."""

    normal: Any
    offset: Any
    pixels: Any

    def drawn(self, pixel, rng):
        """(pixel, mirrored) drawn pixels (UInt32), every SHARE-th drawn anew from those whose
        mirrored rays count; which (Bool)."""
        mirrored = dr.arange(mi.UInt32, dr.width(pixel)) % SHARE == 0
        return dr.select(mirrored, drawn_from(self.pixels, rng), pixel), mirrored

    def turned(self, batch: RayBatch, mirrored) -> None:
        """Mirror those rays of a batch. Poses are for the rays that are not: where the plane is not
        quite right these would move them."""
        o, d = dr.detach(batch.o), dr.detach(batch.d)
        batch.o = dr.select(
            mirrored, o - 2 * (dr.dot(o, self.normal) - self.offset) * self.normal, batch.o
        )
        batch.d = dr.select(mirrored, d - 2 * dr.dot(d, self.normal) * self.normal, batch.d)


def find_symmetry(mesh: Mesh, views: list[InstanceView], poses: np.ndarray) -> Symmetry | None:
    """The plane in which a mesh in the unit frame is its own mirror image; None where it is not,
    the views are too small to tell, or they
    stand all around it: half of the mirrored ones within APART of another. Then a plane that is not
    quite right costs more than it brings."""
    if THICK * np.median([max(v.mask.shape) for v in views]) < LEAST:
        return None
    points = trimesh.sample.sample_surface(
        trimesh.Trimesh(mesh.vertices, mesh.faces, process=False), SAMPLES, seed=0
    )[0]
    plane, distance = symmetry_plane(np.asarray(points))
    return (
        Symmetry(plane, mesh) if distance < EVEN and mirrored_apart(plane, poses) > APART else None
    )


def mirrored_apart(plane: Plane, poses: np.ndarray) -> float:
    """Degrees between each mirrored view and the next one that is not mirrored, the median."""
    near = (viewing_directions(plane.mirror @ poses) @ viewing_directions(poses).T).max(1)
    return float(np.degrees(np.median(np.arccos(np.clip(near, -1, 1)))))


def mirrored_views(
    symmetry: Symmetry, views: list[InstanceView], poses: np.ndarray
) -> tuple[list[InstanceView], np.ndarray]:
    """The views as mirrored cameras have them, and where these stand: nothing is known where the
    object is not even."""
    shown = [
        replace(v, known=v.known * even_pixels(symmetry, v, p))
        for v, p in zip(views, poses, strict=True)
    ]
    return shown, symmetry.plane.mirror @ poses


def mirrored_rays(
    symmetry: Symmetry, bank: PixelBank, shown: list[InstanceView]
) -> MirroredRays | None:
    """The rays of the bank that count mirrored, by what is known in `mirrored_views`; None where
    there are none."""
    known = np.concatenate([v.known.ravel() for v in shown]) > 0.5
    candidates = np.array(bank.candidates)
    chosen = candidates[known[candidates]]
    if len(chosen) == 0:
        return None
    normal = mi.Vector3f(*[dr.opaque(mi.Float, float(x)) for x in symmetry.plane.normal])
    return MirroredRays(normal, dr.opaque(mi.Float, symmetry.plane.offset), mi.UInt32(chosen))


def even_pixels(symmetry: Symmetry, view: InstanceView, pose: np.ndarray) -> np.ndarray:
    """(h, w) bool: pixels off the outline around which the mesh, met by mirrored rays, has the
    silhouette of the view but for the errors of its shape."""
    h, w = view.mask.shape
    thick = max(LEAST, round(THICK * max(h, w)))
    camera = view.camera.with_pose(symmetry.plane.mirror @ pose)
    x, y = np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5)
    depth, _, _ = trace_rays(build_geometry(symmetry.mesh), camera, x.ravel(), y.ravel())
    own = view.mask > 0.5
    wrong = (np.isfinite(depth).reshape(h, w) != own) & (view.known > 0.5)
    uneven = binary_erosion(wrong, iterations=thick)
    band = max(1, round(BAND * max(h, w)))
    told = binary_erosion(own, iterations=band) | ~binary_dilation(own, iterations=band)
    return (
        told & ~binary_dilation(uneven, iterations=(AROUND + 1) * thick) if uneven.any() else told
    )

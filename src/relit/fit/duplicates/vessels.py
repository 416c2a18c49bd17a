"""Vessels: the ends of a body of revolution as silhouettes leave them, and what lies under a mouth.

From a few sides an end is never seen from across, and the fitted shape carries a cone there that no
silhouette needs. So each end is cut off square, as deep as the silhouettes let it be. What is left
is flat, or the mouth of a vessel; outlines do not tell which. A hollow has a wall as thick as the
grid can carry, and its floor at the waist above the foot or at the other end. Whether it explains
the photos better is for the light to say (fit/duplicates/vessel_trial.py): the volume pass knows no
shadows, and paints them on a lid.

Distances (n, n, n) are those of nodes of the unit frame, negative inside.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import trimesh
from scipy.ndimage import binary_dilation, binary_propagation, grey_opening

from relit.fit.duplicates.scene import distance_in
from relit.fit.registration.instances.views import InstanceView
from relit.fit.shape.hollows import small_pixels, small_size
from relit.geometry.revolution_axis import Axis, revolution_axis
from relit.geometry.sdf import node_positions, redistance
from relit.scene import Camera, Mesh

# median distance of the normals from the axis (`revolution_axis`) up to which a body is one of
# revolution
ROUND = 0.055
SAMPLES = 20_000  # points of the surface whose normals are asked
LOST = 0.001  # share of the silhouettes that an end may cost
LEAST = 1.0  # voxels that an end must lose to be cut
MOUTH = 0.4  # radius of an end, of the body's, from which on it may be a mouth
WALL = 1.7  # voxels
WAIST = 1.08  # the body is so much wider on both sides of a waist


@dataclass(frozen=True)
class End:
    """One end of a body. sign: of the axis' direction that points out of it; height: along the axis
    times sign, where it is cut;
    radius: of the rim."""

    sign: int
    height: float
    radius: float


def body_axis(mesh: Mesh) -> Axis | None:
    """The axis of a mesh that is a body of revolution, handles aside; None for others."""
    surface = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    points, face = trimesh.sample.sample_surface(surface, SAMPLES, seed=0)
    axis, missed = revolution_axis(np.asarray(points), surface.face_normals[face])
    return axis if missed <= ROUND else None


def lowest_cut(
    values: np.ndarray, heights: np.ndarray, views: list[InstanceView], cameras: list[Camera]
) -> float:
    """The height above which all can be taken away so that the silhouettes lose LOST of their area,
    of what the body covers. values,
    heights: (n, n, n) distances and heights of the nodes."""
    n, inside = values.shape[0], values < 0
    points, height, found = node_positions(n)[inside].astype(np.float64), heights[inside], []
    for view, camera in zip(views, cameras, strict=True):
        w, h = small_size(camera, n)
        columns, rows, seen = small_pixels(camera, points, w, h)
        lowest = np.full((h, w), np.inf)  # of what covers the pixel
        np.minimum.at(lowest, (rows, columns), height[seen])
        area = cv2.resize(
            (view.mask * view.known).astype(np.float32), (w, h), interpolation=cv2.INTER_AREA
        )
        closed = grey_opening(lowest, 3)  # nodes leave holes between their pixels
        found.append(np.stack([closed, area], -1).reshape(-1, 2))
    lowest, area = np.concatenate(found).T
    order = np.argsort(lowest)
    order = order[np.isfinite(lowest[order])]
    share = np.cumsum(area[order]) / area[order].sum()
    return float(lowest[order[min(np.searchsorted(share, 1 - LOST), len(order) - 1)]])


def ends_of(
    values: np.ndarray, axis: Axis, views: list[InstanceView], cameras: list[Camera]
) -> tuple[np.ndarray, list[End]]:
    """(distances of the body, both ends cut off square as deep as its silhouettes let them be; the
    ends)."""
    n = values.shape[0]
    p, voxel = node_positions(n), 2 / (n - 1)
    heights, cuts = axis.heights(p), {}
    for sign in (1, -1):
        most = float((sign * heights[values < 0]).max())
        cut = lowest_cut(values, sign * heights, views, cameras) + 0.5 * voxel
        cuts[sign] = cut if cut < most - LEAST * voxel else most + voxel
    flat = np.maximum(values, np.maximum(heights - cuts[1], -heights - cuts[-1]))
    radii, ends = axis.radii(p), []
    for sign, cut in cuts.items():
        top = (flat < 0) & (
            sign * heights > min(cut, float((sign * heights[flat < 0]).max())) - 2 * voxel
        )
        ends.append(End(sign, cut, float(np.quantile(radii[top], 0.95)) if top.any() else 0.0))
    return flat, ends


def mouths(values: np.ndarray, axis: Axis, ends: list[End]) -> list[End]:
    """The ends that are wide enough for a mouth, the widest first."""
    widest = float(np.quantile(axis.radii(node_positions(values.shape[0]))[values < 0], 0.98))
    return sorted((e for e in ends if e.radius >= MOUTH * widest), key=lambda e: -e.radius)


def floor_under(values: np.ndarray, axis: Axis, end: End) -> float:
    """The height (times the end's sign) of the waist nearest to an end, on both sides of which the
    body is wider, as at a stem or above a foot; that of the other end where there is none."""
    p, voxel = node_positions(values.shape[0]), 2 / (values.shape[0] - 1)
    inside = values < 0
    h, r = end.sign * axis.heights(p)[inside], axis.radii(p)[inside]
    levels = np.arange(min(end.height, h.max()) - voxel, h.min(), -voxel)
    width = np.array(
        [
            np.quantile(r[near], 0.9) if (near := np.abs(h - level) < voxel).any() else 0.0
            for level in levels
        ]
    )
    before, beyond = np.maximum.accumulate(width), np.maximum.accumulate(width[::-1])[::-1]
    waists = np.flatnonzero((before > WAIST * width) & (beyond > WAIST * width))
    if len(waists) == 0:
        return float(h.min())
    first = waists[
        : np.argmax(np.diff(waists, append=len(levels) + 2) > 1) + 1
    ]  # levels of the nearest one
    return float(levels[first[np.argmin(width[first])]])


def hollowed(
    values: np.ndarray, flat: np.ndarray, axis: Axis, end: End, raised: float = 0.0
) -> np.ndarray | None:
    """Distances of the body `flat` with a hollow under an end; None where there is no room for one.
    values: the body before its ends were cut; the wall is everything within WALL voxels of its
    side, which goes on straight to the end. raised: how far the floor lies above `floor_under`, as
    a part of the way to the rim."""
    p, voxel = node_positions(values.shape[0]), 2 / (values.shape[0] - 1)
    wall, heights = WALL * voxel, end.sign * axis.heights(p)
    over = np.maximum(heights - (end.height - wall - voxel), 0)[
        ..., None
    ]  # farther up it would be the end that is near, not the side
    side = distance_in(redistance(values))(p - over * end.sign * axis.direction)
    lowest = floor_under(flat, axis, end)
    floor = lowest + raised * (end.height - lowest) + wall
    hole = np.maximum(side + wall, floor - heights)
    open_ = hole < 0
    reached = binary_propagation(
        open_ & (heights > end.height - voxel) & (heights < end.height + 2 * voxel), mask=open_
    )
    if not (reached & (flat < 0)).any():
        return None
    hole = np.where(binary_dilation(reached, iterations=2), hole, np.abs(hole))
    return np.maximum(flat, -hole)

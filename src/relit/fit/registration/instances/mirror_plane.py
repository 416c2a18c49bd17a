"""The plane in which an object is its own mirror image, as most made things and animals nearly are.

A photo that is flipped left to right shows the mirrored object; where the object is its own mirror
image, that is one more view of it, from another side. So each instance that stands counts twice for
the body once the plane is known: outlines bound it from both sides, and paint reaches what no
instance has shown. A few instances tell the plane: for each plane that could be, the flipped
pictures of all of them must agree with the model of them, seen from where the plane puts them. That
is looked up in what the renderings from all around score.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from relit.fit.registration.instances.views import InstanceView, instance_crops, nearest_pixels
from relit.fit.registration.register import (
    TURNS,
    Crop,
    Gallery,
    Render,
    Rings,
    all_scores,
    chosen_rings,
    crop_rings,
    directions_around,
    refine,
)
from relit.geometry.sdf import node_positions
from relit.geometry.se3 import rotation_angle
from relit.geometry.symmetry import Plane
from relit.scene import Camera

FLIP = np.diag(
    [-1.0, 1.0, 1.0, 1.0]
)  # of a camera's axes, for a picture that is flipped left to right
NORMALS = 400  # planes that are tried, 7 degrees apart
JUDGED, OTHERS, SETTLED = (
    24,
    8,
    4,
)  # of these by the silhouettes too, and after the flipped pictures have settled
NODES, BINS = 28, 14  # of the body inside the silhouettes, and of their windows, a side
OFFSETS = np.linspace(
    -0.16, 0.16, 9
)  # of a plane from the middle of the model's frame, which lies somewhere in the object
EVEN = 0.004  # shares of the silhouettes that differ by less tell nothing
COVER = 2.0  # weight of the share of the silhouettes beside the scores of pictures
ANOTHER_PLANE = 25.0  # degrees
LEAD, LEAD_OF_TWO = (
    0.035,
    0.1,
    # of the best plane over the next one; the second where two instances tell it
    # (docs/research/instances.md)
)
KEEP = 0.03  # added to the scores of planes near the last one
SLID = 20.0  # degrees
CLOSE = 3  # renderings next to where a plane puts a picture, of which the best counts


def flipped_poses(plane: Plane, poses: np.ndarray) -> np.ndarray:
    """Poses (N, 4, 4) object_from_camera of the flipped pictures of cameras at `poses`."""
    return plane.mirror @ poses @ FLIP


@dataclass(frozen=True)
class Flipped:
    """Crops of views that are flipped left to right, and what is compared of them."""

    crops: list[Crop]
    rings: Rings

    def of(self, chosen: list[int]) -> Flipped:
        return Flipped([self.crops[k] for k in chosen], chosen_rings(self.rings, chosen))


def flipped_views(views: list[InstanceView], parts) -> Flipped:
    """All views, flipped. The cameras' poses stay: they are those of the photo that is flipped."""
    crops = instance_crops([flip(v) for v in views])
    return Flipped(crops, crop_rings(crops, parts))


def flip(view: InstanceView) -> InstanceView:
    """A view of the mirrored object. Its normal prior stays behind: registration does not look at
    it."""
    camera = replace(view.camera, cx=view.camera.width - view.camera.cx)
    rgb, mask, known = (np.ascontiguousarray(a[:, ::-1]) for a in (view.rgb, view.mask, view.known))
    return replace(view, camera=camera, rgb=rgb, mask=mask, known=known, normal=None)


def find_plane(
    views: list[InstanceView],
    pictures: Flipped,
    poses: np.ndarray,
    gallery: Gallery,
    render: Render,
    parts,
    *,
    last: Plane | None = None,
) -> Plane | None:
    """The plane in which the model that `gallery` and `render` show is its own mirror image, by the
    pictures (flipped) of `views` that stand at `poses`; None where no plane leads by LEAD over
    every other one. last: the plane of before, which is believed a little longer.

    A plane is judged by what the flipped pictures score and by how much of every silhouette is left
    of a body that lies inside all silhouettes together with its mirror image.
    """
    half = directions_around(2 * NORMALS)
    normals = half[half[:, 2] > 0]
    score = plane_scores(normals, pictures, poses, gallery)
    hull = HullPoints(views, poses)
    # the likeliest by appearance, and the likeliest of other directions, so that the best one has
    # others to lead over
    judged = np.unique([*np.argsort(-score)[:JUDGED], *distinct_planes(normals, score)[:OTHERS]])
    shares, offsets = np.array([hull.offset(n) for n in normals[judged]]).T
    normals, score = normals[judged], score[judged] + COVER * shares
    chosen = distinct_planes(normals, score)[:SETTLED]
    looked_at = [
        settled_plane(Plane(normals[k], offsets[k]), hull, pictures, poses, render, parts, last)
        for k in chosen
    ]
    (best, plane), *others = sorted(looked_at, key=lambda one: -one[0])
    return plane if best - others[0][0] >= (LEAD if len(poses) > 2 else LEAD_OF_TWO) else None


def distinct_planes(normals: np.ndarray, score: np.ndarray) -> list[int]:
    """Planes from the best score down, each ANOTHER_PLANE degrees or more from those before it."""
    chosen: list[int] = []
    for k in np.argsort(-score).tolist():
        if all(abs(normals[k] @ normals[j]) < np.cos(np.radians(ANOTHER_PLANE)) for j in chosen):
            chosen.append(k)
    return chosen


def settled_plane(
    first: Plane,
    hull: HullPoints,
    pictures: Flipped,
    poses: np.ndarray,
    render: Render,
    parts,
    last: Plane | None,
) -> tuple[float, Plane]:
    """(score, plane) after the flipped pictures have settled on the model; one that slides off to
    another plane counts as it was."""
    start = flipped_poses(first, poses)
    found, own = refine(
        pictures.crops, start, render, rings=pictures.rings, steps=(0, 5.0, 2.5), parts=parts
    )
    slid = (
        np.array(
            [rotation_angle(a[:3, :3].T @ b[:3, :3]) for a, b in zip(found, start, strict=True)]
        )
        > SLID
    )
    if slid.any():
        _, there = refine(
            pictures.crops, start, render, rings=pictures.rings, steps=(0,), parts=parts
        )
        own = np.where(slid, there, own)
    better = normal_between(poses, found, first.normal)
    share, offset = hull.offset(better)
    kept = (
        KEEP if last is not None and abs(better @ last.normal) > np.cos(np.radians(SLID)) else 0.0
    )
    return float(own.mean()) + COVER * share + kept, Plane(better, offset)


class HullPoints:
    """What lies inside all silhouettes, as points (P, 3)."""

    def __init__(self, views: list[InstanceView], poses: np.ndarray):
        self.views, self.cameras = (
            views,
            [v.camera.with_pose(p) for v, p in zip(views, poses, strict=True)],
        )
        points = node_positions(NODES).reshape(-1, 3)
        points = points[(points**2).sum(1) < 0.98]
        self.points = points[self.holds(points)]
        self.outlines = [binned(*np.nonzero(v.mask > 0.5), v) >= 0.5 * cell(v) ** 2 for v in views]

    def holds(self, points: np.ndarray) -> np.ndarray:
        """(P,) bool: whether points lie inside all silhouettes, or where these do not tell."""
        inside = np.ones(len(points), bool)
        for view, camera in zip(self.views, self.cameras, strict=True):
            u, v, ok = nearest_pixels(camera, points)
            inside &= (ok & (view.mask[v, u] > 0.3)) | (view.known[v, u] < 0.5)
        return inside

    def offset(self, normal: np.ndarray) -> tuple[float, float]:
        """(share, offset) of the plane of this normal after which most of the silhouettes is
        covered by what lies, with its mirror image, inside all of them; the middle of the offsets
        that do as well."""
        across = self.points @ normal
        share = np.empty(len(OFFSETS))
        for k, offset in enumerate(OFFSETS):
            left = self.points[self.holds(self.points - 2 * np.outer(across - offset, normal))]
            share[k] = np.mean(
                [
                    self.covered(left, *one)
                    for one in zip(self.views, self.cameras, self.outlines, strict=True)
                ]
            )
        return float(share.max()), float(OFFSETS[share > share.max() - EVEN].mean())

    def covered(
        self, points: np.ndarray, view: InstanceView, camera: Camera, outline: np.ndarray
    ) -> float:
        u, v, ok = nearest_pixels(camera, points)
        return float((binned(v[ok], u[ok], view) > 0)[outline].mean()) if outline.any() else 0.0


def cell(view: InstanceView) -> float:
    """Pixels of a bin's side."""
    return max(view.mask.shape) / BINS


def binned(rows: np.ndarray, columns: np.ndarray, view: InstanceView) -> np.ndarray:
    """(BINS + 1, BINS + 1) how many of the pixels fall into each bin of a view's window."""
    out = np.zeros((BINS + 1, BINS + 1), int)
    np.add.at(out, ((rows / cell(view)).astype(int), (columns / cell(view)).astype(int)), 1)
    return out


def normal_between(poses: np.ndarray, mirrored: np.ndarray, start: np.ndarray) -> np.ndarray:
    """(3,) normal of the plane that best takes poses (N, 4, 4) to those of the flipped pictures;
    start: nearly that. Pictures that say another one, as some do that have slid off to where they
    look alike, do not count."""
    reflections = mirrored[:, :3, :3] @ FLIP[:3, :3] @ poses[:, :3, :3].transpose(0, 2, 1)
    agree = np.abs(np.array([normal_of(r) for r in reflections]) @ start) > np.cos(np.radians(SLID))
    return normal_of(reflections[agree].mean(0)) if agree.any() else start


def normal_of(reflection: np.ndarray) -> np.ndarray:
    """(3,) of the reflection nearest to a (3, 3): it has the eigenvalue -1 along the normal."""
    return np.linalg.eigh(reflection + reflection.T)[1][:, 0]


def plane_scores(
    normals: np.ndarray, pictures: Flipped, poses: np.ndarray, gallery: Gallery
) -> np.ndarray:
    """(P,) mean score of flipped pictures against renderings from about where each plane through
    the middle puts them. normals: (P, 3)."""
    table = all_scores(pictures.rings, gallery.rings)
    eyes = np.array([c.centre / np.linalg.norm(c.centre) for c in gallery.cameras])
    axes = np.array([np.asarray(c.world_from_camera)[:3, :3] for c in gallery.cameras])
    total = np.zeros(len(normals))
    for scores, crop, pose in zip(table, pictures.crops, poses, strict=True):
        placed = np.array([flipped_poses(Plane(n, 0.0), pose) for n in normals])
        there = placed[:, :3, 3] / np.linalg.norm(placed[:, :3, 3], axis=1, keepdims=True)
        close = np.argsort(-(there @ eyes.T), axis=1)[:, :CLOSE]
        own = placed[:, :3, :3] @ np.asarray(crop.camera.world_from_camera)[:3, :3]
        roll = np.einsum("pji,pcjk->pcik", own, axes[close])  # crop_from_view
        angle = np.arctan2(roll[..., 1, 0] - roll[..., 0, 1], roll[..., 0, 0] + roll[..., 1, 1])
        shift = np.round(angle / (2 * np.pi / TURNS)).astype(int)
        near = [scores[close, (shift + d) % TURNS] for d in (-1, 0, 1)]
        total += np.max(near, axis=(0, 2))
    return total / len(poses)

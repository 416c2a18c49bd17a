"""Where the identical objects of a photo stand, by rendering crude models of them.

SfD finds the poses by matching features between the objects (Sec. 3.1; cameras/rotation_sweep.py
does that). Feature matching links what is seen from similar sides; what it cannot link is found
here by search:

    views_of      the photo and its labels -> one virtual camera with picture, mask and what is
                  known for each instance
    inflated      a crude model from one silhouette; carved, taut_body: one from the silhouettes of
                  several
    fit_model     a coarse volume model of some instances

Poses are `object_from_camera` of the PHOTO's camera, in the unit frame of the object: instance i in
the photo's frame is the inverse, SfD's ξ_obj = ξ_ref ∘ ξ_cam^-1 with ξ_ref the photo's camera.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import mitsuba as mi
import numpy as np
from scipy.ndimage import binary_dilation, distance_transform_edt

from relit.conventions import similarity
from relit.fit.passes.camera_corrections import CorrectionModel, corrected, no_corrections
from relit.fit.passes.optimiser import NoStage
from relit.fit.passes.pixels import PixelBank, make_bank
from relit.fit.passes.volume import VolumeModel, VolumeOptions, fit_volume, start_model
from relit.fit.registration.register import Crop, Render, crop_photo, volume_render
from relit.geometry.hull import distance_of
from relit.geometry.sdf import node_positions
from relit.geometry.taut import taut
from relit.rendering.appearance.world_light import shade_albedo, shade_world, start_world_light
from relit.scene import Camera

COARSE = 160  # pixels, longer side of a window while poses are searched
MARGIN = 0.15  # of a window around its instance, of its size
ACROSS = 50  # degrees from which another view bounds what this one leaves open in depth
OBJECT_RADIUS = 0.8  # of the widest silhouette, in the unit frame


@dataclass(frozen=True, order=True)
class ViewId:
    """Names the view of an instance among those of all photos. photo: its number, from 0. label: of
    the instance in that photo's label image."""

    photo: int
    label: int


@dataclass(frozen=True)
class InstanceView:
    """One instance in its window of the photo. camera: of the window, its pose that of the photo.
    rgb: (h, w, 3) linear. mask: (h, w).
    known: (h, w), 0 where another object hides or may hide it. seen: share of the outline that ends
    at known background. normal: (h, w, 3) prior in the camera's axes, 0 where there is none, or
    None. photo: number of the photo that it is from; the camera's pose is that photo's own
    frame."""

    label: int
    camera: Camera
    rgb: np.ndarray
    mask: np.ndarray
    known: np.ndarray
    seen: float
    normal: np.ndarray | None = None
    photo: int = 0

    @property
    def id(self) -> ViewId:
        return ViewId(self.photo, self.label)


def views_of(
    rgb: np.ndarray,
    labels: np.ndarray,
    camera: Camera,
    side: int,
    normal: np.ndarray | None = None,
    photo: int = 0,
) -> list[InstanceView]:
    """A view of each label > 0, in windows of at most `side` pixels. camera: of the photo, identity
    pose. normal: of the photo, or None.
    photo: its number. What a window holds beyond the photo's border is not known."""
    out = []
    for label in np.unique(labels[labels > 0]):
        own = labels == label
        rows, columns = np.flatnonzero(own.any(1)), np.flatnonzero(own.any(0))
        grow = max(8, round(MARGIN * max(np.ptp(rows), np.ptp(columns))))
        top, left = rows[0] - grow, columns[0] - grow
        h, w = rows[-1] + 1 + grow - top, columns[-1] + 1 + grow - left
        mine, there = (
            window(labels, top, left, h, w),
            window(np.ones(labels.shape, bool), top, left, h, w),
        )
        mask = (mine == label).astype(np.float32)
        other = (mine != label) & (mine != 0)
        known = there * (1.0 - binary_dilation(other, iterations=1).astype(np.float32) * (1 - mask))
        edge = binary_dilation(mask > 0, iterations=2) & (mask == 0)
        seen = float(known[edge].mean()) if edge.any() else 0.0
        c = replace(camera, width=int(w), height=int(h), cx=camera.cx - left, cy=camera.cy - top)
        picture, prior = (
            window(rgb, top, left, h, w),
            None if normal is None else window(normal, top, left, h, w) * mask[..., None],
        )
        s = min(1.0, side / max(w, h))
        if s < 1:
            size = (max(8, round(w * s)), max(8, round(h * s)))
            picture, mask, known = (
                cv2.resize(a, size, interpolation=cv2.INTER_AREA) for a in (picture, mask, known)
            )
            prior = None if prior is None else cv2.resize(prior, size, interpolation=cv2.INTER_AREA)
            c = c.resized(*size)
        out.append(
            InstanceView(
                int(label), c, picture, mask, (known > 0.99).astype(np.float32), seen, prior, photo
            )
        )
    return out


def instance_crops(views: list[InstanceView]) -> list[Crop]:
    return [crop_photo(v.rgb, v.mask, v.camera.with_pose(np.eye(4)), v.known) for v in views]


def best_seen(views: list[InstanceView]) -> list[int]:
    """Indices of the views, those first whose outline ends at known background and which are
    large."""
    return sorted(
        range(len(views)),
        key=lambda k: -views[k].seen * np.sqrt(views[k].mask.sum()) / views[k].camera.fx,
    )


def window(a: np.ndarray, top: int, left: int, h: int, w: int) -> np.ndarray:
    """(h, w, ...) of a picture, 0 beyond its border."""
    rows, columns = np.clip([top, top + h], 0, a.shape[0]), np.clip([left, left + w], 0, a.shape[1])
    beyond = ((rows[0] - top, top + h - rows[1]), (columns[0] - left, left + w - columns[1]))
    return np.pad(a[slice(*rows), slice(*columns)], (*beyond, *[(0, 0)] * (a.ndim - 2)))


def pixel_bank(views: list[InstanceView], poses: np.ndarray) -> PixelBank:
    """The pixels of the views, with the virtual cameras at `poses`; unknown ones are never
    drawn."""
    cameras = [v.camera.with_pose(p) for v, p in zip(views, poses, strict=True)]
    normals = [v.normal for v in views] if any(v.normal is not None for v in views) else None
    bank = make_bank(cameras, [v.rgb for v in views], [v.mask for v in views], normals)
    known = np.concatenate([v.known.ravel() for v in views]) > 0.5
    candidates = np.array(bank.candidates)
    bank.candidates = mi.UInt32(candidates[known[candidates]])
    return bank


# ---------------------------------------------------------------- the model


def frame_scale(views: list[InstanceView]) -> float:
    """Distance (unit lengths) at which the widest silhouette has OBJECT_RADIUS: the scale of a
    photo is free, this fixes it."""
    widest = 0.0
    for v in views:
        y, x = np.nonzero(v.mask > 0.5)
        points = np.stack(
            [(x + 0.5 - v.camera.cx) / v.camera.fx, (y + 0.5 - v.camera.cy) / v.camera.fy], -1
        )
        widest = max(
            widest,
            float(np.linalg.norm(points - (points.min(0) + points.max(0)) / 2, axis=1).max()),
        )
    return OBJECT_RADIUS / widest


def eyes_at(poses: np.ndarray) -> float:
    """Median distance of cameras at `poses` (N, 4, 4) from the object's middle."""
    return float(np.median(np.linalg.norm(poses[:, :3, 3], axis=1)))


def first_pose(view: InstanceView, distance: float) -> np.ndarray:
    """object_from_camera (4, 4) of the instance that the model is grown from: the object's axes are
    the camera's, its middle lies on the ray through the middle of the silhouette."""
    y, x = np.nonzero(view.mask > 0.5)
    ray = np.array(
        [
            ((x.min() + x.max() + 1) / 2 - view.camera.cx) / view.camera.fx,
            ((y.min() + y.max() + 1) / 2 - view.camera.cy) / view.camera.fy,
            1.0,
        ]
    )
    return similarity(np.eye(3), -distance * ray)


def nearest_pixels(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Columns and rows (N,) of the pixels that show points (N, 3), or of the nearest ones at the
    border; and whether they show them."""
    q = camera.project(points)
    u, v = np.floor(q[:, 0]).astype(int), np.floor(q[:, 1]).astype(int)
    ok = (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height) & (q[:, 2] > 0)
    return np.clip(u, 0, camera.width - 1), np.clip(v, 0, camera.height - 1), ok


def inflate_silhouette(
    view: InstanceView, pose: np.ndarray, n: int, depth: float = 1.2, most: float = 0.55
) -> np.ndarray:
    """Signed distance (n, n, n) of a body that fills the silhouette, as deep on both sides as
    `depth` times the distance to the outline."""
    camera = view.camera.with_pose(pose)
    solid = view.mask > 0.5
    p = node_positions(n).reshape(-1, 3)
    u, v, ok = nearest_pixels(camera, p)
    middle = float(np.linalg.norm(camera.centre))
    room = distance_transform_edt(np.pad(solid, 1))[1:-1, 1:-1] / camera.fx * middle
    along = p @ (camera.centre / middle)
    inside = ok & solid[v, u] & (np.abs(along) < np.minimum(room[v, u] * depth, most))
    return distance_of(inside.reshape(n, n, n))


def carved(
    views: list[InstanceView],
    poses: np.ndarray,
    n: int,
    tolerance: float,
    depth: float | None = None,
    *,
    crossed: bool = False,
) -> np.ndarray:
    """Signed distance of what lies inside nearly all silhouettes: a node is out where more than
    `tolerance` of the views that know show background there. Raises NoShape when nothing is left.

    depth: a view also counts a node as out that lies farther before or behind the object's middle
    than `depth` times the distance to the
    outline, and a little: views from nearly one side would leave a body as deep as the ball.
    crossed: poses are good enough that a view need not be bounded so where another looks across it
    (at ACROSS degrees or more).
    """
    p = node_positions(n).reshape(-1, 3)
    told, empty = np.zeros(len(p)), np.zeros(len(p))
    seen = poses[:, :3, 3] / np.linalg.norm(poses[:, :3, 3], axis=1, keepdims=True)
    across = crossed & (np.abs(seen @ seen.T).min(1) < np.cos(np.radians(ACROSS)))
    for view, pose, bounded in zip(views, poses, across, strict=True):
        camera = view.camera.with_pose(pose)
        u, v, ok = nearest_pixels(camera, p)
        known = view.known[v, u] > 0.5  # beyond the window: as at its edge
        out = ~(ok & (view.mask[v, u] > 0.3))
        if depth is not None and not bounded:
            middle = float(np.linalg.norm(camera.centre))
            room = (
                distance_transform_edt(np.pad((view.mask > 0.5) | (view.known < 0.5), 1))[
                    1:-1, 1:-1
                ]
                / camera.fx
                * middle
            )
            out |= np.abs(p @ (camera.centre / middle)) > depth * room[v, u] + 0.1
        told += known
        empty += known & out
    inside = (told > 0) & (empty <= tolerance * told) & ((p**2).sum(1) < 0.98)
    return distance_of(inside.reshape(n, n, n))


def taut_body(
    views: list[InstanceView],
    poses: np.ndarray,
    n: int,
    tolerance: float,
    depth: float | None = None,
    *,
    crossed: bool = False,
):
    """As `carved`, but as round as the silhouettes let it be (geometry/taut.py): of few views the
    hull has corners and lumps that nobody has seen, and from other sides it does not look like the
    object."""
    values = carved(views, poses, n, tolerance, depth, crossed=crossed)
    cameras = [v.camera.with_pose(pose) for v, pose in zip(views, poses, strict=True)]
    return taut(values, cameras, [v.mask * v.known for v in views])


def fit_model(
    views: list[InstanceView],
    poses: np.ndarray,
    values: np.ndarray,
    steps: int,
    *,
    refine_cameras: float = 0.0,
    hold: int = 0,
    rays: int = 4096,
    seed: int = 0,
) -> tuple[VolumeModel, np.ndarray]:
    """A coarse model from start distances; (model, poses with the corrections that the fit has
    found). hold: steps before poses move."""
    bank = pixel_bank(views, poses)
    inside = np.concatenate([v.rgb[v.mask > 0.99] for v in views])
    model = start_model(values, np.maximum(inside.mean(0), 1e-3), None, full=False)
    model.appearance = shade_world
    model.reflections, model.rates = start_world_light(float(inside.mean()), len(views))
    if refine_cameras > 0:
        move_poses(bank, model, distances=False)
    options = VolumeOptions(
        (values.shape[0],),
        (steps,),
        rays,
        sharpness=(1.5, 4.0),
        refine_cameras=refine_cameras,
        hold=hold,
    )
    fit_volume(bank, model, options, NoStage(), seed)
    return model, moved_poses(bank, views, poses)


def move_poses(bank: PixelBank, model: VolumeModel, distances: bool = True) -> None:
    """Let the volume pass turn the cameras about the object's middle (not about themselves, which
    would throw the picture aside), move them, and change their distance, if asked to; the focal
    length stays."""
    bank.corrections = no_corrections(bank.views, CorrectionModel.WITH_DISTANCE)
    model.correction_ratios = mi.Float(
        np.tile(np.array([1, 1, 1, 1, 1, 1, 0, distances], np.float32), bank.views)
    )


def hold_distances(model: VolumeModel) -> None:
    """Change the distances of `move_poses` no more. On a fine grid their steps shake the size of
    every instance, and turns suffer."""
    rates = np.array(model.correction_ratios).reshape(-1, 8)
    rates[:, 7] = 0
    model.correction_ratios = mi.Float(rates.ravel())


def moved_poses(bank: PixelBank, views: list[InstanceView], poses: np.ndarray) -> np.ndarray:
    """The poses (N, 4, 4) with the corrections that a fit has found."""
    cameras = corrected(
        [v.camera.with_pose(p) for v, p in zip(views, poses, strict=True)],
        bank.corrections,
    )
    return np.array([c.world_from_camera for c in cameras])


def albedo_render(model: VolumeModel):
    """Renders the model's colours without light on black, and its opacity:
    `fit.registration.register.Render`."""
    return volume_render(replace(model, appearance=shade_albedo))


def overlaps(render: Render, view: InstanceView, poses: np.ndarray) -> np.ndarray:
    """(K,) intersection over union of the view's silhouette and the model's at poses (K, 4, 4),
    where it is known."""
    h, w = view.mask.shape
    square = replace(view.camera, width=max(h, w), height=max(h, w))
    drawn = render([square.with_pose(p) for p in poses])[1][:, :h, :w] > 0.5
    own, known = view.mask > 0.5, view.known > 0.5
    return (drawn & own & known).sum((1, 2)) / np.maximum(((drawn | own) & known).sum((1, 2)), 1)

"""Masks and the object sphere as a person has corrected them, kept beside the capture and used
whenever it is opened again.

    CAPTURE/relit-corrections/  masks/NAME.png (white on the object, of the photo as Relit shows it:
    upright, undistorted)  sphere.json

A corrected mask wins over every other source of masks; a sphere given on the command line wins over
the corrected one. Of a photo of duplicates it corrects the labels, see `corrected_labels`.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from urllib.parse import quote, unquote

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt

from relit.errors import UserError
from relit.files import disk_errors, read_json, write_text
from relit.images import read_data, write_data
from relit.scene import Camera, Photo, Pixels, Sphere

FOLDER = "relit-corrections"
# of the longer side of a photo of duplicates: so far from an object a pixel that was painted in
# belongs to it
REACH = 0.01


@dataclass(frozen=True)
class Corrected:
    """Lays a corrected mask over what `load` returns."""

    load: Callable[[], Pixels]
    path: Path

    def __call__(self) -> Pixels:
        pixels = self.load()
        mask = _read(self.path, pixels.rgb.shape[:2])
        return replace(pixels, mask=_sized(mask, pixels.rgb.shape[:2]))


def _read(path: Path, shape: tuple[int, int]) -> np.ndarray:
    """The mask in [0, 1] at the size it was painted at. Raises UserError where a photo of `shape`
    has other proportions."""
    mask = read_data(path)
    mask = np.ascontiguousarray(mask if mask.ndim == 2 else mask[..., 0], np.float32)
    h, w = shape
    if abs(mask.shape[1] / mask.shape[0] - w / h) > 0.02 * (w / h):
        raise UserError(
            f"a corrected mask and its photo have different shapes: {mask.shape[1]} x {mask.shape[0]} and {w} x {h} pixels",
            "the photo was replaced or turned since",
            f"correct it again, or remove the file: {path}",
        )
    return mask


def _sized(mask: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """The mask at another size (H, W)."""
    if mask.shape == shape:
        return mask
    return cv2.resize(
        mask,
        shape[::-1],
        interpolation=cv2.INTER_AREA if mask.shape[0] > shape[0] else cv2.INTER_LINEAR,
    )


def corrected_labels(labels: np.ndarray, root: Path, name: str) -> tuple[np.ndarray, list[str]]:
    """The labels (H, W) of a photo of duplicates, positive on objects, as its corrected mask wants
    them, and notes that say so.

    What was taken out of the mask is background. What was put in goes to the nearest object within
    REACH of the longer side; farther away it cannot be told whose it is, and it stays what it was.
    Pixels that were not painted keep their labels, and so do objects that are left out (negative).
    """
    path = corrected_masks(root).get(name)
    if path is None:
        return labels, []
    painted = _read(path, labels.shape)
    on = labels > 0
    # painted on a smaller copy: what that alone does to the borders is no correction
    before = _sized(_sized(on.astype(np.float32), painted.shape), labels.shape) > 0.5
    after = _sized(painted, labels.shape) > 0.5
    out, into = before & ~after & on, after & ~before & (labels == 0)
    if not (on & ~out).any():
        raise UserError(
            "a corrected mask leaves no object",
            "all labels lie off it",
            f"correct it again, or remove the file: {path}",
        )
    reach = max(4.0, REACH * max(labels.shape))
    away, nearest = distance_transform_edt(~(on & ~out), return_indices=True)
    given = into & (away <= reach)
    fixed = np.where(out, 0, np.where(given, labels[tuple(nearest)], labels))
    notes = [
        f"{FOLDER}/: the mask was corrected by hand; {out.sum()} pixels were taken out, {given.sum()} went to the nearest object"
    ]
    if refused := int((into & ~given).sum()):
        notes.append(
            f"{FOLDER}/: {refused} pixels that were painted in lie more than {reach:.0f} pixels from every object: whose they are is not "
            "known, and they are not used; a new object needs a label of its own"
        )
    return fixed.astype(labels.dtype), notes


def _file_of(name: str) -> str:
    return quote(name, safe=" ") + ".png"


def corrected_masks(root: Path) -> dict[str, Path]:
    """{name of a photo: its corrected mask}."""
    folder = _folder(root) / "masks"
    return (
        {unquote(p.name[: -len(".png")]): p for p in sorted(folder.glob("*.png"))}
        if folder.is_dir()
        else {}
    )


def corrected_sphere(root: Path) -> Sphere | None:
    """The object sphere as it was corrected, or None. Raises UserError for a file that makes no
    sense."""
    path = _folder(root) / "sphere.json"
    if not path.is_file():
        return None
    data = read_json(path)
    try:
        centre, radius = np.array(data["centre"], np.float64), float(data["radius"])
        if centre.shape != (3,) or not np.isfinite(centre).all() or not 0 < radius < np.inf:
            raise ValueError
    except (TypeError, KeyError, ValueError, OverflowError):
        raise UserError(
            "the corrected object sphere cannot be read",
            fix=f"correct it again, or remove the file: {path}",
        ) from None
    return Sphere(centre, radius)


def with_corrected_masks(
    photos: list[Photo], root: Path, have_masks: bool, notes: list[str]
) -> list[Photo]:
    """The photos with their corrected masks. have_masks: the others have masks too; else corrected
    ones count only if all have one."""
    files = corrected_masks(root)
    found = [p for p in photos if p.name in files]
    if not found:
        return photos
    if not have_masks and len(found) < len(photos):
        notes.append(
            f"{len(found)} of {len(photos)} photos have corrected masks and the others none: they are not used until all have one"
        )
        return photos
    notes.append(f"{len(found)} masks were corrected by hand ({FOLDER}/)")
    return [
        replace(p, load=Corrected(p.load, files[p.name])) if p.name in files else p for p in photos
    ]


def save_mask(root: Path, photo: Photo, mask: np.ndarray) -> Path:
    """Keep a mask (h, w) in [0, 1] of a photo, of its shape at any size. Returns the file."""
    h, w = mask.shape
    if abs(w / h - photo.width / photo.height) > 0.02 * (photo.width / photo.height):
        raise UserError(
            f"a mask of {w} x {h} pixels does not fit a photo of {photo.width} x {photo.height}"
        )
    path = _folder(root) / "masks" / _file_of(photo.name)
    with disk_errors(path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_data(path, mask)
    return path


def forget_mask(root: Path, photo: Photo) -> None:
    """Remove a photo's corrected mask."""
    (_folder(root) / "masks" / _file_of(photo.name)).unlink(missing_ok=True)


def save_sphere(root: Path, sphere: Sphere) -> Path:
    """Keep the object sphere."""
    path = _folder(root) / "sphere.json"
    with disk_errors(path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(
            path,
            json.dumps(
                {"centre": [float(x) for x in sphere.centre], "radius": float(sphere.radius)}
            )
            + "\n",
        )
    return path


def sphere_from_boxes(boxes: list[tuple[Camera, tuple[float, float, float, float]]]) -> Sphere:
    """The ball that boxes (x0, y0, x1, y1), pixels, drawn round the object in two or more photos
    describe: its centre is nearest to the rays through their middles, its radius the mean of their
    half diagonals at that depth. Raises UserError."""
    from relit.capture.sphere import closest_point

    if len(boxes) < 2:
        raise UserError(
            "one box is not enough",
            "a box says nothing about the distance",
            "draw boxes in two photos from different sides",
        )
    directions, radii = [], []
    for c, (x0, y0, x1, y1) in boxes:
        d = c.world_from_camera[:3, :3] @ [
            ((x0 + x1) / 2 - c.cx) / c.fx,
            ((y0 + y1) / 2 - c.cy) / c.fy,
            1.0,
        ]
        directions.append(d / np.linalg.norm(d))
    centres, directions = np.array([c.centre for c, _ in boxes]), np.array(directions)
    if np.ptp(directions, axis=0).max() < 0.02:
        raise UserError(
            "the boxes are all seen from one side",
            fix="draw boxes in two photos from different sides",
        )
    centre = closest_point(centres, directions)
    for c, (x0, y0, x1, y1) in boxes:
        depth = c.project(centre)[2]
        if depth <= 0:
            raise UserError(
                "the boxes do not meet in front of the cameras",
                "they are drawn round different things",
                "draw them again",
            )
        radii.append(depth * np.hypot((x1 - x0) / c.fx, (y1 - y0) / c.fy) / 2)
    return Sphere(centre, float(np.mean(radii)))


def _folder(root: Path) -> Path:
    root = root if root.is_dir() else root.parent
    return root / FOLDER

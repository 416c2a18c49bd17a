"""One photo of several identical objects and where each of them is: SfD's folders, a photo with a label image, cut-outs, COCO.

SfD          transforms_train.json and train/000_rgb.png, train/000_instance_seg.png (or raw/000_rgb.png, raw/000_instance_seg.png)
labels       NAME_labels.png, NAME_instance_seg.png or NAME_seg.png beside the photo NAME.*: one grey level or colour for each object,
             black for the rest
cut-outs     cutouts/*.png beside the photo: RGBA pictures of the photo's size, one for each object
COCO         a .json with `images` and `annotations` (polygons or run lengths) beside the photo
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from relit.capture.frames import pose_from, read_json
from relit.capture.photo import Decoder
from relit.conventions import world_from_cv_camera
from relit.errors import UserError
from relit.images import EXTENSIONS, read_header
from relit.scene import Camera, Capture, Photo, Pixels

SUFFIXES = ("_instance_seg", "_labels", "_instances", "_seg")
SFD_NORMALS = "_normal_pretrain.png"  # SfD's: y up, z towards the camera
CUTOUTS = ("cutouts", "cut-outs", "instances")
LEAST_SIDE = 24  # pixels; smaller objects carry no pose
MOST = 1000  # objects
FOCAL_GUESS = 1.2  # of the longer side, where neither the user nor the file tells


@dataclass(frozen=True)
class Source:
    """What was found: the photo, where its labels are (a label image, a folder of cut-outs, a COCO file), and the file with the camera."""

    root: Path
    photo: Path
    labels: Path
    cameras: Path | None = None


@dataclass(frozen=True)
class Labelled:
    """Adds the labels to what `load` returns. labels: (H, W) int32 at the decoded size. upward: the file's normals have y up and z towards
    the camera."""

    load: Callable[[], Pixels]
    labels: np.ndarray
    upward: bool = False

    def __call__(self) -> Pixels:
        pixels = self.load()
        if self.upward and pixels.normal is not None:
            pixels = replace(pixels, normal=pixels.normal * np.array([1, -1, -1], np.float32))
        return replace(pixels, labels=self.labels, mask=(self.labels > 0).astype(np.float32))


def recognise(path: Path) -> Source | None:
    """The photo and its labels, or None where `path` is no photo of duplicates."""
    if path.is_file():
        labels = _labels_of(path) if path.suffix.lower() in EXTENSIONS else None
        return None if labels is None else Source(path.parent, path, labels, _cameras(path.parent))
    if not path.is_dir():
        return None
    for folder in (path / "train", path / "raw", path):
        if folder.is_dir():
            for photo in sorted(folder.iterdir()):
                if photo.suffix.lower() in EXTENSIONS and not _is_side_file(photo) and (labels := _labels_of(photo)) is not None:
                    return Source(path, photo, labels, _cameras(path))
    return None


def _is_side_file(file: Path) -> bool:
    return file.stem.endswith((*SUFFIXES, "_mask", "_normal", "_normal_pretrain", "_depth"))


def _cameras(root: Path) -> Path | None:
    return next((root / n for n in ("transforms_train.json", "transforms.json") if (root / n).is_file()), None)


def _labels_of(photo: Path) -> Path | None:
    stem = photo.stem.removesuffix("_rgb")
    for suffix in SUFFIXES:
        for end in (".png", ".tif", ".tiff", ".bmp"):
            if (file := photo.parent / f"{stem}{suffix}{end}").is_file():
                return file
    for name in CUTOUTS:
        if (photo.parent / name).is_dir() and any((photo.parent / name).glob("*.png")):
            return photo.parent / name
    for file in sorted(photo.parent.glob("*.json")):
        if file.stat().st_size < 64 << 20 and _is_coco(file):
            return file
    return None


def _is_coco(file: Path) -> bool:
    try:
        data = json.loads(file.read_text(encoding="utf-8-sig"))
    except (ValueError, OSError, RecursionError):
        return False
    return isinstance(data, dict) and isinstance(data.get("annotations"), list) and isinstance(data.get("images"), list)


def open_duplicates(source: Source, *, focal: float | None = None, max_side: int | None = None) -> Capture:
    """The capture: one photo with its camera and labels. focal: pixels of the photo as stored, or None. Raises UserError (exit code 3)."""
    header = read_header(source.photo)
    w, h, notes = header.width, header.height, []
    labels, dropped = checked_labels(read_labels(source.labels, source.photo, (h, w)), source.labels)
    notes += dropped
    pose, known = np.eye(4), None
    if source.cameras is not None:
        pose, known = _camera(source.cameras, w)
    if focal is None and known is None:
        focal = header.focal
        if focal is None:
            focal = FOCAL_GUESS * max(w, h)
            notes.append(
                f"the focal length is not known; {focal:.0f} pixels are assumed (--focal PIXELS): shapes come out too flat or too deep"
            )
    f = float(focal if focal is not None else known)
    scale = min(1.0, (max_side or max(w, h)) / max(w, h))
    size = (max(1, round(w * scale)), max(1, round(h * scale)))
    camera = Camera(w, h, f, f, w / 2, h / 2, pose).resized(*size)
    labels = labels if scale == 1 else cv2.resize(labels, size, interpolation=cv2.INTER_NEAREST)
    name = source.photo.relative_to(source.root).as_posix()
    stem = source.photo.stem.removesuffix("_rgb")
    beside = (source.photo.with_name(stem + end) for end in ("_normal.png", "_normal.exr", SFD_NORMALS))
    normal = next((p for p in beside if p.is_file()), None)
    upward = normal is not None and normal.name.endswith(SFD_NORMALS)
    load = Labelled(Decoder(source.photo, size, normal=normal, orientation=header.orientation), labels.astype(np.int32), upward)
    if normal is not None:
        notes.append(f"normal priors in {normal.name}")
    notes.append(f"{len(np.unique(labels[labels > 0]))} objects in {source.labels.name}")
    photo = Photo(name, load, *size, camera=camera, focal_hint=header.focal)
    return Capture(source.root, "duplicates", (photo,), notes=tuple(notes), kind="duplicates")


def _camera(file: Path, width: int) -> tuple[np.ndarray, float | None]:
    """(world_from_camera, focal in pixels or None) of the first frame. SfD writes the focal length as text."""
    data = read_json(file)
    frames = data.get("frames")
    first = frames[0] if isinstance(frames, list) and frames and isinstance(frames[0], dict) else {}
    pose = world_from_cv_camera(pose_from(first["transform_matrix"], "the camera", file)) if "transform_matrix" in first else np.eye(4)
    for key in ("focal", "fl_x", "camera_angle_x"):
        value = first.get(key, data.get(key))
        if value is None:
            continue
        try:
            number = float(value)
        except (TypeError, ValueError):
            number = -1.0
        if not 0 < number < 1e6:
            raise UserError(f"'{key}' is no focal length: {value!r}", fix=f"write a number of pixels: {file}")
        if key == "camera_angle_x":
            return pose, width / (2 * np.tan(number / 2))
        given = first.get("w", data.get("w"))  # the size that the focal length is for, where the file tells it
        return pose, number * (width / float(given) if given else 1.0)
    return pose, None


# ---------------------------------------------------------------- labels


def read_labels(source: Path, photo: Path, shape: tuple[int, int]) -> np.ndarray:
    """(H, W) int32 numbers of the objects, 0 for the rest. Raises UserError when the labels do not fit the photo."""
    if source.is_dir():
        return _from_cutouts(source, shape)
    if source.suffix.lower() == ".json":
        return _from_coco(source, photo, shape)
    data = cv2.imread(str(source), cv2.IMREAD_UNCHANGED)
    if data is None:
        raise UserError("the label image cannot be read", "it is damaged or no picture", f"write it again: {source}")
    labels = _numbers(data)
    if labels.shape != shape:
        if abs(labels.shape[1] / labels.shape[0] - shape[1] / shape[0]) > 0.01 * shape[1] / shape[0]:
            raise UserError(
                f"the labels have another shape than the photo: {labels.shape[1]} x {labels.shape[0]} and {shape[1]} x {shape[0]} pixels",
                "they belong to another photo, or one of them was cropped or turned",
                f"make them from this photo: {source}",
            )
        labels = cv2.resize(labels, shape[::-1], interpolation=cv2.INTER_NEAREST)
    return labels


def _numbers(data: np.ndarray) -> np.ndarray:
    """Label numbers of a picture: its grey values, or a number for each colour; black is 0."""
    if data.ndim == 3:
        data = data[..., :3].astype(np.int64)
        grey = (data[..., 0] == data[..., 1]).all() and (data[..., 1] == data[..., 2]).all()
        data = data[..., 0] if grey else data[..., 2] * 65536 + data[..., 1] * 256 + data[..., 0]
    return data.astype(np.int32)


def _from_cutouts(folder: Path, shape: tuple[int, int]) -> np.ndarray:
    labels = np.zeros(shape, np.int32)
    for k, file in enumerate(sorted(folder.glob("*.png")), 1):
        data = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        if data is None or data.ndim != 3 or data.shape[2] != 4 or data.shape[:2] != shape:
            have = (
                "unreadable"
                if data is None
                else f"{data.shape[1]} x {data.shape[0]} pixels, {1 if data.ndim == 2 else data.shape[2]} channels"
            )
            raise UserError(
                f"a cut-out does not fit the photo: {have}; the photo has {shape[1]} x {shape[0]} pixels",
                "where the object stands in the photo would be unknown",
                f"write cut-outs as RGBA at the photo's size, clear off the object: {file}",
            )
        labels[data[..., 3] > 127] = k
    return labels


def _from_coco(file: Path, photo: Path, shape: tuple[int, int]) -> np.ndarray:
    data = read_json(file)
    names = {i.get("id"): i for i in data["images"] if isinstance(i, dict)}
    entry = next((i for i in names.values() if Path(str(i.get("file_name", ""))).name == photo.name), None)
    if entry is None and len(names) == 1:
        entry = next(iter(names.values()))
    if entry is None:
        raise UserError(f"the annotations do not name the photo {photo.name}", fix=f"check `images`: {file}")
    sx, sy = shape[1] / float(entry.get("width", shape[1])), shape[0] / float(entry.get("height", shape[0]))
    labels, k = np.zeros(shape, np.int32), 0
    for a in data["annotations"]:
        if not isinstance(a, dict) or a.get("image_id") != entry.get("id"):
            continue
        k += 1
        s = a.get("segmentation")
        try:
            if isinstance(s, dict):
                mask = _run_lengths(s)
                labels[cv2.resize(mask, shape[::-1], interpolation=cv2.INTER_NEAREST) > 0] = k
            else:
                polygons = [np.round(np.array(p, np.float64).reshape(-1, 2) * (sx, sy)).astype(np.int32) for p in s]
                cv2.fillPoly(labels, polygons, k)
        except (TypeError, ValueError, KeyError, OverflowError, cv2.error) as error:
            raise UserError(f"annotation {k} has no usable segmentation", str(error), f"polygons or run lengths: {file}") from None
    return labels


def _run_lengths(s: dict) -> np.ndarray:
    """A COCO mask (H, W) uint8: column-major runs of 0 and 1 in turn, as numbers or in COCO's compressed text."""
    h, w = (int(x) for x in s["size"])
    if not 0 < h * w <= 1 << 28:
        raise ValueError("the size makes no sense")
    counts = s["counts"]
    if isinstance(counts, str):
        counts = _uncompressed(counts)
    counts = np.asarray(counts, np.int64)
    if (counts < 0).any() or counts.sum() != h * w:
        raise ValueError("the runs do not fill the picture")
    return np.repeat(np.arange(len(counts)) % 2, counts).astype(np.uint8).reshape(w, h).T


def _uncompressed(text: str) -> list[int]:
    """Runs of COCO's text form: six bits a letter, the sixth says that more follow, from the third run on differences."""
    out, i = [], 0
    while i < len(text):
        value, shift, more = 0, 0, True
        while more:
            c = ord(text[i]) - 48
            value |= (c & 31) << shift
            more, i, shift = bool(c & 32), i + 1, shift + 5
            if not more and c & 16:
                value |= -1 << shift
        out.append(value + out[-2] if len(out) > 2 else value)
    return out


def checked_labels(labels: np.ndarray, source: Path) -> tuple[np.ndarray, list[str]]:
    """Labels without objects that are too small, and notes about them. Raises UserError when fewer than one object is left."""
    values, index, areas = np.unique(labels, return_inverse=True, return_counts=True)
    index, notes = index.reshape(labels.shape), []
    objects = values > 0
    if not objects.any():
        raise UserError("the labels hold no object: they are black all over", fix=f"give each object a grey level or colour: {source}")
    large = objects & (areas >= LEAST_SIDE**2 / 4)
    if large.sum() > MOST or (objects.sum() > 3 * MOST and large.sum() == 0):
        raise UserError(
            f"the label image holds {int(objects.sum())} values", "it is a photograph, not labels", f"one value per object: {source}"
        )
    typical = np.median(areas[large]) if large.any() else 0
    keep = large & (areas >= 0.02 * typical)
    boxes = [np.nonzero(index == k) for k in np.flatnonzero(keep)]
    for k, (y, x) in zip(np.flatnonzero(keep), boxes, strict=True):
        if max(np.ptp(x), np.ptp(y)) + 1 < LEAST_SIDE:
            keep[k] = False
    gone = int((objects & ~keep).sum())
    if not keep.any():
        raise UserError(
            f"every object is smaller than {LEAST_SIDE} pixels", "so few pixels carry no pose", f"take a larger photo: {source}"
        )
    if gone:
        notes.append(f"{gone} labels cover less than {LEAST_SIDE} pixels, or next to nothing beside the others, and are left out")
    if keep.sum() == 1:
        notes.append("there is only one object: nothing but its front can be known from one photo")
    border = np.unique(np.concatenate([index[0], index[-1], index[:, 0], index[:, -1]]))
    cut = [int(k) for k in border if keep[k]]
    if cut:
        notes.append(f"{len(cut)} objects are cut by the photo's border")
    out = np.where(objects & ~keep, -1, np.where(keep, values, 0)).astype(np.int32)
    return out[index], notes

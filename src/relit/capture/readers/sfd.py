"""Photos of several identical objects and where each of them is: SfD's folders, photos with label
images, cut-outs, COCO, BOP.

SfD          transforms_train.json and train/000_rgb.png, train/000_instance_seg.png (or
             raw/000_rgb.png, raw/000_instance_seg.png)
labels       NAME_labels.png, NAME_instance_seg.png or NAME_seg.png beside the photo NAME.*: one
             grey level or colour for each object,
             black for the rest
cut-outs     cutouts/*.png beside the photo (of several photos: cutouts/NAME/*.png): RGBA pictures
             of the photo's size, one for each object
COCO         a .json with `images` and `annotations` (polygons or run lengths) beside the photo, above
             its images/, or in annotations/; labelme and VIA likewise (`capture.annotations`)
BOP          a scene's folder: scene_camera.json, scene_gt.json, rgb/ or gray/, mask_visib/ or mask/;
             of several objects the commonest

Several photos with labels in one folder are photos of one pile: nothing stirs between them, and
labels need not agree.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from relit.capture.annotations import annotated_photos, annotations_of, are_masks
from relit.capture.corrections import corrected_labels
from relit.capture.frames import check_max_side, parse_json_file, pose_from
from relit.capture.labels import (
    BOP_TRUTH,
    checked_labels,
    cutouts_in,
    read_labels,
    which_objects,
)
from relit.capture.listing import image_folder, list_images, pictures_in
from relit.capture.names import folded, stem_key
from relit.capture.networks import Network, found_instances
from relit.capture.photo import Decoder
from relit.conventions import world_from_cv_camera
from relit.errors import UserError
from relit.images import EXTENSIONS, Header, read_header, read_image
from relit.scene import Camera, Capture, Photo, Pixels

LOOKED_FOR = "a photo with NAME_labels.png, cut-outs, COCO or BOP labels beside it (SfD)"
SUFFIXES = ("_instance_seg", "_labels", "_instances", "_seg")
SFD_NORMALS = "_normal_pretrain.png"  # SfD's: y up, z towards the camera
BOP_PHOTOS = ("rgb", "gray")  # folders of colour or grey photos
CUTOUTS = ("cutouts", "cut-outs", "instances")
FOCAL_GUESS = 1.2  # of the longer side, where neither the user nor the file tells
MOST_PHOTOS = 12  # of one pile; of more, so many evenly spread


@dataclass(frozen=True)
class Source:
    """What was found: the photo, where its labels are (a label image, a folder of cut-outs, a COCO
    or BOP file), and the file with the cameras. more: (photo, labels) of the other photos of the
    same pile."""

    root: Path
    photo: Path
    labels: Path
    cameras: Path | None = None
    more: tuple[tuple[Path, Path], ...] = ()


@dataclass(frozen=True)
class Labelled:
    """Adds the labels to what `load` returns. labels: (H, W) int32 at the decoded size. upward: the
    file's normals have y up and z towards the camera."""

    load: Callable[[], Pixels]
    labels: np.ndarray
    upward: bool = False

    def __call__(self) -> Pixels:
        pixels = self.load()
        if self.upward and pixels.normal is not None:
            pixels = replace(pixels, normal=pixels.normal * np.array([1, -1, -1], np.float32))
        return replace(pixels, labels=self.labels, mask=(self.labels > 0).astype(np.float32))


def recognise(path: Path) -> Source | None:
    """The photos and their labels, or None where `path` is no photo of duplicates."""
    if path.is_file():
        labels = _labels_of(path) if path.suffix.lower() in EXTENSIONS else None
        return None if labels is None else Source(path.parent, path, labels, _cameras(path.parent))
    if not path.is_dir():
        return None
    if (path / BOP_TRUTH).is_file():
        photos = next((p for n in BOP_PHOTOS if (p := pictures_in(path / n))), [])
        truth = path / BOP_TRUTH
        cameras = path / "scene_camera.json"
        return _source(path, [(f, truth) for f in photos], cameras) if photos else None
    for folder in (path / "train", path / "raw", path):
        photos = [f for f in pictures_in(folder) if _is_photo(f)]
        found = [(f, labels) for f in photos if (labels := _labels_of(f, False)) is not None]
        if not found and folder.is_dir():
            found = annotated_photos(folder)
            found = [] if are_masks(found) else found
        if found:
            return _source(path, found, _cameras(path))
    return None


def read(path: Path, found: Source) -> Source:
    """Labelled photos need the focal length and the size that the user asks for: `open_duplicates`
    reads them."""
    return found


def _source(root: Path, found: list[tuple[Path, Path]], cameras: Path | None) -> Source:
    if len({labels for _, labels in found}) == 1 and found[0][1].is_dir():
        found = found[:1]  # one folder of cut-outs is one photo's
    if len(found) > MOST_PHOTOS:
        found = [found[k] for k in np.linspace(0, len(found) - 1, MOST_PHOTOS).round().astype(int)]
    return Source(root, *found[0], cameras, tuple(found[1:]))


def _is_photo(file: Path) -> bool:
    return file.suffix.lower() in EXTENSIONS and not file.stem.endswith(
        (*SUFFIXES, "_mask", "_normal", "_normal_pretrain", "_depth")
    )


def _cameras(root: Path) -> Path | None:
    return next(
        (root / n for n in ("transforms_train.json", "transforms.json") if (root / n).is_file()),
        None,
    )


def _labels_of(photo: Path, annotated: bool = True) -> Path | None:
    """The labels of a photo. annotated: annotation files count as well."""
    stem = photo.stem.removesuffix("_rgb")
    beside = _by_key(photo.parent, photo.parent.stat().st_mtime_ns)
    for suffix in SUFFIXES:
        for end in (".png", ".tif", ".tiff", ".bmp"):
            if (file := beside.get(folded(f"{stem}{suffix}{end}"))) is not None:
                return file
    for name in CUTOUTS:
        top = beside.get(name)
        for folder in (top / stem, top) if top is not None else ():
            if folder.is_dir() and cutouts_in(folder):
                return folder
    return annotations_of(photo) if annotated else None


@lru_cache(maxsize=8)
def _by_key(folder: Path, changed: int) -> dict[str, Path]:
    """What lies in a folder by its name in one Unicode form and letter case. changed: the folder's
    time of change."""
    return {folded(f.name): f for f in sorted(folder.iterdir())}


def open_duplicates(
    source: Source, *, focal: float | None = None, max_side: int | None = None
) -> Capture:
    """The capture: each photo with its camera and labels. focal: pixels of the photo as stored, or
    None. Raises UserError (exit code 3)."""
    notes: list[str] = []
    photos, objects = [], 0
    for path, labels in ((source.photo, source.labels), *source.more):
        header = read_header(path)
        numbers = read_labels(labels, path, (header.height, header.width))
        if source.more and not numbers.any() and (photos or path != source.more[-1][0]):
            notes.append(f"{path.name} shows no object of {labels.name} and is left out")
            continue
        own, dropped = usable_labels(numbers, labels, source.root, path)
        named = f"{path.name}: " if source.more else ""
        count = len(np.unique(own[own > 0]))
        notes += [named + note for note in (*dropped, f"{count} objects in {labels.name}")]
        objects += count
        photos.append(labelled_photo(source, path, header, own, focal, max_side, notes))
    if (told := which_objects(source.labels, source.photo)) is not None:
        notes.append(told)
    if len(photos) > 1:
        notes.append(f"{len(photos)} photos of one pile: nothing must stir between them")
    return Capture(
        source.root,
        "duplicates",
        tuple(photos),
        notes=tuple(dict.fromkeys(notes)),
        kind="duplicates",
        objects=objects,
    )


def open_segmented(
    path: Path, network: str, *, focal: float | None = None, max_side: int | None = None
) -> Capture:
    """As `open_duplicates` for a photo, or a folder of photos of one pile, whose labels an ONNX
    network finds (`capture.networks`)."""
    check_max_side(max_side)
    files = [path]
    if path.is_dir():
        files = [f for f in list_images(image_folder(path) or path) if _is_photo(f)][:MOST_PHOTOS]
    if not files or not files[0].is_file():
        raise UserError("no photo was found", fix=f"give a photo or a folder of photos: {path}")
    root = path if path.is_dir() else path.parent
    source, notes, photos, objects = (
        Source(root, files[0], Path(network), _cameras(root)),
        [],
        [],
        0,
    )
    segmenter = Network(network)
    for file in files:
        labels, dropped = usable_labels(
            found_instances(segmenter, read_image(file).rgb), file, root, file
        )
        count = len(np.unique(labels[labels > 0]))
        notes += [
            *dropped,
            f"{file.name}: {count} objects found by {Path(network).name}; look at them",
        ]
        objects += count
        photos.append(
            labelled_photo(source, file, read_header(file), labels, focal, max_side, notes)
        )
    return Capture(
        root,
        "duplicates",
        tuple(photos),
        notes=tuple(dict.fromkeys(notes)),
        kind="duplicates",
        objects=objects,
    )


def usable_labels(
    labels: np.ndarray, source: Path, root: Path, photo: Path
) -> tuple[np.ndarray, list[str]]:
    """Labels as `checked_labels` leaves them, corrected by hand where they were
    (`capture.corrections`), and notes about both."""
    own, dropped = checked_labels(labels, source)
    fixed, notes = corrected_labels(own, root, photo.relative_to(root).as_posix())
    if notes:
        own, dropped = checked_labels(np.where(own < 0, labels, fixed), source)
    return own, [*dropped, *notes]


def labelled_photo(
    source: Source,
    path: Path,
    header: Header,
    labels: np.ndarray,
    focal: float | None,
    max_side: int | None,
    notes: list[str],
) -> Photo:
    """One photo with its camera and its labels (H, W); what was assumed goes to `notes`."""
    w, h = header.width, header.height
    pose, known, middle = np.eye(4), None, (w / 2, h / 2)
    if source.cameras is not None and source.cameras.is_file():
        bop = source.cameras.name == "scene_camera.json"
        pose, known, middle = (_bop_camera if bop else _camera)(source.cameras, path, header)
    if focal is None and known is None:
        focal = header.focal
        if focal is None:
            focal = FOCAL_GUESS * max(w, h)
            notes.append(
                f"the focal length is not known; {focal:.0f} pixels are assumed (--focal PIXELS): shapes come out too flat or too deep"
            )
    f = float(focal if focal is not None else known)  # pyright: ignore[reportArgumentType]
    scale = min(1.0, (max_side or max(w, h)) / max(w, h))
    size = (max(1, round(w * scale)), max(1, round(h * scale)))
    camera = Camera(w, h, f, f, *middle, pose).resized(*size)
    labels = labels if scale == 1 else cv2.resize(labels, size, interpolation=cv2.INTER_NEAREST)
    stem = path.stem.removesuffix("_rgb")
    normal = next(
        (
            p
            for end in ("_normal.png", "_normal.exr", SFD_NORMALS)
            if (p := path.with_name(stem + end)).is_file()
        ),
        None,
    )
    upward = normal is not None and normal.name.endswith(SFD_NORMALS)
    load = Labelled(
        Decoder(path, size, normal=normal, orientation=header.orientation),
        labels.astype(np.int32),
        upward,
    )
    if normal is not None:
        notes.append(f"normal priors in {normal.name}")
    return Photo(
        path.relative_to(source.root).as_posix(),
        load,
        *size,
        camera=camera,
        focal_hint=header.focal,
    )


def _upright_camera(
    pose: np.ndarray, middle: tuple[float, float], header: Header
) -> tuple[np.ndarray, tuple[float, float]]:
    """World_from_camera and principal point of the upright picture from those of the pixels as
    stored. Mirrored pictures are left as they are."""
    (w, h), (x, y) = header.as_stored, middle
    axes = np.eye(4)
    if header.orientation == 3:
        axes[:2, :2], middle = [[-1, 0], [0, -1]], (w - x, h - y)
    elif header.orientation == 6:
        axes[:2, :2], middle = [[0, 1], [-1, 0]], (h - y, x)
    elif header.orientation == 8:
        axes[:2, :2], middle = [[0, -1], [1, 0]], (y, w - x)
    return pose @ axes, middle


def _camera(
    file: Path, photo: Path, header: Header
) -> tuple[np.ndarray, float | None, tuple[float, float]]:
    """(world_from_camera, focal in pixels or None, principal point) of the photo's frame, upright;
    of several frames none is taken for another one's. SfD writes the focal length as text."""
    data = parse_json_file(file)
    frames = (
        [f for f in data.get("frames") or [] if isinstance(f, dict)]
        if isinstance(data.get("frames"), list)
        else []
    )
    stem = stem_key(photo.name).removesuffix("_rgb")
    frame = next(
        (f for f in frames if stem_key(str(f.get("file_path", ""))).removesuffix("_rgb") == stem),
        frames[0] if len(frames) == 1 else {},
    )
    pose = (
        world_from_cv_camera(pose_from(frame["transform_matrix"], "the camera", file))
        if "transform_matrix" in frame
        else np.eye(4)
    )

    def number(key: str) -> float | None:
        value = frame.get(key, data.get(key))
        if value is None:
            return None
        try:
            out = float(value)
        except (TypeError, ValueError, OverflowError):
            out = -1.0
        if not 0 < out < 1e6:
            raise UserError(
                f"'{key}' is no focal length, size or principal point: {value!r}",
                fix=f"write a number of pixels: {file}",
            )
        return out

    given = number("w"), number("h")
    width, height = header.as_stored
    lying = header.turned and None not in given and given[0] / given[1] * header.height  # pyright: ignore[reportOperatorIssue, reportOptionalOperand]
    upright = (
        bool(lying) and abs(lying / header.width - 1) < 0.02
    )  # the size is that of the upright
    if upright:
        width, height = header.width, header.height
    sx, sy = (
        size / told if told else 1.0 for told, size in zip(given, (width, height), strict=True)
    )
    cx, cy = number("cx"), number("cy")
    middle = (width / 2 if cx is None else cx * sx, height / 2 if cy is None else cy * sy)
    if not upright:
        pose, middle = _upright_camera(pose, middle, header)
    for key in ("focal", "fl_x", "camera_angle_x"):
        value = number(key)
        if value is not None:
            wide = width / (2 * np.tan(value / 2)) if key == "camera_angle_x" else value * sx
            return pose, wide, middle
    return pose, None, middle


def _bop_camera(
    file: Path, photo: Path, header: Header
) -> tuple[np.ndarray, float | None, tuple[float, float]]:
    """As `_camera`, from BOP's cam_K; the world is the camera's frame (millimetres do not
    matter)."""
    try:
        k = np.array(parse_json_file(file)[str(int(photo.stem))]["cam_K"], np.float64).reshape(3, 3)
        if not (np.isfinite(k).all() and k[0, 0] > 0):
            raise ValueError("cam_K makes no sense")
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise UserError(
            "scene_camera.json is not as BOP writes it",
            f"{type(error).__name__}: {error}",
            f"see: {file}",
        ) from None
    # BOP counts pixel centres as whole numbers
    middle = (float(k[0, 2]) + 0.5, float(k[1, 2]) + 0.5)
    pose, middle = _upright_camera(np.eye(4), middle, header)
    return pose, float((k[0, 0] + k[1, 1]) / 2), middle

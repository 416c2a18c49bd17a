"""From a file to a `Photo` that decodes when it is asked: upright, linear, masked, resized,
undistorted."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from relit.capture.annotations import annotated_photos, are_masks, outline_mask
from relit.capture.frames import Frame, Reading
from relit.capture.listing import (
    IMAGE_FOLDERS,
    camera_traces,
    image_folder,
    image_folders,
    is_mask_folder,
    list_images,
    listed,
)
from relit.capture.names import files_below, is_hidden
from relit.errors import UserError
from relit.geometry.lens import Lens, lens_of, undistorted_camera, undistortion_map
from relit.images import EXTENSIONS, Header, read_data, read_header, read_image, turn_upright
from relit.masks.files import read_mask
from relit.masks.rle import Runs
from relit.masks.threshold import Backdrop
from relit.scene import Camera, Photo, Pixels

NORMAL_FOLDERS = ("normals", "normal")
SAME_SHAPE = 0.02  # largest relative difference of width / height between a camera and its photo
MOST_ROUNDING = 2.0  # pixels by which rounding changes a side of a resized copy


@dataclass(frozen=True)
class Decoder:
    """Reads one photo file. Called without arguments it returns the upright `Pixels` at `size`
    (width, height), lens distortion kept.

    mask: a file, run lengths, a backdrop, True for the file's own alpha channel, or None. invert:
    the mask file is white off the object.
    orientation: the photo's in EXIF, for masks that were made from the pixels as stored.
    turn_mask: apply it to the mask though its shape is that of the photo.
    """

    path: Path
    size: tuple[int, int]
    upright: bool = True
    mask: Path | Runs | Backdrop | bool | None = None
    invert: bool = False
    normal: Path | None = None
    orientation: int = 1
    turn_mask: bool = False

    def __call__(self) -> Pixels:
        image = read_image(self.path, self.upright)
        rgb, clipped = image.rgb, image.clipped
        shape = rgb.shape[:2]
        mask = None
        if self.mask is True:
            mask = image.alpha
        elif isinstance(self.mask, Path):
            mask = file_mask(self.mask, shape, self.invert, self.orientation)
            mask = turn_upright(mask, self.orientation) if self.turn_mask else mask
        elif isinstance(self.mask, Runs):
            mask = fitted_mask(
                self.mask.decode(), shape, self.orientation, f"the runs of '{self.mask.name}'"
            )
        elif isinstance(self.mask, Backdrop):
            mask = self.mask(rgb)
            if self.mask.dark:
                rgb = rgb * mask[..., None]
        normal = None if self.normal is None else read_normal(self.normal, shape)
        w, h = self.size
        if (h, w) != shape:
            rgb = cv2.resize(rgb, (w, h), interpolation=cv2.INTER_AREA)
            mask = None if mask is None else cv2.resize(mask, (w, h), interpolation=cv2.INTER_AREA)
            clipped = (
                None
                if clipped is None
                else cv2.resize(clipped.astype(np.float32), (w, h), interpolation=cv2.INTER_AREA)
                > 0
            )
            normal = (
                None
                if normal is None
                else _unit_normals(cv2.resize(normal, (w, h), interpolation=cv2.INTER_AREA))
            )
        return Pixels(rgb, mask, normal, clipped)


@dataclass(frozen=True)
class Undistorted:
    """Takes the lens distortion out of what `load` returns."""

    load: Callable[[], Pixels]
    camera: Camera
    lens: Lens
    ideal: Camera

    def __call__(self) -> Pixels:
        pixels = self.load()
        x, y = _cached_map(_Key(self.camera, self.lens, self.ideal))

        def warp(a, flag=cv2.INTER_LINEAR):
            return None if a is None else cv2.remap(a, x, y, flag, borderMode=cv2.BORDER_REPLICATE)

        clipped = None if pixels.clipped is None else warp(pixels.clipped.astype(np.float32)) > 0
        normal = None if pixels.normal is None else _unit_normals(warp(pixels.normal))  # pyright: ignore[reportArgumentType]
        return Pixels(warp(pixels.rgb), warp(pixels.mask), normal, clipped, white=pixels.white)  # pyright: ignore[reportArgumentType]

    @property
    def mask(self) -> Any:
        """Where the mask comes from, as `load` knows it."""
        return getattr(self.load, "mask", None)


@dataclass(frozen=True)
class Masked:
    """Lays a stored mask (bits packed) over what `load` returns."""

    load: Callable[[], Pixels]
    bits: bytes
    shape: tuple[int, int]

    def __call__(self) -> Pixels:
        h, w = self.shape
        mask = (
            np.unpackbits(np.frombuffer(self.bits, np.uint8), count=h * w)
            .reshape(h, w)
            .astype(np.float32)
        )
        return replace(self.load(), mask=mask)


def layers(load: Callable[[], Pixels]) -> Iterator[Callable[[], Pixels]]:
    """What a photo is loaded by and all that this wraps: the last one, a `Decoder`, reads the
    file."""
    while load is not None:
        yield load
        load = getattr(load, "load", None)  # pyright: ignore[reportAssignmentType]


def with_mask(photo: Photo, mask: np.ndarray) -> Photo:
    """The photo with another mask (H, W), kept in memory at one bit a pixel."""
    return replace(photo, load=Masked(photo.load, np.packbits(mask > 0.5).tobytes(), mask.shape))


class _Key:
    """Cache key: cameras that differ only in pose share their undistortion map."""

    def __init__(self, camera: Camera, lens: Lens, ideal: Camera):
        self.parts = (camera, lens, ideal)
        self.values = (
            lens,
            *((c.width, c.height, c.fx, c.fy, c.cx, c.cy, c.distortion) for c in (camera, ideal)),
        )

    def __hash__(self) -> int:
        return hash(self.values)

    def __eq__(self, other) -> bool:
        return isinstance(other, _Key) and self.values == other.values


@lru_cache(maxsize=4)
def _cached_map(key: _Key) -> tuple[np.ndarray, np.ndarray]:
    return undistortion_map(*key.parts)


def with_camera(photo: Photo, camera: Camera, lens: Lens | None = None) -> Photo:
    """Give a photo (as decoded, distortion in it) its camera, in pixels of any size of the same
    shape; undistort it if need be."""
    camera = (
        camera.resized(photo.width, photo.height)
        if (camera.width, camera.height) != (photo.width, photo.height)
        else camera
    )
    lens = lens or lens_of(camera)
    ideal = undistorted_camera(camera, lens)
    if lens is None:
        return replace(photo, camera=ideal)
    return replace(
        photo,
        camera=ideal,
        width=ideal.width,
        height=ideal.height,
        load=Undistorted(photo.load, camera, lens, ideal),
    )


def photo_from(
    frame: Frame, header: Header, max_side: int | None, normals: dict[str, Path] | None = None
) -> Photo:
    """A `Photo` without camera or mask. Raises UserError when camera and file have different
    shapes."""
    upright = is_upright(frame, header)
    w, h = (header.width, header.height) if upright else header.as_stored
    if max_side is not None and max(w, h) > max_side:
        s = max_side / max(w, h)
        size = (max(1, round(w * s)), max(1, round(h * s)))
    else:
        size = (w, h)
    focal = None if header.focal is None else header.focal * size[0] / w
    normal = find_normal(frame.path, normals or {})
    # of a photo that is left as stored, a mask of the other shape was made from the upright picture
    # and is turned back
    orientation = (
        header.orientation if upright else {6: 8, 8: 6}.get(header.orientation, header.orientation)
    )
    decoder = Decoder(frame.path, size, upright, normal=normal, orientation=orientation)
    return Photo(frame.name, decoder, *size, focal_hint=focal, flash_energy=frame.flash_energy)


def is_upright(frame: Frame, header: Header) -> bool:
    """Whether EXIF's orientation is applied to a photo: always where it has no camera. The formats
    of known cameras mean the pixels as stored (COLMAP, nerfstudio and instant-ngp read them so);
    the upright picture is meant where only its shape is the camera's. Raises UserError when camera
    and photo have different shapes."""
    camera = frame.camera
    if camera is None:
        return True
    shape = camera.width / camera.height
    w, h = header.as_stored
    if abs(shape - w / h) <= SAME_SHAPE * (w / h):
        return header.orientation == 1
    if header.turned and abs(shape - h / w) <= SAME_SHAPE * (h / w):
        return True
    raise UserError(
        f"camera and photo have different shapes: {camera.width} x {camera.height} and {w} x {h} "
        f"pixels ('{frame.name}')",
        "the photo was cropped, turned or undistorted after the cameras were found, or one set of "
        "intrinsics is used for photos of mixed sizes",
        f"use the photos that the cameras were made for: {frame.path}",
    )


def camera_notes(frames: tuple[Frame, ...], headers: list[Header]) -> list[str]:
    """Notes on photos with cameras: whose EXIF orientation is not applied, and whose size is that
    of no resized copy of the calibrated picture (a crop, or a picture undistorted since)."""
    kept, odd = [], []
    for frame, header in zip(frames, headers, strict=True):
        if frame.camera is None:
            continue
        upright = is_upright(frame, header)
        if header.orientation != 1 and not upright:
            kept.append(frame.name)
        w, h = (header.width, header.height) if upright else header.as_stored
        off = abs(w - h * frame.camera.width / frame.camera.height)
        if off > MOST_ROUNDING * max(1.0, w / h):
            odd.append((frame, w, h))
    notes = []
    if kept:
        notes.append(
            f"{len(kept)} photos carry an EXIF orientation that is not applied, for example "
            f"{kept[0]}: the cameras belong to the pixels as stored"
        )
    if odd:
        frame, w, h = odd[0]
        notes.append(
            f"{len(odd)} photos have not quite the shape of their camera, for example {frame.name} "
            f"with {w} x {h} beside {frame.camera.width} x {frame.camera.height} pixels: they may "
            "be cropped or undistorted copies, to which these cameras do not belong"
        )
    return notes


# ---------------------------------------------------------------- masks and normals from files


def file_mask(
    path: Path, shape: tuple[int, int], invert: bool = False, orientation: int = 1
) -> np.ndarray:
    """A mask file at the size of its photo (H, W). Raises UserError when the shapes differ."""
    mask = fitted_mask(read_mask(path), shape, orientation, path)
    return 1.0 - mask if invert else mask


def fitted_mask(
    mask: np.ndarray, shape: tuple[int, int], orientation: int, source: Path | str
) -> np.ndarray:
    """A mask (H', W') at the size of its photo, upright, float32. Raises UserError when the shapes
    differ."""
    mask = upright_mask(mask, shape, orientation)
    h, w = shape
    if mask.shape != (h, w):
        if abs(mask.shape[1] / mask.shape[0] - w / h) > 0.02 * (w / h):
            raise UserError(
                f"a mask and its photo have different shapes: {mask.shape[1]} x {mask.shape[0]} and {w} x {h} pixels",
                "the mask belongs to another photo, or one of them was turned",
                f"make it again from the photo: {source}",
            )
        mask = cv2.resize(
            mask, (w, h), interpolation=cv2.INTER_AREA if mask.shape[0] > h else cv2.INTER_LINEAR
        )
    return np.ascontiguousarray(mask, dtype=np.float32)


def index_normals(root: Path) -> dict[str, Path]:
    """Normal priors in normals/ by stem."""
    for name in NORMAL_FOLDERS:
        folder = root / name
        if folder.is_dir():
            return {
                f.stem.removesuffix("_normal"): f
                for f in files_below(folder)
                if f.suffix.lower() in EXTENSIONS
            }
    return {}


def find_normal(photo: Path, index: dict[str, Path]) -> Path | None:
    """The normal prior of a photo: STEM_normal.png or .exr beside it, or the same stem in the
    folder that was indexed."""
    for suffix in (".png", ".exr"):
        beside = photo.parent / f"{photo.stem}_normal{suffix}"
        if beside.is_file():
            return beside
    return index.get(photo.stem)


def upright_mask(mask: np.ndarray, shape: tuple[int, int], orientation: int) -> np.ndarray:
    """Turn a mask that was made from the pixels as stored, before EXIF turned the photo; its shape
    (H, W) tells."""
    wide, upright = mask.shape[1] > mask.shape[0], shape[1] > shape[0]
    return turn_upright(mask, orientation) if orientation >= 5 and wide != upright else mask


def read_normal(path: Path, shape: tuple[int, int]) -> np.ndarray:
    """(H, W, 3) unit normals in OpenCV camera axes, 0 where unknown: a picture maps [-1, 1] to [0,
    1], an EXR holds them as they are.

    Unknown is what is far from unit length: black and middle grey of a picture, zero of an EXR.
    """
    data = read_data(path)
    if data.ndim != 3 or data.shape[2] < 3:
        raise UserError(
            "a normal prior has no three channels", fix=f"write x, y, z as red, green, blue: {path}"
        )
    picture = path.suffix.lower() != ".exr"
    normal = data[..., :3] * 2 - 1 if picture else data[..., :3]
    length = np.linalg.norm(normal, axis=-1)
    known = (length > 0.5) & (length < 1.5) if picture else length > 0.1
    normal = _unit_normals(normal) * known[..., None]
    if normal.shape[:2] != shape:
        normal = _unit_normals(
            cv2.resize(np.ascontiguousarray(normal), shape[::-1], interpolation=cv2.INTER_LINEAR)
        )
    return normal.astype(np.float32)


def _unit_normals(normal: np.ndarray) -> np.ndarray:
    return (normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)).astype(
        np.float32
    )


# ---------------------------------------------------------------- the plain folder

LOOKED_FOR = "photos in the folder itself or in images/, image/, rgb/, input/ or photos/"


def recognise(path: Path) -> Path | None:
    """The folder with the photos, or None: an images/ whose photos lie in sub-folders, one for
    each ring or camera, as well."""
    if not path.is_dir():
        return None
    inside = [d for d in image_folders(path) if d != path and in_rings(d)]
    return image_folder(path) or next(iter(inside), None)


def in_rings(folder: Path) -> list[Path]:
    """The photos of all sub-folders of an images/, sorted; none for a folder of another name."""
    if folder.name.lower() not in IMAGE_FOLDERS:
        return []
    inside = sorted(d for d in folder.iterdir() if d.is_dir() and not is_hidden(d))
    return [f for d in inside if not is_mask_folder(d) for f in list_images(d)]


def read(path: Path, found: Path) -> Reading:
    """All photos of a folder, without cameras; one file of each (`capture.listing`)."""
    listing = listed(found, duplicates=True)
    files = listing.photos or tuple(in_rings(found))
    annotated = annotated_photos(path)
    outlines = dict(annotated) if are_masks(annotated) else {}
    frames = tuple(
        Frame(
            f,
            f.relative_to(path).as_posix(),
            mask=listing.masks.get(f),
            runs=outline_mask(outlines[f], f) if f in outlines else None,
        )
        for f in files
    )
    return Reading("photos", path, frames, notes=(*listing.notes, *camera_traces(path)))


def headers_of(frames: tuple[Frame, ...]) -> list[Header]:
    """Headers of all files; the first damaged one raises UserError."""
    return [read_header(f.path) for f in frames]

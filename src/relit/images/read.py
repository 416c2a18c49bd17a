"""Reading pictures to linear float32."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from PIL import Image as PilImage

from relit.conventions import linear_from_srgb
from relit.errors import UserError
from relit.images.decode import (
    FLOAT,
    RAW,
    broken,
    checked,
    decode,
    early_exif,
    exr,
    float_tiff,
    hdr_size,
    orientation_of,
    pil,
    raw_file,
    stored_size,
    turn_upright,
)
from relit.images.profiles import profile_of, rgb_of
from relit.images.write import codes_of

FULL_FRAME_DIAGONAL = (
    43.2666  # mm, of the 36 x 24 mm film that "35 mm equivalent" focal lengths refer to
)


@dataclass(frozen=True)
class Image:
    """A decoded picture, turned upright.

    rgb: (H, W, 3) float32 linear Rec.709; composited on black (premultiplied) where the file has an
    alpha channel.
    alpha: (H, W) float32 in [0, 1], or None. clipped: (H, W) bool, True where a code value is
    saturated; None for float formats.
    """

    rgb: np.ndarray
    alpha: np.ndarray | None = None
    clipped: np.ndarray | None = None


@dataclass(frozen=True)
class Header:
    """What a file says before it is decoded.

    width, height: pixels, upright. alpha: has an alpha channel. focal: EXIF focal length in pixels,
    or None.
    orientation: EXIF's, 1 to 8; from 5 on the sides of the stored picture are swapped.
    """

    width: int
    height: int
    alpha: bool = False
    focal: float | None = None
    orientation: int = 1

    @property
    def turned(self) -> bool:
        return self.orientation >= 5

    @property
    def as_stored(self) -> tuple[int, int]:
        """Width and height of the pixels as stored, before EXIF turns them."""
        return (self.height, self.width) if self.turned else (self.width, self.height)


def read_image(path: str | Path, upright: bool = True) -> Image:
    """Decode a photo to linear float32, EXIF orientation applied once (or not at all with
    upright=False).

    8/16-bit PNG, JPEG, WebP, AVIF, TIFF (by their colour profile, else the sRGB curve is removed),
    EXR, HDR and TIFF of floats (linear already), HEIC and RAW with the
    optional extras.
    Raises UserError for a missing, truncated, oversized or unknown file and for NaN or infinite
    pixels.
    """
    path = Path(path)
    decoded = decode(path, upright)
    array, is_linear = decoded.codes, decoded.linear
    alpha, clipped = None, None
    if array.ndim == 2:
        array = array[..., None]
    if array.shape[2] in (2, 4):
        alpha = _unit(array[..., -1])
        array = array[..., :-1]
    if array.dtype.kind == "u":
        clipped = (array == np.iinfo(array.dtype).max).any(axis=-1)
    array = np.repeat(array, 3, axis=2) if array.shape[2] == 1 else array[..., :3]
    if decoded.profile is not None:
        rgb = decoded.profile.linear(_unit(array))
    elif array.dtype.kind == "u" and not is_linear:
        rgb = _code_table(array.dtype.str)[
            array
        ]  # one look-up instead of a dozen arrays of the photo's size
    else:
        rgb = _unit(array) if array.dtype.kind == "u" else array.astype(np.float32)
        rgb = rgb if is_linear else linear_from_srgb(rgb)
    if not is_linear and alpha is not None:  # coded formats store straight alpha, EXR premultiplied
        rgb *= alpha[..., None]
    return Image(np.ascontiguousarray(rgb), alpha, clipped)


def read_small(path: str | Path, side: int = 256, upright: bool = True) -> Image:
    """A small version of `read_image` (longest side about `side` pixels) for looking at many photos
    quickly; linear, upright.

    JPEG files are decoded at reduced size. Alpha is kept apart: rgb is NOT composited. `clipped` is
    None.
    """
    path = Path(path)
    suffix = checked(path)
    if suffix in FLOAT | RAW or (suffix in (".tif", ".tiff") and _is_float(path)):
        image = read_image(path, upright)
        h, w = image.rgb.shape[:2]
        size = (
            (max(1, round(w * side / max(w, h))), max(1, round(h * side / max(w, h))))
            if max(w, h) > side
            else (w, h)
        )
        alpha = (
            None
            if image.alpha is None
            else cv2.resize(image.alpha, size, interpolation=cv2.INTER_AREA)
        )
        return Image(cv2.resize(image.rgb, size, interpolation=cv2.INTER_AREA), alpha)
    with pil(path) as image:
        try:
            orientation = orientation_of(image) if upright else 1
            image.draft("RGB", (side, side))
            has_alpha = image.mode in ("RGBA", "LA", "PA") or "transparency" in image.info
            profile = profile_of(image, early_exif(image))
            if image.mode.startswith("I") or image.format == "TIFF":
                image = PilImage.fromarray(codes_of(_unit(decode(path, upright=False).codes)))
            small = rgb_of(image).convert("RGBA" if has_alpha else "RGB")
            small = (
                small.reduce(max(1, max(small.size) // side))
                if max(small.size) >= 2 * side
                else small
            )
            array = turn_upright(_unit(np.array(small)), orientation)
        except (OSError, SyntaxError, ValueError, EOFError, struct.error) as error:
            raise broken(path, str(error)) from error
    rgb = array[..., :3]
    linear = linear_from_srgb(rgb) if profile is None else profile.linear(rgb)
    return Image(linear, array[..., 3] if has_alpha else None)


def _is_float(path: Path) -> bool:
    """Is it a TIFF of floats?"""
    if float_tiff(path) is not None:
        return True
    with pil(path) as image:
        return image.mode == "F"


def read_data(path: str | Path) -> np.ndarray:
    """Decode without a transfer curve: (H, W) or (H, W, C) float32; 8/16-bit codes divided by their
    largest value. No alpha handling."""
    array = decode(Path(path)).codes
    array = _unit(array) if array.dtype.kind == "u" else array.astype(np.float32)
    return array[..., 0] if array.ndim == 3 and array.shape[2] == 1 else array


def read_header(path: str | Path) -> Header:
    """Size, alpha and EXIF focal length without decoding the pixels. Raises UserError as
    `read_image` does."""
    path = Path(path)
    suffix = checked(path)
    if suffix == ".exr":
        channels, shape = exr(path, header_only=True)
        return Header(shape[1], shape[0], any(c.split(".")[-1] == "A" for c in channels))  # pyright: ignore[reportAttributeAccessIssue]
    if suffix == ".hdr":
        w, h = hdr_size(path)
        return Header(w, h)
    if suffix in RAW:
        with raw_file(path) as raw:
            orientation = {3: 3, 5: 8, 6: 6}.get(raw.sizes.flip, 1)  # LibRaw's flip -> EXIF
            w, h = raw.sizes.width, raw.sizes.height
        w, h = (h, w) if orientation >= 5 else (w, h)
        return Header(w, h, False, _raw_focal(path, w, h), orientation)
    floats = float_tiff(path)
    if floats is not None:
        w, h = (
            (floats.height, floats.width)
            if floats.orientation >= 5
            else (floats.width, floats.height)
        )
        return Header(w, h, floats.alpha, None, floats.orientation)
    with pil(path) as image:
        w, h = stored_size(image)
        orientation, exif = orientation_of(image), early_exif(image)
        w, h = (h, w) if orientation >= 5 else (w, h)
        has_alpha = image.mode in ("RGBA", "LA", "PA") or "transparency" in image.info
        return Header(w, h, has_alpha, _focal(exif, w, h), orientation)


def _focal(exif, width: int, height: int) -> float | None:
    """Focal length in pixels from EXIF: the 35 mm equivalent (defined on the diagonal), else
    millimetres and focal-plane resolution."""
    try:
        ifd = exif.get_ifd(0x8769)
        if float(ifd.get(0xA405, 0)) > 0:
            return float(ifd[0xA405]) * float(np.hypot(width, height)) / FULL_FRAME_DIAGONAL
        resolution, unit = (
            float(ifd.get(0xA20E, 0)),
            {2: 25.4, 3: 10.0, 4: 1.0}.get(int(ifd.get(0xA210, 2)), 25.4),
        )
        focal = float(ifd.get(0x920A, 0)) * resolution / unit
        return focal if focal > 0 and np.isfinite(focal) else None
    except (ValueError, TypeError, ZeroDivisionError, KeyError, OSError, SyntaxError):
        return None  # EXIF is a hint: a broken block is no reason to refuse the photo


def _raw_focal(path: Path, width: int, height: int) -> float | None:
    """EXIF focal length in pixels of a RAW file; most are TIFF files, in which Pillow finds it."""
    try:
        with pil(path) as image:
            return _focal(image.getexif(), width, height)
    except UserError:
        return None


@lru_cache(maxsize=2)
def _code_table(dtype: str) -> np.ndarray:
    """Linear value (float32) of each 8- or 16-bit sRGB code."""
    return linear_from_srgb(_unit(np.arange(np.iinfo(dtype).max + 1, dtype=dtype)))


def _unit(codes: np.ndarray) -> np.ndarray:
    """uint8 / uint16 codes -> float32 in [0, 1]; floats are clipped to it."""
    if codes.dtype.kind == "u":
        return codes.astype(np.float32) / np.float32(np.iinfo(codes.dtype).max)
    return np.clip(codes.astype(np.float32), 0.0, 1.0)

"""Downscaled copies of some photos of a capture, decoded once for all preflight checks."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from relit.errors import UserError
from relit.images import read_small
from relit.images.decode import CODED, HEIC, pil
from relit.scene import Camera, Capture, Photo

MOST = 24  # photos to decode
SIDE = 512  # pixels, longest side


@dataclass(frozen=True)
class Exif:
    """EXIF data. camera: maker and model. exposure: seconds. fnumber, iso: as recorded. flash:
    whether it fired. None: not recorded."""

    camera: str | None = None
    exposure: float | None = None
    fnumber: float | None = None
    iso: float | None = None
    flash: bool | None = None

    @property
    def ev(self) -> float | None:
        """log2 of exposure * ISO / fnumber^2, or None when one of them is unknown."""
        if not self.exposure or not self.fnumber or not self.iso:
            return None
        return float(np.log2(self.exposure * self.iso / self.fnumber**2))


@dataclass(frozen=True)
class Look:
    """One photo at SIDE pixels or less. rgb: (h, w, 3) linear. mask: (h, w) or None. camera: for
    this size, or None. sharpness: of the full-size photo, see `sharpness`. opaque: False where the
    file has an alpha channel, so that colours outside the object are meaningless."""

    name: str
    rgb: np.ndarray
    mask: np.ndarray | None
    camera: Camera | None
    sharpness: float
    opaque: bool
    exif: Exif

    @property
    def gray(self) -> np.ndarray:
        """(h, w) luminance."""
        return self.rgb @ np.array([0.2126, 0.7152, 0.0722], np.float32)


def look_at_photos(capture: Capture, most: int = MOST) -> list[Look]:
    """At most `most` photos, evenly spaced in order of name."""
    chosen = np.unique(
        np.linspace(0, len(capture.photos) - 1, min(most, len(capture.photos))).round().astype(int)
    )
    return [look(capture, capture.photos[i]) for i in chosen]


def look(capture: Capture, photo: Photo) -> Look:
    pixels = photo.load()
    h, w = pixels.rgb.shape[:2]
    s = min(1.0, SIDE / max(h, w))
    size = (max(1, round(w * s)), max(1, round(h * s)))
    rgb = cv2.resize(np.ascontiguousarray(pixels.rgb), size, interpolation=cv2.INTER_AREA)
    mask = pixels.mask
    if mask is not None:
        mask = cv2.resize(np.ascontiguousarray(mask), size, interpolation=cv2.INTER_AREA)
    camera = None if photo.camera is None else photo.camera.resized(*size)
    path = capture.folder / photo.name
    return Look(
        photo.name,
        rgb,
        mask,
        camera,
        sharpness(pixels.rgb, pixels.mask),
        _opaque(path),
        read_exif(path),
    )


def sharpness(rgb: np.ndarray, mask: np.ndarray | None) -> float:
    """Contrast of the finest detail over that of detail four times as coarse, inside the mask where
    there is one. Blur reduces the first and keeps the second, independent of content."""
    gray = np.sqrt(np.maximum(rgb @ np.array([0.2126, 0.7152, 0.0722], np.float32), 0))
    inside = (
        np.ones(gray.shape, bool)
        if mask is None
        else cv2.erode((mask > 0.5).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    )
    if inside.sum() < 100:
        inside = np.ones(gray.shape, bool)
    bands = []
    for sigma in (0.7, 2.8):
        band = cv2.GaussianBlur(gray, (0, 0), sigma) - cv2.GaussianBlur(gray, (0, 0), 2 * sigma)
        bands.append(float(np.sqrt(np.mean(band[inside] ** 2))))
    return bands[0] / max(bands[1], 1e-6)


def _opaque(path: Path) -> bool:
    try:
        return read_small(path, 16).alpha is None
    except UserError:
        return True


def read_exif(path: Path) -> Exif:
    """EXIF data of a file; empty where it is missing or damaged."""
    if (
        path.suffix.lower() not in CODED | HEIC
        or path.suffix.lower() == ".png"
        or not path.is_file()
    ):
        return Exif()
    try:
        with pil(path) as image:
            exif = image.getexif()
            more = exif.get_ifd(0x8769)
            name = " ".join(str(exif.get(tag, "")).strip("\0 ") for tag in (0x010F, 0x0110)).strip()
            flash = more.get(0x9209)
            iso = more.get(0x8827)
            iso = iso[0] if isinstance(iso, (tuple, list)) and iso else iso
            return Exif(
                name or None,
                _number(more.get(0x829A)),
                _number(more.get(0x829D)),
                _number(iso),
                None if flash is None else bool(int(flash) & 1),
            )
    except (UserError, OSError, ValueError, TypeError, ZeroDivisionError, SyntaxError, KeyError):
        return Exif()


def _number(value) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if np.isfinite(number) and number > 0 else None

"""Reading and writing pictures. Everything inside Relit is linear float32; the transfer curve is applied here and nowhere else."""

from __future__ import annotations

import errno
import io
import os
import struct
import tempfile
import warnings
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image as PilImage
from PIL import ImageOps, UnidentifiedImageError

from relit.conventions import linear_from_srgb, srgb_from_linear
from relit.errors import EXIT_ENVIRONMENT, UserError

MAX_PIXELS = 200_000_000  # larger files are refused before they are decoded
HEIC = {".heic", ".heif"}
RAW = {".dng", ".nef", ".cr2", ".cr3", ".arw", ".orf", ".rw2", ".raf"}
FLOAT = {".exr", ".hdr"}
CODED = {".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff"}
EXTENSIONS = CODED | FLOAT | HEIC | RAW
FULL_FRAME_DIAGONAL = 43.2666  # mm, of the 36 x 24 mm film that "35 mm equivalent" focal lengths refer to


@dataclass(frozen=True)
class Image:
    """A decoded picture, turned upright.

    rgb: (H, W, 3) float32 linear Rec.709; composited on black (premultiplied) where the file has an alpha channel.
    alpha: (H, W) float32 in [0, 1], or None. clipped: (H, W) bool, True where a code value is saturated; None for float formats.
    """

    rgb: np.ndarray
    alpha: np.ndarray | None = None
    clipped: np.ndarray | None = None


@dataclass(frozen=True)
class Header:
    """What a file says before it is decoded.

    width, height: pixels, upright. alpha: has an alpha channel. focal: EXIF focal length in pixels, or None.
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


# ---------------------------------------------------------------- reading


def read_image(path: str | Path, upright: bool = True) -> Image:
    """Decode a photo to linear float32, EXIF orientation applied once (or not at all with upright=False).

    8/16-bit PNG, JPEG, WebP, TIFF (sRGB curve removed), EXR and HDR (linear already), HEIC and RAW with the optional extras.
    Raises UserError for a missing, truncated, oversized or unknown file and for NaN or infinite pixels.
    """
    path = Path(path)
    array, is_linear = _decode(path, upright)
    alpha, clipped = None, None
    if array.ndim == 2:
        array = array[..., None]
    if array.shape[2] in (2, 4):
        alpha = _unit(array[..., -1])
        array = array[..., :-1]
    if array.dtype.kind == "u":
        clipped = (array == np.iinfo(array.dtype).max).any(axis=-1)
    rgb = _unit(array) if array.dtype.kind == "u" else array.astype(np.float32)
    rgb = np.repeat(rgb, 3, axis=2) if rgb.shape[2] == 1 else rgb[..., :3]
    if not is_linear:
        rgb = linear_from_srgb(rgb)
        if alpha is not None:  # coded formats store straight alpha, EXR premultiplied
            rgb = rgb * alpha[..., None]
    return Image(np.ascontiguousarray(rgb), alpha, clipped)


def read_small(path: str | Path, side: int = 256, upright: bool = True) -> Image:
    """A small version of `read_image` (longest side about `side` pixels) for looking at many photos quickly; linear, upright.

    JPEG files are decoded at reduced size. Alpha is kept apart: rgb is NOT composited. `clipped` is None.
    """
    import cv2

    path = Path(path)
    suffix = _checked(path)
    if suffix in FLOAT | RAW:
        image = read_image(path, upright)
        h, w = image.rgb.shape[:2]
        size = (max(1, round(w * side / max(w, h))), max(1, round(h * side / max(w, h)))) if max(w, h) > side else (w, h)
        alpha = None if image.alpha is None else cv2.resize(image.alpha, size, interpolation=cv2.INTER_AREA)
        return Image(cv2.resize(image.rgb, size, interpolation=cv2.INTER_AREA), alpha)
    with _pil(path) as image:
        try:
            image.draft("RGB", (side, side))
            has_alpha = image.mode in ("RGBA", "LA", "PA") or "transparency" in image.info
            if image.mode.startswith("I"):
                codes = read_data(path)
                image = PilImage.fromarray(_codes(codes))
            small = image.convert("RGBA" if has_alpha else "RGB")
            small = ImageOps.exif_transpose(small) if upright else small
            small = small.reduce(max(1, max(small.size) // side)) if max(small.size) >= 2 * side else small
            array = _unit(np.array(small))
        except (OSError, SyntaxError, ValueError, EOFError, struct.error) as error:
            raise _broken(path, str(error)) from error
    return Image(linear_from_srgb(array[..., :3]), array[..., 3] if has_alpha else None)


def read_data(path: str | Path) -> np.ndarray:
    """Decode without a transfer curve: (H, W) or (H, W, C) float32; 8/16-bit codes divided by their largest value. No alpha handling."""
    array, _ = _decode(Path(path))
    array = _unit(array) if array.dtype.kind == "u" else array.astype(np.float32)
    return array[..., 0] if array.ndim == 3 and array.shape[2] == 1 else array


def read_header(path: str | Path) -> Header:
    """Size, alpha and EXIF focal length without decoding the pixels. Raises UserError as `read_image` does."""
    path = Path(path)
    suffix = _checked(path)
    if suffix == ".exr":
        channels, shape = _exr(path, header_only=True)
        return Header(shape[1], shape[0], any(c.split(".")[-1] == "A" for c in channels))
    if suffix == ".hdr":
        w, h = _hdr_size(path)
        return Header(w, h)
    if suffix in RAW:
        with _rawpy().imread(str(path)) as raw:
            w, h = (raw.sizes.height, raw.sizes.width) if raw.sizes.flip in (5, 6) else (raw.sizes.width, raw.sizes.height)
        return Header(w, h)
    with _pil(path) as image:
        w, h = image.size
        # Pillow decodes a whole PNG to look for EXIF behind the pixels; what stands before them is enough here
        exif = image.getexif() if image.format != "PNG" or "exif" in image.info else PilImage.Exif()
        orientation = exif.get(0x0112, 1)
        orientation = orientation if orientation in range(1, 9) else 1
        w, h = (h, w) if orientation >= 5 else (w, h)
        has_alpha = image.mode in ("RGBA", "LA", "PA") or "transparency" in image.info
        return Header(w, h, has_alpha, _focal(exif, w, h), orientation)


def _focal(exif, width: int, height: int) -> float | None:
    """Focal length in pixels from EXIF: the 35 mm equivalent (defined on the diagonal), else millimetres and focal-plane resolution."""
    try:
        ifd = exif.get_ifd(0x8769)
        if float(ifd.get(0xA405, 0)) > 0:
            return float(ifd[0xA405]) * float(np.hypot(width, height)) / FULL_FRAME_DIAGONAL
        resolution, unit = float(ifd.get(0xA20E, 0)), {2: 25.4, 3: 10.0, 4: 1.0}.get(int(ifd.get(0xA210, 2)), 25.4)
        focal = float(ifd.get(0x920A, 0)) * resolution / unit
        return focal if focal > 0 and np.isfinite(focal) else None
    except (ValueError, TypeError, ZeroDivisionError, KeyError, OSError, SyntaxError):
        return None  # EXIF is a hint: a broken block is no reason to refuse the photo


def _unit(codes: np.ndarray) -> np.ndarray:
    """uint8 / uint16 codes -> float32 in [0, 1]; floats are clipped to it."""
    if codes.dtype.kind == "u":
        return codes.astype(np.float32) / np.float32(np.iinfo(codes.dtype).max)
    return np.clip(codes.astype(np.float32), 0.0, 1.0)


def _checked(path: Path) -> str:
    suffix = path.suffix.lower()
    if not path.is_file():
        raise UserError(
            "an image file is missing", "it is named by the capture or the command, but is not there", f"check the path: {path}"
        )
    if suffix not in EXTENSIONS:
        raise UserError(f"'{suffix}' is not an image format that can be read", fix=f"use one of {' '.join(sorted(EXTENSIONS))}: {path}")
    return suffix


def _too_large(path: Path, width: int, height: int) -> None:
    if width * height > MAX_PIXELS:
        raise UserError(
            f"an image is too large: {width} x {height} pixels",
            f"the limit is {MAX_PIXELS / 1e6:.0f} megapixels",
            f"make it smaller: {path}",
        )


def _decode(path: Path, upright: bool = True) -> tuple[np.ndarray, bool]:
    """-> ((H, W[, C]) uint8, uint16 or float32 array, True when it is linear already)."""
    suffix = _checked(path)
    if suffix == ".exr":
        return _finite(_exr(path)[0], path), True
    if suffix == ".hdr":
        import cv2

        _too_large(path, *_hdr_size(path))
        array = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if array is None:
            raise _broken(path, "not a Radiance HDR file")
        return _finite(np.ascontiguousarray(array[..., ::-1]), path), True
    if suffix in RAW:
        with _rawpy().imread(str(path)) as raw:  # camera white balance, no automatic exposure, linear
            array = raw.postprocess(gamma=(1, 1), no_auto_bright=True, output_bps=16, use_camera_wb=True)
        return array, True
    with _pil(path) as image:
        try:
            if _is_sixteen_bit(path, suffix):
                return _sixteen_bit(path, image.getexif().get(0x0112, 1) if upright else 1), False
            image = ImageOps.exif_transpose(image) if upright else image
            if image.mode in ("P", "PA") or "transparency" in image.info:
                image = image.convert("RGBA")
            elif image.mode in ("1", "CMYK", "YCbCr", "HSV", "LAB"):
                image = image.convert("L" if image.mode == "1" else "RGB")
            array = np.array(image)
        except (OSError, SyntaxError, ValueError, EOFError, struct.error) as error:
            raise _broken(path, str(error)) from error
    if array.dtype == np.int32:  # PIL's mode I: 16-bit grey
        array = np.clip(array, 0, 65535).astype(np.uint16)
    return array, False


def _is_sixteen_bit(path: Path, suffix: str) -> bool:
    if suffix == ".png":
        with open(path, "rb") as f:
            return f.read(25)[24:25] == b"\x10"
    return suffix in (".tif", ".tiff")


def _sixteen_bit(path: Path, orientation: int) -> np.ndarray:
    """OpenCV keeps all 16 bits where Pillow drops the lower eight of a colour file."""
    import cv2

    array = cv2.imread(str(path), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    if array is None or array.dtype.kind not in "uf":
        raise ValueError("the pixels could not be decoded")
    if array.ndim == 3:
        array = array[..., [2, 1, 0, 3][: array.shape[2]]] if array.shape[2] >= 3 else array
    return turn_upright(array, orientation)


def turn_upright(array: np.ndarray, orientation: int) -> np.ndarray:
    """Apply EXIF's orientation (1 to 8) to an array (H, W[, C])."""
    if orientation in (5, 6, 7, 8):
        array = array.swapaxes(0, 1)
    flips = {2: (1, -1), 3: (-1, -1), 4: (-1, 1), 6: (1, -1), 7: (-1, -1), 8: (-1, 1)}.get(orientation, (1, 1))
    return np.ascontiguousarray(array[:: flips[0], :: flips[1]])


@contextmanager
def _pil(path: Path):
    if path.suffix.lower() in HEIC:
        try:
            from pillow_heif import register_heif_opener
        except ImportError as error:
            raise UserError(
                "HEIC photos need an optional package",
                "pillow-heif is not installed",
                f"pip install 'relit[heic]', or convert to JPEG: {path}",
            ) from error
        register_heif_opener()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow warns of large images; the limit here is our own, and an error
            image = PilImage.open(path)
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError, PilImage.DecompressionBombError) as error:
        raise _broken(path, str(error)) from error
    with image:
        _too_large(path, *image.size)
        yield image


def _rawpy():
    try:
        import rawpy
    except ImportError as error:
        raise UserError(
            "RAW photos need an optional package",
            "rawpy is not installed",
            "pip install 'relit[raw]', or convert the photos to JPEG or EXR",
        ) from error
    return rawpy


def _broken(path: Path, reason: str) -> UserError:
    return UserError(
        "an image file cannot be read",
        f"{reason.replace(str(path), 'the file')} (truncated or damaged)",
        f"copy it again or take it out of the folder: {path}",
    )


def _finite(array: np.ndarray, path: Path) -> np.ndarray:
    bad = ~np.isfinite(array).reshape(array.shape[0], array.shape[1], -1).all(axis=-1)
    if bad.any():
        row, col = np.argwhere(bad)[0]
        raise UserError(
            f"an image holds {int(bad.sum())} pixels that are NaN or infinite (the first at column {col}, row {row})",
            "a renderer or an HDR merge wrote them; they would spread through the whole fit",
            f"replace them before: {path}",
        )
    return array


def _hdr_size(path: Path) -> tuple[int, int]:
    with open(path, "rb") as f:
        head = f.read(4096)
    for line in head.split(b"\n")[1:]:
        words = line.split()
        if len(words) == 4 and words[0] in (b"-Y", b"+Y") and words[1].isdigit() and words[3].isdigit():
            return int(words[3]), int(words[1])
    raise _broken(path, "not a Radiance HDR file")


def _exr(path: Path, header_only: bool = False):
    """-> ((H, W, C) float32, shape), or (channel names, shape) for the header. The display window is what is read."""
    import OpenEXR

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with OpenEXR.File(str(path), separate_channels=True, header_only=True) as f:
                head = f.header()  # emptied when the file is closed
                windows = [np.asarray(head[k], dtype=np.int64) for k in ("displayWindow", "dataWindow")]
                names = [c.name for c in head["channels"]]
            for window in windows:  # before any pixel is decoded
                _too_large(path, *(int(v) for v in window[1] - window[0] + 1))
            w, h = (int(v) for v in windows[0][1] - windows[0][0] + 1)
            dx, dy = (int(v) for v in windows[1][0] - windows[0][0])
            if header_only:
                return names, (h, w)
            with OpenEXR.File(str(path), separate_channels=True) as f:
                channels = {name: c.pixels for name, c in f.channels().items()}
    except UserError:
        raise
    except (RuntimeError, ValueError, TypeError, KeyError, OSError, MemoryError) as error:
        raise _broken(path, str(error)) from error
    names = _exr_layer(list(channels))
    if not names or len({channels[n].shape for n in names}) != 1:
        raise _broken(path, f"no colour channels among {', '.join(channels)}")
    data = np.stack([channels[n].astype(np.float32) for n in names], axis=-1)
    if data.shape[:2] == (h, w) and (dx, dy) == (0, 0):
        return data, (h, w)
    out = np.zeros((h, w, data.shape[2]), np.float32)
    ys, xs = slice(max(dy, 0), min(dy + data.shape[0], h)), slice(max(dx, 0), min(dx + data.shape[1], w))
    out[ys, xs] = data[ys.start - dy : ys.stop - dy, xs.start - dx : xs.stop - dx]
    return out, (h, w)


def _exr_layer(names: list[str]) -> list[str]:
    """Channels of the picture in a file that may have layers: plain R G B, else the first layer that has them, else a lone channel."""
    for prefix in dict.fromkeys(["", *(n.rsplit(".", 1)[0] + "." for n in names if "." in n)]):
        if all(prefix + c in names for c in "RGB"):
            return [prefix + c for c in "RGBA" if prefix + c in names]
    for lone in ("Y", "Z", "V"):
        if lone in names:
            return [lone] + (["A"] if "A" in names else [])
    return names[:1] if len(names) == 1 else []


# ---------------------------------------------------------------- writing


def _codes(array: np.ndarray) -> np.ndarray:
    """[0, 1] -> uint8, rounded."""
    return (np.clip(np.nan_to_num(np.asarray(array, dtype=np.float32)), 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def _encode(codes: np.ndarray, suffix: str, quality: int = 93) -> bytes:
    codes = codes[..., 0] if codes.ndim == 3 and codes.shape[2] == 1 else codes
    out = io.BytesIO()
    if suffix == ".png":
        PilImage.fromarray(codes).save(out, "PNG", compress_level=4)
    elif suffix in (".jpg", ".jpeg"):
        PilImage.fromarray(codes[..., :3] if codes.ndim == 3 else codes).save(out, "JPEG", quality=quality)
    else:
        raise UserError(f"cannot write '{suffix}' as an 8-bit picture", fix="name the file .png or .jpg", code=2)
    return out.getvalue()


def _srgb_codes(linear: np.ndarray) -> np.ndarray:
    """Linear (H, W), (H, W, 3) or straight-alpha (H, W, 4) -> uint8 sRGB; the alpha channel has no curve."""
    linear = np.asarray(linear, dtype=np.float32)
    if linear.ndim == 3 and linear.shape[2] == 4:
        return _codes(np.concatenate([srgb_from_linear(linear[..., :3]), linear[..., 3:]], axis=-1))
    return _codes(srgb_from_linear(linear))


def encode_jpeg(linear: np.ndarray, quality: int = 90) -> bytes:
    """Linear (H, W[, 3]) -> bytes of an sRGB JPEG."""
    return _encode(_srgb_codes(linear), ".jpg", quality)


def encode_png(linear: np.ndarray) -> bytes:
    """Linear (H, W[, 3 or 4, straight alpha]) -> bytes of an 8-bit sRGB PNG."""
    return _encode(_srgb_codes(linear), ".png")


def write_srgb(path: str | Path, linear: np.ndarray) -> None:
    """Write linear (H, W), (H, W, 3) or straight-alpha (H, W, 4) as an 8-bit sRGB PNG or JPEG, atomically."""
    write_bytes(path, _encode(_srgb_codes(linear), Path(path).suffix.lower()))


def write_data(path: str | Path, array: np.ndarray) -> None:
    """Write (H, W[, 1-4]) in [0, 1] as an 8-bit PNG without a transfer curve, atomically."""
    write_bytes(path, _encode(_codes(array), Path(path).suffix.lower()))


def write_bytes(path: str | Path, data: bytes) -> None:
    """Write a file atomically (temporary file beside it, then rename). Raises UserError (exit code 5) on a full or read-only disk."""
    with _replacing(Path(path)) as temporary:
        temporary.write_bytes(data)


def write_linear(path: str | Path, array: np.ndarray) -> None:
    """Write (H, W) or (H, W, 1, 3 or 4) linear values, atomically: .exr as float32, .hdr as RGBE (3 channels only, about 1 % precision)."""
    path = Path(path)
    array = np.ascontiguousarray(array, dtype=np.float32)
    array = array[..., 0] if array.ndim == 3 and array.shape[2] == 1 else array
    suffix = path.suffix.lower()
    with _replacing(path) as temporary:
        if suffix == ".exr":
            import OpenEXR

            name = "Y" if array.ndim == 2 else {3: "RGB", 4: "RGBA"}[array.shape[2]]
            head = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
            with OpenEXR.File(head, {name: array}) as f:
                f.write(str(temporary))
        elif suffix == ".hdr" and array.ndim == 3 and array.shape[2] == 3:
            import cv2

            if not cv2.imwrite(str(temporary), array[..., ::-1]):
                raise OSError(errno.EIO, "the file could not be written")
        else:
            raise UserError(
                f"cannot write {array.shape} linear values as '{suffix}'", fix="use .exr (1, 3 or 4 channels) or .hdr (3 channels)", code=2
            )


@contextmanager
def _replacing(path: Path):
    """Yield a temporary path in the same folder that takes the place of `path` when the block succeeds."""
    temporary = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=".writing-", suffix=path.suffix, dir=path.parent)
        os.close(handle)
        temporary = Path(name)
        yield temporary
        temporary.chmod(0o644)
        os.replace(temporary, path)
    except OSError as error:
        reason = "the disk is full" if error.errno in (errno.ENOSPC, errno.EDQUOT) else (error.strerror or str(error))
        raise UserError(
            "a file could not be written", reason, f"free some space or choose another folder: {path}", code=EXIT_ENVIRONMENT
        ) from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)

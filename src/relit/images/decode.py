"""From a file to an array of codes, or of linear floats: one decoder per format, each refusing what
is damaged or too large."""

from __future__ import annotations

import io
import struct
import threading
import warnings
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image as PilImage
from PIL import TiffImagePlugin, UnidentifiedImageError

from relit.errors import UserError
from relit.images.profiles import Profile, profile_of, rgb_of

MAX_PIXELS = 200_000_000  # larger files are refused before they are decoded
HEIC = {".heic", ".heif", ".hif"}
DELIVERY = {".webp", ".avif"}  # what web sites send in the place of JPEG
RAW = {".dng", ".nef", ".cr2", ".cr3", ".arw", ".orf", ".rw2", ".raf"}
FLOAT = {".exr", ".hdr"}
CODED = {".png", ".jpg", ".jpeg", ".jfif", ".jpe", ".bmp", ".tif", ".tiff"} | DELIVERY
FLOATING = 3  # TIFF's sample format
PLANE_TAGS = (0x0100, 0x0101, 0x0103, 0x0116, 0x013D, 0x0142, 0x0143)  # size, compression, tiles
STRIP_TAGS = (0x0111, 0x0117, 0x0144, 0x0145)  # offsets and byte counts of strips, of tiles
EXTENSIONS = CODED | FLOAT | HEIC | RAW


BRANDS = {b"avif": "AVIF", b"avis": "AVIF"} | {
    b: "HEIC" for b in (b"heic", b"heix", b"hevc", b"heim", b"heis", b"mif1", b"msf1", b"heif")
}  # of ISO base media files
MAGIC = (
    (b"\xff\xd8\xff", "picture"),
    (b"\x89PNG", "picture"),
    (b"II*\0", "picture"),
    (b"MM\0*", "picture"),
    (b"II+\0", "picture"),
    (b"BM", "picture"),
    (b"RIFF", "picture"),
    (b"\x76\x2f\x31\x01", "an EXR file"),
    (b"#?RADIANCE", "a Radiance HDR file"),
    (b"GIF8", "a GIF file"),
    (b"\xff\x0a", "a JPEG XL file"),
    (b"\0\0\0\x0cJXL ", "a JPEG XL file"),
    (b"\0\0\0\x0cjP", "a JPEG 2000 file"),
    (b"8BPS", "a Photoshop file"),
    (b"%PDF", "a PDF file"),
    (b"PK\3\4", "a ZIP archive"),
    (b"\0\5\x16\7", "the attributes of a file of a Mac (AppleDouble)"),
    (b"version https://git-lfs", "a pointer of Git LFS (run: git lfs pull)"),
    (b"<?xml", "an XML file"),
    (b"<svg", "an SVG drawing"),
)
_UNLIMITED = threading.Lock()  # Pillow's own limit is one for all threads


def checked(path: Path) -> str:
    suffix = path.suffix.lower()
    if not path.is_file():
        raise UserError(
            "an image file is missing",
            "it is named by the capture or the command, but is not there",
            f"check the path: {path}",
        )
    if suffix not in EXTENSIONS:
        raise UserError(
            f"'{suffix}' is not an image format that can be read",
            fix=f"use one of {' '.join(sorted(EXTENSIONS))}: {path}",
        )
    return suffix


def _too_large(path: Path, width: int, height: int) -> None:
    if width * height > MAX_PIXELS:
        raise UserError(
            f"an image is too large: {width} x {height} pixels",
            f"the limit is {MAX_PIXELS / 1e6:.0f} megapixels",
            f"make it smaller: {path}",
        )


@dataclass(frozen=True)
class Decoded:
    """codes: (H, W[, C]) uint8, uint16 or float32. linear: they are linear already. profile: what
    the colours' codes mean, or None for sRGB."""

    codes: np.ndarray
    linear: bool
    profile: Profile | None = None


def decode(path: Path, upright: bool = True) -> Decoded:
    """The picture in a file. Raises UserError for what cannot be read."""
    suffix = checked(path)
    if suffix == ".exr":
        return Decoded(_finite(exr(path)[0], path), True)  # pyright: ignore[reportArgumentType]
    if suffix == ".hdr":
        import cv2

        from relit.images.opencv import decode_file

        _too_large(path, *hdr_size(path))
        array = decode_file(path, cv2.IMREAD_UNCHANGED)
        if array is None:
            raise broken(path, "not a Radiance HDR file")
        return Decoded(_finite(np.ascontiguousarray(array[..., ::-1]), path), True)
    if suffix in RAW:
        flip = {} if upright else {"user_flip": 0}
        with raw_file(path) as raw:  # camera white balance, no automatic exposure, linear
            developed = raw.postprocess(
                gamma=(1, 1), no_auto_bright=True, output_bps=16, use_camera_wb=True, **flip
            )
        return Decoded(developed, True)
    floats = float_tiff(path)
    if floats is not None:
        array = _float_colours(path, floats.orientation if upright else 1)
        return Decoded(_finite(array, path), True)
    with pil(path) as image:
        try:
            return _decoded(path, image, orientation_of(image) if upright else 1)
        except (OSError, SyntaxError, ValueError, EOFError, struct.error) as error:
            raise broken(path, str(error)) from error


def _decoded(path: Path, image: PilImage.Image, orientation: int) -> Decoded:
    """What Pillow opened, decoded by it or, with more than 8 bits, by OpenCV."""
    profile = profile_of(image, early_exif(image))
    if _is_sixteen_bit(path, image):
        array = _sixteen_bit(path, orientation)
        if array.dtype.kind == "f":  # floats are linear
            return Decoded(_finite(array, path), True)
        return Decoded(array, False, profile)
    if image.format == "TIFF":  # Pillow turns it too, and mixes up the rows of some
        image = PilImage.open(io.BytesIO(_as_stored(path.read_bytes())))
    if image.mode in ("P", "PA") or "transparency" in image.info:
        image = image.convert("RGBA")
    elif image.mode in ("1", "YCbCr", "HSV"):
        image = image.convert("L" if image.mode == "1" else "RGB")
    array = turn_upright(np.array(rgb_of(image)), orientation)
    if array.dtype == np.int32:  # PIL's mode I: 16-bit grey
        array = np.clip(array, 0, 65535).astype(np.uint16)
    return Decoded(array, False, profile)


def _is_sixteen_bit(path: Path, image: PilImage.Image) -> bool:
    """Whether OpenCV decodes it: a PNG of 16 bits, and a TIFF, but of CMYK and Lab, which Pillow
    knows."""
    if image.format == "PNG":
        with open(path, "rb") as f:
            return f.read(25)[24:25] == b"\x10"
    return image.format == "TIFF" and image.mode not in ("CMYK", "LAB")


def _sixteen_bit(path: Path, orientation: int) -> np.ndarray:
    """OpenCV keeps all 16 bits where Pillow drops the lower eight of a colour file."""
    import cv2

    from relit.images.opencv import decode_bytes

    flags = cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION
    data = _as_stored(path.read_bytes())
    planes = [decode_bytes(plane, flags) for plane in separate_planes(data)]
    if planes and all(p is not None and p.ndim == 2 for p in planes):
        order = [2, 1, 0, *range(3, len(planes))] if len(planes) >= 3 else range(len(planes))
        array = np.stack([planes[k] for k in order], axis=-1)  # pyright: ignore[reportArgumentType, reportCallIssue]
    else:
        array = decode_bytes(data, flags)
    if array is None or array.dtype.kind not in "uf":
        raise ValueError("the pixels could not be decoded")
    if array.ndim == 3:
        array = array[..., [2, 1, 0, 3][: array.shape[2]]] if array.shape[2] >= 3 else array
    return turn_upright(array, orientation)


@dataclass(frozen=True)
class FloatTiff:
    """A TIFF of floating-point colours, which Pillow does not open. width, height: as stored.
    alpha: has a fourth channel.
    orientation: EXIF's, 1 to 8."""

    width: int
    height: int
    alpha: bool
    orientation: int


def float_tiff(path: Path) -> FloatTiff | None:
    """What the head of a TIFF of floating-point colours says; None for all other files (a TIFF of
    grey floats is Pillow's mode F)."""
    if path.suffix.lower() not in (".tif", ".tiff"):
        return None
    try:
        with open(path, "rb") as file:
            head = TiffImagePlugin.ImageFileDirectory_v2(file.read(8))
            file.seek(head.next)
            head.load(file)
        channels, kinds = (
            int(head.get(TiffImagePlugin.SAMPLESPERPIXEL, 1)),
            head.get(TiffImagePlugin.SAMPLEFORMAT, (1,)),
        )
        width, height = (
            int(head[TiffImagePlugin.IMAGEWIDTH]),
            int(head[TiffImagePlugin.IMAGELENGTH]),
        )
    except (OSError, SyntaxError, ValueError, KeyError, TypeError, struct.error, OverflowError):
        return None  # Pillow says what is wrong with it
    if channels < 3 or kinds[0] != FLOATING:
        return None
    _too_large(path, width, height)
    turn = head.get(0x0112, 1)
    return FloatTiff(width, height, channels == 4, turn if turn in range(1, 9) else 1)


def _float_colours(path: Path, orientation: int) -> np.ndarray:
    try:
        return _sixteen_bit(path, orientation).astype(np.float32)
    except (ValueError, struct.error) as error:
        raise UserError(
            "a floating-point TIFF cannot be read",
            "it is damaged, or of a kind that is not read: half floats, planes apart, more than 4 channels, some compressions",
            f"save it as EXR: {path}",
        ) from error


def _as_stored(data: bytes) -> bytes:
    """A file's bytes; of a TIFF with orientation 1: OpenCV, told to ignore it, still mirrors it and
    refuses what lies on its side."""
    order = {b"II": "<", b"MM": ">"}.get(data[:2])
    if order is None or struct.unpack(order + "H", data[2:4]) != (42,):
        return data
    out, (begin,) = bytearray(data), struct.unpack(order + "I", data[4:8])
    (count,) = struct.unpack_from(order + "H", data, begin)
    for entry in range(begin + 2, begin + 2 + 12 * count, 12):
        if struct.unpack_from(order + "H", data, entry) == (0x0112,):
            struct.pack_into(order + "H", out, entry + 8, 1)
    return bytes(out)


def separate_planes(data: bytes) -> list[bytes]:
    """Of a TIFF whose channels are stored one after the other, each as a TIFF of grey (OpenCV mixes
    them up); none of other files. The same pixels are named by a directory of one channel."""
    order = {b"II": "<", b"MM": ">"}.get(data[:2])
    if order is None or struct.unpack(order + "H", data[2:4]) != (42,):
        return []
    head = TiffImagePlugin.ImageFileDirectory_v2(data[:8])
    file = io.BytesIO(data)
    file.seek(head.next)
    head.load(file)
    channels = int(head.get(TiffImagePlugin.SAMPLESPERPIXEL, 1))
    if head.get(TiffImagePlugin.PLANAR_CONFIGURATION, 1) != 2 or not 2 <= channels <= 4:
        return []
    lists = {tag: head[tag] for tag in STRIP_TAGS if tag in head}
    if not lists or any(len(v) % channels for v in lists.values()):
        return []
    tags = {tag: int(head[tag]) for tag in PLANE_TAGS if tag in head}
    bits = head.get(TiffImagePlugin.BITSPERSAMPLE, (8,))
    kinds = head.get(TiffImagePlugin.SAMPLEFORMAT, (1,))
    planes = []
    for k in range(channels):
        share = {t: v[k * len(v) // channels :][: len(v) // channels] for t, v in lists.items()}
        grey = {0x0102: (bits[0],), 0x0106: (1,), 0x0115: (1,), 0x011C: (1,), 0x0153: (kinds[0],)}
        entries = {**{t: (v,) for t, v in tags.items()}, **grey, **share}
        planes.append(_with_directory(data, entries, order))
    return planes


def _with_directory(data: bytes, entries: dict[int, tuple[int, ...]], order: str) -> bytes:
    """A TIFF file with another directory, appended: tags with 32-bit numbers."""
    data = data + bytes(len(data) % 2)
    body, spill = b"", b""
    after = len(data) + 2 + 12 * len(entries) + 4
    for tag, values in sorted(entries.items()):
        packed = struct.pack(f"{order}{len(values)}I", *values)
        if len(values) > 1:
            packed, spill = struct.pack(order + "I", after + len(spill)), spill + packed
        body += struct.pack(order + "HHI", tag, 4, len(values)) + packed
    directory = struct.pack(order + "H", len(entries)) + body + bytes(4) + spill
    return data[:4] + struct.pack(order + "I", len(data)) + data[8:] + directory


def early_exif(image: PilImage.Image) -> PilImage.Exif:
    """EXIF by what stands before the pixels: Pillow decodes a whole PNG to look for more. Ask
    before the pixels are loaded."""
    known = image.format != "PNG" or image.info.keys() & {
        "exif",
        "Raw profile type exif",
        "XML:com.adobe.xmp",
    }
    return image.getexif() if known else PilImage.Exif()


def orientation_of(image: PilImage.Image) -> int:
    """EXIF's orientation, 1 to 8; the one place that decides it, so that size and pixels agree."""
    value = early_exif(image).get(0x0112, 1)
    return value if value in range(1, 9) else 1


def stored_size(image: PilImage.Image) -> tuple[int, int]:
    """Width and height of the pixels as stored: of a TIFF Pillow tells those that it will have when
    it is turned."""
    tags = getattr(image, "tag_v2", None)
    return (
        image.size
        if tags is None
        else (int(tags[TiffImagePlugin.IMAGEWIDTH]), int(tags[TiffImagePlugin.IMAGELENGTH]))
    )


def turn_upright(array: np.ndarray, orientation: int) -> np.ndarray:
    """Apply EXIF's orientation (1 to 8) to an array (H, W[, C])."""
    if orientation in (5, 6, 7, 8):
        array = array.swapaxes(0, 1)
    flips = {2: (1, -1), 3: (-1, -1), 4: (-1, 1), 6: (1, -1), 7: (-1, -1), 8: (-1, 1)}.get(
        orientation, (1, 1)
    )
    return np.ascontiguousarray(array[:: flips[0], :: flips[1]])


@contextmanager
def pil(path: Path):
    """An open Pillow image; what the file is counts, not its extension."""
    content = content_of(path)
    if content == "HEIC" or path.suffix.lower() in HEIC:
        try:
            from pillow_heif import register_heif_opener  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            named = "" if path.suffix.lower() in HEIC else f", which '{path.name}' is in truth,"
            raise UserError(
                f"HEIC photos{named} need an optional package",
                "pillow-heif is not installed",
                f"pip install 'relit[heic]', or convert to JPEG: {path}",
            ) from error
        register_heif_opener()
    try:
        with _UNLIMITED, warnings.catch_warnings():
            # Pillow refuses large images as bombs; the limit here is our own, with its own message
            warnings.simplefilter("ignore")
            limit, PilImage.MAX_IMAGE_PIXELS = PilImage.MAX_IMAGE_PIXELS, None
            try:
                image = PilImage.open(path)
            finally:
                PilImage.MAX_IMAGE_PIXELS = limit
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError) as error:
        raise broken(path, str(error)) from error
    with image:
        _too_large(path, *image.size)
        yield image


@contextmanager
def raw_file(path: Path):
    """An open RAW file (rawpy.RawPy). Raises UserError where the package is missing, and for files
    that it cannot read."""
    package = rawpy()
    try:
        with package.imread(str(path)) as raw:
            _too_large(path, raw.sizes.width, raw.sizes.height)
            yield raw
    except package.LibRawError as error:
        reason = error.args[0] if error.args else error
        raise broken(
            path, reason.decode(errors="replace") if isinstance(reason, bytes) else str(reason)
        ) from error


def rawpy():
    try:
        import rawpy  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise UserError(
            "RAW photos need an optional package",
            "rawpy is not installed",
            "pip install 'relit[raw]', or convert the photos to JPEG or EXR",
        ) from error
    return rawpy


def content_of(path: Path) -> str:
    """What a file holds by its first bytes: 'picture' for what Pillow reads, else its kind, ''
    where it is not known."""
    try:
        with open(path, "rb") as f:
            head = f.read(64)
    except OSError:
        return ""
    if not head:
        return "an empty file"
    if head[4:8] == b"ftyp":
        brands = {head[k : k + 4] for k in (8, *range(16, len(head) - 3, 4))}
        still = next((kind for brand, kind in BRANDS.items() if brand in brands), None)
        return still or "a video (MP4 or QuickTime)"
    start = head.lstrip().lower()
    return next((kind for magic, kind in MAGIC if head.startswith(magic)), "") or (
        "a web page" if start.startswith((b"<!doctype", b"<html")) else ""
    )


def broken(path: Path, reason: str) -> UserError:
    """The error for a file that no decoder reads, with its true reason: another kind of file under
    this name, or damage."""
    content = content_of(path)
    if content not in ("", "picture"):
        return UserError(
            "an image file cannot be read",
            f"it is {content} in truth",
            f"convert it, get it again, or take it out of the folder: {path}",
        )
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


def hdr_size(path: Path) -> tuple[int, int]:
    with open(path, "rb") as f:
        head = f.read(4096)
    for line in head.split(b"\n")[1:]:
        words = line.split()
        if (
            len(words) == 4
            and words[0] in (b"-Y", b"+Y")
            and words[1].isdigit()
            and words[3].isdigit()
        ):
            return int(words[3]), int(words[1])
    raise broken(path, "not a Radiance HDR file")


def exr(path: Path, header_only: bool = False):
    """-> ((H, W, C) float32, shape), or (channel names, shape) for the header. The display window
    is what is read."""
    import OpenEXR

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with OpenEXR.File(str(path), separate_channels=True, header_only=True) as f:
                head = f.header()  # emptied when the file is closed
                windows = [
                    np.asarray(head[k], dtype=np.int64) for k in ("displayWindow", "dataWindow")
                ]
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
        raise broken(path, str(error)) from error
    names = _exr_layer(list(channels))
    if not names or len({channels[n].shape for n in names}) != 1:
        raise broken(path, f"no colour channels among {', '.join(channels)}")
    data = np.stack([channels[n].astype(np.float32) for n in names], axis=-1)
    if data.shape[:2] == (h, w) and (dx, dy) == (0, 0):
        return data, (h, w)
    out = np.zeros((h, w, data.shape[2]), np.float32)
    ys, xs = (
        slice(max(dy, 0), min(dy + data.shape[0], h)),
        slice(max(dx, 0), min(dx + data.shape[1], w)),
    )
    out[ys, xs] = data[ys.start - dy : ys.stop - dy, xs.start - dx : xs.stop - dx]
    return out, (h, w)


def _exr_layer(names: list[str]) -> list[str]:
    """Channels of the picture in a file that may have layers: plain R G B, else the first layer
    that has them, else a lone channel."""
    for prefix in dict.fromkeys(["", *(n.rsplit(".", 1)[0] + "." for n in names if "." in n)]):
        if all(prefix + c in names for c in "RGB"):
            return [prefix + c for c in "RGBA" if prefix + c in names]
    for lone in ("Y", "Z", "V"):
        if lone in names:
            return [lone] + (["A"] if "A" in names else [])
    return names[:1] if len(names) == 1 else []

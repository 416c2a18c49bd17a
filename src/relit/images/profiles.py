"""Colour profiles: from the codes of a picture to linear Rec.709, without a loss to 8 bits.

Matrix profiles (ICC.1:2010, 8.3) and grey ones are computed here: three curves and a matrix to the
connection space, XYZ under D50. All others (tables, CMYK) go through Little CMS to 8-bit sRGB.
"""

from __future__ import annotations

import io
import struct
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from PIL import Image as PilImage
from PIL import ImageCms

from relit.conventions import linear_from_srgb

# columns red, green, blue: XYZ under D50 (Bradford-adapted) of the primaries
SRGB_D50 = np.array(
    [
        [0.4360747, 0.3850649, 0.1430804],
        [0.2225045, 0.7168786, 0.0606169],
        [0.0139322, 0.0971045, 0.7141733],
    ]
)
ADOBE_D50 = np.array(
    [
        [0.60974, 0.20528, 0.14919],
        [0.31111, 0.62567, 0.06322],
        [0.01947, 0.06087, 0.74457],
    ]
)
ADOBE_GAMMA = 2.19921875  # 2 + 51/256, Adobe RGB (1998), 4.3.4.2
SAME = 1.5 / 255  # of a code: a profile so near to sRGB's is taken for it
STEPS = 4096  # of a curve's table
NAMES_OF_SRGB = tuple("sRGB IEC61966".encode(code) for code in ("ascii", "utf-16-be"))
UNCALIBRATED, ADOBE_EXIF = 65535, 2  # EXIF's colour spaces other than sRGB


@dataclass(frozen=True, eq=False)
class Profile:
    """curves: (3, n) linear values at codes in [0, 1], evenly spaced. matrix: (3, 3), from linear
    values to linear Rec.709."""

    curves: np.ndarray
    matrix: np.ndarray

    def linear(self, codes: np.ndarray) -> np.ndarray:
        """(H, W, 3) codes in [0, 1] -> (H, W, 3) float32 linear Rec.709, clipped to [0, 1]."""
        at = np.linspace(0.0, 1.0, self.curves.shape[1])
        bent = np.stack(
            [np.interp(codes[..., k], at, self.curves[k]).astype(np.float32) for k in range(3)], -1
        )
        return np.clip(bent @ self.matrix.T.astype(np.float32), 0.0, 1.0)

    @property
    def is_srgb(self) -> bool:
        """Whether it makes of codes what the sRGB curve does, to 1.5 codes."""
        rng = np.random.default_rng(0)
        codes = rng.uniform(0.05, 1.0, (1, 512, 3)).astype(np.float32)
        ours, theirs = self.linear(codes), linear_from_srgb(codes)
        return bool((np.abs(np.sqrt(ours) - np.sqrt(theirs)) < SAME).all())


ADOBE = Profile(
    np.linspace(0, 1, STEPS)[None].repeat(3, 0) ** ADOBE_GAMMA,
    np.linalg.solve(SRGB_D50, ADOBE_D50),
)


def profile_of(image: PilImage.Image, exif: PilImage.Exif | None = None) -> Profile | None:
    """The profile of a picture's RGB or grey codes by its ICC profile, by EXIF (Adobe RGB, of
    cameras that write no profile) or by PNG's gamma; None where they are sRGB's or not known."""
    data = image.info.get("icc_profile")
    if data:
        return matrix_profile(bytes(data))
    if exif is not None and _is_adobe(exif):
        return ADOBE
    gamma = image.info.get("gamma")
    if image.format == "PNG" and "srgb" not in image.info and isinstance(gamma, float):
        if 0.1 < gamma < 1.5 and abs(gamma - 1 / 2.2) > 0.02:
            curve = np.linspace(0, 1, STEPS) ** (1 / gamma)
            return Profile(curve[None].repeat(3, 0), np.eye(3))
    return None


def _is_adobe(exif: PilImage.Exif) -> bool:
    """DCF 2.0 option files: the colour space is 'uncalibrated' and the interoperability index
    R03."""
    try:
        space = exif.get_ifd(0x8769).get(0xA001)
        index = str(exif.get_ifd(0xA005).get(1, "")).strip("\0 ")
    except (ValueError, TypeError, KeyError, OSError, SyntaxError, struct.error):
        return False
    return space == ADOBE_EXIF or (space in (UNCALIBRATED, None) and index == "R03")


@lru_cache(maxsize=8)
def matrix_profile(data: bytes) -> Profile | None:
    """The profile in an ICC profile's bytes, where it has curves and a matrix (or one curve, of
    grey); None for others, for damaged ones and for sRGB."""
    try:
        tags = _tags(data)
        space = data[16:20]
        if any(name in tags.get(b"desc", b"") for name in NAMES_OF_SRGB):
            return None
        if space == b"GRAY" and b"kTRC" in tags:
            profile = Profile(_curve(tags[b"kTRC"])[None].repeat(3, 0), np.eye(3))
        elif space == b"RGB " and {b"rXYZ", b"gXYZ", b"bXYZ", b"rTRC"} <= tags.keys():
            columns = [_xyz(tags[c + b"XYZ"]) for c in (b"r", b"g", b"b")]
            curves = [_curve(tags[c + b"TRC"]) for c in (b"r", b"g", b"b")]
            matrix = np.linalg.solve(SRGB_D50, np.array(columns).T)
            profile = Profile(np.array(curves), matrix)
        else:
            return None
        usable = np.isfinite(profile.curves).all() and np.isfinite(profile.matrix).all()
        usable = usable and profile.linear(np.ones((1, 1, 3), np.float32)).min() > 0.5
    except (struct.error, ValueError, IndexError, KeyError, OverflowError, np.linalg.LinAlgError):
        return None
    return profile if usable and not profile.is_srgb else None


def _tags(data: bytes) -> dict[bytes, bytes]:
    (count,) = struct.unpack_from(">I", data, 128)
    if count > 200:
        raise ValueError("no profile")
    entries = [struct.unpack_from(">4sII", data, 132 + 12 * k) for k in range(count)]
    return {name: data[at : at + size] for name, at, size in entries}


def _fixed(data: bytes, at: int, count: int) -> np.ndarray:
    """s15Fixed16 numbers."""
    return np.array(struct.unpack_from(f">{count}i", data, at)) / 65536


def _xyz(tag: bytes) -> np.ndarray:
    return _fixed(tag, 8, 3)


def _curve(tag: bytes) -> np.ndarray:
    """(STEPS,) linear values at codes from 0 to 1."""
    x = np.linspace(0.0, 1.0, STEPS)
    if tag[:4] == b"curv":
        (count,) = struct.unpack_from(">I", tag, 8)
        if count == 0:
            return x
        if count == 1:
            return x ** (struct.unpack_from(">H", tag, 12)[0] / 256)
        table = np.array(struct.unpack_from(f">{count}H", tag, 12)) / 65535
        return np.interp(x, np.linspace(0, 1, count), table)
    if tag[:4] != b"para":
        raise ValueError("a curve of a kind that is not known")
    kind = struct.unpack_from(">H", tag, 8)[0]
    g, *rest = _fixed(tag, 12, (1, 3, 4, 5, 7)[kind])
    a, b, c, d, e, f = {
        0: lambda: (1, 0, 0, 0, 0, 0),
        1: lambda: (rest[0], rest[1], 0, -rest[1] / rest[0], 0, 0),
        2: lambda: (rest[0], rest[1], 0, -rest[1] / rest[0], rest[2], rest[2]),
        3: lambda: (*rest, 0, 0),
        4: lambda: tuple(rest),
    }[kind]()
    return np.where(x >= d, np.maximum(a * x + b, 0.0) ** g + e, c * x + f)


def rgb_of(image: PilImage.Image) -> PilImage.Image:
    """A CMYK, Lab or table-profiled picture as 8-bit sRGB by Little CMS; CMYK without a profile by
    Pillow's formula; others as they are."""
    data = image.info.get("icc_profile")
    by_table = image.mode in ("RGB", "RGBA") and data and _is_table(bytes(data))
    if not (image.mode in ("CMYK", "LAB") or by_table):
        return image
    alpha = image.getchannel("A") if image.mode == "RGBA" else None
    colours = image.convert("RGB") if image.mode == "RGBA" else image
    if not data and image.mode != "LAB":
        return colours.convert("RGB")
    try:
        own = ImageCms.ImageCmsProfile(io.BytesIO(data)) if data else None
        source = own or ImageCms.createProfile("LAB")
        out = ImageCms.profileToProfile(
            colours,
            source,
            ImageCms.createProfile("sRGB"),
            ImageCms.Intent.RELATIVE_COLORIMETRIC,
            outputMode="RGB",
        )
    except (ImageCms.PyCMSError, OSError, ValueError, TypeError):
        out = colours.convert("RGB")  # a broken profile is no reason to refuse the photo
    assert out is not None
    if alpha is not None:
        out.putalpha(alpha)
    return out


def _is_table(data: bytes) -> bool:
    """Whether an ICC profile of RGB has tables only."""
    try:
        tags = _tags(data)
    except (struct.error, ValueError):
        return False
    return data[16:20] == b"RGB " and b"A2B0" in tags and b"rXYZ" not in tags

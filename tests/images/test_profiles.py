"""Colour profiles, layouts of TIFF, and the reasons for which a file cannot be read."""

from __future__ import annotations

import io
import struct

import numpy as np
import pytest
from PIL import Image, ImageCms

from relit.conventions import srgb_from_linear
from relit.errors import UserError
from relit.images import read_header, read_image, read_small
from relit.images.profiles import ADOBE_D50, SRGB_D50, matrix_profile

PRO_D50 = np.array([[0.79767, 0.13519, 0.03134], [0.28804, 0.71188, 0.00009], [0.0, 0.0, 0.8249]])
SPACES = {  # name -> (columns of primaries, gamma)
    "Linear sRGB": (SRGB_D50, 1.0),
    "Adobe RGB (1998)": (ADOBE_D50, 2.19921875),
    "ProPhoto RGB": (PRO_D50, 1.8),
}
RNG = np.random.default_rng(0)
COLOURS = RNG.uniform(0.02, 0.9, (12, 16, 3))  # linear Rec.709


def icc(name: str, columns: np.ndarray, curve: bytes, grey=False) -> bytes:
    """A version 2 profile with one curve, of RGB or of grey."""
    fixed = lambda v: b"".join(struct.pack(">i", round(float(x) * 65536)) for x in v)  # noqa: E731
    xyz = lambda v: b"XYZ " + bytes(4) + fixed(v)  # noqa: E731
    text = name.encode()
    desc = b"desc" + bytes(4) + struct.pack(">I", len(text) + 1) + text + bytes(79)
    white = (0.9642, 1.0, 0.8249)
    tags = {b"desc": desc, b"cprt": b"text" + bytes(4) + b"none", b"wtpt": xyz(white)}
    if grey:
        tags[b"kTRC"] = curve
    else:
        for k, c in enumerate((b"r", b"g", b"b")):
            tags[c + b"XYZ"], tags[c + b"TRC"] = xyz(columns[:, k]), curve
    table, body, at = b"", b"", 132 + 12 * len(tags)
    for tag, data in tags.items():
        table += tag + struct.pack(">II", at + len(body), len(data))
        body += data + bytes(-len(data) % 4)
    space = b"GRAY" if grey else b"RGB "
    head = struct.pack(">I4sI4s4s4s", at + len(body), b"none", 0x02400000, b"mntr", space, b"XYZ ")
    head += struct.pack(">6H", 2026, 1, 1, 0, 0, 0) + b"acsp" + bytes(28) + fixed(white)
    return head.ljust(128, b"\0") + struct.pack(">I", len(tags)) + table + body


def gamma_curve(gamma: float) -> bytes:
    if gamma == 1:
        return b"curv" + bytes(4) + struct.pack(">I", 0)
    return b"curv" + bytes(4) + struct.pack(">IH", 1, round(gamma * 256)) + bytes(2)


def table_curve(gamma: float) -> bytes:
    values = np.round(np.linspace(0, 1, 1024) ** gamma * 65535).astype(int)
    return b"curv" + bytes(4) + struct.pack(f">I{len(values)}H", len(values), *values)


def parametric_curve(gamma: float) -> bytes:
    return b"para" + bytes(4) + struct.pack(">HHi", 0, 0, round(gamma * 65536))


def codes_in(space: str, depth=8) -> np.ndarray:
    columns, gamma = SPACES[space]
    linear = COLOURS @ np.linalg.solve(columns, SRGB_D50).T
    top = 2**depth - 1
    return np.round(linear.clip(0, 1) ** (1 / gamma) * top).astype(f"uint{depth}")


def tiff(codes: np.ndarray, profile: bytes = b"", planar=False) -> bytes:
    """An uncompressed little-endian TIFF of colours, interleaved or in separate planes."""
    h, w, c = codes.shape
    planes = [codes[..., k] for k in range(c)] if planar else [codes]
    data = [p.astype(f"<u{codes.itemsize}").tobytes() for p in planes]
    at = [8 + sum(len(d) for d in data[:k]) for k in range(len(data))]
    tags = {
        256: (4, (w,)),
        257: (4, (h,)),
        258: (3, (8 * codes.itemsize,) * c),
        259: (3, (1,)),
        262: (3, (2,)),
        273: (4, tuple(at)),
        277: (3, (c,)),
        278: (4, (h,)),
        279: (4, tuple(len(d) for d in data)),
        284: (3, (2 if planar else 1,)),
    }
    if profile:
        tags[34675] = (7, tuple(profile))
    start = 8 + sum(map(len, data))
    body, spill, after = b"", b"", start + 2 + 12 * len(tags) + 4
    for tag, (kind, values) in sorted(tags.items()):
        packed = struct.pack("<" + {3: "H", 4: "I", 7: "B"}[kind] * len(values), *values)
        if len(packed) > 4:
            packed, spill = struct.pack("<I", after + len(spill)), spill + packed
        body += struct.pack("<HHI", tag, kind, len(values)) + packed.ljust(4, b"\0")
    head = b"II*\0" + struct.pack("<I", start)
    return head + b"".join(data) + struct.pack("<H", len(tags)) + body + bytes(4) + spill


def close(path, atol: float, expected=COLOURS) -> None:
    """Colours of the full and of the small copy, in sRGB values."""
    for found in (read_image(path).rgb, read_small(path, 64).rgb):
        np.testing.assert_allclose(srgb_from_linear(found), srgb_from_linear(expected), atol=atol)


@pytest.mark.parametrize("curve", [gamma_curve, table_curve, parametric_curve])
@pytest.mark.parametrize("space", SPACES)
def test_eight_bit_files_follow_their_profile(tmp_path, space, curve):
    columns, gamma = SPACES[space]
    profile = icc(space, columns, curve(gamma))
    picture = Image.fromarray(codes_in(space))
    for name in ("a.png", "a.webp"):
        picture.save(
            tmp_path / name, icc_profile=profile, **({"lossless": True} if "webp" in name else {})
        )
        close(tmp_path / name, 0.02)
    (tmp_path / "a.tif").write_bytes(tiff(codes_in(space), profile))
    close(tmp_path / "a.tif", 0.02)
    cms = ImageCms.profileToProfile(
        picture, ImageCms.ImageCmsProfile(io.BytesIO(profile)), ImageCms.createProfile("sRGB")
    )
    ours = srgb_from_linear(read_image(tmp_path / "a.png").rgb) * 255
    assert np.abs(ours - np.asarray(cms)).max() < 2.5  # Little CMS rounds to 8 bits


@pytest.mark.parametrize("space", SPACES)
def test_sixteen_bit_files_follow_their_profile(tmp_path, space):
    columns, gamma = SPACES[space]
    profile = icc(space, columns, gamma_curve(gamma))
    (tmp_path / "a.tif").write_bytes(tiff(codes_in(space, 16), profile))
    found = read_image(tmp_path / "a.tif")
    np.testing.assert_allclose(found.rgb, COLOURS, atol=2e-3)
    assert found.clipped is not None and not found.clipped.any()


@pytest.mark.parametrize("depth", [8, 16])
@pytest.mark.parametrize("channels", [3, 4])
def test_separate_planes_of_a_tiff(tmp_path, depth, channels):
    top = 2**depth - 1
    codes = np.round(srgb_from_linear(COLOURS) * top).astype(f"uint{depth}")
    if channels == 4:
        codes = np.concatenate([codes, np.full((12, 16, 1), top, codes.dtype)], -1)
    for planar in (False, True):
        (tmp_path / f"{planar}.tif").write_bytes(tiff(codes, planar=planar))
        close(tmp_path / f"{planar}.tif", 0.006)


def test_grey_and_exif_and_png_gamma(tmp_path):
    codes = np.round(np.linspace(0.1, 0.9, 16) * 255).astype(np.uint8)[None].repeat(12, 0)
    profile = icc("Gray Gamma 1.8", SRGB_D50, gamma_curve(1.8), grey=True)
    Image.fromarray(codes).save(tmp_path / "g.png", icc_profile=profile)
    grey = np.repeat((codes / 255.0)[..., None] ** 1.8, 3, -1)
    np.testing.assert_allclose(read_image(tmp_path / "g.png").rgb, grey, atol=4e-3)
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA001] = 65535
    exif.get_ifd(0x8769)[0xA005] = {1: "R03"}
    picture = Image.fromarray(codes_in("Adobe RGB (1998)"))
    picture.save(tmp_path / "e.jpg", quality=100, subsampling=0, exif=exif.tobytes())
    close(tmp_path / "e.jpg", 0.04)
    from PIL import PngImagePlugin

    chunks = PngImagePlugin.PngInfo()
    chunks.add(b"gAMA", struct.pack(">I", 100000))
    Image.fromarray(codes_in("Linear sRGB")).save(tmp_path / "l.png", pnginfo=chunks)
    close(tmp_path / "l.png", 0.02)


def test_cmyk_tiff_is_turned_once(tmp_path):
    picture = Image.fromarray(np.round(srgb_from_linear(COLOURS) * 255).astype(np.uint8))
    exif = Image.Exif()
    exif[0x0112] = 6
    for name, turn in (("a.tif", {}), ("b.tif", {"exif": exif})):
        picture.convert("CMYK").save(tmp_path / name, **turn)  # the pixels are stored as they are
    close(tmp_path / "a.tif", 0.03)
    upright = read_image(tmp_path / "b.tif").rgb
    header = read_header(tmp_path / "b.tif")
    assert upright.shape[:2] == (16, 12) == (header.height, header.width)
    np.testing.assert_allclose(upright, read_image(tmp_path / "a.tif").rgb[::-1].swapaxes(0, 1))
    stored = read_image(tmp_path / "b.tif", upright=False).rgb
    np.testing.assert_allclose(stored, read_image(tmp_path / "a.tif").rgb)


@pytest.mark.parametrize("spoil", [b"", b"junk", bytes(400), b"\xff" * 400])
def test_broken_profiles_are_none(spoil):
    good = icc("x", SRGB_D50, gamma_curve(1.0))
    assert matrix_profile(good) is not None
    for data in (spoil, good[: len(good) // 2] + spoil, good[:128] + spoil):
        assert matrix_profile(data) is None


@pytest.mark.parametrize(
    "content, said",
    [
        (b"", "an empty file"),
        (b"\0\0\0\x18ftypmp42" + bytes(40), "a video"),
        (b"<!DOCTYPE html><html>", "a web page"),
        (b"version https://git-lfs.github.com/spec/v1\n", "git lfs pull"),
        (b"\0\5\x16\7\0\2\0\0Mac OS X", "AppleDouble"),
        (b"PK\3\4" + bytes(40), "a ZIP archive"),
        (b"GIF89a", "a GIF file"),
        (b"\xff\x0a" + bytes(20), "a JPEG XL file"),
        (b"\xff\xd8\xff\xe0" + bytes(20), "truncated or damaged"),
        (b"\0\0\0\x18ftypheic" + bytes(40), "HEIC|truncated or damaged"),
    ],
)
def test_the_true_reason(tmp_path, content, said):
    (tmp_path / "a.jpg").write_bytes(content)
    for read in (read_image, read_header, read_small):
        with pytest.raises(UserError) as refusal:
            read(tmp_path / "a.jpg")
        assert any(s in str(refusal.value) for s in said.split("|")), str(refusal.value)


def test_two_hundred_megapixels_have_the_own_limit(tmp_path):
    """A header tells the size; nothing is decoded."""
    for side, fits in ((14100, True), (14200, False)):
        head = struct.pack(
            "<2sIHHIIiiHHIIiiII", b"BM", 0, 0, 0, 54, 40, side, side, 1, 24, 0, 0, 0, 0, 0, 0
        )
        (tmp_path / "a.bmp").write_bytes(head + bytes(64))
        if fits:
            assert read_header(tmp_path / "a.bmp").width == side
        else:
            with pytest.raises(UserError, match="too large"):
                read_header(tmp_path / "a.bmp")
    assert Image.MAX_IMAGE_PIXELS is not None  # the limit of other programs in the process stays

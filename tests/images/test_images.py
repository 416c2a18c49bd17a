"""Pictures survive a round trip; damaged ones get an answer."""

import struct
import sys

import numpy as np
import pytest
from PIL import Image as PilImage

from relit import images
from relit.conventions import linear_from_srgb
from relit.errors import EXIT_ENVIRONMENT, UserError

RAMP = np.linspace(0, 1, 6 * 8 * 3, dtype=np.float32).reshape(6, 8, 3)


def test_png_is_srgb_and_linear_inside(tmp_path):
    images.write_srgb(tmp_path / "a.png", RAMP)
    back = images.read_image(tmp_path / "a.png")
    assert back.rgb.dtype == np.float32 and back.alpha is None
    np.testing.assert_allclose(back.rgb, RAMP, atol=0.005)
    stored = np.asarray(PilImage.open(tmp_path / "a.png"))
    assert stored[3, 4, 0] > 1.2 * 255 * RAMP[3, 4, 0]  # sRGB codes lie above linear ones
    assert back.clipped[-1, -1] and not back.clipped[0, 0]


def test_data_has_no_curve(tmp_path):
    images.write_data(tmp_path / "a.png", RAMP[..., 0])
    back = images.read_data(tmp_path / "a.png")
    assert back.shape == (6, 8)
    np.testing.assert_allclose(back, RAMP[..., 0], atol=0.5 / 255 + 1e-6)


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_exr_is_exact(tmp_path, channels):
    array = np.random.default_rng(0).normal(size=(5, 7, channels)).astype(np.float32) * 100
    images.write_linear(tmp_path / "a.exr", array)
    np.testing.assert_array_equal(images.read_data(tmp_path / "a.exr").reshape(array.shape), array)
    header = images.read_header(tmp_path / "a.exr")
    assert (header.width, header.height, header.alpha) == (7, 5, channels == 4)


def test_hdr_round_trip(tmp_path):
    array = np.random.default_rng(0).uniform(0.5, 30, (4, 9, 3)).astype(np.float32)
    images.write_linear(tmp_path / "a.hdr", array)
    back = images.read_image(tmp_path / "a.hdr")
    assert np.abs(back.rgb - array).max() < 0.01 * array.max()
    assert images.read_header(tmp_path / "a.hdr").width == 9


def test_sixteen_bits_are_kept(tmp_path):
    import cv2

    codes = np.arange(4 * 5 * 3, dtype=np.uint16).reshape(4, 5, 3) * 3 + 30000
    cv2.imwrite(str(tmp_path / "a.png"), codes[..., ::-1])
    np.testing.assert_allclose(
        images.read_image(tmp_path / "a.png").rgb,
        linear_from_srgb(codes / np.float32(65535)),
        rtol=1e-5,
    )
    assert len(np.unique(images.read_data(tmp_path / "a.png"))) == codes.size


def test_alpha_is_composited_on_black_in_linear_light(tmp_path):
    rgba = np.zeros((2, 2, 4), np.uint8)
    rgba[..., :3], rgba[..., 3] = 188, 128
    PilImage.fromarray(rgba).save(tmp_path / "a.png")
    image = images.read_image(tmp_path / "a.png")
    np.testing.assert_allclose(image.alpha, 128 / 255)
    np.testing.assert_allclose(image.rgb, linear_from_srgb(188 / 255) * 128 / 255, rtol=1e-6)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation_is_applied_once(tmp_path, orientation):
    """A red upper left corner stays in the upper left corner of the upright picture, whatever the
    sensor's orientation."""
    upright = np.zeros((24, 16, 3), np.uint8)
    upright[:8, :8, 0] = 255
    stored = {
        1: upright, 2: upright[:, ::-1], 3: upright[::-1, ::-1], 4: upright[::-1], 5: upright.transpose(1, 0, 2),
        6: np.rot90(upright, 1), 7: upright[::-1, ::-1].transpose(1, 0, 2), 8: np.rot90(upright, -1),
    }[orientation]  # fmt: skip
    exif = PilImage.Exif()
    exif[0x0112] = orientation
    PilImage.fromarray(np.ascontiguousarray(stored)).save(
        tmp_path / "a.jpg", exif=exif, quality=95, subsampling=0
    )
    image, header = images.read_image(tmp_path / "a.jpg"), images.read_header(tmp_path / "a.jpg")
    assert image.rgb.shape == (24, 16, 3) and (header.width, header.height) == (16, 24)
    assert (
        image.rgb[3, 3, 0] > 0.9
        and image.rgb[20, 12, 0] < 0.1
        and image.rgb[3, 12, 0] < 0.1
        and image.rgb[20, 3, 0] < 0.1
    )
    np.testing.assert_allclose(images.read_small(tmp_path / "a.jpg", 64).rgb, image.rgb, atol=0.02)
    assert images.read_image(tmp_path / "a.jpg", upright=False).rgb.shape == (*stored.shape[:2], 3)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_sixteen_bit_files_turn_as_eight_bit_ones(tmp_path, orientation):
    codes = np.random.default_rng(0).integers(0, 255, (5, 7, 3)).astype(np.uint8)
    wide = images.turn_upright(codes, orientation)
    exif = PilImage.Exif()
    exif[0x0112] = orientation
    PilImage.fromarray(codes).save(tmp_path / "a.png", exif=exif)
    np.testing.assert_allclose(
        images.read_image(tmp_path / "a.png").rgb,
        linear_from_srgb(wide / np.float32(255)),
        rtol=1e-6,
    )


@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientation_of_a_png_in_a_raw_profile(tmp_path, orientation):
    """ImageMagick writes EXIF as hexadecimal text; header, pixels and small copy agree about it."""
    from PIL.PngImagePlugin import PngInfo

    codes = np.random.default_rng(0).integers(0, 255, (24, 32, 3)).astype(np.uint8)
    exif, info = PilImage.Exif(), PngInfo()
    exif[0x0112] = orientation
    block = exif.tobytes()
    info.add_text("Raw profile type exif", f"\nexif\n{len(block):8d}\n{block.hex()}\n", zip=True)
    PilImage.fromarray(codes).save(tmp_path / "a.png", pnginfo=info)
    image, header = images.read_image(tmp_path / "a.png"), images.read_header(tmp_path / "a.png")
    np.testing.assert_allclose(
        image.rgb,
        linear_from_srgb(images.turn_upright(codes, orientation) / np.float32(255)),
        rtol=1e-6,
    )
    assert (header.height, header.width, header.orientation) == (*image.rgb.shape[:2], orientation)
    np.testing.assert_allclose(images.read_small(tmp_path / "a.png", 64).rgb, image.rgb, atol=1e-5)
    assert images.read_image(tmp_path / "a.png", upright=False).rgb.shape == (24, 32, 3)


def test_exif_focal_is_the_35mm_equivalent_on_the_diagonal(tmp_path):
    exif = PilImage.Exif()
    exif.get_ifd(0x8769)[0xA405] = 26
    PilImage.fromarray(np.zeros((30, 40, 3), np.uint8)).save(tmp_path / "a.jpg", exif=exif)
    assert images.read_header(tmp_path / "a.jpg").focal == pytest.approx(26 * 50 / 43.2666)


def test_nan_in_an_exr_is_refused_with_its_place(tmp_path):
    array = np.ones((4, 5, 3), np.float32)
    array[2, 3, 1] = np.nan
    images.write_linear(tmp_path / "a.exr", array)
    with pytest.raises(UserError, match=r"1 pixels that are NaN or infinite .*column 3, row 2"):
        images.read_image(tmp_path / "a.exr")


def write_tiff(path, array: np.ndarray, kind: int = 3, orientation: int = 1) -> None:
    """(H, W, C), one strip, as TIFF 6.0 says. kind: 1 of whole numbers, 3 of floats."""
    h, w, c = array.shape
    shorts = {
        256: [w],
        257: [h],
        258: [8 * array.itemsize] * c,
        259: [1],
        262: [2],
        277: [c],
        274: [orientation],
        278: [h],
        284: [1],
    }
    shorts |= {339: [kind] * c} | ({338: [2]} if c == 4 else {})
    tags = {k: (3, v) for k, v in shorts.items()} | {273: (4, [0]), 279: (4, [array.nbytes])}
    begin = 8 + 2 + 12 * len(tags) + 4
    extra = b"".join(struct.pack(f"<{c}H", *v) for k, (_, v) in sorted(tags.items()) if len(v) > 2)
    tags[273] = (4, [begin + len(extra)])
    head, at = struct.pack("<2sHIH", b"II", 42, 8, len(tags)), begin
    for tag, (size, values) in sorted(tags.items()):
        if len(values) > 2:
            head, at = head + struct.pack("<HHII", tag, size, len(values), at), at + 2 * len(values)
        else:
            head += struct.pack("<HHI", tag, size, len(values)) + struct.pack("<I", values[0])
    path.write_bytes(head + struct.pack("<I", 0) + extra + array.tobytes())


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.float32])
def test_a_tiff_is_turned_once(tmp_path, kind, orientation):
    array = np.random.default_rng(0).uniform(0, 200, (6, 8, 3)).astype(kind)
    write_tiff(tmp_path / "a.tif", array, 3 if kind is np.float32 else 1, orientation)
    expected = images.turn_upright(array, orientation)
    white = 1 if kind is np.float32 else np.iinfo(kind).max
    np.testing.assert_allclose(images.read_data(tmp_path / "a.tif"), expected / white, rtol=1e-6)
    header = images.read_header(tmp_path / "a.tif")
    assert (header.height, header.width) == expected.shape[:2]
    small = images.read_small(tmp_path / "a.tif").rgb
    np.testing.assert_allclose(small, images.read_image(tmp_path / "a.tif").rgb, atol=0.004)


@pytest.mark.parametrize("channels", [3, 4])
def test_a_tiff_of_float_colours_is_linear(tmp_path, channels):
    path, array = (
        tmp_path / "a.tif",
        np.random.default_rng(0).uniform(0, 3, (6, 8, channels)).astype(np.float32),
    )
    write_tiff(path, array, orientation=6)
    array = images.turn_upright(array, 6)
    header = images.read_header(path)
    assert (header.width, header.height, header.alpha, header.orientation) == (
        6,
        8,
        channels == 4,
        6,
    )
    for image in (images.read_image(path), images.read_small(path)):
        np.testing.assert_array_equal(image.rgb, array[..., :3])
        assert image.clipped is None and (image.alpha is None) == (channels == 3)
    array[2, 3] = np.nan
    write_tiff(path, array)
    with pytest.raises(UserError, match="pixels that are NaN or infinite"):
        images.read_image(path)


def test_a_tiff_of_floats_that_cannot_be_read_says_so(tmp_path, capfd):
    array = np.ones((6, 8, 3), np.float32)
    write_tiff(tmp_path / "half.tif", array.astype(np.float16))
    write_tiff(tmp_path / "short.tif", array)
    (tmp_path / "short.tif").write_bytes((tmp_path / "short.tif").read_bytes()[:-200])
    for name in ("half.tif", "short.tif"):
        with pytest.raises(UserError, match="floating-point TIFF cannot be read") as caught:
            images.read_image(tmp_path / name)
        assert "EXR" in caught.value.fix


def test_a_tiff_of_grey_floats_is_linear_and_checked(tmp_path):
    grey = np.linspace(0, 2, 48, dtype=np.float32).reshape(6, 8)
    PilImage.fromarray(grey).save(tmp_path / "a.tif")
    for rgb in (
        images.read_image(tmp_path / "a.tif").rgb,
        images.read_small(tmp_path / "a.tif").rgb,
    ):
        np.testing.assert_array_equal(rgb, np.repeat(grey[..., None], 3, axis=2))
    grey[2, 3] = np.nan
    PilImage.fromarray(grey).save(tmp_path / "a.tif")
    with pytest.raises(UserError, match=r"1 pixels that are NaN or infinite .*column 3, row 2"):
        images.read_image(tmp_path / "a.tif")


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".exr", ".hdr"])
def test_a_truncated_file_is_refused(tmp_path, suffix):
    array = np.random.default_rng(0).uniform(size=(64, 64, 3)).astype(np.float32)
    whole = tmp_path / f"a{suffix}"
    (images.write_linear if suffix in images.FLOAT else images.write_srgb)(whole, array)
    cut = tmp_path / f"cut{suffix}"
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size // 3])
    with pytest.raises(UserError, match="cannot be read"):
        images.read_image(cut)


def test_missing_unknown_and_oversized_files(tmp_path, monkeypatch):
    with pytest.raises(UserError, match="missing"):
        images.read_image(tmp_path / "none.png")
    (tmp_path / "a.txt").write_text("no picture")
    with pytest.raises(UserError, match="not an image format"):
        images.read_image(tmp_path / "a.txt")
    images.write_srgb(tmp_path / "a.png", RAMP)
    monkeypatch.setattr(images.decode, "MAX_PIXELS", 10)
    with pytest.raises(UserError, match="too large: 8 x 6"):
        images.read_image(tmp_path / "a.png")


@pytest.mark.parametrize(
    "name, module, extra",
    [("a.heic", "pillow_heif", "relit[heic]"), ("a.nef", "rawpy", "relit[raw]")],
)
def test_optional_formats_say_what_to_install(tmp_path, monkeypatch, name, module, extra):
    monkeypatch.setitem(sys.modules, module, None)
    (tmp_path / name).write_bytes(b"x" * 64)
    for read in (images.read_image, images.read_header):
        with pytest.raises(UserError, match="need an optional package") as caught:
            read(tmp_path / name)
        assert extra in caught.value.fix


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".exr"])
def test_small_copies_agree_with_the_whole_picture(tmp_path, suffix):
    import cv2

    y, x = np.mgrid[:96, :128]
    array = np.stack([x / 128, y / 96, 0.5 + 0 * x], -1).astype(np.float32)
    (images.write_linear if suffix == ".exr" else images.write_srgb)(tmp_path / f"a{suffix}", array)
    small = images.read_small(tmp_path / f"a{suffix}", 32)
    assert max(small.rgb.shape) <= 64 and small.alpha is None
    h, w = small.rgb.shape[:2]
    np.testing.assert_allclose(
        small.rgb, cv2.resize(array, (w, h), interpolation=cv2.INTER_AREA), atol=0.03
    )


@pytest.mark.parametrize(
    "data, display", [((1, 1, 2, 3), (0, 0, 5, 4)), ((-1, -1, 4, 4), (0, 0, 3, 2))]
)
def test_the_display_window_of_an_exr_is_read(tmp_path, data, display):
    import OpenEXR

    (x0, y0, x1, y1), (_, _, u1, v1) = data, display
    y, x = np.mgrid[y0 : y1 + 1, x0 : x1 + 1]
    pixels = np.stack([x, y, x + 0 * y], -1).astype(np.float32) + 10
    head = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    head["dataWindow"] = (np.array([x0, y0], np.int32), np.array([x1, y1], np.int32))
    head["displayWindow"] = (np.array([0, 0], np.int32), np.array([u1, v1], np.int32))
    with OpenEXR.File(head, {"RGB": np.ascontiguousarray(pixels)}) as f:
        f.write(str(tmp_path / "a.exr"))
    rgb = images.read_image(tmp_path / "a.exr").rgb
    assert rgb.shape == (v1 + 1, u1 + 1, 3)
    for row, col in ((0, 0), (2, 1), (2, 2), (v1, u1)):
        inside = x0 <= col <= x1 and y0 <= row <= y1
        np.testing.assert_array_equal(
            rgb[row, col], [col + 10, row + 10, col + 10] if inside else [0, 0, 0]
        )


def test_layers_of_an_exr(tmp_path):
    import OpenEXR

    plane = np.full((3, 4), 2, np.float32)
    channels = {"Depth.Z": plane * 9, **{f"Image.{c}": plane * i for i, c in enumerate("RGB")}}
    with OpenEXR.File(
        {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, channels
    ) as f:
        f.write(str(tmp_path / "a.exr"))
    np.testing.assert_array_equal(images.read_image(tmp_path / "a.exr").rgb[0, 0], [0, 2, 4])


def test_a_failed_write_leaves_the_old_file(tmp_path):
    target = tmp_path / "a.png"
    images.write_srgb(target, RAMP)
    before = target.read_bytes()
    with pytest.raises(UserError):
        images.write_linear(target, RAMP)
    assert target.read_bytes() == before and list(tmp_path.iterdir()) == [target]
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError) as caught:
        images.write_srgb(tmp_path / "file" / "a.png", RAMP)
    assert caught.value.code == EXIT_ENVIRONMENT


def test_encoders():
    assert images.encode_jpeg(RAMP)[:2] == b"\xff\xd8" and images.encode_png(RAMP)[:4] == b"\x89PNG"


# ---------------------------------------------------------------- colour profiles

P3_TO_XYZ = np.array(
    [[0.51512, 0.29198, 0.15710], [0.24120, 0.69225, 0.06657], [-0.00105, 0.04189, 0.78407]]
)  # adapted to D50
SRGB_TO_XYZ = np.array(
    [[0.43607, 0.38515, 0.14307], [0.22249, 0.71687, 0.06061], [0.01392, 0.09708, 0.71410]]
)
GAMMA = 2.19921875  # a curve of one number in an ICC profile: unsigned 8.8


def p3_profile(name=b"Display P3") -> bytes:
    """A version 2 matrix profile (ICC.1:2001-04) with Display P3's primaries and a plain gamma."""

    def xyz(v):
        return b"XYZ " + bytes(4) + b"".join(struct.pack(">i", round(float(x) * 65536)) for x in v)

    text = (
        b"desc" + bytes(4) + struct.pack(">I", len(name) + 1) + name + bytes(1 + 4 + 4 + 2 + 1 + 67)
    )
    curve = b"curv" + bytes(4) + struct.pack(">IH", 1, round(GAMMA * 256)) + bytes(2)
    tags = {
        b"desc": text + bytes(-len(text) % 4),
        b"wtpt": xyz([0.9642, 1.0, 0.8249]),
        b"cprt": b"text" + bytes(4) + b"none" + bytes(4),
    }
    for k, c in enumerate((b"r", b"g", b"b")):
        tags[c + b"XYZ"], tags[c + b"TRC"] = xyz(P3_TO_XYZ[:, k]), curve
    table, body, at = b"", b"", 128 + 4 + 12 * len(tags)
    for tag, data in tags.items():
        table += tag + struct.pack(">II", at + len(body), len(data))
        body += data
    head = struct.pack(
        ">I4sI4s4s4s", at + len(body), b"none", 0x02400000, b"mntr", b"RGB ", b"XYZ "
    )
    head += (
        struct.pack(">6H", 2026, 1, 1, 0, 0, 0)
        + b"acsp"
        + bytes(28)
        + xyz([0.9642, 1.0, 0.8249])[8:]
    )
    return head.ljust(128, bytes(1)) + struct.pack(">I", len(tags)) + table + body


@pytest.mark.parametrize("mode, suffix", [("RGB", ".png"), ("RGBA", ".png"), ("RGB", ".jpg")])
def test_display_p3_photos_are_carried_to_srgb(tmp_path, mode, suffix):
    from PIL import Image

    from relit.images.read import read_small

    codes = np.array([180, 90, 60, 200][: len(mode)], np.uint8)
    picture = Image.fromarray(np.broadcast_to(codes, (16, 16, len(mode))).copy())
    path = tmp_path / f"a{suffix}"
    picture.save(
        path,
        icc_profile=p3_profile(),
        **({"quality": 100, "subsampling": 0} if suffix == ".jpg" else {}),
    )
    linear = (codes[:3] / 255.0) ** GAMMA
    expected = np.linalg.inv(SRGB_TO_XYZ) @ P3_TO_XYZ @ linear
    alpha = codes[3] / 255 if mode == "RGBA" else 1.0
    got = images.read_image(path)
    np.testing.assert_allclose(got.rgb[8, 8], expected * alpha, atol=0.01)
    assert np.abs(expected - linear).max() > 0.03  # the profile matters
    np.testing.assert_allclose(read_small(path, 8).rgb[4, 4], expected, atol=0.01)
    np.testing.assert_allclose(
        images.read_data(path)[8, 8] * 255, codes, atol=1.01
    )  # data has no colour
    if mode == "RGBA":
        np.testing.assert_allclose(got.alpha, 200 / 255, atol=1e-6)


def test_srgb_and_broken_profiles_change_nothing(tmp_path):
    from PIL import Image

    picture = Image.fromarray(np.full((8, 8, 3), (180, 90, 60), np.uint8))
    picture.save(tmp_path / "plain.png")
    plain = images.read_image(tmp_path / "plain.png").rgb
    for k, profile in enumerate((p3_profile(b"sRGB IEC61966-2.1"), b"no profile at all" * 20)):
        picture.save(tmp_path / f"{k}.png", icc_profile=profile)
        np.testing.assert_array_equal(images.read_image(tmp_path / f"{k}.png").rgb, plain)

"""HEIC and RAW photos and the segmenter, with the packages of the optional extras; without them
each test says what is missing."""

import numpy as np
import pytest
from PIL import Image

from relit import images
from relit.errors import UserError
from relit.images.read import read_small
from relit.masks.segment import segmenter

COLOURS = np.array(
    [[[0.5, 0.1, 0.1], [0.1, 0.5, 0.1]], [[0.1, 0.1, 0.5], [0.25, 0.25, 0.25]]], np.float32
)  # of the four quarters


def quarters(height=96, width=160):
    """(H, W, 3) linear: red, green / blue, grey."""
    return np.repeat(np.repeat(COLOURS, height // 2, 0), width // 2, 1)


def middles(picture):
    """(2, 2, 3) colours in the middle of the quarters."""
    h, w = picture.shape[:2]
    return picture[np.ix_([h // 4, 3 * h // 4], [w // 4, 3 * w // 4])]


def exif(orientation, equivalent=26):
    out = Image.Exif()
    out[0x0112] = orientation
    out.get_ifd(0x8769)[0xA405] = equivalent
    return out.tobytes()


def turned(array, orientation):
    return images.turn_upright(array, orientation)


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_heic_photos_stand_upright_and_know_their_focal_length(tmp_path, orientation):
    heif = pytest.importorskip("pillow_heif", reason="needs pillow-heif (the extra `heic`)")
    heif.register_heif_opener()
    stored = as_codes(quarters())
    path = tmp_path / "a.heic"
    stored.save(path, quality=95, exif=exif(orientation))
    picture, header = images.read_image(path), images.read_header(path)
    expected = turned(quarters(), orientation)
    assert (
        picture.rgb.shape == expected.shape and (header.height, header.width) == expected.shape[:2]
    )
    np.testing.assert_allclose(middles(picture.rgb), middles(expected), atol=0.02)
    assert header.focal == pytest.approx(26 * np.hypot(160, 96) / 43.2666, rel=1e-3)
    np.testing.assert_allclose(middles(read_small(path, 48).rgb), middles(expected), atol=0.02)


def as_codes(linear):
    from relit.conventions import srgb_from_linear

    return Image.fromarray((srgb_from_linear(linear) * 255 + 0.5).astype(np.uint8))


def test_a_damaged_heic_is_answered(tmp_path):
    heif = pytest.importorskip("pillow_heif", reason="needs pillow-heif (the extra `heic`)")
    heif.register_heif_opener()
    path = tmp_path / "a.heic"
    noise = np.random.default_rng(0).integers(0, 255, (96, 160, 3), np.uint8)
    Image.fromarray(noise).save(path, quality=90)
    whole = path.read_bytes()
    for part in (0.05, 0.7):
        path.write_bytes(whole[: int(part * len(whole))])
        with pytest.raises(UserError, match="cannot be read"):
            images.read_image(path)


# ---------------------------------------------------------------- RAW

XYZ_FROM_RGB = np.array(
    [
        [0.4124564, 0.3575761, 0.1804375],
        [0.2126729, 0.7151522, 0.0721750],
        [0.0193339, 0.1191920, 0.9503041],
    ]
)


def rationals(values):
    return [int(n) for v in values for n in (round(float(v) * 10000), 10000)]


def write_dng(path, rgb, orientation=1, white=16383, neutral=(1.0, 1.0, 1.0)):
    """A DNG file of a camera that sees linear Rec.709 times `neutral`, as a Bayer mosaic of `rgb`
    (H, W, 3)."""
    tifffile = pytest.importorskip("tifffile", reason="comes with scikit-image")
    codes = (np.clip(rgb * np.array(neutral), 0, 1) * white).round().astype(np.uint16)
    mosaic = codes[..., 1].copy()
    mosaic[0::2, 0::2], mosaic[1::2, 1::2] = codes[0::2, 0::2, 0], codes[1::2, 1::2, 2]
    matrix = np.diag(neutral) @ np.linalg.inv(XYZ_FROM_RGB)
    tags = [
        (50706, 1, 4, b"\x01\x04\x00\x00", True),  # DNGVersion
        (50707, 1, 4, b"\x01\x01\x00\x00", True),
        (50708, 2, 0, "Test", True),  # UniqueCameraModel
        (271, 2, 0, "Test", True),
        (272, 2, 0, "Test", True),
        (274, 3, 1, orientation, True),
        (33421, 3, 2, (2, 2), True),  # CFARepeatPatternDim
        (33422, 1, 4, b"\x00\x01\x01\x02", True),  # CFAPattern: RGGB
        (50714, 4, 1, 0, True),  # BlackLevel
        (50717, 4, 1, white, True),
        (50721, 10, 9, rationals(matrix.ravel()), True),  # ColorMatrix1
        (50728, 5, 3, rationals(neutral), True),  # AsShotNeutral
        (50778, 3, 1, 21, True),  # CalibrationIlluminant1: D65
    ]
    tifffile.imwrite(path, mosaic, photometric=32803, extratags=tags, metadata=None)
    return path


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_raw_photos_are_linear_with_the_cameras_white_balance(tmp_path, orientation):
    pytest.importorskip("rawpy", reason="needs rawpy (the extra `raw`)")
    path = write_dng(tmp_path / "a.dng", quarters(), orientation, neutral=(0.5, 1.0, 0.7))
    picture, header = images.read_image(path), images.read_header(path)
    expected = turned(quarters(), orientation)
    assert (
        picture.rgb.shape == expected.shape and (header.height, header.width) == expected.shape[:2]
    )
    assert header.orientation == orientation and picture.clipped is not None
    got = middles(picture.rgb)
    np.testing.assert_allclose(
        got / got.max(), middles(expected) / 0.5, atol=0.01
    )  # exposure is free, colours and linearity are not
    as_stored = images.read_image(path, upright=False).rgb
    np.testing.assert_allclose(middles(as_stored), turned_back(got, orientation), atol=1e-3)
    np.testing.assert_allclose(middles(read_small(path, 48).rgb), got, atol=0.01)


def turned_back(array, orientation):
    return turned(array, {6: 8, 8: 6}.get(orientation, orientation))


@pytest.mark.parametrize("content", [b"nonsense" * 50, None])
def test_a_damaged_raw_file_is_answered(tmp_path, content):
    pytest.importorskip("rawpy", reason="needs rawpy (the extra `raw`)")
    path = write_dng(tmp_path / "a.dng", quarters())
    path.write_bytes(content or path.read_bytes()[:9000])
    with pytest.raises(UserError, match="cannot be read"):
        images.read_image(path)


def test_raw_files_of_any_size_are_not_decoded(tmp_path, monkeypatch):
    pytest.importorskip("rawpy", reason="needs rawpy (the extra `raw`)")
    path = write_dng(tmp_path / "a.dng", quarters())
    monkeypatch.setattr(images.decode, "MAX_PIXELS", 1000)
    for read in (images.read_image, images.read_header):
        with pytest.raises(UserError, match="too large: 160 x 96"):
            read(path)


# ---------------------------------------------------------------- the segmenter


def write_model(path):
    """A network with U^2-Net's signature whose mask is what is blue."""
    onnx = pytest.importorskip("onnx", reason="needs onnx to write a small network")
    h, t = onnx.helper, onnx.TensorProto
    weight = h.make_tensor("w", t.FLOAT, [1, 3, 1, 1], [0.0, 0.0, 1.0])
    nodes = [h.make_node("Conv", ["input.1", "w"], ["y"]), h.make_node("Sigmoid", ["y"], ["out"])]
    ends = [
        h.make_tensor_value_info(n, t.FLOAT, [1, c, 320, 320])
        for n, c in (("input.1", 3), ("out", 1))
    ]
    model = h.make_model(
        h.make_graph(nodes, "blue", ends[:1], ends[1:], [weight]),
        opset_imports=[h.make_opsetid("", 13)],
    )
    model.ir_version = 8
    path.parent.mkdir(parents=True, exist_ok=True)
    onnx.save(model, path)


def test_the_segmenter_runs_a_network_from_the_folder_of_weights(tmp_path, monkeypatch):
    pytest.importorskip("onnxruntime", reason="needs onnxruntime (the extra `segment`)")
    monkeypatch.setenv("RELIT_CACHE", str(tmp_path / "cache"))
    write_model(tmp_path / "u2net.onnx")
    picture = np.full((60, 90, 3), 0.05, np.float32)
    picture[20:40, 30:60] = (0.05, 0.05, 0.9)
    mask = segmenter(str(tmp_path / "u2net.onnx"))(picture)
    assert mask.shape == (60, 90) and mask.dtype == np.float32
    inside = np.zeros((60, 90), bool)
    inside[20:40, 30:60] = True
    assert mask[inside].mean() > 0.9 and mask[~inside].mean() < 0.2


def test_a_capture_with_the_segmenters_masks(tmp_path, monkeypatch):
    pytest.importorskip("onnxruntime", reason="needs onnxruntime (the extra `segment`)")
    monkeypatch.setenv("RELIT_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("RELIT_SEGMENTER", str(tmp_path / "weights" / "u2net.onnx"))
    write_model(tmp_path / "weights" / "u2net.onnx")
    from relit.capture.open import open_capture

    rng = np.random.default_rng(0)
    for i in range(3):
        picture = rng.uniform(0.0, 0.2, (60, 90, 3)).astype(np.float32)
        picture[15:45, 25:65, 2] = 0.9
        images.write_srgb(tmp_path / "photos" / f"{i}.png", picture)
    capture = open_capture(tmp_path / "photos", masks="segment")
    mask = capture.photos[1].load().mask
    assert mask[20:40, 30:60].mean() > 0.8 and mask[:10].mean() < 0.2
    assert any("segmenter" in note for note in capture.notes)

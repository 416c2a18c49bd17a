"""The segmenter: what a network is given, which masks are kept, where weights come from."""

import hashlib
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from relit.conventions import linear_from_srgb
from relit.errors import EXIT_ENVIRONMENT, UserError
from relit.masks.segment import KINDS, Segmenter, segmenter
from relit.masks.weights import SEGMENTER, Weights, find_segmenter, keep_weights, kept_weights

ISNET = Path(__file__).parents[3] / "shared/data/weights/isnet/isnet_small.onnx"


class Session:
    """Stands for ONNX Runtime: the mask is what is brighter in red than its mean input."""

    def __init__(self):
        self.given = []

    def get_inputs(self):
        return [SimpleNamespace(name="input")]

    def run(self, names, given):
        x = given["input"]
        self.given.append(x)
        return [(x[:, :1] > x[:, :1].mean()).astype(np.float32), None]


@pytest.fixture
def network(tmp_path, monkeypatch):
    monkeypatch.setenv("RELIT_CACHE", str(tmp_path / "cache"))
    file = tmp_path / "mine.onnx"
    file.write_bytes(b"weights")
    return lambda side: Segmenter(file, Session(), side, "sum")


@pytest.mark.parametrize("side", KINDS)
def test_a_network_gets_codes_as_it_was_trained_on_them(network, side):
    one, kind = network(side), KINDS[side]
    codes = np.array([20, 128, 250], np.float32)
    one(np.broadcast_to(linear_from_srgb(codes / 255), (40, 60, 3)).astype(np.float32))
    (given,) = one.session.given
    assert given.shape == (1, 3, side, side) and given.dtype == np.float32
    expected = (codes - np.array(kind.mean)) / np.array(kind.spread)
    np.testing.assert_allclose(given[0, :, 5, 5], expected, atol=0.02)


def test_a_mask_has_the_size_of_its_photo_and_lies_where_the_object_is(network):
    rgb = np.zeros((90, 160, 3), np.float32)
    rgb[20:60, 30:80] = 0.8
    mask = network(320)(rgb)
    assert mask.shape == (90, 160) and mask.dtype == np.float32
    assert mask[30:50, 40:70].min() > 0.9 and mask[:10].max() < 0.1 and mask[:, 100:].max() < 0.1


def test_a_photo_is_segmented_once(network, tmp_path):
    one, photo = network(320), tmp_path / "a.jpg"
    photo.write_bytes(b"first")
    rgb = np.zeros((48, 64, 3), np.float32)
    rgb[10:30, 20:50] = 1
    first = one.kept(photo, rgb.shape[:2], lambda: rgb)
    again = one.kept(photo, rgb.shape[:2], lambda: rgb)
    assert len(one.session.given) == 1 and np.abs(first - again).max() < 1 / 255
    photo.write_bytes(b"another photo of that name")
    one.kept(photo, rgb.shape[:2], lambda: rgb)
    assert len(one.session.given) == 2
    one.kept(photo, (20, 30), lambda: rgb[:20, :30])  # decoded at another size
    assert len(one.session.given) == 3


def test_weights_are_found_where_they_are_named_or_kept(tmp_path, monkeypatch):
    monkeypatch.setenv("RELIT_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("RELIT_SEGMENTER", raising=False)
    mine, other = tmp_path / "mine.onnx", tmp_path / "other.onnx"
    mine.write_bytes(b"a")
    other.write_bytes(b"b")
    assert find_segmenter(str(mine)) == mine
    monkeypatch.setenv("RELIT_SEGMENTER", str(other))
    assert find_segmenter() == other and find_segmenter(str(mine)) == mine
    monkeypatch.delenv("RELIT_SEGMENTER")
    kept = kept_weights()
    kept.parent.mkdir(parents=True)
    kept.write_bytes(b"c")
    assert find_segmenter() == kept and kept.is_relative_to(tmp_path)
    with pytest.raises(UserError, match="no network at"):
        find_segmenter("nowhere.onnx")


def test_a_file_is_kept_only_where_its_sum_is_right(tmp_path, monkeypatch):
    monkeypatch.setenv("RELIT_CACHE", str(tmp_path / "cache"))
    source = tmp_path / "given.onnx"
    source.write_bytes(b"some weights")
    right = Weights("n.onnx", "", hashlib.sha256(b"some weights").hexdigest(), 12, "mine")
    assert keep_weights(source, right).read_bytes() == b"some weights"
    with pytest.raises(UserError, match="not the one that was asked for"):
        keep_weights(source, SEGMENTER)
    assert not kept_weights().exists() and not list(kept_weights().parent.glob(".*"))


def test_without_a_network_it_is_said_how_to_bring_the_file(tmp_path, monkeypatch):
    monkeypatch.setenv("RELIT_CACHE", str(tmp_path / "cache"))
    nowhere = Weights("n.onnx", "http://127.0.0.1:9/n.onnx", "", 1, "mine")
    with pytest.raises(UserError, match="could not be fetched") as raised:
        keep_weights(None, nowhere)
    assert raised.value.code == EXIT_ENVIRONMENT and "--from FILE" in raised.value.fix


@pytest.mark.slow
def test_a_real_network_cuts_a_toy_from_its_turntable(tmp_path, monkeypatch):
    pytest.importorskip("onnxruntime", reason="needs onnxruntime (the extra `segment`)")
    photos = ISNET.parents[2] / "real/turntable_oxford_dino/images"
    if not (ISNET.is_file() and photos.is_dir()):
        pytest.skip("needs ../shared/data")
    from relit.images import read_image

    monkeypatch.setenv("RELIT_CACHE", str(tmp_path))
    rgb = read_image(sorted(photos.iterdir())[1]).rgb
    mask = segmenter(str(ISNET))(rgb)
    orange = rgb[..., 0] > 1.5 * rgb[..., 2]  # the toy; table and wall are blue
    both = (mask > 0.5) & orange
    assert both.sum() / ((mask > 0.5) | orange).sum() > 0.8


class Middle:
    """A network whose mask is the middle of the photo."""

    name = "the middle"

    def kept(self, path, shape, make):
        mask = np.zeros(shape, np.float32)
        h, w = shape
        mask[h // 4 : -h // 4, w // 4 : -w // 4] = 1
        return mask


@pytest.mark.parametrize("same", [True, False])
def test_masks_by_a_threshold_are_believed_where_the_segmenter_agrees(same):
    from relit.capture import mask_sources

    load = lambda: SimpleNamespace(mask=found)  # noqa: E731
    load.path = None
    found = np.zeros((80, 120), np.float32)
    found[(slice(20, 60), slice(30, 90)) if same else (slice(0, 24), slice(0, 120))] = 1
    photos = [SimpleNamespace(load=load, height=80, width=120)] * 3
    doubt = mask_sources._doubt(photos, photos, Middle())
    assert (doubt == "") == same and (same or "in 3 photos" in doubt)

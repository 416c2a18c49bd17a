"""LPIPS by a user's network. onnxruntime is optional, so a stand-in takes its place: its 'network'
is the mean absolute difference of the two inputs."""

from __future__ import annotations

import sys
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest

from relit.errors import UserError
from relit.evaluate.lpips import load_lpips
from relit.evaluate.picture_figures import definitions_of, picture_figures

FILE = "lpips_vgg.onnx"


class Session:
    names = ("in0", "in1")
    fed: ClassVar[list[dict]] = []

    def __init__(self, path, providers):
        if not path.endswith(FILE):
            raise RuntimeError("not a network\nsecond line")

    def get_inputs(self):
        return [SimpleNamespace(name=n) for n in self.names]

    def run(self, outputs, feed):
        self.fed.append(feed)
        a, b = feed["in0"], feed["in1"]
        return [np.abs(a - b).mean().reshape(1, 1, 1, 1)]


@pytest.fixture
def runtime(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "onnxruntime", SimpleNamespace(InferenceSession=Session))
    (tmp_path / FILE).write_bytes(b"")
    return tmp_path / FILE


def test_pictures_go_in_from_minus_one_to_one(runtime):
    distance = load_lpips(runtime)
    a, b = np.zeros((4, 6, 3)), np.full((4, 6, 3), 0.25)
    assert distance(a, b) == pytest.approx(0.5)
    fed = Session.fed[-1]["in1"]
    assert fed.shape == (1, 3, 4, 6) and fed.dtype == np.float32 and fed[0, 0, 0, 0] == -0.5


def test_it_stands_beside_the_other_figures(runtime):
    shown, truth = np.full((12, 12, 3), 0.5), np.full((12, 12, 3), 0.5)
    shown[6:] = 1.0
    inside = np.zeros((12, 12), bool)
    inside[:6] = True
    figures = picture_figures(shown, truth, inside, load_lpips(runtime))
    assert figures["lpips_masked"] == 0 < figures["lpips"]
    assert figures["psnr_masked"] == 100 > figures["psnr"]
    assert set(figures) == {n.removeprefix("x_") for n in definitions_of("x", "pictures")}
    assert "lpips" not in picture_figures(shown, truth, inside)


def test_what_is_missing_or_wrong_is_named(runtime, monkeypatch, tmp_path):
    with pytest.raises(UserError, match="no network at"):
        load_lpips(tmp_path / "other.onnx")
    (tmp_path / "text.onnx").write_text("x")
    with pytest.raises(UserError, match="cannot be read") as error:
        load_lpips(tmp_path / "text.onnx")
    assert error.value.why == "not a network"
    monkeypatch.setattr(Session, "names", ("only",))
    with pytest.raises(UserError, match="has 1 inputs"):
        load_lpips(runtime)
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(UserError, match="needs onnxruntime") as error:
        load_lpips(runtime)
    assert "relit[lpips]" in error.value.fix

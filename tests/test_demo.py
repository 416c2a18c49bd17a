"""The demo from the rendered capture to the printed figures, with tiny pictures and a tiny fit."""

from __future__ import annotations

import json

import numpy as np
import pytest

from relit import demo as module
from relit.asset.gltf import write_glb
from relit.errors import UserError
from relit.fit.multiview import recipe
from relit.images import write_linear
from relit.synthesize.procedural import evening, pawn, studio
from support.commands import TINY


@pytest.fixture
def folder(tmp_path, monkeypatch, report_sizes):
    """A folder in which the demo finds a small object and small lights of its own."""
    small = {"VIEWS": 3, "TEST_VIEWS": 1, "RESOLUTION": 32, "SPP": 4, "TEST_SPP": 16}
    for name, value in small.items():
        monkeypatch.setattr(module, name, value)
    options = {k: (v,) if k.startswith("level") else v for k, v in TINY.items()}
    monkeypatch.setitem(recipe.PRESETS, "draft", options)
    write_glb(tmp_path / "truth.glb", *pawn(10, 14, 16))
    write_linear(tmp_path / "light.exr", studio(8))
    write_linear(tmp_path / "other_light.exr", evening(8))
    return tmp_path


@pytest.mark.slow
def test_demo_ends_with_a_glb_a_report_and_scores(folder, capsys):
    run = module.demo(folder, device="cpu")
    assert run == folder / "run"
    assert (run / "asset/object.glb").read_bytes()[:4] == b"glTF"
    metrics = json.loads((run / "evaluation.json").read_text())["metrics"]
    assert set(module.SHOWN) <= set(metrics)
    assert all(np.isfinite(metrics[name]["value"]) for name in module.SHOWN)
    assert metrics["glb_roundtrip_psnr"]["value"] > 30
    page = (run / "report.html").read_text()
    assert "albedo_psnr" in page and "(held out)" in page
    said = capsys.readouterr()
    assert "4 of 4" in said.err and "object.glb" in said.out
    assert all(name in said.out for name in module.SHOWN)
    assert module.demo(folder, device="cpu") == run
    assert (run / "asset/object.glb").is_file()


def test_demo_refuses_a_file(tmp_path):
    (tmp_path / "f").write_text("mine")
    with pytest.raises(UserError, match="a file, not a folder"):
        module.demo(tmp_path / "f")

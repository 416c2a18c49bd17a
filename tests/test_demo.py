"""The demo's path with tiny pictures and the truth in the place of the fit: capture, scores,
report, printed figures."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from relit import demo as module
from relit.errors import UserError


@pytest.fixture
def tiny(monkeypatch):
    from relit import reconstruction as reconstruct
    from relit.asset.asset import save_asset
    from relit.images import read_image
    from relit.job import Job, open_input
    from relit.report import page as report
    from relit.run import Run
    from relit.scene import Asset
    from relit.synthesize import procedural
    from relit.synthesize.multiview import object_frame

    for name, value in {
        "VIEWS": 3,
        "TEST_VIEWS": 1,
        "RESOLUTION": 32,
        "SPP": 4,
        "TEST_SPP": 16,
    }.items():
        monkeypatch.setattr(module, name, value)
    for name, value in {
        "SIDE": 24,
        "STILLS": 2,
        "SPP": 1,
        "SPP_COMPARED": 1,
        "VIEWS": 1,
        "HELD_OUT": 1,
    }.items():
        monkeypatch.setattr(report, name, value)
    real = {name: getattr(procedural, name) for name in ("pawn", "studio", "evening")}
    monkeypatch.setattr(procedural, "pawn", lambda: real["pawn"](10, 14, 16))
    monkeypatch.setattr(procedural, "studio", lambda height=8: real["studio"](8))
    monkeypatch.setattr(procedural, "evening", lambda height=8: real["evening"](8))

    def stand_in(input, out, **_):
        capture = open_input(Path(input), Job())
        mesh, material = procedural.pawn()
        light = read_image(Path(input) / "truth/environment.exr").rgb
        asset = Asset(
            mesh,
            material,
            object_frame(mesh),
            light,
            tuple((p.name, p.camera) for p in capture.photos),
        )
        with Run.open(out, {"input": "capture", "quality": "draft"}) as run, run.stage("asset"):
            save_asset(run.folder / "asset", asset)

    monkeypatch.setattr(reconstruct, "reconstruct", stand_in)


def test_demo_ends_with_a_glb_a_report_and_scores(tiny, tmp_path, capsys):
    run = module.demo(tmp_path / "demo", device="cpu")
    assert run == tmp_path / "demo/run"
    assert (run / "asset/object.glb").read_bytes()[:4] == b"glTF"
    metrics = json.loads((run / "evaluation.json").read_text())["metrics"]
    assert (
        metrics["normal_mae"]["value"] < 1 and metrics["albedo_psnr"]["value"] > 35
    )  # the truth against itself
    page = (run / "report.html").read_text()
    assert "albedo_psnr" in page and "(held out)" in page
    said = capsys.readouterr()
    assert "4 of 4" in said.err and "object.glb" in said.out and "relit_psnr" in said.out


def test_demo_refuses_a_file(tmp_path):
    (tmp_path / "f").write_text("mine")
    with pytest.raises(UserError, match="a file, not a folder"):
        module.demo(tmp_path / "f")

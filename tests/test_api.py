"""Relit from Python: the same verbs as on the command line, and what a notebook shows."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

import relit
from relit.asset.asset import save_asset
from relit.errors import UserError
from relit.geometry.se3 import look_at
from relit.images import write_linear
from relit.scene import Asset, Camera
from relit.synthesize.procedural import pawn, studio
from relit.viewer.page import PAGE
from support.striped_ball import write_capture

TINY = {"levels": [16], "level_steps": [12], "rays": 128, "faces": 300, "texture": 16, "light": 4}
TINY |= {"surface_steps": 4, "points": 32, "directions": 4}


@pytest.fixture(scope="module")
def asset(tmp_path_factory):
    folder = tmp_path_factory.mktemp("asset") / "run & <b>"
    mesh, material = pawn(12, 16, 16)
    camera = Camera(24, 24, 30, 30, 12, 12, look_at([0, 1, 4], [0, 0.8, 0]))
    save_asset(folder / "asset", Asset(mesh, material, np.eye(4), studio(8), (("a.png", camera),)))
    return relit.load(folder)


@pytest.mark.slow
def test_from_photos_to_an_asset(tmp_path):
    folder = write_capture(tmp_path / "photos")
    capture = relit.open_capture(folder)
    assert len(capture.photos) == 6 and capture.has_cameras
    assert relit.inspect(folder)["photos"] == 6
    asset = relit.reconstruct(
        folder, tmp_path / "run", quality="draft", device="cpu", settings=TINY, report=False
    )
    assert isinstance(asset, relit.AssetFolder) and asset.folder == tmp_path / "run/asset"
    assert len(asset.asset.mesh.faces) > 50 and len(asset.asset.cameras) == 6


def test_relight_and_export(asset, tmp_path):
    write_linear(tmp_path / "light.hdr", studio(8))
    (picture,) = asset.relight(tmp_path / "light.hdr", size=24, spp=2, device="cpu")
    assert (
        isinstance(picture, Image.Image)
        and picture.size == (24, 24)
        and np.asarray(picture).max() > 30
    )
    files = asset.relight(
        tmp_path / "light.hdr", tmp_path / "out", cameras="capture", size=16, spp=1, device="cpu"
    )
    assert [f.suffix for f in files] == [".png"] and files[0].is_file()
    for name in ("a.glb", "a.obj", "a.ply"):
        assert asset.export(tmp_path / name).is_file()
    with pytest.raises(UserError, match="cannot be told from the ending"):
        asset.export(tmp_path / "a.fbx")


def test_what_a_notebook_shows(asset, monkeypatch):
    if PAGE.is_file():
        shown = asset._repr_html_()
        assert (
            shown.startswith("<iframe")
            and 'sandbox="allow-scripts"' in shown
            and shown.count('"') == 6
            and "model/gltf-binary" in shown
        )
    monkeypatch.setattr("relit.viewer.page.PAGE", PAGE.with_name("nowhere.html"))
    assert "&lt;b&gt;" in asset._repr_html_() and "make viewer" in asset._repr_html_()


def test_folders_that_hold_no_asset(tmp_path):
    with pytest.raises(UserError, match="not an asset folder"):
        relit.load(tmp_path)
    with pytest.raises(AttributeError, match="no attribute 'relght'"):
        _ = relit.relght


def test_import_is_quick_and_light():
    job = "import sys, relit; dir(relit); print({'mitsuba', 'numpy', 'cv2'} & set(sys.modules)); "
    job += "relit.open_capture; assert 'mitsuba' not in sys.modules"
    assert (
        subprocess.run(
            [sys.executable, "-c", job], capture_output=True, text=True, check=True
        ).stdout
        == "set()\n"
    )

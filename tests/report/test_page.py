"""report.html stands alone, shows what there is, says what there is not, and believes no name."""

from __future__ import annotations

import base64
import html.parser
import io
import json
import re

import numpy as np
import pytest
from PIL import Image

from relit.asset.asset import save_asset
from relit.conventions import environment_directions, environment_solid_angles
from relit.geometry.se3 import look_at
from relit.report import page as report
from relit.report.curves import ball_of, bars, camera_plot, curve
from relit.run import Run
from relit.scene import Asset, Camera, Capture, Photo, Pixels
from relit.synthesize.procedural import evening, pawn, studio

EVIL = "<script>alert(1)</script>.png"


@pytest.fixture(autouse=True)
def small(report_sizes):
    report_sizes(SIDE=40, STILLS=3, SPP=2, SPP_COMPARED=2, VIEWS=2)


@pytest.fixture(scope="module")
def asset():
    mesh, material = pawn(rows=10, columns=14, texture=16)
    place = np.diag([2.0, 2.0, 2.0, 1.0])
    cameras = []
    for i, angle in enumerate((0.0, 2.0, 4.0)):
        pose = look_at(np.array([6 * np.sin(angle), 2.5, 6 * np.cos(angle)]), np.array([0, 1.6, 0]))
        cameras.append((f"train/r_{i}.png" if i else EVIL, Camera(80, 60, 120, 120, 40, 30, pose)))
    return Asset(mesh, material, place, studio(8), tuple(cameras))


@pytest.fixture
def folder(tmp_path, asset):
    with Run.open(tmp_path / "run", {"input": EVIL, "quality": "draft", "seed": 3}) as run:
        with run.stage("volume", steps=20, title="volume pass") as stage:
            for i in range(1, 21):
                stage._written = -1e9  # write every step
                stage.step(i, colour=1.0 / i, eikonal=0.1)
        with run.stage("asset") as stage:
            save_asset(run.folder / "asset", asset)
            (stage.folder / "notes.json").write_text(json.dumps(["2 photos were <b>blurred</b>"]))
    return run.folder


def capture_of(asset):
    def photo(name, camera):
        rgb = np.full((60, 80, 3), 0.2, np.float32)
        return Photo(name, lambda: Pixels(rgb, np.ones((60, 80), np.float32)), 80, 60, camera)

    photos = [photo(name, camera) for name, camera in asset.cameras]
    return Capture(None, "photos", tuple(photos[:2]), held_out=(photos[2],))


class Reader(html.parser.HTMLParser):
    def __init__(self):
        super().__init__()
        self.sources, self.headings, self.text, self.open, self.tags = [], [], [], [], set()

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        self.sources += [v for k, v in attrs if k in ("src", "href")]
        if tag not in ("img", "meta", "rect", "polyline", "circle", "line"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        if tag in self.open:
            assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)
        if self.open and self.open[-1] == "h2":
            self.headings.append(data)


def read(path):
    reader = Reader()
    reader.feed(path.read_text(encoding="utf-8"))
    assert reader.open == []
    return reader


def test_the_report_stands_alone_and_shows_everything(folder, asset):
    metrics = {"relit_psnr": {"value": 31.25, "unit": "dB", "definition": "of <sRGB> pictures"}}
    (folder / "evaluation.json").write_text(json.dumps({"metrics": metrics}))
    path = report.write_report(folder, capture_of(asset))
    reader, text = read(path), path.read_text()
    assert "http" not in text and "script" not in reader.tags and "b" not in reader.tags
    assert all(source.startswith("data:image/jpeg;base64,") for source in reader.sources)
    for source in reader.sources:
        picture = np.asarray(Image.open(io.BytesIO(base64.b64decode(source.split(",")[1]))))
        assert picture.ndim == 3 and picture.std() > 0
    assert len(reader.sources) >= 3 + 8 + 2 + 4 + 3
    said = " ".join(reader.text)
    names = (
        "volume pass",
        "2 photos were <b>blurred</b>",
        "seed 3",
        "object.glb",
        "(held out)",
        EVIL,
    )
    for expected in ("31.25", "of <sRGB> pictures", *names):
        assert expected in said
    assert "Losses" in reader.headings and "Another light" in reader.headings
    assert str(folder) not in text  # movable: no absolute path


def test_the_report_says_what_is_missing(folder):
    (folder / "metrics.jsonl").unlink()
    said = " ".join(read(report.write_report(folder)).text)
    assert "No losses were recorded." in said and "No truth was given." in said
    assert "Photos and renders" not in said


def test_comparison_measures_where_the_object_is_drawn(asset, report_sizes):
    """Photos that are the report's own renders agree; grey ones do not."""
    report_sizes(SPP_COMPARED=32)
    from relit.reference.mitsuba_scene import build_scene, render

    scene = build_scene(asset.mesh, asset.material, asset.world_from_asset, asset.environment)
    camera = asset.cameras[1][1]
    rgb = render(scene, camera, spp=64)[..., :3]
    photo = Photo(asset.cameras[1][0], lambda: Pixels(rgb), 80, 60, camera)
    body = report._comparison(asset, Capture(None, "photos", (photo,)))
    got = float(re.search(r": ([\d.]+) dB", body)[1])
    assert got > 20
    grey = report._comparison(asset, capture_of(asset))
    assert float(re.search(r": ([\d.]+) dB", grey)[1]) < got


def test_curves():
    assert "(log)" in curve("a", [(1, 100.0), (2, 1.0)]) and "(log)" not in curve(
        "a", [(1, 1.0), (2, -1.0)]
    )
    assert curve("flat", [(1, 2.0), (2, 2.0)]).count("nan") == 0
    assert "&lt;" in curve("<", [(1, 1), (2, 2)]) and bars([]) == ""
    assert bars([("a", 0.0)]).count("<rect") == 1


def test_camera_plot_shows_every_camera_on_both_sides(asset):
    ball = ball_of(asset)
    vertices = (
        asset.mesh.vertices @ asset.world_from_asset[:3, :3].T + asset.world_from_asset[:3, 3]
    )
    assert np.linalg.norm(vertices @ ball[:3, :3].T + ball[:3, 3], axis=1).max() == pytest.approx(
        1, abs=1e-5
    )
    plot = camera_plot([c for _, c in asset.cameras], ball)
    assert plot.count("<line") == 2 * len(asset.cameras) and plot.count("<svg") == 1
    assert camera_plot([], ball) == ""


# ---------------------------------------------------------------- the demo's object and lights


def test_pawn_is_closed_smooth_and_in_range():
    import trimesh

    mesh, material = pawn(rows=24, columns=32, texture=64)
    welded = trimesh.Trimesh(
        mesh.vertices, mesh.faces, process=True, merge_tex=True, merge_norm=True
    )
    assert welded.is_watertight and welded.volume > 0.4
    corners = mesh.vertices[mesh.faces]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.linalg.norm(flat, axis=1) > 0).all()
    assert (
        np.einsum("ij,ij->i", flat, mesh.normals[mesh.faces].mean(1)) > 0
    ).all()  # counter-clockwise from outside
    assert np.allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-5)
    assert 0 <= mesh.uvs.min() and mesh.uvs.max() <= 1
    for array in (material.base_color, material.roughness, material.metallic):
        assert 0 <= array.min() and array.max() <= 1
    assert 0.03 < material.metallic.mean() < 0.3 and np.ptp(material.roughness) > 0.5


def test_lights_are_positive_bright_and_coloured():
    for light in (studio(64), evening(64)):
        assert light.shape == (64, 128, 3) and light.dtype == np.float32 and light.min() >= 0
        assert light.max() > 20 * light.mean()
    brightest = environment_directions(64, 128)[
        np.unravel_index(studio(64).sum(-1).argmax(), (64, 128))
    ]
    assert brightest @ np.array([0.55, 0.60, 0.58]) > 0.97
    mean = np.einsum("hwc,hw->c", studio(64), environment_solid_angles(64, 128)) / (4 * np.pi)
    assert (mean > 0.2).all() and (mean < 3).all()

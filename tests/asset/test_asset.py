"""The asset folder: written, moved, read; and what wrong folders are told."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from relit.asset.asset import (
    SCHEMA,
    cameras_from_json,
    cameras_to_json,
    load_asset,
    read_cameras,
    save_asset,
)
from relit.errors import UserError
from relit.images import read_data, read_image
from relit.reference.mitsuba_scene import build_scene, render


def test_round_trip_after_a_move(tmp_path, asset):
    save_asset(tmp_path / "run" / "asset", asset)
    shutil.move(tmp_path / "run", tmp_path / "elsewhere")
    for place in ("elsewhere", "elsewhere/asset"):
        got = load_asset(tmp_path / place)
        assert np.allclose(got.world_from_asset, asset.world_from_asset)
        assert np.array_equal(got.environment, asset.environment)
        assert got.meta == asset.meta
        assert np.array_equal(got.mesh.vertices, asset.mesh.vertices)
        for (name, camera), (old_name, old) in zip(got.cameras, asset.cameras, strict=True):
            assert name == old_name
            assert np.allclose(camera.world_from_camera, old.world_from_camera, atol=1e-12)
            assert (camera.width, camera.fx, camera.cx, camera.cy) == (
                old.width,
                old.fx,
                old.cx,
                old.cy,
            )
    c = asset.cameras[0][1]
    a, b = (
        render(build_scene(x.mesh, x.material, x.world_from_asset, x.environment), c, spp=8)
        for x in (asset, got)
    )
    assert a[..., 3].mean() > 0.1
    assert -10 * np.log10(np.mean((np.clip(a, 0, 1) - np.clip(b, 0, 1)) ** 2)) > 45


def test_layout(tmp_path, asset, material):
    folder = save_asset(tmp_path / "asset", asset)
    files = {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()}
    textures = {
        f"textures/{k}.png" for k in ("base_color", "roughness", "metallic", "specular", "normal")
    }
    assert (
        files
        == {
            "asset.json",
            "object.glb",
            "cameras.json",
            "lights/environment.exr",
            "lights/environment.hdr",
        }
        | textures
    )
    head = json.loads((folder / "asset.json").read_text())
    assert head["schema"] == SCHEMA
    assert np.allclose(head["world_from_asset"], asset.world_from_asset)
    frame = json.loads((folder / "cameras.json").read_text())["frames"][0]
    assert np.allclose(
        np.array(frame["transform_matrix"])[:3, 1], -asset.cameras[0][1].world_from_camera[:3, 1]
    )  # OpenGL: y up
    assert (
        np.abs(read_image(folder / "textures" / "base_color.png").rgb - material.base_color).max()
        < 0.006
    )
    assert (
        np.abs(read_data(folder / "textures" / "roughness.png") - material.roughness).max() < 0.003
    )
    assert np.allclose(
        read_image(folder / "lights" / "environment.hdr").rgb,
        asset.environment,
        rtol=0.02,
        atol=0.08,
    )
    assert (
        str(tmp_path)
        not in (folder / "asset.json").read_text() + (folder / "cameras.json").read_text()
    )


def test_saving_again_replaces_and_leaves_no_litter(tmp_path, asset):
    save_asset(tmp_path / "asset", asset)
    save_asset(tmp_path / "asset", replace(asset, environment=None, cameras=()))
    got = load_asset(tmp_path / "asset")
    assert got.environment is None
    assert got.cameras == ()
    assert [p.name for p in tmp_path.iterdir()] == ["asset"]


def test_a_failed_write_changes_nothing(tmp_path, asset, monkeypatch):
    save_asset(tmp_path / "asset", asset)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("relit.asset.asset.write_linear", full)
    with pytest.raises(UserError, match="could not be written"):
        save_asset(tmp_path / "asset", replace(asset, meta={"capture": "other"}))
    assert load_asset(tmp_path / "asset").meta == asset.meta
    assert [p.name for p in tmp_path.iterdir()] == ["asset"]


def test_a_folder_of_something_else_is_not_overwritten(tmp_path, asset):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "me.jpg").write_bytes(b"x")
    with pytest.raises(UserError, match="something else"):
        save_asset(tmp_path / "photos", asset)
    assert (tmp_path / "photos" / "me.jpg").read_bytes() == b"x"


@pytest.mark.parametrize(
    "kind",
    [
        "missing",
        "empty",
        "not json",
        "list",
        "no schema",
        "newer",
        "no matrix",
        "nan matrix",
        "no glb",
        "bad camera",
    ],
)
def test_bad_folders_get_an_answer(tmp_path, asset, kind):
    folder = tmp_path / "asset"
    if kind != "missing":
        save_asset(folder, asset)
        path = folder / "asset.json"
        head = json.loads(path.read_text())
        if kind == "empty":
            path.unlink()
        elif kind == "not json":
            path.write_text("{")
        elif kind == "list":
            path.write_text("[1]")
        elif kind == "no glb":
            (folder / "object.glb").unlink()
        elif kind == "bad camera":
            data = json.loads((folder / "cameras.json").read_text())
            data["frames"][0]["fl_x"] = -1
            (folder / "cameras.json").write_text(json.dumps(data))
        else:
            change = {
                "no schema": {"schema": "one"},
                "newer": {"schema": SCHEMA + 1},
                "no matrix": {"world_from_asset": [1, 2]},
            }
            head |= change.get(kind, {"world_from_asset": [[float("nan")] * 4] * 4})
            path.write_text(json.dumps(head))
    with pytest.raises(UserError) as e:
        load_asset(folder)
    assert e.value.fix


def test_cameras_with_distortion_and_shared_intrinsics(tmp_path, camera):
    distorted = replace(camera, distortion=(0.1, -0.2, 0.001, 0.0, 0.03))
    [(name, got)] = cameras_from_json(
        json.loads(json.dumps(cameras_to_json([("a.png", distorted)])))
    )
    assert name == "a.png"
    assert got.distortion == distorted.distortion
    pose = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]
    text = json.dumps(
        {"camera_angle_x": np.pi / 2, "w": 64, "h": 32, "frames": [{"transform_matrix": pose}]}
    )
    (tmp_path / "c.json").write_text(text)
    [(_, got)] = read_cameras(tmp_path / "c.json")
    assert (got.fx, got.fy, got.cx, got.cy) == (pytest.approx(32), pytest.approx(32), 32, 16)
    assert got.world_from_camera[2, 2] == -1

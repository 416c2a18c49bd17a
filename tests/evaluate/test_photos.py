"""Evaluation against photographs: an asset that is the truth, wrong ones, masks or none, given or
recovered cameras."""

import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from relit.asset.asset import save_asset
from relit.conventions import (
    move_pose,
    rotate_environment,
    sample_environment,
    similarity,
    world_from_gl_camera,
)
from relit.errors import UserError
from relit.evaluate import photos
from relit.evaluate.dispatch import evaluate
from relit.evaluate.roundtrip import glb_roundtrip, write_own_renders
from relit.geometry.se3 import look_at
from relit.images import write_linear
from relit.reference.mitsuba_scene import build_scene, render
from relit.scene import Asset, Camera, Material, Mesh, Sphere

SIZE, SPP = 48, 256


@pytest.fixture(scope="module")
def asset() -> Asset:
    ball = trimesh.creation.icosphere(3)
    v = ball.vertices.astype(np.float32)
    uvs = np.stack([np.where(v[:, 1] < 0, 0.25, 0.75), np.full(len(v), 0.5)], 1).astype(np.float32)
    base = np.full((2, 4, 3), 0.6, np.float32)
    base[:, :2] = (0.5, 0.2, 0.1)
    material = Material(base, np.full((1, 1), 0.6, np.float32), np.zeros((1, 1), np.float32))
    light = np.full((8, 16, 3), 0.25, np.float32) * np.array([1.0, 0.9, 0.8], np.float32)
    light[1:4, 3:6] += 1.5
    cameras = []
    for i, o in enumerate(
        [(3, 0.5, 0), (0, 0.8, 3), (-3, -0.5, 0.2), (0.3, 0.6, -3), (2, 1.5, 2), (-2, 1, 1.8)]
    ):
        pose = look_at(np.array(o) * 1.1)
        cameras.append(
            (
                f"{'train' if i < 4 else 'test'}/r_{i}.exr",
                Camera(SIZE, SIZE, 50.0, 50.0, SIZE / 2, SIZE / 2, pose),
            )
        )
    return Asset(
        Mesh(v, ball.faces.astype(np.int32), v, uvs), material, np.eye(4), light, tuple(cameras)
    )


def write_capture(folder, asset: Asset, alpha: bool, held_out: int = 2):
    """Photos of the asset from its cameras, the last ones set aside; with alpha, or before the
    light itself."""
    scene = build_scene(asset.mesh, asset.material, asset.world_from_asset, asset.environment)
    splits = (
        {"train": asset.cameras[:-held_out], "test": asset.cameras[-held_out:]}
        if held_out
        else {"train": asset.cameras}
    )
    for split, cameras in splits.items():
        frames = []
        for i, (name, camera) in enumerate(cameras):
            picture = render(scene, camera, spp=SPP, seed=100 + i)
            if not alpha:
                behind = sample_environment(asset.environment, photos.directions(camera))
                picture = picture[..., :3] + behind * (1 - picture[..., 3:])
            write_linear(folder / name, picture)
            frames.append(
                {
                    "file_path": name,
                    "transform_matrix": world_from_gl_camera(camera.world_from_camera).tolist(),
                }
            )
        angle = float(2 * np.arctan(SIZE / 100))
        (folder / f"transforms_{split}.json").write_text(
            json.dumps({"camera_angle_x": angle, "frames": frames})
        )
    return folder


@pytest.fixture(scope="module")
def masked(asset, tmp_path_factory):
    return write_capture(tmp_path_factory.mktemp("masked"), asset, True)


@pytest.fixture(scope="module")
def unmasked(asset, tmp_path_factory):
    return write_capture(tmp_path_factory.mktemp("unmasked"), asset, False)


def values(result):
    assert all(e["definition"] for e in result["metrics"].values())
    return {k: e["value"] for k, e in result["metrics"].items()}


@pytest.mark.slow
def test_the_asset_that_was_photographed(asset, masked, tmp_path):
    save_asset(tmp_path / "asset", asset)
    result = evaluate(tmp_path, masked, spp=SPP)
    got = values(result)
    assert (
        set(result["per_view"]) == {"test/r_4.exr", "test/r_5.exr"}
        and result["alignment"] == "identity"
    )
    assert (
        got["held_out_psnr_masked"] > 35
        and got["held_out_psnr"] > 33
        and got["held_out_mask_iou"] > 0.97
    )
    dark = photos.evaluate_on_photos(
        replace(asset, environment=asset.environment * 0.5), masked, spp=64
    )
    assert values(dark)["held_out_psnr_masked"] < 20


@pytest.mark.slow
def test_photos_without_masks_are_compared_over_the_object_sphere(asset, unmasked, tmp_path):
    config = tmp_path / "config.toml"
    config.write_text('masks = "none"\nsphere = [0.0, 0.0, 0.0, 1.2]\n')  # as the run was asked for
    got = values(photos.evaluate_on_photos(asset, unmasked, run=tmp_path, spp=SPP))
    assert got["held_out_psnr_sphere"] > 32 and got["held_out_psnr_covered"] > 34
    camera = asset.cameras[-1][1]
    distance = np.linalg.norm(camera.centre)
    share = (1 / (distance**2 - 1)) / (
        1.2**2 / (distance**2 - 1.2**2)
    )  # of the two discs that the spheres show on an image plane
    assert (
        got["held_out_covered"] == pytest.approx(share, abs=0.1)
        and "held_out_psnr_masked" not in got
    )
    small = replace(asset, world_from_asset=np.diag([0.7, 0.7, 0.7, 1.0]))
    less = values(photos.evaluate_on_photos(small, unmasked, run=tmp_path, spp=64))
    assert (
        less["held_out_covered"] < 0.7 * got["held_out_covered"]
        and less["held_out_psnr_sphere"] < got["held_out_psnr_sphere"] - 5
    )


def test_a_frame_of_its_own_is_aligned(asset, masked):
    free = similarity(Rotation.from_euler("y", 90, degrees=True).as_matrix(), [1, 2, 3], 0.25)
    cameras = tuple(
        (name.split("/")[1], c.with_pose(move_pose(free, c.world_from_camera)))
        for name, c in asset.cameras[:-2]
    )
    turned = replace(
        asset,
        world_from_asset=free,
        cameras=cameras,
        environment=rotate_environment(asset.environment, free),
    )
    result = photos.evaluate_on_photos(turned, masked, spp=SPP)
    assert result["alignment"] == "sim3" and values(result)["held_out_psnr_masked"] > 35
    assert values(result)["camera_rotation"] < 1e-3


@pytest.mark.slow
def test_without_photos_set_aside_those_of_the_fit_are_named_so(asset, tmp_path):
    folder = write_capture(tmp_path, replace(asset, cameras=asset.cameras[:4]), True, held_out=0)
    got = values(photos.evaluate_on_photos(asset, folder, spp=64))
    assert "seen_psnr_masked" in got and not any(k.startswith("held_out") for k in got)


def test_photos_without_cameras_are_no_truth(asset, masked, tmp_path):
    for file in (masked / "train").iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    with pytest.raises(UserError, match="no cameras and no truth"):
        photos.evaluate_on_photos(asset, tmp_path)


def test_the_sphere_and_the_directions_of_a_camera():
    pose = look_at([0, 0, 4.0])
    camera = Camera(40, 30, 60.0, 60.0, 20.0, 15.0, pose)
    d = photos.directions(camera)
    ends = camera.centre + 4 * d
    np.testing.assert_allclose(
        camera.project(ends)[..., 0], np.arange(40) + 0.5 + np.zeros((30, 1)), atol=1e-9
    )
    hit = photos.meets_sphere(camera, d, Sphere(np.zeros(3), 0.5))
    radius = 60 * np.tan(np.arcsin(0.5 / 4))
    u, v = np.meshgrid(np.arange(40) + 0.5 - 20, np.arange(30) + 0.5 - 15)
    np.testing.assert_array_equal(hit, np.hypot(u, v) < radius)
    assert not photos.meets_sphere(
        camera, d, Sphere(np.array([0, 0, 9.0]), 0.5)
    ).any()  # behind the camera


# ---------------------------------------------------------------- the round trip of the files


def psnr_of(asset, folder) -> float:
    figures = glb_roundtrip(asset, folder)
    assert figures["glb_roundtrip_psnr_masked"] <= figures["glb_roundtrip_psnr"]
    return figures["glb_roundtrip_psnr"]


def test_own_renders_are_kept_and_the_files_compared_with_them(asset, tmp_path):
    write_own_renders(tmp_path, asset)
    assert len(list(tmp_path.glob("own_*.exr"))) == 3
    assert psnr_of(asset, tmp_path) == 100.0  # the same asset, the same random numbers
    save_asset(tmp_path / "asset", asset)
    from relit.asset.asset import load_asset

    assert 38 < psnr_of(load_asset(tmp_path / "asset"), tmp_path) < 100  # 8-bit textures
    darker = replace(
        asset, material=replace(asset.material, base_color=asset.material.base_color * 0.5)
    )
    assert psnr_of(darker, tmp_path) < 30


def test_no_light_or_camera_no_round_trip(asset, tmp_path):
    write_own_renders(tmp_path, replace(asset, environment=None))
    write_own_renders(tmp_path, replace(asset, cameras=()))
    assert list(tmp_path.iterdir()) == [] and glb_roundtrip(asset, tmp_path) == {}

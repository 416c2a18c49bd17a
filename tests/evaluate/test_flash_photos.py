"""Evaluation of flash photos that nothing true is known of: held-out ones under the recovered
flash, which moves with their cameras."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from relit.asset.asset import save_asset
from relit.conventions import move_pose, similarity
from relit.evaluate import photos
from relit.evaluate.alignment import aligned
from relit.evaluate.dispatch import evaluate
from relit.geometry.se3 import look_at
from relit.images import write_data, write_linear
from relit.reference.flash_scene import build_flash_scene, render_flash
from relit.reference.photographed import FLASH_DEPTH
from relit.scene import Asset, Camera, Flash, Material, Mesh
from relit.synthesize.flash import _write_cameras

SIZE, SPP = 40, 64
PLACES = [(3, 0.5, 0), (0, 0.8, 3), (-3, -0.5, 0.2), (0.3, 0.6, -3), (2, 1.5, 2), (-2, 1, 1.8)]


@pytest.fixture(scope="module")
def plastic(device) -> Asset:
    ball = trimesh.creation.icosphere(3, radius=0.8)
    v = ball.vertices.astype(np.float32)
    n = (v / 0.8).astype(np.float32)
    uvs = np.stack([np.where(v[:, 1] < 0, 0.25, 0.75), np.full(len(v), 0.5)], 1).astype(np.float32)
    base = np.full((2, 4, 3), 0.6, np.float32)
    base[:, :2] = (0.5, 0.2, 0.1)
    one = np.ones((1, 1), np.float32)
    material = Material(base, 0.45 * one, 0 * one, 1.49, 0.8 * one, diffuse=base)
    flash = Flash(np.array([-0.6, 0.2, 0.0]), np.full(3, 20.0))
    cameras = tuple(
        (f"{i}.exr", Camera(SIZE, SIZE, 50.0, 50.0, SIZE / 2, SIZE / 2, look_at(np.array(o))))
        for i, o in enumerate(PLACES)
    )
    return Asset(
        Mesh(v, ball.faces.astype(np.int32), n, uvs),
        material,
        np.eye(4),
        None,
        cameras,
        {"material": "rough_plastic"},
        flash,
    )


@pytest.fixture(scope="module")
def capture(plastic, tmp_path_factory):
    """IRON's layout without any true map: four photos for the fit, two set aside."""
    folder = tmp_path_factory.mktemp("flash")
    scene = build_flash_scene(plastic.mesh, plastic.material)
    for split, some in (("train", plastic.cameras[:4]), ("test", plastic.cameras[4:])):
        _write_cameras(
            folder / split / "cam_dict_norm.json",
            [(name.removesuffix(".exr"), c) for name, c in some],
        )
        for name, camera in some:
            picture = render_flash(scene, camera, plastic.flash, SPP, seed=7, max_depth=FLASH_DEPTH)
            write_linear(folder / split / "image" / name, picture[..., :3])
            write_data(folder / split / "mask" / name.replace(".exr", ".png"), picture[..., 3])
    return folder


def figures(result):
    return {name: entry["value"] for name, entry in result["metrics"].items()}


@pytest.mark.slow
def test_the_asset_that_was_photographed(plastic, capture, tmp_path):
    save_asset(tmp_path / "asset", replace(plastic, cameras=plastic.cameras[:4]))
    result = evaluate(tmp_path, capture, spp=SPP)
    got = figures(result)
    assert len(result["per_view"]) == 2 and result["alignment"] == "identity"
    assert got["held_out_psnr_masked"] > 33 and got["held_out_mask_iou"] > 0.95
    assert "recovered moving flash" in result["metrics"]["held_out_psnr"]["definition"]
    at_camera = replace(plastic, flash=replace(plastic.flash, offset=np.zeros(3)))
    assert (
        figures(photos.evaluate_on_photos(at_camera, capture, spp=SPP))["held_out_psnr_masked"]
        < got["held_out_psnr_masked"] - 5
    )


def test_the_flash_follows_into_the_frame_of_the_photos(plastic, capture):
    free = similarity(Rotation.from_euler("y", 90, degrees=True).as_matrix(), [1, 2, 3], 0.25)
    cameras = tuple(
        (name, c.with_pose(move_pose(free, c.world_from_camera))) for name, c in plastic.cameras[:4]
    )
    flash = Flash(plastic.flash.offset * 0.25, plastic.flash.intensity * 0.25**2)
    moved = replace(plastic, world_from_asset=free, cameras=cameras, flash=flash)
    back, how = aligned(moved, {k: c for k, c in plastic.cameras[:4]}, dict(cameras))
    assert (
        how == "sim3"
        and np.allclose(back.flash.offset, plastic.flash.offset)
        and np.allclose(back.flash.intensity, 20)
    )
    result = photos.evaluate_on_photos(moved, capture, spp=SPP)
    assert result["alignment"] == "sim3" and figures(result)["held_out_psnr_masked"] > 33

"""The digests of a run's input hold what is read, wherever it lies, and nothing else."""

import json

import numpy as np
import pytest

from relit import images
from relit.capture.open import open_capture
from relit.job import input_digests
from support import camera_ring


@pytest.fixture
def cameras():
    return camera_ring.ring()


def test_notes_and_logs_decide_nothing(tmp_path, cameras):
    names = camera_ring.write_photos(tmp_path / "images", cameras)
    camera_ring.write_transforms(tmp_path, cameras, [f"images/{n}" for n in names])
    before = input_digests(open_capture(tmp_path))
    (tmp_path / "log.txt").write_text("looked at it again")
    assert input_digests(open_capture(tmp_path)) == before
    assert set(before) == {"transforms.json", *(f"images/{n}" for n in names)}


@pytest.mark.parametrize("model", ["sparse/0", "colmap/sparse/0", "dense/sparse"])
def test_cameras_of_colmap_decide_wherever_they_lie(tmp_path, cameras, model):
    names = camera_ring.write_photos(tmp_path / "images", cameras)
    camera_ring.write_colmap_text(tmp_path / model, cameras, names)
    assert {f"{model}/cameras.txt", f"{model}/images.txt", "images/000.png"} <= set(
        input_digests(open_capture(tmp_path))
    )


def test_masks_and_normal_priors_beside_the_photos_decide(tmp_path, cameras):
    camera_ring.write_photos(tmp_path, cameras, suffix=".jpg")
    for i, camera in enumerate(cameras):
        alpha = camera_ring.picture(camera)[1]
        images.write_data(tmp_path / f"{i:03d}_mask.png", alpha)
        images.write_data(
            tmp_path / f"{i:03d}_normal.png",
            np.stack([alpha * 0 + 0.5, alpha * 0 + 0.5, alpha * 0], -1),
        )
    before = input_digests(open_capture(tmp_path))
    assert {"003.jpg", "003_mask.png", "003_normal.png"} <= set(before)
    images.write_data(tmp_path / "003_mask.png", camera_ring.picture(cameras[3])[1] * 0.9)
    assert input_digests(open_capture(tmp_path)) != before


def test_cameras_in_the_folder_of_a_split_decide(tmp_path, cameras):
    names = camera_ring.write_photos(tmp_path / "train" / "image", cameras)
    k = np.eye(4)
    k[:3, :3] = cameras[0].intrinsics
    entries = {
        n: {
            "K": k.ravel().tolist(),
            "W2C": c.camera_from_world.ravel().tolist(),
            "img_size": [c.width, c.height],
        }
        for n, c in zip(names, cameras, strict=True)
    }
    (tmp_path / "train" / "cam_dict_norm.json").write_text(json.dumps(entries))
    assert "train/cam_dict_norm.json" in input_digests(open_capture(tmp_path))

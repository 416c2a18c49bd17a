"""Which camera, mask and normal prior belong to which photo, where names repeat, files are missing
or other programs' files lie about."""

import json

import numpy as np
import pytest
from PIL import Image as PilImage

from relit import images
from relit.capture.open import open_capture
from relit.errors import UserError
from relit.job import Job, open_as
from support import camera_ring


def write_splits(root, cameras):
    """train/ and test/ with the same names; the test cameras stand elsewhere."""
    splits = {"train": cameras, "test": camera_ring.ring(distance=5.0)}
    for split, some in splits.items():
        names = camera_ring.write_photos(root / split, some, background=camera_ring.BACKGROUND)
        camera_ring.write_transforms(
            root, some, [f"{split}/{n}" for n in names], f"transforms_{split}.json"
        )
    return splits


# ---------------------------------------------------------------- photos and cameras


def test_a_missing_training_photo_is_not_taken_from_the_test_split(tmp_path, cameras):
    splits = write_splits(tmp_path, cameras)
    (tmp_path / "train" / "002.png").unlink()
    capture = open_capture(tmp_path, masks="none")
    assert [p.name for p in capture.photos] == [f"train/00{i}.png" for i in (0, 1, 3, 4, 5)]
    assert [p.name for p in capture.held_out] == [f"test/00{i}.png" for i in range(6)]
    for photo, camera in zip(capture.held_out, splits["test"], strict=True):
        camera_ring.same_camera(photo.camera, camera)


def test_a_missing_photo_of_a_rig_is_not_taken_from_the_other_camera(tmp_path, cameras):
    names = [
        f"{side}/{n}"
        for side, some in (("left", cameras[:3]), ("right", cameras[3:]))
        for n in _written(tmp_path, side, some)
    ]
    camera_ring.write_colmap_text(tmp_path / "sparse" / "0", cameras, names)
    (tmp_path / "images" / "left" / "001.png").unlink()
    capture = open_capture(tmp_path)
    assert [p.name for p in capture.photos] == [f"images/{n}" for n in names if n != "left/001.png"]
    assert sum(camera_ring.check_projection(p) for p in capture.photos) > 5


def _written(root, side, cameras):
    return camera_ring.write_photos(root / "images" / side, cameras)


def test_images_beside_the_model_come_first(tmp_path, cameras):
    """COLMAP's dense/ holds undistorted copies of images/, of the same names."""
    camera_ring.write_photos(tmp_path / "images", cameras[::-1])
    names = camera_ring.write_photos(tmp_path / "dense" / "images", cameras)
    camera_ring.write_colmap_text(tmp_path / "dense" / "sparse", cameras, names)
    capture = open_capture(tmp_path)
    assert [p.name for p in capture.photos] == [f"dense/images/{n}" for n in names]
    assert sum(camera_ring.check_projection(p) for p in capture.photos) > len(cameras)


def test_synthetic4relight(tmp_path, cameras):
    """Its file_path is train/000: the photo is train/000_rgb.exr with train/000_mask.png, a test
    photo is test/000_rgba.png."""
    for split, suffix, stem in (("train", ".exr", "{:03d}_rgb"), ("test", ".png", "{:03d}_rgba")):
        camera_ring.write_photos(
            tmp_path / split, cameras, suffix, alpha=split == "test", stem=stem
        )
        camera_ring.write_transforms(
            tmp_path, cameras, [f"{split}/{i:03d}" for i in range(6)], f"transforms_{split}.json"
        )
    alphas = [camera_ring.picture(c)[1] for c in cameras]
    for i, alpha in enumerate(alphas):
        images.write_data(tmp_path / "train" / f"{i:03d}_mask.png", alpha)
    capture = open_capture(tmp_path)
    assert [p.name for p in (capture.photos[1], capture.held_out[1])] == [
        "train/001_rgb.exr",
        "test/001_rgba.png",
    ]
    assert sum(camera_ring.check_projection(p) for p in capture.photos) > len(cameras)
    np.testing.assert_allclose(capture.photos[1].load().mask, alphas[1], atol=0.01)


def test_a_camera_file_of_iron_may_be_opened_itself(tmp_path, cameras):
    names = camera_ring.write_photos(tmp_path / "image", cameras)
    entries = {}
    for name, c in zip(names, cameras, strict=True):
        k = np.eye(4)
        k[:3, :3] = c.intrinsics
        entries[name] = {
            "K": k.ravel().tolist(),
            "W2C": c.camera_from_world.ravel().tolist(),
            "img_size": [c.width, c.height],
        }
    (tmp_path / "cam_dict_norm.json").write_text(json.dumps(entries))
    assert (
        open_capture(tmp_path / "cam_dict_norm.json").format
        == open_capture(tmp_path).format
        == "iron"
    )


@pytest.mark.parametrize("name", ["metadata.json", "annotations.json"])
@pytest.mark.parametrize("content", ["[1, 2]", '"azimuths"', "no JSON at all"])
def test_files_of_other_programs_are_no_collection(tmp_path, cameras, name, content):
    camera_ring.write_photos(tmp_path, cameras, suffix=".jpg", background=camera_ring.BACKGROUND)
    (tmp_path / name).write_text(content)
    assert open_capture(tmp_path, masks="none").format == "photos"


def test_segmentations_make_no_pile_of_what_is_asked_for_as_another_kind(tmp_path, cameras):
    names = camera_ring.write_photos(tmp_path, cameras, background=camera_ring.BACKGROUND)
    camera_ring.write_transforms(tmp_path, cameras, names)
    for i, camera in enumerate(cameras):
        images.write_data(
            tmp_path / f"{i:03d}_seg.png", (camera_ring.picture(camera)[1] > 0.5).astype(np.float32)
        )
    capture, kind = open_as(tmp_path, Job(capture="multiview"))
    assert (capture.format, kind, len(capture.photos)) == ("transforms", "multiview", 6)
    assert open_as(tmp_path, Job())[1] == "duplicates"


# ---------------------------------------------------------------- masks and normal priors


def test_masks_of_two_splits_of_the_same_names(tmp_path, cameras):
    splits = write_splits(tmp_path, cameras)
    for split, some in splits.items():
        for i, camera in enumerate(some):
            images.write_data(
                tmp_path / "masks" / split / f"{i:03d}.png", camera_ring.picture(camera)[1]
            )
    capture = open_capture(tmp_path)
    for photos, some in ((capture.photos, splits["train"]), (capture.held_out, splits["test"])):
        for photo, camera in zip(photos, some, strict=True):
            np.testing.assert_allclose(photo.load().mask, camera_ring.picture(camera)[1], atol=0.01)


@pytest.mark.parametrize("orientation", [6, 8])
def test_upright_masks_of_photos_that_are_left_as_stored(tmp_path, cameras, orientation):
    """The cameras are those of the pixels as stored; the masks were made from the pictures as EXIF
    turns them."""
    exif = PilImage.Exif()
    exif[0x0112] = orientation
    (tmp_path / "images").mkdir()
    for i, camera in enumerate(cameras):
        rgb, alpha = camera_ring.picture(camera)
        codes = (np.clip(rgb, 0, 1) * 255).astype(np.uint8)
        PilImage.fromarray(codes).save(tmp_path / "images" / f"{i}.jpg", exif=exif, quality=97)
        images.write_data(tmp_path / "masks" / f"{i}.png", images.turn_upright(alpha, orientation))
    camera_ring.write_transforms(tmp_path, cameras, [f"images/{i}.jpg" for i in range(6)])
    photo = open_capture(tmp_path).photos[1]
    assert (photo.width, photo.height) == (72, 56)
    np.testing.assert_allclose(photo.load().mask, camera_ring.picture(cameras[1])[1], atol=0.01)


def test_a_mask_path_that_is_not_there_is_an_error(capture_folder):
    file = capture_folder / "transforms.json"
    data = json.loads(file.read_text())
    for i, frame in enumerate(data["frames"]):
        frame["mask_path"] = f"masks/{i}.png"
    file.write_text(json.dumps(data))
    with pytest.raises(UserError, match=r"6 of 6 photos have no mask, for example images/000\.png"):
        open_capture(capture_folder)
    assert open_capture(capture_folder, masks="none").photos[0].load().mask is None


@pytest.mark.parametrize("suffix", [".PNG", ".tif"])
def test_masks_beside_the_photos_may_end_otherwise(capture_folder, cameras, suffix):
    for i, camera in enumerate(cameras):
        codes = (camera_ring.picture(camera)[1] * 255).astype(np.uint8)
        PilImage.fromarray(codes).save(capture_folder / "images" / f"{i:03d}_mask{suffix}")
    np.testing.assert_allclose(
        open_capture(capture_folder).photos[2].load().mask,
        camera_ring.picture(cameras[2])[1],
        atol=0.01,
    )


def test_a_backdrop_is_looked_for_in_training_photos(tmp_path):
    """Every second of 24 photos is held out, just those that an even sample would take."""
    cameras = camera_ring.ring(24)
    names = [
        f"images/{n}"
        for n in camera_ring.write_photos(
            tmp_path / "images", cameras, background=camera_ring.BACKGROUND
        )
    ]
    camera_ring.write_transforms(tmp_path, cameras, names, test_filenames=names[::2])
    capture = open_capture(tmp_path)
    assert len(capture.photos) == 12 and any("plain backdrop" in n for n in capture.notes)
    assert np.abs(capture.photos[0].load().mask - camera_ring.picture(cameras[1])[1]).mean() < 0.02


def test_normal_priors_that_do_not_face_the_camera_are_not_used(capture_folder):
    away = np.zeros((56, 72, 3))
    away[..., 2] = 1  # z towards the camera, as OpenGL has it
    for i in range(6):
        images.write_data(capture_folder / "normals" / f"{i:03d}.png", away * 0.5 + 0.5)
    capture = open_capture(capture_folder)
    assert capture.photos[0].load().normal is None
    assert any("normal priors are not used: 100 %" in n for n in capture.notes)

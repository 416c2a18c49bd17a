"""Camera files as other programs write them: COLMAP models without points or second lines,
workspaces, folders at other resolutions, NeuS2, Nex."""

from __future__ import annotations

import json
import shutil

import cv2
import numpy as np
import pytest
from PIL import Image

from relit.capture.open import open_capture
from relit.capture.readers.colmap_complete import with_second_lines
from relit.capture.readers.colmap_model import camera_from_colmap
from relit.errors import UserError
from relit.images import write_data
from support import camera_ring

W, H = 96, 64


@pytest.fixture
def cameras():
    return camera_ring.ring(5, W, H)


@pytest.fixture
def project(tmp_path, cameras):
    """images/ and sparse/0 as text."""
    names = camera_ring.write_photos(
        tmp_path / "images", cameras, background=camera_ring.BACKGROUND
    )
    camera_ring.write_colmap_text(tmp_path / "sparse" / "0", cameras, names)
    return tmp_path


def same(capture, cameras):
    assert capture.format == "colmap" and capture.has_cameras
    assert len(capture.photos) == len(cameras)
    for photo, camera in zip(capture.photos, cameras, strict=True):
        camera_ring.same_camera(photo.camera, camera)
    assert sum(camera_ring.check_projection(p) for p in capture.photos) > len(cameras)


def to_binary(folder):
    import pycolmap

    model = pycolmap.Reconstruction(str(folder))
    shutil.rmtree(folder)
    folder.mkdir()
    model.write_binary(str(folder))


def one_line_each(folder):
    lines = (folder / "images.txt").read_text().splitlines()
    (folder / "images.txt").write_text("\n".join(line for line in lines if line) + "\n")


def no_points(folder):
    (folder / "points3D.txt").unlink()
    (folder / "points3D.ply").write_text("ply")


def no_points_binary(folder):
    to_binary(folder)
    (folder / "points3D.bin").unlink()


def windows(folder):
    for f in folder.glob("*.txt"):
        f.write_bytes(f.read_bytes().replace(b"\n", b"\r\n"))


def comments(folder):
    for f in folder.glob("*.txt"):
        f.write_text("# a comment\n" + f.read_text())


@pytest.mark.parametrize(
    "write, note",
    [
        (one_line_each, "no second line"),
        (no_points, "no points3D.txt"),
        (no_points_binary, "no points3D.bin"),
        (windows, ""),
        (comments, ""),
    ],
)
def test_models_that_lack_something(project, cameras, write, note):
    write(project / "sparse" / "0")
    capture = open_capture(project, masks="none")
    same(capture, cameras)
    assert any(note in n for n in capture.notes)


def test_names_with_spaces_in_text(tmp_path, cameras):
    names = camera_ring.write_photos(tmp_path / "images", cameras, stem="a photo {}")
    camera_ring.write_colmap_text(tmp_path / "sparse", cameras, names)
    same(open_capture(tmp_path, masks="none"), cameras)


def test_a_line_that_is_neither_image_nor_points_is_named():
    good = "1 1 0 0 0 0 0 1 1 a.png\n"
    assert with_second_lines(good + "\n" + good)[1] == 0
    assert with_second_lines(good + good + "0.5 0.5 -1\n")[1] == 1
    with pytest.raises(ValueError, match=r"line 2 of images\.txt"):
        with_second_lines(good + "1 2 3 4 5\n")


def test_a_workspace_gives_the_model_of_its_undistorted_photos(tmp_path, cameras):
    """sparse/0 belongs to photos that lie elsewhere, dense/0 to those that are there."""
    dense = tmp_path / "dense" / "0"
    names = camera_ring.write_photos(dense / "images", cameras, background=camera_ring.BACKGROUND)
    wide = camera_ring.ring(5, W + 2, H + 2, focal=90.0)
    camera_ring.write_colmap_text(
        tmp_path / "sparse" / "0", wide, names, "SIMPLE_RADIAL", extra=[0.1]
    )
    camera_ring.write_colmap_text(dense / "sparse", cameras, names)
    capture = open_capture(tmp_path, masks="none")
    same(capture, cameras)
    assert any("dense/0/sparse" in n for n in capture.notes)
    shutil.rmtree(dense / "sparse")
    capture = open_capture(tmp_path, masks="none")
    assert not any("shape of their camera" in n for n in capture.notes)  # a pixel is rounding
    for f in (dense / "images").iterdir():
        Image.open(f).resize((W - 4, H + 6)).save(f)
    with pytest.raises(UserError, match="different shapes"):
        open_capture(tmp_path, masks="none")


def test_a_photo_that_is_missing_is_not_taken_from_the_undistorted_ones(project, cameras):
    shutil.copytree(project / "images", project / "dense" / "images")
    (project / "images" / "002.png").unlink()
    capture = open_capture(project, masks="none")
    assert [p.name for p in capture.photos] == [f"images/00{k}.png" for k in (0, 1, 3, 4)]
    assert any("1 photos of the COLMAP model are not there" in n for n in capture.notes)


def test_photos_without_a_camera_are_named(project, cameras):
    shutil.copy(project / "images" / "000.png", project / "images" / "extra.png")
    capture = open_capture(project, masks="none")
    same(capture, cameras)
    assert any("1 photos have no camera" in n and "extra.png" in n for n in capture.notes)


def test_cut_outs_beside_photos_with_cameras_are_masks(tmp_path, cameras):
    names = camera_ring.write_photos(tmp_path / "images", cameras, suffix=".jpg")
    camera_ring.write_photos(tmp_path / "images", cameras, suffix=".png", alpha=True)
    camera_ring.write_colmap_text(tmp_path / "sparse" / "0", cameras, names)
    capture = open_capture(tmp_path)
    assert [p.name for p in capture.photos] == [f"images/{n}" for n in names]
    mask = camera_ring.picture(cameras[1])[1]
    assert np.abs(capture.photos[1].load().mask - mask).mean() < 0.01
    assert not any("no camera" in n for n in capture.notes)


def test_masks_of_a_workspace(tmp_path, cameras):
    dense = tmp_path / "dense" / "0"
    names = camera_ring.write_photos(dense / "images", cameras, background=camera_ring.BACKGROUND)
    camera_ring.write_colmap_text(dense / "sparse", cameras, names)
    (dense / "masks").mkdir()
    for name, camera in zip(names, cameras, strict=True):
        write_data(dense / "masks" / f"{name}.png", camera_ring.picture(camera)[1])
    capture = open_capture(tmp_path)
    assert capture.photos[0].load().mask is not None


def test_the_images_folder_of_a_project(project, cameras):
    capture = open_capture(project / "images", masks="none")
    same(capture, cameras)
    assert any("the folder above" in n for n in capture.notes)


def test_a_project_that_cannot_be_read_is_said(project):
    (project / "sparse" / "0" / "images.txt").write_text("nonsense\n")
    capture = open_capture(project / "images", masks="none")
    assert not capture.has_cameras
    assert any("folder above cannot be used" in n for n in capture.notes)


@pytest.mark.parametrize(
    "leave", ["sparse/0/images.bin", "database.db", "bundle.out", "my_transforms_v2.json"]
)
def test_cameras_are_never_lost_without_a_note(tmp_path, leave):
    camera_ring.write_photos(tmp_path, camera_ring.ring(4, W, H))
    (tmp_path / leave).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / leave).write_text("{}")
    capture = open_capture(tmp_path, masks="none")
    assert not capture.has_cameras
    assert any("is not used" in n and leave in n for n in capture.notes)


@pytest.mark.parametrize("folders", [("images_2",), ("images_2", "images_4")])
@pytest.mark.parametrize("layout", ["colmap", "transforms", "llff"])
def test_copies_at_a_lower_resolution(tmp_path, cameras, layout, folders):
    cameras = camera_ring.ring(5, W, H, focal=100.0, centred=True)
    names = camera_ring.write_photos(tmp_path / "full", cameras, background=camera_ring.BACKGROUND)
    for folder in folders:
        (tmp_path / folder).mkdir()
        for name in names:
            size = (W // int(folder[-1]), H // int(folder[-1]))
            picture = cv2.imread(str(tmp_path / "full" / name))
            small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
            cv2.imwrite(str(tmp_path / folder / name), small)
    shutil.rmtree(tmp_path / "full")
    if layout == "colmap":
        camera_ring.write_colmap_text(tmp_path / "sparse" / "0", cameras, names)
    elif layout == "transforms":
        camera_ring.write_transforms(tmp_path, cameras, [f"images/{n}" for n in names])
    else:
        rows = []
        for c in cameras:
            m = c.world_from_camera
            axes = [m[:3, 1], m[:3, 0], -m[:3, 2], m[:3, 3], [c.height, c.width, c.fx]]
            rows.append([*np.stack(axes, -1).ravel(), 1, 10])
        np.save(tmp_path / "poses_bounds.npy", np.array(rows))
    capture = open_capture(tmp_path, masks="none")
    assert capture.format == layout and capture.photos[0].name.startswith("images_2/")
    for photo, camera in zip(capture.photos, cameras, strict=True):
        camera_ring.same_camera(photo.camera, camera.resized(W // 2, H // 2))


@pytest.mark.parametrize(
    "model, params",
    [
        ("SIMPLE_FISHEYE", [80.0, 35.0, 29.0]),
        ("FISHEYE", [80.0, 82.0, 35.0, 29.0]),
        ("EQUIRECTANGULAR", [70, 60]),
        ("SIMPLE_DIVISION", [80.0, 35.0, 29.0, -0.05]),
        ("EUCM", [80.0, 82.0, 35.0, 29.0, 0.6, 1.1]),
    ],
)
def test_lenses_of_newer_versions(model, params):
    import pycolmap

    from relit.geometry.lens import lens_of, pixels_from_ideal

    if not hasattr(pycolmap.CameraModelId, model):
        pytest.skip(f"this pycolmap has no {model}")
    reference = pycolmap.Camera(model=model, width=70, height=60, params=params)
    camera, lens = camera_from_colmap(reference, np.eye(4))
    xy = np.random.default_rng(0).uniform(-0.3, 0.3, (20, 2))
    expected = reference.img_from_cam(np.concatenate([xy, np.ones((20, 1))], axis=1))
    found = pixels_from_ideal(camera, lens or lens_of(camera), xy)
    np.testing.assert_allclose(found, expected, atol=1e-9)


@pytest.mark.parametrize("matrix", [True, False])
def test_neus2_has_opencv_axes(tmp_path, cameras, matrix):
    names = camera_ring.write_photos(
        tmp_path / "images", cameras, background=camera_ring.BACKGROUND
    )
    camera_ring.write_transforms(
        tmp_path, cameras, [f"images/{n}" for n in names], per_frame=True, from_na=True
    )
    data = json.loads((tmp_path / "transforms.json").read_text())
    for frame, c in zip(data["frames"], cameras, strict=True):
        frame["transform_matrix"] = c.world_from_camera.tolist()
        if matrix:
            k = np.eye(4)
            k[:3, :3] = c.intrinsics
            for key in ("fl_x", "fl_y", "cx", "cy"):
                del frame[key]
            frame["intrinsic_matrix"] = k.tolist()
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    capture = open_capture(tmp_path, masks="none")
    for photo, camera in zip(capture.photos, cameras, strict=True):
        camera_ring.same_camera(photo.camera, camera)
    assert sum(camera_ring.check_projection(p) for p in capture.photos) > len(cameras)


def test_rows_without_sizes_are_refused_with_the_reason(tmp_path):
    camera_ring.write_photos(tmp_path / "images", camera_ring.ring(4, W, H))
    np.save(tmp_path / "poses_bounds.npy", np.zeros((4, 14)))
    with pytest.raises(UserError, match="14 columns, 17 are needed"):
        open_capture(tmp_path)

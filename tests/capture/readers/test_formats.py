"""A round trip per format: known cameras are written, read and compared; coloured balls show that
the axes are right."""

import json
from dataclasses import replace

import numpy as np
import pytest

from relit.capture.open import open_capture
from relit.capture.readers.colmap_model import camera_from_colmap
from relit.conventions import scale_of
from relit.errors import UserError
from support import camera_ring


@pytest.fixture
def cameras():
    return camera_ring.ring()


def check(capture, cameras, format):
    assert capture.format == format and len(capture.photos) == len(cameras) and capture.has_cameras
    for photo, camera in zip(capture.photos, cameras, strict=True):
        camera_ring.same_camera(photo.camera, camera)
    assert sum(camera_ring.check_projection(p) for p in capture.photos) > len(cameras)


@pytest.mark.parametrize("per_frame", [False, True])
def test_nerfstudio_transforms(tmp_path, cameras, per_frame):
    names = camera_ring.write_photos(tmp_path / "images", cameras)
    camera_ring.write_transforms(
        tmp_path, cameras, [f"./images/{n}" for n in names], per_frame=per_frame
    )
    capture = open_capture(tmp_path)
    check(capture, cameras, "transforms")
    assert capture.photos[0].name == "images/000.png"
    check(open_capture(tmp_path / "transforms.json"), cameras, "transforms")


def test_nerf_synthetic(tmp_path):
    cameras = camera_ring.ring(centred=True)
    angle = 2 * np.arctan(0.5 * cameras[0].width / cameras[0].fx)
    for split, some in (("train", cameras[:4]), ("val", cameras[4:5]), ("test", cameras[5:])):
        camera_ring.write_photos(tmp_path / split, some, alpha=True, stem="r_{}")
        camera_ring.write_transforms(
            tmp_path,
            some,
            [f"./{split}/r_{i}" for i in range(len(some))],
            f"transforms_{split}.json",
        )
        data = json.loads((tmp_path / f"transforms_{split}.json").read_text())
        kept = {"camera_angle_x": angle, "frames": data["frames"]}
        (tmp_path / f"transforms_{split}.json").write_text(json.dumps(kept))
    capture = open_capture(tmp_path)
    check(capture, cameras[:4], "transforms")
    assert [p.name for p in capture.held_out] == ["test/r_0.png"]
    camera_ring.same_camera(capture.held_out[0].camera, cameras[5])
    assert capture.black_background
    mask = capture.photos[0].load().mask
    np.testing.assert_allclose(mask, camera_ring.picture(cameras[0])[1], atol=0.01)
    np.testing.assert_allclose(
        capture.photos[0].load().rgb, camera_ring.picture(cameras[0])[0], atol=0.02
    )


def test_frames_without_a_file_are_held_out_or_left_out(tmp_path, cameras):
    names = camera_ring.write_photos(tmp_path / "images", cameras)
    (tmp_path / "heldout_from_history").mkdir()
    (tmp_path / "images" / names[1]).rename(tmp_path / "heldout_from_history" / names[1])
    (tmp_path / "images" / names[2]).unlink()
    camera_ring.write_transforms(tmp_path, cameras, [f"images/{n}" for n in names])
    capture = open_capture(tmp_path)
    assert [p.name for p in capture.held_out] == ["heldout_from_history/001.png"]
    assert len(capture.photos) == 4
    assert any(
        "1 photos named in transforms.json are not there" in n and "images/002.png" in n
        for n in capture.notes
    )


def test_distortion_is_taken_out(tmp_path, cameras):
    """Pictures drawn through a lens come back such that plain projection finds the balls."""
    import cv2

    from relit.geometry.lens import BrownLens, pixels_from_ideal

    k = (-0.25, 0.1, 0.01, -0.005)
    names = camera_ring.write_photos(tmp_path / "images", cameras)
    for camera, name in zip(cameras, names, strict=True):
        # a pinhole picture of a wider view, looked up through the lens
        wide = replace(
            camera,
            width=camera.width * 4,
            height=camera.height * 4,
            cx=camera.cx + 1.5 * camera.width,
            cy=camera.cy + 1.5 * camera.height,
        )
        rgb, _ = camera_ring.picture(wide, samples=1)
        from relit.geometry.lens import ideal_from_pixels

        xs, ys = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        xy = ideal_from_pixels(camera, BrownLens(k), np.stack([xs.ravel(), ys.ravel()], 1))
        p = (
            pixels_from_ideal(wide, None, xy)
            .reshape(camera.height, camera.width, 2)
            .astype(np.float32)
            - 0.5
        )
        camera_ring.images.write_srgb(
            tmp_path / "images" / name, cv2.remap(rgb, p[..., 0], p[..., 1], cv2.INTER_LINEAR)
        )
    camera_ring.write_transforms(
        tmp_path, cameras, [f"images/{n}" for n in names], k1=k[0], k2=k[1], p1=k[2], p2=k[3]
    )
    capture = open_capture(tmp_path, masks="none")
    photo = capture.photos[0]
    assert photo.camera.distortion == () and photo.load().rgb.shape == (
        photo.height,
        photo.width,
        3,
    )
    assert sum(camera_ring.check_projection(p) for p in capture.photos) > len(cameras)


def test_a_resized_copy_scales_the_camera(tmp_path, cameras):
    names = camera_ring.write_photos(tmp_path / "images", [c.resized(36, 28) for c in cameras])
    camera_ring.write_transforms(tmp_path, cameras, [f"images/{n}" for n in names])
    check(open_capture(tmp_path), [c.resized(36, 28) for c in cameras], "transforms")
    small = open_capture(tmp_path, max_side=18)
    assert small.photos[0].load().rgb.shape == (14, 18, 3)
    camera_ring.same_camera(small.photos[0].camera, cameras[0].resized(18, 14))


@pytest.mark.parametrize("name", ["cameras_sphere.npz", "cameras.npz"])
def test_idr(tmp_path, cameras, name):
    camera_ring.write_photos(tmp_path / "image", cameras, stem="{:06d}")
    scale = np.diag([1.5, 1.5, 1.5, 1.0])
    scale[:3, 3] = 0.1, -0.2, 0.05
    arrays = {f"world_mat_{i}": camera_ring.projection(c) for i, c in enumerate(cameras)}
    np.savez(tmp_path / name, **arrays, **{f"scale_mat_{i}": scale for i in range(len(cameras))})
    capture = open_capture(tmp_path)
    check(capture, cameras, "idr")
    assert capture.sphere.radius == pytest.approx(1.5)
    np.testing.assert_allclose(capture.sphere.centre, [0.1, -0.2, 0.05])


def test_idr_projections_of_any_scale_and_sign(tmp_path, cameras):
    camera_ring.write_photos(tmp_path / "image", cameras)
    np.savez(
        tmp_path / "cameras.npz",
        **{f"world_mat_{i}": -0.37 * camera_ring.projection(c) for i, c in enumerate(cameras)},
    )
    check(open_capture(tmp_path), cameras, "idr")


def test_middlebury(tmp_path, cameras):
    names = camera_ring.write_photos(tmp_path, cameras)
    lines = [str(len(cameras))]
    for camera, name in zip(cameras, names, strict=True):
        k = replace(camera, cx=camera.cx - 0.5, cy=camera.cy - 0.5).intrinsics
        m = camera.camera_from_world
        lines.append(
            " ".join([name, *(repr(float(v)) for v in [*k.ravel(), *m[:3, :3].ravel(), *m[:3, 3]])])
        )
    (tmp_path / "balls_par.txt").write_text("\n".join(lines))
    check(open_capture(tmp_path), cameras, "middlebury")


def test_llff(tmp_path):
    cameras = camera_ring.ring(centred=True)
    camera_ring.write_photos(tmp_path / "images", cameras)
    rows = []
    for c in cameras:
        right, down, forward, t = c.world_from_camera[:3].T
        rows.append(
            [
                *np.column_stack([down, right, -forward, t, [c.height, c.width, c.fx]]).ravel(),
                2.0,
                6.0,
            ]
        )
    np.save(tmp_path / "poses_bounds.npy", np.array(rows))
    check(open_capture(tmp_path), cameras, "llff")


@pytest.mark.parametrize("binary", [False, True])
def test_colmap(tmp_path, cameras, binary):
    import pycolmap

    names = camera_ring.write_photos(tmp_path / "images", cameras)
    text = tmp_path / "elsewhere" / "text"
    camera_ring.write_colmap_text(text, cameras, names)
    model = pycolmap.Reconstruction(str(text))
    small = tmp_path / "sparse" / "0"
    large = tmp_path / "sparse" / "1"
    small.mkdir(parents=True), large.mkdir()
    camera_ring.write_colmap_text(small, cameras[:3], names[:3])
    (model.write_binary if binary else model.write_text)(str(large))
    capture = open_capture(tmp_path)
    check(capture, cameras, "colmap")
    assert any("2 COLMAP models with 3, 6 photos: the largest was read" in n for n in capture.notes)


def test_colmap_points_and_model_folder(tmp_path):
    import pycolmap

    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(
        num_points3D=80, num_frames_per_rig=3, camera_width=72, camera_height=56
    )
    options.camera_model_id, options.camera_params = (
        pycolmap.CameraModelId.SIMPLE_RADIAL,
        [90.0, 36.0, 28.0, 0.05],
    )
    model = pycolmap.synthesize_dataset(options)
    (tmp_path / "sparse").mkdir()
    (tmp_path / "images").mkdir()
    model.write_binary(str(tmp_path / "sparse"))
    for image in model.images.values():
        camera_ring.images.write_srgb(
            tmp_path / "images" / image.name, np.random.default_rng(0).uniform(size=(56, 72, 3))
        )
    capture = open_capture(tmp_path, masks="none", min_photos=2)
    assert len(capture.photos) == 6 and capture.points.shape == (80, 3)
    for photo in capture.photos:
        image = model.find_image_with_name(photo.name.removeprefix("images/"))
        np.testing.assert_allclose(
            photo.camera.camera_from_world[:3], image.cam_from_world().matrix(), atol=1e-9
        )
        assert photo.camera.fx == 90.0 and photo.camera.distortion == ()
    assert open_capture(tmp_path / "sparse", masks="none").format == "colmap"


@pytest.mark.parametrize(
    "model, params",
    [
        ("SIMPLE_PINHOLE", []),
        ("PINHOLE", []),
        ("SIMPLE_RADIAL", [0.1]),
        ("RADIAL", [0.1, -0.05]),
        ("OPENCV", [0.1, -0.05, 0.01, 0.02]),
        ("FULL_OPENCV", [0.1, -0.05, 0.01, 0.02, 0.03, 0.1, 0.02, 0.01]),
        ("OPENCV_FISHEYE", [0.1, -0.05, 0.02, 0.01]),
        ("SIMPLE_RADIAL_FISHEYE", [0.1]),
        ("RADIAL_FISHEYE", [0.1, 0.02]),
        ("FOV", [0.3]),
        ("THIN_PRISM_FISHEYE", [0.1, -0.05, 0.01, 0.02, 0.03, 0.01, 0.02, 0.01]),
    ],
)  # fmt: skip
def test_every_colmap_lens(model, params):
    import pycolmap

    from relit.geometry.lens import lens_of, pixels_from_ideal

    head = (
        [80.0, 35.0, 29.0]
        if model.startswith("SIMPLE") or model.startswith("RADIAL")
        else [80.0, 82.0, 35.0, 29.0]
    )
    reference = pycolmap.Camera(model=model, width=70, height=60, params=head + params)
    camera, lens = camera_from_colmap(reference, np.eye(4))
    xy = np.random.default_rng(0).uniform(-0.3, 0.3, (20, 2))
    expected = reference.img_from_cam(np.concatenate([xy, np.ones((20, 1))], axis=1))
    np.testing.assert_allclose(
        pixels_from_ideal(camera, lens or lens_of(camera), xy), expected, atol=1e-9
    )


def test_plain_photos(tmp_path):
    camera_ring.write_photos(
        tmp_path / "photos", camera_ring.ring(), suffix=".jpg", background=(0.3, 0.5, 0.2)
    )
    camera_ring.images.write_data(tmp_path / "photos" / "000_depth.png", np.ones((4, 4)))
    capture = open_capture(tmp_path)
    assert capture.format == "photos" and len(capture.photos) == 6 and not capture.has_cameras
    assert capture.sphere is None and capture.photos[3].name == "photos/003.jpg"


def test_a_fisheye_of_nerfstudio_is_undistorted(tmp_path, cameras):
    names = camera_ring.write_photos(tmp_path / "images", cameras)
    camera_ring.write_transforms(
        tmp_path,
        cameras,
        [f"images/{n}" for n in names],
        camera_model="OPENCV_FISHEYE",
        k1=0.05,
        k2=0.0,
        k3=0.0,
        k4=0.0,
    )
    photo = open_capture(tmp_path, masks="none").photos[0]
    assert (
        photo.load().rgb.shape == (photo.height, photo.width, 3)
        and photo.camera.fx == cameras[0].fx
    )
    assert (photo.width, photo.height) != (72, 56)


def test_cameras_of_photos_as_stored_before_exif_turned_them(tmp_path, cameras):
    """COLMAP and others may calibrate the pixels as stored; the camera's shape tells."""
    from PIL import Image as PilImage

    (tmp_path / "images").mkdir()
    exif = PilImage.Exif()
    exif[0x0112] = 6
    for i, camera in enumerate(cameras):
        data = camera_ring.images.encode_png(camera_ring.picture(camera)[0])
        (tmp_path / "x.png").write_bytes(data)
        PilImage.open(tmp_path / "x.png").save(
            tmp_path / "images" / f"{i}.jpg", exif=exif, quality=97, subsampling=0
        )
    (tmp_path / "x.png").unlink()
    camera_ring.write_transforms(tmp_path, cameras, [f"images/{i}.jpg" for i in range(6)])
    check(open_capture(tmp_path), cameras, "transforms")


def test_normal_priors_from_files(tmp_path, cameras):
    names = camera_ring.write_photos(tmp_path / "images", cameras)
    camera_ring.write_transforms(tmp_path, cameras, [f"images/{n}" for n in names])
    towards = np.zeros((56, 72, 3))
    towards[..., 2] = -1  # OpenCV axes: a surface that faces the camera
    camera_ring.images.write_data(tmp_path / "images" / "000_normal.png", towards * 0.5 + 0.5)
    (tmp_path / "normals").mkdir()
    camera_ring.images.write_data(tmp_path / "normals" / "001.png", towards * 0.5 + 0.5)
    capture = open_capture(tmp_path)
    for i in (0, 1):
        np.testing.assert_allclose(capture.photos[i].load().normal, towards, atol=0.01)
    assert capture.photos[2].load().normal is None and len(capture.photos) == 6


def test_a_scale_in_the_pose_is_taken_out(tmp_path, cameras):
    names = camera_ring.write_photos(tmp_path / "images", cameras)
    camera_ring.write_transforms(tmp_path, cameras, [f"images/{n}" for n in names])
    data = json.loads((tmp_path / "transforms.json").read_text())
    for frame in data["frames"]:
        m = np.array(frame["transform_matrix"])
        m[:3, :3] *= 3
        frame["transform_matrix"] = m.tolist()
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    capture = open_capture(tmp_path)
    assert scale_of(capture.photos[0].camera.world_from_camera) == pytest.approx(1)
    camera_ring.same_camera(capture.photos[0].camera, cameras[0])


def test_numbers_of_cameras_and_photos_must_agree(tmp_path, cameras):
    camera_ring.write_photos(tmp_path / "image", cameras[:-1])
    np.savez(
        tmp_path / "cameras.npz",
        **{f"world_mat_{i}": camera_ring.projection(c) for i, c in enumerate(cameras)},
    )
    with pytest.raises(UserError, match="6 cameras and 5 photos do not match"):
        open_capture(tmp_path)


@pytest.mark.parametrize("suffix", [".png", ".exr"])
def test_normal_priors_know_where_they_know_nothing(tmp_path, suffix):
    """Black and middle grey of a picture and zeros of an EXR are no normals; the others come back
    unit, resized or not."""
    from relit.capture.photo import read_normal
    from relit.images import write_data, write_linear

    normal = np.zeros((12, 16, 3), np.float32)
    normal[:, :8] = [0.6, 0.0, -0.8]
    normal[:6, 8:] = [0.0, -0.6, -0.8]
    path = tmp_path / f"a{suffix}"
    if suffix == ".exr":
        write_linear(path, normal * 1.7)  # of any length
    else:
        codes = normal * 0.5 + 0.5  # unknown is middle grey ...
        codes[9:, 8:] = 0  # ... or black
        write_data(path, codes)
    got = read_normal(path, (12, 16))
    np.testing.assert_allclose(got, normal, atol=0.01)
    assert (got[6:, 8:] == 0).all()
    small = read_normal(path, (6, 8))
    np.testing.assert_allclose(small[:, :4], normal[::2, :8:2], atol=0.01)
    assert (small[3:, 4:] == 0).all()


def test_raw_files_beside_their_developed_photos_are_left_out(tmp_path):
    from relit.images import write_srgb

    picture = np.random.default_rng(0).uniform(0, 1, (20, 30, 3)).astype(np.float32)
    for k in range(4):
        write_srgb(tmp_path / f"DSC{k}.jpg", picture)
        (tmp_path / f"DSC{k}.NEF").write_bytes(b"never opened")
    capture = open_capture(tmp_path, masks="none")
    assert [p.name for p in capture.photos] == [f"DSC{k}.jpg" for k in range(4)]
    assert any("4 RAW files" in note for note in capture.notes)

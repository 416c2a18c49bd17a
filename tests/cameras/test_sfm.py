"""Cameras from photos alone, on drawn pictures of a textured corner of a room."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from relit import images
from relit.cameras import sfm
from relit.cameras.sfm import find_cameras
from relit.capture.open import open_capture
from relit.errors import EXIT_FAILED, UserError
from relit.geometry.se3 import camera_errors, look_at
from relit.scene import Camera
from support.room_corner import FOCAL, HEIGHT, WIDTH, arc, photo


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("room")
    for i, camera in enumerate(arc()):
        rgb, mask = photo(camera)
        images.write_srgb(path / "images" / f"{i}.png", rgb)
        images.write_data(path / "masks" / f"{i}.png", mask)
    return path


@pytest.mark.slow
def test_a_textured_corner(folder, tmp_path):
    truth = arc()
    capture = open_capture(folder)
    assert capture.photos[0].load().mask.mean() > 0.2
    found, verdict = find_cameras(capture, workdir=tmp_path)
    assert any("found from the masks" in n for n in found.notes)
    assert (
        verdict.registered == verdict.total == 6
        and verdict.reason == ""
        and verdict.mean_error < 1.0
    )
    assert found.has_cameras and found.sphere is not None and len(found.points) > 50
    poses = np.stack([p.camera.world_from_camera for p in found.photos])
    angle, distance = camera_errors(poses, np.stack([c.world_from_camera for c in truth]))
    inside = np.linalg.norm(found.points - np.median(found.points, axis=0), axis=1)
    assert (
        np.quantile(inside, 0.95) < 1.2 * found.sphere.radius
    )  # features off the masks are not used
    assert np.median(angle) < 0.5 and np.median(distance) < 0.05
    assert found.photos[0].camera.fx == pytest.approx(FOCAL, rel=0.05)
    assert found.photos[0].load().rgb.shape == (found.photos[0].height, found.photos[0].width, 3)

    again, same = find_cameras(capture, workdir=tmp_path)  # read back, not searched again
    assert same == verdict
    np.testing.assert_array_equal(
        again.photos[3].camera.world_from_camera, found.photos[3].camera.world_from_camera
    )


@pytest.mark.slow
def test_a_fixed_focal_stays_and_strangers_are_left_out_with_a_reason(
    folder, tmp_path, monkeypatch
):
    monkeypatch.setattr(
        sfm, "EXHAUSTIVE", 3
    )  # matched along the order of names, as a large capture is
    room = tmp_path / "room"
    room.mkdir()
    for i in range(1, 5):
        (room / f"{i}.png").write_bytes((folder / "images" / f"{i}.png").read_bytes())
    images.write_srgb(room / "blank.png", np.full((HEIGHT, WIDTH, 3), 0.4))
    found, verdict = find_cameras(
        open_capture(room, masks="none"), workdir=tmp_path / "work", focals=[FOCAL] * 5
    )
    assert (verdict.registered, verdict.total) == (4, 5)
    assert "1 have fewer than 150 features" in verdict.reason and "blank.png" in verdict.reason
    assert str(verdict).startswith("4 of 5 photos registered, because ")
    assert len(verdict.tries) >= 2  # it tried again before it gave up on that photo
    assert all(p.camera.fx == FOCAL for p in found.photos)
    assert [p.name for p in found.photos] == ["1.png", "2.png", "3.png", "4.png"]


def test_textureless_photos_are_refused_with_the_reason(tmp_path):
    for i in range(4):
        images.write_srgb(tmp_path / f"{i}.png", np.full((60, 80, 3), 0.3 + 0.05 * i))
    with pytest.raises(UserError, match="no cameras were found: 0 of 4") as caught:
        find_cameras(open_capture(tmp_path), workdir=tmp_path / "work")
    assert caught.value.code == EXIT_FAILED and "4 have fewer than 150 features" in caught.value.why


@pytest.mark.slow
def test_four_photos_of_forty_are_no_capture(folder, tmp_path):
    room = tmp_path / "room"
    room.mkdir()
    for i in range(1, 5):
        (room / f"{i}.png").write_bytes((folder / "images" / f"{i}.png").read_bytes())
    for i in range(36):
        images.write_srgb(room / f"blank{i}.png", np.full((HEIGHT, WIDTH, 3), 0.1 + 0.02 * i))
    with pytest.raises(UserError, match="too few cameras were found: 4 of 40") as caught:
        find_cameras(
            open_capture(room, masks="none"), workdir=tmp_path / "work", focals=[FOCAL] * 40
        )
    assert (
        caught.value.code == EXIT_FAILED and "36 have fewer than 150 features" in caught.value.why
    )


@pytest.mark.slow
def test_photos_that_look_apart_are_told_so_without_advice_about_given_poses(tmp_path):
    for i, x in enumerate(
        np.linspace(-0.5, 1.0, 5)
    ):  # a walk along a wall, each photo turned away from the middle
        eye = np.array([x, 0.0, -1.0])
        pose = look_at(eye, [x + 0.5 * (x - 0.25), 0.0, 1.0], [0, -1, 0])
        images.write_srgb(
            tmp_path / f"{i}.png",
            photo(Camera(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, pose))[0],
        )
    with pytest.raises(
        UserError, match=r"look away from each other.*found from the photos"
    ) as caught:
        find_cameras(
            open_capture(tmp_path, masks="none"), workdir=tmp_path / "work", focals=[FOCAL] * 5
        )
    assert (
        caught.value.code == EXIT_FAILED
        and "do not go around one object" in caught.value.why
        and "--sphere" not in caught.value.fix
    )


def test_two_photos_are_too_few(folder, tmp_path):
    capture = open_capture(folder, masks="none")
    with pytest.raises(UserError, match="2 photos are not enough"):
        find_cameras(replace(capture, photos=capture.photos[:2]), workdir=tmp_path)


def test_pycolmap_does_not_break_zlib():
    """Without the guard in `relit/__init__.py` this aborts: pycolmap's zlib symbols take the place
    of libz's."""
    code = "import relit, pycolmap, zlib; data = bytes(range(256)) * 8192; assert zlib.decompress(zlib.compress(data, 4)) == data"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)

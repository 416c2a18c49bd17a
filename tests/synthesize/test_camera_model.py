"""Each effect of the camera model against its formula, and the file as the package reads it."""

from dataclasses import replace

import numpy as np
import pytest

from relit.errors import UserError
from relit.geometry.lens import lens_of, pixels_from_ideal, undistorted_camera, undistortion_map
from relit.geometry.se3 import look_at
from relit.images import read_header, read_image
from relit.scene import Camera
from relit.synthesize import camera_model as cm

W, H, F = 160, 120, 170.0
CAMERA = Camera(W, H, F, F, W / 2, H / 2, look_at(np.array([0.0, 0.5, 3.0])))


def shot_of(seed=0, camera=CAMERA, **settings):
    model = cm.CameraModel(**settings)
    return model, cm.draw_shot(model, camera, seed)


def smooth_scene(camera):
    """(H, W, 3) a pattern over ideal coordinates, through a pinhole."""
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    u, v = np.meshgrid(x, y)
    value = 0.5 + 0.2 * np.sin(14 * u + 3 * v) + 0.2 * np.cos(11 * v)
    return np.repeat(value[..., None], 3, 2).astype(np.float32)


def test_an_ideal_camera_changes_nothing():
    model, shot = shot_of()
    assert np.array_equal(shot.camera.world_from_camera, CAMERA.world_from_camera)
    assert (shot.camera.cx, shot.camera.distortion, shot.orientation) == (W / 2, (), 1)
    scene = smooth_scene(CAMERA)
    codes, record = cm.develop(model, shot, scene)
    expected = cm.codes_of(cm.respond(scene, "srgb"))
    assert np.array_equal(codes, expected) and record["gain"] == 1
    assert model.suffix == ".png"


@pytest.mark.parametrize("k1", [-0.12, 0.08])
def test_distortion_is_undone_by_the_lens_of_the_package(k1):
    _, shot = shot_of(distortion=k1)
    wide = cm.wide_pinhole(shot.camera)
    photo = cm.distorted_picture(shot.camera, wide, smooth_scene(wide))
    lens = lens_of(shot.camera)
    ideal = undistorted_camera(shot.camera, lens)
    import cv2

    x, y = undistortion_map(shot.camera, lens, ideal)
    back = cv2.remap(photo, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    error = np.abs(back - smooth_scene(ideal))[3:-3, 3:-3]
    assert error.max() < 4e-3  # half a code of 8 bits in a slope of .02 a pixel
    moved = pixels_from_ideal(shot.camera, lens, np.array([[0.4, 0.3]]))
    assert np.abs(moved - pixels_from_ideal(CAMERA, None, np.array([[0.4, 0.3]]))).max() > 1


def test_a_lens_that_folds_the_frame_is_refused():
    wide_angle = Camera(W, H, 60.0, 60.0, W / 2, H / 2, np.eye(4))
    _, shot = shot_of(camera=wide_angle, distortion=-0.3)
    with pytest.raises(UserError, match="cannot be inverted"):
        cm.wide_pinhole(shot.camera)


@pytest.mark.parametrize("response", cm.RESPONSES)
def test_responses_are_monotone_and_inverted(response):
    x = np.linspace(0, 1, 4001)
    y = cm.respond(x, response)
    assert y[0] == 0 and y[-1] == pytest.approx(1) and (np.diff(y) > 0).all()
    assert np.abs(cm.inverse_response(y, response) - x).max() < 1e-5


def test_responses_differ():
    grey = [float(cm.respond(np.array(0.18), r)) for r in cm.RESPONSES]
    assert grey[0] == pytest.approx(0.4614, abs=1e-3)
    assert grey[1] == pytest.approx(0.18 ** (1 / 2.2), abs=1e-6)
    assert cm.respond(0.05, "phone") < cm.respond(0.05, "srgb") - 0.03  # darker shadows
    assert cm.respond(0.6, "phone") > cm.respond(0.6, "srgb") + 0.03


def test_noise_has_the_variance_of_its_formula():
    model, shot = shot_of(shot_noise=0.002, read_noise=0.01, response="gamma")
    level = 0.3
    codes, record = cm.develop(model, shot, np.full((H, W, 3), level, np.float32))
    linear = cm.inverse_response(codes / 255, "gamma")
    amplified = record["iso"] / 100
    expected = 0.002 * amplified * level + (0.01 * amplified) ** 2
    assert linear.var() == pytest.approx(expected, rel=0.05)
    assert linear.mean() == pytest.approx(level, abs=1e-3)


def test_auto_exposure_reaches_its_mean_and_exif_tells_the_gain():
    gains = []
    for brightness in (0.03, 0.3):
        model, shot = shot_of(auto_exposure=0.18)
        codes, record = cm.develop(model, shot, brightness * smooth_scene(CAMERA))
        assert cm.inverse_response(codes / 255, "srgb").mean() == pytest.approx(0.18, abs=2e-3)
        gains.append(record["gain"])
        assert record["exposure_time"] * record["iso"] == pytest.approx(record["gain"] / 1.2)
        assert record["exposure_time"] <= cm.LONGEST_TIME
    assert gains[0] == pytest.approx(10 * gains[1], rel=1e-4)


def test_white_balance_drifts_red_and_blue_alone():
    gains = np.array(
        [cm.draw_shot(cm.CameraModel(white_balance=0.1), CAMERA, s).white for s in range(400)]
    )
    assert (gains[:, 1] == 1).all()
    assert np.log(gains[:, [0, 2]]).std(0) == pytest.approx([0.1, 0.1], rel=0.15)
    model, shot = shot_of(3, white_balance=0.1)
    codes, _ = cm.develop(model, shot, np.full((H, W, 3), 0.3, np.float32))
    linear = cm.inverse_response(codes / 255, "srgb")[0, 0]
    assert linear / linear[1] == pytest.approx(shot.white, rel=0.02)


def test_vignetting_is_quadratic_around_the_principal_point():
    camera = replace(CAMERA, cx=50.0)
    field = cm.vignette(camera, 0.4)
    assert field[59:61, 49:51].min() > 0.9999
    assert field.min() == pytest.approx(0.6, abs=0.01) and field[0, -1] == field.min()
    assert field[60, -1] == pytest.approx(1 - 0.4 * (109.5**2 + 0.25) / (110**2 + 60**2), abs=1e-3)


def test_blur_has_its_width_and_keeps_the_light():
    point = np.zeros((61, 61, 3), np.float32)
    point[30, 30] = 1
    _, shot = shot_of()
    y, x = np.mgrid[:61, :61] - 30.0
    soft = cm.blurred(point, replace(shot, defocus=1.7))[..., 0]
    assert soft.sum() == pytest.approx(1, abs=1e-3)
    assert (soft * x**2).sum() == pytest.approx(1.7**2, rel=0.05)
    streak = cm.blurred(point, replace(shot, motion=9.0, angle=np.radians(30)))[..., 0]
    assert streak.sum() == pytest.approx(1, abs=1e-3)
    values, vectors = np.linalg.eigh([[(streak * a * b).sum() for b in (x, y)] for a in (x, y)])
    assert values[1] == pytest.approx(9.0**2 / 12, rel=0.08) and values[0] < 0.3
    angle = np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])) % 180
    assert angle == pytest.approx(30, abs=2)


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_a_turned_file_is_read_upright(tmp_path, orientation):
    model, shot = shot_of(jpeg=98, exif=True)
    shot = replace(shot, orientation=orientation)
    scene = np.zeros((H, W, 3), np.float32)
    scene[: H // 2] += 0.4
    scene[:, : W // 3, 0] += 0.4
    codes, record = cm.develop(model, shot, scene)
    file = tmp_path / "photo.jpg"
    file.write_bytes(cm.encode_photo(model, shot, codes, record))
    read = read_image(file)
    assert np.abs(read.rgb - scene).mean() < 0.01
    header = read_header(file)
    assert (header.width, header.height) == (W, H) and header.orientation == orientation
    if orientation >= 5:
        assert read_image(file, upright=False).rgb.shape[:2] == (W, H)
    # the 35 mm equivalent is a whole number
    assert header.focal == pytest.approx(F, abs=0.6 * np.hypot(W, H) / 43.27)


def test_exif_holds_what_was_drawn(tmp_path):
    from PIL import Image

    model = cm.PRESETS["phone"]
    shot = cm.draw_shot(model, CAMERA, 5)
    codes, record = cm.develop(model, shot, 0.2 * smooth_scene(CAMERA))
    file = tmp_path / "photo.jpg"
    file.write_bytes(cm.encode_photo(model, shot, codes, record))
    with Image.open(file) as image:
        inner = image.getexif().get_ifd(0x8769)
    assert float(inner[0x829A]) == pytest.approx(record["exposure_time"], abs=1e-6)
    assert inner[0x8827] == round(record["iso"])
    assert float(inner[0x829D]) == cm.F_NUMBER and inner[0x9209] == 0x10


def test_shares_of_partial_cropped_and_turned_photos():
    model = cm.CameraModel(partial=0.3, crops=0.2, turned=0.6, exif=True, jpeg=90)
    shots = [cm.draw_shot(model, CAMERA, s) for s in range(600)]
    for share, key in ((0.3, "partial"), (0.2, "cropped")):
        assert np.mean([getattr(s, key) for s in shots]) == pytest.approx(share, abs=0.05)
    turned = [s.orientation for s in shots if s.orientation != 1]
    assert len(turned) / 600 == pytest.approx(0.6, abs=0.05) and set(turned) == {3, 6, 8}
    middle = np.array([W / 2, H / 2])
    for shot in shots[:80]:
        off = shot.camera.project(np.zeros(3))[:2] - middle
        share = np.linalg.norm(off) / H
        if shot.partial:
            assert 0.3 - 1e-6 <= share <= 0.5 + 1e-6
        else:
            assert share < 1e-6
        shift = abs(shot.camera.cx - W / 2) / W
        assert shift == 0 if not shot.cropped else 0.08 <= shift <= 0.2


def test_drawing_depends_on_the_seed_alone():
    phone = cm.PRESETS["phone"]
    a, b = (cm.draw_shot(phone, CAMERA, 9) for _ in range(2))
    assert np.array_equal(a.camera.world_from_camera, b.camera.world_from_camera)
    assert (a.white, a.ev, a.orientation) == (b.white, b.ev, b.orientation)
    assert cm.draw_shot(phone, CAMERA, 10).white != a.white
    still = cm.draw_shot(replace(phone, motion=0.0, partial=0.0), CAMERA, 9)
    assert still.white == a.white and still.ev == a.ev


def test_settings_from_text():
    phone = cm.PRESETS["phone"]
    assert cm.parse_camera_model("phone") == phone
    assert cm.parse_camera_model("off") == cm.CameraModel()
    some = cm.parse_camera_model("vignetting=.3, jpeg=80")
    assert some == cm.CameraModel(vignetting=0.3, jpeg=80)
    changed = cm.parse_camera_model("phone,exif=0,turned=0,response=gamma")
    assert changed == replace(phone, exif=False, turned=0.0, response="gamma")
    for text in ("fone", "jpg=80", "jpeg=x", "vignetting=2", "exif=maybe", "turned=.5,jpeg=90"):
        with pytest.raises(UserError):
            cm.parse_camera_model(text)

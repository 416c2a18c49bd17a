"""Wrong input gets what, why and fix, with exit code 3."""

import json

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from relit import images
from relit.capture import mask_sources
from relit.capture.frames import parse_json_file
from relit.capture.open import open_capture
from relit.capture.readers.middlebury import parse
from relit.cli import main as cli
from relit.errors import EXIT_INPUT, EXIT_USAGE, UserError
from relit.scene import Sphere
from support import camera_ring


def refused(path, match, **options):
    with pytest.raises(UserError, match=match) as caught:
        open_capture(path, **options)
    assert caught.value.code == EXIT_INPUT and caught.value.fix
    return caught.value


def edit(folder, change):
    file = folder / "transforms.json"
    data = json.loads(file.read_text())
    change(data)
    file.write_text(json.dumps(data))


def test_nothing_there(tmp_path):
    refused(tmp_path / "nowhere", "not there")


def test_no_images_says_what_was_looked_for(tmp_path):
    (tmp_path / "notes.txt").write_text("hello")
    error = refused(tmp_path, "no images")
    for word in (
        "transforms.json",
        "cameras_sphere.npz",
        "_par.txt",
        "sparse/",
        "poses_bounds.npy",
        "notes.txt",
    ):
        assert word in error.why


def test_one_image(tmp_path):
    camera_ring.write_photos(tmp_path, camera_ring.ring(1))
    refused(tmp_path, "1 photo is not enough: at least 3")


@pytest.mark.parametrize("side", [-5, 0, 15])
def test_photos_cannot_be_shrunk_to_nothing(capture_folder, capsys, side):
    with pytest.raises(UserError, match=f"cannot be shrunk to {side} pixels") as caught:
        open_capture(capture_folder, max_side=side)
    assert (
        caught.value.code == EXIT_USAGE and "at least 16" in caught.value.why and caught.value.fix
    )
    assert cli.main(["inspect", str(capture_folder), "--max-side", str(side)]) == EXIT_USAGE
    assert "at least 16" in capsys.readouterr().err


def test_mixed_sizes(tmp_path, cameras):
    camera_ring.write_photos(
        tmp_path / "images",
        [cameras[0], cameras[1].resized(90, 70), *cameras[2:]],
        background=camera_ring.BACKGROUND,
    )
    assert any("2 sizes (5 of 72 x 56, 1 of 90 x 70)" in n for n in open_capture(tmp_path).notes)
    camera_ring.write_photos(
        tmp_path / "images", [cameras[0].resized(56, 72)], background=camera_ring.BACKGROUND
    )
    names = [f"images/{i:03d}.png" for i in range(6)]
    camera_ring.write_transforms(tmp_path, cameras, names)
    refused(tmp_path, "different shapes: 72 x 56 and 56 x 72")


def test_photos_that_do_not_match_the_cameras(capture_folder):
    for i, file in enumerate(sorted((capture_folder / "images").iterdir())):
        file.rename(file.with_name(f"other{i}.png"))
    refused(
        capture_folder,
        r"6 of 6 photos in transforms.json are not there, for example 'images/000.png'",
    )


def test_cameras_that_look_away(capture_folder):
    def turn(data):
        for frame in data["frames"]:
            m = np.array(frame["transform_matrix"])
            m[:3, 1:3] *= -1  # OpenCV poses where OpenGL ones belong
            frame["transform_matrix"] = m.tolist()

    edit(capture_folder, turn)
    refused(capture_folder, "look away from each other: only 0 of 6")


def test_sphere_outside_the_views(capture_folder):
    refused(
        capture_folder,
        "sphere lies outside the view of . of 6",
        sphere=Sphere(np.array([0.0, 40.0, 0.0]), 0.5),
    )
    refused(capture_folder, "sphere is not valid", sphere=Sphere(np.zeros(3), -1.0))


@pytest.mark.parametrize(
    "value, match", [(0.0, "all masks are black"), (1.0, "all masks are white")]
)
def test_masks_that_say_nothing(capture_folder, value, match):
    for i in range(6):
        images.write_data(
            _made(capture_folder / "masks") / f"{i:03d}.png", np.full((56, 72), value)
        )
    refused(capture_folder, match)


def _made(folder):
    folder.mkdir(exist_ok=True)
    return folder


def test_missing_masks(capture_folder, cameras):
    for i in range(4):
        images.write_data(
            _made(capture_folder / "masks") / f"{i:03d}.png", camera_ring.picture(cameras[i])[1]
        )
    error = refused(capture_folder, "2 of 6 photos have no mask, for example images/004.png")
    assert "masks/" in error.why
    assert open_capture(capture_folder, masks="none").photos[0].load().mask is None


def test_inverted_masks_are_turned_with_a_note(capture_folder, cameras):
    for i, camera in enumerate(cameras):
        images.write_data(
            _made(capture_folder / "mask") / f"{i}.png", 1 - camera_ring.picture(camera)[1]
        )
    capture = open_capture(capture_folder)
    assert any("inverted" in n for n in capture.notes)
    np.testing.assert_allclose(
        capture.photos[2].load().mask, camera_ring.picture(cameras[2])[1], atol=0.01
    )


def test_masks_of_0_and_1_are_read_with_a_note(capture_folder, cameras):
    for i, camera in enumerate(cameras):
        images.write_data(
            _made(capture_folder / "masks") / f"{i:03d}.png",
            (camera_ring.picture(camera)[1] > 0.5) / 255,
        )
    capture = open_capture(capture_folder)
    assert any("numbers 0 and 1" in n for n in capture.notes)
    np.testing.assert_array_equal(
        capture.photos[2].load().mask, camera_ring.picture(cameras[2])[1] > 0.5
    )


def test_masks_of_the_pixels_as_stored_are_turned_with_their_photo(tmp_path, cameras):
    """Some tools ignore EXIF: their mask of a turned photo lies on its side."""
    from PIL import Image as PilImage

    exif = PilImage.Exif()
    exif[0x0112] = 6
    (tmp_path / "images").mkdir()
    stored = [np.rot90(camera_ring.picture(c)[i], 1) for c in cameras for i in (0, 1)]
    for i in range(6):
        codes = (np.clip(stored[2 * i] ** (1 / 2.2), 0, 1) * 255).astype(np.uint8)
        PilImage.fromarray(codes).save(tmp_path / "images" / f"{i}.jpg", exif=exif, quality=97)
        images.write_data(_made(tmp_path / "masks") / f"{i}.png", stored[2 * i + 1])
    photo = open_capture(tmp_path).photos[1]
    assert (photo.width, photo.height) == (72, 56)
    np.testing.assert_allclose(photo.load().mask, camera_ring.picture(cameras[1])[1], atol=0.01)


def test_an_inverted_alpha_channel(tmp_path, cameras):
    for i, camera in enumerate(cameras):
        rgb, alpha = camera_ring.picture(camera)
        images.write_srgb(tmp_path / f"{i}.png", np.concatenate([rgb, 1 - alpha[..., None]], -1))
    refused(tmp_path, "alpha channel looks inverted")


def test_an_opaque_alpha_channel_is_no_mask(tmp_path, cameras):
    for i, camera in enumerate(cameras):
        rgb, alpha = camera_ring.picture(camera)
        background = np.random.default_rng(i).uniform(size=rgb.shape) * (1 - alpha[..., None])
        images.write_srgb(
            tmp_path / f"{i}.png",
            np.concatenate([rgb + background, np.ones_like(alpha)[..., None]], -1),
        )
    capture = open_capture(tmp_path)
    assert capture.photos[0].load().mask is None and not capture.black_background
    assert any("opaque everywhere" in n for n in capture.notes)


def test_a_mask_of_another_shape(capture_folder):
    for i in range(6):
        mask = np.zeros((72, 56) if i == 3 else (56, 72))
        mask[20:40, 20:40] = 1
        images.write_data(_made(capture_folder / "masks") / f"{i:03d}.png", mask)
    with pytest.raises(UserError, match="mask and its photo have different shapes"):
        open_capture(capture_folder).photos[3].load()


def test_a_photo_with_an_empty_mask_is_left_out_with_a_note(capture_folder, cameras, monkeypatch):
    monkeypatch.setattr(mask_sources, "SMALL", 40)  # masks are judged on small copies
    for i, camera in enumerate(cameras):
        images.write_data(
            _made(capture_folder / "masks") / f"{i:03d}.png",
            camera_ring.picture(camera)[1] * (i != 2),
        )
    capture = open_capture(capture_folder)
    assert len(capture.photos) == 5 and any(
        "1 photos have an empty mask" in n for n in capture.notes
    )


def test_masks_asked_for_but_not_there(capture_folder):
    refused(capture_folder, "6 of 6 photos have no mask", masks="files")
    refused(capture_folder, "no alpha channel", masks="alpha")
    with pytest.raises(
        UserError, match=r"unknown kind of masks 'threshhold'. Did you mean 'threshold'\?"
    ):
        open_capture(capture_folder, masks="threshhold")


def test_grabcut_on_request(capture_folder, cameras):
    capture = open_capture(capture_folder, masks="grabcut")
    mask, truth = capture.photos[0].load().mask, camera_ring.picture(cameras[0])[1]
    assert ((mask > 0.5) & (truth > 0.5)).sum() > 0.6 * (truth > 0.5).sum()
    assert any("GrabCut" in n for n in capture.notes)


def test_truncated_jpeg_and_nan(tmp_path):
    camera_ring.write_photos(
        tmp_path, camera_ring.ring(4), suffix=".jpg", background=camera_ring.BACKGROUND
    )
    whole = (tmp_path / "002.jpg").read_bytes()
    (tmp_path / "002.jpg").write_bytes(whole[: len(whole) // 2])
    refused(tmp_path, "cannot be read")
    exr = tmp_path / "exr"
    camera_ring.write_photos(
        exr, camera_ring.ring(4), suffix=".exr", background=camera_ring.BACKGROUND
    )
    images.write_linear(exr / "001.exr", np.full((56, 72, 3), np.inf))
    refused(exr, "NaN or infinite")


@pytest.mark.parametrize(
    "name", ["../../../etc/passwd", "/etc/passwd", "images/../../x.png", "..\\x.png"]
)
def test_paths_stay_inside(capture_folder, name):
    edit(capture_folder, lambda data: data["frames"][0].update(file_path=name))
    refused(capture_folder, "outside the capture")


@pytest.mark.parametrize(
    "change, match",
    [
        (lambda d: d.pop("frames"), "no frames"),
        (lambda d: d["frames"][0].pop("file_path"), "no file_path"),
        (lambda d: d["frames"][0].update(transform_matrix=[[1, 2], [3]]), "no valid 4 x 4 pose"),
        (
            lambda d: d["frames"][0].update(transform_matrix=np.diag([1, 1, -1, 1]).tolist()),
            "mirrored",
        ),
        (
            lambda d: d["frames"][0].update(transform_matrix=np.diag([1, 5, 1, 1]).tolist()),
            "not a rotation",
        ),
        (lambda d: d.pop("fl_x"), "no focal length"),
        (lambda d: d.update(fl_x="wide"), "not a number"),
        (lambda d: d.update(fl_x=-4), "out of range"),
        (lambda d: d.update(camera_model="EQUIRECTANGULAR"), "camera model 'EQUIRECTANGULAR'"),
    ],
)
def test_broken_transforms(capture_folder, change, match):
    edit(capture_folder, change)
    refused(capture_folder, match)


def test_malformed_json_names_the_place(capture_folder):
    (capture_folder / "transforms.json").write_text('{"frames": [,]}')
    assert "line 1" in refused(capture_folder, "not valid JSON").why
    (capture_folder / "transforms.json").write_bytes(b"\xff\xfe\x00")
    refused(capture_folder, "not text")


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4)
    ),
    max_leaves=8,
)
KEYS = [
    "fl_x",
    "fl_y",
    "cx",
    "w",
    "h",
    "k1",
    "p1",
    "camera_angle_x",
    "camera_model",
    "is_fisheye",
    "frames",
    "test_filenames",
]


@pytest.mark.slow
@given(
    st.dictionaries(st.sampled_from(KEYS), values, max_size=4),
    st.dictionaries(
        st.sampled_from(["file_path", "transform_matrix", "mask_path", "fl_x"]), values
    ),
)
@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_any_json_is_read_or_refused(tmp_path, head, first):
    if not (tmp_path / "images").exists():
        camera_ring.write_photos(
            tmp_path / "images", camera_ring.ring(3), background=camera_ring.BACKGROUND
        )
    cameras = camera_ring.ring(3)
    camera_ring.write_transforms(tmp_path, cameras, [f"images/{i:03d}.png" for i in range(3)])

    def change(data):
        data["frames"][0].update(first)
        data.update(head)

    edit(tmp_path, change)
    try:
        open_capture(tmp_path, masks="none")
    except UserError as error:
        assert error.code == EXIT_INPUT


@given(st.text(max_size=200))
@settings(max_examples=60, deadline=None)
def test_any_parameter_file_is_read_or_refused(text):
    from pathlib import Path

    try:
        for name, numbers in parse(text, Path("x_par.txt")):
            assert name and numbers.shape == (21,)
    except UserError:
        pass


@given(st.binary(max_size=60))
@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_any_bytes_as_json_are_read_or_refused(tmp_path, data):
    (tmp_path / "x.json").write_bytes(data)
    try:
        assert isinstance(parse_json_file(tmp_path / "x.json"), dict)
    except UserError:
        pass

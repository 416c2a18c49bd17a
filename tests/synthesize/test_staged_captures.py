"""Everyday and turntable captures, and multiview through a camera model: tiny, with what they say
checked against what they show."""

import json

import numpy as np
import pytest
import trimesh

from relit.capture.open import open_capture
from relit.errors import UserError
from relit.evaluate.truth import load_truth
from relit.images import read_data, read_image, write_linear
from relit.reference.mitsuba_scene import build_geometry
from relit.scene import Mesh
from relit.synthesize import surroundings
from relit.synthesize.camera_model import CameraModel
from relit.synthesize.delivery import Delivery, pixel_directions
from relit.synthesize.everyday import EVERYDAY, synthesize_everyday
from relit.synthesize.multiview import synthesize_multiview
from relit.synthesize.object_truth import CaptureFiles, Sampling
from relit.synthesize.surroundings import TEXTURES, out_of_focus, table_texture
from relit.synthesize.turntable import synthesize_turntable

SAMPLING = Sampling(views=4, test_views=1, resolution=64, spp=8, test_spp=8, seed=2)


@pytest.fixture(scope="module", autouse=True)
def coarse_textures():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(surroundings, "TEXTURE_SIZE", 256)
        patch.setattr(surroundings, "DISC_SIZE", 128)
        yield


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """An object without symmetry: an L of two boxes."""
    folder = tmp_path_factory.mktemp("asset")
    foot = trimesh.creation.box((2.0, 0.5, 0.8))
    tower = trimesh.creation.box((0.5, 1.2, 0.5))
    tower.apply_translation((0.7, 0.8, 0.1))
    trimesh.util.concatenate([foot, tower]).export(folder / "l.obj")
    for name, column in (("light", 8), ("other", 24)):
        light = np.full((16, 32, 3), 1.0, np.float32)
        light[3:6, column : column + 3] = 40.0
        write_linear(folder / f"{name}.exr", light)
    return CaptureFiles(
        folder / "l.obj", folder / "light.exr", (folder / "other.exr",), roughness=0.6, metallic=0.0
    )


def silhouette(capture, camera):
    """(H, W) bool: truth/mesh.ply seen by a camera, at the pixel centres."""
    import mitsuba as mi

    ply = trimesh.load(capture / "truth" / "mesh.ply", process=False)
    mesh = Mesh(
        np.asarray(ply.vertices, np.float32),
        np.asarray(ply.faces, np.int32),
        np.asarray(ply.vertex_normals, np.float32),
    )
    d = pixel_directions(camera).reshape(-1, 3)
    ray = mi.Ray3f(mi.Point3f(*map(float, camera.centre)), mi.Vector3f(*d.T.astype(np.float32)))
    hit = build_geometry(mesh).ray_test(ray)
    return np.array(hit).reshape(camera.height, camera.width)


def masks_agree_with_cameras(capture):
    truth = load_truth(capture)
    for name, camera in truth.train.items():
        mask = read_data(capture / "truth" / "masks" / f"{name}.png") > 0.5
        seen = silhouette(capture, camera)
        assert mask.shape == seen.shape and mask.sum() > 50
        assert (mask & seen).sum() / (mask | seen).sum() > 0.93, name
    return truth


@pytest.fixture(scope="module")
def everyday(files, tmp_path_factory):
    delivery = Delivery(CameraModel(crops=0.5, partial=0.3, jpeg=95), masks=False, cameras=False)
    out = tmp_path_factory.mktemp("e") / "capture"
    return synthesize_everyday(files, out, SAMPLING, delivery=delivery)


@pytest.fixture(scope="module")
def turntable(files, tmp_path_factory):
    out = tmp_path_factory.mktemp("t") / "capture"
    delivery = Delivery(CameraModel(partial=1.0, turned=1.0, jpeg=95, exif=True))
    return synthesize_turntable(files, out, SAMPLING, elevations=(20, 45), delivery=delivery)


def test_everyday_hands_over_photos_alone(everyday):
    assert {p.name for p in everyday.iterdir()} == {"images", "truth"}
    capture = open_capture(everyday)
    assert len(capture.photos) == 4
    assert all(p.camera is None and p.load().mask is None for p in capture.photos)


def test_everyday_cameras_are_true_for_the_masks(everyday):
    truth = masks_agree_with_cameras(everyday)
    sizes = {(c.width, c.height) for c in truth.train.values()}
    assert sizes <= {(64, 48), (48, 64)}
    records = json.loads((everyday / "truth" / "truth.json").read_text())["photos"]
    assert any(r["cropped"] for r in records.values())
    assert any(abs(c.cx - c.width / 2) > 1 for c in truth.train.values())


def test_everyday_truth_has_the_layout_of_multiview(everyday):
    truth = load_truth(everyday)
    assert list(truth.test) == ["t_000"] and truth.meta["relight"] == ["other"]
    for tail in ("", "_albedo", "_normal", "_roughness", "_metallic", "_depth"):
        assert (everyday / "truth" / "test" / f"t_000{tail}.exr").is_file()
    lit = truth.picture("relight/other/t_000")
    camera = truth.test["t_000"]
    alone = lit[..., 3] > 0.5
    seen = silhouette(everyday, camera)
    assert (alone & seen).sum() / (alone | seen).sum() > 0.93  # no table in it


def test_the_object_throws_a_shadow_on_the_table(everyday):
    """Table pixels beside the object are darker than the median of the table."""
    import cv2

    darker = []
    for file in sorted((everyday / "images").iterdir()):
        grey = read_image(file).rgb.mean(-1)
        mask = read_data(everyday / "truth" / "masks" / f"{file.stem}.png")
        near = cv2.dilate(mask, np.ones((9, 9))) - cv2.dilate(mask, np.ones((3, 3)))
        below = np.arange(len(grey))[:, None] > np.argwhere(mask > 0.5)[:, 0].mean()
        beside, table = (near > 0.5) & below, (mask < 0.01) & below
        darker.append(np.median(grey[beside]) / np.median(grey[table]))
    assert np.mean(darker) < 0.95


def test_turntable_cameras_turn_about_the_object(turntable):
    truth = masks_agree_with_cameras(turntable)
    told = truth.meta["turntable"]
    assert told["elevations"] == [20, 45]
    assert [round(a) for a in told["angles"].values()] == [0, 180, 0, 180]
    centres = np.array([c.centre for c in truth.train.values()])
    assert centres[1] == pytest.approx(centres[0] * [-1, 1, -1], abs=1e-6)
    heights = np.degrees(np.arcsin(centres[:, 1] / np.linalg.norm(centres, axis=1)))
    assert heights == pytest.approx([20, 20, 45, 45], abs=1e-6)


def test_the_background_of_a_turntable_is_still_and_the_plate_is_not(turntable):
    first, second = (read_image(turntable / "images" / f"v_00{i}.jpg").rgb for i in (0, 1))
    assert np.abs(first[:4] - second[:4]).mean() < 0.02  # above the object
    foot = slice(-14, None)  # rows of the plate
    assert np.abs(first[foot] - second[foot]).mean() > 2 * np.abs(first[:4] - second[:4]).mean()


def test_turntable_hands_over_masks_and_cameras_when_asked(turntable):
    capture = open_capture(turntable)
    assert all(p.camera is not None and p.load().mask is not None for p in capture.photos)
    truth = load_truth(turntable)
    for photo in capture.photos:
        pose = truth.train[photo.name.split("/")[-1].split(".")[0]].world_from_camera
        assert photo.camera.world_from_camera == pytest.approx(pose)


@pytest.mark.slow
def test_multiview_through_a_phone_opens_undistorted_and_upright(files, tmp_path):
    model = CameraModel(distortion=0.1, turned=0.9, jpeg=95, exif=True)
    out = synthesize_multiview(
        files.asset,
        files.light,
        tmp_path / "capture",
        views=4,
        test_views=1,
        resolution=64,
        spp=8,
        test_spp=8,
        roughness=0.6,
        metallic=0.0,
        delivery=Delivery(model),
    )
    truth, capture = load_truth(out), open_capture(out)
    records = truth.meta["photos"]
    assert {r["orientation"] for r in records.values()} - {1}
    assert truth.meta["delivery"]["camera"]["distortion"] == 0.1
    for photo in capture.photos:
        pixels = photo.load()
        mask, seen = pixels.mask > 0.5, silhouette(out, photo.camera)
        assert (mask & seen).sum() / (mask | seen).sum() > 0.93
    assert not (out / "train").exists() and not (out / "transforms_train.json").exists()


def test_textures_are_made_by_seed_and_read_from_files(tmp_path):
    for name in TEXTURES:
        colour, roughness = table_texture(name, 1)
        again, other = table_texture(name, 1)[0], table_texture(name, 2)[0]
        assert np.array_equal(colour, again) and np.abs(colour - other).mean() > 0.01
        assert 0 < colour.min() and colour.max() < 1 and 0 < roughness <= 1
        assert colour.mean(-1).std() > 0.02  # has features
    write_linear(tmp_path / "t.exr", np.full((4, 4, 3), 0.3, np.float32))
    assert table_texture(tmp_path / "t.exr", 0)[0] == pytest.approx(np.full((4, 4, 3), 0.3))
    with pytest.raises(UserError, match="unknown texture"):
        table_texture("wod", 0)


def test_what_is_behind_is_blurred_around_the_seam():
    light = np.zeros((90, 180, 3), np.float32)
    light[45, 0] = 1
    soft = out_of_focus(light, 4.0)
    assert soft[45, 1] == pytest.approx(soft[45, -1]) and soft[45, -1].min() > 0
    assert np.array_equal(out_of_focus(light, 0.0), light)


def test_settings_that_make_no_sense_are_refused(files, tmp_path):
    with pytest.raises(UserError, match="elevation"):
        synthesize_turntable(files, tmp_path / "a", SAMPLING, elevations=(95.0,))
    with pytest.raises(UserError, match="views"):
        Sampling(views=1, test_views=1, resolution=64, spp=1, test_spp=1)
    with pytest.raises(UserError, match="unknown texture"):
        synthesize_everyday(files, tmp_path / "a", SAMPLING, texture="glass", delivery=EVERYDAY)
    assert not (tmp_path / "a").exists()

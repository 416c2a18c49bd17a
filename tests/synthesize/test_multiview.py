"""A tiny synthetic capture: what lies where, that it says what it shows, and that it can be taken
up again."""

import json

import numpy as np
import pytest
import trimesh

from relit.conventions import linear_from_srgb, world_from_cv_camera
from relit.errors import UserError
from relit.images import read_data, read_image, write_linear, write_srgb
from relit.scene import Mesh
from relit.synthesize import multiview as synthetic

OPTIONS = dict(
    views=4, test_views=2, resolution=32, spp=16, test_spp=32, seed=3, roughness=0.5, metallic=0.0
)


def write_ball(folder):
    """An OBJ of a ball of radius 2 around (5, 1, 0), left half red and right half green by
    texture."""
    ball = trimesh.creation.icosphere(3)
    uv = np.stack(
        [np.where(ball.vertices[:, 0] < 0, 0.25, 0.75), np.full(len(ball.vertices), 0.5)], 1
    )
    v = 2 * ball.vertices + [5, 1, 0]
    lines = [
        "mtllib ball.mtl",
        "usemtl m",
        *(f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in v),
        *(f"vt {a:.4f} {b:.4f}" for a, b in uv),
    ]
    lines += [f"vn {x:.6f} {y:.6f} {z:.6f}" for x, y, z in ball.vertices]
    lines += ["f " + " ".join(f"{i}/{i}/{i}" for i in face) for face in ball.faces + 1]
    (folder / "ball.obj").write_text("\n".join(lines) + "\n")
    (folder / "ball.mtl").write_text("newmtl m\nmap_Kd ball.png\n")
    texture = np.zeros((8, 8, 3), np.float32)
    texture[:, :4], texture[:, 4:] = (0.6, 0.1, 0.1), (0.1, 0.6, 0.1)
    write_srgb(folder / "ball.png", texture)
    return folder / "ball.obj"


def write_light(folder, name="light.exr", direction_column=8):
    light = np.full((16, 32, 3), 20.0, np.float32)
    light[4:7, direction_column : direction_column + 3] = 400.0
    write_linear(folder / name, light)
    return folder / name


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ball")
    return write_ball(folder), write_light(folder), write_light(folder, "other.exr", 24)


@pytest.fixture(scope="module")
def capture(ball, tmp_path_factory):
    asset, light, other = ball
    return synthetic.synthesize_multiview(
        asset, light, tmp_path_factory.mktemp("c") / "capture", relights=[other], **OPTIONS
    )


@pytest.mark.slow
def test_layout(capture):
    truth = json.loads((capture / "truth" / "truth.json").read_text())
    assert (
        len(list(capture.glob("train/*.png"))) == 4 and len(list(capture.glob("test/*.png"))) == 2
    )
    for name in ("t_000", "t_001"):
        for tail in ("", "_albedo", "_normal", "_roughness", "_metallic", "_depth"):
            assert (capture / "truth" / "test" / f"{name}{tail}.exr").is_file()
        assert (capture / "truth" / "relight" / "other" / f"{name}.exr").is_file()
    assert (capture / "truth" / "relight" / "other.exr").is_file()
    assert truth["relight"] == ["other"] and truth["train_albedo"] == [
        "r_000",
        "r_001",
        "r_002",
        "r_003",
    ]
    assert str(capture.parent) not in (capture / "truth" / "truth.json").read_text()  # movable


def test_photos_are_straight_alpha_srgb_and_agree_with_the_linear_truth(capture):
    codes = read_data(capture / "test" / "t_000.png")
    assert codes.shape == (32, 32, 4)
    linear = read_data(capture / "truth" / "test" / "t_000.exr")
    np.testing.assert_allclose(codes[..., 3], linear[..., 3], atol=0.003)
    inside = linear[..., 3] > 0.2
    straight = np.clip(linear[..., :3][inside] / linear[..., 3:][inside], 0, 1)
    np.testing.assert_allclose(linear_from_srgb(codes[..., :3])[inside], straight, atol=0.006)
    assert (codes[..., :3][codes[..., 3] == 0] == 0).all()


def test_exposure_puts_the_bright_pixels_at_the_mark(capture):
    values = []
    for file in sorted(capture.glob("train/*.png")):
        picture = read_image(file)
        values.append(picture.rgb[picture.alpha > 0.99].max(-1))
    assert np.percentile(np.concatenate(values), 99) == pytest.approx(synthetic.WHITE, rel=0.15)
    light = read_image(capture / "truth" / "environment.exr").rgb
    assert light.max() / light.min() == pytest.approx(20.0, rel=1e-4)  # scaled, not changed


def test_depth_and_normals_are_those_of_the_ball(capture):
    content = json.loads((capture / "transforms_test.json").read_text())
    pose = world_from_cv_camera(np.array(content["frames"][0]["transform_matrix"]))
    focal = 16 / np.tan(content["camera_angle_x"] / 2)
    depth, normal = (
        read_data(capture / "truth" / "test" / f"t_000_{k}.exr") for k in ("depth", "normal")
    )
    y, x = np.nonzero(normal[..., 3] == 1)
    p = (
        np.stack([(x + 0.5 - 16) / focal, (y + 0.5 - 16) / focal, np.ones(len(x))], -1)
        * depth[y, x][:, None]
    )
    world = p @ pose[:3, :3].T + pose[:3, 3]
    # pixel means against the centre ray: exact in the middle of the ball, near enough away from the
    # rim
    facing = (normal[y, x, :3] * -pose[:3, 2]).sum(-1) > 0.5
    radius = synthetic.RADIUS  # of the ball: the farthest vertex stands there
    np.testing.assert_allclose(np.linalg.norm(world[facing], axis=1), radius, atol=0.03)
    np.testing.assert_allclose(normal[y, x, :3][facing], world[facing] / radius, atol=0.06)


def test_the_same_settings_return_at_once_and_others_are_refused(ball, capture):
    asset, light, other = ball
    before = (capture / "truth" / "truth.json").stat().st_mtime_ns
    synthetic.synthesize_multiview(asset, light, capture, relights=[other], **OPTIONS)
    assert (capture / "truth" / "truth.json").stat().st_mtime_ns == before
    with pytest.raises(UserError, match="other settings"):
        synthetic.synthesize_multiview(
            asset, light, capture, relights=[other], **{**OPTIONS, "seed": 4}
        )


@pytest.mark.slow
def test_a_stopped_rendering_is_taken_up_with_the_same_result(ball, capture):
    asset, light, other = ball
    lost, kept = capture / "train" / "r_002.png", capture / "train" / "r_001.png"
    content, stamp = lost.read_bytes(), kept.stat().st_mtime_ns
    lost.unlink()
    (capture / "truth" / "truth.json").unlink()
    synthetic.synthesize_multiview(asset, light, capture, relights=[other], **OPTIONS)
    assert lost.read_bytes() == content and kept.stat().st_mtime_ns == stamp


def test_wrong_input_is_answered(ball, tmp_path):
    asset, light, _ = ball
    with pytest.raises(UserError, match="no asset file"):
        synthetic.synthesize_multiview(tmp_path / "none.glb", light, tmp_path / "a")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "photo.jpg").write_bytes(b"x")
    with pytest.raises(UserError, match="not empty"):
        synthetic.synthesize_multiview(asset, light, tmp_path / "mine")
    for wrong in [
        dict(views=1),
        dict(spp=0),
        dict(renderer="phong"),
        dict(roughness=1.5),
        dict(relights=[light, light]),
    ]:
        with pytest.raises(UserError):
            synthetic.synthesize_multiview(asset, light, tmp_path / "b", **wrong)
    assert not (tmp_path / "b").exists()
    write_linear(tmp_path / "dark.exr", np.zeros((8, 16, 3), np.float32))
    with pytest.raises(UserError, match="black"):
        synthetic.synthesize_multiview(asset, tmp_path / "dark.exr", tmp_path / "d", **OPTIONS)


def test_cameras_frame_the_object_and_stand_above_the_table():
    cameras = synthetic.orbit_cameras(40, 64, seed=1)
    again = synthetic.orbit_cameras(40, 64, seed=1)
    ball = trimesh.creation.icosphere(2).vertices * synthetic.RADIUS
    for (name, camera), (_, same) in zip(cameras, again, strict=True):
        np.testing.assert_array_equal(camera.world_from_camera, same.world_from_camera)
        rotation = camera.world_from_camera[:3, :3]
        np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) > 0, name
        x = camera.project(ball)
        assert x[:, 2].min() > 0 and x[:, :2].min() >= 0 and x[:, :2].max() <= 64
        elevation = np.degrees(np.arcsin(camera.centre[1] / np.linalg.norm(camera.centre)))
        assert elevation >= synthetic.LOWEST - 1e-9
        assert camera.world_from_camera[1, 1] < 0.2  # the image's down is never the world's up


def test_object_frame_centres_and_scales():
    mesh = Mesh(
        np.array([[1, 1, 1], [3, 1, 1], [1, 5, 1]], np.float32), np.array([[0, 1, 2]], np.int32)
    )
    frame = synthetic.object_frame(mesh)
    v = mesh.vertices @ frame[:3, :3].T + frame[:3, 3]
    np.testing.assert_allclose(v.min(0) + v.max(0), 0, atol=1e-12)
    assert np.linalg.norm(v, axis=1).max() == pytest.approx(synthetic.RADIUS)
    with pytest.raises(UserError):
        synthetic.object_frame(Mesh(np.zeros((3, 3), np.float32), np.array([[0, 1, 2]], np.int32)))

"""Relighting: which light from where, which cameras, pictures and video, and mistakes."""

from dataclasses import replace

import numpy as np
import pytest

from relit.asset.asset import cameras_to_json, save_asset
from relit.conventions import similarity
from relit.errors import UserError
from relit.geometry.tangents import vertex_normals
from relit.images import read_image, write_linear
from relit.lighting.spherical_gaussians import SphericalGaussians, write_lobes
from relit.relight import orbit, orbit_camera, relight
from relit.scene import Asset, Camera, Material, Mesh

TURN = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], float)  # world +Z is the asset's up


@pytest.fixture(scope="module")
def asset() -> Asset:
    import trimesh

    s = trimesh.creation.icosphere(2)
    mesh = Mesh(s.vertices.astype(np.float32), s.faces.astype(np.int32))
    mesh = replace(mesh, normals=vertex_normals(mesh))
    material = Material(
        np.full((1, 1, 3), 0.6, np.float32),
        np.full((1, 1), 0.8, np.float32),
        np.zeros((1, 1), np.float32),
    )
    world = similarity(TURN, [5, 6, 7], 0.1)
    pose = np.eye(4)  # looks along world +Y, world +Z is up in the picture
    pose[:3, :3] = np.stack([[1, 0, 0], [0, 0, -1], [0, 1, 0]], 1)
    pose[:3, 3] = [5, 5.5, 7]
    cameras = tuple((f"photos/{k}.jpg", Camera(24, 20, 40.0, 40.0, 12.0, 10.0, pose)) for k in "ab")
    environment = np.zeros((16, 32, 3), np.float32)
    environment[:, 6:10] = 1  # from world +X
    return Asset(mesh, material, world, environment, cameras, {"capture": "multiview"})


@pytest.fixture(scope="module")
def run(asset, tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    save_asset(folder / "asset", asset)
    return folder


@pytest.fixture(scope="module")
def from_above(tmp_path_factory):
    light = np.zeros((16, 32, 3), np.float32)
    light[0] = 20
    path = tmp_path_factory.mktemp("light") / "above.hdr"
    write_linear(path, light)
    return path


def halves(path):
    """Brightness of the top, bottom, left and right halves of a picture."""
    p = read_image(path).rgb.sum(-1)
    h, w = p.shape
    return p[: h // 2].sum(), p[h // 2 :].sum(), p[:, : w // 2].sum(), p[:, w // 2 :].sum()


@pytest.mark.slow
def test_a_light_stands_upright_over_the_object(run, from_above, tmp_path):
    """The top of the map is over the asset's up, whatever the frame of the cameras."""
    files = relight(run, from_above, tmp_path / "out", spp=8)
    assert sorted(p.name for p in files) == ["a.png", "b.png"]
    top, bottom, left, right = halves(files[0])
    assert top > 5 * bottom
    assert left == pytest.approx(right, rel=0.25)


def test_the_recovered_light_stands_where_it_was(run, tmp_path):
    files = relight(run, run / "asset" / "lights" / "environment.exr", tmp_path / "out", spp=8)
    top, bottom, left, right = halves(files[0])
    assert right > 3 * left
    assert top == pytest.approx(bottom, rel=0.25)


def test_rotation_turns_the_light_about_the_objects_up(run, tmp_path):
    """+90 degrees carry a light from the asset's +Z to its +X; the camera looks along the asset's
    -Z."""
    light = np.zeros((16, 32, 3), np.float32)
    light[:, 14:18] = 1  # from +Z
    write_linear(tmp_path / "front.exr", light)
    front = halves(relight(run, tmp_path / "front.exr", tmp_path / "0", spp=8)[0])
    turned = halves(relight(run, tmp_path / "front.exr", tmp_path / "90", spp=8, rotate=90)[0])
    assert front[2] == pytest.approx(front[3], rel=0.25)
    assert turned[3] > 3 * turned[2]


def test_spherical_gaussians_as_light(run, tmp_path):
    sg = SphericalGaussians(np.array([[0, 1.0, 0]]), np.array([30.0]), np.array([[10.0, 10, 10]]))
    write_lobes(tmp_path / "sky.json", sg)
    top, bottom, _, _ = halves(relight(run, tmp_path / "sky.json", tmp_path / "out", spp=8)[0])
    assert top > 5 * bottom


def test_turntable_holds_the_object_in_view(asset):
    views = orbit(asset, 5, 64)
    points = asset.mesh.vertices @ (0.1 * TURN).T + [5, 6, 7]
    for _, camera in views:
        xy = camera.project(points)
        assert (xy[:, 2] > 0).all()
        assert ((xy[:, :2] > 0) & (xy[:, :2] < 64)).all()
        assert np.ptp(xy[:, 0]) > 40
        up = camera.project(np.array([[5, 6, 7], [5, 6, 7.05]]))
        assert up[1, 1] < up[0, 1]  # world +Z, the asset's up, is up in the picture
        assert np.linalg.det(camera.world_from_camera[:3, :3]) == pytest.approx(1)
    assert len({tuple(np.round(c.centre, 6)) for _, c in views}) == 5


def test_the_object_from_above_and_from_below(asset):
    middle, up = np.array([5.0, 6, 7]), np.array([0, 0, 1.0])  # the asset's up is the world's +Z
    for elevation, sign in ((90, 1), (-90, -1)):
        camera = orbit_camera(asset, 0, elevation, 64)
        away = camera.centre - middle
        np.testing.assert_allclose(away / np.linalg.norm(away), sign * up, atol=1e-6)
        xy = camera.project(asset.mesh.vertices @ (0.1 * TURN).T + middle)
        assert (xy[:, 2] > 0).all()
        assert ((xy[:, :2] > 0) & (xy[:, :2] < 64)).all()
        assert np.linalg.det(camera.world_from_camera[:3, :3]) == pytest.approx(1)


def test_sizes_exr_scale_and_a_camera_file(run, asset, from_above, tmp_path):
    import json

    (tmp_path / "c.json").write_text(json.dumps(cameras_to_json(asset.cameras[:1])))
    options = {"cameras": tmp_path / "c.json", "spp": 4, "size": 12, "exr": True}
    plain = relight(run, from_above, tmp_path / "1", **options)
    darker = relight(run, from_above, tmp_path / "2", albedo_scale=[0.5, 0.5, 0.5], **options)
    assert [p.suffix for p in plain] == [".png", ".exr"]
    a, b = (read_image(f[1]) for f in (plain, darker))
    assert a.rgb.shape == (10, 12, 3)
    assert a.alpha.max() == 1
    assert 0.4 < b.rgb.sum() / a.rgb.sum() < 0.65


@pytest.mark.parametrize("with_ffmpeg", [True, False])
def test_video(run, from_above, tmp_path, monkeypatch, with_ffmpeg):
    import sys

    import cv2

    if with_ffmpeg:
        pytest.importorskip("imageio_ffmpeg", reason="the video extra is not installed")
    else:
        monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    seen = []
    out = tmp_path / "turn.mp4"
    assert relight(
        run, from_above, out, cameras="orbit:3", size=32, spp=2, progress=lambda *a: seen.append(a)
    ) == [out]
    assert seen == [(2, 6), (4, 6), (6, 6)]  # of three pictures with two samples each
    video = cv2.VideoCapture(str(out))
    frames = []
    while (got := video.read())[0]:
        frames.append(got[1])
    assert len(frames) == 3
    assert frames[0].shape == (32, 32, 3)
    assert frames[0].max() > 60
    assert [p.name for p in tmp_path.iterdir()] == ["turn.mp4"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"cameras": "orbit:0"}, "not a turntable"),
        ({"cameras": "orbit"}, "not a turntable"),
        ({"cameras": "gone.json"}, "missing"),
        ({"spp": 0}, "--spp"),
        ({"albedo_scale": [1, 2]}, "albedo scale"),
        ({"light": "photo.jpg"}, "not a light"),
        ({"light": "gone.hdr"}, "missing"),
        ({"light": "black.exr"}, "black"),
    ],
)
def test_mistakes_get_an_answer(run, from_above, tmp_path, monkeypatch, options, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "photo.jpg").write_bytes(b"x")
    write_linear(tmp_path / "black.exr", np.zeros((2, 4, 3), np.float32))
    options = dict(options)
    light = options.pop("light", from_above)
    with pytest.raises(UserError, match=message):
        relight(run, light, tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


def test_cameras_of_another_frame_are_refused(run, asset, from_above, tmp_path):
    import json

    away = [("a", asset.cameras[0][1].with_pose(similarity(np.diag([1, -1, -1]), [500, 0, 0])))]
    (tmp_path / "c.json").write_text(json.dumps(cameras_to_json(away)))
    with pytest.raises(UserError, match="no camera sees"):
        relight(run, from_above, tmp_path / "out", cameras=tmp_path / "c.json")

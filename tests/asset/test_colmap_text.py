import numpy as np
import pytest

from relit.asset.colmap_text import write_colmap
from relit.geometry.se3 import exp_so3, look_at, quaternion
from relit.scene import Camera


def test_quaternions_of_any_turn():
    rng = np.random.default_rng(0)
    for w in (
        *rng.normal(size=(20, 3)) * 2,
        np.array([np.pi, 0, 0]),
        np.array([0, np.pi / np.sqrt(2), np.pi / np.sqrt(2)]),
        np.zeros(3),
    ):
        r = exp_so3(w)
        q = quaternion(r)
        a, v = q[0], q[1:]
        cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
        assert np.allclose(
            (a * a - v @ v) * np.eye(3) + 2 * np.outer(v, v) + 2 * a * cross, r, atol=1e-9
        )
        assert a >= 0


def test_colmap_reads_it_back(tmp_path):
    pytest.importorskip("pycolmap")
    from relit.device import load_pycolmap

    eyes = ([0, 1, 3.0], [2, 0, -2.0], [-1, 0.5, 0.2])
    cameras = [
        (
            f"image/{i}.jpg",
            Camera(40 + i, 30, 50.0, 51.0, 20.5, 15.0, look_at(np.array(e), roll=0.3)),
        )
        for i, e in enumerate(eyes)
    ]
    model = load_pycolmap().Reconstruction(str(write_colmap(tmp_path / "colmap", cameras)))
    found = {image.name: image for image in model.images.values()}
    for name, camera in cameras:
        image, intrinsics = found[name], model.cameras[found[name].camera_id]
        pose = image.cam_from_world
        pose = (pose() if callable(pose) else pose).matrix()
        assert np.allclose(pose, np.linalg.inv(camera.world_from_camera)[:3], atol=1e-8)
        assert np.allclose(intrinsics.params, [camera.fx, camera.fy, camera.cx, camera.cy])
        assert (intrinsics.width, intrinsics.height) == (camera.width, camera.height)
        d = np.array([0.3, -0.2, 2.0])
        point = camera.world_from_camera[:3, :3] @ d + camera.centre
        assert np.allclose(
            intrinsics.img_from_cam(pose @ [*point, 1]),
            camera.project(point[None])[0][:2],
            atol=1e-6,
        )

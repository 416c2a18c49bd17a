"""The object sphere from masks, points and rays: it holds the object and is not much larger."""

from dataclasses import replace

import numpy as np
import pytest

from relit.capture import sphere as s
from relit.conventions import move_pose, similarity
from relit.errors import UserError
from relit.geometry.se3 import exp_so3, look_at
from relit.scene import Camera, Sphere
from support import camera_ring


def object_points():
    d = np.random.default_rng(0).normal(size=(200, 3))
    d *= camera_ring.RADIUS / np.linalg.norm(d, axis=1, keepdims=True)
    return np.concatenate([d + np.asarray(c) for c in camera_ring.BALLS])


def holds(sphere, points, low, high):
    reach = np.linalg.norm(points - sphere.centre, axis=1).max() / sphere.radius
    assert low < reach < high


def views(cameras):
    return [s.SphereView(c, mask=camera_ring.picture(c)[1]) for c in cameras]


@pytest.mark.parametrize("seed", range(3))
def test_from_masks_in_any_frame(seed):
    rng = np.random.default_rng(seed)
    b_from_a = similarity(
        exp_so3(rng.normal(size=3)), rng.normal(size=3) * 10, 0.03 if seed else 70.0
    )
    cameras = camera_ring.ring(8)
    moved = [
        s.SphereView(
            v.camera.with_pose(move_pose(b_from_a, v.camera.world_from_camera)), mask=v.mask
        )
        for v in views(cameras)
    ]
    sphere, source = s.find_sphere(moved)
    points = object_points() @ b_from_a[:3, :3].T + b_from_a[:3, 3]
    assert source == "the masks"
    holds(sphere, points, 0.65, 0.97)


def test_from_masks_of_a_lens_and_of_pictures_that_cut_the_object():
    from relit.geometry.lens import BrownLens

    close = [replace(c, fx=c.fx * 1.6, fy=c.fy * 1.6) for c in camera_ring.ring(12)]
    holds(s.sphere_from_masks(views(close)), object_points(), 0.55, 1.02)
    lens = BrownLens((0.0, 0.0, 0.0, 0.0))
    plain = s.sphere_from_masks(views(camera_ring.ring(8)))
    through = s.sphere_from_masks(
        [s.SphereView(v.camera, lens, v.mask) for v in views(camera_ring.ring(8))]
    )
    np.testing.assert_allclose(through.centre, plain.centre)


def test_one_bad_mask_of_many_does_not_matter():
    good = views(camera_ring.ring(24))
    bad = [s.SphereView(good[0].camera, mask=np.roll(good[0].mask, 30, axis=1)), *good[1:]]
    holds(s.sphere_from_masks(bad), object_points(), 0.55, 1.0)


def test_masks_of_different_places():
    good = views(camera_ring.ring(6))
    with pytest.raises(UserError, match="no place in common"):
        s.sphere_from_masks([replace_mask(v, i) for i, v in enumerate(good)])


def test_the_masks_that_miss_the_object_are_named():
    good = views(camera_ring.ring(10))
    wrong = np.zeros_like(good[3].mask)
    wrong[:6, :6] = 1
    named = [
        s.SphereView(v.camera, mask=wrong if i in (3, 7) else v.mask, name=f"p{i}.png")
        for i, v in enumerate(good)
    ]
    with pytest.raises(UserError, match="no place in common") as caught:
        s.sphere_from_masks(named)
    assert caught.value.why.endswith(": p3.png, p7.png") and "--edit" in caught.value.fix


def replace_mask(view, i):
    mask = np.zeros_like(view.mask)
    mask[(4, 48)[i % 2] :, :][:6, 4 + 11 * i : 10 + 11 * i] = 1
    return s.SphereView(view.camera, mask=mask)


def test_from_points_of_a_turntable():
    points = np.concatenate([object_points(), [[40.0, 0, 0]]])
    sphere, source = s.find_sphere([s.SphereView(c) for c in camera_ring.ring()], points)
    assert source == "the sparse points"
    holds(sphere, points[:-1], 0.8, 0.95)


def test_from_rays_with_a_background():
    rng = np.random.default_rng(0)
    room = rng.uniform(-20, 20, (3000, 3))
    cameras = camera_ring.ring(10, focal=100.0)
    sphere, source = s.find_sphere([s.SphereView(c) for c in cameras], room)
    assert source == "the cameras' viewing directions"
    np.testing.assert_allclose(sphere.centre, 0, atol=0.15)
    assert 0.8 < sphere.radius < 1.6


def test_the_longer_side_of_the_pictures_counts():
    """A tall object in upright photos is held from top to bottom."""
    square = camera_ring.ring(10, focal=100.0)
    upright = [replace(c, height=2 * c.height, cy=2 * c.cy) for c in square]
    small, large = s.sphere_from_rays(square).radius, s.sphere_from_rays(upright).radius
    distance = np.linalg.norm(square[0].centre)
    assert large == pytest.approx(
        min(distance * np.sin(np.arctan(upright[0].height / 200)), 0.8 * distance), rel=0.05
    )
    assert large > 1.3 * small


def test_a_stray_camera_does_not_move_the_sphere():
    cameras = camera_ring.ring(9)
    stray = cameras[0].with_pose(look_at([4, 0, 0], [4, 30, 10]))
    np.testing.assert_allclose(s.sphere_from_rays([stray, *cameras[1:]]).centre, 0, atol=0.15)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("value", [1e30, 1e200, np.inf, np.nan])
def test_a_pose_with_senseless_numbers_is_no_crash(value):
    origins = np.random.default_rng(0).normal(size=(4, 3))
    for which in range(2):
        rays = [origins.copy(), -origins]
        rays[which][0, 0] = value
        assert s.robust_closest_point(*rays).shape == (3,)
    assert s.robust_closest_point(np.zeros((4, 3)), np.zeros((4, 3))).shape == (
        3,
    )  # and so is one without a direction


def test_cameras_that_look_outwards():
    cameras = [c.with_pose(look_at(c.centre, 2 * c.centre)) for c in camera_ring.ring()]
    with pytest.raises(UserError, match="look away from each other"):
        s.sphere_from_rays(cameras)


def test_smallest_ball():
    points = np.random.default_rng(0).normal(size=(300, 3))
    points *= 2 / np.linalg.norm(points, axis=1, keepdims=True)
    centre, radius = s.smallest_ball(points + np.array([1, 2, 3]))
    np.testing.assert_allclose(centre, [1, 2, 3], atol=0.03)
    assert radius == pytest.approx(2, rel=0.01)


def test_a_given_sphere_is_checked():
    cameras = camera_ring.ring()
    assert s.check_sphere(Sphere(np.zeros(3), 1.0), cameras) == []
    assert "cameras stand inside" in s.check_sphere(Sphere(np.zeros(3), 10.0), cameras)[0]
    with pytest.raises(UserError, match="outside the view of"):
        s.check_sphere(Sphere(np.array([0, 30.0, 0]), 0.2), cameras)


@pytest.mark.parametrize("up", [[0, 1, 0], [0, 0, 1], [0.48, 0.6, 0.64]])
def test_up_from_level_cameras(up):
    up = np.asarray(up, dtype=float)
    rng = np.random.default_rng(0)
    side = np.cross(up, [0.3, 0.2, 0.9])
    cameras = []
    for i in range(12):
        eye = exp_so3(up * i * 0.5) @ (side / np.linalg.norm(side) * 3) + up * rng.uniform(0.2, 1.5)
        cameras.append(Camera(40, 30, 50, 50, 20, 15, look_at(eye, np.zeros(3), up)))
    np.testing.assert_allclose(s.up_direction(cameras), up / np.linalg.norm(up), atol=1e-6)


def test_no_up_from_rolled_cameras():
    rng = np.random.default_rng(0)
    cameras = [
        c.with_pose(look_at(c.centre, np.zeros(3), rng.normal(size=3)))
        for c in camera_ring.ring(20)
    ]
    assert s.up_direction(cameras) is None

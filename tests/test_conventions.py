"""Every conversion of `conventions` there and back, and against a value known from elsewhere."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from relit import conventions as c
from relit.geometry.se3 import exp_so3

RNG = np.random.default_rng(0)
unit_interval = st.floats(0.0, 1.0)


def random_similarity(rng=RNG):
    return c.similarity(exp_so3(rng.normal(size=3)), rng.normal(size=3), np.exp(rng.normal()))


@given(st.floats(0.0, 16.0, width=32))
@settings(max_examples=60, deadline=None)
def test_srgb_and_linear(x):
    assert float(c.linear_from_srgb(c.srgb_from_linear(x))) == pytest.approx(x, rel=2e-5, abs=1e-6)


def test_srgb_values_of_the_standard():
    np.testing.assert_allclose(c.srgb_from_linear([0.0, 0.214041, 1.0]), [0.0, 0.5, 1.0], atol=1e-5)
    np.testing.assert_allclose(c.linear_from_srgb(0.04045), 0.04045 / 12.92, rtol=1e-5)


def test_luminance_of_white_and_of_green():
    np.testing.assert_allclose(
        c.luminance(np.eye(3, dtype=np.float32)), [0.2126, 0.7152, 0.0722], rtol=1e-6
    )
    assert float(c.luminance(np.ones(3, np.float32))) == pytest.approx(1.0)


@given(unit_interval)
@settings(max_examples=40, deadline=None)
def test_roughness_and_alpha(r):
    assert c.roughness_from_alpha(c.alpha_from_roughness(r)) == pytest.approx(r, abs=1e-12)


@given(st.floats(1.0, 3.0))
@settings(max_examples=40, deadline=None)
def test_f0_and_ior(ior):
    assert c.ior_from_f0(c.f0_from_ior(ior)) == pytest.approx(ior, rel=1e-9)


def test_f0_of_known_materials():
    assert c.f0_from_ior(1.5) == pytest.approx(0.04)
    assert c.f0_from_ior(1.329) == pytest.approx(0.02, abs=1e-4)


def test_camera_axes_there_and_back():
    pose = random_similarity()
    np.testing.assert_allclose(c.world_from_cv_camera(c.world_from_gl_camera(pose)), pose)
    np.testing.assert_allclose(c.world_from_mitsuba_camera(c.world_from_mitsuba_camera(pose)), pose)
    forward, up = np.array([0, 0, 1.0, 0]), np.array([0, -1.0, 0, 0])  # in OpenCV axes
    np.testing.assert_allclose(c.world_from_gl_camera(pose) @ [0, 0, -1, 0], pose @ forward)
    np.testing.assert_allclose(c.world_from_gl_camera(pose) @ [0, 1, 0, 0], pose @ up)
    np.testing.assert_allclose(c.world_from_mitsuba_camera(pose) @ [0, 0, 1, 0], pose @ forward)
    np.testing.assert_allclose(c.world_from_mitsuba_camera(pose) @ [0, 1, 0, 0], pose @ up)


def test_similarities_move_points_and_poses_alike():
    b_from_a, pose = random_similarity(), c.similarity(exp_so3([0.3, -1.0, 0.5]), [1, 2, 3])
    assert c.scale_of(b_from_a) == pytest.approx(np.cbrt(np.linalg.det(b_from_a[:3, :3])))
    moved = c.move_pose(b_from_a, pose)
    np.testing.assert_allclose(moved[:3, :3] @ moved[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(moved[:3, 3], c.move_points(b_from_a, pose[:3, 3]))
    np.testing.assert_allclose(c.move_pose(np.linalg.inv(b_from_a), moved), pose, atol=1e-9)
    points = RNG.normal(size=(4, 5, 3))
    np.testing.assert_allclose(
        c.move_points(np.linalg.inv(b_from_a), c.move_points(b_from_a, points)), points, atol=1e-9
    )
    # a pixel stays on its ray: what the moved camera sees of the moved point is what the camera saw
    # of the point, scaled
    seen = np.linalg.inv(pose) @ np.append(points[0, 0], 1)
    seen_moved = np.linalg.inv(moved) @ np.append(c.move_points(b_from_a, points[0, 0]), 1)
    np.testing.assert_allclose(seen_moved[:3], seen[:3] * c.scale_of(b_from_a), atol=1e-9)


@given(st.floats(0.0, 1.0, exclude_max=True), st.floats(0.01, 0.99))
@settings(max_examples=60, deadline=None)
def test_directions_and_lat_long(u, v):
    d = c.direction_from_uv([u, v])
    assert np.linalg.norm(d) == pytest.approx(1)
    found = c.uv_from_direction(d)
    assert found[1] == pytest.approx(v, abs=1e-9)
    assert (found[0] - u + 0.5) % 1 - 0.5 == pytest.approx(0, abs=1e-9)


def test_axes_of_the_lat_long_map():
    np.testing.assert_allclose(
        c.uv_from_direction([[1, 0, 0], [0, 0, 1], [-1, 0, 0], [0, 0, -1]])[:, 0],
        [0.25, 0.5, 0.75, 0.0],
    )
    np.testing.assert_allclose(c.uv_from_direction([[0, 1, 0], [0, -1, 0]])[:, 1], [0, 1])


def test_texels_and_their_solid_angles():
    directions = c.environment_directions(6, 10)
    rows, cols = np.mgrid[:6, :10]
    np.testing.assert_allclose(
        c.uv_from_direction(directions),
        np.stack([(cols + 0.5) / 10, (rows + 0.5) / 6], -1),
        atol=1e-12,
    )
    weights = c.environment_solid_angles(6, 10)
    assert weights.sum() == pytest.approx(4 * np.pi)
    np.testing.assert_allclose((directions * weights[..., None]).sum((0, 1)), 0, atol=1e-12)


def test_gltf_environment_there_and_back():
    env = RNG.uniform(size=(4, 8, 3))
    np.testing.assert_array_equal(c.environment_from_gltf(c.gltf_environment(env)), env)
    lit = np.zeros((4, 8, 3))
    lit[1, 4] = 1  # near +Z
    assert c.gltf_environment(lit)[1, 6].sum() == 3


def smooth(direction):
    x, y, z = np.moveaxis(np.asarray(direction), -1, 0)
    return np.stack([1 + 0.5 * x, 1 + 0.4 * y * z, 1 - 0.3 * z], -1)


def test_sampling_and_turning_of_a_map():
    env = smooth(c.environment_directions(64, 128)).astype(np.float32)
    d = RNG.normal(size=(50, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    np.testing.assert_allclose(c.sample_environment(env, d), smooth(d), atol=0.02)
    turn = exp_so3([0.4, 0.9, -0.3])
    turned = c.rotate_environment(env, turn)
    np.testing.assert_allclose(
        c.sample_environment(turned, d @ turn.T), smooth(d), atol=0.02
    )  # light from d in a comes from R d in b
    np.testing.assert_allclose(c.rotate_environment(turned, turn.T), env, atol=0.03)

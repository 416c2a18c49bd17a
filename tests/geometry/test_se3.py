"""Group laws of rotations and rigid motions; alignment recovers what was applied."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from relit.conventions import move_points, move_pose, similarity
from relit.geometry import se3

numbers = st.floats(-3, 3, allow_nan=False)
vectors = st.tuples(numbers, numbers, numbers).map(np.array)
angles_below_pi = vectors.map(lambda v: v * min(1.0, 3.1 / max(np.linalg.norm(v), 1e-9)))


def random_pose(rng):
    return similarity(se3.exp_so3(rng.normal(size=3)), 5 * rng.normal(size=3))


@given(angles_below_pi)
@settings(max_examples=60, deadline=None)
def test_so3_exp_then_log(w):
    r = se3.exp_so3(w)
    np.testing.assert_allclose(r @ r.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(r) == pytest.approx(1)
    np.testing.assert_allclose(se3.log_so3(r), w, atol=1e-7)


def test_exp_is_the_matrix_exponential():
    from scipy.linalg import expm

    w = np.array([0.5, 1.1, -0.4])
    np.testing.assert_allclose(se3.exp_so3(w), expm(se3.hat(w)), atol=1e-12)


@pytest.mark.parametrize("axis", np.vstack([np.eye(3), -np.eye(3), [[0.6, 0.8, 0]]]))
def test_half_turns_and_tiny_turns(axis):
    half = se3.log_so3(se3.exp_so3(axis * np.pi))
    assert np.linalg.norm(half) == pytest.approx(np.pi)
    assert abs(half @ axis) == pytest.approx(np.pi)
    np.testing.assert_allclose(se3.log_so3(se3.exp_so3(axis * 1e-9)), axis * 1e-9, atol=1e-15)


@given(st.integers(0, 1000))
@settings(max_examples=30, deadline=None)
def test_alignment_recovers_a_similarity(seed):
    rng = np.random.default_rng(seed)
    b_from_a = similarity(
        se3.exp_so3(rng.normal(size=3)), rng.normal(size=3) * 4, np.exp(rng.normal())
    )
    points = rng.normal(size=(6, 3))
    np.testing.assert_allclose(
        se3.umeyama(points, move_points(b_from_a, points)), b_from_a, atol=1e-8
    )
    poses = np.stack([random_pose(rng) for _ in range(5)])
    moved = np.stack([move_pose(b_from_a, p) for p in poses])
    np.testing.assert_allclose(se3.align_cameras(poses, moved), b_from_a, atol=1e-8)
    angle, distance = se3.camera_errors(poses, moved)
    assert angle.max() < 1e-5 and distance.max() < 1e-6


def test_alignment_of_cameras_on_a_line():
    """Centres on a line leave a turn about the line open; the orientations settle it."""
    rng = np.random.default_rng(1)
    poses = np.stack([random_pose(rng) for _ in range(4)])
    poses[:, :3, 3] = np.outer(np.arange(4), [1.0, 2.0, 3.0])
    b_from_a = similarity(se3.exp_so3([0.4, -1, 0.2]), [1, 2, 3], 2.5)
    np.testing.assert_allclose(
        se3.align_cameras(poses, [move_pose(b_from_a, p) for p in poses]), b_from_a, atol=1e-9
    )


def test_one_wrong_camera_is_reported_and_does_not_move_the_others():
    rng = np.random.default_rng(2)
    poses = np.stack([random_pose(rng) for _ in range(9)])
    wrong = poses.copy()
    wrong[4] = wrong[4] @ similarity(se3.exp_so3(np.array([0, 0.7, 0])), np.zeros(3))
    angle, _ = se3.camera_errors(wrong, poses)
    assert angle[4] == pytest.approx(np.degrees(0.7), abs=1e-4)
    assert np.delete(angle, 4).max() < 1e-4


def test_look_at_is_opencv():
    pose = se3.look_at([0, 0, -3], [0, 0, 0])
    np.testing.assert_allclose(pose[:3, 2], [0, 0, 1])  # looks along +z
    np.testing.assert_allclose(pose[:3, 1], [0, -1, 0])  # image down is world down
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
    down = se3.look_at([0, 3, 0], [0, 0, 0])
    np.testing.assert_allclose(down[:3, :3] @ down[:3, :3].T, np.eye(3), atol=1e-12)


def test_several_cameras_look_as_each_alone():
    eyes = np.array([[0, 0, -3.0], [0.1, 3, 0.5], [1, -2, 0.5]])  # the second looks along `up`
    at, up, roll = [0.1, 0.0, 0.2], [0, 1, 0.1], 0.3
    together = se3.look_at(eyes, at, up, roll)
    np.testing.assert_allclose(together, [se3.look_at(e, at, up, roll) for e in eyes], atol=1e-15)
    np.testing.assert_allclose(together[:, :3, 3], eyes)
    np.testing.assert_allclose(np.linalg.det(together[:, :3, :3]), 1)

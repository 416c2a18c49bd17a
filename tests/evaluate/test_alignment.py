"""A known similarity between two sets of cameras is found again."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from relit.conventions import move_points, move_pose, similarity
from relit.errors import UserError
from relit.evaluate.alignment import (
    align_named_cameras,
    align_points,
    angle_between,
    pose_errors,
    same_frame,
)
from relit.synthesize.multiview import orbit_cameras

KNOWN = similarity(
    Rotation.from_euler("xyz", [40, -75, 130], degrees=True).as_matrix(), [0.4, -2.0, 5.0], 3.7
)


def test_umeyama_finds_a_known_similarity():
    points = np.random.default_rng(0).normal(size=(20, 3))
    np.testing.assert_allclose(align_points(points, move_points(KNOWN, points)), KNOWN, atol=1e-10)
    flat = points * [1, 1, 0]
    found = align_points(flat, move_points(KNOWN, flat))
    np.testing.assert_allclose(found, KNOWN, atol=1e-10)
    assert np.linalg.det(align_points(points, points * [1, 1, -1])[:3, :3]) > 0  # never a mirror


def test_umeyama_refuses_what_is_not_determined():
    with pytest.raises(UserError):
        align_points(np.zeros((2, 3)), np.zeros((2, 3)))
    line = np.linspace(0, 1, 5)[:, None] * [1.0, 2, 3]
    with pytest.raises(UserError, match="line"):
        align_points(line, line)


def test_cameras_in_another_frame():
    truth = dict(orbit_cameras(9, 32))
    inverse = np.linalg.inv(KNOWN)
    recovered = {
        name: c.with_pose(move_pose(inverse, c.world_from_camera))
        for name, c in list(truth.items())[2:]
    }
    assert not same_frame(recovered, truth) and same_frame(truth, truth)
    s = align_named_cameras(recovered, truth)
    np.testing.assert_allclose(s, KNOWN, atol=1e-8)
    rotations, distances = pose_errors(recovered, truth, s)
    assert len(rotations) == 7 and rotations.max() < 1e-6 and distances.max() < 1e-9


def test_an_arc_of_cameras_fixes_the_rotation():
    truth = {}
    for i, angle in enumerate(np.linspace(-0.2, 0.2, 5)):  # centres on a straight line
        pose = similarity(Rotation.from_euler("y", -angle).as_matrix(), [10 * angle, 0, -4])
        truth[f"{i}"] = orbit_cameras(1, 32)[0][1].with_pose(pose)
    recovered = {
        name: c.with_pose(move_pose(np.linalg.inv(KNOWN), c.world_from_camera))
        for name, c in truth.items()
    }
    np.testing.assert_allclose(align_named_cameras(recovered, truth), KNOWN, atol=1e-8)


def test_no_common_name_is_a_user_error():
    cameras = dict(orbit_cameras(3, 32))
    with pytest.raises(UserError, match="name"):
        align_named_cameras({"x": cameras["r_000"]}, cameras)


def test_rotation_angle_is_exact_near_zero():
    turn = Rotation.from_rotvec([0, 0, 1e-5]).as_matrix()
    assert angle_between(np.eye(3), turn) == pytest.approx(np.degrees(1e-5), rel=1e-6)
    assert angle_between(np.eye(3), np.diag([1.0, -1, -1])) == pytest.approx(180)

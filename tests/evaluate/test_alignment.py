"""A known similarity between two sets of cameras is found again."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from relit.conventions import move_points, move_pose, similarity
from relit.errors import UserError
from relit.evaluate.alignment import (
    align_centres,
    align_named_cameras,
    align_points,
    angle_between,
    angles_between,
    pose_errors,
    same_frame,
)
from relit.geometry.se3 import exp_so3, look_at
from relit.scene import Camera
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


# ---------------------------------------------------------------- Procrustes on centres


def around(count=8):
    rng = np.random.default_rng(3)
    eyes = rng.normal(size=(count, 3))
    return {
        f"{i}": Camera(40, 30, 50.0, 50.0, 20.0, 15.0, look_at(4 * eye / np.linalg.norm(eye)))
        for i, eye in enumerate(eyes)
    }


def test_centres_alone_fix_the_similarity():
    rng = np.random.default_rng(0)
    x = rng.normal(size=(9, 3))
    s = similarity(exp_so3(np.array([0.3, -0.8, 0.5])), [1.0, 2, 3], 2.5)
    y = move_points(s, x)
    np.testing.assert_allclose(align_centres(x, y), s, atol=1e-9)
    y[4] += 20  # one camera lost
    np.testing.assert_allclose(align_centres(x, y), s, atol=1e-9)
    assert np.abs(align_centres(x, y, robust=False) - s).max() > 0.1
    with pytest.raises(UserError, match="on a line"):
        align_centres(x[:, :1] * [1, 2, 3], x)


def test_orientations_that_are_all_off_alike_are_seen_after_procrustes_on_centres():
    """A fit of the orientations themselves would hide this error."""
    from relit.evaluate.collection import camera_pose_figures

    true = around()
    tilt = np.eye(4)
    tilt[:3, :3] = exp_so3(np.radians([0, 11, 0]))
    # every camera turned by 11 degrees about the WORLD's y, its centre kept
    found = {}
    for name, camera in true.items():
        pose = camera.world_from_camera.copy()
        pose[:3, :3] = tilt[:3, :3] @ pose[:3, :3]
        found[name] = camera.with_pose(pose)
    del found["7"]  # and one photo without a camera
    values, _ = camera_pose_figures(found, true, {})
    assert values["rotation_mean"] == pytest.approx(11) and values["cameras"] == 87.5
    assert values["rotation_median"] == pytest.approx(11) and values["rotation_within_10"] == 0
    assert values["translation_percent"] == pytest.approx(0, abs=1e-6)
    few = {n: found[n] for n in "012"}
    assert camera_pose_figures(few, true, {})[0]["rotation_median"] == 180


def test_chance_of_cameras_is_that_of_random_rotations():
    from relit.evaluate.collection import camera_chance

    true = around(24)
    baselines = camera_chance(true, true, {})
    assert 105 < baselines["rotation_mean"][0] < 132 and baselines["translation_percent"][0] > 60
    assert camera_chance(true, true, {}) == baselines  # a fixed seed


def test_angles_of_stacks_are_those_of_pairs():
    rng = np.random.default_rng(5)
    a, b = (np.array([exp_so3(rng.normal(size=3) * 2) for _ in range(6)]) for _ in range(2))
    expected = [angle_between(x, y) for x, y in zip(a, b, strict=True)]
    np.testing.assert_allclose(angles_between(a, b), expected, atol=1e-6)
    half = exp_so3(np.array([0, np.pi, 0]))
    assert angles_between(np.eye(3), half) == pytest.approx(180)


def test_a_few_wrong_cameras_do_not_move_the_others():
    """Two of ten cameras are far off: the eight others come to where they are."""
    from relit.evaluate.alignment import align_named_cameras, pose_errors
    from relit.geometry.se3 import exp_so3, look_at
    from relit.scene import Camera

    rng = np.random.default_rng(5)
    eyes = rng.normal(size=(10, 3)) + np.array([0.0, 0.0, 4.0])
    truth = {
        f"{i}": Camera(64, 64, 60.0, 60.0, 32.0, 32.0, look_at(eye)) for i, eye in enumerate(eyes)
    }
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = 2.5 * exp_so3(np.array([0.3, -1.0, 0.5])), (1.0, -2.0, 0.3)
    found = {}
    for name, camera in truth.items():
        pose = camera.world_from_camera.copy()
        if name in "37":
            pose[:3, 3] += (3.0, -2.0, 1.0)
            pose[:3, :3] = exp_so3(np.array([0.0, 0.7, 0.0])) @ pose[:3, :3]
        moved = frame @ pose
        moved[:3, :3] /= 2.5
        found[name] = camera.with_pose(moved)
    rotations, distances = pose_errors(found, truth, align_named_cameras(found, truth))
    right = [i for i, name in enumerate(sorted(truth)) if name not in "37"]
    assert rotations[right].max() < 1e-6 and distances[right].max() < 1e-6

"""Which poses count as wrong, and what the figures of poses make of them."""

import numpy as np
import pytest

from relit.errors import UserError
from relit.evaluate.pose_truth import NOISE, PoseJudge, SeenInstance, principal_axes
from relit.evaluate.registration import evaluate_registration, summary
from relit.geometry.se3 import exp_so3, look_at
from relit.reference.mitsuba_scene import build_scene
from relit.scene import Camera, Material
from relit.synthesize.procedural import pawn
from support.flash_ball import ball


def seen(pose) -> SeenInstance:
    camera = Camera(40, 40, 60.0, 60.0, 20.0, 20.0, look_at(np.array([0.0, 1.2, 4.0])))
    return SeenInstance(camera, pose, np.ones((40, 40), bool))


def judge_of(mesh, material) -> PoseJudge:
    return PoseJudge(build_scene(mesh, material, np.eye(4), None), mesh.vertices, mesh.faces)


def turned(axis, degrees):
    return exp_so3(np.array(axis, float) * np.radians(degrees))


def test_a_photo_of_a_painted_object_tells_its_pose_and_one_of_a_ball_does_not():
    painted = judge_of(*pawn(rows=40, columns=60, texture=64))
    one = seen(np.eye(4))
    assert painted.difference(one, np.eye(3)) == 0
    assert painted.difference(one, turned([1, 0, 0], 40)) > 5 * NOISE
    # spots on the head and nine flutes tell the turn about the axis as well
    assert painted.difference(one, turned([0, 1, 0], 60)) > NOISE
    assert painted.determined(one)
    plain = ball()
    grey = Material(
        np.full((4, 4, 3), 0.5, np.float32),
        np.full((4, 4), 0.5, np.float32),
        np.zeros((4, 4), np.float32),
    )
    sphere = judge_of(plain, grey)
    assert not sphere.determined(one) and sphere.difference(one, turned([1, 0, 0], 70)) < NOISE


def test_the_object_turns_about_its_own_middle_in_a_world_of_another_scale():
    judge = judge_of(*pawn(rows=40, columns=60, texture=64))
    pose = np.eye(4)
    pose[:3, :3] = 0.5 * turned([0, 0, 1], 90)
    pose[:3, 3] = [0.3, 0.4, 0.1]
    full = judge.difference(seen(pose), turned([0, 1, 0], 360))
    assert full < 1e-3
    assert judge.difference(seen(pose), turned([0, 0, 1], 90)) > 5 * NOISE


def test_the_longest_axis_of_a_body_is_the_last_of_its_principal_axes():
    mesh, _ = pawn(rows=40, columns=60, texture=32)
    axes = principal_axes(mesh.vertices, mesh.faces)
    assert abs(axes[2] @ [0, 1, 0]) > 0.99 and np.allclose(axes @ axes.T, np.eye(3), atol=1e-9)


def instance(error, differs=1.0, determined=1.0, chance=None):
    row = {"error": error, "differs": differs, "determined": determined}
    return row if chance is None else {**row, "chance": chance}


def test_a_wrong_pose_that_is_called_sure_counts_and_an_uncertain_one_does_not():
    rows = {
        "right": instance(1.0, chance=0.1),
        "wrong and sure": instance(90.0, chance=0.2),
        "wrong and uncertain": instance(90.0, chance=0.8),
        "turned where nothing shows it": instance(120.0, differs=0.0, determined=0.0, chance=0.1),
        "not registered": instance(180.0),
    }
    got = summary(rows)
    assert got["wrong_sure"] == pytest.approx(20) and got["wrong"] == pytest.approx(60)
    assert got["determined"] == pytest.approx(80)
    assert got["determined_sure"] == pytest.approx(50) and got["undetermined_unsure"] == 0
    assert got["rotation_median"] == pytest.approx(90)
    assert got["stated_wrong"] == pytest.approx(30)


def test_a_run_without_poses_is_refused(tmp_path):
    with pytest.raises(UserError, match="has not found poses"):
        evaluate_registration(tmp_path, tmp_path)

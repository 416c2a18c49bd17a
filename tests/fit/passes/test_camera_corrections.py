"""What all cameras share is taken out of their corrections, and nothing else."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest

from relit.fit.passes.camera_corrections import (
    CameraCorrections,
    CorrectionModel,
    corrected,
    without_common_motion,
)
from relit.fit.passes.pixels import camera_rows
from relit.geometry.se3 import exp_so3, look_at
from relit.scene import Camera

RNG = np.random.default_rng(3)


def ring(count=7):
    eyes = RNG.normal(size=(count, 3))
    eyes = (
        3 * eyes / np.linalg.norm(eyes, axis=1, keepdims=True) * RNG.uniform(0.8, 1.2, (count, 1))
    )
    return [Camera(64, 64, 80, 80, 32, 32, look_at(e, [0.1, 0, 0], [0, 0, 1])) for e in eyes]


def between(cameras):
    """Each camera as seen from the first one, distances in units of that to the second: what no
    common motion changes."""
    first = cameras[0].camera_from_world
    unit = np.linalg.norm(cameras[1].centre - cameras[0].centre)
    out = []
    for c in cameras:
        pose = first @ c.world_from_camera
        pose[:3, 3] /= unit
        out.append(pose)
    return np.array(out)


def corrections_of(numbers):
    """Of (views, 6, 7 or 8) numbers."""
    model = CorrectionModel(np.shape(numbers)[1])
    return CameraCorrections(model, mi.Float(np.ravel(numbers).astype(np.float32)))


def freed(numbers, cameras):
    """The numbers without what the cameras share."""
    rows = mi.Float(camera_rows(cameras))
    return without_common_motion(corrections_of(numbers), rows).numbers


def common(cameras, each, turn, growth, shift):
    """Corrections that turn, grow and move all cameras together, to first order."""
    rows = []
    for c in cameras:
        row = np.zeros(each)
        row[:3] = turn
        if each == 8:
            row[7], row[3:6] = growth, shift
        else:
            row[3:6] = growth * c.centre + shift + (np.cross(turn, c.centre) if each == 6 else 0)
        rows.append(row)
    return np.array(rows)


@pytest.mark.parametrize("each", [6, 7, 8])
def test_a_common_motion_is_taken_out_whole(each):
    cameras = ring()
    moved = common(
        cameras, each, np.array([2e-3, -1e-3, 3e-3]), 4e-3, np.array([5e-3, 1e-3, -2e-3])
    )
    assert (
        np.abs(
            np.diff(between(corrected(cameras, corrections_of(moved))) - between(cameras), axis=0)
        ).max()
        < 1e-4
    )  # the corrections are common
    left = freed(moved, cameras)
    assert np.abs(left).max() < 2e-2 * np.abs(moved).max()


@pytest.mark.parametrize("each", [6, 7, 8])
def test_what_cameras_are_to_each_other_stays(each):
    cameras = ring()
    own = RNG.normal(size=(len(cameras), each)) * 5e-3
    before = own + common(cameras, each, np.array([4e-3, 0, -3e-3]), 6e-3, np.array([0, 8e-3, 0]))
    after = freed(before, cameras)
    assert np.abs(after - before).max() > 3e-3
    a, b = (between(corrected(cameras, corrections_of(c))) for c in (after, before))
    np.testing.assert_allclose(a, b, atol=4e-4)
    again = freed(after, cameras)
    assert np.abs(again - after).max() < 2e-4  # nothing is left to take out
    if each > 6:
        np.testing.assert_allclose(
            after[:, 6], before[:, 6], atol=1e-7
        )  # the focal lengths are the cameras' own


def test_pictures_of_a_moved_scene_are_the_same():
    """The premise: a scene and its cameras moved together give the same pixels."""
    cameras = ring(3)
    turn, grow, shift = exp_so3(np.array([0.3, -0.2, 0.5])), 1.7, np.array([0.4, 0.1, -0.6])
    x = RNG.normal(size=(20, 3)) * 0.3
    for c in cameras:
        pose = np.eye(4)
        pose[:3, :3] = turn @ c.world_from_camera[:3, :3]
        pose[:3, 3] = grow * turn @ c.centre + shift
        moved = replace(c, world_from_camera=pose)
        np.testing.assert_allclose(
            [moved.project(p)[:2] for p in grow * x @ turn.T + shift],
            [c.project(p)[:2] for p in x],
            atol=1e-6,
        )

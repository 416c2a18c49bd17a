"""Best constants and chance, against values worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from relit.evaluate.baselines import Constants, best_constant, moments_of, random_rotations
from relit.evaluate.duplicates import instance_chance, instance_pose_figures, surface_chance
from relit.geometry.se3 import exp_so3
from relit.scene import Camera


def test_the_best_constant_of_a_squared_error_is_the_mean():
    constants = Constants()
    truth = np.array([[0.0, 1.0], [1.0, 0.2]])
    inside = np.array([[True, True], [True, False]])
    constants.add("roughness_mse", truth, inside)  # 0, 1, 1: the mean 2/3, the variance 2/9
    (value, text) = constants.baselines()["roughness_mse"]
    assert value == pytest.approx(2 / 9) and "best constant" in text


def test_views_count_alike_whatever_their_pixels():
    few, many = np.zeros((1, 1)), np.ones((10, 10))
    constant, value = best_constant([moments_of(few), moments_of(many)], psnr=False)
    assert constant == pytest.approx([0.5]) and value == pytest.approx(0.25)


def test_the_best_constant_of_a_psnr_beats_all_others():
    rng = np.random.default_rng(1)
    views = [
        np.clip(level + spread * rng.normal(size=(20, 20, 1)), 0, 1)
        for level, spread in ((0.2, 0.05), (0.35, 0.2), (0.7, 0.02))
    ]
    constant, value = best_constant([moments_of(v) for v in views], psnr=True)

    def psnr(c: float) -> float:
        return float(np.mean([-10 * np.log10(np.square(v - c).mean()) for v in views]))

    assert value == pytest.approx(psnr(float(constant[0])))
    assert value >= max(psnr(c) for c in np.linspace(0.4, 0.95, 200)) - 1e-3


def test_a_constant_over_the_frame_is_black_outside_the_object():
    truth = np.zeros((4, 4, 3))
    truth[:2] = [0.2, 0.4, 0.6]
    coverage = np.zeros((4, 4))
    coverage[:2] = 1
    constant, value = best_constant([moments_of(truth, coverage=coverage)], psnr=True)
    np.testing.assert_allclose(constant, [0.2, 0.4, 0.6])
    assert value == 100
    without = best_constant([moments_of(truth)], psnr=False)[1]
    assert without == pytest.approx(np.mean(np.square([0.1, 0.2, 0.3])))


def test_random_rotations_are_uniform():
    """Of uniform rotations the angle has the density (1 - cos x) / pi: its mean is 126.5 degrees."""
    turns = random_rotations(4000, np.random.default_rng(0))
    cosine = (np.trace(turns, axis1=1, axis2=2) - 1) / 2
    angles = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    assert angles.mean() == pytest.approx(np.degrees(np.pi / 2 + 2 / np.pi), abs=1.5)


def posed(*vectors):
    poses = {}
    for k, v in enumerate(vectors):
        poses[k] = np.eye(4)
        poses[k][:3, :3] = exp_so3(np.radians(v))
    return poses


def test_instances_that_are_not_registered_count_as_lost():
    true = posed([0, 0, 0], [0, 90, 0], [90, 0, 0], [0, 0, 90], [30, 20, 10])
    found = {k: true[k] for k in (0, 1)}
    seen = dict.fromkeys(true, 1.0)
    figures = instance_pose_figures(found, true, seen)
    assert figures["rotation_median"] == 180 and figures["registered"] == pytest.approx(40)
    assert figures["rotation_median_registered"] == pytest.approx(0, abs=1e-5)
    hidden = {**seen, 2: 0.0, 3: 0.0, 4: 0.1}  # two that the photo does not show, one hardly
    figures = instance_pose_figures(found, true, hidden)
    assert figures["rotation_median"] == pytest.approx(0, abs=1e-5)
    assert figures["registered"] == 100


def test_rotation_errors_of_instances():
    true = posed([0, 0, 0], [0, 50, 0], [70, 0, 0], [0, 0, 40])
    found = {k: p.copy() for k, p in true.items()}
    found[3][:3, :3] = exp_so3(np.radians([0, 30, 0])) @ found[3][:3, :3]
    figures = instance_pose_figures(found, true, dict.fromkeys(true, 1.0))
    assert figures["rotation_worst"] == pytest.approx(30) and figures["registered"] == 75
    assert figures["rotation_median"] == pytest.approx(0, abs=1e-5)
    # 3 of 6 pairs are off by 30: the median is the mean of 0 and 30
    assert figures["rotation_pairs"] == pytest.approx(15)


def test_chance_of_instances():
    rng = np.random.default_rng(7)
    true = {k: np.eye(4) for k in range(30)}
    for k, turn in enumerate(random_rotations(30, rng)):
        true[k][:3, :3] = turn
    chance = instance_chance(list(true), true, dict.fromkeys(true, 1.0))
    # the median angle x of uniform rotations solves x - sin x = pi / 2: 132.3 degrees
    assert chance["rotation_pairs"][0] == pytest.approx(132.3, abs=3)
    assert 90 < chance["rotation_median"][0] < 133 and chance["registered"][0] < 10
    assert "fixed seed" in chance["registered"][1]
    assert chance["rotation_before"] == chance["rotation_median"]
    assert instance_chance([], true, {}) == {}


def test_chance_between_surfaces_is_nothing_for_a_ball_and_something_for_a_rod():
    true = posed([0, 0, 0], [0, 50, 0], [70, 0, 0])
    camera = Camera(8, 8, 9.0, 9.0, 4.0, 4.0, np.eye(4))
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(3000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    value = surface_chance([0, 1, 2], true, camera, ball, 1.0)["surface_median"][0]
    assert value < 0.06
    # two rods through one point at an angle x: points at r are r sin x off, .5 pi / 4 on average
    rod = np.linspace([-1, 0, 0], [1, 0, 0], 400)
    value = surface_chance([0, 1, 2], true, camera, rod, 1.0)["surface_median"][0]
    assert value == pytest.approx(0.5 * np.pi / 4, abs=0.1)

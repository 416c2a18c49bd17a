"""Matches that poses guide, and poses adjusted over them."""

from __future__ import annotations

import numpy as np
import pytest

from relit.cameras.guided import (
    bundle_adjusted,
    consistent_matches,
    guided,
    guided_links,
    midpoints,
    relative_turn,
    tracks_of,
)
from relit.cameras.rotation_sweep import STEP, Features, Link
from relit.conventions import move_points, similarity
from relit.geometry.se3 import exp_so3, rotation_angle
from relit.scene import Camera

CAMERA = Camera(1600, 1200, 2300.0, 2300.0, 800.0, 600.0, np.eye(4))
TURNS = 360 // STEP


def scene(noise_degrees=1.5, seed=0):
    """Four objects of 120 points, half of them on the side that all see; their true poses, and
    wrong ones."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(120, 3))
    points = 0.8 * points / np.linalg.norm(points, axis=1, keepdims=True)
    axes = [np.array(a) for a in ([0.0, 0, 0], [0.5, 0.2, 0], [-0.3, 0.5, 0], [0.1, -0.6, 0])]
    rolls, places = (
        [0.0, 1.4, -2.2, 2.9],
        [[-2, -1.0, 11], [2, -1, 12], [-2, 1.2, 12.5], [2, 1.2, 11.5]],
    )
    true, wrong = [], []
    for a, roll, at in zip(axes, rolls, places, strict=True):
        turn = exp_so3(np.array([0, 0, roll])) @ exp_so3(a)
        true.append(np.linalg.inv(similarity(turn, np.array(at))))
        off = exp_so3(np.radians(noise_degrees) * rng.normal(size=3)) @ turn
        wrong.append(np.linalg.inv(similarity(off, np.array(at) * (1 + 0.01 * rng.normal()))))
    names = rng.normal(size=(120, 128))
    features = []
    for pose, roll in zip(true, rolls, strict=True):
        seen = np.flatnonzero(points @ pose[:3, 3] > 2.5)
        pixels = (
            CAMERA.project(move_points(np.linalg.inv(pose), points[seen]))[:, :2]
            + rng.normal(size=(len(seen), 2)) * 0.3
        )
        d = np.zeros((TURNS, len(seen), 128), np.float32)
        for t in range(TURNS):  # alike only at the turn that the object really has
            off = (t * STEP - np.degrees(roll) + 180) % 360 - 180
            share = np.exp(-((off / 12) ** 2))
            d[t] = share * names[seen] + (1 - share) * rng.normal(size=(len(seen), 128))
        features.append(Features(pixels, d / np.linalg.norm(d, axis=2, keepdims=True)))
    return features, np.array(true), np.array(wrong), points


def pair_errors(poses, true):
    def between(p, i, j):
        return p[i][:3, :3].T @ p[j][:3, :3]

    return [
        rotation_angle(between(poses, i, j).T @ between(true, i, j))
        for j in range(len(poses))
        for i in range(j)
    ]


def test_the_turn_between_two_poses_is_that_of_their_pictures():
    upright = np.linalg.inv(similarity(exp_so3(np.array([0.4, 0, 0])), np.array([0, 0, 9.0])))
    for degrees in (35.0, 250.0):
        rolled = exp_so3(np.array([0, 0, np.radians(degrees)])) @ exp_so3(np.array([0.4, 0, 0]))
        other = np.linalg.inv(similarity(rolled, np.array([0, 0, 9.0])))
        assert relative_turn(upright, other) == pytest.approx(
            degrees, abs=0.5
        )  # about +z away from the camera: clockwise in the picture
    assert relative_turn(upright, upright) == pytest.approx(0, abs=1e-6)


def test_lines_of_sight_of_one_point_meet_there():
    _, true, _, points = scene()
    p, q = (CAMERA.project(move_points(np.linalg.inv(m), points))[:, :2] for m in true[:2])
    found, off = midpoints(p, q, true[:2], (CAMERA, CAMERA))
    assert np.abs(found - points).max() < 1e-6 and off.max() < 1e-9
    assert midpoints(p, q[::-1], true[:2], (CAMERA, CAMERA))[1].mean() > 0.05


def test_guided_matches_are_right_and_adjustment_lowers_the_error():
    features, true, wrong, _ = scene()
    cameras = [CAMERA] * 4
    links = guided_links(features, wrong, cameras, 2.0)
    assert len(links) >= 2
    for (i, j), link in links.items():
        p, q = features[i].points[link.a], features[j].points[link.b]
        assert np.median(midpoints(p, q, true[[i, j]], (CAMERA, CAMERA))[1]) < 0.005
    before = np.median(pair_errors(wrong, true))
    moved, counts, (start, end) = bundle_adjusted(features, links, wrong, cameras)
    assert end < 0.5 * start and counts.sum() > 40
    linked = sorted({k for pair in links for k in pair})
    assert np.median(pair_errors(moved[linked], true[linked])) < 0.7 * before
    for k in set(range(4)) - set(linked):
        assert np.allclose(moved[k], wrong[k])
    both, count = guided(features, {}, wrong, cameras, 2.0)
    assert count >= len(links) and np.median(pair_errors(both[linked], true[linked])) < 0.7 * before


def test_matches_that_the_poses_forbid_are_left_out():
    features, true, _, _ = scene()
    n = min(len(features[0].points), len(features[1].points))
    links = {
        (0, 1): Link(np.arange(n), np.arange(n)[::-1].copy(), 0.0)
    }  # keypoints paired at random
    kept = consistent_matches(features, links, true, [CAMERA] * 4)
    assert not kept or len(kept[0, 1].a) < 0.5 * n
    bare = [Features(f.points, np.zeros((0, 0, 0), np.float32)) for f in features]
    same, count = guided(bare, {}, true, [CAMERA] * 4, 2.0)
    assert count == 0 and np.array_equal(same, true)


def test_tracks_hold_one_keypoint_of_an_instance():
    one = Link(np.array([0, 1, 2]), np.array([0, 1, 2]), 0.0)
    links = {
        (0, 1): one,
        (1, 2): Link(np.array([0, 1]), np.array([5, 6]), 0.0),
        (0, 2): Link(np.array([0, 1]), np.array([5, 7]), 0.0),
    }
    assert sorted(tracks_of(links)) == [[(0, 0), (1, 0), (2, 5)], [(0, 2), (1, 2)]]

"""Rotation-swept matching of identical objects."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from relit.cameras.rotation_sweep import (
    LEAST,
    STEP,
    best_turn,
    find_features,
    link_instances,
    map_instances,
    match_pair,
)
from relit.geometry.se3 import exp_so3, rotation_angle
from relit.scene import Camera


def texture(size=150):
    rng = np.random.default_rng(0)
    coarse = rng.uniform(0, 1, (24, 24)).astype(np.float32)
    picture = cv2.resize(coarse, (size, size), interpolation=cv2.INTER_CUBIC)
    return np.repeat(np.clip(picture, 0, 1)[..., None], 3, 2)


def disc(size=150):
    mask = np.zeros((size, size), np.float32)
    cv2.circle(mask, (size // 2, size // 2), size // 2 - 10, 1.0, -1)
    return mask


def turned(picture, degrees):
    centre = (picture.shape[1] / 2 - 0.5, picture.shape[0] / 2 - 0.5)
    return cv2.warpAffine(
        picture,
        cv2.getRotationMatrix2D(centre, degrees, 1.0),
        picture.shape[1::-1],
        flags=cv2.INTER_CUBIC,
    )


def test_the_count_is_smoothed_around_the_circle():
    counts = np.zeros(30)
    counts[17] = 9  # one outlier
    counts[[29, 0, 1]] = 6
    assert best_turn(counts) == 0


def test_turned_matches_are_found_by_the_sweep_and_come_back_in_photo_pixels():
    picture = texture()
    a = find_features(picture, disc(), (100.0, 50.0))
    b = find_features(np.clip(turned(picture, 100), 0, 1), disc(), (400.0, 50.0))
    link = match_pair(a, b)
    plain = match_pair(a, b, sweep=False)
    assert link is not None and (plain is None or len(plain.a) < 0.5 * len(link.a))
    off = (link.turn - 100 + 180) % 360 - 180, (link.turn + 100 + 180) % 360 - 180
    assert min(abs(x) for x in off) <= 2 * STEP
    p, q = a.points[link.a] - [100, 50] - 75, b.points[link.b] - [400, 50] - 75
    c, s = np.cos(np.radians(100)), np.sin(np.radians(100))
    assert np.median(np.linalg.norm(p @ np.array([[c, s], [-s, c]]).T - q, axis=1)) < 1.5


def test_objects_of_one_scene_are_linked_and_placed():
    """Three bumpy reliefs with one texture, turned against each other: relative rotations from one
    photo."""
    rng = np.random.default_rng(1)
    points = rng.uniform(-1, 1, (200, 3)) * [1, 1, 0.4]
    camera = Camera(1200, 400, 900.0, 900.0, 600.0, 200.0, np.eye(4))
    turns = [exp_so3(np.array([0.25 * k, 0.3 * k, 1.2 * k])) for k in range(3)]
    features = []
    descriptors = rng.normal(size=(200, 128)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    noise = [rng.normal(size=(200, 128)).astype(np.float32) for _ in range(8)]
    for k, turn in enumerate(turns):
        seen = camera.project(points @ turn.T + [3.0 * (k - 1), 0, 12])[:, :2]
        swept = np.stack(
            [n / np.linalg.norm(n, axis=1, keepdims=True) for n in noise[:1] * (360 // STEP)]
        )
        swept[[0, 3, 87]] = descriptors  # what a turn of about 0 shows; all others do not match
        features.append(
            type(
                find_features(np.zeros((8, 8, 3), np.float32), np.ones((8, 8), np.float32), (0, 0))
            )(seen, swept)
        )
    links = link_instances(features, camera, 1.0)
    assert set(links) == {(0, 1), (0, 2), (1, 2)} and min(len(x.a) for x in links.values()) >= LEAST
    placed = map_instances(features, links, camera)[0]
    assert sorted(placed) == [0, 1, 2]
    for i, j in links:
        relative = placed[j][:3, :3] @ placed[i][:3, :3].T
        assert rotation_angle(relative.T @ turns[j] @ turns[i].T) < 1.0
        assert rotation_angle(links[i, j].rotation.T @ turns[j] @ turns[i].T) < 3.0


def test_objects_without_texture_are_not_linked():
    flat = np.full((80, 80, 3), 0.5, np.float32)
    a = find_features(flat, np.ones((80, 80), np.float32), (0, 0))
    assert match_pair(a, a) is None
    assert map_instances([a, a], {}, Camera(100, 100, 90.0, 90.0, 50.0, 50.0, np.eye(4))) == []


@pytest.mark.parametrize("shape", [(60, 90), (90, 60)])
def test_keypoints_lie_in_the_window(shape):
    picture = texture()[: shape[0], : shape[1]]
    f = find_features(picture, np.ones(shape, np.float32), (10.0, 20.0))
    assert (f.points >= [10, 20]).all() and (f.points <= [10 + shape[1], 20 + shape[0]]).all()
    assert f.descriptors.shape == (360 // STEP, len(f.points), 128)

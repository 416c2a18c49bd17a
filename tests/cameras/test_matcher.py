"""Matchers that a user brings."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from relit.cameras.matcher import (
    keypoints,
    link_by_matcher,
    load_matcher,
    matches_at,
    rotated_picture,
)
from relit.cameras.rotation_sweep import Features
from relit.errors import UserError
from relit.fit.duplicates.options import DuplicatesOptions
from relit.fit.duplicates.poses import match_instances
from relit.geometry.se3 import exp_so3, rotation_angle
from relit.scene import Camera


def corners(a, b):
    """Matches the brightest pixel of each of the three channels."""
    out = [
        np.array([np.unravel_index(x[..., c].argmax(), x.shape[:2])[::-1] for c in range(3)]) + 0.5
        for x in (a, b)
    ]
    return out[0], out[1]


def test_points_of_the_turned_picture_are_carried_back():
    picture = np.zeros((50, 80, 3), np.uint8)
    where = np.array([[20, 10], [60, 30], [41, 44]])
    for c, (x, y) in enumerate(where):
        cv2.circle(picture, (int(x), int(y)), 2, tuple(255 if k == c else 0 for k in range(3)), -1)
        picture[y, x, c] = 255
    picture = cv2.GaussianBlur(picture, (0, 0), 1.5)
    for degrees in (0.0, 24.0, 100.0, 215.0):
        assert rotated_picture(picture, degrees)[0].shape[0] >= 50 or degrees == 0
        p, q = matches_at(corners, picture, picture, degrees)
        assert np.abs(p - q).max() < 1.5 and np.abs(p - where - 0.5).max() < 1.5


def test_keypoints_are_counted_once():
    known = []
    assert keypoints(known, np.array([[1.0, 1], [5, 5], [1.2, 1]])).tolist() == [0, 1, 0]
    assert keypoints(known, np.array([[5.0, 5.1], [9, 9]])).tolist() == [1, 2] and len(known) == 3


def test_a_matcher_links_two_objects(monkeypatch):
    """A stand-in that knows the scene: it answers only where the picture is turned rightly."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (60, 3)) * [1, 1, 0.4]
    camera = Camera(1200, 400, 900.0, 900.0, 600.0, 200.0, np.eye(4))
    turns = [np.eye(3), exp_so3(np.array([0.3, 0.35, 0.0]))]
    seen = [
        camera.project(points @ t.T + [4.0 * (k - 0.5), 0, 12])[:, :2] for k, t in enumerate(turns)
    ]
    corner = [s.min(0) - 10 for s in seen]
    windows = [
        (np.full((170, 170, 3), 0.4, np.float32), np.ones((170, 170), np.float32), c)
        for c in corner
    ]
    import relit.cameras.matcher as module

    scale = module.SIDE / 170
    calls = []

    def answer(matcher, a, b, degrees):
        calls.append(degrees)
        good = abs((degrees + 180) % 360 - 180) < 20
        p, q = ((s - c) * scale for s, c in zip(seen, corner, strict=True))
        return (p, q) if good else (rng.uniform(0, 400, (30, 2)), rng.uniform(0, 400, (30, 2)))

    monkeypatch.setattr(module, "matches_at", answer)
    features, links = link_by_matcher(None, windows, [camera, camera], 1.0)
    assert set(links) == {(0, 1)} and isinstance(features[0], Features) and 15 < len(calls) < 25
    calls.clear()
    fine = link_by_matcher(None, windows, [camera, camera], 1.0, step=4)[1]
    assert {float(t) for t in range(0, 360, 4)} <= set(calls) and len(
        calls
    ) < 96  # each turn is asked for once
    assert abs((fine[0, 1].turn + 180) % 360 - 180) < 20 and len(fine[0, 1].a) == len(links[0, 1].a)
    link = links[0, 1]
    assert np.abs(features[0].points[link.a] - seen[0][: len(link.a)]).max() < 1.0
    assert rotation_angle(link.rotation.T @ turns[1] @ turns[0].T) < 1.5


def test_the_step_is_a_setting_of_the_recipe(tmp_path, monkeypatch):
    """A matcher that finds nothing is asked once for each turn of the sweep."""
    (tmp_path / "counting_matcher.py").write_text(
        "asked = []\ndef match(a, b):\n    asked.append(1)\n    return [], []\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    labels = np.zeros((40, 90), np.int32)
    labels[10:30, 10:30], labels[10:30, 50:70] = 1, 2
    photo = SimpleNamespace(rgb=np.full((40, 90, 3), 0.5, np.float32), labels=labels, normal=None)
    shots = [(photo, Camera(90, 40, 90.0, 90.0, 45, 20, np.eye(4)))]
    run = SimpleNamespace(say=lambda text: None)
    counts = []
    for given in ({}, {"matcher_step": 4}):
        options = DuplicatesOptions(matcher="counting_matcher:match", **given)
        assert match_instances(shots, run, options, 0).links == {}
        asked = sys.modules["counting_matcher"].asked
        counts.append(len(asked))
        asked.clear()
    del sys.modules["counting_matcher"]
    assert 15 <= counts[0] <= 18 and 90 <= counts[1] <= 93
    for wrong in (0, 7, 100):
        with pytest.raises(ValueError, match="divisor"):
            DuplicatesOptions(matcher_step=wrong)


def test_matchers_are_loaded_by_name(tmp_path, monkeypatch):
    (tmp_path / "my_matcher_for_tests.py").write_text(
        "def match(a, b):\n    return [[1, 2]], [[3, 4], [5, 6]]\nnumber = 3\n"
    )
    monkeypatch.chdir(tmp_path)
    match = load_matcher("my_matcher_for_tests:match")
    with pytest.raises(UserError, match="the matcher failed"):
        matches_at(match, np.zeros((8, 8, 3), np.uint8), np.zeros((8, 8, 3), np.uint8), 0.0)
    for wrong, message in (
        ("my_matcher_for_tests", "names no matcher"),
        ("my_matcher_for_tests:none", "could not be loaded"),
        ("nowhere_to_be_found:match", "could not be loaded"),
        ("my_matcher_for_tests:number", "no function"),
    ):
        with pytest.raises(UserError, match=message):
            load_matcher(wrong)
    sys.modules.pop("my_matcher_for_tests", None)

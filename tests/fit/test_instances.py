"""Poses of identical objects: windows of the photo, hypotheses that agree, the ground."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from relit.cameras.se3 import exp_so3, nearest_rotation, rotation_angle
from relit.conventions import similarity
from relit.fit.instance_search import consistent, distinct, trusted
from relit.fit.instances import carved, first_pose, frame_scale, inflated, pixel_bank, views_of
from relit.fit.pile_scene import find_ground
from relit.geometry.sdf import node_positions
from relit.scene import Camera

CAMERA = Camera(200, 120, 300.0, 300.0, 100.0, 60.0, np.eye(4))


def discs():
    labels = np.zeros((120, 200), np.int32)
    cv2.circle(labels, (50, 60), 30, 7, -1)
    cv2.circle(labels, (100, 60), 30, 9, -1)  # in front of the first
    return labels


def test_windows_look_at_the_same_pixels_and_know_what_another_object_may_hide():
    labels = discs()
    rgb = np.random.default_rng(0).uniform(0, 1, (120, 200, 3)).astype(np.float32)
    views = views_of(rgb, labels, CAMERA, 10**6)
    assert [v.label for v in views] == [7, 9]
    v = views[0]
    left, top = round(CAMERA.cx - v.camera.cx), round(CAMERA.cy - v.camera.cy)
    h, w = v.mask.shape
    assert np.array_equal(v.rgb, rgb[top : top + h, left : left + w])
    other = labels[top : top + h, left : left + w] == 9
    assert (v.known[other] == 0).all() and (v.known[(v.mask > 0)] == 1).all()
    assert 0.5 < v.seen < 1
    bank = pixel_bank(views, np.tile(similarity(np.eye(3), [0, 0, -6]), (2, 1, 1)))
    drawn = np.array(bank.candidates)
    hidden = np.flatnonzero(np.concatenate([x.known.ravel() for x in views]) == 0)
    assert len(drawn) and not set(drawn.tolist()) & set(hidden.tolist())


def test_a_disc_inflates_to_a_body_as_wide_and_nearly_as_deep():
    labels = np.zeros((120, 200), np.int32)
    cv2.circle(labels, (140, 70), 30, 1, -1)
    views = views_of(np.zeros((120, 200, 3), np.float32), labels, CAMERA, 10**6)
    pose = first_pose(views[0], frame_scale(views))
    values = inflated(views[0], pose, 33)
    inside = node_positions(33)[values < 0]
    assert np.abs(inside.mean(0)).max() < 0.1
    reach = np.abs(inside).max(0)
    assert reach[0] == pytest.approx(0.8, abs=0.1) and 0.4 < reach[2] < 0.9


def test_carving_keeps_what_unknown_pixels_may_hide():
    labels = discs()
    views = views_of(np.zeros((120, 200, 3), np.float32), labels, CAMERA, 10**6)
    pose = first_pose(views[0], frame_scale(views))
    v = views[0]
    everywhere = replace(v, mask=np.ones_like(v.mask), known=np.ones_like(v.known))  # another view that has the object all over
    poses = np.stack([pose, pose])
    blind = replace(v, known=np.ones_like(v.known))
    assert (carved([v, everywhere], poses, 24, 0.0) < 0).sum() > 1.05 * (carved([blind, everywhere], poses, 24, 0.0) < 0).sum()


def test_the_orientations_that_most_guesses_support_are_found():
    rng = np.random.default_rng(1)
    n, keep = 7, 3
    truth = np.array([exp_so3(rng.normal(size=3)) for _ in range(n)])
    rotations, scores = np.zeros((n, n, keep, 3, 3)), np.full((n, n, keep), 0.86)
    for s in range(n):
        for j in range(n):
            for k in range(keep):
                rotations[s, j, k] = exp_so3(rng.normal(size=3) * 2)
            if rng.uniform() < 0.6:  # one of the guesses is right within some degrees, not always the best one
                rotations[s, j, rng.integers(keep)] = exp_so3(rng.normal(size=3) * 0.08) @ truth[j] @ truth[s].T
    found = consistent(rotations, scores, list(range(n)), 22.0)[0][1]
    frame = nearest_rotation(np.einsum("nji,njk->ik", found, truth))
    assert max(rotation_angle((a @ frame).T @ b) for a, b in zip(found, truth, strict=True)) < 12


def test_a_strong_link_from_matching_decides_between_guesses():
    turn = exp_so3(np.array([0, 0, 1.5]))
    rotations, scores = np.tile(np.eye(3), (2, 2, 1, 1, 1)), np.full((2, 2, 1), 0.85)
    found = consistent(rotations, scores, [0, 1], 22.0, links=[(0, 1, turn, 1.0)])[0][1]
    assert rotation_angle(found[1] @ found[0].T @ turn.T) < 15


def test_sets_that_differ_only_by_their_frame_are_one():
    rng = np.random.default_rng(2)
    a = np.array([exp_so3(rng.normal(size=3)) for _ in range(5)])
    b = a @ exp_so3(np.array([0.3, 1.0, 0.2]))
    c = np.array([exp_so3(rng.normal(size=3)) for _ in range(5)])
    assert len(distinct([(3.0, a), (2.0, b), (1.0, c)], 5)) == 2


def test_instances_with_low_scores_are_not_trusted():
    assert trusted(np.array([0.9, 0.92, 0.6, 0.88, 0.5])).tolist() == [0, 1, 3]
    assert len(trusted(np.array([0.9, 0.3, 0.2, 0.1]))) == 3


def test_the_ground_is_the_plane_that_most_instances_touch():
    rng = np.random.default_rng(3)
    up = np.array([0.0, -0.8, -0.6])  # in the photo's frame: towards the camera and up in the picture
    body = rng.normal(size=(400, 3))
    body = 0.8 * body / np.linalg.norm(body, axis=1, keepdims=True)
    poses, side = [], np.cross(up, [1.0, 0, 0])
    for k in range(6):
        centre = np.array([0, 0, 12.0]) + (k % 3 - 1) * 2.0 * np.array([1.0, 0, 0]) + (k // 3) * 2.0 * side
        centre = centre + up * (1.5 if k == 5 else 0.0)  # one lies on others
        photo_from_object = similarity(exp_so3(rng.normal(size=3)), centre)
        poses.append(np.linalg.inv(photo_from_object))
    point, normal = find_ground(body, np.array(poses))
    assert normal @ up > 0.995
    assert (np.array([0, 0, 12.0]) - point) @ up == pytest.approx(0.8, abs=0.08)
    assert len(find_ground(body, np.array(poses[:2]))) == 0

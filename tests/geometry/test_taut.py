"""What is left of a visual hull where only what silhouettes ask for stays."""

import cv2
import numpy as np
import pytest

from relit.geometry.hull import NoShape, visual_hull
from relit.geometry.sdf import node_positions
from relit.geometry.se3 import look_at
from relit.geometry.taut import taut
from relit.scene import Camera

NODES, RADIUS = 40, 0.6


def cameras_at(*eyes):
    return [Camera(120, 120, 160.0, 160.0, 60.0, 60.0, look_at(np.array(e, float))) for e in eyes]


def picture(inside, camera):
    """Mask of the points for which `inside` says so, on a fine grid of [-1, 1]^3."""
    p = node_positions(96).reshape(-1, 3)
    return covered(p[inside(p)], camera)


def covered(points, camera):
    q = camera.project(points)
    shape = (camera.height, camera.width)
    out = np.zeros(shape, np.float32)
    out[
        np.clip(q[:, 1].astype(int), 0, shape[0] - 1), np.clip(q[:, 0].astype(int), 0, shape[1] - 1)
    ] = 1
    return out


def ball(p):
    return (p**2).sum(1) < RADIUS**2


def cross(p):
    """Three thin bars at right angles."""
    return (np.abs(p) < 0.09).sum(1) >= 2


def hull_and_masks(inside, cameras):
    masks = [
        cv2.morphologyEx(picture(inside, c), cv2.MORPH_CLOSE, np.ones((5, 5))) for c in cameras
    ]
    return visual_hull(cameras, masks, NODES), masks


def volume(values):
    return float((values < 0).sum()) * (2 / (NODES - 1)) ** 3


def test_two_outlines_of_a_ball_leave_a_body_nearer_to_the_ball_than_their_hull():
    cameras = cameras_at((0, 0, 4), (4, 0, 0))
    hull, masks = hull_and_masks(ball, cameras)
    body = taut(hull, cameras, masks)
    p = node_positions(NODES).reshape(-1, 3)
    true = ball(p)
    wrong = [float(((v.ravel() < 0) != true).sum()) / true.sum() for v in (hull, body)]
    assert wrong[0] > 0.2  # the crossing of two cylinders has corners
    assert wrong[1] < 0.6 * wrong[0]
    assert not ((body < 0) & ~(hull < 0)).any()


def test_silhouettes_stay_filled_down_to_thin_bars():
    cameras = cameras_at((0.5, 0.8, 4), (4, 0.7, 0.6), (0.6, 4, 0.7))
    hull, masks = hull_and_masks(cross, cameras)
    body = taut(hull, cameras, masks, rounds=12)
    p = node_positions(NODES).reshape(-1, 3)
    assert volume(body) < 0.9 * volume(hull)
    for camera in cameras:
        coarse = camera.resized(30, 30)  # a pixel is as large as a cell of the grid
        full, left = (covered(p[v.ravel() < 0], coarse) for v in (hull, body))
        assert not ((full > 0) & (cv2.dilate(left, np.ones((3, 3))) == 0)).any()


def test_what_is_not_known_to_be_the_objects_is_not_held():
    cameras = cameras_at((0, 0, 4), (4, 0, 0))
    hull, masks = hull_and_masks(ball, cameras)
    body = taut(hull, cameras, [np.zeros_like(m) for m in masks], rounds=3)
    assert volume(body) < volume(taut(hull, cameras, masks, rounds=3)) < volume(hull)


def test_an_empty_hull_is_said():
    with pytest.raises(NoShape):
        taut(
            np.ones((NODES, NODES, NODES), np.float32),
            cameras_at((0, 0, 4)),
            [np.ones((120, 120), np.float32)],
        )

"""Lenses against OpenCV's own, and undistorted pictures without blank pixels."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from relit.geometry.lens import (
    BrownLens,
    FisheyeLens,
    ideal_from_pixels,
    lens_of,
    pixels_from_ideal,
    undistorted_camera,
    undistortion_map,
)
from relit.scene import Camera

RNG = np.random.default_rng(0)
XY = RNG.uniform(-0.5, 0.5, (50, 2))


def camera(distortion=(), width=60, height=40):
    return Camera(width, height, 70.0, 72.0, 29.0, 21.0, np.eye(4), tuple(distortion))


@pytest.mark.parametrize(
    "k",
    [
        (0.1, -0.2, 0.01, -0.02),
        (0.1, -0.2, 0.01, -0.02, 0.05),
        (0.1, 0.2, 0.0, 0.0, 0.05, 0.2, -0.1, 0.02),
    ],
)
def test_brown_is_opencv(k):
    c = camera(k)
    points = np.concatenate([XY, np.ones((50, 1))], axis=1)
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), c.intrinsics, np.array(k))
    np.testing.assert_allclose(pixels_from_ideal(c, lens_of(c), XY), expected[:, 0], atol=1e-9)


def test_fisheye_is_opencv():
    k = (0.1, -0.05, 0.02, -0.01)
    expected = cv2.fisheye.distortPoints(XY[None], np.eye(3), np.array(k))[0]
    np.testing.assert_allclose(FisheyeLens(k)(XY), expected, atol=1e-9)


@given(st.tuples(*[st.floats(-0.15, 0.15)] * 2, *[st.floats(-0.01, 0.01)] * 2))
@settings(max_examples=40, deadline=None)
def test_undistorted_pictures_have_no_blank_pixels(k):
    c, lens = camera(k), BrownLens(k)
    ideal = undistorted_camera(c, lens)
    x, y = undistortion_map(c, lens, ideal)
    assert x.shape == (ideal.height, ideal.width)
    assert x.min() > -1 and y.min() > -1 and x.max() < c.width and y.max() < c.height
    assert 0.7 * c.width < ideal.width <= 1.3 * c.width and ideal.fx == c.fx


def test_inverse_of_the_lens():
    c = camera((-0.2, 0.05, 0.001, 0.002))
    lens = lens_of(c)
    np.testing.assert_allclose(
        ideal_from_pixels(c, lens, pixels_from_ideal(c, lens, XY)), XY, atol=1e-4
    )


def test_the_map_agrees_with_projection():
    """A world point that projects to some pixel of the undistorted picture is found where the lens
    put it in the photo."""
    c = camera((-0.1, 0.02, 0.002, -0.001))
    lens = lens_of(c)
    ideal = undistorted_camera(c, lens)
    x, y = undistortion_map(c, lens, ideal)
    row, col = 11, 37
    point = np.array([(col + 0.5 - ideal.cx) / ideal.fx, (row + 0.5 - ideal.cy) / ideal.fy, 1.0])
    np.testing.assert_allclose(ideal.project(point)[:2], [col + 0.5, row + 0.5])
    seen, _ = cv2.projectPoints(
        point[None], np.zeros(3), np.zeros(3), c.intrinsics, np.array(c.distortion)
    )
    np.testing.assert_allclose([x[row, col] + 0.5, y[row, col] + 0.5], seen[0, 0], atol=1e-5)


def test_no_lens_is_no_change():
    c = camera()
    assert lens_of(c) is None and undistorted_camera(c, None) == c
    assert lens_of(camera((0.0, 0.0, 0.0, 0.0))) is None


def test_a_wide_fisheye_is_cut():
    c = Camera(100, 100, 30.0, 30.0, 50.0, 50.0, np.eye(4))  # 190 degrees across
    ideal = undistorted_camera(c, FisheyeLens((0.0, 0.0, 0.0, 0.0)))
    assert 0 < ideal.width <= 125

"""Bodies of revolution: what an outline rules out on one side is ruled out all around, and handles stay."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from relit.cameras.se3 import look_at
from relit.fit.instances import View
from relit.fit.turned_body import turned_body, widest_circles
from relit.geometry.hull import distance_of
from relit.geometry.revolution_axis import Axis
from relit.geometry.sdf import node_positions
from relit.scene import Camera

N = 80
UP = Axis(np.zeros(3), np.array([0.0, 1.0, 0.0]))


def waisted(y):
    """Radius of a body that is narrow in its middle."""
    return 0.5 - 0.3 * np.exp(-np.square(y / 0.12))


def solid(n: int, filled: bool, handle: bool = True) -> np.ndarray:
    """(n, n, n) bool: the waisted body with a handle at +x; filled: without its waist on a quarter of all sides, where +z is."""
    p = node_positions(n)
    r, y = np.hypot(p[..., 0], p[..., 2]), p[..., 1]
    wide = (np.abs(np.arctan2(p[..., 0], p[..., 2])) < np.pi / 4) & filled
    ring = np.hypot(p[..., 2], np.hypot(p[..., 0] - 0.5, y) - 0.25) < 0.06
    return ((np.abs(y) < 0.5) & (r < np.where(wide, 0.5, waisted(y)))) | (ring & handle)


@pytest.fixture(scope="module")
def seen():
    """Six views, two of them from above or below."""
    p, views, cameras = node_positions(160)[solid(160, False)].astype(float), [], []
    for k, height in enumerate((0.1, -0.1, 1.2, 0.2, -0.9, 0.0)):
        eye = np.array([np.cos(2.4 * k), 0, np.sin(2.4 * k)]) * np.sqrt(9 - height**2) + [0, height, 0]
        camera = Camera(192, 192, 220.0, 220.0, 96.0, 96.0, look_at(eye))
        x, y = camera.project(p)[:, :2].astype(int).T
        mask = np.zeros((192, 192), np.float32)
        mask[y, x] = 1
        mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((3, 3)))
        cameras.append(camera)
        views.append(View(k, camera, np.zeros((192, 192, 3)), mask, np.ones((192, 192)), 1.0))
    return views, cameras


def test_a_waist_goes_all_around_and_the_handle_stays(seen):
    start, truth = solid(N, True), solid(N, False)
    found = turned_body(distance_of(start), UP, *seen) < 0
    filling = start & ~truth
    handle = truth & ~solid(N, False, handle=False)
    assert (filling & found).sum() < 0.65 * filling.sum()
    assert (handle & found).sum() > 0.95 * handle.sum()
    assert (truth & ~found).sum() < 0.03 * truth.sum()


def test_circles_are_as_wide_as_the_body(seen):
    heights, widest = widest_circles(distance_of(solid(N, True)), UP, *seen)
    inner = np.abs(heights) < 0.45
    assert np.abs(widest - waisted(heights))[inner].max() < 2.5 * 2 / (N - 1)


def test_nothing_goes_that_no_view_rules_out(seen):
    """Views that know nothing but what they show of the object itself."""
    views = [replace(v, known=v.mask) for v in seen[0]]
    start = distance_of(solid(N, True))
    assert turned_body(start, UP, views, seen[1]) is start

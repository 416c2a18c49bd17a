"""The plane in which a surface is its own mirror image: found where it lies, and told from none."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from relit.conventions import move_points, similarity
from relit.geometry.se3 import exp_so3
from relit.geometry.symmetry import Plane, half_sphere, plane_between, symmetry_plane


def surface(boxes) -> np.ndarray:
    """Points on boxes (extents, middle)."""
    parts = [trimesh.creation.box(extents=e).apply_translation(at) for e, at in boxes]
    whole = trimesh.util.concatenate(parts)
    return np.asarray(trimesh.sample.sample_surface(whole, 12_000, seed=0)[0])


# a body with two arms that is even in x alone, and the same with one arm
EVEN = [
    ((0.5, 0.9, 0.4), (0, 0, 0)),
    ((0.5, 0.2, 0.2), (0.5, 0.3, 0.1)),
    ((0.5, 0.2, 0.2), (-0.5, 0.3, 0.1)),
    ((0.2, 0.2, 0.5), (0, -0.3, 0.4)),
]
LOPSIDED = [*EVEN[:2], *EVEN[3:], ((0.3, 0.5, 0.2), (-0.2, -0.4, -0.3))]


@pytest.mark.slow
def test_the_plane_is_found_wherever_the_body_lies():
    pose = similarity(exp_so3(np.array([0.4, -0.7, 1.1])), np.array([0.05, -0.1, 0.02]))
    plane, distance = symmetry_plane(move_points(pose, surface(EVEN)))
    normal = pose[:3, 0]
    assert abs(plane.normal @ normal) > np.cos(np.radians(0.5))
    assert plane.offset * np.sign(plane.normal @ normal) == pytest.approx(
        normal @ pose[:3, 3], abs=0.004
    )
    assert distance < 0.012  # points lie so far apart
    assert symmetry_plane(surface(LOPSIDED))[1] > 2 * distance


def test_the_plane_between_points_and_their_images_is_the_one_that_mirrored_them():
    rng = np.random.default_rng(0)
    for normal in half_sphere(5):
        plane = Plane(normal, 0.3)
        points = rng.standard_normal((40, 3))
        found = plane_between(points, move_points(plane.mirror, points))
        side = np.sign(found.normal @ normal)
        assert np.allclose(side * found.normal, normal) and side * found.offset == pytest.approx(
            0.3
        )
        assert np.allclose(plane.mirror @ plane.mirror, np.eye(4))

"""Photos that structure from motion has put where they were not taken."""

import numpy as np
import pytest

from relit.cameras.strays import LEAST_POINTS, expected_points, stray_photos
from relit.conventions import similarity
from relit.fit.registration.register import directions_around
from relit.geometry.se3 import exp_so3, look_at
from relit.scene import Camera

SIDE = 256


def camera(pose):
    return Camera(SIDE, SIDE, 360.0, 360.0, SIDE / 2, SIDE / 2, pose)


def box_points(rng, count=400):
    """Points on a long box, so that its outline tells from where it is seen."""
    p = rng.uniform(-1, 1, (count, 3))
    axis = rng.integers(0, 3, count)
    p[np.arange(count), axis] = np.sign(p[np.arange(count), axis])
    return p * [0.9, 0.08, 0.3]


@pytest.fixture
def seen():
    """(cameras, masks, points) of 20 photos whose masks are those of the box."""
    rng = np.random.default_rng(0)
    points, dense = box_points(rng), box_points(rng, 400_000)
    cameras = [camera(look_at(3.0 * d)) for d in directions_around(20)]
    masks = []
    for c in cameras:
        u, v, _ = c.project(dense).T
        mask = np.zeros((SIDE, SIDE), np.float32)
        mask[np.clip(v.astype(int), 0, SIDE - 1), np.clip(u.astype(int), 0, SIDE - 1)] = 1
        masks.append(mask)
    return cameras, masks, points


def test_none_stray_where_all_is_right(seen):
    cameras, masks, points = seen
    odd, kept = stray_photos(cameras, masks, points)
    assert odd == [] and kept.all()


def test_photos_that_stand_elsewhere_are_found_and_their_points_left_out(seen):
    cameras, masks, points = seen
    turned = exp_so3(np.array([0.0, 0.0, 1.2]))
    cameras = list(cameras)
    for k in (3, 11, 12):  # turned about the object: each still looks at its middle
        pose = cameras[k].world_from_camera.copy()
        pose[:3] = turned @ pose[:3]
        cameras[k] = camera(pose)
    beside = np.random.default_rng(1).uniform(0.8, 1.2, (60, 3))  # what the strays have made up
    odd, kept = stray_photos(cameras, masks, np.concatenate([points, beside]))
    assert odd == [3, 11, 12]
    assert kept[: len(points)].mean() > 0.9 and not kept[len(points) :].any()


def test_nobody_is_blamed_where_little_is_known(seen):
    cameras, masks, points = seen
    wrong = [camera(look_at(np.array([0.1, 3.0, 0.2]))), *cameras[1:]]
    assert stray_photos(wrong, masks, points)[0] == [0]
    assert stray_photos(wrong, masks, points[: LEAST_POINTS - 1])[0] == []
    assert stray_photos(wrong, masks, None)[0] == []
    rough = [np.roll(m, 56, axis=1) for m in masks]  # masks that hold little of it anywhere
    assert stray_photos(wrong, rough, points)[0] == []
    turned = exp_so3(np.array([0.0, 0.0, 1.2]))
    half = [
        camera(similarity(turned @ c.world_from_camera[:3, :3], turned @ c.centre)) if k % 2 else c
        for k, c in enumerate(cameras)
    ]
    assert stray_photos(half, masks, points)[0] == []


def test_a_close_up_is_no_stray(seen):
    """Half of the object lies outside its frame; what lies inside agrees."""
    cameras, masks, points = seen
    cameras, masks = list(cameras), list(masks)
    cut = SIDE // 2
    c = cameras[5]
    cameras[5], masks[5] = (
        Camera(cut, SIDE, c.fx, c.fy, c.cx, c.cy, c.world_from_camera),
        masks[5][:, :cut],
    )
    assert stray_photos(cameras, masks, points)[0] == []
    away = c.world_from_camera.copy()
    away[:3, :3] = away[:3, :3] @ exp_so3(np.array([0.0, 1.5, 0.0]))  # sees nothing of it
    full = np.ones((SIDE, SIDE), np.float32)  # whose mask reaches the border: nothing to judge by
    assert (
        stray_photos(
            [*cameras[:5], camera(away), *cameras[6:]], [*masks[:5], full, *masks[6:]], points
        )[0]
        == []
    )
    assert stray_photos([*cameras[:5], camera(away), *cameras[6:]], seen[1], points)[0] == [
        5
    ]  # whose mask shows all of the object


def test_points_behind_or_beside_the_picture_are_not_shown(seen):
    cameras, _, _ = seen
    c, mask = cameras[0], np.ones((SIDE // 2, SIDE // 2), np.float32)
    mask[:, : SIDE // 4 - 8] = 0  # the object goes on beyond the border
    x, ahead = c.world_from_camera[:3, 0], c.world_from_camera[:3, 2]
    points = c.centre + np.array([2 * ahead, -2 * ahead, 2 * ahead + 5 * x, 2 * ahead - 0.3 * x])
    inside, held = expected_points(c, mask, points)
    assert inside.tolist() == [True, False, False, True] and held.tolist() == [
        True,
        False,
        False,
        False,
    ]
    mask[[0, -1]], mask[:, [0, -1]] = 0, 0
    assert expected_points(c, mask, points)[
        0
    ].all()  # all of it lies in the frame: where it does not, something is wrong

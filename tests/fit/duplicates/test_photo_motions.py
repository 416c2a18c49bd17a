"""Several photos of one pile: the motion between them, and what they show together."""

from __future__ import annotations

import numpy as np
import pytest

from relit.conventions import similarity
from relit.fit.duplicates.photo_motions import gather, motion_from
from relit.geometry.se3 import exp_so3, rotation_angle


def pile(count, seed=0):
    rng = np.random.default_rng(seed)
    places = [
        np.array([2.2 * (k % 4) - 3.3, 1.9 * (k // 4) - 2, 9 + 0.3 * rng.normal()])
        for k in range(count)
    ]
    return [similarity(exp_so3(rng.normal(size=3)), p) for p in places]


def seen(pile, first_from_photo, chosen, rng, noise=1.0):
    """photo_from_object with two degrees and a per cent of distance of error."""
    out = []
    for k in chosen:
        m = np.linalg.inv(first_from_photo) @ pile[k]
        turn = exp_so3(noise * np.radians(2) * rng.normal(size=3) / np.sqrt(3)) @ m[:3, :3]
        out.append(similarity(turn, m[:3, 3] * (1 + noise * 0.01 * rng.normal())))
    return out


ORBIT = similarity(exp_so3(np.array([0.1, 0.9, 0.2])), np.array([-7.0, 0.5, 3.0]))


def test_photos_are_related_and_instances_meet():
    rng, true = np.random.default_rng(3), pile(9)
    first, second = seen(true, np.eye(4), range(7), rng), seen(true, ORBIT, [8, 6, 5, 3, 2, 1], rng)
    scene = gather(np.array(first + second), np.array([0] * 7 + [1] * 6))
    assert scene.of_view.tolist() == [0, 1, 2, 3, 4, 5, 6, 7, 6, 5, 3, 2, 1]
    assert (
        rotation_angle(scene.motions[1][:3, :3].T @ ORBIT[:3, :3]) < 2 and len(scene.standing) == 8
    )
    both = [1, 2, 3, 5, 6]  # two photos tell the distance that one does not
    error = [np.linalg.norm(scene.standing[k][:3, 3] - true[k][:3, 3]) for k in both]
    alone = [np.linalg.norm(first[k][:3, 3] - true[k][:3, 3]) for k in both]
    assert np.mean(error) < np.mean(alone)


def test_one_object_in_several_photos_is_a_multi_view_capture():
    true = pile(1)
    views = [
        np.linalg.inv(similarity(exp_so3(np.array([0, 0.4 * k, 0])), np.array([0.5 * k, 0, 0])))
        @ true[0]
        for k in range(3)
    ]
    scene = gather(np.array(views), np.arange(3))
    assert all(m is not None for m in scene.motions) and scene.of_view.tolist() == [0, 0, 0]
    assert np.allclose(scene.motions[2] @ views[2], views[0])


def test_a_photo_of_something_else_is_not_related():
    rng = np.random.default_rng(4)
    scene = gather(
        np.array(seen(pile(5), np.eye(4), range(5), rng) + pile(5, seed=9)),
        np.array([0] * 5 + [1] * 5),
    )
    assert scene.motions[1] is None and len(scene.standing) == 5 and (scene.of_view[5:] == -1).all()


def test_motion_of_exact_poses_is_exact():
    true = pile(3)
    assert motion_from([np.linalg.inv(ORBIT) @ m for m in true], true) == pytest.approx(ORBIT)

"""A recovered pile laid on the true one: the scale about the camera, whatever frame and size the
object was given."""

import numpy as np
import pytest

from relit.conventions import similarity
from relit.evaluate.pile_alignment import grown_about, object_turn, scale_about
from relit.geometry.se3 import exp_so3

CENTRE, MIDDLE = np.array([1.0, 2.0, -3.0]), np.array([0.4, -0.2, 0.1])
FRAME = similarity(
    exp_so3(np.array([0.4, -1.1, 0.6])), np.array([0.3, 0.1, -0.2]), 1.7
)  # recovered from true object


def piles(scale, count=10, along=0.0, seed=0):
    """True poses, and the recovered ones: nearer to the camera by the scale, in another frame of
    the object, and each with an error along its line of sight, a part of its distance."""
    rng = np.random.default_rng(seed)
    true = {
        k: similarity(
            exp_so3(rng.normal(size=3)), CENTRE + np.array([0, 0, 12]) + rng.uniform(-3, 3, 3), 0.8
        )
        for k in range(count)
    }
    found = {
        k: grown_about(CENTRE, (1 + along * rng.normal()) / scale) @ p @ np.linalg.inv(FRAME)
        for k, p in true.items()
    }
    return found, true


def test_scale_and_middle_are_found_from_a_wrong_guess():
    found, true = piles(1.37)
    scale, own = scale_about(CENTRE, found, true, MIDDLE, np.array([0.2, 0.2, 0.2]))
    there = FRAME[:3, :3] @ MIDDLE + FRAME[:3, 3]
    assert scale == pytest.approx(1.37, rel=2e-4) and np.allclose(own, there, atol=0.004)


def test_distances_that_are_off_do_not_lead_it_astray():
    found, true = piles(1.37, along=0.001)
    found[3] = grown_about(CENTRE, 1.03) @ found[3]
    found[5] = found[5] @ similarity(exp_so3(np.array([0, 2.0, 0])), np.zeros(3))  # half a turn off
    guess = FRAME[:3, :3] @ MIDDLE + FRAME[:3, 3] + 0.05
    scale, _ = scale_about(CENTRE, found, true, MIDDLE, guess)
    assert scale == pytest.approx(1.37, rel=1e-3)


def test_one_instance_alone_takes_the_guess():
    found, true = piles(1.37, count=1)
    guess = FRAME[:3, :3] @ MIDDLE + FRAME[:3, 3]
    scale, own = scale_about(CENTRE, found, true, MIDDLE, guess)
    assert scale == pytest.approx(1.37, rel=1e-6) and np.allclose(own, guess)


def test_the_turn_is_that_of_most():
    found, true = piles(1.0)
    found[2] = found[2] @ similarity(exp_so3(np.array([0, 3.0, 0])), np.zeros(3))
    assert np.allclose(object_turn(found, true), FRAME[:3, :3] / 1.7, atol=1e-6)

"""SAMURAI's soft assignment: shares, their memory, and what takes part in a fit."""

import numpy as np

from relit.conventions import similarity
from relit.fit.registration.photos.multiplex import (
    Multiplex,
    expanded,
    shares_of,
    updated,
    with_refined,
)
from relit.fit.registration.register import Hypotheses
from relit.geometry.se3 import exp_so3


def turned(*degrees):
    """Poses turned about y by so many degrees."""
    return np.array(
        [similarity(exp_so3(np.array([0, np.radians(a), 0])), np.zeros(3)) for a in degrees]
    )


def found(angles, scores):
    return Hypotheses(
        turned(*angles)[None], np.array([scores], float), np.zeros((1, len(angles)), int)
    )


def test_shares_follow_scores_and_sharpen():
    scores = np.array([[0.95, 0.90, -1.0]])
    early, late = shares_of(scores, 1.0), shares_of(scores, 10.0)
    assert np.allclose(early, [[1 / (1 + np.exp(-1)), 1 / (1 + np.exp(1)), 0]])
    assert late[0, 0] > 0.999 and late[0, 2] == 0


def test_memory_outlives_one_bad_round():
    state = updated(None, found([0, 90], [0.95, 0.85]), 0.5)
    held = state.memory[0, 0]
    state = updated(
        state, found([92, 1], [0.93, 0.92]), 0.5
    )  # in another order, and the other one scores a little better
    assert state.memory[0, 1] > 0.6 and state.memory[0, 1] < held
    assert np.allclose(state.best, turned(1))
    for _ in range(8):
        state = updated(state, found([90, 0], [0.95, 0.85]), 0.5)
    assert state.memory[0, 0] > 0.9  # what goes on being better wins


def test_a_new_hypothesis_starts_with_its_share():
    state = updated(None, found([0, 90], [0.95, 0.94]), 0.0)
    state = updated(state, found([180, 0], [0.99, 0.80]), 0.0)
    assert np.allclose(state.memory.sum(1), 1) and state.memory[0, 0] > 0.3


def test_what_takes_part():
    memory = np.array([[0.6, 0.4, 0.0], [0.95, 0.04, 0.01]])
    state = Multiplex(
        np.stack([turned(0, 90, 180), turned(10, 100, 190)]), memory, np.zeros((2, 3))
    )
    crops, poses, shares = expanded(["a", "b"], state)
    assert (
        crops == ["a", "a", "b"]
        and np.allclose(shares, [0.6, 0.4, 0.95])
        and np.allclose(poses, turned(0, 90, 10))
    )
    refined = with_refined(state, np.stack([turned(84)[0], turned(12)[0]]))
    assert np.allclose(refined.poses[0], turned(0, 84, 180)) and np.allclose(
        refined.poses[1], turned(12, 100, 190)
    )


def test_without_the_multiplex_one_hypothesis_is_kept():
    from relit.fit.collection.options import CollectionOptions

    assert CollectionOptions(keep=4).hypotheses == 4
    assert CollectionOptions(keep=4, without=("multiplex",)).hypotheses == 1

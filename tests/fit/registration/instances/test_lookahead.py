"""One step ahead: the way of joining after which all others agree best."""

from __future__ import annotations

import numpy as np
import pytest

from relit.conventions import similarity
from relit.fit.registration.instances import growth as instance_growth
from relit.fit.registration.instances import lookahead as instance_lookahead
from relit.fit.registration.instances.growth import ahead, lead_over_second
from relit.fit.registration.instances.lookahead import branch_values, mean_of_known
from relit.fit.registration.instances.options import Growth
from relit.geometry.hull import NoShape
from relit.geometry.se3 import exp_so3


def pose(degrees):
    return similarity(exp_so3(np.array([0, np.radians(degrees), 0])), np.zeros(3))


def test_branches_are_compared_over_those_whom_they_leave_out(monkeypatch):
    """Instance 3 agrees little with anything: a branch that it is a member of must not gain by
    that."""
    told = {(0, 1): {2: 0.7, 3: 0.3}, (0, 2): {1: 0.8, 3: 0.4}, (0, 3): {1: 0.7, 2: 0.65}}
    monkeypatch.setattr(
        instance_lookahead,
        "heights_of",
        lambda v, c, r, p, members, poses, rest, o, seed, flipped, plane: [
            told[tuple(members)][k] for k in rest
        ],
    )
    branches = [([0, k], np.tile(np.eye(4), (4, 1, 1))) for k in (1, 2, 3)]
    value = branch_values([None] * 4, None, None, None, branches, Growth(), 0)
    # usual: 1 .75, 2 .675, 3 .35
    assert value == pytest.approx([(0.025 - 0.05) / 2, (0.05 + 0.05) / 2, (-0.05 - 0.025) / 2])


def test_a_branch_without_a_common_shape_is_never_taken(monkeypatch):
    def heights(v, c, r, p, members, poses, rest, o, seed, flipped, plane):
        if members == [0, 1]:
            raise NoShape("nothing in common")
        return np.full(len(rest), 0.2)

    monkeypatch.setattr(instance_lookahead, "heights_of", heights)
    poses = np.tile(np.eye(4), (3, 1, 1))
    value = branch_values(
        [None] * 3,
        None,
        None,
        None,
        [([0, 1], poses), ([0, 2], poses), ([0, 1, 2], poses)],
        Growth(),
        0,
    )
    assert value[0] == -np.inf and value[1] == 0 and value[2] == 0  # the last leaves nobody out


def test_means_of_what_is_known():
    a = np.array([[1.0, np.nan], [3.0, np.nan]])
    assert mean_of_known(a, 0)[0] == 2 and np.isnan(mean_of_known(a, 0)[1])


def test_who_joins_is_decided_by_what_becomes_of_the_others_and_by_its_lead(monkeypatch):
    places = np.array([[pose(0), pose(10)], [pose(90), pose(120)], [np.eye(4)] * 2])  # (K, R, 4, 4)
    heights = np.array([[0.9, 0.8], [0.78, 0.76], [-1.0, -1.0]])
    told, seen = np.array([0.0, 0.0, 0.2, 0.0]), []

    def values(views, crops, rings, parts, branches, o, seed, flipped, plane):
        seen.extend(branches)
        return told[: len(branches)]

    monkeypatch.setattr(instance_growth, "branch_values", values)
    poses, rest = np.tile(np.eye(4), (3, 1, 1)), [1, 2]
    rings = (None, None, None, None)
    assert lead_over_second(places[:, 0], heights[:, 0], 0) == pytest.approx(
        0.12
    ) and lead_over_second(places[:, 0], heights[:, 0], 1) == pytest.approx(-0.12)
    told[2] = 0.3
    assert ahead(*rings, [0], poses, rest, places, heights, Growth(), 0, None) == (
        1,
        0,
    )  # third by its score, best for the others
    assert [members for members, _ in seen] == [
        [0, 1],
        [0, 2],
        [0, 1],
        [0, 2],
    ]  # what was not found (-1) is not tried
    assert np.array_equal(seen[2][1][1], pose(90)) and np.array_equal(seen[2][1][2], np.eye(4))
    told[2] = (
        # what it is ahead by in the others' eyes is less than what it lags behind the best place of
        # its own
        0.2
    )
    assert ahead(*rings, [0], poses, rest, places, heights, Growth(), 0, None) == (0, 0)
    told[:2] = 0.0, 0.1
    assert ahead(*rings, [0], poses, rest, places, heights, Growth(ahead=2), 0, None) == (0, 1)
    drawn = {
        ahead(
            *rings, [0], poses, rest, places, heights, Growth(leap=0.2), 0, np.random.default_rng(s)
        )
        for s in range(60)
    }
    assert len(drawn) == 4
    nowhere = np.full((2, 1), -1.0)  # a search that finds nothing gives its first place
    assert ahead(*rings, [0, 2], poses, [1], places[:2, :1], nowhere, Growth(), 0, None) == (0, 0)
    count = len(seen)
    assert (
        ahead(*rings, [0, 2], poses, [1], places[:, :1], heights[:, :1], Growth(), 0, None)
        == (0, 0)
        and len(seen) == count
    )

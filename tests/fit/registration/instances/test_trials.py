"""Few identical objects are searched for several times: which search is believed."""

from types import SimpleNamespace

import numpy as np
import pytest

from relit.conventions import similarity
from relit.fit.registration.instances import trials as instance_trials
from relit.fit.registration.instances.options import Search
from relit.fit.registration.instances.trials import SAME, place_few, turned_apart
from relit.fit.registration.placements import all_placed
from relit.geometry.hull import NoShape
from relit.geometry.se3 import exp_so3


def poses(seed, count=6):
    return np.array(
        [
            similarity(exp_so3(w), np.zeros(3))
            for w in np.random.default_rng(seed).normal(size=(count, 3)) * 2
        ]
    )


def turned(some, by, only=None):
    """The poses in another frame of the object; and `only` the objects of these numbers by
    something of its own."""
    out = similarity(exp_so3(np.array(by)), np.zeros(3)) @ some
    for k in only or ():
        out[k] = similarity(exp_so3(np.array([0.0, 0.8, 0.0])), np.zeros(3)) @ out[k]
    return out


def test_a_turn_of_the_whole_is_no_difference():
    right = poses(0)
    assert turned_apart(right, turned(right, [0.4, 1.0, -2.0])) < 1e-4
    assert (
        abs(turned_apart(turned(right, [0.4, 1.0, -2.0], only=[1, 4]), right) - np.degrees(0.8))
        < 1e-4
    )
    assert turned_apart(right, poses(1)) > SAME


@pytest.fixture
def search(monkeypatch):
    """search(results, agreements, count) -> (poses, what was said, seeds): with what each search
    finds, or an error of its."""

    def run(results, agreements, count=6, sure=False, **options):
        said, seeds, left, told = [], [], list(results), list(agreements)

        def place(views, o, *, seed, links, say):
            seeds.append(seed)
            one = left.pop(0)
            if isinstance(one, Exception):
                raise one
            return all_placed(one, np.full(len(one), 0.9), sure)

        monkeypatch.setattr(instance_trials, "place", place)
        monkeypatch.setattr(
            instance_trials,
            "leave_out",
            lambda *_, **__: SimpleNamespace(own=np.full(count, told.pop(0))),
        )
        got = place_few([None] * count, Search(**options), seed=7, say=said.append)
        return got.poses, said, seeds

    return run


def test_two_searches_that_agree_are_believed_against_a_better_score(search):
    right, wrong = poses(0), turned(poses(0), [0, 0, 1.0], only=[1, 4])
    got, said, seeds = search([wrong, right, turned(right, [1.0, 0, 0])], [0.97, 0.95, 0.96])
    assert np.array_equal(got, turned(right, [1.0, 0, 0])) and len(set(seeds)) == 3
    assert "same poses" in said[-1]
    _, _, seeds = search([right, turned(right, [1.0, 0, 0])], [0.95, 0.95])
    assert len(seeds) == 2  # a third is not needed


def test_a_search_that_is_sure_of_all_places_is_not_repeated(search):
    got, said, seeds = search([poses(0)], [], sure=True)
    assert np.array_equal(got, poses(0)) and seeds == [7] and not said


def test_where_none_agree_the_best_is_taken_and_said(search):
    got, said, _ = search([poses(0), poses(1), poses(2)], [0.91, 0.95, 0.93])
    assert np.array_equal(got, poses(1)) and "no two of 3 searches" in said[-1]


def test_a_search_that_fails_is_no_end(search):
    got, said, seeds = search([NoShape("nothing"), poses(1), NoShape("nothing")], [0.95])
    assert np.array_equal(got, poses(1)) and len(seeds) == 3 and "no two of 3 searches" in said[-1]
    with pytest.raises(NoShape, match="nothing"):
        search([NoShape("nothing")] * 3, [])
    with pytest.raises(TypeError, match="a fault"):  # only that there is no shape is passed over
        search([TypeError("a fault"), poses(1), poses(1)], [])


def test_many_objects_and_two_are_searched_for_once(search):
    for count in (2, 9):
        _, said, seeds = search([poses(0, count)], [], count)
        assert seeds == [7] and not said
    assert search([poses(0)], [], descents=0)[2] == [7]  # an ablation
    assert search([poses(0)], [], searches=1)[2] == [7]  # draft

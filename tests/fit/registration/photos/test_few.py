"""Few photos: several ways to their poses, and the one that explains them best."""

import numpy as np
import pytest

from relit.geometry.hull import NoShape
from relit.geometry.se3 import camera_errors, exp_so3
from support.volume_lump import photos_of, volume_lump

pytest.importorskip("mitsuba")


@pytest.fixture(scope="module")
def photos():
    return photos_of(
        volume_lump(), 6, np.random.default_rng(4), turn=0.1
    )  # hints are of photos that are held upright


@pytest.fixture(scope="module")
def crops(photos):
    from relit.fit.registration.photos.poses import even_colours
    from relit.fit.registration.register import crop_photo

    return even_colours([crop_photo(*p) for p in photos])


def true_poses(photos):
    return np.array([c.world_from_camera for *_, c in photos])


def quiet(*_):
    """Says nothing."""


@pytest.mark.slow
def test_the_way_that_explains_the_photos_is_taken_unless_it_lost_some(photos, crops, monkeypatch):
    """Right poses have less misfit than wrong ones; ways that fail are passed over."""
    from relit.fit.registration.photos import few

    monkeypatch.setattr(few, "NODES", 32)
    monkeypatch.setattr(few, "STEPS", 60)
    right, said = true_poses(photos), []
    wrong = right[np.random.default_rng(3).permutation(len(right))]

    def fails():
        raise NoShape("nothing in common")

    for score, taken in ((0.95, right), (0.9, wrong)):
        ways = {
            "none": fails,
            "one": lambda: (wrong, np.full(len(crops), 0.99)),
            "two": lambda score=score: (right, np.full(len(crops), score)),
        }
        assert few.best_way(crops, ways, 0, said.append)[0] is taken
    misfits = [float(text.split()[-1]) for text in said if "misfit" in text]
    assert misfits[1] < 0.7 * misfits[0] and misfits[3] < 0.7 * misfits[2]
    assert said.count("none: nothing in common") == 2
    with pytest.raises(NoShape, match="nothing in common"):
        few.best_way(crops, {"no": fails}, 0, quiet)


@pytest.mark.parametrize(
    ("heights", "ends"), [((0.9, 0.92, 0.93), 2), ((0.9, 0.87, 0.88), 2), ((0.9, 0.91, 0.8), 1)]
)
def test_a_search_that_loses_photos_is_taken_back(monkeypatch, heights, ends):
    from relit.fit.registration.photos import few

    asked = []

    def polish(_, poses, *rest, **__):
        asked.append(poses)
        return poses + 1, np.full(6, heights[len(asked) - 1])

    monkeypatch.setattr(few, "polish", polish)
    poses, scores = few.polished([None] * 6, np.zeros((6, 4, 4)), None, 45.0, 1, 0, quiet, 3)
    assert len(asked) == 3 and (poses == ends + 1).all() and (scores == heights[ends]).all()


@pytest.mark.slow
def test_few_photos_end_nearer_than_their_hints(photos, crops):
    from relit.fit.registration.photos.few import few_from_hints
    from relit.fit.registration.photos.poses import pose_towards, schedule_of

    right, rng = true_poses(photos), np.random.default_rng(1)
    hints = np.array(
        [
            exp_so3(np.radians(15) * rng.normal(size=3) / np.sqrt(3))
            @ (p[:3, 3] / np.linalg.norm(p[:3, 3]))
            for p in right
        ]
    )
    begin = np.array([pose_towards(c, h) for c, h in zip(crops, hints, strict=True)])
    poses, scores = few_from_hints(crops, hints, 45.0, schedule_of(2), 1, 0, quiet, 1)
    before, after = camera_errors(begin, right)[0], camera_errors(poses, right)[0]
    assert np.mean(after) < 0.7 * np.mean(before) and scores.mean() > 0.85


@pytest.mark.parametrize(
    ("count", "hinted", "linked", "cycles", "few"),
    [
        (6, 6, False, 1, "hints"),
        (6, 0, False, 1, "growth"),
        (12, 0, False, 1, ""),
        (6, 4, False, 1, ""),
        (6, 6, True, 1, ""),
        (6, 6, False, 0, ""),
        (30, 30, False, 1, ""),
    ],
)
def test_which_photos_are_few(crops, monkeypatch, count, hinted, linked, cycles, few):
    """Photos of which some have hints, photos that matches link, and many photos go the one way."""
    from relit.fit.registration.photos import growth

    some, taken = (crops * 5)[:count], []
    poses, scores = np.tile(np.eye(4), (count, 1, 1)), np.ones(count)

    def way(name):
        return lambda *_, **__: (taken.append(name), (poses, scores))[1]

    for name in (
        "few_from_hints",
        "few_by_growth",
        "poses_from_hints",
        "poses_by_growth",
        "polish",
    ):
        said = {"few_from_hints": "hints", "few_by_growth": "growth"}.get(name, "")
        monkeypatch.setattr(growth, name, way(said))
    directions = np.zeros((count, 3))
    directions[:hinted] = [0, 0, 1]
    begun = (poses, scores, np.ones(count, bool)) if linked else None
    growth.find_poses(some, directions, 45.0, None, 1, 1, (), 0, quiet, cycles, begun)
    assert [t for t in taken if t] == ([few] if few else [])


def test_a_shape_seen_from_one_side_does_not_reach_far_behind(crops):
    """The search is told how deep the object may be; photos from all around are left to their
    outlines."""
    from relit.fit.registration.photos.depth import depth_limit
    from relit.fit.registration.photos.poses import coarse_model, gauge, pose_towards
    from relit.geometry.sdf import dense_values, node_positions

    turns = np.radians([-30, -10, 10, 30, 0, 15])
    poses = gauge(
        crops,
        np.array(
            [
                pose_towards(c, np.array([np.sin(a), 0.1, np.cos(a)]))
                for c, a in zip(crops, turns, strict=True)
            ]
        ),
    )
    p = node_positions(24)

    def depth(limit):
        inside = dense_values(coarse_model(crops, poses, 24, 10, 0.4, 0, limit).grid) < 0
        return np.ptp(p[inside][:, 2])

    assert depth(depth_limit(crops, poses, 24)) < 0.9 * depth(None)

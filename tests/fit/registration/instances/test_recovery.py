"""An instance that was left out, sought in the finished model of the others."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from relit.conventions import similarity
from relit.fit.duplicates.recover_unregistered import carried
from relit.fit.registration.instances import recovery as module
from relit.fit.registration.instances.azimuth_maps import turned_about
from relit.fit.registration.instances.outliers import view_errors
from relit.fit.registration.instances.recovery import sought_again
from relit.fit.registration.instances.views import (
    InstanceView,
    albedo_render,
    overlaps,
    pixel_bank,
)
from relit.fit.registration.register import (
    directions_around,
    make_galleries,
    views_from,
    volume_render,
)
from relit.geometry.se3 import rotation_angle
from relit.rendering.appearance.world_light import shade_world, start_world_light
from support.volume_lump import photos_of, volume_lump


def none(seed):
    """No galleries: places are given."""


def galleries_around(model, directions, distance):
    """As `galleries_of`, from a few directions (V, 3)."""
    views = views_from(directions, distance)
    return make_galleries(albedo_render(model), views, module.PLACED)


@pytest.fixture(scope="module")
def lump():
    """A model under an even light, and views of it with their poses; of the second the left half is
    hidden."""
    model = volume_lump()
    model.appearance = shade_world
    model.reflections, model.rates = start_world_light(0.3, 2)
    views, poses = [], []
    for number, (_, _, camera) in enumerate(photos_of(model, 2, np.random.default_rng(4))):
        rgb, mask = (a[0] for a in volume_render(model)([camera]))
        views.append(
            InstanceView(
                number,
                camera.with_pose(np.eye(4)),
                rgb * (1.0 - 0.4 * number),
                (mask > 0.5) * 1.0,
                np.ones_like(mask),
                1.0,
            )
        )
        poses.append(camera.world_from_camera)
    shown = np.arange(mask.shape[1]) > np.median(np.nonzero(mask > 0.5)[1])
    views[1] = replace(
        views[1], mask=mask * shown, known=np.broadcast_to(shown, mask.shape) * 1.0, seen=0.5
    )
    return model, views, np.array(poses)


@pytest.mark.slow
def test_it_is_found_though_half_of_it_is_hidden_and_it_stands_in_the_shade(lump, monkeypatch):
    model, (guide, hidden), poses = lump
    monkeypatch.setattr(module, "STEPS", 120)
    before = [np.array(a) for a in (model.grid.features, model.grid.row_values, model.reflections)]
    far = float(np.linalg.norm(poses[0, :3, 3]))

    @cache
    def galleries(seed):
        return galleries_around(model, directions_around(500, seed), far)

    level = (
        float(view_errors(pixel_bank([hidden], poses[:1]), model)[0]) / 80
    )  # a tenth of what it is at a wrong place agrees
    found, certain = sought_again(hidden, guide, poses[0], model, level, None, galleries)
    assert certain
    assert rotation_angle(found[:3, :3].T @ poses[1][:3, :3]) < 1.5
    assert np.linalg.norm(found[:3, 3] - poses[1][:3, 3]) < 0.1
    mirrored = replace(
        hidden, rgb=hidden.rgb[:, ::-1], mask=hidden.mask[:, ::-1], known=hidden.known[:, ::-1]
    )
    assert sought_again(mirrored, guide, poses[0], model, level, None, galleries) == (None, False)
    assert galleries.cache_info().hits == 1  # those of the first who was sought
    after = [np.array(a) for a in (model.grid.features, model.grid.row_values, model.reflections)]
    assert all(
        np.array_equal(a, b) for a, b in zip(before, after, strict=True)
    )  # the model itself stays


def apart(*degrees):
    """Places (K, 4, 4) turned by these degrees about one axis."""
    return np.array([turned_about(np.eye(4), np.radians(a)) for a in degrees])


@pytest.mark.parametrize(
    "errors, best, certain",
    [
        ([7.0, 15.0], 0, True),
        ([7.0, 13.0], 0, False),  # another place agrees nearly as well
        ([9.0, 30.0], 0, False),  # nothing agrees
        ([30.0, 3.0], 1, True),
    ],
)
def test_a_place_is_certain_where_it_alone_agrees(errors, best, certain):
    places = apart(0, 90)
    pose, sure = module.most_likely_pose(places, np.array(errors), 1.0)
    assert np.array_equal(pose, places[best]) and sure == certain


@pytest.mark.parametrize(
    "errors, taken",
    [
        ([11.0, 14.0], True),  # nearly certain
        ([18.0, 30.0], True),  # it leads clearly
        ([18.0, 26.0], False),  # it does not
        ([22.0, 60.0], False),  # it leads, but too far off
    ],
)
def test_which_places_are_worth_a_trial(errors, taken):
    assert module.worth_a_trial(apart(0, 90), np.array(errors), 1.0) == taken


def test_of_places_that_are_nearly_the_same_the_better_descent_counts():
    places = apart(5, 90, 0, 95)
    assert module.best_places(places, np.array([30.0, 26.0, 18.0, np.nan])) == [2, 1]
    # its neighbour is no rival of the best place
    assert module.most_likely_pose(places, np.array([3.0, 50.0, 2.0, 60.0]), 1.0)[1]


def test_places_count_whose_silhouettes_agree_about_as_well_as_the_best(lump):
    """What is in the wrong place by a fifth of its radius can still overlap by .95, and agree in
    colour by chance."""
    model, (guide, _), poses = lump
    shifted = poses[[0, 0, 0, 0]]
    shifted[:, 0, 3] += [0.006, 0.008, 0.013, 0.4]
    left = 1 - overlaps(volume_render(model), guide, shifted)
    assert left[1] < 1.5 * left[0] < left[2] < 0.05 and left[3] > 0.2, left
    errors = np.array([3.0, 2.0, 1.5, 1.0])
    found = module.where_outlines_agree(errors, guide, shifted, model)
    assert np.isfinite(found).tolist() == [True, True, False, False]
    assert not np.isfinite(module.where_outlines_agree(errors[3:], guide, shifted[3:], model)).any()


@pytest.mark.slow
def test_where_no_place_is_certain(lump, monkeypatch):
    """Other places are tried with other seeds; of a body of revolution the best place whose
    silhouette agrees is turned to what the others show."""
    model, (guide, _), poses = lump
    monkeypatch.setattr(module, "STEPS", 1)
    seeds, asked = [], []

    def near(seed):
        seeds.append(seed)
        far = np.linalg.norm(poses[:, :3, 3], axis=1)
        return galleries_around(model, poses[:, :3, 3] / far[:, None], far.mean())

    def turned(view, pose):
        asked.append((view, pose))
        return turned_about(pose, 0.3)

    nothing = 1e-9  # level of the errors with which nothing agrees
    rest = (guide, guide, poses[0], model)
    assert sought_again(*rest, nothing, None, near, 5) == (None, False) and seeds == [5, 6, 7]
    seeds.clear()
    found, sure = sought_again(*rest, nothing, None, near, 5, turned=turned)
    assert not sure and seeds == [5] and len(asked) == 1 and asked[0][0] is guide
    assert rotation_angle(asked[0][1][:3, :3].T @ poses[0][:3, :3]) < 5
    assert np.array_equal(found, turned_about(asked[0][1], 0.3))
    seeds.clear()  # hopeless: no guess is sought on
    assert sought_again(*rest, nothing, None, near, 5, guess=True) == (None, False)
    assert seeds == [5]


@pytest.mark.slow
def test_of_one_whose_axis_is_known_all_turns_are_tried_and_the_best_is_taken(lump, monkeypatch):
    model, (guide, hidden), poses = lump
    monkeypatch.setattr(module, "STEPS", 60)
    level = float(view_errors(pixel_bank([hidden], poses[:1]), model)[0]) / 40
    turned = turned_about(poses[1], 2.0)
    assert rotation_angle(turned[:3, :3].T @ poses[1][:3, :3]) > 100
    found, certain = sought_again(hidden, guide, poses[0], model, level, None, none, on_axis=turned)
    assert certain and rotation_angle(found[:3, :3].T @ poses[1][:3, :3]) < 6
    found, certain = sought_again(
        hidden, guide, poses[0], model, 1e-9 * level, None, none, on_axis=turned
    )  # nothing agrees: a guess
    assert not certain and found is not None


def test_poses_are_carried_along_with_those_that_passes_have_moved():
    rng = np.random.default_rng(0)
    before = np.array(
        [
            similarity(r, rng.standard_normal(3))
            for r in Rotation.random(6, random_state=1).as_matrix()
        ]
    )
    turn = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    after = np.array(
        [similarity(turn @ p[:3, :3], 1.2 * turn @ p[:3, 3] + [0.1, 0.2, -0.3]) for p in before]
    )
    there = carried({7: before[5]}, before[:5], after[:5])
    assert np.allclose(there[7], after[5])

"""An instance that was left out, sought in the finished model of the others."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from relit.conventions import similarity
from relit.fit.duplicates.recover_unregistered import carried
from relit.fit.registration.instances import recovery as module
from relit.fit.registration.instances.azimuth import turned_by
from relit.fit.registration.instances.azimuth_maps import turned_about
from relit.fit.registration.instances.outliers import view_errors
from relit.fit.registration.instances.recovery import sought_again
from relit.fit.registration.instances.views import InstanceView, overlaps, pixel_bank
from relit.fit.registration.register import volume_render
from relit.geometry.revolution_axis import Axis
from relit.geometry.se3 import rotation_angle
from relit.rendering.appearance.world_light import shade_world, start_world_light
from support.volume_lump import photos_of, volume_lump


def none(seed):
    """No galleries: places are given."""


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


def test_it_is_found_though_half_of_it_is_hidden_and_it_stands_in_the_shade(lump, monkeypatch):
    model, (guide, hidden), poses = lump
    monkeypatch.setattr(module, "VIEWPOINTS", 500)
    monkeypatch.setattr(module, "STEPS", 120)
    before = [np.array(a) for a in (model.grid.features, model.grid.row_values, model.reflections)]
    galleries = cache(partial(module.galleries_of, model, float(np.linalg.norm(poses[0, :3, 3]))))
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


def test_where_several_places_agree_it_stays_out(lump, monkeypatch):
    model, (guide, hidden), poses = lump
    turned = poses[[1, 1]]
    turned[1, :3] = np.diag([-1.0, 1.0, -1.0]) @ turned[1, :3]
    monkeypatch.setattr(module, "candidates", lambda *_: turned)
    for errors, out in (([1.0, 1.5], True), ([1.0, 3.0], False), ([9.0, 30.0], True)):
        monkeypatch.setattr(module, "refine_candidates", lambda *_, e=errors: (turned, np.array(e)))
        assert (sought_again(hidden, guide, poses[0], model, 1.0, None, none)[0] is None) == out


def test_of_a_body_of_revolution_the_best_place_whose_silhouette_agrees_is_turned(
    lump, monkeypatch
):
    model, (guide, _), poses = lump
    shifted = poses[[0, 0, 0]]
    shifted[1, :3, 3] += [0.4, 0.0, 0.0]
    shifted[2, :3, 3] += [0.01, 0.0, 0.0]
    shares = overlaps(volume_render(model), guide, shifted)
    assert shares[0] > 0.97 and shares[1] < 0.8 < shares[2]
    axis = Axis(np.array([0.1, 0.0, -0.2]), np.array([0.6, 0.8, 0.0]))
    tried = np.stack([turned_by(poses[0], axis, 1.01), shifted[1]])
    monkeypatch.setattr(module, "candidates", lambda *_: tried)
    monkeypatch.setattr(
        module, "refine_candidates", lambda *_: (tried, np.array([50.0, 20.0]))
    )  # nothing agrees, least where the outline does not
    monkeypatch.setattr(
        module, "overlaps", lambda render, _, some: np.where(np.arange(len(some)) % 2 > 0, 0.5, 1)
    )

    asked = []

    def turned(view, pose):
        asked.append(view)
        return turned_by(pose, axis, -1.01)

    found, sure = sought_again(guide, guide, poses[0], model, 1.0, None, none, turned=turned)
    assert np.allclose(found, poses[0]) and not sure and asked == [guide]
    assert sought_again(guide, guide, poses[0], model, 1.0, None, none) == (None, False), (
        "not a body of revolution"
    )
    monkeypatch.setattr(module, "overlaps", lambda render, view, some: np.full(len(some), 0.5))
    assert sought_again(guide, guide, poses[0], model, 1.0, None, none, turned=turned) == (
        None,
        False,
    )


def test_where_no_place_agrees_others_are_tried(lump, monkeypatch):
    _, (guide, hidden), poses = lump
    asked = []

    def found(errors_of_turn):
        asked.clear()

        def descended(*rest):
            asked.append(rest[-1])
            return poses[[1, 0]], np.array(errors_of_turn[len(asked) - 1])

        monkeypatch.setattr(module, "refine_candidates", descended)
        return sought_again(hidden, guide, poses[0], None, 1.0, None, none, 5)[0]

    monkeypatch.setattr(module, "candidates", lambda *_: poses[[1, 0]])
    assert np.array_equal(found([[20.0, 30.0], [3.0, 30.0]]), poses[1]) and asked == [5, 6]
    assert found([[20.0, 30.0]] * 3) is None and asked == [5, 6, 7]


@pytest.mark.parametrize(
    "first, then, taken, rounds",
    [
        ([20.0, 30.0], [11.0, 14.0], True, 1),  # nearly
        ([20.0, 30.0], [18.0, 30.0], True, 1),  # it leads clearly
        ([20.0, 30.0], [18.0, 26.0], False, 3),  # it does not
        ([30.0, 60.0], [22.0, 60.0], False, 3),  # it leads, but too far off
        ([20.0, 30.0], [7.0, 30.0], True, 1),  # certain by then
        ([45.0, 90.0], None, False, 1),  # nothing like it
        ([np.nan, np.nan], None, False, 1),  # no pixel is whole
    ],
)
def test_the_best_places_are_looked_into_where_none_is_certain(
    lump, monkeypatch, first, then, taken, rounds
):
    _, (guide, hidden), poses = lump
    asked = []

    def descended(view, guide, guide_pose, tried, model, turns, steps, seed):
        asked.append((steps, len(tried)))
        return tried, np.array(
            [*first, first[1] + 1, first[1] + 60] if steps == module.STEPS else then
        )

    turned = turned_about(poses[1], 0.1)  # of one place the better descent counts
    monkeypatch.setattr(
        module,
        "candidates",
        lambda *_: np.stack([poses[1], poses[0], turned_about(poses[0], 0.1), turned]),
    )
    monkeypatch.setattr(module, "refine_candidates", descended)
    pose, sure = sought_again(hidden, guide, poses[0], None, 1.0, None, none, 5, guess=True)
    assert asked == (
        [(module.STEPS, 4), (module.LONGER, 2)] * rounds if then else [(module.STEPS, 4)]
    )
    assert sure == (then is not None and then[0] < module.AGREES)
    assert pose is None if not taken else np.array_equal(pose, poses[1])


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


@pytest.mark.parametrize(
    "shared, there",
    [
        ([0.99, 0.986, 0.96], [1, 1, 0]),
        ([0.96, 0.951, 0.93], [1, 1, 0]),
        ([0.94, 0.93, 0.9], [0, 0, 0]),
    ],
)
def test_places_count_whose_silhouettes_agree_about_as_well_as_the_best(monkeypatch, shared, there):
    """What is in the wrong place by a fifth of its radius can still overlap by .95, and agree in
    colour by chance."""
    monkeypatch.setattr(module, "overlaps", lambda render, view, poses: np.array(shared))
    found = module.where_outlines_agree(np.array([3.0, 2.0, 1.0]), None, None, None)
    assert np.array_equal(np.isfinite(found), np.array(there, bool))

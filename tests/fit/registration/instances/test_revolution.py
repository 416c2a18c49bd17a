"""Bodies of revolution: axes from outlines, turns from decoration. The pictures are splatted
points, with nothing of what is tested."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from relit.conventions import similarity
from relit.fit.registration.instances import revolution_search as instance_revolution
from relit.fit.registration.instances import search as instance_search
from relit.fit.registration.instances.azimuth_maps import (
    AzimuthEstimate,
    cells_read,
    empty_board,
    turned_about,
)
from relit.fit.registration.instances.options import DETAILED, Search
from relit.fit.registration.instances.protrusions import (
    EMPTY,
    FILLED_OR_EMPTY,
    SHOWN,
    filled,
    turned_by_outline,
)
from relit.fit.registration.instances.regrowth import Placed
from relit.fit.registration.instances.revolution import KNOTS, OUTLINE, axis_of, drawn, leaning_back
from relit.fit.registration.instances.revolution_fit import (
    Revolved,
    adjusted_pose,
    crop_outline,
    leaning_the_other_way,
    refine_revolution,
    seats_of,
)
from relit.fit.registration.instances.revolution_search import (
    EXACT,
    LONGER,
    RevolvedPlaces,
    lies_on_plane,
    place_revolved,
)
from relit.fit.registration.instances.unrolled import (
    LATITUDES,
    ONE_VALUE,
    TURNS,
    one_value,
    pattern_cells,
    turned_by_decoration,
)
from relit.fit.registration.instances.views import InstanceView, instance_crops
from relit.fit.registration.placements import Status
from relit.fit.registration.register import crop_rings
from relit.geometry.se3 import rotation_angle
from relit.scene import Camera

SIDE, FOCAL, AWAY = 96, 190.0, 4.0
CAMERA = Camera(SIDE, SIDE, FOCAL, FOCAL, SIDE / 2, SIDE / 2, np.eye(4))
OPTIONS = Search(steps=20, nodes=28)


def bottle() -> tuple[np.ndarray, np.ndarray]:
    """Points (M, 3) and colours (M, 3) of a bottle with random blots."""
    y, a = np.linspace(-0.75, 0.75, 360), np.linspace(0, 2 * np.pi, 720, endpoint=False)
    r = np.interp(y, [-0.75, 0.15, 0.4, 0.75], [0.36, 0.36, 0.15, 0.15])
    side = np.stack(
        [r[:, None] * np.sin(a), np.broadcast_to(y[:, None], (360, 720)), r[:, None] * np.cos(a)],
        -1,
    )
    blots = gaussian_filter(
        np.random.default_rng(5).standard_normal((360, 720, 3)),
        (14, 22, 0),
        mode=("nearest", "wrap", "nearest"),
    )
    colour = np.where(blots > 0.35 * blots.std((0, 1)), 0.6, 0.15)
    ends = [
        np.stack([r0 * np.sin(a), np.full(720, h), r0 * np.cos(a)], -1)
        for h, most in ((-0.75, 0.36), (0.75, 0.15))
        for r0 in np.linspace(0, most, 80)
    ]
    ends = np.concatenate(ends)
    return np.concatenate([side.reshape(-1, 3), ends]), np.concatenate(
        [colour.reshape(-1, 3), np.full(ends.shape, 0.3)]
    )


def ellipsoid(*radii: float) -> tuple[np.ndarray, np.ndarray]:
    p = np.random.default_rng(0).standard_normal((120000, 3))
    p /= np.linalg.norm(p, axis=1, keepdims=True)
    return p * np.array(radii), 0.2 + 0.5 * (np.sin(9 * p) > 0)


def seen(points: np.ndarray, colours: np.ndarray, pose: np.ndarray, label: int) -> InstanceView:
    """The points before the camera, each over those behind it."""
    at = (points - pose[:3, 3]) @ pose[:3, :3]
    u, v = (np.floor(FOCAL * at[:, i] / at[:, 2] + SIDE / 2).astype(int) for i in (0, 1))
    nearest = np.lexsort((-at[:, 2], v * SIDE + u))  # of each pixel the last is the nearest
    rgb, mask = np.zeros((SIDE, SIDE, 3), np.float32), np.zeros((SIDE, SIDE), np.float32)
    rgb[v[nearest], u[nearest]], mask[v[nearest], u[nearest]] = colours[nearest], 1
    return InstanceView(label, CAMERA, rgb, mask, np.ones((SIDE, SIDE), np.float32), 1.0)


def pile(points, colours, count: int, seed: int) -> tuple[list[InstanceView], np.ndarray]:
    turns = Rotation.random(count, random_state=seed).as_matrix()
    poses = np.array([similarity(r, -AWAY * r @ np.array([0.02, -0.03, 1.0])) for r in turns])
    return [seen(points, colours, pose, k + 1) for k, pose in enumerate(poses)], poses


PROFILE = np.concatenate(
    [
        [-0.75, 0.75],
        np.interp(
            np.linspace(-0.75, 0.75, KNOTS), [-0.75, 0.15, 0.4, 0.75], [0.36, 0.36, 0.15, 0.15]
        ),
    ]
)  # of a bottle


@pytest.fixture(scope="module")
def shots():
    """Views of bottles, their crops and poses."""
    views, poses = pile(*bottle(), 7, 3)
    return views, instance_crops(views), poses


@pytest.fixture(scope="module")
def bottles(shots):
    """Views, crops and poses of bottles, what outlines make of a profile and poses that are nearly
    right, and seats."""
    views, crops, poses = shots
    outlines, rings = [crop_outline(c) for c in crops], crop_rings(crops, OUTLINE)
    tilt = similarity(Rotation.from_rotvec([0.06, 0.0, 0.04]).as_matrix(), np.zeros(3))
    begun = Revolved(1.05 * PROFILE, tilt @ poses, np.zeros(7))
    body = refine_revolution(outlines, rings, begun)
    return views, crops, poses, body, seats_of(crops, body)


@pytest.fixture(scope="module")
def told(bottles) -> AzimuthEstimate:
    """Their turns about the axis, by decoration."""
    views, _, _, body, seats = bottles
    return turned_by_decoration(views, body.profile, seats)["colour and brightness"]


def off_axis(pose: np.ndarray, truth: np.ndarray, sign: float) -> float:
    return float(np.degrees(np.arccos(np.clip(sign * axis_of(pose) @ axis_of(truth), -1, 1))))


def wrong_by(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(N,) degrees, after the one turn of the object that most agree on."""
    turn = [t[:3, :3] @ p[:3, :3].T for p, t in zip(found, truth, strict=True)]
    off = np.array([[rotation_angle(a.T @ b) for a in turn] for b in turn])
    return off[np.median(off, 1).argmin()]


def axes_off(found: np.ndarray, truth: np.ndarray) -> list[float]:
    """Degrees between axes that point the same way in all, or all the other way."""
    ways = ([off_axis(p, t, sign) for p, t in zip(found, truth, strict=True)] for sign in (1, -1))
    return min(ways, key=sum)


@pytest.mark.slow
def test_bottles_are_placed_by_outlines_and_decoration_without_a_search(shots):
    """Nothing but the views is given."""
    views, _, truth = shots
    said = []
    found = instance_search.place(views, OPTIONS, say=said.append)
    off, wrong = axes_off(found.poses, truth), wrong_by(found.poses, truth)
    assert np.median(off) < 4 and max(off) < 12, off
    unsure = found.having(Status.AXIS_ONLY)
    assert found.sure and (~unsure).sum() >= 4 and (wrong[~unsure] < 20).all(), (wrong, unsure)
    assert any("bodies of revolution" in text for text in said)
    assert not any("grown" in text for text in said)
    assert any("azimuths about the axis are uncertain" in text for text in said) == unsure.any()


@pytest.mark.slow
def test_outlines_tell_the_axes(bottles):
    _, _, poses, body, seats = bottles
    assert body.misfit < EXACT
    off = min(
        (
            [min(off_axis(p, t, sign) for p in some) for some, t in zip(seats, poses, strict=True)]
            for sign in (1, -1)
        ),
        key=sum,
    )
    assert np.median(off) < 4 and max(off) < 12, off
    assert np.median([len(some) for some in seats]) <= 2


@pytest.mark.slow
def test_decoration_tells_the_turns_about_them(bottles, told):
    off = wrong_by(told.poses, bottles[2])
    assert (off < 12).sum() >= 5, off
    assert (off[told.sure] < 20).all(), (
        off,
        told.sure,
    )  # those that say that they are sure are right
    assert told.sure.sum() >= 4, told.sure


@pytest.mark.slow
def test_a_pose_that_is_off_comes_back_to_its_outline(bottles):
    _, crops, _, body, _ = bottles
    for crop, pose in zip(crops[:4], body.poses, strict=False):
        outline, tilted = crop_outline(crop), pose.copy()
        tilt = Rotation.from_rotvec(np.radians([0.0, 0.0, 6.0])).as_matrix()
        tilted[:3] = np.concatenate([tilt @ pose[:3, :3], (tilt @ pose[:3, 3:])], 1)
        before = float(
            ((outline.weights(r := outline.residual(body.profile, tilted)) * r) ** 2).sum()
        )
        back, level = adjusted_pose(outline, body.profile, tilted)
        assert level < 0.3 * before
        assert (
            np.degrees(np.arccos(axis_of(back) @ axis_of(pose))) < 5
        )  # shortening by a tilt is nearly that by distance


@pytest.mark.slow
def test_an_axis_that_leans_the_other_way_has_nearly_the_same_outline(bottles):
    *_, body, _ = bottles
    turn = Rotation.random(random_state=4).as_matrix()
    pose = similarity(turn, turn @ np.array([0, 0, -150.0]))
    other, again = leaning_back(pose), leaning_back(leaning_back(pose))
    assert np.allclose(axis_of(again), axis_of(pose), atol=1e-9)
    assert (
        np.isclose(axis_of(other)[2], -axis_of(pose)[2], atol=1e-9) and abs(axis_of(pose)[2]) > 0.2
    )
    a, b = (
        drawn(body.profile, Camera(SIDE, SIDE, 6000.0, 6000.0, SIDE / 2, SIDE / 2, p)) > 0.5
        for p in (pose, other)
    )
    assert a.sum() > 500 and (a ^ b).sum() < 0.03 * a.sum()


@pytest.mark.slow
@pytest.mark.parametrize("radii", [(0.8, 0.55, 0.3), (0.7, 0.7, 0.7)], ids=["lopsided", "ball"])
def test_what_has_no_axis_is_not_sure_of_it(radii):
    """Ellipses are the outlines of a body of revolution too: what is not sure of its turns is left
    to the search."""
    views, _ = pile(*ellipsoid(*radii), 4, 1)
    found = place_revolved(views, instance_crops(views), OPTIONS)
    assert found is None or (not found.certain and len(found.placed.unsure) > len(views) / 2)


def test_two_maps_of_one_decoration_are_laid_on_each_other():
    rng = np.random.default_rng(2)
    values = gaussian_filter(rng.standard_normal((1, LATITUDES, TURNS)), (0, 1.5, 2), mode="wrap")
    values /= values.std()
    shown = np.ones((LATITUDES, TURNS), bool)
    shown[:, 70:] = False
    board = empty_board(ONE_VALUE, (LATITUDES, TURNS))
    board.lay(pattern_cells(shown, values), 0)
    before = board.total.copy()
    gains = board.gains(pattern_cells(np.roll(shown, -17, 1), np.roll(values, -17, 2)))
    assert gains.argmax() == 17 and gains.max() > 3 * np.sort(gains)[-12]
    board.lay(pattern_cells(shown, values), 31)
    board.lay(pattern_cells(shown, values), 31, -1)
    assert np.allclose(board.total, before)


@pytest.mark.parametrize(
    "evidence, summed, values",
    [
        (ONE_VALUE, one_value, np.linspace(-2, 2, 9)),
        (FILLED_OR_EMPTY, lambda _, total: filled(total), [SHOWN, EMPTY]),
    ],
    ids=["decoration", "outline"],
)
def test_what_a_shifted_map_gains_is_the_change_of_the_evidence(evidence, summed, values):
    rng, rows, turns = np.random.default_rng(3), 5, 12
    board = empty_board(evidence, (rows, turns))

    def some(count):
        row, column = np.divmod(rng.choice(rows * turns, count, replace=False), turns)
        weights = rng.uniform(0.2, 1, count)
        return cells_read(
            evidence, (rows, turns), row, column, rng.choice(values, count), weights
        ), weights

    for turn, count in enumerate((30, 20, 25)):
        board.gains(some(4)[0])  # asked before it has changed
        board.lay(some(count)[0], turn)
    one, weights = some(22)
    before = summed(board.count, board.total)
    for turn, gain in enumerate(board.gains(one)):
        at = one.row, (one.column + turn) % turns
        more = summed(board.count[at] + 1, board.total[at] + one.values) - before[at]
        assert np.isclose(gain, weights @ more, atol=1e-9)


@pytest.mark.slow
def test_a_turn_about_the_axis_leaves_the_axis(bottles):
    pose = bottles[3].poses[0]
    turned = turned_about(pose, 0.7)
    assert np.allclose(axis_of(turned), axis_of(pose)) and np.isclose(
        rotation_angle(turned[:3, :3] @ pose[:3, :3].T), np.degrees(0.7)
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "short, long, told, asked",
    [
        ({"a": 0.75, "b": 0.74, "c": 0.6}, {"a": 0.7, "b": 0.76}, "b", 5),
        ({"a": 0.75, "b": 0.6, "c": 0.5}, {}, "a", 3),
        ({"a": -np.inf, "b": -np.inf}, {}, None, 2),
        ({}, {}, None, 0),
    ],
    ids=["close", "clear", "none agrees", "no answer"],
)
def test_between_answers_that_come_close_longer_fits_decide(monkeypatch, short, long, told, asked):
    fits = []

    def agreement(views, crops, poses, o, seed, steps):
        fits.append(steps)
        return (short if steps == 2 * o.steps else long)[poses]

    monkeypatch.setattr(instance_revolution, "decoration_agreement", agreement)
    assert (
        instance_revolution.most_likely_set(None, None, {name: name for name in short}, OPTIONS, 0)
        == told
    )
    assert len(fits) == asked
    assert max(fits, default=2 * OPTIONS.steps) == (LONGER if long else 1) * 2 * OPTIONS.steps


def revolved(firm: int, **fields) -> RevolvedPlaces:
    """Seven objects, the last `firm` of which are sure of their turn."""
    ids = tuple(range(7))
    poses = standing_on_a_plane(7, 0.1)
    placed = Placed(poses, np.full(7, 0.9), ids[7 - firm :], ids[: 7 - firm], DETAILED)
    return RevolvedPlaces(placed, **{"axes": True, "certain": True, **fields})


@pytest.mark.parametrize(
    "firm, deferred, said",
    [
        (7, [], ""),
        (5, [0, 1], "2 of 7 azimuths about the axis are uncertain: deferred"),
        (3, [], "4 of 7 azimuths about the axis are uncertain: their decoration"),
    ],
)
def test_uncertain_azimuths_are_deferred_where_most_are_certain(firm, deferred, said):
    told = []
    found = instance_search.by_axes(revolved(firm).placed, told.append)
    assert np.flatnonzero(found.having(Status.AXIS_ONLY)).tolist() == deferred
    assert (said in told[0] and len(told) == 1) if said else not told


@pytest.mark.parametrize(
    "firm, fields, searched",
    [
        (7, {}, False),
        (0, {}, False),  # on one plane: sure of the axes
        (0, {"certain": False}, True),
    ],
)
def test_bodies_of_revolution_keep_their_axes_and_are_searched_where_nothing_is_certain(
    shots, monkeypatch, firm, fields, searched
):
    """With a search that finds nothing."""
    told, asked = revolved(firm, **fields), []
    monkeypatch.setattr(instance_search, "place_revolved", lambda *_, **__: told)
    monkeypatch.setattr(instance_search, "grown_from_pairs", lambda *_, **__: asked.append(1))
    found = instance_search.place(shots[0], OPTIONS)
    assert np.array_equal(found.poses, told.placed.poses) and bool(asked) == searched


@pytest.mark.slow
@pytest.mark.parametrize("right", [True, False])
def test_turns_of_matches_and_of_axes_are_compared(shots, right):
    """Guessed turns do not replace matches that decoration bears out; wrong matches do not replace
    right turns. Outlines are the same in both."""
    views, crops, poses = shots[:3]
    about_axis = [
        similarity(Rotation.from_rotvec([0, a, 0]).as_matrix(), np.zeros(3))
        for a in np.random.default_rng(2).uniform(0.8, 5.5, len(poses))
    ]
    wrong = np.array([turn @ p for p, turn in zip(poses, about_axis, strict=True)])
    linked, guessed = (poses, wrong) if right else (wrong, poses)
    links = [
        (i, j, linked[j][:3, :3].T @ linked[i][:3, :3])
        for i in range(len(poses))
        for j in range(i + 1, len(poses))
    ]
    revolved = Placed(guessed, np.ones(len(poses)), (), tuple(range(len(poses))), DETAILED)
    said: list[str] = []
    found = instance_search.better_by_matches(
        views, crops, revolved, OPTIONS, seed=0, links=links, say=said.append
    )
    assert (found is not None) == right, said
    assert f"those by {'matches' if right else 'axes'} are kept" in said[0]


def standing_on_a_plane(count: int, off: float) -> np.ndarray:
    """Poses (count, 4, 4) of objects in any turn whose middles lie on a plane that leans, but for
    `off` along the line of sight."""
    rng = np.random.default_rng(8)
    x, y = rng.uniform(-2.5, 2.5, (2, count))
    middles = np.stack([x, y, 9 + 0.5 * y + off * rng.standard_normal(count)], -1)
    return np.array(
        [
            similarity(r, -r @ m)
            for r, m in zip(
                Rotation.random(count, random_state=2).as_matrix(), middles, strict=True
            )
        ]
    )


def test_a_plane_that_the_middles_lie_on_is_seen_whatever_their_turns():
    assert lies_on_plane(standing_on_a_plane(10, 0.2)) and not lies_on_plane(
        standing_on_a_plane(10, 1.0)
    )
    assert not lies_on_plane(
        standing_on_a_plane(5, 0.0)
    )  # any three points have a plane, and of five little is left to tell


# ---------------------------------------------------------------- what has a handle


def cup() -> tuple[np.ndarray, np.ndarray]:
    """Points (M, 3) and colours (M, 3) of a cup with a handle on one side and the same stripe at
    every quarter turn."""
    y, a = np.linspace(-0.5, 0.5, 300), np.linspace(0, 2 * np.pi, 720, endpoint=False)
    r = np.interp(y, [-0.5, -0.4, 0.5], [0.3, 0.33, 0.6])
    side = np.stack(
        [r[:, None] * np.sin(a), np.broadcast_to(y[:, None], (300, 720)), r[:, None] * np.cos(a)],
        -1,
    ).reshape(-1, 3)
    stripes = np.where(np.cos(4 * np.arctan2(side[:, 0], side[:, 2])) > 0.7, 0.2, 0.7)
    ends = [
        np.stack([r0 * np.sin(a), np.full(720, h), r0 * np.cos(a)], -1)
        for h, most in ((-0.5, 0.3), (0.5, 0.6))
        for r0 in np.linspace(0, most, 90)
    ]
    t, u = np.meshgrid(np.linspace(-np.pi / 2, np.pi / 2, 200), np.linspace(0, 2 * np.pi, 60))
    arm = 0.28 + 0.06 * np.cos(u)  # half a torus, in the plane of the axis
    handle = np.stack([0.06 * np.sin(u), arm * np.sin(t), 0.5 + arm * np.cos(t)], -1).reshape(-1, 3)
    points = np.concatenate([side, *ends, handle])
    grey = np.concatenate([stripes, np.full(720 * 180, 0.7), np.full(len(handle), 0.7)])
    return points, np.repeat(grey[:, None], 3, 1)


CUP = np.concatenate(
    [[-0.5, 0.5], np.interp(np.linspace(-0.5, 0.5, KNOTS), [-0.5, -0.4, 0.5], [0.3, 0.33, 0.6])]
)  # its profile


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 4])
def test_a_handle_tells_the_turns_front_and_back(seed):
    """Of axes that are right to a few degrees. Those who hide the handle, or show it before the
    body, are not sure."""
    views, poses = pile(*cup(), 10, seed)
    rng = np.random.default_rng(1)
    shaken = [
        similarity(
            r := Rotation.from_rotvec(0.03 * x).as_matrix() @ p[:3, :3], r @ p[:3, :3].T @ p[:3, 3]
        )
        for p, x in zip(poses, rng.standard_normal((10, 3)), strict=True)
    ]
    told = turned_by_outline(
        views,
        CUP,
        np.array([turned_about(p, a) for p, a in zip(shaken, rng.uniform(0, 6, 10), strict=True)]),
    )
    off = wrong_by(told.poses, poses)
    assert told.sure.sum() >= 5 and (off[told.sure] < 15).all(), (off, told.sure)


@pytest.mark.slow
def test_without_a_handle_outlines_tell_no_turns(bottles):
    views, *_, body, _ = bottles
    assert turned_by_outline(views, body.profile, body.poses) is None


@pytest.mark.slow
def test_axes_that_all_lean_the_wrong_way_come_back(bottles):
    """From afar all outlines together are the same so; perspective tells."""
    _, crops, _, body, _ = bottles
    outlines, rings = [crop_outline(c) for c in crops], crop_rings(crops, OUTLINE)
    wrong = Revolved(
        body.profile, np.array([leaning_back(p) for p in body.poses]), np.full(len(crops), 0.01)
    )
    assert np.median([off_axis(a, b, 1) for a, b in zip(wrong.poses, body.poses, strict=True)]) > 20
    back = refine_revolution(outlines, rings, leaning_the_other_way(outlines, wrong))
    assert back.misfit < 1.5 * body.misfit
    assert np.median([off_axis(a, b, 1) for a, b in zip(back.poses, body.poses, strict=True)]) < 5

"""Photos without hints: pairs that find each other, the set that they hold together, and growth
from it."""

import numpy as np
import pytest

from relit.geometry.se3 import exp_so3, look_at, rotation_angle
from support.volume_lump import volume_lump

pytest.importorskip("mitsuba")


def told(rotations, near, seed=0):
    """scores (P, P, 3), rotations (P, P, 3, 3, 3): what photos within `near` degrees of each other
    would find, at first place in two of three cases and at second place else, and anything for the
    others."""
    rng, count = np.random.default_rng(seed), len(rotations)
    scores, found = (
        np.sort(rng.uniform(0.8, 0.9, (count, count, 3)))[..., ::-1].copy(),
        np.zeros((count, count, 3, 3, 3)),
    )
    for i in range(count):
        for j in range(count):
            found[i, j] = [exp_so3(rng.normal(size=3) * 2) for _ in range(3)]
            between = rotation_angle(rotations[i].T @ rotations[j])
            if i != j and between < near:
                k = int(rng.random() < 0.3)
                found[i, j, k] = rotations[i].T @ rotations[j] @ exp_so3(rng.normal(size=3) * 0.08)
                scores[i, j] += 0.06 * (1 - between / near)
    return scores, found


def test_mutual_pairs_hold_a_set_together():
    from relit.fit.registration.photos.pairs import largest_consistent_set, mutual_pairs

    rng = np.random.default_rng(1)
    directions = rng.normal(size=(24, 3)) + np.array([0, 0.6, 1.2])
    rotations = np.array([look_at(3 * d / np.linalg.norm(d))[:3, :3] for d in directions])
    pairs = mutual_pairs(*told(rotations, 60))
    assert (np.diff([p.score for p in pairs]) <= 0).all()
    right = [
        rotation_angle(p.rotation.T @ rotations[p.first].T @ rotations[p.second]) < 25
        for p in pairs
    ]
    assert np.mean(right[:15]) > 0.9 and not all(right)  # chance makes pairs too
    placed = largest_consistent_set(pairs, 24)
    assert len(placed) >= 8
    first = min(placed)
    off = [
        rotation_angle((placed[first].T @ placed[k]).T @ rotations[first].T @ rotations[k])
        for k in placed
    ]
    assert np.mean(np.array(off) < 25) > 0.85
    assert largest_consistent_set([], 24) == {}


def test_a_photo_is_placed_with_its_silhouette_in_the_middle():
    from relit.fit.registration.photos.pairs import placed_towards
    from relit.fit.registration.photos.poses import SPREAD
    from relit.fit.registration.register import crop_photo, moments

    mask = np.zeros((60, 80), np.float32)
    mask[10:30, 50:70] = 1  # off the middle
    from relit.scene import Camera

    crop = crop_photo(
        np.full((60, 80, 3), 0.5, np.float32),
        mask,
        Camera(80, 60, 90.0, 90.0, 40.0, 30.0, np.eye(4)),
    )
    turn = exp_so3(np.array([0.3, -0.5, 0.2]))
    pose = placed_towards(crop, turn)
    u, v, depth = Camera(80, 60, 90.0, 90.0, 40.0, 30.0, pose).project(np.zeros((1, 3)))[0]
    assert np.allclose(pose[:3, :3], turn) and abs(u - 60) < 0.5 and abs(v - 20) < 0.5
    assert depth == pytest.approx(SPREAD * 90 / moments(mask[None])[1][0], rel=0.05)


def test_upright_photos_tell_how_the_others_are_held():
    from types import SimpleNamespace

    from relit.fit.registration.photos.growth import ROLL, TURNS, UPRIGHT, rolls, upright_prior

    poses = np.array(
        [
            look_at(np.array(eye), roll=roll)
            for eye, roll in (([0, 1, 3.0], 0), ([2, -1, 1.0], 0.4), ([-3, 0, 1.0], np.pi))
        ]
    )
    assert np.allclose(rolls(poses), [0, np.degrees(0.4), 180], atol=1e-4)
    views = [SimpleNamespace(centre=np.array(c)) for c in ([0, 0, 3.0], [0, 3.0, 0])]
    prior = upright_prior(SimpleNamespace(cameras=views))
    assert (
        prior.shape == (2, TURNS) and prior[0, 0] == 0 and np.abs(prior[1]).max() < 1e-12
    )  # from above any turn will do
    assert prior[0].min() == pytest.approx(-4 * UPRIGHT)
    assert prior[0, round(TURNS * ROLL / 360)] == pytest.approx(-UPRIGHT, rel=0.01)


def photos_in_front(eyes, rng):
    """Photos of a lump with features, from near-by viewpoints, as `crop_photo` takes them."""
    from relit.fit.registration.register import volume_render
    from relit.scene import Camera

    model, out = volume_lump(), []
    for eye in eyes:
        camera = Camera(
            120,
            120,
            150.0,
            150.0,
            60.0,
            60.0,
            look_at(np.array(eye), roll=rng.uniform(-0.15, 0.15)),
        )
        rgb, alpha = (a[0] for a in volume_render(model)([camera]))
        out.append((rgb * rng.uniform(0.7, 1.4, 3).astype(np.float32), alpha, camera))
    return out


def test_a_set_grows_to_all_photos(monkeypatch):
    """Every round takes more photos, the best; only viewpoints around the set are trusted; photos
    that are upright tell of the others."""
    from types import SimpleNamespace

    from relit.fit.registration.photos import growth

    eyes = [[3 * np.sin(a), 0.4, 3 * np.cos(a)] for a in np.linspace(-1.0, 1.0, 9)]
    right = np.array([look_at(np.array(e)) for e in eyes])
    rounds = []

    def search(crops, gallery, keep, *, rings, allowed, prior):
        rounds.append((allowed, prior))
        return SimpleNamespace(poses=right[:, None], scores=None)

    def refine(crops, poses, render, **_):
        return poses, np.linspace(0.9, 0.5, 9)  # the last photos match worst

    for name, stand_in in {
        "coarse_model": lambda *_: None,
        "fit_with_free_poses": lambda some, poses, *_: (SimpleNamespace(), poses),
        "replace": lambda model, **_: model,
        "volume_render": lambda _: None,
        "make_gallery": lambda render, views, parts: SimpleNamespace(cameras=views),
        "gauge": lambda crops, poses: poses,
        "depth_limit": lambda *_: None,
        "search": search,
        "refine": refine,
    }.items():
        monkeypatch.setattr(growth, name, stand_in)
    said = []
    poses, scores = growth.grow_set(
        [None] * 9, right, [0, 1, 2, 3, 4, 5], 0, lambda text, *_: said.append(text[18:24]), None
    )
    assert (
        said == ["6 of 9", "6 of 9", "6 of 9", "8 of 9", "9 of 9", "9 of 9"]
        and np.array_equal(poses, right)
        and scores[0] == 0.9
    )
    before, after = rounds[0][0][0].mean(), rounds[-1][0][0].mean()
    assert 0.1 < before < after < 0.6 and all(prior is not None for _, prior in rounds)
    rounds.clear()
    turned = np.array(
        [
            p @ np.block([[exp_so3(np.array([0, 0, i * 0.7])), np.zeros((3, 1))], [0, 0, 0, 1]])
            for i, p in enumerate(right)
        ]
    )
    growth.grow_set([None] * 9, turned, [0, 1, 2, 3, 4, 5], 0, lambda *_: None, None)
    assert rounds[0][1] is None  # held anyhow: they tell nothing


def test_depth_is_bounded_while_all_look_from_one_side():
    from relit.fit.registration.photos.growth import depth_limit
    from relit.fit.registration.photos.poses import even_colours, gauge
    from relit.fit.registration.register import crop_photo

    eyes = ([0.3, 0.5, 3.0], [-0.6, 0.3, 3.0], [0.2, -0.6, 3.0], [0, 0, -3.0])
    photos = photos_in_front(eyes, np.random.default_rng(0))
    crops = even_colours([crop_photo(*p) for p in photos])
    poses = gauge(crops, np.array([c.world_from_camera for *_, c in photos]))
    inside = depth_limit(crops[:3], poses[:3], 24)
    assert inside.shape == (24, 24, 24)
    from relit.geometry.sdf import node_positions

    assert (
        0.3 < np.ptp(node_positions(24)[inside][:, 2]) < 1.4
    )  # the lump is 1.2 deep, the sphere that it is in 2
    assert depth_limit(crops, poses, 24) is None


@pytest.mark.slow
def test_solids_of_single_photos_find_their_neighbours():
    """Photos a few degrees apart find each other through the solid of one silhouette."""
    from relit.fit.registration.photos.growth import PARTS
    from relit.fit.registration.photos.pairs import pairs_of
    from relit.fit.registration.photos.poses import even_colours
    from relit.fit.registration.register import crop_photo, crop_rings

    photos = photos_in_front(
        [[0.3, 0.5, 3.0], [-0.6, 0.3, 3.0], [0.2, -0.6, 3.0]], np.random.default_rng(0)
    )
    crops = even_colours([crop_photo(*p) for p in photos])
    pairs = pairs_of(crops, crop_rings(crops, PARTS), PARTS, 0, nodes=24)
    turns = [
        photos[p.first][2].world_from_camera[:3, :3].T
        @ photos[p.second][2].world_from_camera[:3, :3]
        for p in pairs
    ]
    assert len(pairs) >= 2
    assert (
        np.mean([rotation_angle(p.rotation.T @ t) < 25 for p, t in zip(pairs, turns, strict=True)])
        > 0.6
    )


@pytest.mark.parametrize(
    ("photos", "held", "begins"), [(14, 8, "set"), (14, 4, "photo"), (9, 8, "photo")]
)
def test_growth_begins_from_pairs_where_they_hold_enough(monkeypatch, photos, held, begins):
    """Each of the first `held` photos finds the next two as they stand."""
    from relit.fit.registration.photos import growth
    from relit.fit.registration.photos.pairs import RelativePose
    from relit.fit.registration.register import crop_photo

    shots = photos_in_front([[0.3, 0.5, 3.0], [-0.6, 0.3, 3.0]], np.random.default_rng(0))
    crops, asked, grown = ([crop_photo(*p) for p in shots] * 7)[:photos], [], []
    pairs = [
        RelativePose(0.9, i, j, exp_so3(np.array([0, 0.3 * (j - i), 0])))
        for i in range(held)
        for j in (i + 1, i + 2)
        if j < held
    ]
    done = (np.tile(np.eye(4), (photos, 1, 1)), np.full(photos, 0.9))
    monkeypatch.setattr(growth, "pairs_of", lambda *_: asked.append(1) or pairs)
    monkeypatch.setattr(
        growth,
        "grow_set",
        lambda crops, poses, used, *_: grown.append(("set", used, poses)) or done,
    )
    monkeypatch.setattr(growth, "grow_photos", lambda *_: grown.append(("photo",)) or done)
    monkeypatch.setattr(growth, "settle_photos", lambda *_: done)
    said = []
    growth.poses_by_growth(crops, 1, 1, 0, said.append)
    assert grown[0][0] == begins and bool(asked) == (photos >= 12)
    if begins == "set":
        ((_, used, poses),) = grown
        assert used == list(range(8)) and said == ["pairs hold 8 of 14 photos together"]
        between = poses[0, :3, :3].T @ poses[7, :3, :3]
        assert rotation_angle(between) == pytest.approx(np.degrees(2.1), abs=1)

"""Matches between photos as evidence: pycolmap on rendered photos, groups in the object's frame,
votes; and photos that the frame cuts."""

from dataclasses import replace

import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")


def texture_ball(direction, side=220, field=1.1):
    """(rgb, mask, world_from_camera, focal): a ball with a fine pattern, seen from `direction` at
    distance 3. field: focal length over side."""
    from relit.geometry.se3 import look_at

    pose = look_at(np.asarray(direction) / np.linalg.norm(direction) * 3)
    focal = side * field
    x, y = np.meshgrid(
        (np.arange(side) + 0.5 - side / 2) / focal, (np.arange(side) + 0.5 - side / 2) / focal
    )
    d = np.stack([x, y, np.ones_like(x)], -1)
    d = d / np.linalg.norm(d, axis=-1, keepdims=True) @ pose[:3, :3].T
    o = pose[:3, 3]
    b = d @ o
    root = b * b - (o @ o - 1)
    hit = root > 0
    p = o + d * (-b - np.sqrt(np.maximum(root, 0)))[..., None]
    rng = np.random.default_rng(0)
    centres = rng.normal(size=(500, 3))
    centres /= np.linalg.norm(centres, axis=1, keepdims=True)
    shades = rng.uniform(0.05, 0.9, (500, 3))
    rgb = np.zeros((side, side, 3), np.float32)
    rgb[hit] = shades[(p[hit] @ centres.T).argmax(1)]
    return rgb, hit.astype(np.float32), pose, focal


def arc(count, step=14.0):
    a = np.radians(step) * np.arange(count)
    return np.stack([np.sin(a), 0.25 * np.cos(2 * a), np.cos(a)], 1)


@pytest.mark.slow
def test_photos_of_one_ball_are_linked_whatever_their_light(tmp_path):
    pytest.importorskip("pycolmap")
    from relit.cameras.links import link_photos
    from relit.geometry.se3 import camera_errors

    shots = [texture_ball(d, 260) for d in arc(8, 9.0)]
    lights = np.random.default_rng(2).uniform(0.5, 1.5, (8, 3))
    noise = np.random.default_rng(3).uniform(0, 1, (9, 260, 260, 3)).astype(np.float32)
    photos = [
        (s[0] * light + n * (1 - s[1][..., None]), s[1], s[3])
        for s, n, light in zip(shots, noise, lights, strict=False)
    ]
    photos.append((noise[8], shots[0][1], 0.0))  # something else within the same outline
    said = []
    groups = link_photos(photos, tmp_path / "links", 1, said.append)
    assert (
        len(groups) >= 1 and set(groups[0].photos) <= set(range(8)) and len(groups[0].photos) >= 4
    )
    truth = np.array([shots[i][2] for i in groups[0].photos])
    assert np.median(camera_errors(groups[0].poses, truth)[0]) < 4
    assert "of 9 photos are linked" in said[-1] and not (tmp_path / "links").exists()


def shots_of(count, step=40.0, side=64, field=1.1):
    from relit.fit.collection.photos import CollectionPhoto
    from relit.scene import Camera, Photo

    out, poses = [], []
    for i, d in enumerate(arc(count, step)):
        rgb, mask, pose, f = texture_ball(d, side, field)
        camera = Camera(side, side, f, f, side / 2, side / 2, np.eye(4))
        out.append(
            CollectionPhoto(Photo(f"{i}.png", None, side, side), rgb, mask, camera, np.zeros(3))
        )
        poses.append(pose)
    return out, np.array(poses)


def turned(poses, rng, scale=3.0):
    """The poses in another frame: (poses, rotation that was applied)."""
    from relit.geometry.se3 import nearest_rotation

    r = nearest_rotation(rng.normal(size=(3, 3)))
    out = poses.copy()
    out[:, :3, :3] = r @ poses[:, :3, :3]
    out[:, :3, 3] = scale * (poses[:, :3, 3] @ r.T) + [5, -2, 1]
    return out, r


@pytest.mark.slow
def test_a_group_is_put_into_the_hints_frame():
    from relit.cameras.links import Group
    from relit.fit.collection.links import poses_of_group
    from relit.geometry.se3 import rotation_angle

    shots, poses = shots_of(8)
    other, _ = turned(poses, np.random.default_rng(3))
    group = Group(np.arange(8), other, np.full(8, 1.1), np.zeros((0, 3)), np.zeros(0, int))
    hints = poses[:, :3, 3] / np.linalg.norm(poses[:, :3, 3], axis=1, keepdims=True)
    found, angle = poses_of_group(group, shots, hints)
    assert angle < 5
    assert (
        max(rotation_angle(a[:3, :3].T @ b[:3, :3]) for a, b in zip(found, poses, strict=True)) < 6
    )
    distance = np.linalg.norm(found[:, :3, 3], axis=1)
    assert np.allclose(
        distance, 3 * 0.88, rtol=0.2
    )  # the ball of radius 1 fills .88 of the unit sphere; its hull is larger


def test_a_group_outvotes_a_photo_that_stands_elsewhere():
    from relit.cameras.links import Group
    from relit.fit.collection.links import consensus
    from relit.geometry.se3 import rotation_angle

    _, poses = shots_of(6)
    other, _ = turned(poses, np.random.default_rng(4))
    group = Group(np.arange(6), other, np.ones(6), np.zeros((0, 3)), np.zeros(0, int))
    present = poses.copy()
    present[2, :3, :3] = present[2, :3, :3] @ np.diag([-1.0, 1, -1])
    wanted = consensus(group, present)
    assert max(rotation_angle(a.T @ b[:3, :3]) for a, b in zip(wanted, poses, strict=True)) < 1
    scattered = np.array(
        [turned(p[None], np.random.default_rng(9 + i))[0][0] for i, p in enumerate(poses)]
    )
    assert consensus(group, scattered) is None


@pytest.mark.slow
def test_a_cut_photo_is_found_with_place_and_scale_free():
    """The lower half of the picture is outside the frame: the whole silhouette's middle and size
    say nothing."""
    from relit.fit.registration.photos.framing import is_cut, not_empty, slide
    from relit.fit.registration.register import crop_photo, views_from
    from relit.geometry.se3 import look_at, rotation_angle
    from relit.reference.mitsuba_scene import build_scene, render
    from relit.scene import Camera
    from support.lump import lump

    mesh, material = lump()
    scene = build_scene(mesh, material, np.eye(4), np.ones((4, 8, 3), np.float32))

    def picture(cameras):
        pixels = np.array([render(scene, c, spp=4) for c in cameras])
        return pixels[..., :3], pixels[..., 3]

    directions = np.array([[np.sin(a), 0.3, np.cos(a)] for a in np.arange(8) * np.pi / 4])
    views = views_from(directions / np.linalg.norm(directions, axis=1, keepdims=True))
    truth = look_at(directions[3] * 4)
    camera = Camera(96, 96, 140, 140, 48, 48, truth)
    rgb, alpha = (a[0] for a in picture([camera]))
    rows = np.flatnonzero((alpha > 0.5).any(1))
    bottom = int(rows[0] + 0.6 * (rows[-1] - rows[0]))
    cut = Camera(96, bottom, 140, 140, 48, 48, np.eye(4))
    crop, whole = (
        crop_photo(rgb[:bottom], alpha[:bottom], cut),
        crop_photo(rgb, alpha, camera.with_pose(np.eye(4))),
    )
    assert is_cut(crop) and not is_cut(whole)
    assert not_empty([crop])[0].sum() > not_empty([whole])[0].sum()
    found = slide([crop], picture, views, 2)
    assert found.view[0, 0] == 3 and found.scores[0, 0] > 0.8
    assert rotation_angle(found.poses[0, 0][:3, :3].T @ truth[:3, :3]) < 12
    assert np.linalg.norm(found.poses[0, 0][:3, 3] - truth[:3, 3]) < 1.0


@pytest.mark.parametrize(
    ("photos", "linked", "begins"),
    [(6, 6, True), (6, 4, False), (4, 4, True), (4, 3, False), (60, 8, True), (60, 7, False)],
)
def test_from_how_many_linked_photos_a_shape_begins(monkeypatch, photos, linked, begins):
    """Eight are enough; of few photos nearly all have to be linked."""
    from relit.cameras.links import Group
    from relit.errors import UserError
    from relit.fit.collection import links

    asked = []

    def placed(*_):
        asked.append(True)
        raise UserError("far enough")

    monkeypatch.setattr(links, "poses_of_group", placed)
    group = Group(
        np.arange(linked),
        np.tile(np.eye(4), (linked, 1, 1)),
        np.ones(linked),
        np.zeros((0, 3)),
        np.zeros(0, int),
    )
    assert (
        links.poses_from_links(
            [None] * photos, [group], [], np.zeros((photos, 3)), 45.0, 1, 0, lambda *_: None
        )
        is None
    )
    assert bool(asked) == begins


def spoilt(shots, which):
    """The shots, the mask of one of them far too large: it takes what stands beside the object
    along."""
    mask = shots[which].mask.copy()
    mask[:, :70] = 1
    out = list(shots)
    out[which] = replace(shots[which], mask=mask)
    return out


@pytest.mark.slow
@pytest.mark.parametrize("bad", [None, 4])
def test_one_bad_mask_does_not_unlink_few_photos(bad):
    from relit.cameras.links import Group
    from relit.fit.collection.links import poses_from_links
    from relit.fit.collection.photos import collection_crops
    from relit.geometry.se3 import camera_errors

    shots, poses = shots_of(6, 6.0, 120, 0.45)
    shots = shots if bad is None else spoilt(shots, bad)
    other, _ = turned(poses, np.random.default_rng(3))
    group = Group(np.arange(6), other, np.full(6, 0.45), np.zeros((0, 3)), np.zeros(0, int))
    said = []
    found, scores, held = poses_from_links(
        collection_crops(shots), [group], shots, np.zeros((6, 3)), 45.0, 1, 0, said.append
    )
    assert held.all() and camera_errors(found, poses)[0].max() < 1
    named = [line for line in said if "look at its mask" in line]
    assert len(named) == (bad is not None)
    if bad is not None:
        assert f"without {bad}.png" in named[0] and scores.argmin() == bad


@pytest.mark.slow
def test_given_cameras_begin_the_shape_like_matches(monkeypatch):
    """They are not matched again, and bring every photo to its place; one photo without a camera,
    and matches are asked."""
    from relit.fit.collection import links
    from relit.fit.collection.photos import collection_crops
    from relit.geometry.se3 import camera_errors

    shots, poses = shots_of(8)
    other, _ = turned(poses, np.random.default_rng(5))
    given = [replace(s, given=p) for s, p in zip(shots, other, strict=True)]
    groups = links.links_stage(given, None, 0).groups
    assert len(groups) == 1 and np.allclose(groups[0].focals, 1.1)
    found, scores, held = links.poses_from_links(
        collection_crops(given), groups, given, np.zeros((8, 3)), 45.0, 1, 0, lambda *_: None
    )
    assert held.all() and camera_errors(found, poses)[0].max() < 1 and scores.mean() > 0.9

    class Asked(Exception):
        pass

    def cached(*_, **__):
        raise Asked

    run = type("Run", (), {"cached": staticmethod(cached)})
    with pytest.raises(Asked):
        links.links_stage([*given[:-1], shots[-1]], run, 0)

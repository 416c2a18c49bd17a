"""Where photos were taken from: hints, descent, and the second look of a finished model."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from relit.geometry.se3 import exp_so3
from support.volume_lump import errors, photos_of, volume_lump

pytest.importorskip("mitsuba")


@pytest.fixture(scope="module")
def model():
    return volume_lump()


@pytest.fixture(scope="module")
def photos(model):
    return photos_of(model, 14, np.random.default_rng(4))


def direction(camera):
    return camera.centre / np.linalg.norm(camera.centre)


def off(photos, degrees, seed=0):
    """Directions of the photos, wrong by about so many degrees."""
    rng = np.random.default_rng(seed)
    return np.array(
        [
            exp_so3(np.radians(degrees) * rng.normal(size=3) / np.sqrt(3)) @ direction(c)
            for *_, c in photos
        ]
    )


def after_alignment(poses, photos):
    from relit.geometry.se3 import camera_errors

    return camera_errors(poses, np.array([c.world_from_camera for *_, c in photos]))[0]


@pytest.mark.slow
def test_a_rough_start_descends(photos):
    from relit.fit.registration.photos.poses import even_colours, fit_with_free_poses
    from relit.fit.registration.register import crop_photo

    crops = even_colours([crop_photo(*p) for p in photos])
    rng = np.random.default_rng(2)
    start = np.array([c.world_from_camera for *_, c in photos])
    for pose in start:
        pose[:3] = exp_so3(rng.normal(size=3) * np.radians(5)) @ pose[:3]
    before = after_alignment(start, photos)
    model, poses = fit_with_free_poses(crops, start, 32, 60, 0)
    assert np.median(after_alignment(poses, photos)) < 0.6 * np.median(before)
    assert model.grid.n == 32


@pytest.mark.slow
def test_only_the_lost_photo_moves(model, photos):
    from relit.fit.collection.held_out import look_again
    from relit.fit.collection.options import CollectionOptions
    from relit.fit.collection.photos import CollectionPhoto, PhotoSet
    from relit.recipe import FitContext

    some = photos[:4]
    plain = [replace(c, world_from_camera=np.eye(4)) for *_, c in some]
    shots = [
        CollectionPhoto(SimpleNamespace(name=str(i)), rgb, mask, p, np.zeros(3))
        for i, ((rgb, mask, _), p) in enumerate(zip(some, plain, strict=True))
    ]
    cameras = [c for *_, c in some]
    cameras[2] = cameras[2].with_pose(cameras[0].world_from_camera)
    options = CollectionOptions(keep=2, frozen_steps=20, rays=2048, refine_cameras=0.001)
    shape = SimpleNamespace(cameras=cameras, model=model)
    fit = FitContext(None, options, 0)
    seen = look_again(shape, PhotoSet(shots, [], 45.0), np.zeros(len(shots), bool), fit)
    assert (
        seen.moved.tolist() == [2]
        and seen.detail.shape == seen.as_well.shape == (4,)
        and (np.abs(seen.detail) <= 1).all()
    )
    assert errors(seen.poses, some).max() < 6.0


def test_ablation_without_search_keeps_the_hints(photos):
    from relit.fit.registration.photos.growth import find_poses
    from relit.fit.registration.photos.poses import even_colours, schedule_of
    from relit.fit.registration.register import crop_photo

    crops = even_colours([crop_photo(*p) for p in photos])
    hints = off(photos, 20)
    poses, scores = find_poses(
        crops, hints, 45.0, schedule_of(2), 1, 1, ("search",), 0, lambda *_: None, 3
    )
    eyes = poses[:, :3, 3] / np.linalg.norm(poses[:, :3, 3], axis=1, keepdims=True)
    assert (eyes * hints).sum(1).min() > 0.97 and (scores == 1).all()


@pytest.mark.slow
def test_agreement_tells_right_poses_from_wrong_ones(photos):
    from relit.fit.registration.photos.poses import cross_validated_share, even_colours
    from relit.fit.registration.register import crop_photo

    crops = even_colours([crop_photo(*p) for p in photos])
    right = np.array([c.world_from_camera for *_, c in photos])
    wrong = right[np.random.default_rng(3).permutation(len(right))]
    coarse = {"nodes": 24, "steps": 20, "views": 150, "within": 30.0}
    assert cross_validated_share(crops, right, 0, **coarse) >= 0.5
    assert cross_validated_share(crops, wrong, 0, **coarse) <= 0.2


@pytest.mark.slow
def test_settling_searches_and_refines_and_never_ends_worse_than_it_began(photos):
    """The whole of it, twice: what is compared has as many parts everywhere, and poses whose mean
    score is higher than that of any round are what comes out."""
    from relit.fit.registration.photos.growth import PARTS, settle_photos
    from relit.fit.registration.photos.poses import even_colours, gauge
    from relit.fit.registration.register import crop_photo, crop_rings

    some = photos[:5]
    crops = even_colours([crop_photo(*p) for p in some])
    poses = np.array([c.world_from_camera for *_, c in some])
    rings, said = crop_rings(crops, PARTS), []
    for begun in (0.0, 2.0):
        settled, scores = settle_photos(
            crops, poses, np.full(5, begun), rings, 1, 0, lambda text, *_: said.append(text), 1
        )
        assert "round 1 of 1" in said.pop() and settled.shape == poses.shape
        if begun:
            assert np.array_equal(settled, gauge(crops, poses)) and (scores == begun).all()
        else:
            assert scores.mean() > 0.7 and not np.allclose(settled, gauge(crops, poses), atol=1e-4)


def test_photos_without_hints_end_upright(photos):
    """A frame that is tilted as a whole is levelled by the photos' own upward directions; photos
    that are rolled at random leave it."""
    from relit.conventions import similarity
    from relit.fit.registration.photos.growth import upright

    poses = np.array([c.world_from_camera for *_, c in photos])
    tilt = similarity(exp_so3(np.array([0.5, 0.1, -0.4])), np.zeros(3))
    levelled = upright(tilt @ poses)
    mean = -levelled[:, :3, 1].mean(0)
    assert mean[1] / np.linalg.norm(mean) > 0.9999
    relative = np.linalg.inv(levelled[0]) @ levelled[1]
    assert np.allclose(relative, np.linalg.inv(poses[0]) @ poses[1], atol=1e-6)  # turned as a whole
    cancelled = np.array(
        [similarity(exp_so3(np.array([0, 0, a])), np.zeros(3)) for a in np.arange(12) * np.pi / 6]
    )
    assert np.array_equal(upright(cancelled), cancelled)

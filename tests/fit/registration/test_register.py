import numpy as np
import pytest

from relit.geometry.se3 import exp_so3
from relit.scene import Camera
from support.volume_lump import errors, photos_of, volume_lump

pytest.importorskip("mitsuba")


@pytest.fixture(scope="module")
def model():
    return volume_lump()


def test_photos_are_found_and_refined(model):
    from relit.fit.registration.register import (
        crop_photo,
        directions_around,
        make_gallery,
        refine,
        search,
        views_from,
        volume_render,
    )

    photos = photos_of(model, 8, np.random.default_rng(1))
    crops = [crop_photo(*p) for p in photos]
    render = volume_render(model)
    found = search(crops, make_gallery(render, views_from(directions_around(300))), keep=3)
    assert (np.diff(found.scores, axis=1) <= 0).all()
    first = errors(found.poses[:, 0], photos)
    assert np.median(first) < 9 and (first < 20).mean() >= 0.8
    poses, scores = refine(crops, found.poses[:, 0], render)
    right = first < 20
    assert errors(poses, photos)[right].max() < 2.0
    assert (scores[right] > 0.97).all()
    centres = np.array(
        [np.linalg.norm(p[:3, 3] - c.centre) for p, (_, _, c) in zip(poses, photos, strict=True)]
    )
    assert centres[right].max() < 0.12  # of 3.5: the distance comes from the size of the silhouette


def test_unknown_pixels_do_not_mislead(model):
    from relit.fit.registration.register import crop_photo, refine, volume_render

    rgb, mask, camera = photos_of(model, 1, np.random.default_rng(5))[0]
    weight = np.ones_like(mask)
    weight[:, 70:] = 0  # something stands before a part of the object
    hidden = np.where(weight > 0, mask, 0)
    start = np.array(camera.world_from_camera)
    start[:3] = exp_so3(np.array([0.0, 0.1, 0.1])) @ start[:3]
    crops = [crop_photo(rgb * weight[..., None], hidden, camera, weight)]
    pose, _ = refine(crops, start[None], volume_render(model))
    blind, _ = refine(
        [crop_photo(rgb * weight[..., None], hidden, camera)], start[None], volume_render(model)
    )
    photo = [(rgb, mask, camera)]
    assert errors(pose, photo)[0] < 3.0
    assert errors(pose, photo)[0] < errors(blind, photo)[0]


def test_the_search_can_be_restricted(model):
    from relit.fit.registration.register import (
        crop_photo,
        directions_around,
        make_gallery,
        near,
        search,
        views_from,
        volume_render,
    )

    photos = photos_of(model, 2, np.random.default_rng(3))
    crops = [crop_photo(*p) for p in photos]
    gallery = make_gallery(volume_render(model), views_from(directions_around(150)))
    away = np.array([-c.centre / np.linalg.norm(c.centre) for _, _, c in photos])
    found = search(crops, gallery, keep=2, allowed=near(gallery, away, 50))
    for i in range(2):
        for pose in found.poses[i]:
            assert pose[:3, 3] @ away[i] / np.linalg.norm(pose[:3, 3]) > np.cos(np.radians(58))
    upright = search(crops, gallery, keep=1, max_roll=np.radians(15))
    assert upright.scores[0, 0] < search(crops, gallery, keep=1).scores[0, 0] + 1e-6


def test_an_empty_mask_is_refused():
    from relit.fit.registration.register import crop_photo

    with pytest.raises(ValueError, match="empty"):
        crop_photo(
            np.zeros((20, 20, 3)), np.zeros((20, 20)), Camera(20, 20, 20, 20, 10, 10, np.eye(4))
        )


def test_detail_tells_a_decoration_from_the_shading_on_it():
    from relit.fit.registration.register import SIDE, all_scores, rings_of

    rng = np.random.default_rng(0)
    x, y = np.meshgrid(np.arange(SIDE), np.arange(SIDE))
    mask = ((x - 32) ** 2 + (y - 32) ** 2 < 22**2).astype(np.float32)

    def spotted():
        places = rng.uniform(14, 50, (14, 2))
        spots = (np.hypot(x[..., None] - places[:, 0], y[..., None] - places[:, 1]) < 3).any(-1)
        return np.repeat((0.6 - 0.35 * spots)[..., None], 3, 2).astype(np.float32)

    ours, other = spotted(), spotted()
    shade = np.exp(0.05 * (x - 32))[..., None].astype(
        np.float32
    )  # five times as bright on one side

    def score(a, b, parts):
        one, two = (
            rings_of((p * mask[..., None])[None].astype(np.float32), mask[None], parts=parts)
            for p in (a, b)
        )
        return float(all_scores(one, two)[0, 0, 0])

    plain, fine = (0.6, 2.0, 0.6), (0.6, 1.0, 0.1, 0.6)
    assert (
        score(ours * shade, ours, fine) > score(other, ours, fine) + 0.2
    )  # the same under another light, against another
    assert score(ours * shade, ours, plain) < score(ours * shade, ours, fine) - 0.1

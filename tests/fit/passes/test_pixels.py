"""The pixel bank: photos of mixed sizes, masks, which pixels are drawn, rays, corrections, normal
priors."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.ndimage import binary_dilation

from relit.fit.passes.camera_corrections import CameraCorrections, CorrectionModel, corrected
from relit.fit.passes.pixels import (
    SATURATED,
    batch_of,
    draw_pixels,
    locate,
    make_bank,
    rays_through,
    saturated_at,
    sphere_pixels,
    well_exposed,
)
from relit.geometry.se3 import look_at
from relit.scene import Camera

SIZES = [(12, 8), (5, 9), (16, 16)]  # width, height


@pytest.fixture(scope="module")
def photos():
    rng = np.random.default_rng(0)
    cameras = [
        Camera(w, h, 1.1 * w, 1.2 * w, 0.5 * w + 0.3, 0.5 * h - 0.2, look_at(o, roll=0.2))
        for (w, h), o in zip(SIZES, ([3, 0.5, 0.2], [-1, 2, 2.0], [0.3, -1, -2.5]), strict=True)
    ]
    images = [rng.uniform(0, 1, (h, w, 3)).astype(np.float32) for w, h in SIZES]
    masks = [rng.uniform(0, 1, (h, w)).astype(np.float32) for w, h in SIZES]
    return cameras, images, masks


def everything(bank):
    return mi.UInt32(np.arange(bank.total, dtype=np.uint32))


def columns(x):
    return np.array(x).T


def test_every_pixel_of_photos_of_mixed_sizes_is_found_again(photos):
    cameras, images, masks = photos
    bank = make_bank(cameras, images, masks)
    assert (bank.views, bank.total, bank.masked) == (3, sum(w * h for w, h in SIZES), True)
    view, x, y = (np.array(a) for a in locate(bank, everything(bank)))
    batch = batch_of(bank, everything(bank))
    rgb, mask, o, d = columns(batch.rgb), np.array(batch.mask), columns(batch.o), columns(batch.d)
    at = 0
    for k, (camera, image, m) in enumerate(zip(cameras, images, masks, strict=True)):
        h, w = m.shape
        part = slice(at, at + w * h)
        assert (view[part] == k).all()
        np.testing.assert_array_equal(x[part].reshape(h, w), np.arange(w) + np.zeros((h, 1)))
        np.testing.assert_array_equal(y[part].reshape(h, w), np.arange(h)[:, None] + np.zeros(w))
        np.testing.assert_array_equal(rgb[part].reshape(h, w, 3), image)
        np.testing.assert_array_equal(mask[part].reshape(h, w), m)
        back = camera.project(o[part] + 2.5 * d[part]).reshape(
            h, w, 3
        )  # each ray passes through the centre of its pixel
        np.testing.assert_allclose(back[..., 0], np.arange(w) + 0.5 + np.zeros((h, 1)), atol=1e-4)
        np.testing.assert_allclose(
            back[..., 1], np.arange(h)[:, None] + 0.5 + np.zeros(w), atol=1e-4
        )
        at += w * h
    np.testing.assert_allclose(np.linalg.norm(d, axis=1), 1, atol=1e-6)


def test_candidates_are_the_pixels_of_the_sphere_near_the_mask(photos):
    cameras, images, _ = photos
    masks = [np.zeros((h, w), np.float32) for w, h in SIZES]
    masks[2][7:9, 7:9] = 1
    masks[0][2, 3] = 1
    found = np.array(make_bank(cameras, images, masks).candidates)
    expected, at = [], 0
    for camera, mask in zip(cameras, masks, strict=True):
        near = sphere_pixels(camera, 1.0)
        if mask.any():
            near = near & binary_dilation(mask > 0.02, iterations=3)
        expected.append(np.flatnonzero(near.ravel()) + at)
        at += mask.size
    np.testing.assert_array_equal(found, np.concatenate(expected))
    assert (
        0 < len(expected[2]) < sphere_pixels(cameras[2], 1.0).sum()
    )  # the margin round the mask is smaller than the sphere
    all_of_them = np.array(make_bank(cameras, images, [None] * 3).candidates)
    assert len(all_of_them) == sum(sphere_pixels(c, 1.0).sum() for c in cameras)


def test_without_masks_every_pixel_counts(photos):
    cameras, images, masks = photos
    bank = make_bank(cameras, images, [None, masks[1], None])
    assert not bank.masked
    assert (np.array(batch_of(bank, everything(bank)).mask)[: SIZES[0][0] * SIZES[0][1]] == 1).all()


def test_pixels_are_drawn_evenly_from_the_candidates(photos):
    cameras, images, _ = photos
    bank = make_bank(cameras, images, [None] * 3)
    rng = mi.PCG32(size=40_000, initstate=3)
    drawn = np.array(draw_pixels(bank, rng, 40_000))
    candidates = np.array(bank.candidates)
    counts = np.bincount(drawn, minlength=bank.total)
    assert set(np.flatnonzero(counts)) == set(candidates)
    expected = 40_000 / len(candidates)
    assert np.abs(counts[candidates] - expected).max() < 5 * np.sqrt(expected)


def test_what_is_over_exposed_is_told_by_the_codes_of_each_photo(photos):
    """Codes end at white, also where a photo was scaled; radiance that is no code does not end,
    unless all of it does at 1."""
    cameras, images, _ = photos
    dark, bright = (
        [np.full_like(im, 0.9) for im in images],
        [np.full_like(im, 1.5) for im in images],
    )

    def level(images, whites):
        return np.broadcast_to(
            np.array(make_bank(cameras, images, [None] * 3, whites=whites).saturated), 3
        ).tolist()

    assert level(dark, None) == level(dark, [None] * 3) == level(dark, [1.0] * 3) == [SATURATED] * 3
    assert level(bright, [None] * 3) == [np.inf] * 3
    assert level(bright, [1.0, 2.0, 2.0]) == pytest.approx(
        [SATURATED, 2 * SATURATED, 2 * SATURATED]
    )
    assert level([dark[0], bright[1], dark[2]], [1.0, None, None]) == pytest.approx(
        [SATURATED, np.inf, np.inf]
    )
    bank = make_bank(cameras, bright, [None] * 3, whites=[1.0, 2.0, 1.2])
    batch = batch_of(bank, everything(bank))
    fine = np.array(well_exposed(batch.rgb, saturated_at(bank, batch.view)))
    assert (fine == (np.array(batch.view) == 1)).all()


def test_corrections_are_the_cameras_that_they_stand_for(photos):
    """Rays with corrections are those of the cameras that have them built in, for turns that no
    refinement will reach."""
    cameras, images, _ = photos
    bank = make_bank(cameras, images, [None] * 3)
    numbers = np.random.default_rng(1).normal(size=18) * 0.1
    corrections = CameraCorrections(CorrectionModel.ABOUT_CAMERA, mi.Float(numbers))
    batch = batch_of(bank, everything(bank), corrections)
    moved = make_bank(corrected(cameras, corrections), images, [None] * 3)
    there = batch_of(moved, everything(moved))
    np.testing.assert_allclose(columns(batch.d), columns(there.d), atol=2e-6)
    np.testing.assert_allclose(columns(batch.o), columns(there.o), atol=2e-6)


def test_normal_priors_stand_in_the_frame_of_the_rays(photos):
    """Camera axes in the file, unit frame in the batch; length 1 even where shrinking has averaged
    them; unknown where there is none."""
    cameras, images, _ = photos
    world = np.array([0.6, -0.48, 0.64])
    in_camera = [np.asarray(c.world_from_camera)[:3, :3].T @ world for c in cameras]
    normals = [
        np.broadcast_to(0.7 * n, image.shape).astype(np.float32)
        for n, image in zip(in_camera, images, strict=True)
    ]
    normals[1] = None
    normals[2] = normals[2].copy()
    normals[2][3, 4] = 0
    bank = make_bank(cameras, images, [None] * 3, normals)
    batch = batch_of(bank, everything(bank))
    known = np.array(batch.has_normal) > 0
    view, x, y = (np.array(a) for a in locate(bank, everything(bank)))
    np.testing.assert_array_equal(known, (view != 1) & ~((view == 2) & (x == 4) & (y == 3)))
    np.testing.assert_allclose(
        columns(batch.normal)[known], np.broadcast_to(world, (known.sum(), 3)), atol=1e-5
    )


def test_rays_of_a_part_of_a_pixel(photos):
    cameras, images, _ = photos
    bank = make_bank(cameras, images, [None] * 3)
    o, d = rays_through(
        bank.cameras, mi.UInt32([1, 1]), mi.Float([2.25, 4.0]), mi.Float([7.75, 0.0])
    )
    back = cameras[1].project(columns(o + dr.zeros(mi.Vector3f, 2)) + 3 * columns(d))
    np.testing.assert_allclose(back[:, :2], [[2.25, 7.75], [4.0, 0.0]], atol=1e-4)

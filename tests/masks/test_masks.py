"""Thresholds, GrabCut and the judgement of mask files, on drawn pictures."""

import cv2
import numpy as np
import pytest
from PIL import Image

from relit.errors import EXIT_ENVIRONMENT, UserError
from relit.geometry.se3 import look_at
from relit.masks import files, segment
from relit.masks.grabcut import grabcut, sphere_disc
from relit.masks.threshold import find_backdrop
from relit.scene import Camera, Sphere

RNG = np.random.default_rng(0)


def disc(h=60, w=80, centre=(30, 40), radius=16):
    y, x = np.mgrid[:h, :w]
    return ((y - centre[0]) ** 2 + (x - centre[1]) ** 2 < radius**2).astype(np.float32)


def photo(mask, background, noise=0.004, colour=(0.4, 0.3, 0.1)):
    shade = 0.4 + 0.6 * np.linspace(0, 1, mask.shape[1])[None, :, None]
    rgb = mask[..., None] * np.asarray(colour) * shade + (1 - mask[..., None]) * np.asarray(
        background
    )
    return np.maximum(rgb + RNG.normal(size=rgb.shape) * noise, 0).astype(np.float32)


def overlap(a, b):
    return float(((a > 0.5) & (b > 0.5)).sum() / ((a > 0.5) | (b > 0.5)).sum())


@pytest.mark.parametrize(
    "background, dark",
    [((0.001, 0.001, 0.001), True), ((0.9, 0.9, 0.88), False), ((0.05, 0.4, 0.1), False)],
)
def test_plain_backdrops(background, dark):
    masks = [disc(centre=(28 + i, 36 + 2 * i)) for i in range(5)]
    photos = [photo(m, background, noise=0.0005) for m in masks]
    backdrop = find_backdrop(photos)
    assert backdrop is not None and backdrop.dark == dark
    assert min(overlap(backdrop(p), m) for p, m in zip(photos, masks, strict=True)) > 0.85


def test_a_busy_background_is_no_backdrop():
    photos = [photo(disc(), cv2.resize(RNG.uniform(size=(8, 8, 3)), (80, 60))) for _ in range(5)]
    assert find_backdrop(photos) is None


def test_one_colour_without_an_object_is_no_backdrop():
    assert find_backdrop([np.full((40, 40, 3), 0.5, np.float32)] * 4) is None


def test_the_opening_of_a_ring_stays_open_and_a_small_shadow_is_filled():
    ring = disc(radius=24) - disc(radius=12)
    photos = [photo(ring, (0.9, 0.9, 0.9), noise=0.0005)] * 4
    for p in photos:
        p[30, 58:60] = 0.9  # a speck of backdrop colour inside the ring
    mask = find_backdrop(photos)(photos[0])
    assert mask[30, 40] == 0 and mask[30, 58] == 1


def test_the_disc_of_the_sphere():
    camera = Camera(80, 60, 90.0, 90.0, 40.0, 30.0, look_at([0, 0, -5], [0, 0, 0]))
    seen = sphere_disc(camera, Sphere(np.zeros(3), 1.0))
    assert seen.sum() == pytest.approx(
        np.pi * (90 / np.sqrt(24)) ** 2, rel=0.02
    )  # tangent cone: r / sqrt(d^2 - r^2)
    assert not sphere_disc(camera, Sphere(np.array([0, 0, -10.0]), 1.0)).any()  # behind


def test_grabcut_is_seeded_by_the_sphere():
    camera = Camera(80, 60, 90.0, 90.0, 40.0, 30.0, look_at([0, 0, -5], [0, 0, 0]))
    mask = disc(radius=15)
    stripes = 0.5 + 0.2 * np.sin(np.arange(60) / 3)[:, None, None] * np.ones((1, 80, 3))
    rgb = photo(mask, stripes, noise=0.01, colour=(0.5, 0.05, 0.02))
    found = grabcut(rgb, camera, Sphere(np.zeros(3), 1.1))
    assert overlap(found, mask) > 0.85
    np.testing.assert_array_equal(grabcut(rgb, camera, Sphere(np.zeros(3), 1.1)), found)


def test_inverted_masks_are_seen():
    assert files.looks_inverted(1 - disc()) and not files.looks_inverted(disc())
    close_up = np.ones((60, 80), np.float32)
    close_up[:, :10] = 0  # an object that fills the picture but for one side
    assert not files.looks_inverted(close_up)
    assert files.judge({"a": 1 - disc(), "b": 1 - disc()}, "masks/") == (True, [])


@pytest.mark.parametrize("suffix, top", [(".png", 255), (".tif", 65535)])
def test_numbers_0_and_1_are_a_mask(tmp_path, suffix, top):
    """As programs write that number objects; nearly black both. Black with noise, or a third level,
    is none."""
    path, inside = tmp_path / f"a{suffix}", disc() > 0.5
    codes = inside.astype(np.uint8 if top == 255 else np.uint16)
    Image.fromarray(codes).save(path)
    mask, numbered = files.read_counted(path)
    np.testing.assert_array_equal(mask, inside)
    assert numbered
    for other in (codes * top, codes * 0, codes + 1, codes + codes[::-1]):
        Image.fromarray(other.astype(codes.dtype)).save(path)
        mask, numbered = files.read_counted(path)
        np.testing.assert_allclose(mask, other / top, atol=1e-6)
        assert not numbered


def test_judgement_of_masks():
    good, black, white = disc(), np.zeros((60, 80)), np.ones((60, 80))
    assert files.judge({"a": good, "b": good, "c": black}, "masks/") == (False, ["c"])
    with pytest.raises(UserError, match="all masks are black"):
        files.judge({"a": black, "b": black}, "masks/")
    with pytest.raises(UserError, match="all masks are white"):
        files.judge({"a": white, "b": white}, "masks/")
    with pytest.raises(UserError, match="2 of 5 masks look inverted"):
        files.judge({"a": good, "b": good, "c": good, "d": 1 - good, "e": 1 - good}, "masks/")
    with pytest.raises(UserError, match="2 of 3 masks are black"):
        files.judge({"a": good, "b": black, "c": black}, "masks/")


@pytest.mark.parametrize(
    "colours, expected",
    [
        (
            [(0, 0, 0), (128, 0, 0), (0, 128, 0)],
            [0, 1, 1],
        ),  # DAVIS, VOC: one dark colour for each object
        ([(0, 0, 0), (1, 1, 1), (2, 2, 2)], [0, 1, 1]),  # the numbers of the objects as grey levels
        (
            [(0, 0, 0), (51, 51, 51), (255, 255, 255)],
            [0, 0.2, 1],
        ),  # a soft mask with a palette of greys
        ([(255, 255, 255), (0, 0, 0), (51, 51, 51)], [1, 0, 0.2]),  # in another order
    ],
)
def test_masks_with_a_palette(tmp_path, colours, expected):
    index = RNG.integers(0, 3, (60, 80)).astype(np.uint8)
    index[0, :3] = 0, 1, 2
    picture = Image.fromarray(index, "P")
    picture.putpalette([v for c in colours for v in c])
    picture.save(tmp_path / "a.png")
    np.testing.assert_allclose(
        files.read_mask(tmp_path / "a.png"), np.array(expected)[index], atol=1e-6
    )


def test_a_missing_segmenter_says_what_to_install(monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(UserError, match="optional package") as caught:
        segment.segmenter()
    assert caught.value.code == EXIT_ENVIRONMENT and "relit[segment]" in caught.value.fix

"""The base colour of the ground, told by a photo of the pile."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from relit.conventions import similarity
from relit.fit.duplicates.ground_paint import ground_as_shown
from relit.geometry.se3 import look_at
from relit.reference.mitsuba_scene import render_channels
from relit.scene import Asset, Camera, Ground, Instance, Material, Pixels
from support.flash_ball import ball

TRUE = np.array([0.36, 0.33, 0.30])


@pytest.fixture(scope="module")
def seen(device):
    """Nine balls close together, so that the ground that shows is shadowed, as the photo has them;
    (asset, its pixels)."""
    from relit.reference.photographed import as_photographed, lit_scene

    places = [(x, 1.0, z) for x in (-2.1, 0, 2.1) for z in (-2.1, 0, 2.1)]
    world_from_object = [similarity(np.eye(3), np.array(p), 1.4) for p in places]
    camera = Camera(
        200, 160, 260.0, 260.0, 100.0, 80.0, look_at(np.array([0.0, 8, 8]), np.zeros(3))
    )
    material = Material(
        np.full((8, 8, 3), (0.6, 0.2, 0.1), np.float32),
        np.full((8, 8), 0.5, np.float32),
        np.zeros((8, 8), np.float32),
    )
    sky = np.full((16, 32, 3), 0.8, np.float32)
    instances = tuple(Instance(10 * (k + 1), m, "") for k, m in enumerate(world_from_object))
    ground = Ground(np.zeros(3), np.array([0.0, 1, 0]), 40.0, TRUE)
    asset = Asset(
        ball(),
        material,
        world_from_object[0],
        sky,
        (("photo", camera),),
        {},
        instances=instances,
        ground=ground,
    )
    picture = as_photographed(asset)("photo", camera, spp=64, seed=3)
    objects = render_channels(lit_scene(asset, ground=False), camera, spp=16)["alpha"]
    pixels = Pixels(picture[..., :3], None, labels=(objects > 0).astype(np.int32))
    return asset, pixels


@pytest.mark.slow
@pytest.mark.parametrize("start", [(0.5, 0.5, 0.5), (0.05, 0.3, 0.9)])
def test_the_ground_is_as_bright_as_the_photo_shows_it(seen, start):
    asset, pixels = seen
    begun = replace(asset, ground=replace(asset.ground, colour=np.array(start)))
    assert ground_as_shown(begun, pixels).ground.colour == pytest.approx(TRUE, rel=0.02)


@pytest.mark.slow
def test_shadows_of_the_pile_are_not_taken_for_paint(seen):
    """The whole sky would make the ground darker than it is, by what the balls hide of it."""
    from relit.fit.duplicates.scene import ground_colour, ground_reflectance

    asset, pixels = seen
    whole = ground_reflectance(
        asset.environment, asset.ground.normal, ground_colour(pixels, np.ones((2, 3)))
    )
    assert (whole < 0.9 * TRUE).all()


@pytest.mark.slow
def test_a_photo_without_ground_changes_nothing(seen):
    asset, pixels = seen
    everywhere = replace(pixels, labels=np.ones_like(pixels.labels))
    assert ground_as_shown(asset, everywhere) is asset
    assert ground_as_shown(replace(asset, ground=None), pixels).ground is None

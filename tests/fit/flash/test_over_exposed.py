"""Over-exposed pixels have no say over the volume pass, the groups' lobes and the patches; photos
that cannot clip are fitted as before."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest

from relit.fit.flash.lobe_clusters import start_kinship
from relit.fit.flash.surface import (
    FlashModel,
    FlashSurfaceOptions,
    FlashTerms,
    fit_flash_surface,
)
from relit.fit.passes.optimiser import NoStage
from relit.fit.passes.pixels import well_exposed
from relit.fit.passes.volume import VolumeOptions, fit_volume, start_model
from relit.geometry.sdf import node_positions
from relit.materials.plastic_field import start_plastic
from relit.materials.rough_plastic import Coat
from support import flash_ball as scene


@pytest.fixture(scope="module")
def shot(device):
    return scene.capture(size=24, count=6)


def burnt(bank, value: float):
    """rgbm with `value` in one channel of a quarter of the brighter half of the object's pixels."""
    rgbm = np.array(bank.rgbm).reshape(-1, 4).copy()
    bright = (rgbm[:, 3] > 0.99) & (rgbm[:, 1] > np.median(rgbm[rgbm[:, 3] > 0.99, 1]))
    rgbm[np.flatnonzero(bright)[::4], 1] = value
    return mi.Float(rgbm.ravel())


def test_one_channel_is_enough():
    rgb = mi.Color3f([0.5, 0.2, 0.98], [0.1, 0.99, 0.98], [0.5, 0.3, 0.98])
    assert np.array(well_exposed(rgb, 0.99)).tolist() == [True, False, True]
    assert well_exposed(rgb, np.inf) is True


def volume_after(bank, value, saturated):
    """Distances and features after a few steps."""
    bank = replace(bank, rgbm=burnt(bank, value), saturated=saturated, drop_saturated=True)
    start = np.linalg.norm(node_positions(16), axis=-1) - 0.65
    model = start_model(start.astype(np.float32), np.full(3, 0.4), None, full=True)
    fit_volume(bank, model, VolumeOptions((16,), (3,), 512), NoStage(), 0)
    return np.array(model.grid.row_values), np.array(model.grid.features)


@pytest.mark.slow
def test_volume_pass(shot):
    bank = shot[0]
    a, b = volume_after(bank, 1.0, 0.99), volume_after(bank, 3.0, 0.99)
    np.testing.assert_allclose(a[0], b[0], atol=1e-5)  # sums of threads come in any order
    np.testing.assert_allclose(a[1], b[1], atol=1e-5)
    c, d = volume_after(bank, 1.0, np.inf), volume_after(bank, 3.0, np.inf)
    assert np.abs(c[1] - d[1]).max() > 1e-3
    assert np.abs(a[1] - c[1]).max() > 1e-3


def surface_after(shot, value, saturated):
    """(textures, numbers of the groups) after a few steps from a model that is brighter than any
    photo, so that a burnt channel has no residual of its own where it says "at least this bright".
    Weights of edges and outliers, which see all values, are off."""
    bank, views, mesh, truth = shot
    bank = replace(bank, rgbm=burnt(bank, value), saturated=saturated)
    size = truth.size
    known, one = np.ones((size, size), bool), np.ones((size, size))
    features = np.random.default_rng(0).uniform(0, 1, (size, size, 4))
    kin = start_kinship(features, known, np.stack([0.5 * one, 0.2 * one], -1), groups=4)
    model = FlashModel(
        start_plastic(0.4 * np.ones((size, size, 3)), 0.5 * one, 0.2 * one),
        mi.Float(features.astype(np.float32).ravel()),
        kin,
        mi.Float(0, 0, 0),
        mi.Float([9.0]),
        Coat(),
    )
    o = FlashSurfaceOptions(
        steps=4, points=64 * 12, directions=0, edge=1e6, robust=(1e6, 1e6), patches=1.0
    )
    fit_flash_surface(FlashTerms(bank, views, mesh, model, o), NoStage())
    return np.array(model.field.diffuse), np.array(kin.level)


@pytest.mark.slow
def test_surface_pass(shot):
    """Neither the patches, which change the textures, nor the evidence of the groups see how far
    a pixel is over-exposed."""
    below, above, *unlimited = (
        surface_after(shot, value, saturated)
        for saturated in (0.99, np.inf)
        for value in (1.0, 2.0)
    )
    for part in (0, 1):
        np.testing.assert_allclose(below[part], above[part], atol=1e-5)
        c, d = (after[part] for after in unlimited)
        assert np.abs(c - d).max() > 1e-4 and np.abs(below[part] - c).max() > 1e-4

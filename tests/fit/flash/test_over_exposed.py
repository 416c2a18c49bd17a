"""Over-exposed pixels have no say over the volume pass, the groups' lobes and the patches; photos
that cannot clip are fitted as before."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from relit.fit.flash import surface as flash_surface
from relit.fit.flash.lobe_clusters import start_kinship
from relit.fit.flash.surface import FlashModel, FlashSurfaceOptions, fit_flash_surface
from relit.fit.passes import volume
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
    """(pixels (n,) that are burnt, rgbm): a quarter of the object's pixels with `value` in one
    channel."""
    rgbm = np.array(bank.rgbm).reshape(-1, 4).copy()
    chosen = np.flatnonzero(rgbm[:, 3] > 0.99)[::4]
    rgbm[chosen, 1] = value
    return chosen, mi.Float(rgbm.ravel())


def test_one_channel_is_enough():
    rgb = mi.Color3f([0.5, 0.2, 0.98], [0.1, 0.99, 0.98], [0.5, 0.3, 0.98])
    assert np.array(well_exposed(rgb, 0.99)).tolist() == [True, False, True]
    assert well_exposed(rgb, np.inf) is True


def volume_after(bank, value, saturated):
    """Distances and features after a few steps."""
    before = bank.rgbm, bank.saturated
    try:
        bank.rgbm, bank.saturated, bank.drop_saturated = burnt(bank, value)[1], saturated, True
        start = np.linalg.norm(node_positions(16), axis=-1) - 0.65
        model = start_model(start.astype(np.float32), np.full(3, 0.4), None, full=True)
        fit_volume(bank, model, VolumeOptions((16,), (3,), 512), NoStage(), 0)
        return np.array(model.grid.row_values), np.array(model.grid.features)
    finally:
        bank.rgbm, bank.saturated = before
        bank.drop_saturated = False


def test_volume_pass(shot):
    bank = shot[0]
    a, b = volume_after(bank, 1.0, 0.99), volume_after(bank, 3.0, 0.99)
    np.testing.assert_allclose(a[0], b[0], atol=1e-5)  # sums of threads come in any order
    np.testing.assert_allclose(a[1], b[1], atol=1e-5)
    c, d = volume_after(bank, 1.0, np.inf), volume_after(bank, 3.0, np.inf)
    assert np.abs(c[1] - d[1]).max() > 1e-3
    assert np.abs(a[1] - c[1]).max() > 1e-3


def test_volume_pass_of_photos_that_cannot_clip(shot, monkeypatch):
    """Nothing is asked of their pixels: the loss gets what it got before."""
    monkeypatch.setattr(volume, "well_exposed", None)
    volume_after(shot[0], 1.0, np.inf)


@pytest.mark.parametrize("saturated", [0.99, np.inf])
def test_surface_pass(shot, monkeypatch, saturated):
    bank, views, mesh, truth = shot
    size = truth.size
    chosen, rgbm = burnt(bank, 1.0)
    monkeypatch.setattr(bank, "rgbm", rgbm)
    seen = {}

    def watch(name, pick):
        real = getattr(flash_surface, name)

        def call(*args):
            seen[name] = [np.array(x) for x in pick(*args)]
            return real(*args)

        monkeypatch.setattr(flash_surface, name, call)

    watch(
        "share_evidence",
        lambda kin, field, uv, plastic, shade, photo, weight, rate: (weight.x, weight.z),
    )
    watch("pyramid_loss", lambda a, b, target, weight: (dr.max(target), weight))
    watch(
        "ssim_loss", lambda a, b, target, valid: (dr.max(target), dr.select(valid, mi.Float(1), 0))
    )
    pixels = dr.arange(mi.UInt32, 64 * 12)
    monkeypatch.setattr(flash_surface, "draw_patches", lambda bank, rng, count: pixels)
    known, one = np.ones((size, size), bool), np.ones((size, size))
    features = np.random.default_rng(0).uniform(0, 1, (size, size, 4))
    kin = start_kinship(features, known, np.stack([0.5 * one, 0.2 * one], -1), groups=4)
    field = start_plastic(0.4 * np.ones((size, size, 3)), 0.5 * one, 0.2 * one)
    model = FlashModel(
        field,
        mi.Float(features.astype(np.float32).ravel()),
        kin,
        mi.Float(0, 0, 0),
        mi.Float([1.7]),
        Coat(),
    )
    options = FlashSurfaceOptions(steps=1, points=64 * 12, directions=0, patches=0.1)
    monkeypatch.setattr(bank, "saturated", saturated)
    fit_flash_surface(flash_surface.FlashTerms(bank, views, mesh, model, options), NoStage())
    is_burnt = np.isin(np.arange(64 * 12), chosen)
    for weight in (*seen["share_evidence"], seen["pyramid_loss"][1], seen["ssim_loss"][1]):
        assert (weight[~is_burnt] > 0).any()
        assert (
            (weight[is_burnt] == 0).all()
            if np.isfinite(saturated)
            else (weight[is_burnt] > 0).any()
        )

"""Figures of a flash view over the frame and inside the mask, against values worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from relit.evaluate.baselines import Constants
from relit.evaluate.flash import FLASH_DEFINITIONS, FlashView, view_figures

SIZE = 16


@pytest.fixture
def view() -> FlashView:
    """The object fills the upper half; its true albedo is .2 left and .4 right."""
    mask = np.zeros((SIZE, SIZE))
    mask[: SIZE // 2] = 1
    black = np.zeros((SIZE, SIZE, 3))
    albedo = np.full((SIZE, SIZE, 3), 0.2)
    albedo[:, SIZE // 2 :] = 0.4
    albedo *= mask[..., None]
    normal = np.concatenate([black, mask[..., None]], -1)
    normal[..., 2] = mask
    return FlashView(
        "t_000",
        black,
        black,
        mask,
        (albedo + 0.1 * mask[..., None], albedo),
        (0.5 * mask, 0.5 * mask),
        (0.3 * mask, 0.1 * mask),
        (normal[..., :3], normal),
    )


def test_frame_and_mask(view):
    constants = Constants()
    figures = view_figures(view, constants)
    assert figures["diffuse_psnr_masked"] == pytest.approx(20)
    assert figures["diffuse_psnr"] == pytest.approx(20 + 10 * np.log10(2))
    assert figures["roughness_mse_masked"] == pytest.approx(0.04)
    assert figures["roughness_mse"] == pytest.approx(0.02)
    assert figures["normal_mae"] == pytest.approx(0) and figures["novel_ssim_masked"] == 1
    baselines = {name: value for name, (value, _) in constants.baselines().items()}
    assert baselines["diffuse_psnr_masked"] == pytest.approx(20)  # .3, and .1 off everywhere
    assert baselines["diffuse_psnr"] == pytest.approx(20 + 10 * np.log10(2))
    assert baselines["roughness_mse"] == pytest.approx(0, abs=1e-12)
    assert set(baselines) | set(figures) <= set(FLASH_DEFINITIONS)


def test_without_a_true_mask_only_the_frame_counts(view):
    bare = FlashView(**{**vars(view), "normals": None})
    figures = view_figures(bare, Constants())
    assert not [name for name in figures if name.endswith("_masked")]
    assert figures["diffuse_psnr"] == pytest.approx(20 + 10 * np.log10(2))

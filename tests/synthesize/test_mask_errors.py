"""Masks of a segmenter against the true ones."""

import numpy as np
import pytest

from relit.synthesize.mask_errors import (
    MaskErrors,
    MaskFault,
    draw_fault,
    occluded,
    parse_mask_errors,
    segmented,
)

SIZE, RADIUS = 400, 120


def disc():
    y, x = np.mgrid[:SIZE, :SIZE] - SIZE / 2 + 0.5
    return (np.hypot(x, y) < RADIUS).astype(np.float32)


def fault(seed=1, piece=False, wrong="", occluder=""):
    return MaskFault(piece, wrong, occluder, seed)


def overlap(a, b):
    return np.minimum(a, b).sum() / np.maximum(a, b).sum()


def test_without_errors_the_mask_is_the_true_one():
    assert np.array_equal(segmented(disc(), MaskErrors(), fault()), disc())
    assert draw_fault(MaskErrors(), 4) == fault(4)


def test_the_outline_wanders_by_its_deviation():
    errors = MaskErrors(outline=3.0)
    areas, radii = [], []
    for seed in range(4):
        mask = segmented(disc(), errors, fault(seed))
        row = mask[SIZE // 2 - 60 : SIZE // 2 + 60]
        radii.append(row.sum(1) / 2)  # half the chord
        areas.append(mask.sum())
    y = np.arange(-60, 60) + 0.5
    off = np.array(radii) - np.sqrt(RADIUS**2 - y**2)
    assert 1.2 < off.std() < 3.5  # two borders, each 3 pixels along its normal, averaged
    assert np.mean(areas) == pytest.approx(disc().sum(), rel=0.02)


def test_soft_borders_have_their_width():
    mask = segmented(disc(), MaskErrors(soft=8.0), fault())
    partly = ((mask > 0.02) & (mask < 0.98)).sum()
    assert partly == pytest.approx(2 * np.pi * RADIUS * 8 * 0.96, rel=0.1)
    assert overlap((mask > 0.5).astype(float), disc()) > 0.98


def test_a_piece_is_missing_inside_only():
    mask = segmented(disc(), MaskErrors(), fault(piece=True))
    lost = 1 - mask.sum() / disc().sum()
    assert 0.01 < lost < 0.4 and (mask <= disc()).all()


@pytest.mark.parametrize("wrong", ["other", "empty", "inverted"])
def test_wrong_masks(wrong):
    mask = segmented(disc(), MaskErrors(), fault(wrong=wrong))
    assert (mask * disc()).sum() == 0
    assert {"other": mask.sum() > 100, "empty": mask.sum() == 0, "inverted": mask.sum() > 1e5}[
        wrong
    ]


@pytest.mark.parametrize("kind", ["hand", "stand"])
def test_an_occluder_hides_a_part_and_reaches_the_border(kind):
    scene = np.full((SIZE, SIZE, 3), 0.4, np.float32)
    for seed in range(6):
        painted, left = occluded(scene, disc(), fault(seed, occluder=kind))
        hidden = disc() - left
        assert 0.002 < hidden.sum() / disc().sum() < 0.4
        changed = np.abs(painted - scene).max(-1) > 0.01
        assert changed[[0, -1]].any() or changed[:, [0, -1]].any()
        assert changed[hidden > 0.99].all() and not changed[left == 1].any()


def test_shares():
    errors = MaskErrors(pieces=0.3, wrong=0.2, occluders=0.4)
    drawn = [draw_fault(errors, s) for s in range(1000)]
    assert np.mean([d.piece for d in drawn]) == pytest.approx(0.3, abs=0.05)
    assert np.mean([d.wrong != "" for d in drawn]) == pytest.approx(0.2, abs=0.05)
    assert np.mean([d.occluder != "" for d in drawn]) == pytest.approx(0.4, abs=0.05)
    assert {d.wrong for d in drawn} == {"", "other", "empty", "inverted"}
    assert {d.occluder for d in drawn} == {"", "hand", "stand"}


def test_settings_from_text():
    assert parse_mask_errors("segmenter").outline > 0
    assert parse_mask_errors("outline=2,wrong=.1") == MaskErrors(outline=2.0, wrong=0.1)

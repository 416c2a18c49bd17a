"""What a flash capture tells of each place before any fit, on a ball whose albedo is known; and a
network's features on the same places."""

import mitsuba as mi
import numpy as np
import pytest

from relit.fit.flash.dino import DinoNetwork
from relit.fit.flash.features import (
    FlashLamp,
    FlashPhotos,
    capture_features,
    flash_views_of,
    network_features,
)
from relit.fit.flash.lobe_clusters import (
    LADDER,
    SCALES,
    best_lobes,
    highlights_seen,
    pooled,
    start_kinship,
)
from relit.materials.plastic_field import plastic_at
from relit.materials.rough_plastic import Coat
from support import flash_ball as scene
from support.dino_network import write_network


@pytest.fixture(scope="module")
def shot(device):
    return scene.capture(size=56, count=30)


@pytest.fixture(scope="module")
def places():
    """Points all over the upper three quarters of the ball, with their texture coordinates."""
    rng = np.random.default_rng(4)
    v, u = rng.uniform(0.15, 0.65, 400), rng.uniform(0, 1, 400)
    theta, phi = np.pi * v, 2 * np.pi * u
    n = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), np.sin(theta) * np.cos(phi)], -1)
    return 0.7 * n, n, np.stack([u, v], -1)


FLASH = FlashLamp(np.array(scene.OFFSET), scene.INTENSITY)


@pytest.mark.slow
def test_albedo_from_photos_from_the_side(shot, places):
    bank, views, mesh, truth = shot
    x, n, uv = places
    found = capture_features(FlashPhotos(bank, views, mesh, Coat(), FLASH), x, n)
    true, _ = plastic_at(truth, mi.Point2f(uv[:, 0], uv[:, 1]))
    true = np.array(true.diffuse).T
    assert found.seen.mean() > 0.9
    ratio = (found.albedo / true)[found.seen].mean(1)
    assert np.median(ratio[true[found.seen].mean(1) > 0.3]) == pytest.approx(1, abs=0.06)
    # taken for a base under a coat of alpha .2; under one of .3 less light comes back
    assert np.median(ratio[true[found.seen].mean(1) < 0.3]) == pytest.approx(0.89, abs=0.06)
    assert found.features.shape == (400, 4)


def test_places_behind_the_ball_are_not_seen(shot, places):
    bank, views, mesh, _ = shot
    x, n, _ = places
    point, normal = (mi.Vector3f(np.ascontiguousarray(a.T, np.float32)) for a in (x, n))
    seen = flash_views_of(FlashPhotos(bank, views, mesh, Coat(), FLASH), 3, point, normal)
    facing = (n * (views[3].centre - x)).sum(1) > 0
    assert not np.array(seen.ok)[~facing].any() and np.array(seen.ok)[facing].mean() > 0.7
    u, v, _ = views[3].project(x).T
    np.testing.assert_allclose(np.array(seen.column)[facing], np.asarray(u)[facing], atol=1e-2)
    np.testing.assert_allclose(np.array(seen.row)[facing], np.asarray(v)[facing], atol=1e-2)


def test_features_of_a_network_tell_the_paints_apart(shot, places, tmp_path):
    bank, views, mesh, truth = shot
    x, n, uv = places
    write_network(tmp_path / "patches.onnx", np.random.default_rng(3).normal(0, 0.02, (5, 3, 8, 8)))
    shown = FlashPhotos(bank, views, mesh, Coat(), FLASH)
    got = network_features(shown, x, n, DinoNetwork(tmp_path / "patches.onnx"))
    true, _ = plastic_at(truth, mi.Point2f(uv[:, 0], uv[:, 1]))
    bright = np.array(true.diffuse.x) > 0.4
    dark = np.array(true.diffuse.x) < 0.2
    a, b = got[bright], got[dark]
    assert np.linalg.norm(a.mean(0) - b.mean(0)) > np.sqrt(a.var(0).sum() + b.var(0).sum())


def test_like_groups_count_each_other_s_evidence():
    """Two groups of one paint, one of another: a group without evidence takes the lobe of the like
    one."""
    rng = np.random.default_rng(0)
    paint = np.repeat([0.2, 0.2, 0.8], 100)
    features = np.stack([paint, np.repeat([0, 0.02, 0.5], 100)], -1).reshape(
        1, 300, 2
    ) + rng.normal(0, 1e-4, (1, 300, 2))
    kin = start_kinship(features, np.ones((1, 300), bool), np.full((1, 300, 2), 0.3), groups=4)
    centres = np.array(kin.index).reshape(300, 4)[:, 0]
    first, last = centres[0], centres[-1]
    assert (
        kin.apart[first, centres[150]] < min(SCALES[:3]) ** 2
        and kin.apart[first, last] > (3 * max(SCALES)) ** 2
    )
    np.testing.assert_allclose(np.array(kin.weight).reshape(300, 4).sum(1), 1, rtol=1e-5)


def test_the_best_lobe_is_that_of_the_photo():
    """Columns made of known lobes: the ladder's rung and the linear numbers come back."""
    rng = np.random.default_rng(2)
    angle = np.abs(rng.normal(0, 0.4, 4000))
    lobe = lambda a: np.exp(-((angle / a) ** 2)) / a**2  # noqa: E731
    base, white = np.cos(angle) * rng.uniform(0.3, 0.7, 4000), np.cos(angle)
    photo = 0.02 * lobe(0.21) + 1.1 * base - 0.03 * white
    sums = np.zeros((len(LADDER), 1, 4, 4))
    for k, a in enumerate(LADDER):
        columns = np.stack([lobe(a), base, white, photo])
        sums[k, 0] = columns @ columns.T
    specular, alpha, factor, shift = best_lobes(sums, np.array([[0.02, 0.3]]))[0]
    assert alpha == pytest.approx(0.21, rel=0.05) and specular == pytest.approx(0.02, rel=0.1)
    assert factor == pytest.approx(1.1, abs=0.02) and shift == pytest.approx(-0.03, abs=0.01)


def test_a_group_that_shows_no_highlight_takes_the_lobe_of_the_likest():
    """Two paints seen from all sides, and the underside of the first, seen at grazing angles alone
    and with a falloff that is wrong."""
    rng = np.random.default_rng(4)
    features = np.repeat([[0.2, 0.0], [0.8, 0.0], [0.2, 0.12]], 100, axis=0).reshape(
        1, 300, 2
    ) + rng.normal(0, 1e-4, (1, 300, 2))
    kin = start_kinship(features, np.ones((1, 300), bool), np.full((1, 300, 2), 0.3), groups=4)
    nearest = np.array(kin.index).reshape(300, 4)[:, 0]
    lobe = lambda a, t: np.exp(-((np.tan(t) / a) ** 2)) / a**2 * 0.01  # noqa: E731
    fall = lambda a, t: np.cos(t) ** (1 + 2 * a)  # noqa: E731
    for group in np.unique(nearest):
        paint = np.flatnonzero(nearest == group)[0] // 100
        low, high = (0, 1.2) if paint < 2 else (1.0, 1.4)
        angle = rng.uniform(low, high, 3000)
        alpha, specular = ((0.2, 0.8), (0.4, 0.3), (0.2, 0.8))[paint]
        base = rng.uniform(0.3, 0.7, 3000)
        photo = specular * lobe(alpha, angle) + base * fall(alpha if paint < 2 else 0.7, angle)
        for k, a in enumerate(LADDER):
            columns = np.stack([lobe(a, angle), base * fall(a, angle), fall(a, angle), photo])
            kin.sums[k, group] = columns @ columns.T
    kin.trust = highlights_seen(kin.sums)
    top, other, under = nearest[0], nearest[150], nearest[-1]
    assert kin.trust[top] == 1 and kin.trust[other] == 1 and kin.trust[under] == 0
    start = np.tile([0.5, 0.3], (4, 1))
    found = best_lobes(pooled(kin), start)
    assert found[top, 1] == pytest.approx(0.2, rel=0.1) and found[other, 1] == pytest.approx(
        0.4, rel=0.1
    )
    np.testing.assert_allclose(found[under, :2], found[top, :2], rtol=0.02)
    alone = best_lobes(kin.sums, start)  # what it would take from itself
    assert alone[under, 1] > 0.5
    kept = np.array(kin.own(0.99)).reshape(300, 2)
    assert kept[:100].min() > 0.95 and kept[-100:].max() < 0.9

"""Steps of the base colour over whole stretches of surface."""

import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")

SIZE = 32


@pytest.fixture(scope="module")
def sheet():
    """A flat grid of 17 x 17 vertices, its uvs all over the texture."""
    from relit.scene import Mesh

    u, v = np.meshgrid(np.linspace(0, 1, 17), np.linspace(0, 1, 17))
    vertices = np.stack([u.ravel(), v.ravel(), 0 * u.ravel()], 1).astype(np.float32)
    i = (np.arange(16)[:, None] * 17 + np.arange(16)).ravel()
    faces = np.concatenate([np.stack([i, i + 1, i + 18], 1), np.stack([i, i + 18, i + 17], 1)])
    normals = np.tile(np.array([0, 0, 1], np.float32), (len(vertices), 1))
    return Mesh(vertices, faces.astype(np.uint32), normals, vertices[:, :2].copy())


def test_a_shade_over_a_stretch_is_taken_away_at_once(sheet):
    from relit.fit.passes.broad_steps import BroadSteps

    steps, rng = BroadSteps(sheet, SIZE), np.random.default_rng(0)
    uv = rng.uniform(size=(20_000, 2))
    true = np.where(uv[:, :1] < 0.5, 0.8, 1.25) * np.ones(
        3
    )  # the left half came out too bright, the right one too dark
    a, b = (1 + 0.3 * rng.normal(size=(2, len(uv), 1))) * np.ones(
        3
    )  # noise of estimates does not bias the factor
    target = true * (1 + 0.1 * rng.normal(size=true.shape))
    one = np.ones_like(true)
    seen = one * (uv[:, 1:] < 0.9)  # the upper end is not seen
    steps.add(mi.Point2f(uv.T), *(mi.Color3f(x.T) for x in (seen, a, b, target)))
    factor = steps.factors()
    assert factor.shape == (SIZE, SIZE, 4) and (factor[..., 3] == 1).all()
    assert np.allclose(factor[2:24, 2:10, :3], 0.8, atol=0.03) and np.allclose(
        factor[2:24, 22:30, :3], 1.25, atol=0.04
    )
    assert (steps.shown == 0).all()  # forgotten
    steps.add(mi.Point2f(uv.T), *(mi.Color3f(x.T) for x in (one, a, b, 9 * one)))
    assert steps.factors()[..., :3].max() == pytest.approx(1.4)  # never more at once


def test_what_is_not_seen_stays(sheet):
    from relit.fit.passes.broad_steps import BroadSteps

    steps = BroadSteps(sheet, SIZE)
    uv, one = np.random.default_rng(1).uniform(0, [0.3, 1], size=(4000, 2)), np.ones((4000, 3))
    steps.add(mi.Point2f(uv.T), *(mi.Color3f(x.T) for x in (one, one, one, 1.3 * one)))
    factor = steps.factors()[..., :3]
    assert np.allclose(factor[:, :8], 1.3, atol=0.02) and np.allclose(
        factor[:, 24:], 1.0, atol=1e-3
    )

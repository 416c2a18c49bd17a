"""Steps along which light and base colour change against each other."""

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from relit.conventions import environment_directions, environment_solid_angles
from relit.fit.passes.exchange import Exchange, hat_weights, mirrored

LIGHT, SIZE = 16, 12


def start(seed=0, hats=4):
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(SIZE, SIZE, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    light = np.exp(rng.normal(size=(LIGHT, 2 * LIGHT, 3)))
    colour = np.concatenate(
        [rng.uniform(0.2, 0.5, (SIZE, SIZE, 3)), np.full((SIZE, SIZE, 1), 0.4)], -1
    )
    exchange = Exchange(normals, SIZE**2, LIGHT, hats)
    exchange.refresh(flat(light))
    return exchange, normals.reshape(-1, 3), light, colour.reshape(-1, 4)


def flat(a):
    """Copied into Dr.Jit's own memory: NumPy's is lent as it lies, and which kernel reads it
    depends on how it is aligned."""
    return mi.Float(np.asarray(a, np.float32).ravel().tolist())


def move(exchange, light, colour, g_light, g_colour, rate=0.02, metallic=None):
    colour, log_light = exchange.step(
        flat(colour), flat(np.log(light)), flat(g_colour), flat(g_light), rate, metallic
    )
    return np.array(colour).reshape(-1, 4), np.exp(np.array(log_light).reshape(light.shape))


def diffuse(normals, light, colour):
    d = environment_directions(LIGHT, 2 * LIGHT).reshape(-1, 3)
    w = environment_solid_angles(LIGHT, 2 * LIGHT).reshape(-1, 1)
    return colour[:, :3] * (np.maximum(normals @ d.T, 0) @ (light.reshape(-1, 3) * w))


def test_weights_of_the_hats_sum_to_one():
    w = hat_weights(16, 4)
    assert w.shape == (512, 32) and w.min() >= 0
    np.testing.assert_allclose(w.sum(1), 1)


@pytest.mark.parametrize("rows", [4, 16, 24, 64])
@pytest.mark.parametrize("faces", [True, False])
def test_shares_are_those_of_the_light(rows, faces):
    """Against matrices in NumPy, for maps that are smaller, as large and larger than the table."""
    light = np.exp(np.random.default_rng(rows).normal(size=(rows, 2 * rows, 3)) * 2)
    exchange = Exchange(np.tile([0.0, 1.0, 0.0], (4, 1)) if faces else None, 4, rows)
    exchange.refresh(flat(light))
    d, area = (
        environment_directions(16, 32).reshape(-1, 3),
        environment_solid_angles(16, 32).reshape(-1),
    )
    cosines = (np.maximum(d @ d.T, 0) if faces else np.ones((512, 512))) * area
    small = cv2.resize(light.mean(-1), (32, 16), interpolation=cv2.INTER_AREA).ravel() + 1e-6
    expected = (cosines * small) @ hat_weights(16, 4) / (cosines @ small)[:, None]
    np.testing.assert_allclose(
        np.array(exchange.share).reshape(512, 32), expected, rtol=2e-5, atol=1e-9
    )


def test_diffuse_radiance_stays_where_light_moves():
    """The light moves by many times what the radiance of diffuse surfaces does. Light of one
    colour: the table is of its mean."""
    exchange, normals, light, colour = start()
    light = np.repeat(light.mean(-1, keepdims=True), 3, -1)
    exchange.refresh(flat(light))
    before = diffuse(normals, light, colour)
    rng = np.random.default_rng(1)
    after_colour, after = move(
        exchange, light, colour, rng.normal(size=light.shape), np.zeros_like(colour), 0.05
    )
    moved = np.abs(np.log(after / light)).mean()
    changed = np.abs(np.log(diffuse(normals, after, after_colour) / before)).mean()
    unpaired = np.abs(np.log(diffuse(normals, after, colour) / before)).mean()
    assert moved > 0.02
    assert changed < 0.35 * unpaired  # normals are binned to a table of 16 rows
    np.testing.assert_array_equal(after_colour[:, 3], colour[:, 3].astype(np.float32))


def test_one_scale_is_among_the_moves_and_follows_the_slope():
    """Light times e^c, colour times e^-c, channel by channel, against the slope of the loss along
    that line."""
    exchange, _, light, colour = start()
    g_light, g_colour = np.zeros_like(light), np.zeros_like(colour)
    g_light[..., 0] = 0.1  # red: the light should fall
    g_colour[:, 1] = 0.1  # green: the colour should fall, so the light rises
    g_colour[:, 3] = 5.0  # roughness is no part of it
    after_colour, after = move(exchange, light, colour, g_light, g_colour)
    c = np.log(after / light)
    np.testing.assert_allclose(c, np.broadcast_to([-0.02, 0.02, 0.0], c.shape), atol=1e-4)
    np.testing.assert_allclose(
        after_colour[:, :3], colour[:, :3] * np.exp([0.02, -0.02, 0.0]), rtol=1e-4
    )


def test_what_is_mirrored_counts_as_reflectance():
    """Black paint reflects too: all that a texel reflects, times the light, stays, and its colour,
    which could not fall further, pulls."""
    exchange, _, light, colour = start()
    colour[:, :3] = 0.0
    colour[:50, 1] = 0.3
    g_colour = np.zeros_like(colour)
    g_colour[50:, :3] = -0.1  # the black ones would rather be brighter, so that the light falls
    metallic = np.zeros(SIZE**2, np.float32)
    metallic[-20:] = 1  # metal reflects nothing besides its base colour
    after_colour, after = move(
        exchange, light, colour, np.zeros_like(light), g_colour, metallic=mi.Float(metallic)
    )
    c = np.log(after / light)
    np.testing.assert_allclose(c, np.full_like(c, -0.02), atol=1e-4)
    s = np.array(mirrored(mi.Float(0.4)))[0] * (1 - metallic)[:, None]
    np.testing.assert_allclose(
        after_colour[:, :3] + s, (colour[:, :3] + s) * np.exp(0.02), rtol=1e-4
    )
    still, _ = move(
        start()[0], light, np.where(np.arange(4) < 3, 0.0, colour), np.zeros_like(light), g_colour
    )
    assert not still[:, :3].any()


@pytest.mark.parametrize("roughness", [0.15, 0.3, 0.5, 0.7, 1.0])
def test_mirrored_is_what_black_paint_reflects_under_even_light(roughness):
    """Over views that stand on the hemisphere by their cosine; directions of the light by mirrors
    drawn from GGX."""
    from relit.materials.brdf import Surface, evaluate_brdf, ggx_d

    rng = np.random.default_rng(4)
    a, n = roughness**2, 200_000
    u, phi = rng.uniform(size=(2, n)), rng.uniform(0, 2 * np.pi, (2, n))
    z = np.sqrt([1 - u[0], (1 - u[1]) / (1 + (a * a - 1) * u[1])])
    r = np.sqrt(1 - z * z)
    v, h = (
        mi.Vector3f(*d.astype(np.float32))
        for d in np.stack([r * np.cos(phi), r * np.sin(phi), z], 1)
    )
    l = 2 * dr.dot(v, h) * h - v
    density = ggx_d(h.z, a) * h.z / (4 * dr.maximum(dr.dot(v, h), 1e-6))
    black = Surface(mi.Color3f(0.0), mi.Float(roughness), mi.Float(0.0))
    f = dr.select(
        (l.z > 0) & (dr.dot(v, h) > 0),
        evaluate_brdf(black, mi.Vector3f(0, 0, 1), v, l).x / density,
        0,
    )
    assert np.array(f).mean() == pytest.approx(
        np.array(mirrored(mi.Float(roughness)))[0], abs=0.006
    )


def test_without_normals_every_texel_is_as_if_it_faced_all_sides():
    _, _, light, colour = start()
    exchange = Exchange(None, SIZE**2, LIGHT)
    exchange.refresh(flat(light))
    g = np.zeros_like(light)
    g[..., 1] = 0.1
    after_colour, after = move(exchange, light, colour, g, np.zeros_like(colour))
    np.testing.assert_allclose(
        np.log(after / light), np.broadcast_to([0, -0.02, 0], light.shape), atol=1e-4
    )
    np.testing.assert_allclose(after_colour[:, 1], colour[:, 1] * np.exp(0.02), rtol=1e-4)


def test_slope_along_a_move_is_that_of_the_loss():
    """For a loss sum(p log light) + sum(q colour), the gradient that the step sees is the finite
    difference along each move."""
    exchange, _, light, colour = start(hats=2)
    rng = np.random.default_rng(2)
    p, q = rng.normal(size=light.shape), rng.normal(size=colour.shape)
    q[:, 3] = 0
    seen = {}

    class Watch:
        def step(self, parameter, gradient, rate, ratio=1.0):
            seen["gradient"] = np.array(gradient)
            return mi.Float(seen["move"])

    exchange.adam = Watch()
    for lane in (0, 7, 13, 23):
        seen["move"] = np.zeros(24, np.float32)
        seen["move"][lane] = 0.01
        after_colour, after = move(exchange, light, colour, p, q)
        change = (p * np.log(after / light)).sum() + (q * (after_colour - colour)).sum()
        assert change / 0.01 == pytest.approx(seen["gradient"][lane], rel=0.02, abs=0.01)


def test_a_step_compiles_nothing_new():
    exchange, _, light, colour = start()
    rng = np.random.default_rng(3)
    move(exchange, light, colour, rng.normal(size=light.shape), rng.normal(size=colour.shape), 0.01)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for k in range(3):
            exchange.refresh(flat(light * (1 + k)))
            move(
                exchange,
                light,
                colour,
                rng.normal(size=light.shape),
                rng.normal(size=colour.shape),
                0.01 * (k + 1),
            )
        history = dr.kernel_history()
    assert history and all(k["cache_hit"] for k in history if "cache_hit" in k)

import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")


def lights(count=3):
    from relit.lighting.per_photo import PhotoLights, load_light_prior, log_lights

    rng = np.random.default_rng(0)
    k = load_light_prior()[1].shape[0]
    return PhotoLights(
        mi.Float(
            np.exp(
                log_lights(rng.normal(size=(count, k)), rng.normal(size=(count, 3)) * 0.3)
            ).ravel()
        ),
        count,
    )


def directions(count):
    d = np.random.default_rng(1).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def test_each_lane_sees_its_own_light():
    from relit.conventions import sample_environment

    maps, d = lights(), directions(60)
    which = np.arange(60) % 3
    of = maps.of(mi.UInt32(which.astype(np.uint32)))
    got = np.array(of.eval(mi.Vector3f(*d.T.astype(np.float32)))).T
    images = maps.images()
    expected = np.array([sample_environment(images[w], v) for w, v in zip(which, d, strict=True)])
    assert np.allclose(got, expected, rtol=2e-3, atol=1e-4)


def test_sampling_agrees_with_its_density():
    """The mean of 1 / pdf over samples is the sphere's area, and the mean of f / pdf the integral
    of f, light by light."""
    import drjit as dr

    from relit.conventions import (
        environment_directions,
        environment_solid_angles,
        sample_environment,
    )
    from relit.lighting.per_photo import COLUMNS, ROWS

    maps, n = lights(), 60_000
    which = dr.arange(mi.UInt32, n) % 3
    rng = mi.PCG32(size=n)
    of = maps.of(which)
    d, density = of.sample(mi.Point2f(rng.next_float32(), rng.next_float32()))
    assert np.allclose(np.array(density), np.array(of.pdf(d)), rtol=1e-2)
    value = np.array(mi.luminance(of.eval(d)) / density)
    fine = environment_directions(8 * ROWS, 8 * COLUMNS)
    area = environment_solid_angles(8 * ROWS, 8 * COLUMNS)[..., None]
    for k in range(3):
        integral = float(
            (sample_environment(maps.images()[k], fine) * area).sum((0, 1))
            @ np.array([0.2126, 0.7152, 0.0722])
        )
        own = value[k::3]
        assert abs(own.mean() - integral) < 4 * own.std() / np.sqrt(len(own)) + 0.01 * integral


def test_the_prior_knows_what_is_up():
    from relit.lighting.per_photo import COLUMNS, ROWS, load_light_prior

    mean, basis = load_light_prior()
    sky, ground = (
        mean.reshape(ROWS, COLUMNS, 3)[: ROWS // 2].mean(),
        mean.reshape(ROWS, COLUMNS, 3)[ROWS // 2 :].mean(),
    )
    assert sky > ground
    assert np.isfinite(basis).all() and basis.shape[1] == ROWS * COLUMNS * 3
    turned = mean.reshape(ROWS, COLUMNS, 3)
    assert (
        np.abs(turned - turned.mean(1, keepdims=True)).max() < 2e-2
    )  # learnt under all turns: the mean has no azimuth


def test_the_shipped_light_comes_from_above():
    """Irradiance of the middle light on what faces up, aside and down: a ground of ordinary
    reflectance sends back a fifth to a half."""
    from relit.conventions import environment_directions, environment_solid_angles
    from relit.lighting.per_photo import COLUMNS, ROWS, load_light_prior

    mean, basis = load_light_prior()
    radiance = np.exp(mean).reshape(-1, 3)
    directions = environment_directions(ROWS, COLUMNS).reshape(-1, 3)
    angles = environment_solid_angles(ROWS, COLUMNS).ravel()
    up, aside, down = (
        (np.maximum(directions @ np.array(n), 0) * angles) @ radiance
        for n in ([0, 1.0, 0], [1.0, 0, 0], [0, -1.0, 0])
    )
    assert (
        (up > 1.5 * aside).all()
        and (aside > 1.2 * down).all()
        and (0.2 * up < down).all()
        and (down < 0.5 * up).all()
    )
    assert basis.shape[0] >= 64

"""Spherical Gaussians: closed forms against sums, and the fit to maps that are known."""

import json

import numpy as np
import pytest

from relit.conventions import environment_directions, environment_solid_angles
from relit.errors import UserError
from relit.lighting.spherical_gaussians import (
    SphericalGaussians,
    energy,
    environment_of,
    fibonacci,
    fit_spherical_gaussians,
    gaussian_radiance,
    read_lobes,
    rotate,
    write_lobes,
)


def some(count=6, seed=0):
    rng = np.random.default_rng(seed)
    return SphericalGaussians(
        fibonacci(count), rng.uniform(2, 60, count), rng.uniform(0.1, 5, (count, 3))
    )


def energy_of_map(image):
    return (image * environment_solid_angles(*image.shape[:2])[..., None]).sum((0, 1))


def irradiance(image):
    """(200, 3) over as many normals."""
    d = environment_directions(*image.shape[:2]).reshape(-1, 3)
    cos = np.maximum(fibonacci(200) @ d.T, 0) * environment_solid_angles(*image.shape[:2]).ravel()
    return cos @ image.reshape(-1, 3)


def test_one_lobe_is_the_formula():
    sg = SphericalGaussians(np.array([[0, 1.0, 0]]), np.array([3.0]), np.array([[2.0, 1, 0.5]]))
    assert np.allclose(gaussian_radiance(sg, [0, 1, 0]), [2, 1, 0.5])
    assert np.allclose(gaussian_radiance(sg, [[[1, 0, 0]]]), np.exp(-3) * np.array([2, 1, 0.5]))


@pytest.mark.parametrize("sharpness", [0.5, 20.0, 3000.0])
def test_energy_is_the_integral(sharpness):
    sg = SphericalGaussians(
        np.array([[0.6, 0, 0.8]]), np.array([sharpness]), np.array([[1.0, 2, 3]])
    )
    assert np.allclose(energy_of_map(environment_of(sg, 64, 128)), energy(sg), rtol=5e-3)


def test_a_map_made_of_lobes_is_recovered():
    truth = some()
    image = environment_of(truth, 64, 128)
    back = environment_of(fit_spherical_gaussians(image, 24), 64, 128)
    assert np.sqrt(np.mean((back - image) ** 2) / np.mean(image**2)) < 0.1


def test_energy_and_irradiance_are_kept_with_a_sun_in_the_sky():
    rng = np.random.default_rng(1)
    image = environment_of(some(5, 3), 48, 96) + 0.2 * rng.random((48, 96, 3)).astype(np.float32)
    image[10, 30] = [7000, 6500, 5000]
    sg = fit_spherical_gaussians(image)
    assert np.allclose(energy(sg), energy_of_map(image), rtol=1e-3)
    back = environment_of(sg, 48, 96)
    a, b = irradiance(image), irradiance(back)
    assert np.sqrt(np.mean((a - b) ** 2) / np.mean(a**2)) < 0.01
    brightest = sg.axis[np.argmax(sg.amplitude.sum(1) / sg.sharpness)]
    assert brightest @ environment_directions(48, 96)[10, 30] > np.cos(np.radians(3))
    assert (sg.amplitude >= 0).all()
    assert (sg.sharpness > 0).all()
    assert np.allclose(np.linalg.norm(sg.axis, axis=1), 1)


def test_large_and_odd_maps_keep_their_energy():
    image = np.random.default_rng(2).random((150, 301, 3)).astype(np.float32)
    assert np.allclose(
        energy(fit_spherical_gaussians(image, 16, steps=5)), energy_of_map(image), rtol=1e-4
    )


def test_black_map_and_one_colour():
    assert energy(fit_spherical_gaussians(np.zeros((8, 16, 3)), 4)).max() == 0
    sg = fit_spherical_gaussians(np.ones((8, 16, 3)) * [1, 0, 0], 4, steps=10)
    assert energy(sg)[0] == pytest.approx(4 * np.pi)
    assert energy(sg)[1:].max() == 0


def test_rotation_turns_the_light():
    sg = some()
    turn = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]], float)
    d = fibonacci(50)
    assert np.allclose(
        gaussian_radiance(rotate(sg, 2.5 * turn), d @ turn.T), gaussian_radiance(sg, d)
    )


def test_file_round_trip(tmp_path):
    sg = some()
    write_lobes(tmp_path / "light.json", sg)
    got = read_lobes(tmp_path / "light.json")
    assert np.allclose(got.axis, sg.axis)
    assert np.allclose(got.sharpness, sg.sharpness)
    assert np.allclose(got.amplitude, sg.amplitude)


@pytest.mark.parametrize(
    "text",
    [
        "{",
        "[]",
        '{"lobes": []}',
        '{"lobes": [{"axis": [0, 0], "sharpness": 1, "amplitude": [1, 1, 1]}]}',
        '{"lobes": [{"axis": [0, 0, 0], "sharpness": 1, "amplitude": [1, 1, 1]}]}',
        '{"lobes": [{"axis": [0, 0, 1], "sharpness": -1, "amplitude": [1, 1, 1]}]}',
        json.dumps(
            {"lobes": [{"axis": [0, 0, 1], "sharpness": 1, "amplitude": [1, 1, float("nan")]}]}
        ),
    ],
)
def test_bad_files_get_an_answer(tmp_path, text):
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(UserError, match="no spherical Gaussians"):
        read_lobes(tmp_path / "a.json")


def test_bad_maps_get_an_answer():
    with pytest.raises(UserError):
        fit_spherical_gaussians(np.full((4, 8, 3), np.nan))
    with pytest.raises(UserError):
        fit_spherical_gaussians(np.ones((4, 8)))
    with pytest.raises(UserError):
        fit_spherical_gaussians(np.ones((4, 8, 3)), 0)

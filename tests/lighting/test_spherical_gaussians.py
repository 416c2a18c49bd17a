"""Spherical Gaussians: closed forms against sums, and files."""

import json

import numpy as np
import pytest

from relit.conventions import environment_solid_angles
from relit.errors import UserError
from relit.lighting.spherical_gaussians import SphericalGaussians, environment_of, evaluate, fibonacci, read_json


def some(count=6, seed=0):
    rng = np.random.default_rng(seed)
    return SphericalGaussians(fibonacci(count), rng.uniform(2, 60, count), rng.uniform(0.1, 5, (count, 3)))


def energy_of_map(image):
    return (image * environment_solid_angles(*image.shape[:2])[..., None]).sum((0, 1))


def test_one_lobe_is_the_formula():
    sg = SphericalGaussians(np.array([[0, 1.0, 0]]), np.array([3.0]), np.array([[2.0, 1, 0.5]]))
    assert np.allclose(evaluate(sg, [0, 1, 0]), [2, 1, 0.5])
    assert np.allclose(evaluate(sg, [[[1, 0, 0]]]), np.exp(-3) * np.array([2, 1, 0.5]))


@pytest.mark.parametrize("sharpness", [0.5, 20.0, 3000.0])
def test_a_map_keeps_the_energy_of_its_lobes(sharpness):
    """The integral over the sphere: 2 pi mu / lambda (1 - exp(-2 lambda))."""
    sg = SphericalGaussians(np.array([[0.6, 0, 0.8]]), np.array([sharpness]), np.array([[1.0, 2, 3]]))
    energy = -2 * np.pi / sharpness * np.expm1(-2 * sharpness) * sg.amplitude[0]
    assert np.allclose(energy_of_map(environment_of(sg, 64, 128)), energy, rtol=5e-3)


def test_lobes_from_a_file(tmp_path):
    sg = some()
    columns = zip(2 * sg.axis, sg.sharpness, sg.amplitude, strict=True)  # axes of any length
    lobes = [{"axis": a.tolist(), "sharpness": float(s), "amplitude": m.tolist()} for a, s, m in columns]
    (tmp_path / "light.json").write_text(json.dumps({"lobes": lobes}))
    got = read_json(tmp_path / "light.json")
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
        json.dumps({"lobes": [{"axis": [0, 0, 1], "sharpness": 1, "amplitude": [1, 1, float("nan")]}]}),
    ],
)
def test_bad_files_get_an_answer(tmp_path, text):
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(UserError, match="no spherical Gaussians"):
        read_json(tmp_path / "a.json")

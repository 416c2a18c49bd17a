"""Neural-PIL's light network: reading, derivatives, refusals. It is not ours to ship: a random one
of its shape stands in."""

from pathlib import Path

import numpy as np
import pytest

from relit.errors import UserError
from relit.lighting.neural_pil import CODE, SHAPES, load_neural_pil
from relit.lighting.per_photo import COLUMNS, ROWS, TEXELS, log_lights, mean_level
from support.neural_pil_files import write_network

REAL = Path(__file__).parents[2] / "shared" / "data" / "weights" / "neural_pil"
REAL = (
    REAL
    if REAL.is_dir()
    else Path(__file__).parents[3] / "shared" / "data" / "weights" / "neural_pil"
)


def test_lights_and_their_derivative(tmp_path):
    write_network(tmp_path)
    network, rng = load_neural_pil(tmp_path), np.random.default_rng(1)
    noise, along = rng.normal(size=(2, 2, CODE)).astype(np.float32)
    gradient = rng.normal(size=(2, TEXELS * 3)).astype(np.float32)
    maps = network.log_maps(noise)
    assert maps.shape == (2, TEXELS * 3) and np.isfinite(maps).all()
    assert np.abs(maps[0] - maps[1]).mean() > 0.05
    step = 2e-3
    sums = [
        (network.log_maps(noise + s * step * along).astype(np.float64) * gradient).sum(1)
        for s in (1, -1)
    ]
    expected = (sums[0] - sums[1]) / (2 * step)
    assert np.allclose(
        (network.pull_back(noise, gradient) * along).sum(1),
        expected,
        rtol=0.05,
        atol=0.05 * np.abs(expected).max(),
    )


def test_a_file_as_numpy_names_its_arrays(tmp_path):
    """`numpy.savez("network.npz", *arrays)`, as the guide says: arr_10 comes after arr_9, not after
    arr_1."""
    write_network(tmp_path)
    padded = load_neural_pil(tmp_path)
    (tmp_path / "illumination-network_network.npz").unlink()
    np.savez(tmp_path / "network.npz", *padded.weights)
    plain = load_neural_pil(tmp_path)
    assert all(np.array_equal(a, b) for a, b in zip(plain.weights, padded.weights, strict=True))


def test_codes_stay_within_three_deviations(tmp_path):
    write_network(tmp_path)
    code, _ = load_neural_pil(tmp_path).codes(np.full((1, CODE), 50.0))
    assert np.allclose(code, 3.0, atol=0.02)


def test_gains_come_on_top(tmp_path):
    write_network(tmp_path)
    network = load_neural_pil(tmp_path)
    none = np.zeros((1, CODE), np.float32)
    brighter = log_lights(none, np.full((1, 3), np.log(2)), network)
    assert np.allclose(
        np.exp(brighter).reshape(TEXELS, 3).mean(0), 2 * mean_level(network), rtol=1e-3
    )


@pytest.mark.parametrize(
    "wrong", ["nowhere", "empty", "pickled", "shape", "codes", "no codes", "object array"]
)
def test_what_is_no_network_is_refused(tmp_path, wrong):
    folder = tmp_path / "network"
    if wrong != "nowhere":
        folder.mkdir()
    if wrong in ("shape", "codes", "no codes"):
        write_network(folder, (*SHAPES[:-1], (7,)) if wrong == "shape" else SHAPES)
    if wrong == "pickled":
        np.save(
            folder / "network.npy",
            np.array([np.zeros(3), np.zeros(4)], dtype=object),
            allow_pickle=True,
        )
    if wrong == "object array":
        np.savez(folder / "network.npz", a=np.array([np.zeros(3), "x"], dtype=object))
    if wrong == "codes":
        np.save(folder / "illumination_latent_mean_std.npy", np.zeros((3, CODE), np.float32))
    if wrong == "no codes":
        (folder / "illumination_latent_mean_std.npy").unlink()
    with pytest.raises(UserError) as caught:
        load_neural_pil(folder)
    assert ("pickle" in str(caught.value)) == (wrong in ("pickled", "object array"))


def test_the_real_network_draws_skies():
    if not REAL.is_dir():
        pytest.skip("Neural-PIL's weights are not here")
    network = load_neural_pil(REAL)
    noise = np.random.default_rng(0).normal(size=(40, CODE)).astype(np.float32)
    maps = np.exp(network.log_maps(noise)).reshape(-1, ROWS, COLUMNS, 3)
    assert np.median(maps.max((1, 2, 3)) / maps.mean((1, 2, 3))) > 8  # lamps, not mush
    assert (
        np.median(maps[:, : ROWS // 2].mean((1, 2, 3)) / maps[:, ROWS // 2 :].mean((1, 2, 3))) > 1.1
    )  # light comes from above

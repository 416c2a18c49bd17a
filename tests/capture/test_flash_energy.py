"""WildLight's light_energy_i: photos without flash are left out of a flash capture, and others
scaled where the flash's power differs."""

import numpy as np
import pytest

from relit.capture.open import open_capture
from relit.errors import UserError
from relit.job import Job, open_as
from support import camera_ring


@pytest.fixture
def folder(tmp_path, cameras):
    """A function that writes the camera file with energies, {index: three numbers}."""
    camera_ring.write_photos(tmp_path / "image", cameras)

    def write(energies):
        arrays = {f"world_mat_{i}": camera_ring.projection(c) for i, c in enumerate(cameras)}
        arrays |= {f"scale_mat_{i}": np.diag([1.5, 1.5, 1.5, 1.0]) for i in range(len(cameras))}
        arrays |= {f"light_energy_{i}": np.asarray(e) for i, e in energies.items()}
        np.savez(tmp_path / "cameras_sphere.npz", **arrays)
        return tmp_path

    return write


@pytest.fixture
def cameras():
    return camera_ring.ring()


def test_photos_without_flash_are_left_out(folder):
    """Index 2 has energy 0, index 4 none: both are off."""
    path = folder({0: [5, 5, 5], 1: [5, 5, 5], 2: [0, 0, 0], 3: [5, 5, 5], 5: [5, 5, 5]})
    capture, kind = open_as(path, Job(capture="flash"))
    assert kind == "flash" and [p.name for p in capture.photos] == [
        f"image/{i:03d}.png" for i in (0, 1, 3, 5)
    ]
    assert any("2 of 6 photos were taken without the flash" in n for n in capture.notes)
    before = {p.name: p.load().rgb for p in open_capture(path).photos}
    for photo in capture.photos:
        np.testing.assert_array_equal(photo.load().rgb, before[photo.name])


def test_another_kind_of_capture_keeps_all(folder):
    capture, _ = open_as(folder({0: [5, 5, 5]}), Job(capture="multiview"))
    assert len(capture.photos) == 6


def test_photos_under_different_energies_are_evened_out(folder):
    path = folder({i: np.full(3, 4.0 if i % 2 else 2.0) for i in range(6)})
    capture, _ = open_as(path, Job(capture="flash"))
    before = {p.name: p.load().rgb for p in open_capture(path).photos}
    for i, photo in enumerate(capture.photos):
        np.testing.assert_allclose(
            photo.load().rgb, before[photo.name] * (1 if i % 2 else 2), rtol=1e-6
        )
        assert (
            photo.load().white == pytest.approx(1 if i % 2 else 2)
            and photo.load().clipped is not None
        )
    assert any("2 to 4" in n and "scaled" in n for n in capture.notes)


def test_files_without_energies_are_as_they_were(folder):
    capture, _ = open_as(folder({}), Job(capture="flash"))
    assert len(capture.photos) == 6 and capture.photos[0].flash_energy is None


@pytest.mark.parametrize(
    "energies, message",
    [
        ({0: [0.0] * 3}, "0 of 6 photos were taken with the flash on"),
        ({1: [-1.0] * 3}, "light_energy_1"),
    ],
)
def test_senseless_energies(folder, energies, message):
    with pytest.raises(UserError, match=message):
        open_as(folder(energies), Job(capture="flash"))

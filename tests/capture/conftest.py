"""The capture that tests of reading spoil: six photos with known cameras in transforms.json."""

import pytest

from support import camera_ring


@pytest.fixture
def cameras():
    return camera_ring.ring()


@pytest.fixture
def capture_folder(tmp_path, cameras):
    names = camera_ring.write_photos(
        tmp_path / "images", cameras, background=camera_ring.BACKGROUND
    )
    camera_ring.write_transforms(tmp_path, cameras, [f"images/{n}" for n in names])
    return tmp_path

"""The capture that tests of reading spoil: six photos with known cameras in transforms.json."""

import pytest
import shots


@pytest.fixture
def cameras():
    return shots.ring()


@pytest.fixture
def capture_folder(tmp_path, cameras):
    names = shots.write_photos(tmp_path / "images", cameras, background=shots.BACKGROUND)
    shots.write_transforms(tmp_path, cameras, [f"images/{n}" for n in names])
    return tmp_path

"""The capture on which each pass runs."""

import pytest

from support import flash_ball


@pytest.fixture(scope="session")
def shot(device):
    """(bank, cameras, mesh, textures) of a ball."""
    return flash_ball.capture(size=16, count=4)

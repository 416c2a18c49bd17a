"""The pile of pawns that the tests of duplicates share."""

import numpy as np
import pytest

from relit.asset.gltf import write_glb
from relit.images import write_linear
from relit.synthesize.duplicates import synthesize_duplicates
from relit.synthesize.procedural import pawn
from support.pile_of_pawns import SIZES


@pytest.fixture(scope="session")
def pile(tmp_path_factory):
    """A capture of four pawns with its truth; no test writes into it."""
    folder = tmp_path_factory.mktemp("pile")
    write_glb(folder / "pawn.glb", *pawn(rows=16, columns=20, texture=32))
    light = np.full((8, 16, 3), 0.5, np.float32)
    light[1:3, 3:6] = 8.0
    write_linear(folder / "light.exr", light)
    relights = [folder / "light.exr"]
    return synthesize_duplicates(
        folder / "pawn.glb", folder / "light.exr", folder / "capture", relights=relights, **SIZES
    )

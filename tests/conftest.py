"""Fixtures for every test: the device is chosen once, and the optional data is looked for once."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

os.environ.setdefault("OMP_NUM_THREADS", "2")


@pytest.fixture(scope="session", autouse=True)
def device() -> str:
    """Mitsuba's variant is set before anything touches its types; `RELIT_TEST_DEVICE` may name `cuda`."""
    from relit.device import use_device

    return use_device(os.environ.get("RELIT_TEST_DEVICE", "cpu"))


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder with the third-party photos, models and environment maps; `RELIT_DATA` names another place."""
    here = Path(__file__).resolve().parents[1]
    for folder in [os.environ.get("RELIT_DATA"), here / "shared" / "data", here.parent / "shared" / "data"]:
        if folder and Path(folder).is_dir():
            return Path(folder)
    pytest.skip("needs the third-party data (set RELIT_DATA to its folder)")

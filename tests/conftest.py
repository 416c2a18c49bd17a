"""Fixtures for every test: the device is chosen once, and the optional data is looked for once."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

PARALLEL = "PYTEST_XDIST_WORKER" in os.environ  # tests run side by side, each on one thread
os.environ.setdefault("OMP_NUM_THREADS", "1" if PARALLEL else "2")


@pytest.fixture(scope="session", autouse=True)
def device() -> str:
    """Mitsuba's variant is set before anything touches its types; `RELIT_TEST_DEVICE` may name
    `cuda`."""
    from relit.device import use_device

    variant = use_device(os.environ.get("RELIT_TEST_DEVICE", "cpu"))
    if PARALLEL:
        import drjit as dr

        dr.set_thread_count(1)
    return variant


@pytest.fixture
def load_scene(device) -> Callable[[Path], Any]:
    """`mitsuba.load_file`, which waits for itself for ever where Dr.Jit has one thread."""
    import drjit as dr
    import mitsuba as mi

    def load(path: Path) -> Any:
        threads = dr.thread_count()
        dr.set_thread_count(max(threads, 2))
        try:
            return mi.load_file(str(path))
        finally:
            dr.set_thread_count(threads)

    return load


@pytest.fixture
def report_sizes(monkeypatch) -> Callable[..., None]:
    """Shrinks the pictures of the report; called with names of constants of report/page.py, it
    changes those."""
    from relit.report import page

    def shrink(**sizes: int) -> None:
        for name, value in sizes.items():
            monkeypatch.setattr(page, name, value)

    shrink(SIDE=24, STILLS=2, SPP=1, SPP_COMPARED=1, VIEWS=1, HELD_OUT=1)
    return shrink


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder with the third-party photos, models and environment maps; `RELIT_DATA` names another
    place."""
    here = Path(__file__).resolve().parents[1]
    for folder in [
        os.environ.get("RELIT_DATA"),
        here / "shared" / "data",
        here.parent / "shared" / "data",
    ]:
        if folder and Path(folder).is_dir():
            return Path(folder)
    pytest.skip("needs the third-party data (set RELIT_DATA to its folder)")

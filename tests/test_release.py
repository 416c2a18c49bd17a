"""What is published: the wheel installs into an environment of its own, carries what it needs, and
its command line runs there."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

from relit.viewer.page import PAGE

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ("src", "LICENSE", "MANIFEST.in", "README.md", "pyproject.toml")


def check_release():
    spec = importlib.util.spec_from_file_location("check_release", ROOT / "tools/check_release.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """Built without network: setuptools must be there in the version that pyproject.toml asks
    for."""
    if int(version("setuptools").split(".")[0]) < 77:
        have = version("setuptools")
        pytest.skip(
            f"a wheel is built by setuptools 77 or newer, here is {have} (make setup installs it; make dist fetches its own)"
        )
    pytest.importorskip("build", reason="the package `build` is not installed")
    copy = tmp_path_factory.mktemp("sources")
    for name in SOURCES:
        if (ROOT / name).is_dir():
            shutil.copytree(
                ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__", "*.egg-info")
            )
        else:
            shutil.copy(ROOT / name, copy / name)
    command = [
        sys.executable,
        "-m",
        "build",
        "--wheel",
        "--no-isolation",
        "--outdir",
        str(copy / "dist"),
        str(copy),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return next((copy / "dist").glob("relit-*.whl"))


@pytest.mark.slow
def test_the_wheel_works_in_an_environment_of_its_own(wheel):
    """Dependencies are those of the test's own environment; RELIT_WHEELS names a folder of wheels
    that they are installed from instead."""
    wheels = os.environ.get("RELIT_WHEELS")
    check_release().check(
        wheel, wheels=Path(wheels) if wheels else None, borrow=not wheels, page=PAGE.is_file()
    )


def test_make_dist_checks_what_it_built_with_the_demo():
    recipe = (ROOT / "Makefile").read_text().split("\ndist:")[1].split("\n\n")[0]
    assert (
        "python -m build" in recipe
        and "tools/check_release.py dist/*.whl --demo" in recipe.split("python -m build")[1]
    )

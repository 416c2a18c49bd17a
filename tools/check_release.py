"""Installs a wheel into an empty environment and sees whether it works there.

.venv/bin/python tools/check_release.py dist/relit-*.whl [--demo] [--wheels FOLDER | --borrow]

`relit doctor` and `relit demo --help` are run, with --demo the demo itself. Dependencies come from
the package index; with --wheels from a folder of wheels and nowhere else; with --borrow they are
those of the interpreter that runs this, only the wheel itself is installed.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path

# said by the installed package: it is the wheel's, and the page and the prior of lights are in it
CONTENT = """
import pathlib, sys, relit
from relit.viewer.page import PAGE
home = pathlib.Path(relit.__file__).parent
assert home.is_relative_to(sys.prefix), f"not the wheel's: {home}"
assert (home / "lighting/light_prior.npz").is_file(), "the prior of lights is not in the wheel"
assert PAGE.is_file() or "--no-page" in sys.argv, "the page is not in the wheel"
"""


def run(*words: str | Path, cwd: Path, seconds: int = 600) -> None:
    """Run a command away from the sources. Raises SystemExit with its output where it fails."""
    kept = {
        k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")
    }
    done = subprocess.run(
        [str(w) for w in words], cwd=cwd, env=kept, capture_output=True, text=True, timeout=seconds
    )
    if done.returncode:
        raise SystemExit(
            f"error: {' '.join(Path(str(w)).name for w in words[:4])} ended with {done.returncode}\n{done.stdout}{done.stderr}"
        )


def check(
    wheel: Path,
    *,
    demo: bool = False,
    wheels: Path | None = None,
    borrow: bool = False,
    page: bool = True,
) -> None:
    """Raises SystemExit where the wheel does not install or work. page: it must hold the page of
    `relit view`."""
    with tempfile.TemporaryDirectory(prefix="relit-release-") as folder:
        here = Path(folder)
        run(sys.executable, "-m", "venv", "--without-pip", here / "venv", cwd=here)
        python = here / "venv/bin/python"
        pip = [
            sys.executable,
            "-m",
            "pip",
            "--disable-pip-version-check",
            "--python",
            python,
            "install",
            "-q",
        ]
        if borrow:
            run(*pip, "--no-deps", "--no-index", wheel.resolve(), cwd=here)
            site = next((here / "venv/lib").glob("python*/site-packages"))
            (site / "borrowed.pth").write_text(sysconfig.get_path("purelib") + "\n")
        else:
            run(
                *pip,
                *([] if wheels is None else ["--no-index", "--find-links", wheels.resolve()]),
                wheel.resolve(),
                cwd=here,
                seconds=1800,
            )
        run(python, "-c", CONTENT, *([] if page else ["--no-page"]), cwd=here)
        relit = here / "venv/bin/relit"
        run(relit, "doctor", cwd=here)
        run(relit, "demo", "--help", cwd=here)
        if demo:
            run(relit, "demo", "-o", here / "demo", cwd=here, seconds=3600)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("wheel", type=Path)
    parser.add_argument("--demo", action="store_true")
    parser.add_argument("--wheels", type=Path)
    parser.add_argument("--borrow", action="store_true")
    args = parser.parse_args()
    check(args.wheel, demo=args.demo, wheels=args.wheels, borrow=args.borrow)
    print(
        f"{args.wheel.name}: installs into an empty environment, relit doctor {'and relit demo pass' if args.demo else 'passes'}"
    )


if __name__ == "__main__":
    main()

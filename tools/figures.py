"""Writes docs/figures.md: what each figure of `relit evaluate` and of benchmarks/RESULTS.md means,
from the definitions in the code.

.venv/bin/python tools/figures.py
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "src"))

from relit.evaluate.collection import DEFINITIONS as COLLECTION  # noqa: E402
from relit.evaluate.definitions import DEFINITIONS  # noqa: E402
from relit.evaluate.duplicates import DUPLICATES_DEFINITIONS  # noqa: E402
from relit.evaluate.flash import FLASH_DEFINITIONS  # noqa: E402

KINDS = {  # heading -> definitions
    "": DEFINITIONS,
    "Photos under a flash": FLASH_DEFINITIONS,
    "Collections": COLLECTION,
    "Photos of duplicates": DUPLICATES_DEFINITIONS,
}

HEAD = """# What the figures mean

Written by `tools/figures.py` from the definitions that `relit evaluate` prints beside each figure. `benchmarks/RESULTS.md` uses these
names.

How to read them:

* **Whole frame or masked.** A black background is right by itself and lifts a PSNR by several dB. `..._masked` counts the object only.
  Compare like with like.
* **Scaled or not.** Photos under an unknown light fix base colour only up to one factor per channel. Scaled figures take the best such
  factor first; `..._unscaled` ones do not, and show how well the priors chose it.
* **Noise.** The truth and the renders are Monte Carlo pictures: even a perfect asset does not reach infinity. RESULTS.md states that
  ceiling.
* **Small differences** between two runs may be noise of the fit: try another `--seed` before believing one.
"""
TABLE = "\n| figure | unit | definition |\n|---|---|---|\n"


def rows(definitions: dict[str, tuple[str, str]]) -> str:
    return "".join(
        f"| `{name}` | {unit or '-'} | {text[0].upper()}{text[1:]} |\n"
        for name, (unit, text) in definitions.items()
    )


def page() -> str:
    return HEAD + "\n".join(
        (f"## {kind}\n" if kind else "") + TABLE + rows(some) for kind, some in KINDS.items()
    )


if __name__ == "__main__":
    (ROOT / "docs" / "figures.md").write_text(page(), encoding="utf-8")

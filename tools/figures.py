"""Writes docs/definitions.md: what each figure of `relit evaluate` and of benchmarks/RESULTS.md means,
from the definitions in the code.

.venv/bin/python tools/figures.py
"""

from __future__ import annotations

import sys
import textwrap
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "src"))

from relit.evaluate.collection import DEFINITIONS as COLLECTION  # noqa: E402
from relit.evaluate.definitions import DEFINITIONS  # noqa: E402
from relit.evaluate.duplicates import DUPLICATES_DEFINITIONS  # noqa: E402
from relit.evaluate.flash import FLASH_DEFINITIONS  # noqa: E402
from relit.evaluate.protocols import orb, pir, samurai, sfd  # noqa: E402
from relit.evaluate.registration import DEFINITIONS as REGISTRATION  # noqa: E402

KINDS = {  # heading -> definitions
    "Shape, material and light": DEFINITIONS,
    "Photos under a flash": FLASH_DEFINITIONS,
    "Collections": COLLECTION,
    "Photos of duplicates": DUPLICATES_DEFINITIONS,
    "Poses alone (`relit benchmark registration`)": REGISTRATION,
    "`--protocol sfd`": sfd.DEFINITIONS,
    "`--protocol pir`": pir.DEFINITIONS,
    "`--protocol samurai`": samurai.DEFINITIONS,
    "`--protocol orb`": orb.DEFINITIONS,
}

HEAD = """# What the figures mean

Written by `tools/figures.py` from the definitions that `relit evaluate` prints beside each figure.
[figures.md](figures.md) says how to check them.
"""


def entries_text(definitions: dict[str, tuple[str, str]]) -> str:
    """One list item a figure, at most 100 columns wide."""
    out = []
    for name, (unit, text) in definitions.items():
        line = f"* `{name}`" + (f" ({unit})" if unit else "") + f": {text}."
        out += textwrap.wrap(line, 100, subsequent_indent="  ", break_on_hyphens=False)
    return "\n".join(out) + "\n"


def page() -> str:
    return HEAD + "".join(f"\n## {kind}\n\n" + entries_text(some) for kind, some in KINDS.items())


if __name__ == "__main__":
    (ROOT / "docs" / "definitions.md").write_text(page(), encoding="utf-8")

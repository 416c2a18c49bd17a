"""Writes docs/flags.md: every verb with every flag, from the parsers themselves.

.venv/bin/python tools/flags.py
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "src"))

from relit.verbs import VERBS, parser_for  # noqa: E402

HEAD = """# Every flag

Written by `tools/flags.py` from the parsers. `relit VERB --help` says the same.
"""


def row(action) -> str:
    name = ", ".join(f"`{o}`" for o in action.option_strings) or f"`{action.metavar or action.dest}`"
    value = "" if action.nargs == 0 or not action.option_strings else f" {action.metavar or ''}".rstrip()
    choices = "" if action.choices is None else " (" + ", ".join(str(c) for c in action.choices) + ")"
    return f"| {name}{value} | {(action.help or '') + choices} |".replace("<", "&lt;")


def page() -> str:
    parts = [HEAD]
    for verb, spec in VERBS.items():
        kinds = list(spec.kinds) or [None]
        seen: set[str] = set()
        for kind in kinds:
            parser = parser_for(verb, [kind] if kind else [])
            rows = [row(a) for a in parser._actions if a.dest != "help"]
            rows = [r for r in rows if r not in seen]
            seen |= set(rows)
            title = f"## relit {verb}" if kind is None or kind == kinds[0] else f"### relit {verb} {kind}: flags of its own"
            about = f"\n{spec.summary[0].upper()}{spec.summary[1:]}.\n" if kind in (None, kinds[0]) else ""
            if rows:
                parts.append("\n".join([title, about, "| flag | meaning |", "|---|---|", *rows]) + "\n")
    return "\n".join(parts)


if __name__ == "__main__":
    (ROOT / "docs" / "flags.md").write_text(page(), encoding="utf-8")

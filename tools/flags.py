"""Writes docs/flags.md: every verb with every flag, from the parsers themselves.

.venv/bin/python tools/flags.py
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "src"))

from relit.cli.verbs import VERBS, parser_for  # noqa: E402

HEAD = """# Every flag

Written by `tools/flags.py` from the parsers. `relit VERB --help` says the same.
"""


def row(action) -> str:
    name = (
        ", ".join(f"`{o}`" for o in action.option_strings) or f"`{action.metavar or action.dest}`"
    )
    value = (
        ""
        if action.nargs == 0 or not action.option_strings
        else f" {action.metavar or ''}".rstrip()
    )
    choices = (
        "" if action.choices is None else " (" + ", ".join(str(c) for c in action.choices) + ")"
    )
    return f"| {name}{value} | {(action.help or '') + choices} |".replace("<", "&lt;")


def rows_of(verb: str, kind: str | None) -> list[str]:
    return [row(a) for a in parser_for(verb, [kind] if kind else [])._actions if a.dest != "help"]


def table(*head: str, rows: list[str]) -> str:
    return "\n".join([*head, "| flag | meaning |", "|---|---|", *rows]) + "\n"


def page() -> str:
    parts = [HEAD]
    for verb, spec in VERBS.items():
        rows = {kind: rows_of(verb, kind) for kind in (list(spec.kinds) or [None])}
        common = [r for r in next(iter(rows.values())) if all(r in some for some in rows.values())]
        parts.append(
            table(
                f"## relit {verb}", f"\n{spec.summary[0].upper()}{spec.summary[1:]}.\n", rows=common
            )
        )
        for kind, all_rows in rows.items():
            own = [r for r in all_rows if r not in common]
            if kind and own:
                parts.append(table(f"### relit {verb} {kind}: flags of its own", "", rows=own))
    return "\n".join(parts)


if __name__ == "__main__":
    (ROOT / "docs" / "flags.md").write_text(page(), encoding="utf-8")

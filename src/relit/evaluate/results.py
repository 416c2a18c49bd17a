"""Figures with their units and definitions, as `relit evaluate` gives them."""

from __future__ import annotations

from typing import Any

import numpy as np


def entries(
    values: dict[str, float], definitions: dict[str, tuple[str, str]]
) -> dict[str, dict[str, Any]]:
    """{name: {"value", "unit", "definition"}} of those figures that are defined, in the order of
    their definitions (unit, sentence)."""
    known = ((name, *definitions[name]) for name in definitions if name in values)
    return {
        name: {"value": float(values[name]), "unit": unit, "definition": definition}
        for name, unit, definition in known
    }


def view_means(per_view: dict[str, dict[str, float]]) -> dict[str, float]:
    """Mean of each per-view figure over views, and over lights where there are several
    ('name:light')."""
    gathered: dict[str, list[float]] = {}
    for figures in per_view.values():
        for key, value in figures.items():
            gathered.setdefault(key.split(":")[0], []).append(value)
    return {key: float(np.mean(values)) for key, values in gathered.items()}


def figures_table(result: dict[str, Any], title: str = "", definitions: bool = True):
    """A rich Table of the figures, with what each means."""
    from rich.table import Table

    out = Table(title=title or None)
    out.add_column("figure")
    out.add_column("value", justify="right")
    out.add_column("unit")
    if definitions:
        out.add_column("definition", overflow="fold")
    for name, entry in result["metrics"].items():
        row = [name, f"{entry['value']:.4g}", entry["unit"]]
        out.add_row(*row, *([entry["definition"]] if definitions else []))
    return out

"""Figures with their units and definitions, as `relit evaluate` gives them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from relit.evaluate.baselines import Baselines


@dataclass(frozen=True)
class PaperValue:
    """A published value of a figure. value: as printed. where: paper and table. rerun: the same
    figure in the authors' own later run, where known. note: what differs, other values beside."""

    value: float
    where: str
    rerun: float | None = None
    note: str = ""

    @property
    def source(self) -> str:
        """where and note."""
        return self.where + (f"; {self.note}" if self.note else "")


def entries(
    values: Mapping[str, float],
    definitions: Mapping[str, tuple[str, str]],
    baselines: Baselines | None = None,
    papers: Mapping[str, PaperValue] | None = None,
) -> dict[str, dict[str, Any]]:
    """{name: {"value", "unit", "definition"}} of those figures that are defined, in the order of
    their definitions (unit, sentence).

    Where they are known: "baseline" with "baseline_definition"; "paper" with "paper_where", and
    "rerun", the authors' own later run.
    """
    out: dict[str, dict[str, Any]] = {}
    for name, (unit, definition) in definitions.items():
        if name not in values:
            continue
        out[name] = {"value": float(values[name]), "unit": unit, "definition": definition}
        if baselines and name in baselines:
            value, text = baselines[name]
            out[name] |= {"baseline": float(value), "baseline_definition": text}
        if papers and name in papers:
            paper = papers[name]
            out[name] |= {"paper": paper.value, "paper_where": paper.source}
            if paper.rerun is not None:
                out[name]["rerun"] = paper.rerun
    return out


def view_means(per_view: dict[str, dict[str, float]]) -> dict[str, float]:
    """Mean of each per-view figure over views, and over lights where there are several
    ('name:light')."""
    gathered: dict[str, list[float]] = {}
    for figures in per_view.values():
        for key, value in figures.items():
            gathered.setdefault(key.split(":")[0], []).append(value)
    return {key: float(np.mean(values)) for key, values in gathered.items()}


COLUMNS = {"baseline": "baseline", "paper": "paper", "rerun": "re-run"}  # key of an entry -> head


def figures_table(result: dict[str, Any], title: str = "", definitions: bool = True):
    """A rich Table of the figures with what each means: the baseline, the paper's value and the
    authors' re-run beside it where a figure has one."""
    from rich.table import Table

    metrics = result["metrics"]
    extra = [key for key in COLUMNS if any(key in entry for entry in metrics.values())]
    out = Table(title=title or None)
    out.add_column("figure")
    out.add_column("value", justify="right")
    for key in extra:
        out.add_column(COLUMNS[key], justify="right")
    out.add_column("unit")
    if definitions:
        out.add_column("definition", overflow="fold")
    for name, entry in metrics.items():
        row = [name, f"{entry['value']:.4g}"]
        row += [f"{entry[key]:.4g}" if key in entry else "" for key in extra]
        row.append(entry["unit"])
        text = entry["definition"]
        if "paper_where" in entry:
            text += f". Paper: {entry['paper_where']}"
        out.add_row(*row, *([text] if definitions else []))
    notes = []
    if "baseline" in extra:
        texts = dict.fromkeys(e["baseline_definition"] for e in metrics.values() if "baseline" in e)
        notes.append("Baseline: " + "; or ".join(texts) + ".")
    if ceiling := result.get("ceiling"):
        shown = (
            f"{light} " + ", ".join(f"{name} {value:.1f}" for name, value in figures.items())
            for light, figures in ceiling.items()
        )
        notes.append("Ceiling, the TRUE asset in Relit's renderer, dB: " + "; ".join(shown) + ".")
    out.caption = "\n".join(notes) or None
    return out

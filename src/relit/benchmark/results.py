"""Means, verdicts and tables of a suite's results."""

from __future__ import annotations

from typing import Any

import numpy as np

from relit.benchmark.suites import Bar, Suite


def means(runs: dict[str, dict]) -> dict[str, float]:
    """Mean over objects of every figure that all of them have."""
    if not runs:
        return {}
    first, *rest = [r["metrics"] for r in runs.values()]
    names = [k for k in first if all(k in r for r in rest)]
    return {k: float(np.mean([first[k]["value"], *(r[k]["value"] for r in rest)])) for k in names}


def baseline_means(runs: dict[str, dict]) -> dict[str, float]:
    """Mean over objects of the baseline of every figure that has one in all of them."""
    entries = [r["metrics"] for r in runs.values()]
    names = [
        k
        for k in (entries[0] if entries else {})
        if all("baseline" in e.get(k, {}) for e in entries)
    ]
    return {k: float(np.mean([e[k]["baseline"] for e in entries])) for k in names}


def verdict(bar: Bar | None, value: float) -> str:
    """'' without a bar, 'met', or by how much a mean misses its bar."""
    if bar is None:
        return ""
    missed = bar[1] - value if bar[0] == ">=" else value - bar[1]
    return "met" if missed <= 0 else f"missed by {missed:.3g}"


def bar_text(bar: Bar | None) -> str:
    return f"{bar[0]} {bar[1]:g}" if bar else ""


def markdown(result: dict[str, Any], suite: Suite) -> str:
    """A fragment for benchmarks/RESULTS.md: per variant one table with the objects, the mean, and
    the bar; then what failed, and why."""
    lines = [
        f"Suite `{result['suite']}`, split `{result['split']}`, quality `{result['quality']}`, "
        f"device `{result['device']}`, {result['machine']}.",
        "",
    ]
    if result["unfinished"]:
        lines += [f"Not measured yet: {', '.join(result['unfinished'])}.", ""]
    for variant, runs in result["runs"].items():
        lines += [f"### {variant}", ""]
        if runs:
            lines += [
                f"| figure | unit | {' | '.join(runs)} | mean | baseline | bar | |",
                "|---" * (len(runs) + 6) + "|",
            ]
        baselines = baseline_means(runs)
        for figure in means(runs):
            values = " | ".join(f"{r['metrics'][figure]['value']:.4g}" for r in runs.values())
            bar, unit = (
                suite.bar(figure, result["quality"]),
                next(iter(runs.values()))["metrics"][figure]["unit"],
            )
            mean = result["means"][variant].get(figure)
            told = ("", "") if mean is None else (f"{mean:.4g}", verdict(bar, mean))
            base = f"{baselines[figure]:.4g}" if figure in baselines else ""
            lines.append(
                f"| {figure} | {unit} | {values} | {told[0]} | {base} | {bar_text(bar)} "
                f"| {told[1]} |"
            )
        lines += [*([""] if runs else []), *_failures(result["failed"][variant])]
    return "\n".join(lines)


def means_table(result: dict[str, Any], suite: Suite):
    """A rich Table of the means: one column a variant, one row a figure. A variant of which an
    object failed is a column of dashes."""
    from rich.table import Table

    title = f"{result['suite']}, {result['split']}, {result['quality']}"
    out = Table(title=f"{title}, mean of {len(result['objects'])} objects")
    out.add_column("figure")
    for variant in result["means"]:
        out.add_column(variant, justify="right")
    for column in ("baseline", "bar"):
        out.add_column(column, justify="right")
    out.add_column("")
    baselines = baseline_means(result["runs"]["plain"])
    for figure in dict.fromkeys(f for m in result["means"].values() for f in m):
        bar, value = suite.bar(figure, result["quality"]), result["means"]["plain"].get(figure)
        row = [
            f"{m[figure]:.4g}" if figure in m else "" if m else "-"
            for m in result["means"].values()
        ]
        base = f"{baselines[figure]:.4g}" if figure in baselines else ""
        out.add_row(figure, *row, base, bar_text(bar), "" if value is None else verdict(bar, value))
    return out


def _failures(failed: dict[str, str]) -> list[str]:
    lines = []
    for name, reason in failed.items():
        lines += [f"`{name}` failed:", "", "```", reason, "```", ""]
    return lines

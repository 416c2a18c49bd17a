"""One JSON file for each benchmark run: figures with their definitions, and what produced them."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from relit import __version__
from relit.errors import UserError
from relit.files import write_text

SCHEMA = 1
# What decides a figure besides the suites themselves; a row measured before the last change of
# these is marked in RESULTS.md.
DECIDING = (
    *("src/relit/fit", "src/relit/rendering", "src/relit/materials", "src/relit/lighting"),
    *("src/relit/geometry", "src/relit/cameras"),
)


@dataclass(frozen=True)
class Record:
    """Figures of one run over a suite.

    runs: {variant: {object: {figure: value}}}; the variant 'plain' has nothing switched off.
    failed: {variant: {object: reason}}. definitions: {figure: (unit, sentence)}. baselines: as
    runs, the best constant's or chance's score of those figures that have one. ceilings: {object:
    {light: {figure: value}}}, the true asset in our renderer. commit: of the code, or its version outside a repository. source: 'measured', or where the figures were
    transcribed from. options: of the run, as on the command line; "unfinished" names objects that are not measured
    yet. split: of the objects (`benchmark.splits`); records of before the split are of tune.
    """

    suite: str
    quality: str
    seed: int
    commit: str
    machine: str
    runs: Mapping[str, Mapping[str, Mapping[str, float]]]
    failed: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    definitions: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    baselines: Mapping[str, Mapping[str, Mapping[str, float]]] = field(default_factory=dict)
    ceilings: Mapping[str, Mapping[str, Mapping[str, float]]] = field(default_factory=dict)
    device: str = "cpu"
    dirty: bool = False
    date: str = ""
    command: str = ""
    source: str = "measured"
    split: str = "tune"
    note: str = ""
    options: Mapping[str, Any] = field(default_factory=dict)


def repository() -> Path | None:
    """The checkout that this package runs from, or None."""
    root = Path(__file__).resolve().parents[3]
    return root if (root / ".git").exists() else None


def git(*words: str) -> str | None:
    """What git prints in the package's checkout, or None where that fails."""
    root = repository()
    if root is None:
        return None
    try:
        done = subprocess.run(["git", "-C", str(root), *words], capture_output=True, text=True)
    except OSError:
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def state_of_code() -> tuple[str, bool]:
    """(commit or version, whether tracked files differ from it)."""
    commit = git("rev-parse", "--short", "HEAD")
    if commit is None:
        return f"v{__version__}", False
    return commit, bool(git("status", "--porcelain", "--untracked-files=no"))


def changed_since(commit: str) -> bool | None:
    """Whether the code that decides figures has changed since `commit`; None where git does not
    know."""
    listed = git("log", "--format=%h", f"{commit}..HEAD", "--", *DECIDING)
    return None if listed is None else bool(listed)


def commit_time(commit: str) -> int:
    """Seconds since 1970 at which a commit was made; 0 where git does not know it."""
    return int(git("log", "-1", "--format=%ct", commit) or 0)


def record_of(result: Mapping[str, Any], options: Mapping[str, Any]) -> Record:
    """A Record of what `run_suite` returns."""
    commit, dirty = result["commit"]
    runs: dict[str, dict[str, dict[str, float]]] = {}
    baselines: dict[str, dict[str, dict[str, float]]] = {}
    ceilings: dict[str, dict[str, dict[str, float]]] = {}
    definitions: dict[str, tuple[str, str]] = {}
    for variant, objects in result["runs"].items():
        runs[variant], baselines[variant] = {}, {}
        for name, entry in objects.items():
            metrics = entry["metrics"]
            runs[variant][name] = {figure: m["value"] for figure, m in metrics.items()}
            baselines[variant][name] = {
                figure: m["baseline"] for figure, m in metrics.items() if "baseline" in m
            }
            if entry.get("ceiling"):
                ceilings[name] = entry["ceiling"]
            definitions.update({f: (m["unit"], m["definition"]) for f, m in metrics.items()})
    return Record(
        result["suite"],
        result["quality"],
        result["seed"],
        commit,
        result["machine"],
        runs,
        result["failed"],
        definitions,
        baselines,
        ceilings,
        device=result["device"],
        dirty=dirty,
        date=time.strftime("%Y-%m-%d"),
        command=" ".join(["relit", *sys.argv[1:]]),
        split=result["split"],
        options=dict(options),
    )


def write_record(record: Record, path: Path) -> None:
    """Write a record as JSON, its folder made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    content = {"schema": SCHEMA, **vars(record)}
    write_text(path, json.dumps(content, indent=1, ensure_ascii=False) + "\n")


def read_record(path: Path) -> Record:
    """Inverse of `write_record`. Raises UserError for a file that is no record."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        schema = content.pop("schema")
        content["definitions"] = {k: tuple(v) for k, v in content["definitions"].items()}
        record = Record(**content)
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        why = f"{type(error).__name__}: {error}"
        fix = f"remove the file, or write it again with relit benchmark: {path}"
        raise UserError("a result file cannot be read", why, fix) from None
    if schema != SCHEMA:
        what = f"a result file has schema {schema}; this version reads {SCHEMA}"
        raise UserError(what, fix=f"measure again with relit benchmark: {path}")
    return record


def read_records(folder: Path) -> list[Record]:
    """All records below a folder, in the order of their file names."""
    return [read_record(path) for path in sorted(folder.rglob("*.json"))]

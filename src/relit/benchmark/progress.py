"""What of a run over a suite is measured: parts of the objects, and how a stopped run goes on."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from relit.benchmark.records import changed_since
from relit.benchmark.results import means
from relit.errors import EXIT_USAGE, UserError

SAME = ("suite", "split", "quality", "device", "seed", "objects")  # of calls that share a folder


@dataclass(frozen=True)
class Share:
    """The part of a suite's objects that one call measures. part, parts: the part-th of so many.
    minutes: no object is begun after so many."""

    part: int = 1
    parts: int = 1
    minutes: float = math.inf

    def __post_init__(self) -> None:
        if not 1 <= self.part <= self.parts:
            what = f"there is no part {self.part} of {self.parts}"
            raise UserError(what, fix="give K/N with 1 <= K <= N", code=EXIT_USAGE)
        if not self.minutes > 0:
            raise UserError("no minutes are left to measure", fix="give more", code=EXIT_USAGE)

    def of(self, names: Sequence[str]) -> list[str]:
        """Every parts-th name: parts take about equally long."""
        return list(names[self.part - 1 :: self.parts])


def parse_part(text: str) -> tuple[int, int]:
    """(K, N) of 'K/N'. Raises UserError for other text."""
    words = text.split("/")
    if len(words) != 2 or not all(w.isdecimal() for w in words):
        raise UserError(f"'{text}' is no part", fix="write K/N, for example 1/3", code=EXIT_USAGE)
    return int(words[0]), int(words[1])


@dataclass(frozen=True)
class Measured:
    """runs: {variant: {object: entry}}. failed: {variant: {object: reason}}. commit: [of the code
    of the first call, whether tracked files differed from it]."""

    runs: dict[str, dict[str, Any]]
    failed: dict[str, dict[str, str]]
    commit: Sequence[Any]

    def has(self, variant: str, name: str) -> bool:
        """Whether the object was measured with the variant, or failed."""
        return name in self.runs[variant] or name in self.failed[variant]


def read_progress(
    folder: Path, head: Mapping[str, Any], variants: Sequence[str]
) -> tuple[Measured, bool]:
    """What earlier calls measured in a folder, and whether there was one. head: see `SAME`, and the
    commit of the code.

    Raises UserError where the folder is of a call with other options, or the code that decides
    figures has changed since: figures of two versions do not make one record.
    """
    file = folder / "results.json"
    if not file.is_file():
        empty = {v: {} for v in variants}
        return Measured(empty, {v: {} for v in variants}, head["commit"]), False
    try:
        before = json.loads(file.read_text(encoding="utf-8"))
        runs, failed, commit = before["runs"], before["failed"], before["commit"]
        other = [key for key in SAME if before[key] != head[key]]
    except (ValueError, LookupError, TypeError) as error:
        why = f"{type(error).__name__}: {error}"
        fix = f"choose another --out: {folder}"
        raise UserError("the folder's results cannot be read", why, fix) from None
    if other:
        raise UserError(
            "the folder holds results of a run with other options",
            f"different: {', '.join(other)}",
            f"choose another --out: {folder}",
            code=EXIT_USAGE,
        )
    if commit[0] != head["commit"][0] and changed_since(commit[0]) is not False:
        raise UserError(
            "the code that decides figures has changed since the folder's results",
            f"they are of {commit[0]}; figures of two versions do not make one record",
            f"choose another --out, or check out {commit[0]}: {folder}",
            code=EXIT_USAGE,
        )
    runs, failed = ({v: each.get(v, {}) for v in variants} for each in (runs, failed))
    return Measured(runs, failed, commit), True


def summarised(head: Mapping[str, Any], measured: Measured) -> dict[str, Any]:
    """The result of `run_suite`: objects in the order of the suite, means of complete variants,
    what is left."""
    objects = head["objects"]

    def ordered(of: dict[str, Any]) -> dict[str, Any]:
        return {v: {n: each[n] for n in objects if n in each} for v, each in of.items()}

    runs, failed = ordered(measured.runs), ordered(measured.failed)
    unfinished = [n for n in objects if not all(measured.has(v, n) for v in runs)]
    complete = {v: len(runs[v]) == len(objects) for v in runs}
    return {
        **head,
        "commit": measured.commit,
        "runs": runs,
        "failed": failed,
        "means": {v: means(runs[v]) if complete[v] else {} for v in runs},
        "unfinished": unfinished,
    }


def remaining(options: Mapping[str, Any]) -> list[str]:
    """Objects that a record's run has not measured yet, by the record's options."""
    return list(options.get("unfinished", ()))

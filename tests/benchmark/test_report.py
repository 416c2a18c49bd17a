"""Records of benchmark runs, and RESULTS.md as it is generated from them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from relit.benchmark.records import Record, read_record, read_records, write_record
from relit.benchmark.report import OLD, UNKNOWN, met, report
from relit.errors import UserError

ROOT = Path(__file__).resolve().parents[2]


def record(seed: int, relit: float, **changes) -> Record:
    figures = {"relit_psnr": relit, "albedo_psnr": 25.0, "normal_mae": 5.0}
    runs = {"plain": {"spot": figures}}
    definitions = {"relit_psnr": ("dB", "relit pictures")}
    return replace(
        Record("multiview", "standard", seed, "0000000", "2 cores", runs, {}, definitions),
        **changes,
    )


def rows_of(text: str) -> dict[str, list[str]]:
    """{first cell: other cells} of all table rows."""
    rows = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("| ")]
    return {first: [c.strip() for c in rest] for first, *rest in rows}


def test_a_record_survives_its_file(tmp_path):
    before = record(3, 31.5, options={"objects": ["spot"]}, date="2026-12-01")
    write_record(before, tmp_path / "a" / "r.json")
    assert read_record(tmp_path / "a" / "r.json") == before


@pytest.mark.parametrize("text", ["", "{}", "[1]", '{"schema": 1, "suite": "x"}', '{"schema": 9}'])
def test_a_file_that_is_no_record_is_refused_by_name(tmp_path, text):
    (tmp_path / "r.json").write_text(text)
    with pytest.raises(UserError, match="result file") as caught:
        read_records(tmp_path)
    assert "r.json" in str(caught.value)


def test_mean_and_spread_are_over_seeds_and_decide_the_bar(tmp_path):
    for seed, value in enumerate((31.0, 32.0, 33.0)):
        write_record(record(seed, value), tmp_path / f"{seed}.json")
    rows = rows_of(report(tmp_path))
    mean, spread, constant, _, bar, verdict = rows["`relit_psnr`, dB"]
    assert (mean, spread, constant, bar) == ("32", "0.82", "-", ">= 31")
    assert verdict == "met"
    assert met((">=", 31.5), 32.0, 0.82) == "missed" and met(("<=", 33.0), 32.0, 0.5) == "met"
    assert rows["spot"][4] == "3" and rows["spot"][5] == f"0000000{UNKNOWN}"


def test_the_newest_commit_of_each_object_counts_and_parts_do_not(tmp_path):
    write_record(record(0, 20.0, date="2026-01-01", commit="aaaaaaa"), tmp_path / "old.json")
    write_record(record(0, 30.0, date="2026-02-01", commit="bbbbbbb"), tmp_path / "new.json")
    ablated = {"plain": {"spot": {"relit_psnr": 9.0}}, "white": {"spot": {"relit_psnr": 8.0}}}
    part = record(0, 9.0, date="2026-03-01", runs=ablated, options={"part": True})
    write_record(part, tmp_path / "part.json")
    text = report(tmp_path)
    assert rows_of(text)["`relit_psnr`, dB"][0] == "30"
    assert "| spot | without white | 8 |" in text and "aaaaaaa" not in text


def test_no_records_are_an_error(tmp_path):
    with pytest.raises(UserError, match="no result files"):
        report(tmp_path)


def test_results_are_what_the_records_give():
    """The marks of commits depend on the history and are left out of the comparison."""

    def bare(text: str) -> str:
        return "\n".join(text.replace(OLD, "").replace(UNKNOWN, "").splitlines())

    written = (ROOT / "benchmarks" / "RESULTS.md").read_text(encoding="utf-8")
    assert bare(report(ROOT / "benchmarks" / "results")) == bare(written)
    assert len(written.splitlines()) <= 250
    assert max(len(line) for line in written.splitlines()) <= 100

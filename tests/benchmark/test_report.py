"""Records of benchmark runs, and RESULTS.md as it is generated from them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from relit.benchmark.records import Record, read_record, read_records, record_of, write_record
from relit.benchmark.report import EARLIER, OLD, UNKNOWN, met, report
from relit.benchmark.results import baseline_means
from relit.errors import UserError
from relit.evaluate.duplicates import DUPLICATES_DEFINITIONS

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
    mean, spread, baseline, _, bar, verdict = rows["`relit_psnr`, dB"]
    assert (mean, spread, baseline, bar) == ("32", "1", "-", ">= 31")
    assert verdict == "met"  # 32 - 1 is not below 31
    assert rows["spot"][0] == "32 ± 1"
    assert met((">=", 31.5), 32.0, 0.82) == "missed" and met(("<=", 33.0), 32.0, 0.5) == "met"
    assert rows["spot"][4] == "3" and rows["spot"][5] == f"0000000{UNKNOWN}"


def test_one_seed_is_said_and_the_worse_side_decides(tmp_path):
    write_record(record(0, 31.5), tmp_path / "0.json")
    assert rows_of(report(tmp_path))["`relit_psnr`, dB"][5] == "met *"
    write_record(record(1, 32.5), tmp_path / "1.json")  # 32 with a spread of .71
    assert rows_of(report(tmp_path))["`relit_psnr`, dB"][5] == "met"
    write_record(record(2, 29.0), tmp_path / "2.json")  # the mean still meets 31, with 1.8
    assert rows_of(report(tmp_path))["`relit_psnr`, dB"][5] == "missed"


def test_baselines_and_ceilings_stand_beside_the_figures(tmp_path):
    for seed, value in enumerate((18.0, 20.0)):
        baselines = {"plain": {"spot": {"albedo_psnr": value}}}
        ceilings = {"spot": {"capture": {"psnr": 41.26, "psnr_inside": 36.0}, "relight": {}}}
        one = record(seed, 31.0, baselines=baselines, ceilings=ceilings)
        write_record(one, tmp_path / f"{seed}.json")
        assert read_record(tmp_path / f"{seed}.json") == one
    text = report(tmp_path)
    assert rows_of(text)["`albedo_psnr`"][2] == "19"
    assert "spot (capture 41.3 / 36.0)" in text.replace("\n", " ")


def test_records_take_baselines_and_ceilings_of_a_run():
    entry = {"value": 20.0, "unit": "dB", "definition": "base colour"}
    metrics = {"albedo_psnr": {**entry, "baseline": 12.0}, "relit_psnr": entry}
    ceiling = {"test": {"psnr": 40.0}}
    result = {
        "suite": "multiview",
        "quality": "draft",
        "seed": 1,
        "device": "cpu",
        "machine": "2 cores",
        "runs": {"plain": {"spot": {"metrics": metrics, "ceiling": ceiling}}},
        "failed": {"plain": {}},
        "split": "report",
        "commit": ["0000000", False],
    }
    made = record_of(result, {})
    assert made.baselines == {"plain": {"spot": {"albedo_psnr": 12.0}}}
    assert made.ceilings == {"spot": ceiling} and made.runs["plain"]["spot"]["relit_psnr"] == 20
    assert baseline_means(result["runs"]["plain"]) == {"albedo_psnr": 12.0}


def test_splits_have_tables_of_their_own_with_the_relit_ceiling(tmp_path):
    lights = {"capture": {"psnr": 50.0}, "a": {"psnr": 40.0}, "b": {"psnr": 38.0}}
    reported = record(0, 24.5, split="report", ceilings={"spot": lights})
    write_record(reported, tmp_path / "r.json")
    write_record(record(0, 31.0), tmp_path / "t.json")
    assert read_record(tmp_path / "r.json").split == "report"
    text = report(tmp_path)
    first, second = text.split("## multiview, split `report`")[1].split("split `tune`")
    assert "| object | relit | ceiling |" in first and "| spot | 24.5 | 39 |" in first
    assert "| object | relit | base |" in second and "| spot | 31 | 25 |" in second


def test_a_figure_under_an_earlier_definition_is_marked(tmp_path):
    figures = {"runs": {"plain": {"spot": {"chamfer": 0.03}}}, "suite": "duplicates"}
    old = record(0, 0.0, **figures, definitions={"chamfer": ("radii", "after ICP")})
    write_record(old, tmp_path / "0.json")
    assert "`chamfer`" + EARLIER + ", radii" in rows_of(report(tmp_path))
    now = {"chamfer": DUPLICATES_DEFINITIONS["chamfer"]}
    write_record(record(0, 0.0, **figures, definitions=now), tmp_path / "0.json")
    assert "`chamfer`, radii" in rows_of(report(tmp_path))


def test_old_records_without_baselines_are_read(tmp_path):
    write_record(record(0, 31.0), tmp_path / "r.json")
    content = json.loads((tmp_path / "r.json").read_text())
    del content["baselines"], content["ceilings"], content["split"]
    (tmp_path / "r.json").write_text(json.dumps(content))
    assert read_record(tmp_path / "r.json") == record(0, 31.0)


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

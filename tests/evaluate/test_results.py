"""Entries of figures and the table that is printed of them."""

from __future__ import annotations

import json
from io import StringIO

from rich.console import Console

from relit.evaluate.results import PaperValue, entries, figures_table
from relit.evaluate.truth import ceiling_of

DEFINITIONS = {"albedo_psnr": ("dB", "base colour"), "chamfer": ("radii", "shape"), "x": ("", "x")}


def test_entries_hold_what_stands_beside_a_figure():
    out = entries(
        {"chamfer": 0.01, "albedo_psnr": 20, "undefined": 3},
        DEFINITIONS,
        {"albedo_psnr": (12, "the best constant")},
        {"chamfer": PaperValue(0.034, "SfD Tab. 1", 0.05, "one photo")},
    )
    assert list(out) == ["albedo_psnr", "chamfer"]
    assert out["albedo_psnr"]["baseline"] == 12 and "paper" not in out["albedo_psnr"]
    assert out["chamfer"]["paper"] == 0.034 and out["chamfer"]["rerun"] == 0.05
    assert out["chamfer"]["paper_where"] == "SfD Tab. 1; one photo"
    assert json.loads(json.dumps(out)) == out


def test_the_table_prints_baseline_paper_rerun_and_ceiling():
    metrics = entries(
        {"chamfer": 0.01, "albedo_psnr": 20},
        DEFINITIONS,
        {"albedo_psnr": (12.34, "the best constant")},
        {"chamfer": PaperValue(0.034, "SfD Tab. 1", 0.056)},
    )
    text = StringIO()
    result = {"metrics": metrics, "ceiling": {"capture": {"psnr": 38.52}}}
    Console(file=text, width=140).print(figures_table(result))
    for word in ("baseline", "12.34", "paper", "0.034", "re-run", "0.056", "SfD Tab. 1", "38.5"):
        assert word in text.getvalue(), word


def test_the_ceiling_of_a_capture_is_read_where_there_is_one(tmp_path):
    assert ceiling_of(tmp_path) == {}
    (tmp_path / "truth").mkdir()
    file = tmp_path / "truth" / "truth.json"
    figures = {"psnr": 40.5, "gain": [1, 1, 1], "psnr_masked": 33}
    file.write_text(json.dumps({"ceiling": {"definition": "text", "eve": figures, "dawn": {}}}))
    assert ceiling_of(tmp_path) == {"eve": {"psnr": 40.5, "psnr_masked": 33.0}}
    file.write_text('{"ceiling": 3}')
    assert ceiling_of(tmp_path) == {}

"""The benchmark's own work: caching, timing, means, bars, results. The reconstruction is stood in
for by a copy of the true asset."""

import json
import shutil
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from relit.benchmark import SUITES, Item, Suite, SuiteOptions, run_suite, runner
from relit.benchmark.cost import timed
from relit.benchmark.photographed import OPTIONS
from relit.benchmark.progress import Share, parse_part
from relit.benchmark.records import read_record
from relit.benchmark.results import means, verdict
from relit.benchmark.suites import function_at
from relit.errors import EXIT_FAILED, UserError
from relit.images import write_linear
from relit.scene import Asset, Material, Mesh
from relit.synthesize import multiview as synthetic


def test_a_command_is_timed_and_its_memory_measured(tmp_path):
    script = "import time; a = bytearray(200_000_000); time.sleep(0.3); print('said')"
    seconds, memory = timed([sys.executable, "-c", script], tmp_path / "logs" / "x.txt")
    assert 0.3 < seconds < 20 and 0.2 < memory < 0.4
    assert (tmp_path / "logs" / "x.txt").read_text() == "said\n"
    small = timed([sys.executable, "-c", "pass"], tmp_path / "y.txt")[1]
    assert small < 0.1  # a later command does not inherit the peak of an earlier one


def test_a_command_starts_cold(tmp_path):
    script = "import os; print(len(os.listdir(os.environ['DRJIT_CACHE_DIR'])))"
    timed([sys.executable, "-c", script], tmp_path / "log.txt")
    assert (tmp_path / "log.txt").read_text() == "0\n"


def test_a_failed_command_shows_the_end_of_its_output(tmp_path):
    with pytest.raises(UserError) as error:
        timed(
            [sys.executable, "-c", "print('the reason'); raise SystemExit(4)"], tmp_path / "log.txt"
        )
    assert (
        error.value.code == EXIT_FAILED
        and "the reason" in error.value.why
        and "code 4" in error.value.what
    )


def test_bars_are_told_by_how_much_they_are_missed():
    suite = SUITES["multiview"]

    def said(figure, value, quality):
        return verdict(suite.bar(figure, quality), value)

    assert said("novel_psnr", 32.5, "standard") == "met"
    assert said("novel_psnr", 30.5, "standard") == "missed by 1.5"
    assert said("chamfer_percent", 0.75, "standard") == "missed by 0.25"
    assert (
        said("seconds", 100, "standard") == "met"
        and said("seconds", 100, "draft") == "missed by 10"
    )
    assert (
        said("novel_psnr", 10, "draft") == ""
        and said("novel_ssim", 0.1, "standard") == ""
        and said("seconds", 9e9, "high") == ""
    )


@pytest.mark.parametrize("name", SUITES)
def test_a_suite_names_what_there_is(name):
    """Functions, capture kind, settings of ablations, bars of figures with one direction."""
    from relit.job import RECIPES, recipe_of
    from relit.settings import with_pairs

    suite = SUITES[name]
    assert suite.kind in RECIPES and suite.items_of(suite.default_split())
    synthesize, evaluate = function_at(suite.synthesize), function_at(suite.evaluate)
    assert (
        callable(synthesize)
        and callable(evaluate)
        and callable(function_at(suite.synthesize.rpartition(".")[0] + ".settings_of"))
    )
    known = OPTIONS.get(suite.synthesize.rpartition(".")[2], synthesize.__kwdefaults__)
    assert callable(suite.settings_function())
    for options in (suite.options, *(i.options for i in (*suite.items, *suite.report_items))):
        assert set(options) <= set(known)
    for words in suite.ablations.values():
        with_pairs(
            recipe_of(suite.kind).options("standard"),
            [w for w in words if not w.startswith("--")],
        )
    assert all(bar[0] in (">=", "<=") for bar in (*suite.bars.values(), *suite.draft_bars.values()))


def test_means_are_over_figures_that_every_object_has():
    runs = {
        "a": {"metrics": {"x": {"value": 1.0}, "y": {"value": 5.0}}},
        "b": {"metrics": {"x": {"value": 3.0}}},
    }
    assert means(runs) == {"x": 2.0}


def test_wrong_names_are_answered(tmp_path, monkeypatch):
    with pytest.raises(UserError, match="multiview"):
        run_suite("multivew")
    with pytest.raises(UserError, match="spot"):
        run_suite("multiview", SuiteOptions(objects=["spto"]))
    with pytest.raises(UserError, match="ablation"):
        run_suite("multiview", SuiteOptions(ablate=["nonsense"]))
    with pytest.raises(UserError, match="assets are not there"):
        runner.data_folder(tmp_path)
    monkeypatch.setenv("RELIT_CACHE", str(tmp_path / "c"))
    assert runner.cache_folder() == tmp_path / "c" and runner.cache_folder(tmp_path) == tmp_path


@pytest.fixture
def tiny(tmp_path, monkeypatch):
    """A suite of one grey ball, and a true asset that stands in for its reconstruction."""
    from relit.asset.asset import save_asset
    from relit.asset.gltf import write_glb

    data, ball = tmp_path / "data", trimesh.creation.icosphere(2)
    mesh = Mesh(
        ball.vertices.astype(np.float32),
        ball.faces.astype(np.int32),
        ball.vertices.astype(np.float32),
        np.full((len(ball.vertices), 2), 0.5, np.float32),
    )
    material = Material(
        np.full((4, 4, 3), 0.5, np.float32),
        np.full((4, 4), 0.6, np.float32),
        np.zeros((4, 4), np.float32),
    )
    (data / "assets").mkdir(parents=True)
    write_glb(data / "assets" / "ball.glb", mesh, material)
    for name, value in (("a", 2.0), ("b", 0.5)):
        write_linear(
            data / "envmaps" / f"{name}.exr",
            np.full((8, 16, 3), value, np.float32) * [1.0, 0.9, 0.8],
        )
    item = Item("ball", "assets/ball.glb", "envmaps/a.exr")
    suite = Suite(
        "multiview",
        (item,),
        ("envmaps/b.exr",),
        {"views": 3, "test_views": 1, "resolution": 24, "spp": 4, "test_spp": 16},
        bars=SUITES["multiview"].bars,
        ablations={"shallow": ("max_depth=2", "--masks=none")},
    )
    monkeypatch.setitem(SUITES, "tiny", suite)
    scale = synthetic.RADIUS
    save_asset(
        tmp_path / "ready",
        Asset(mesh, material, np.diag([scale, scale, scale, 1.0]), np.ones((8, 16, 3), np.float32)),
    )
    return tmp_path, data


@pytest.mark.slow
def test_a_suite_from_end_to_end(tiny, monkeypatch, capsys):
    folder, data = tiny
    commands = []

    def stand_in(capture, out, target):
        commands.append((target.kind, target.quality, target.words))
        return [
            sys.executable,
            "-c",
            f"import shutil; shutil.copytree({str(folder / 'ready')!r}, {str(out)!r})",
        ]

    monkeypatch.setattr(runner, "reconstruct_command", stand_in)
    options = dict(
        assets=data, cache=folder / "cache", device="cpu", spp=16, ablate=["shallow", "max_depth=3"]
    )
    result = run_suite(
        "tiny", SuiteOptions(out=folder / "out", json_file=folder / "r" / "x.json", **options)
    )
    assert commands == [
        ("multiview", "standard", w)
        for w in ((), ("max_depth=2", "--masks=none"), ("max_depth=3",))
    ]
    plain = result["runs"]["plain"]["ball"]["metrics"]
    assert (
        plain["relit_psnr"]["value"] > 25
        and plain["seconds"]["value"] > 0
        and plain["peak_memory"]["value"] > 0
    )
    assert result["means"]["plain"]["relit_psnr"] == plain["relit_psnr"]["value"]
    assert json.loads((folder / "out" / "results.json").read_text()) == result
    record = read_record(folder / "r" / "x.json")
    assert record.runs["plain"]["ball"]["relit_psnr"] == plain["relit_psnr"]["value"]
    assert record.definitions["relit_psnr"][0] == "dB" and record.commit
    text = (folder / "out" / "results.md").read_text()
    assert (
        "### max_depth=3" in text
        and "### shallow" in text
        and "| relit_psnr | dB |" in text
        and ">= 31" in text
    )
    assert "relit_psnr" in capsys.readouterr().out

    captures = list((folder / "cache" / "captures").iterdir())
    stamp = (captures[0] / "truth" / "truth.json").stat().st_mtime_ns
    again = run_suite("tiny", SuiteOptions(out=folder / "out", **options))  # all is measured
    assert again["runs"] == result["runs"] and len(commands) == 3
    (folder / "out" / "results.json").unlink()
    with pytest.raises(
        UserError, match="exists already"
    ):  # a run that is there would be resumed, and its time would mean nothing
        run_suite("tiny", SuiteOptions(out=folder / "out", **options))
    assert list((folder / "cache" / "captures").iterdir()) == captures
    assert (captures[0] / "truth" / "truth.json").stat().st_mtime_ns == stamp
    shutil.rmtree(folder / "cache")


def test_the_command_is_the_one_a_user_would_give(tmp_path):
    command = runner.reconstruct_command(
        tmp_path / "c",
        tmp_path / "o",
        runner.Target("multiview", "draft", "cpu", 3, ("a=1", "--masks=none")),
    )
    assert command[:4] == [sys.executable, "-m", "relit", "reconstruct"]
    assert command[-3:] == ["--set", "a=1", "--masks=none"] and "draft" in command
    assert command[command.index("--capture") + 1] == "multiview"


@pytest.mark.slow
def test_a_run_that_fails_is_told_and_the_others_go_on(tiny, monkeypatch, capsys):
    """As `search` of the duplicates does, without which nothing is left to show: a result of the
    ablation, not the end of the suite."""
    folder, data = tiny
    broken = {"max_depth=3"}

    def stand_in(capture, out, target):
        if broken & {*target.words} or "all" in broken:
            return [sys.executable, "-c", "print('no pair is linked'); raise SystemExit(4)"]
        return [
            sys.executable,
            "-c",
            f"import shutil; shutil.copytree({str(folder / 'ready')!r}, {str(out)!r})",
        ]

    monkeypatch.setattr(runner, "reconstruct_command", stand_in)
    options = dict(assets=data, cache=folder / "cache", device="cpu", spp=16)
    result = run_suite(
        "tiny", SuiteOptions(out=folder / "out", ablate=["max_depth=3", "shallow"], **options)
    )
    assert (
        "no pair is linked" in result["failed"]["max_depth=3"]["ball"]
        and result["means"]["max_depth=3"] == {}
    )
    assert result["means"]["shallow"]["relit_psnr"] > 25 and result["failed"]["plain"] == {}
    text = (folder / "out" / "results.md").read_text()
    assert (
        text.count("| relit_psnr |") == 2
        and "`ball` failed:" in text
        and "no pair is linked" in text
    )
    said = capsys.readouterr().out
    assert "ball (max_depth=3): failed: the command ended with code 4" in said and " - │" in said

    broken.add("all")
    with pytest.raises(UserError, match="1 of 1 runs failed") as error:
        run_suite("tiny", SuiteOptions(out=folder / "again", **options))
    assert error.value.code == EXIT_FAILED and "no pair is linked" in error.value.why
    assert json.loads((folder / "again" / "results.json").read_text())["failed"]["plain"]["ball"]


class FakeMeasure:
    """Stands for rendering, reconstruction and evaluation: figures by the object's name."""

    def __init__(self, monkeypatch, stop_at=None, seconds=0.0):
        self.done, self.stop_at, self.seconds = [], stop_at, seconds
        monkeypatch.setattr(runner, "synthesize_item", lambda suite, item, *_: item.name)
        monkeypatch.setattr(runner, "_measured", self.measured)

    def measured(self, label, capture, run, how, say):
        run.mkdir(parents=True)  # as `relit reconstruct` does before it is killed
        if capture == self.stop_at:
            raise KeyboardInterrupt
        time.sleep(self.seconds)
        self.done.append(capture)
        entry = {"value": float(len(capture)), "unit": "dB", "definition": "length of the name"}
        return {"metrics": {"relit_psnr": entry}, "run": run.name, "capture": capture}


@pytest.fixture
def three(monkeypatch):
    items = tuple(Item(n, f"assets/{n}.glb", "envmaps/a.exr") for n in ("a", "bb", "ccc"))
    report = (Item("dddd", "assets/d.glb", "envmaps/a.exr"),)
    monkeypatch.setitem(SUITES, "three", Suite("multiview", items, report_items=report))


def test_a_stopped_run_goes_on_after_the_last_object(three, tmp_path, monkeypatch):
    options = SuiteOptions(out=tmp_path / "out", json_file=tmp_path / "r.json", device="cpu")
    FakeMeasure(monkeypatch, stop_at="bb")
    with pytest.raises(KeyboardInterrupt):
        run_suite("three", options)
    before = read_record(tmp_path / "r.json")
    assert list(before.runs["plain"]) == ["a"] and before.options["unfinished"] == ["bb", "ccc"]
    fake = FakeMeasure(monkeypatch)
    result = run_suite("three", options)
    assert fake.done == ["bb", "ccc"] and result["unfinished"] == []
    assert result["means"]["plain"] == {"relit_psnr": 2.0}
    record = read_record(tmp_path / "r.json")
    assert list(record.runs["plain"]) == ["a", "bb", "ccc"] and "unfinished" not in record.options
    with pytest.raises(UserError, match="exists already"):
        run_suite("three", options)
    with pytest.raises(UserError, match="other options"):
        run_suite("three", SuiteOptions(out=tmp_path / "out", quality="draft", device="cpu"))


def test_parts_share_the_objects_and_make_one_result(three, tmp_path, monkeypatch):
    fake = FakeMeasure(monkeypatch)
    options = dict(out=tmp_path / "out", device="cpu")
    first = run_suite("three", SuiteOptions(share=Share(1, 2), **options))
    assert fake.done == ["a", "ccc"] and first["unfinished"] == ["bb"]
    assert first["means"] == {"plain": {}}  # a mean over some objects is none of the suite
    whole = run_suite("three", SuiteOptions(share=Share(2, 2), **options))
    assert list(whole["runs"]["plain"]) == ["a", "bb", "ccc"] and not whole["unfinished"]
    assert parse_part("2/3") == (2, 3)
    for wrong in ("2", "a/b", "1/2/3"):
        with pytest.raises(UserError, match="no part"):
            parse_part(wrong)
    with pytest.raises(UserError, match="no part 3 of 2"):
        Share(3, 2)


def test_minutes_end_a_call_after_an_object(three, tmp_path, monkeypatch):
    fake = FakeMeasure(monkeypatch, seconds=0.6)
    options = SuiteOptions(out=tmp_path / "out", device="cpu", share=Share(minutes=0.5 / 60))
    assert run_suite("three", options)["unfinished"] == ["bb", "ccc"] and fake.done == ["a"]


def test_figures_of_two_versions_make_no_record(three, tmp_path, monkeypatch):
    FakeMeasure(monkeypatch)
    options = SuiteOptions(out=tmp_path / "out", device="cpu", share=Share(1, 3))
    run_suite("three", options)
    with pytest.raises(UserError, match="has changed"):
        file = tmp_path / "out" / "results.json"
        file.write_text(
            file.read_text().replace(json.loads(file.read_text())["commit"][0], "fffffff")
        )
        run_suite("three", options)


def test_seeds_go_on_with_the_unfinished_one(three, tmp_path, monkeypatch):
    fake = FakeMeasure(monkeypatch)
    first = SuiteOptions(
        out=tmp_path / "out", json_file=tmp_path / "r.json", device="cpu", share=Share(1, 2)
    )
    runner.run_seeds("three", first, 2)
    assert fake.done == ["a", "ccc"] * 2
    runner.run_seeds("three", replace(first, share=Share()), 2)
    assert fake.done == ["a", "ccc"] * 2 + ["bb"] * 2
    runner.run_seeds("three", first, 2)
    assert len(fake.done) == 6 and read_record(tmp_path / "r-1.json").seed == 1


def test_the_report_split_has_objects_of_its_own(three, tmp_path, monkeypatch):
    fake = FakeMeasure(monkeypatch)
    options = SuiteOptions(
        out=tmp_path / "o", split="report", device="cpu", json_file=tmp_path / "r.json"
    )
    assert run_suite("three", options)["split"] == "report" and fake.done == ["dddd"]
    assert read_record(tmp_path / "r.json").split == "report"
    assert "-report-" in str(runner.record_file("three", replace(options, json_file=None), 0))
    with pytest.raises(UserError, match="split"):
        run_suite("three", replace(options, split="test"))
    other = replace(options, out=tmp_path / "other", json_file=None)
    reported = replace(SUITES["three"], items=())
    monkeypatch.setitem(SUITES, "three", reported)
    assert run_suite("three", replace(other, split=""))["split"] == "report"
    with pytest.raises(UserError, match="no objects"):
        run_suite("three", replace(other, split="tune"))

"""The benchmark's own work: caching, timing, means, bars, results. The reconstruction is stood in
for by a copy of the true asset."""

import json
import shutil
import sys

import numpy as np
import pytest
import trimesh

from relit.benchmark import SUITES, Item, Suite, SuiteOptions, run_suite, runner
from relit.benchmark.cost import timed
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
    assert suite.kind in RECIPES and suite.items
    synthesize, evaluate = function_at(suite.synthesize), function_at(suite.evaluate)
    assert (
        callable(synthesize)
        and callable(evaluate)
        and callable(function_at(suite.synthesize.rpartition(".")[0] + ".settings_of"))
    )
    keywords = synthesize.__kwdefaults__
    for options in (suite.options, *(item.options for item in suite.items)):
        assert set(options) <= set(keywords)
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

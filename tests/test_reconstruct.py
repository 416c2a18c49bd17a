"""The main job around the fit: resuming, repeating, refusing; the fit itself is replaced by one
that hands the truth back."""

from __future__ import annotations

import json
import os
import signal
import time
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from relit.asset.asset import load_asset
from relit.cli import main as cli
from relit.errors import UserError
from relit.files import parse_toml
from relit.job import Job, check_memory, estimate, open_input
from relit.recipe import Recipe
from relit.scene import Asset
from relit.synthesize.procedural import pawn, studio
from support.striped_ball import picture, write_capture

CALLS: list[tuple] = []


@pytest.fixture(autouse=True)
def quick(monkeypatch, report_sizes):
    """A fit of three steps that checkpoints each, and a small report."""
    import relit.fit.multiview.recipe as multiview

    CALLS.clear()

    def fit(capture, run, options, seed):
        mesh, material = pawn(10, 14, 16)
        if not run.done("volume"):
            with run.stage("volume", steps=3) as stage:
                first = int((stage.load("state") or {"i": 0})["i"])
                CALLS.append(("fit", first, len(capture.photos), seed))
                for i in range(first, 3):
                    stage.step(i + 1, loss=1.0)
                    stage.save("state", i=i + 1)
                    if STOP and i == 1:
                        raise STOP.pop()
        return Asset(
            mesh, material, np.eye(4), studio(8), tuple((p.name, p.camera) for p in capture.photos)
        )

    monkeypatch.setattr(multiview, "RECIPE", replace(multiview.RECIPE, run=fit))


STOP: list[BaseException] = []


@pytest.fixture
def capture(tmp_path):
    return write_capture(tmp_path / "photos")


def relit(capsys, *argv):
    code = cli.main([str(a) for a in argv])
    out = capsys.readouterr()
    return code, out.out, out.err


@pytest.mark.slow
def test_a_stopped_job_resumes_and_a_finished_one_is_left(capsys, tmp_path, capture):
    command = ("reconstruct", capture, "-o", tmp_path / "run", "--quality", "draft", "--seed", "3")
    STOP.append(KeyboardInterrupt())
    code, _, err = relit(capsys, *command)
    assert code == 130 and "goes on from the checkpoint" in err
    assert not (tmp_path / "run/asset").exists()
    code, out, _ = relit(capsys, *command)
    assert code == 0 and out.strip() == str(tmp_path / "run/asset/object.glb")
    assert CALLS == [("fit", 0, 6, 3), ("fit", 2, 6, 3)]
    before = {
        p: p.stat().st_mtime_ns
        for p in (tmp_path / "run").rglob("*")
        if p.is_file() and p.name not in ("lock", "log.txt")
    }
    code, _, err = relit(capsys, *command)
    assert code == 0 and "this run is complete" in err and len(CALLS) == 2
    assert before == {p: p.stat().st_mtime_ns for p in before}
    (tmp_path / "run/report.html").unlink()
    assert (
        relit(capsys, *command)[0] == 0
        and (tmp_path / "run/report.html").exists()
        and len(CALLS) == 2
    )


@pytest.mark.parametrize("number, code", [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_inside_a_native_loop_is_still_a_stop(
    capsys, tmp_path, capture, monkeypatch, number, code
):
    """Dr.Jit's loops raise RuntimeError from whatever passes through them."""
    import relit.fit.multiview.recipe as multiview

    def fit(capture, run, options, seed):
        with run.stage("volume", steps=3) as stage:
            stage.save("state", i=1)
            try:
                os.kill(os.getpid(), number)
                time.sleep(1)
            except BaseException as error:
                raise RuntimeError("dr.while_loop(): encountered an exception") from error

    monkeypatch.setattr(multiview, "RECIPE", replace(multiview.RECIPE, run=fit))
    before = [signal.getsignal(s) for s in (signal.SIGINT, signal.SIGTERM)]
    got, _, err = relit(capsys, "reconstruct", capture, "-o", tmp_path / "run")
    assert got == code and "goes on from the checkpoint" in err and "bug in Relit" not in err
    assert before == [signal.getsignal(s) for s in (signal.SIGINT, signal.SIGTERM)]
    assert (
        relit(capsys, "inspect", tmp_path / "nowhere")[0] == 3
    )  # the stop is forgotten by the next command


def test_the_asset_says_how_it_was_made_and_holds_no_path(capsys, tmp_path, capture):
    assert relit(capsys, "reconstruct", capture, "-o", tmp_path / "run", "--seed", "5")[0] == 0
    meta = load_asset(tmp_path / "run").meta
    assert (
        meta["capture"] == "multiview"
        and meta["seed"] == 5
        and meta["quality"] == "standard"
        and meta["device"] in ("cpu", "cuda")
    )
    assert (
        meta["stages"]["volume"]["peak_memory"] > 1e7
        and "images/p0.png" in meta["inputs"]
        and "mitsuba" in meta["versions"]
    )
    for path in (tmp_path / "run").rglob("*"):
        if path.is_file() and path.suffix in (".toml", ".json", ".jsonl", ".html"):
            assert str(tmp_path) not in path.read_text(), path
    config = parse_toml((tmp_path / "run/config.toml").read_text())
    assert (
        config["input"] == "photos" and config["seed"] == 5 and isinstance(config["settings"], dict)
    )


@pytest.mark.slow
def test_a_runs_config_repeats_it(capsys, tmp_path, capture):
    assert (
        relit(
            capsys,
            "reconstruct",
            capture,
            "-o",
            tmp_path / "a",
            "--quality",
            "draft",
            "--max-side",
            "40",
            "--seed",
            "7",
        )[0]
        == 0
    )
    assert (
        relit(
            capsys,
            "reconstruct",
            capture,
            "-o",
            tmp_path / "b",
            "--config",
            tmp_path / "a/config.toml",
        )[0]
        == 0
    )
    assert (tmp_path / "a/config.toml").read_text() == (tmp_path / "b/config.toml").read_text()
    assert (
        relit(
            capsys,
            "reconstruct",
            capture,
            "-o",
            tmp_path / "c",
            "--config",
            tmp_path / "a/config.toml",
            "--seed",
            "8",
        )[0]
        == 0
    )
    assert parse_toml((tmp_path / "c/config.toml").read_text())["seed"] == 8


@pytest.mark.slow
def test_other_settings_and_replaced_photos_are_refused(capsys, tmp_path, capture):
    run = tmp_path / "run"
    assert relit(capsys, "reconstruct", capture, "-o", run, "--quality", "draft")[0] == 0
    code, _, err = relit(capsys, "reconstruct", capture, "-o", run, "--quality", "high")
    assert code == 2 and "quality was 'draft', is now 'high'" in err
    Image.fromarray(255 - picture(2)).save(capture / "images/p2.png")
    code, _, err = relit(capsys, "reconstruct", capture, "-o", run, "--quality", "draft")
    assert code == 3 and "images/p2.png" in err and len(CALLS) == 1
    Image.fromarray(picture(2)).save(capture / "images/p2.png")
    assert (
        relit(capsys, "reconstruct", capture, "-o", run, "--quality", "high", "--overwrite")[0] == 0
    )
    assert len(CALLS) == 2


def test_photos_whose_camera_is_not_found_are_no_changed_input(
    capsys, tmp_path, capture, monkeypatch
):
    import relit.reconstruction as job

    monkeypatch.setattr(
        job, "with_cameras", lambda capture, *rest: replace(capture, photos=capture.photos[:-1])
    )
    code, _, err = relit(capsys, "reconstruct", capture, "-o", tmp_path / "run", "--device", "cpu")
    assert code == 0, err
    assert (tmp_path / "run" / "asset" / "object.glb").is_file()


def test_a_focal_length_is_that_of_the_files(capsys, tmp_path, capture, monkeypatch):
    """--max-side shrinks the photos, each by a factor of its own, and the focal length in pixels
    with them."""
    import relit.cameras.sfm as sfm

    def find(capture, *, focals, **rest):
        groups = [len(g) for g in sfm._groups(list(capture.photos), focals)]
        CALLS.append((capture.photos[0].width, focals[0], focals[-1], groups))
        raise UserError("far enough")

    monkeypatch.setattr(sfm, "find_cameras", find)
    (capture / "transforms.json").unlink()
    side = picture(0).shape[1]
    last = sorted((capture / "images").iterdir())[-1]
    Image.fromarray(np.repeat(np.repeat(np.array(Image.open(last)), 2, 0), 2, 1)).save(last)
    # of photos that are the same to the last byte one is used
    count = len({p.read_bytes() for p in (capture / "images").iterdir()})
    for more in ((), ("--max-side", side // 2)):
        assert (
            relit(
                capsys,
                "reconstruct",
                capture,
                "-o",
                tmp_path / f"run{len(more)}",
                "--focal",
                "70",
                *more,
            )[0]
            == 3
        )
    assert CALLS == [(side, 70.0, 70.0, [count - 1, 1]), (side // 2, 35.0, 17.5, [count - 1, 1])]


def test_a_failed_fit_leaves_no_asset_and_its_log(capsys, tmp_path, capture):
    STOP.append(ZeroDivisionError("the fit"))
    code, _, err = relit(capsys, "reconstruct", capture, "-o", tmp_path / "run")
    assert code == 1 and "Traceback" not in err and str(tmp_path / "run/log.txt") in err
    assert "ZeroDivisionError: the fit" in (tmp_path / "run/log.txt").read_text()
    assert not (tmp_path / "run/asset").exists()


def test_estimate_grows_with_photos_and_quality(capture, monkeypatch):
    few = open_input(capture, Job())
    draft, high = (estimate(few, Job(quality=q)) for q in ("draft", "high"))
    assert draft.seconds < high.seconds and draft.memory < high.memory
    small = estimate(open_input(capture, Job(max_side=24)), Job(quality="draft"))
    assert small.memory < draft.memory
    check_memory(draft)


def test_estimate_at_the_measured_capture_is_what_was_measured(capture):
    from relit.job import MEASURED_PHOTOS, recipe_of

    opened = open_input(capture, Job())
    side = {"width": 400, "height": 400}
    sixty = replace(
        opened, photos=tuple(replace(opened.photos[0], **side) for _ in range(MEASURED_PHOTOS))
    )
    measured = recipe_of("multiview").cost
    for quality, (seconds, memory) in measured.items():
        cost = estimate(sixty, Job(quality=quality))
        assert (cost.seconds, cost.memory) == pytest.approx(
            (seconds, memory), rel=0.1
        )  # draft shrinks them
    assert (
        estimate(replace(sixty, photos=sixty.photos * 2), Job()).seconds > measured["standard"][0]
    )


def test_a_flash_capture_has_a_cost_of_its_own(capture):
    """120 photos of 400x400 at standard took 217 s and 2.4 GB; a draft 56 s (the cup)."""
    opened = open_input(capture, Job())
    many = replace(
        opened, photos=tuple(replace(opened.photos[0], width=400, height=400) for _ in range(120))
    )
    cost = estimate(many, Job(), "flash")
    assert (cost.seconds, cost.memory) == pytest.approx((217.0, 2.4e9), rel=0.05)
    draft, high = (estimate(many, Job(quality=q), "flash") for q in ("draft", "high"))
    assert (
        draft.seconds == pytest.approx(56, rel=0.2)
        and draft.memory < cost.memory < high.memory
        and cost.seconds < high.seconds
    )


def test_more_identical_objects_cost_more(capture):
    """Ten Spots took 398 s and 1.6 GB, thirty 653 s and 2.1 GB, sixty 962 s and 2.6 GB; other
    objects up to 590 s and 2 GB."""
    opened = open_input(capture, Job())
    photo = replace(opened, photos=(replace(opened.photos[0], width=1600, height=1600),))
    ten, thirty, sixty = (
        estimate(replace(photo, objects=n), Job(), "duplicates") for n in (10, 30, 60)
    )
    assert 398 < ten.seconds < 653 < thirty.seconds < 962 < sixty.seconds < 1300
    assert 1.6e9 < ten.memory < 2.5e9 and 2.1e9 < thirty.memory < sixty.memory < 4e9
    assert (
        estimate(photo, Job(), "duplicates").seconds == ten.seconds
    )  # of objects that are not known


def test_the_layout_of_the_input_chooses_the_recipe(capsys, tmp_path, capture, monkeypatch):
    """`--capture auto` takes the kind that the reader told, and says so when there is no recipe for
    it."""
    import sys
    import types
    from dataclasses import dataclass, replace

    from relit import job as plan

    @dataclass(frozen=True)
    class Options:
        steps: int = 3

    def fit(capture, run, options, seed):
        CALLS.append((options.steps, capture.has_cameras))
        mesh, material = pawn(10, 14, 16)
        return Asset(
            mesh, material, np.eye(4), studio(8), tuple((p.name, p.camera) for p in capture.photos)
        )

    module = types.ModuleType("stand_in_recipe")
    cost = {"standard": (7.0, 1.0e9)}
    module.RECIPE = Recipe(
        "flash", "a lamp", lambda quality: Options(), fit, ("one",), cost, min_photos=1
    )
    monkeypatch.setitem(sys.modules, "stand_in_recipe", module)
    opened = plan.open_input(capture, Job())
    monkeypatch.setattr(plan, "open_input", lambda path, job: replace(opened, kind="flash"))
    monkeypatch.delitem(plan.RECIPES, "flash", raising=False)
    code, _, err = relit(capsys, "reconstruct", capture, "-o", tmp_path / "run")
    assert code == 2 and "--capture flash is not known" in err
    monkeypatch.setitem(plan.RECIPES, "flash", "stand_in_recipe")
    assert relit(capsys, "reconstruct", capture, "-o", tmp_path / "run", "--set", "steps=5")[0] == 0
    assert CALLS == [(5, True)] and load_asset(tmp_path / "run").meta["capture"] == "flash"
    code, _, err = relit(
        capsys, "reconstruct", capture, "-o", tmp_path / "other", "--set", "rays=5"
    )
    assert code == 2 and "known keys: steps" in err
    assert (
        relit(
            capsys,
            "reconstruct",
            capture,
            "-o",
            tmp_path / "m",
            "--capture",
            "multiview",
            "--quality",
            "draft",
        )[0]
        == 0
    )
    assert CALLS[-1][0] == "fit"


def test_inspect_changes_nothing(capsys, capture):
    before = sorted(capture.rglob("*"))
    code, out, _ = relit(capsys, "inspect", capture, "--json", "--quality", "high")
    found = json.loads(out)
    assert (
        code == 0
        and found["stages"] == ["volume", "mesh", "surface", "asset", "report"]
        and found["estimate"]["quality"] == "high"
    )
    assert before == sorted(capture.rglob("*"))


def test_inspect_draws_the_cameras(capsys, tmp_path, capture):
    plot = tmp_path / "cameras.svg"
    assert relit(capsys, "inspect", capture, "--plot", plot)[0] == 0
    assert plot.read_text().startswith("<svg xmlns") and plot.read_text().count("<line") == 12
    code, _, err = relit(capsys, "inspect", capture, "--plot", plot)
    assert code == 3 and "nothing was overwritten" in err
    (capture / "transforms.json").unlink()
    code, _, err = relit(capsys, "inspect", capture, "--plot", tmp_path / "other.svg")
    assert code == 3 and "cameras are unknown" in err and not (tmp_path / "other.svg").exists()

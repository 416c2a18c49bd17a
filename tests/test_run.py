"""A long job behaves like one: it resumes, holds its folder, survives a kill, and overwrites
nothing."""

from __future__ import annotations

import errno
import io
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from relit.errors import EXIT_ENVIRONMENT, UserError
from relit.files import (
    digests,
    disk_error,
    load_arrays,
    parse_toml,
    save_arrays,
    toml_text,
    write_text,
)
from relit.log import Log, MemoryWatch, Progress, peak_memory, readable_bytes, readable_seconds
from relit.run import RUN_FORMAT, Run, read_metrics

CONFIG = {
    "capture": "multiview",
    "seed": 0,
    "settings": {"steps": 3, "rate": 0.5, "fast": True, "name": 'a "b"\n\\c'},
}

JOB = """
import sys, time
import numpy as np
import relit.run as run
run.CHECKPOINT_SECONDS = run.CHECKPOINT_LONGEST = 0.05
from relit.run import Run, Terminated, termination
with termination(), Run.open(sys.argv[1], {"seed": 0}) as r:
    try:
        with r.stage("count", steps=200) as s:
            s._interval = 0.05
            state = s.load("state") or {"i": 0, "total": 0}
            first, total = int(state["i"]), int(state["total"])
            print("first", first, flush=True)
            for i in range(first, 200):
                total += i
                time.sleep(0.01)
                s.step(i + 1, total=total)
                if s.checkpoint_due():
                    s.save("state", i=i + 1, total=total)
            s.save("state", i=200, total=total)
    except Terminated:
        sys.exit(143)
"""


def start(folder):
    return subprocess.Popen(
        [sys.executable, "-c", JOB, str(folder)],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )


def wait_for(path, process):
    end = time.monotonic() + 20
    while not path.exists() and process.poll() is None and time.monotonic() < end:
        time.sleep(0.02)
    assert path.exists()


@pytest.mark.parametrize("stop, code", [(signal.SIGKILL, -signal.SIGKILL), (signal.SIGTERM, 143)])
def test_a_stopped_job_goes_on_from_its_checkpoint(tmp_path, stop, code):
    folder = tmp_path / "run"
    with start(folder) as job:
        wait_for(folder / "stages/count/state.npz", job)
        job.send_signal(stop)
        assert job.wait(10) == code
    assert not (folder / "stages/count/DONE").exists()
    with start(folder) as job:
        out, _ = job.communicate(timeout=20)
    assert int(out.split()[1]) > 0  # it did not begin at 0 again
    assert job.returncode == 0
    assert int(load_arrays(folder / "stages/count/state.npz")["total"]) == sum(range(200))
    steps = [m["step"] for m in read_metrics(folder)]
    assert steps == sorted(set(steps)) and steps[-1] == 200


def test_a_folder_is_held_by_one_process_and_freed_by_its_death(tmp_path):
    folder = tmp_path / "run"
    with start(folder) as job:
        wait_for(folder / "stages/count/state.npz", job)
        with pytest.raises(UserError, match=f"another process.*{job.pid}"):
            Run.open(folder, {"seed": 0})
        job.kill()
        job.wait(10)
    Run.open(folder, {"seed": 0}).close()


def test_a_second_run_in_the_same_process_is_refused_until_the_first_is_closed(tmp_path):
    with Run.open(tmp_path, CONFIG), pytest.raises(UserError, match="another process"):
        Run.open(tmp_path, CONFIG)
    Run.open(tmp_path, CONFIG).close()


def saved_config(folder: Path) -> dict:
    """The settings in config.toml, without the format of the run folder."""
    saved = parse_toml((folder / "config.toml").read_text())
    assert saved.pop("run_format") == RUN_FORMAT
    return saved


def test_config_is_saved_as_toml_and_read_back(tmp_path):
    with Run.open(tmp_path / "run", CONFIG):
        assert saved_config(tmp_path / "run") == CONFIG


def test_other_settings_are_refused_by_name(tmp_path):
    Run.open(tmp_path, CONFIG).close()
    with pytest.raises(UserError, match="other settings") as caught:
        Run.open(tmp_path, {**CONFIG, "seed": 1, "settings": {**CONFIG["settings"], "steps": 4}})
    text = str(caught.value)
    assert (
        "seed was 0, is now 1" in text
        and "settings.steps was 3, is now 4" in text
        and "--overwrite" in text
    )
    assert "rate" not in text
    assert saved_config(tmp_path) == CONFIG


def test_resume_false_removes_only_what_a_run_made(tmp_path):
    with Run.open(tmp_path, CONFIG) as run, run.stage("a"):
        pass
    (tmp_path / "mine.txt").write_text("keep")
    with Run.open(tmp_path, {"seed": 5}, resume=False) as run:
        assert not run.done("a")
    assert (tmp_path / "mine.txt").read_text() == "keep"


def test_a_folder_with_other_things_is_left_alone(tmp_path):
    (tmp_path / "holiday.jpg").write_bytes(b"x")
    for resume in (True, False):
        with pytest.raises(UserError, match="not empty and is no Relit run"):
            Run.open(tmp_path, CONFIG, resume=resume)
    assert [p.name for p in tmp_path.iterdir()] == ["holiday.jpg"]
    with pytest.raises(UserError, match="a file, not a folder"):
        Run.open(tmp_path / "holiday.jpg", CONFIG)


def test_a_replaced_photo_is_noticed(tmp_path):
    photos = tmp_path / "photos"
    photos.mkdir()
    for name in "ab":
        (photos / name).write_bytes(name.encode())
    before = digests(photos, ["a", "b"])
    Run.open(tmp_path / "run", CONFIG, inputs=before).close()
    os.utime(photos / "a", (0, 0))  # a new time alone is no change
    Run.open(tmp_path / "run", CONFIG, inputs=digests(photos, ["a", "b"])).close()
    (photos / "b").write_bytes(b"c")
    with pytest.raises(UserError, match="with: b"):
        Run.open(tmp_path / "run", CONFIG, inputs=digests(photos, ["a", "b"]))


def test_a_damaged_list_of_inputs_is_an_answer(tmp_path):
    Run.open(tmp_path / "run", CONFIG, inputs={"a": "1:x"}).close()
    (tmp_path / "run/inputs.json").write_text('{"a": ')
    with pytest.raises(UserError, match=r"inputs\.json cannot be read"):
        Run.open(tmp_path / "run", CONFIG, inputs={"a": "1:x"})


def test_stage_records_time_memory_and_losses(tmp_path):
    calls = []
    with Run.open(tmp_path, CONFIG) as run:
        with run.stage("fit", steps=1000, title="volume pass") as stage:
            for i in range(1, 1001):
                stage.step(i, loss=lambda i=i: calls.append(i) or 1.0 / i, rate=0.1)
        assert run.done("fit") and not run.done("other")
        (record,) = run.stages()
        assert (
            record["title"] == "volume pass"
            and record["seconds"] < 10
            and record["peak_memory"] > 1e6
        )
        assert len(calls) < 20  # callables are evaluated only when a line is written
        last = run.metrics()[-1]
        assert (
            last["stage"] == "fit" and last["step"] == 1000 and last["loss"] == pytest.approx(0.001)
        )


def test_a_failing_stage_is_not_done(tmp_path):
    with Run.open(tmp_path, CONFIG) as run:
        with pytest.raises(ZeroDivisionError), run.stage("fit") as stage:
            stage.save("state", x=np.ones(3))
            raise ZeroDivisionError
        assert not run.done("fit")
        with run.stage("fit") as stage:
            np.testing.assert_array_equal(stage.load("state")["x"], np.ones(3))
    assert "ZeroDivisionError" in (tmp_path / "log.txt").read_text()


@pytest.mark.parametrize("damage", ["truncate", "flip", "empty"])
def test_a_corrupt_checkpoint_is_left_out_with_a_line(tmp_path, damage, capsys):
    with Run.open(tmp_path, CONFIG) as run, run.stage("fit") as stage:
        stage.save("state", x=np.arange(1000.0))
        path = stage.folder / "state.npz"
        data = bytearray(path.read_bytes())
        if damage == "flip":
            data[len(data) // 2] ^= 255
        path.write_bytes({"truncate": data[: len(data) // 2], "flip": data, "empty": b""}[damage])
        assert stage.load("state") is None
        assert stage.load("none") is None
    assert "cannot be read" in capsys.readouterr().err


def test_checkpoints_hold_no_objects(tmp_path):
    with pytest.raises(TypeError, match="bad"):
        save_arrays(tmp_path / "a.npz", {"bad": np.array([{}], dtype=object)})
    assert list(tmp_path.iterdir()) == []


def test_checkpoint_names_may_be_any_word(tmp_path):
    save_arrays(tmp_path / "a.npz", {"file": 1, "name": np.float32(2), "self": "x"})
    assert sorted(load_arrays(tmp_path / "a.npz")) == ["file", "name", "self"]


def test_checkpoint_is_due_after_its_interval(tmp_path, monkeypatch):
    with Run.open(tmp_path, CONFIG) as run, run.stage("fit") as stage:
        assert not stage.checkpoint_due()
        now = time.monotonic()
        monkeypatch.setattr(time, "monotonic", lambda: now + 21)
        assert stage.checkpoint_due()
        stage.save("state", x=1)
        assert not stage.checkpoint_due()


def test_metrics_survive_a_torn_line_and_repeated_steps(tmp_path):
    Run.open(tmp_path, CONFIG).close()
    rows = [{"stage": "a", "step": s, "loss": s} for s in (1, 2, 3)]
    (tmp_path / "metrics.jsonl").write_text(
        "".join(json.dumps(r) + "\n" for r in rows) + '{"stage": "a", "st'
    )
    with Run.open(tmp_path, CONFIG) as run, run.stage("a", steps=3) as stage:
        stage.step(2, loss=9.0)
    got = read_metrics(tmp_path)
    assert [m["step"] for m in got] == [1, 2] and got[-1]["loss"] == 9.0


def test_a_full_disk_is_an_environment_error(tmp_path, monkeypatch):
    run = Run.open(tmp_path, CONFIG)

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(UserError, match="disk is full") as caught, run.stage("fit") as stage:
        stage.save("state", x=1)
        monkeypatch.setattr(os, "fsync", full)
        stage.save("state", x=2)
    monkeypatch.undo()
    assert caught.value.code == EXIT_ENVIRONMENT and str(tmp_path) in caught.value.fix
    assert (
        int(load_arrays(tmp_path / "stages/fit/state.npz")["x"]) == 1
    )  # the old checkpoint is whole
    assert not list(tmp_path.rglob("*.part"))
    run.close()
    assert disk_error(OSError(errno.ENOENT, "no"), tmp_path) is None


def test_what_a_killed_writer_left_is_cleared(tmp_path):
    with Run.open(tmp_path, CONFIG) as run, run.stage("fit") as stage:
        torn = stage.folder / ".state.npz.12345.part"
        torn.write_bytes(b"half")
    Run.open(tmp_path, CONFIG).close()
    assert not torn.exists()


def test_atomic_text(tmp_path):
    write_text(tmp_path / "a", "one")
    write_text(tmp_path / "a", "two")
    assert (tmp_path / "a").read_text() == "two" and len(list(tmp_path.iterdir())) == 1


def test_toml_refuses_what_it_cannot_say():
    with pytest.raises(TypeError, match="object"):
        toml_text({"a": object()})


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_progress_redraws_on_a_terminal_and_prints_plain_lines_elsewhere(monkeypatch):
    clock = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    for stream in (Terminal(), io.StringIO()):
        progress = Progress(Log(stream=stream), "volume pass", 400)
        for done in range(1, 301):
            clock[0] += 0.1
            progress.update(done, {"loss": 0.5})
        text = stream.getvalue()
        if stream.isatty():
            assert text.count("\r") > 50 and "\n" not in text
        else:
            assert "\r" not in text and text.count("\n") == 2
            assert (
                text.splitlines()[-1] == "volume pass  202/400  50 %  10.0/s  20 s left  loss 0.5"
            )


def test_memory_watch_sees_a_stage_below_the_maximum():
    big = np.ones(40_000_000)  # 320 MB: sets the process's maximum
    del big
    watch = MemoryWatch().start()
    small = np.ones(10_000_000)
    time.sleep(0.7)
    del small
    assert 8e7 < watch.stop() < peak_memory()


def test_readable():
    assert [readable_seconds(s) for s in (8.2, 200, 7500)] == ["8 s", "3 min 20 s", "2 h 5 min"]
    assert readable_bytes(3.4e9) == "3.4 GB" and readable_bytes(8.12e8) == "812 MB"


def test_a_run_folder_of_another_version_is_refused(tmp_path):
    Run.open(tmp_path, CONFIG).close()
    text = (tmp_path / "config.toml").read_text()
    for other in ("", "run_format = 99\n"):
        (tmp_path / "config.toml").write_text(
            other + "".join(x + "\n" for x in text.splitlines() if "run_format" not in x)
        )
        with pytest.raises(UserError, match="another version") as caught:
            Run.open(tmp_path, CONFIG)
        assert "--overwrite" in str(caught.value)
    Run.open(tmp_path, CONFIG, resume=False).close()


@dataclass(frozen=True)
class Squares:
    values: np.ndarray
    largest: float


def test_a_cached_stage_is_computed_once(tmp_path):
    calls = []

    def compute(stage):
        calls.append(stage.name)
        values = np.arange(4.0) ** 2
        return Squares(values, float(values.max()))

    for _ in range(2):
        with Run.open(tmp_path, CONFIG) as run:
            result = run.cached("squares", Squares, compute, title="squares of numbers")
            assert result.largest == 9.0 and result.values.tolist() == [0, 1, 4, 9]
    assert calls == ["squares"]
    (tmp_path / "stages/squares/result.npz").write_bytes(b"damaged")
    with Run.open(tmp_path, CONFIG) as run, pytest.raises(UserError, match="cannot be read"):
        run.cached("squares", Squares, compute)


def test_a_cached_stage_that_is_stopped_is_computed_again(tmp_path):
    def stopped(stage):
        raise KeyboardInterrupt

    with Run.open(tmp_path, CONFIG) as run, pytest.raises(KeyboardInterrupt):
        run.cached("squares", Squares, stopped)
    with Run.open(tmp_path, CONFIG) as run:
        result = run.cached("squares", Squares, lambda stage: Squares(np.zeros(1), 0.0))
    assert result.largest == 0.0

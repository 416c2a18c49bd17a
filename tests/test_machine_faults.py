"""What a machine can do to a job: kill it, fill the disk, take memory away, move its folder. The
real fit, very small."""

from __future__ import annotations

import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from relit.asset.asset import load_asset
from relit.cli import main as cli
from relit.run import Run
from support.commands import JOB, TINY, answered
from support.small_captures import collection_photos, flash_photos
from support.striped_ball import write_capture

WORDS = [
    "--quality",
    "draft",
    "--device",
    "cpu",
    *[w for k, v in TINY.items() for w in ("--set", f"{k}={v}")],
]


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Path:
    return write_capture(tmp_path_factory.mktemp("faults") / "Fotos für später (1)")


@pytest.fixture(autouse=True)
def small_report(report_sizes):
    """Every report of this file is small."""


def start(*words, limits=()):
    """A relit process. limits: (resource, bytes) pairs."""

    def prepare():
        for which, size in limits:
            resource.setrlimit(which, (size, size))

    command = [sys.executable, "-c", JOB, *map(str, words)]
    return subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=prepare if limits else None,
    )


def relit(capsys, *argv):
    code = cli.main([str(a) for a in argv])
    out = capsys.readouterr()
    return code, out.out, out.err


@pytest.fixture(scope="module")
def finished(capture, tmp_path_factory) -> Path:
    """A complete tiny run, made by the command line in another process."""
    run = tmp_path_factory.mktemp("runs") / "ein Lauf ✓"
    process = start("reconstruct", capture, "-o", run, *WORDS)
    _, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    return run


def stop_when(process, log: Path, said: str, number: int) -> int:
    """Send a signal as soon as the log says something; returns the exit code."""
    end = time.monotonic() + 100
    while process.poll() is None and time.monotonic() < end:
        if log.exists() and said in log.read_text(encoding="utf-8"):
            os.kill(process.pid, number)
            break
        time.sleep(0.002)
    process.communicate(timeout=60)
    return process.returncode


# kill -9 in the stage of a name: soon after it began, or at its end at the latest
KILLED = """
import contextlib, os, sys, threading
from relit.run import Run
begin, doomed = Run.stage, sys.argv.pop(1)
@contextlib.contextmanager
def stage(self, name, **about):
    with begin(self, name, **about) as entered:
        if name != doomed:
            yield entered
            return
        timer = threading.Timer(0.03, os.kill, (os.getpid(), 9))
        timer.start()
        yield entered
        timer.join()
Run.stage = stage
"""


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["volume", "mesh", "surface", "asset", "report"])
def test_kill_9_in_any_stage_and_the_same_command(capsys, capture, finished, tmp_path, stage):
    run = tmp_path / "run"
    words = ["reconstruct", capture, "-o", run, *WORDS]
    process = subprocess.run(
        [sys.executable, "-c", KILLED + JOB, stage, *map(str, words)],
        capture_output=True,
        timeout=100,
    )
    assert process.returncode == -signal.SIGKILL and not (run / "stages" / stage / "DONE").exists()
    assert not (run / "report.html").exists()
    code, _, err = relit(capsys, *words)
    assert code == 0, err
    assert (
        "Traceback" not in err
        and (run / "report.html").is_file()
        and (run / "photos/index.json").is_file()
    )
    a, b = load_asset(run), load_asset(finished)
    assert a.environment.shape == b.environment.shape and abs(
        len(a.mesh.faces) - len(b.mesh.faces)
    ) < 0.1 * len(b.mesh.faces)
    assert np.abs(a.mesh.vertices.mean(0) - b.mesh.vertices.mean(0)).max() < 0.05
    assert not list(run.rglob("*.part")) and not [
        p for p in run.iterdir() if p.name.startswith(".")
    ]


@pytest.mark.slow
@pytest.mark.parametrize("number, code", [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_asked_to_stop(capture, tmp_path, number, code):
    run = tmp_path / "run"
    many = ["--set", "surface_steps=20000"]
    process = start("reconstruct", capture, "-o", run, *WORDS, *many)
    assert (
        stop_when(process, run / "log.txt", "material and light (surface pass): begun", number)
        == code
    )
    log = (run / "log.txt").read_text(encoding="utf-8")
    assert "the same command" in log and "Traceback" not in log and not (run / "asset").exists()


@pytest.mark.slow
def test_a_checkpoint_that_was_damaged(capsys, capture, finished, tmp_path):
    """Of the finished volume pass: the pass is done again, or the message says what to do."""
    run = tmp_path / "run"
    shutil.copytree(finished, run)
    for name in ("mesh", "surface", "asset", "report"):
        shutil.rmtree(run / "stages" / name, ignore_errors=True)
    shutil.rmtree(run / "asset")
    for path in (run / "stages/volume").glob("*.npz"):
        data = bytearray(path.read_bytes())
        data[len(data) // 2 : len(data) // 2 + 64] = b"\xaa" * 64
        path.write_bytes(data)
    code, _, err = relit(capsys, "reconstruct", capture, "-o", run, *WORDS)
    assert "Traceback" not in err
    if code:
        answered(code, err, 3, "overwrite")
    else:
        assert (
            err.count("checkpoint.npz cannot be read") == 1 and (run / "asset/object.glb").is_file()
        )


@pytest.mark.slow
def test_what_a_finished_stage_has_kept_was_damaged(capsys, capture, finished, tmp_path):
    """Later stages were made from it: it cannot be made again behind their backs."""
    run = tmp_path / "run"
    shutil.copytree(finished, run)
    shutil.rmtree(run / "asset")
    path = run / "stages/mesh/result.npz"
    path.write_bytes(path.read_bytes()[:-40])
    code, _, err = relit(capsys, "reconstruct", capture, "-o", run, *WORDS)
    answered(code, err, 3, "stage 'mesh'")
    assert "--overwrite" in err


@pytest.mark.slow
def test_a_disk_that_fills_up(capsys, capture, tmp_path):
    """A limit on the size of files stands for a full disk: the same OSError from the same calls."""
    run = tmp_path / "run"
    process = start(
        "reconstruct", capture, "-o", run, *WORDS, limits=[(resource.RLIMIT_FSIZE, 30_000)]
    )
    _, err = process.communicate(timeout=100)
    answered(process.returncode, err, 5, "the disk is full")
    assert not (run / "asset").exists()
    code, _, err = relit(capsys, "reconstruct", capture, "-o", run, *WORDS)
    assert code == 0 and (run / "asset/object.glb").is_file(), err


def test_an_output_that_cannot_be_written(capsys, capture):
    code, _, err = relit(capsys, "reconstruct", capture, "-o", "/proc/run", *WORDS)
    answered(code, err, 5, "cannot")
    code, _, err = relit(capsys, "reconstruct", capture, "-o", "/dev/null/run", *WORDS)
    answered(code, err, 5, "cannot be made")


@pytest.mark.slow
def test_a_photo_replaced_during_the_run(capture, tmp_path):
    photos, run = tmp_path / "photos", tmp_path / "run"
    shutil.copytree(capture, photos)
    before = (photos / "images/p0.png").read_bytes()
    words = ["reconstruct", photos, "-o", run, *WORDS, "--set", "surface_steps=80"]
    process = start(*words)
    log = run / "log.txt"
    while process.poll() is None and not (
        log.exists() and "shape (volume pass): begun" in log.read_text(encoding="utf-8")
    ):
        time.sleep(0.002)
    Image.new("RGBA", (48, 48), (255, 0, 0, 255)).save(photos / "images/p0.png")
    _, err = process.communicate(timeout=100)
    answered(process.returncode, err, 3, "p0.png")
    assert not (run / "asset").exists()
    (photos / "images/p0.png").write_bytes(before)
    process = start(*words)
    _, err = process.communicate(timeout=100)
    assert process.returncode == 0, err


def test_two_runs_in_one_folder(capsys, capture, tmp_path):
    with Run.open(tmp_path / "run", {"input": "x"}):
        code, _, err = relit(capsys, "reconstruct", capture, "-o", tmp_path / "run", *WORDS)
    answered(code, err, 3, "another process works in this run folder")


@pytest.mark.slow
def test_a_run_folder_that_was_moved(capsys, capture, finished, tmp_path):
    moved, photos = tmp_path / "anderswo/Lauf", tmp_path / "andere Fotos" / capture.name
    shutil.copytree(finished, moved)
    shutil.copytree(capture, photos)
    texts = [
        p.read_text(encoding="utf-8", errors="ignore")
        for p in moved.rglob("*")
        if p.suffix in (".json", ".toml", ".jsonl", ".html")
    ]
    assert not any(str(finished.parent) in t or str(capture.parent) in t for t in texts)
    for words in (["export", moved, "-o", tmp_path / "ü b.obj"], ["relight", moved, "--light", moved / "asset/lights/environment.exr",
                  "--cameras", "orbit:1", "--size", "16", "--spp", "1", "-o", tmp_path / "Bilder"]):  # fmt: skip
        code, _, err = relit(capsys, *words)
        assert code == 0, err
    code, _, err = relit(capsys, "reconstruct", photos, "-o", moved, *WORDS)
    assert code == 0 and "complete" in err


@pytest.mark.slow
def test_two_gigabytes_of_memory(capture, tmp_path):
    """Data segments and anonymous memory together: a draft goes through."""
    process = start(
        "reconstruct",
        capture,
        "-o",
        tmp_path / "run",
        *WORDS,
        limits=[(resource.RLIMIT_DATA, 2 << 30)],
    )
    _, err = process.communicate(timeout=100)
    assert process.returncode == 0, err


@pytest.mark.slow
def test_memory_that_runs_out(capture, tmp_path):
    """An answer, no traceback, and never a half written asset."""
    process = start(
        "reconstruct",
        capture,
        "-o",
        tmp_path / "run",
        *WORDS,
        "--set",
        "texture=16384",
        limits=[(resource.RLIMIT_DATA, 2 << 30)],
    )
    _, err = process.communicate(timeout=100)
    assert process.returncode != 0 and not (tmp_path / "run/asset").exists()
    if process.returncode > 0:
        answered(process.returncode, err, 5, "memory")


@pytest.mark.slow
def test_a_photo_of_a_hundred_megapixels(tmp_path, capsys):
    folder = write_capture(tmp_path / "photos")
    Image.fromarray(np.asarray(Image.open(folder / "images/p0.png"))[..., :3]).resize(
        (10_000, 10_000)
    ).save(folder / "images/p0.jpg", quality=40)
    job = "import sys\nfrom relit.images import read_image\nassert read_image(sys.argv[1]).rgb.shape == (10000, 10000, 3)\n"
    # its own peak: getrusage would count what the process held that started it
    job += "print(next(int(line.split()[1]) >> 10 for line in open('/proc/self/status') if line.startswith('VmHWM')))"
    done = subprocess.run(
        [sys.executable, "-c", job, str(folder / "images/p0.jpg")],
        capture_output=True,
        text=True,
        timeout=100,
    )
    assert int(done.stdout) < 2000, done.stderr  # MB: the pixels as float32 are 1144
    Image.new("1", (20_000, 10_001)).save(folder / "images/p1.png")
    code, _, err = relit(capsys, "inspect", folder)
    answered(code, err, 3, "too large: 20000 x 10001")


OFFLINE = """
import sys
def watch(event, arguments):
    if event in ("socket.connect", "socket.getaddrinfo", "socket.sendto", "urllib.Request"):
        raise SystemExit(f"reached for the network: {event} {arguments}")
sys.addaudithook(watch)
"""


@pytest.mark.slow
def test_nothing_reaches_for_the_network(capture, tmp_path):
    words = ["reconstruct", capture, "-o", tmp_path / "run", *WORDS]
    done = subprocess.run(
        [sys.executable, "-c", OFFLINE + JOB, *map(str, words)],
        capture_output=True,
        text=True,
        timeout=100,
    )
    assert done.returncode == 0, done.stderr
    reach = "import socket\nsocket.create_connection(('127.0.0.1', 9), timeout=1)"
    assert (
        "reached for the network"
        in subprocess.run(
            [sys.executable, "-c", OFFLINE + reach], capture_output=True, text=True
        ).stderr
    )


FLAT = """
import sys
from pathlib import Path
from relit.run import Stage
step, seen = Stage.step, {}
def resident():
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 2**20
def watched(self, i, /, **losses):
    step(self, i, **losses)
    if i in (150, 500):
        seen[self.name, i] = resident()
Stage.step = watched
from relit.reconstruction import reconstruct
settings = {"levels": [16], "level_steps": [500], "rays": 128, "faces": 300, "texture": 16, "light": 4}
settings |= {"surface_steps": 500, "points": 32, "directions": 4, "background": 16, "explore_steps": 500}
reconstruct(sys.argv[1], sys.argv[2], quality="draft", device="cpu", settings=settings, masks=sys.argv[3], report=False)
for name in {n for n, _ in seen}:
    print(name, seen[name, 500] - seen[name, 150])
"""


@pytest.mark.slow
def test_memory_stays_flat_over_500_steps(capture, tmp_path):
    """Of every pass: what a step allocates it gives back. Passes with masks:
    fit/passes/test_memory.py."""
    command = [sys.executable, "-c", FLAT, str(capture), str(tmp_path / "run"), "none"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr
    grown = {
        line.split()[0]: float(line.split()[1])
        for line in done.stdout.splitlines()
        if len(line.split()) == 2
    }
    assert {"explore", "volume", "surface"} <= set(grown), done.stdout
    assert all(mb < 6 for mb in grown.values()), grown


@pytest.mark.slow
@pytest.mark.parametrize("make", [flash_photos, collection_photos], ids=lambda m: m.__name__)
def test_kill_9_in_the_surface_pass_of_other_kinds(capsys, tmp_path, make):
    photos, flags = make(tmp_path / "photos")
    tiny = [w for k, v in TINY.items() if k != "light" for w in ("--set", f"{k}={v}")]
    words = [
        "reconstruct",
        photos,
        "-o",
        tmp_path / "run",
        "--quality",
        "draft",
        "--device",
        "cpu",
        *tiny,
        *flags,
    ]
    process = subprocess.run(
        [sys.executable, "-c", KILLED + JOB, "surface", *map(str, words)],
        capture_output=True,
        timeout=100,
    )
    assert process.returncode == -signal.SIGKILL, process.stderr.decode()
    stages = tmp_path / "run/stages"
    assert (
        (stages / "volume/DONE").exists()
        and not (stages / "surface/DONE").exists()
        and not (tmp_path / "run/asset").exists()
    )
    before = (stages / "volume/DONE").stat().st_mtime_ns
    code, _, err = relit(capsys, *words)
    assert code == 0, err
    assert (stages / "volume/DONE").stat().st_mtime_ns == before  # what was done is not done again
    asset = load_asset(tmp_path / "run")
    assert (
        len(asset.mesh.faces) > 50
        and np.isfinite(asset.material.base_color).all()
        and (tmp_path / "run/report.html").is_file()
    )

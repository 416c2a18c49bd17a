"""A real fit that is killed, and one that is done twice: what a rerun gives, as a user would see
it."""

import signal
import subprocess
import sys

import numpy as np
import pytest

from relit.asset.asset import load_asset
from relit.conventions import move_points
from relit.evaluate.metrics import encode, psnr
from relit.reconstruction import reconstruct
from relit.reference.mitsuba_scene import build_scene, render
from relit.run import read_metrics
from support.lump import cameras, distance_to_truth, write_photos

SETTINGS = {
    "levels": [24, 40],
    "level_steps": [60, 80],
    "rays": 1024,
    "faces": 2000,
    "texture": 64,
    "surface_steps": 120,
    "points": 512,
    "directions": 16,
    "light": 8,
}
# the command line, with checkpoints so often that a fit of seconds has some, in a process that
# kills itself at a step of a stage
COMMAND = """
import os, signal, sys, relit.run as run
run.CHECKPOINT_SECONDS = 0.1
stage, after, step = sys.argv.pop(1), int(sys.argv.pop(1)), run.Stage.step
def killing(self, i, /, **losses):
    step(self, i, **losses)
    if self.name == stage and i >= after and (self.folder / "checkpoint.npz").exists():
        os.kill(os.getpid(), signal.SIGKILL)
run.Stage.step = killing
from relit.cli.main import main
sys.exit(main(sys.argv[1:]))
"""


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return write_photos(tmp_path_factory.mktemp("photos"))


@pytest.fixture(scope="module")
def whole(capture, tmp_path_factory):
    """The same job, never stopped."""
    return load_asset(
        reconstruct(
            capture,
            tmp_path_factory.mktemp("whole") / "run",
            seed=3,
            settings=SETTINGS,
            device="cpu",
            report=False,
        )
    )


def pictures(asset):
    scene = build_scene(asset.mesh, asset.material, asset.world_from_asset, asset.environment)
    return np.stack(
        [render(scene, cameras()[k].resized(40, 40), spp=48, seed=k) for k in (0, 5, 11)]
    )


def alike(a, b) -> float:
    """PSNR in dB of three pictures of each asset."""
    return psnr(encode(pictures(a)[..., :3]), encode(pictures(b)[..., :3]))


def shape_error(asset) -> float:
    return distance_to_truth(move_points(asset.world_from_asset, asset.mesh.vertices))


@pytest.mark.slow
def test_the_same_seed_gives_the_same_asset(capture, whole, tmp_path):
    again = load_asset(
        reconstruct(
            capture, tmp_path / "again", seed=3, settings=SETTINGS, device="cpu", report=False
        )
    )
    other = load_asset(
        reconstruct(
            capture, tmp_path / "other", seed=4, settings=SETTINGS, device="cpu", report=False
        )
    )
    assert alike(whole, again) > 36  # sums of floats in another order, and nothing else
    assert alike(whole, other) < alike(whole, again)
    assert shape_error(again) == pytest.approx(shape_error(whole), rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("stage, after", [("volume", 70), ("surface", 40)])
def test_kill_9_and_the_same_command_again(capture, whole, tmp_path, stage, after):
    run = tmp_path / "run"
    pairs = [
        w
        for key, value in SETTINGS.items()
        for w in ("--set", f"{key}={','.join(map(str, np.atleast_1d(value)))}")
    ]
    words = ["reconstruct", str(capture), "-o", str(run), "--seed", "3", "--device", "cpu", *pairs]
    done = subprocess.run(
        [sys.executable, "-c", COMMAND, stage, str(after), *words], capture_output=True, timeout=100
    )
    assert done.returncode == -signal.SIGKILL, done.stderr
    folder = run / "stages" / stage
    assert not (folder / "DONE").exists() and not (run / "asset").exists()
    kept = int(np.load(folder / "checkpoint.npz")["step"])
    lines = len(read_metrics(run))
    asset = load_asset(
        reconstruct(capture, run, seed=3, settings=SETTINGS, device="cpu", report=False)
    )
    later = [m["step"] for m in read_metrics(run)[lines:] if m["stage"] == stage]
    assert kept >= 1 and min(later) > kept  # nothing before the checkpoint was done again
    assert alike(whole, asset) > 36 and shape_error(asset) < 1.3 * shape_error(whole) + 1e-3

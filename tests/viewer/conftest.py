"""A small run folder, and the page driven in a headless Chromium by steps
(viewer/test/drive.mjs)."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from relit.asset.asset import save_asset
from relit.conventions import move_points, similarity
from relit.geometry.se3 import look_at
from relit.images import write_srgb
from relit.reference.mitsuba_scene import build_scene, render
from relit.scene import Asset, Camera
from relit.synthesize.procedural import pawn
from relit.viewer.page import PAGE
from support import ROOT
from support.browser import HEIGHT, WIDTH, lopsided, serve

CHROMIUM = next(
    (p for p in map(shutil.which, ("chromium", "chromium-browser", "google-chrome")) if p), None
)


@pytest.fixture(scope="session")
def asset() -> Asset:
    """The pawn, turned, scaled and moved in the world, under a lopsided light; three cameras."""
    mesh, material = pawn(40, 60, 64)
    turn, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    world_from_asset = similarity(turn, [0.3, -0.2, 0.5], 1.7)
    cameras = []
    for i in range(3):
        angle = 0.3 + 1.7 * i
        eye, target = move_points(
            world_from_asset,
            np.array([[3.4 * np.sin(angle), 1.6, 3.4 * np.cos(angle)], [0, 0.8, 0]]),
        )
        pose = look_at(eye, target, turn @ [0, 1, 0])
        cameras.append((f"images/p{i}.png", Camera(WIDTH, HEIGHT, 125, 120, 50, 39, pose)))
    return Asset(
        mesh, material, world_from_asset, lopsided(), tuple(cameras), {"capture": "multiview"}
    )


@pytest.fixture(scope="session")
def reference(asset) -> np.ndarray:
    """(H, W, 4) Mitsuba's picture from the first camera."""
    scene = build_scene(asset.mesh, asset.material, asset.world_from_asset, asset.environment)
    return render(scene, asset.cameras[0][1], spp=256)


@pytest.fixture(scope="session")
def run_folder(asset, reference, tmp_path_factory) -> Path:
    """A finished run: asset and small copies of its photos; spaces and umlauts in its path."""
    run = tmp_path_factory.mktemp("viewer") / "ein Läufer & co"
    save_asset(run / "asset", asset)
    (run / "config.toml").write_text('input = "pawn"\n')
    index = {}
    for i, (name, _) in enumerate(asset.cameras):
        write_srgb(run / f"photos/{i:04d}.jpg", reference[..., :3])
        index[name] = f"{i:04d}.jpg"
    (run / "photos/index.json").write_text(json.dumps({"photos": index}))
    return run


@pytest.fixture(scope="session")
def server(built, run_folder):
    from relit.viewer.serve import run_server

    running = serve(lambda: run_server(run_folder))
    yield running
    running.shutdown()
    running.server_close()


@pytest.fixture(scope="session")
def built() -> None:
    if not PAGE.is_file():
        pytest.skip("the page is not built (make viewer)")


@pytest.fixture(scope="session")
def drive(built):
    """drive(url, steps) -> the results of the steps that have one; fails where the page reported an
    error."""
    if not shutil.which("node") or not (ROOT / "viewer/node_modules/playwright-core").is_dir():
        pytest.skip("needs node and viewer/node_modules (make viewer)")
    if CHROMIUM is None:
        pytest.skip("needs Chromium")

    def act(url, steps, errors_allowed=False):
        command = ["node", str(ROOT / "viewer/test/drive.mjs"), CHROMIUM, url]
        done = subprocess.run(
            command, input=json.dumps(steps), capture_output=True, text=True, timeout=120
        )
        assert done.returncode == 0 and done.stdout, done.stderr
        answer = json.loads(done.stdout)
        assert "failed" not in answer, answer
        if not errors_allowed:
            assert answer["said"] == [], answer["said"]
        act.fetched = answer["fetched"]
        return answer["results"]

    return act

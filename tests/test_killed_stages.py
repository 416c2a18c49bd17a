"""Small jobs of each kind, killed in the stages that a capture with cameras and masks does not
have; and done whole where there is no network, 2 GB of memory, and folders with odd names."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from relit.asset.asset import load_asset
from relit.capture.open import open_capture
from relit.errors import UserError
from relit.geometry.se3 import camera_errors
from relit.job import Job
from relit.reconstruction import with_cameras
from relit.run import Run
from support.commands import JOB, TINY
from support.small_captures import collection_photos, flash_photos

# no checkpoint is too early; killed at the third that the stage of a name saves, or at its end,
# before it is called done
DOOMED = """
import contextlib, os, sys, relit.run as run
run.CHECKPOINT_SECONDS = run.CHECKPOINT_LONGEST = 0.0
doomed, saved, begin, save = sys.argv.pop(1), [], run.Run.stage, run.Stage.save
def counted(self, name, /, **arrays):
    save(self, name, **arrays)
    saved.extend([name] * (self.name == doomed))
    if len(saved) == 3:
        os.kill(os.getpid(), 9)
@contextlib.contextmanager
def stage(self, name, **about):
    with begin(self, name, **about) as entered:
        yield entered
        if name == doomed:
            os.kill(os.getpid(), 9)
run.Stage.save, run.Run.stage = counted, stage
"""
# a filter of system calls: the process, and all that it starts, native code as well, dies at the
# first socket of a network
OFFLINE = """
import ctypes, struct
rules = [(0x20, 0, 0, 4), (0x15, 0, 5, 0xC000003E), (0x20, 0, 0, 0), (0x15, 0, 3, 41)]  # x86-64, socket(
rules += [(0x20, 0, 0, 16), (0x15, 1, 0, 1), (0x06, 0, 0, 0x80000000), (0x06, 0, 0, 0x7FFF0000)]  # AF_UNIX is allowed
code = ctypes.create_string_buffer(b"".join(struct.pack("<HBBI", *rule) for rule in rules))
program = ctypes.create_string_buffer(struct.pack("<HxxxxxxQ", len(rules), ctypes.addressof(code)))
libc = ctypes.CDLL(None)
assert libc.prctl(38, 1, 0, 0, 0) == 0 and libc.prctl(22, 2, program, 0, 0) == 0
"""
# sums then come in one order: two runs of one job are the same to the last bit, whatever the photos
ONE_THREAD = "import drjit; drjit.set_thread_count(1)\n"
# true poses stand in for the search of a pile's, and a ball in the middle for a hollow that takes
# many photos to find
TOLD = """
import os
if "HOLLOW" in os.environ:
    import numpy, relit.fit.collection.shape as shape
    shape.PHOTOS = 4
    x = numpy.stack(numpy.meshgrid(*3 * [numpy.linspace(-1, 1, shape.FIRST.nodes)], indexing="ij"), -1)
    shape.open_lids = lambda *_, **__: (numpy.linalg.norm(x, axis=-1) - 0.15).astype(numpy.float32)
if "TRUE_POSES" in os.environ:
    import numpy, relit.fit.duplicates.poses as poses
    from relit.fit.registration.placements import all_placed
    poses.place_few = lambda views, *_, **__: all_placed(numpy.load(os.environ["TRUE_POSES"]), numpy.full(len(views), 0.95))
    from relit.fit.registration.instances.left_out import LeftOut
    poses.leave_out = lambda views, *_, **__: LeftOut(*(numpy.full(len(views), x) for x in (0.95, 0.9, 0.5, 90.0)))
"""


def limited():
    resource.setrlimit(resource.RLIMIT_DATA, (2 << 30, 2 << 30))


def room_photos(folder: Path) -> tuple[Path, list[str]]:
    """A corner of a room without cameras."""
    from relit.images import write_data, write_srgb
    from support.room_corner import arc, photo

    for i, camera in enumerate(arc()):
        rgb, mask = photo(camera)
        write_srgb(folder / "images" / f"{i}.png", rgb)
        write_data(folder / "masks" / f"{i}.png", mask)
    return folder, ["--capture", "multiview"]


def unmasked_photos(folder: Path) -> tuple[Path, list[str]]:
    from support.striped_ball import write_capture

    steps = [
        "explore_steps=100",
        "level_steps=60",
        "surface_steps=80",
    ]  # in fewer, one seed ends now here, now there
    return write_capture(folder), [
        "--masks",
        "none",
        *[w for s in ["background=16", *steps] for w in ("--set", s)],
    ]


def pile_photo(folder: Path) -> tuple[Path, list[str]]:
    """Four pawns."""
    from relit.asset.gltf import write_glb
    from relit.images import write_linear
    from relit.synthesize.duplicates import synthesize_duplicates
    from relit.synthesize.procedural import pawn
    from support.pile_of_pawns import true_poses

    folder.mkdir(parents=True)
    write_glb(folder / "pawn.glb", *pawn(rows=16, columns=20, texture=32))
    write_linear(
        folder / "light.exr", np.linspace(0.2, 2.0, 8 * 16 * 3).reshape(8, 16, 3).astype(np.float32)
    )
    sizes = {
        "count": 4,
        "seed": 3,
        "resolution": 96,
        "test_resolution": 16,
        "spp": 8,
        "test_spp": 1,
        "test_views": 1,
    }
    synthesize_duplicates(folder / "pawn.glb", folder / "light.exr", folder / "photo", **sizes)
    np.save(folder / "poses.npy", true_poses(folder / "photo"))
    return folder / "photo", ["--set", "without=matching", "--set", "side=48"]


def pile_with_ends(folder: Path) -> tuple[Path, list[str]]:
    """The same with two levels, so that the ends of the pawns are asked about. Poses hardly move: a
    checkpoint changes how they round."""
    photo, flags = pile_photo(folder)
    return photo, [
        *flags,
        "--set",
        "levels=16,24",
        "--set",
        "level_steps=10,10",
        "--set",
        "refine_poses=1e-12",
    ]


def collection_with_held_out(folder: Path) -> tuple[Path, list[str]]:
    photos, words = collection_photos(folder)
    words[words.index("without=links")] = "holdout=5"
    return photos, words


def collection_with_a_hollow(folder: Path) -> tuple[Path, list[str]]:
    photos, words = collection_photos(folder)
    return photos, [*words, "--set", "hollows=1"]


def words_of(photos: Path, flags: list[str], run: Path) -> list[str]:
    tiny = [w for k, v in TINY.items() if k != "light" for w in ("--set", f"{k}={v}")]
    return [
        "reconstruct",
        str(photos),
        "-o",
        str(run),
        "--quality",
        "draft",
        "--device",
        "cpu",
        *tiny,
        *flags,
    ]


def job(prelude: str, *words: str, prepare=None):
    told = next((p for w in words for p in [Path(w).with_name("poses.npy")] if p.is_file()), None)
    env = dict(os.environ) if told is None else {**os.environ, "TRUE_POSES": str(told)}
    env |= {"HOLLOW": "1"} if "hollows=1" in words else {}
    command = [sys.executable, "-c", prelude + ONE_THREAD + TOLD + JOB, *words]
    return subprocess.run(command, capture_output=True, timeout=300, preexec_fn=prepare, env=env)


def done(run: Path) -> dict[str, int]:
    return {p.parent.name: p.stat().st_mtime_ns for p in (run / "stages").glob("*/DONE")}


JOBS = [
    (room_photos, ["cameras"]),
    (unmasked_photos, ["explore"]),
    (flash_photos, ["volume", "mesh"]),
    (
        flash_photos,
        ["surface"],
    ),  # resumed in the mesh, the volume pass is taken up at its end and is done once more
    (pile_photo, ["poses", "joint", "volume", "surface"]),
    (pile_photo, ["mesh"]),
    (pile_with_ends, ["joint", "vessel", "mesh"]),
    (collection_with_held_out, ["links", "poses", "second_look", "held_out"]),
    (collection_with_a_hollow, ["volume", "hollows", "opened", "mesh", "surface"]),
]


@pytest.mark.slow
@pytest.mark.parametrize("make, stages", JOBS, ids=lambda v: v.__name__ if callable(v) else None)
def test_kill_9_in_one_stage_after_the_other(tmp_path, make, stages):
    photos, flags = make(tmp_path / "Fotos für später (1)")
    whole, run = tmp_path / "ein Lauf ✓", tmp_path / "run"
    first = job(OFFLINE, *words_of(photos, flags, whole), prepare=limited)
    assert first.returncode == 0, first.stderr.decode()
    paths = [
        p for p in whole.rglob("*") if p.is_file() and str(tmp_path).encode() in p.read_bytes()
    ]
    assert [p.name for p in paths] == ["log.txt"]  # what was said; all else can be moved
    before: dict[str, int] = {}
    for stage in stages:
        killed = job(DOOMED, stage, *words_of(photos, flags, run))
        assert killed.returncode == -signal.SIGKILL, killed.stderr.decode()
        finished = done(run)
        assert (
            stage not in finished
            and before.items() <= finished.items()
            and not (run / "asset").exists()
        )
        before = finished
    last = job("", *words_of(photos, flags, run))
    assert last.returncode == 0, last.stderr.decode()
    assert set(done(run)) == set(done(whole)) and not list(run.rglob("*.part"))
    (alike if make is room_photos else same)(load_asset(whole), load_asset(run))


def same(a, b) -> None:
    """Two assets of one job, to the last bit: shape, maps, lights, cameras and instances."""
    for part in ("vertices", "faces", "normals", "uvs"):
        assert np.array_equal(getattr(a.mesh, part), getattr(b.mesh, part)), part
    maps = [
        {k: v for k, v in vars(x.material).items() if isinstance(v, np.ndarray)} for x in (a, b)
    ]
    assert set(maps[0]) == set(maps[1]) and len(maps[0]) > 1
    for name, values in maps[0].items():
        assert np.array_equal(values, maps[1][name]), name
    lights = [[x.environment, *(x.lights or ())] for x in (a, b)]
    assert all(np.array_equal(x, y) for x, y in zip(*lights, strict=True))
    for (name, x), (other, y) in zip(a.cameras, b.cameras, strict=True):
        assert (
            name == other
            and x.fx == y.fx
            and np.array_equal(x.world_from_camera, y.world_from_camera)
        )
    for x, y in zip(a.instances, b.instances, strict=True):
        assert (x.label, x.registered) == (y.label, y.registered)
        assert not x.registered or np.array_equal(x.world_from_object, y.world_from_object)


def alike(a, b) -> None:
    """Two assets of one job whose cameras were found anew, by a library that draws its own
    samples."""
    angle, distance = camera_errors(
        *(np.array([c.world_from_camera for _, c in x.cameras]) for x in (a, b))
    )
    assert np.median(angle) < 1 and np.median(distance) < 0.05 * np.ptp(b.mesh.vertices)
    assert np.allclose(np.ptp(a.mesh.vertices, axis=0), np.ptp(b.mesh.vertices, axis=0), rtol=0.1)
    assert np.allclose(
        a.material.base_color.mean((0, 1)), b.material.base_color.mean((0, 1)), atol=0.05
    )


def test_a_network_is_noticed():
    """The test above proves nothing if this fails."""
    for reach in (
        "import socket\nsocket.socket()",
        "import subprocess, sys\nsubprocess.run([sys.executable, '-c', INNER], check=True)",
    ):
        code = (
            OFFLINE
            + "INNER = 'import socket; socket.socket()'\nimport socket\nsocket.socket(socket.AF_UNIX)\n"
            + reach
        )
        assert subprocess.run([sys.executable, "-c", code], capture_output=True).returncode != 0


def test_cameras_that_a_run_has_found_are_not_found_anew(tmp_path):
    """They would stand in a frame of their own, and what later stages have kept would not fit."""
    photos, _ = room_photos(tmp_path / "photos")
    with Run.open(tmp_path / "run", {}) as run:
        with run.stage("cameras") as stage:
            (stage.folder / "found.json").write_text("{")
        with pytest.raises(
            UserError, match="cameras that this run has found cannot be read"
        ) as error:
            with_cameras(open_capture(photos), run, Job())
    assert "--overwrite" in error.value.fix

"""Wrong input gets an answer: what, why, fix and the right exit code, through the real command
line; nothing is overwritten."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from relit.images import write_linear
from support.commands import answered, relit
from support.striped_ball import SIDE, black_masks, edit, photos_only, picture, write_capture

# ---------------------------------------------------------------- the table: how the input is
# spoilt, the exit code, what is said


def empty(f):
    for p in (f / "images").iterdir():
        p.unlink()
    photos_only(f)


def one_photo(f):
    for i in range(1, 6):
        (f / f"images/p{i}.png").unlink()
    photos_only(f)


def one_frame(f):
    edit(f, lambda c: c.update(frames=c["frames"][:1]))


def missing_photos(f):
    for i in (0, 1, 3, 4):
        (f / f"images/p{i}.png").unlink()


def renamed_photos(f):
    for i in range(6):
        (f / f"images/p{i}.png").rename(f / f"images/other{i}.png")


def other_size(f):
    edit(f, lambda c: c.update(w=640, h=480, fl_x=500.0))


def truncated(f):
    data = picture(0)[..., :3]
    Image.fromarray(data).save(f / "images/p0.jpg", quality=95)
    whole = (f / "images/p0.jpg").read_bytes()
    (f / "images/p0.jpg").write_bytes(whole[: len(whole) // 2])
    edit(f, lambda c: c["frames"][0].update(file_path="images/p0.jpg"))


def not_an_image(f):
    (f / "images/p0.png").write_text("these are not pixels")


def nan_exr(f):
    rgba = picture(0).astype(np.float32) / 255
    rgba[20:24, 20:24, 0] = np.nan
    write_linear(f / "images/p0.exr", rgba)
    edit(f, lambda c: c["frames"][0].update(file_path="images/p0.exr"))


def white_masks(f):
    (f / "masks").mkdir()
    for i in range(6):
        Image.fromarray(picture(i)[..., :3]).save(f / f"images/p{i}.png")
        Image.new("L", (SIDE, SIDE), 255).save(f / f"masks/p{i}.png")


def inverted_masks(f):
    (f / "masks").mkdir()
    for i in range(6):
        Image.fromarray(picture(i)[..., :3]).save(f / f"images/p{i}.png")
        Image.fromarray(255 - picture(i)[..., 3]).save(f / f"masks/p{i}.png")


def masks_of_another_size(f):
    (f / "masks").mkdir()
    for i in range(6):
        Image.fromarray(picture(i)[..., :3]).save(f / f"images/p{i}.png")
        Image.new("L", (SIDE // 2, SIDE * 2), 128).save(f / f"masks/p{i}.png")


def away(f):
    """Every camera turned by 180 degrees about its own vertical axis."""
    turn = np.diag([-1.0, 1.0, -1.0, 1.0])

    def change(c):
        for frame in c["frames"]:
            frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ turn).tolist()

    edit(f, change)


def no_json(f):
    (f / "transforms.json").write_text('{"frames": [')


def nan_pose(f):
    text = (f / "transforms.json").read_text()
    (f / "transforms.json").write_text(
        text.replace("3.0", "NaN", 1) if "3.0" in text else text.replace("0.8", "NaN", 1)
    )


def no_focal(f):
    edit(f, lambda c: c.pop("camera_angle_x"))


def no_pose(f):
    edit(f, lambda c: c["frames"][2].pop("transform_matrix"))


def textureless(f):
    photos_only(f)
    for i in range(6):
        Image.new("RGB", (SIDE * 2, SIDE * 2), (128, 128, 128)).save(f / f"images/p{i}.png")


FAULTS = [
    (empty, 3, "no "),
    (one_photo, 3, "1 photo is not enough"),
    (one_frame, 3, "1 photo is not enough"),
    (missing_photos, 3, "4 of 6 photos"),
    (renamed_photos, 3, "p0.png"),
    (other_size, 3, "48"),
    (truncated, 3, "p0.jpg"),
    (not_an_image, 3, "p0.png"),
    (nan_exr, 3, "p0.exr"),
    (black_masks, 3, "mask"),
    (white_masks, 3, "mask"),
    (masks_of_another_size, 3, "mask"),
    (away, 3, "camera"),
    (no_json, 3, "transforms.json"),
    (nan_pose, 3, "transforms.json"),
    (no_focal, 3, "focal"),
    (no_pose, 3, "p2.png"),
    (textureless, 4, "0 of 6"),
]


@pytest.fixture
def capture(tmp_path):
    return write_capture(tmp_path / "photos")


@pytest.mark.slow
@pytest.mark.parametrize(
    "spoil, code, said", FAULTS, ids=lambda v: v.__name__ if callable(v) else None
)
def test_spoilt_input(capsys, tmp_path, capture, spoil, code, said):
    spoil(capture)
    before = {p: p.read_bytes() for p in capture.rglob("*") if p.is_file()}
    got, out, err = relit(
        capsys,
        "reconstruct",
        capture,
        "-o",
        tmp_path / "run",
        "--quality",
        "draft",
        "--device",
        "cpu",
    )
    answered(got, err, code, said)
    assert out == ""
    assert before == {p: p.read_bytes() for p in capture.rglob("*") if p.is_file()}
    assert not (tmp_path / "run/asset").exists()


def test_the_unspoilt_capture_is_recognised(capsys, capture):
    """The table above proves nothing if this fails."""
    code, out, _ = relit(capsys, "inspect", capture, "--json")
    found = json.loads(out)
    assert (
        code == 0
        and found["photos"] == 6
        and found["cameras"] == "given"
        and found["sizes"] == [[48, 48]]
    )
    assert all(0.05 < share < 0.6 for share in found["masks"].values())
    assert np.linalg.norm(found["sphere"]["centre"]) < 0.3 and 0.7 < found["sphere"]["radius"] < 1.1
    code, out, _ = relit(capsys, "inspect", capture)
    assert code == 0 and "6 of 48x48 pixels" in out and "recognised as" in out


def test_what_can_be_mended_is_mended_and_said(capsys, capture):
    inverted_masks(capture)
    (capture / "images/p5.png").unlink()
    code, out, _ = relit(capsys, "inspect", capture, "--json")
    found = json.loads(out)
    assert code == 0 and found["photos"] == 5
    assert any("inverted" in note for note in found["notes"]) and any(
        "p5.png" in note for note in found["notes"]
    )
    assert all(share < 0.6 for share in found["masks"].values())


def test_photos_of_mixed_sizes_are_named_or_read(capsys, capture):
    photos_only(capture)
    Image.fromarray(picture(0)).resize((96, 64)).save(capture / "images/p0.png")
    code, out, err = relit(capsys, "inspect", capture, "--json")
    if code:
        answered(code, err, 3, "size")
    else:
        found = json.loads(out)
        assert [96, 64] in found["sizes"] and any("size" in note for note in found["notes"])


@pytest.mark.parametrize("flags, code, said", [
    (["--sphere", "100,0,0,0.5"], 3, "sphere"),
    (["--masks", "magic"], 2, "magic"),
    (["--masks", "files"], 3, "mask"),
    (["--set", "no_such_key=1"], 2, "unknown key 'no_such_key'"),
    (["--set", "nonsense"], 2, "'=' is missing"),
    (["--device", "cdua"], 2, "Did you mean 'cuda'?"),
])  # fmt: skip
def test_flags_that_do_not_fit_the_input(capsys, tmp_path, capture, flags, code, said):
    got, _, err = relit(capsys, "reconstruct", capture, "-o", tmp_path / "run", *flags)
    answered(got, err, code, said)
    assert not (tmp_path / "run").exists()


def test_input_that_is_not_there(capsys, tmp_path):
    got, _, err = relit(capsys, "reconstruct", tmp_path / "nowhere", "-o", tmp_path / "run")
    answered(got, err, 3, "nowhere")
    (tmp_path / "notes.txt").write_text("hello")
    got, _, err = relit(capsys, "inspect", tmp_path / "notes.txt")
    answered(got, err, 3, "notes.txt")


def test_config_file_with_an_unknown_key(capsys, tmp_path, capture):
    config = tmp_path / "c.toml"
    wrong = {
        "qualty = 'draft'\n": "unknown key 'qualty'",
        "quality = 'drft'\n": "Did you mean 'draft'?",
        "= 3": "cannot be read",
    }
    for text, said in wrong.items():
        config.write_text(text)
        got, _, err = relit(
            capsys, "reconstruct", capture, "-o", tmp_path / "run", "--config", config
        )
        answered(got, err, 2, said)
    config.write_text("seed = 'many'\n")
    got, _, err = relit(capsys, "reconstruct", capture, "-o", tmp_path / "run", "--config", config)
    answered(got, err, 2, "seed=many is not valid; expected whole number")


def test_output_that_would_be_mixed_or_overwritten(capsys, tmp_path, capture):
    got, _, err = relit(capsys, "reconstruct", capture, "-o", capture / "run")
    answered(got, err, 3, "lie in one another")
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "thesis.txt").write_text("years of work")
    for extra in ([], ["--overwrite"]):
        got, _, err = relit(capsys, "reconstruct", capture, "-o", mine, *extra)
        answered(got, err, 3, "nothing was overwritten")
    assert [p.name for p in mine.iterdir()] == ["thesis.txt"]


def test_full_disk(capsys, tmp_path, capture, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    got, _, err = relit(
        capsys, "reconstruct", capture, "-o", tmp_path / "run", "--quality", "draft"
    )
    monkeypatch.undo()
    answered(got, err, 5, "the disk is full")


def test_too_little_memory(capsys, tmp_path, capture, monkeypatch):
    from relit import job as plan

    monkeypatch.setattr(plan, "available_memory", lambda: 2e8)
    got, _, err = relit(capsys, "reconstruct", capture, "-o", tmp_path / "run")
    answered(got, err, 5, "of memory")
    assert not (tmp_path / "run").exists()


def test_no_libllvm_in_a_fresh_process(tmp_path, capture):
    environment = {**os.environ, "DRJIT_LIBLLVM_PATH": str(tmp_path / "nowhere.so")}
    command = [
        sys.executable,
        "-m",
        "relit",
        "reconstruct",
        str(capture),
        "-o",
        str(tmp_path / "run"),
        "--device",
        "cpu",
    ]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=60)
    answered(done.returncode, done.stderr, 5, "libLLVM")
    assert "apt-get install" in done.stderr


@pytest.mark.parametrize("verb, flags", [
    ("export", ["-o", "x.glb"]),
    ("export", ["-o", "x.html"]),
    ("view", ["--no-browser"]),
    ("evaluate", ["--truth", "."]),
    ("relight", ["--light", "l.hdr", "-o", "pictures"]),
])  # fmt: skip
def test_verbs_that_need_an_asset(capsys, tmp_path, monkeypatch, verb, flags):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    got, _, err = relit(capsys, verb, "empty", *flags)
    answered(got, err, 3, "asset folder")


def test_a_page_that_is_not_built(capsys, tmp_path, monkeypatch):
    """A checkout without node: every other verb works, and these two say what builds it."""
    from relit.asset.asset import save_asset
    from relit.scene import Asset
    from relit.synthesize.procedural import pawn

    save_asset(tmp_path / "run/asset", Asset(*pawn(6, 8, 8), np.eye(4)))
    monkeypatch.setattr("relit.viewer.page.PAGE", tmp_path / "nowhere.html")
    for words in (
        ["view", tmp_path / "run", "--no-browser"],
        ["export", tmp_path / "run", "-o", tmp_path / "x.html"],
    ):
        got, _, err = relit(capsys, *words)
        answered(got, err, 5, "make viewer")
    got, _, err = relit(capsys, "view", tmp_path / "run", "--port", "99999")
    answered(got, err, 2, "is not a port")

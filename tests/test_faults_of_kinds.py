"""Wrong input of flash, duplicates and collection through the command line: what is said, the exit
code, no asset; nothing is fitted."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from PIL import Image

from support.commands import answered, relit
from support.small_captures import answer, collection
from support.striped_ball import SIDE, edit, picture, write_capture

BALL = ["--sphere", "0,0,0,0.9"]

# ---------------------------------------------------------------- flash: the ball of
# `write_capture` under a lamp at the camera


def flash_capture(folder):
    """Six photos with cameras; the ball darkens towards its outline, as under a flash, and nothing
    else is lit."""
    write_capture(folder)
    repaint(folder, lambda rgb, inside, _: rgb * 0.6)
    return folder


def repaint(folder, change, mode="RGBA"):
    """change(rgb (48, 48, 3) in [0, 1], inside (48, 48, 1) bool, number of the photo) -> rgb."""
    for i in range(6):
        rgba = picture(i)
        rgb = np.clip(change(rgba[..., :3] / 255, rgba[..., 3:] > 127, i) * 255, 0, 255).astype(
            np.uint8
        )
        Image.fromarray(np.concatenate([rgb, rgba[..., 3:]], -1)).convert(mode).save(
            folder / f"images/p{i}.png"
        )


def black(f):
    repaint(f, lambda rgb, *_: 0 * rgb)


def lit_room(f):
    repaint(
        f,
        lambda rgb, inside, i: np.where(inside, rgb, np.random.default_rng(i).random(rgb.shape)),
        "RGB",
    )


def bright_wall(f):
    repaint(f, lambda rgb, inside, i: np.where(inside, rgb * 0.6, 0.9), "RGB")


def over_exposed(f):
    repaint(f, lambda rgb, inside, i: np.ones_like(rgb) * inside)


def one_place(f):
    edit(
        f,
        lambda c: [
            frame.update(transform_matrix=c["frames"][0]["transform_matrix"])
            for frame in c["frames"]
        ],
    )
    for i in range(1, 6):
        shutil.copy(f / "images/p0.png", f / f"images/p{i}.png")


# ---------------------------------------------------------------- duplicates: three discs in a
# photo


def pile(folder):
    folder.mkdir()
    y, x = np.mgrid[:96, :160]
    labels = sum((k + 1) * 40 * ((x - 30 - 48 * k) ** 2 + (y - 48) ** 2 < 18**2) for k in range(3))
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (96, 160, 3), np.uint8)).save(
        folder / "pile.png"
    )
    relabel(folder, labels)
    return folder


def relabel(folder, labels):
    Image.fromarray(labels.astype(np.uint8)).save(folder / "pile_labels.png")


def no_labels(f):
    (f / "pile_labels.png").unlink()


def no_instance(f):
    relabel(f, np.zeros((96, 160)))


def empty_cutouts(f):
    no_labels(f)
    (f / "cutouts").mkdir()
    for k in range(3):
        Image.new("RGBA", (160, 96)).save(f / f"cutouts/{k}.png")


def labels_of_another_photo(f):
    relabel(f, np.ones((160, 96)))


def tiny_instances(f):
    labels = np.zeros((96, 160))
    for k in range(4):
        labels[20:30, 20 + 30 * k : 30 + 30 * k] = k + 1
    relabel(f, labels)


# ---------------------------------------------------------------- collection: six photos of the
# ball with masks


def three_photos(f):
    for i in range(3, 6):
        (f / f"image/{i}.png").unlink()
        (f / f"mask/{i}.png").unlink()


def all_centre(f):
    answer(f, ["Center", "Center", "Center"])


def unknown_quadrant(f):
    answer(f, ["Left", "Abov", "Front"])


def quadrants_of_others(f):
    frames = [
        {"image_name": f"IMG_{i}.jpg", "quadrant": ["Left", "Center", "Front"]} for i in range(6)
    ]
    (f / "quadrants.json").write_text(json.dumps({"frames": frames}))


def empty_masks(f):
    for i in range(6):
        Image.new("L", (SIDE, SIDE), 0).save(f / f"mask/{i}.png")


def as_it_is(f):
    pass


FAULTS = [
    (flash_capture, black, BALL, 3, "the photos are black"),
    (flash_capture, lit_room, BALL, 3, "the surroundings are not dark"),
    (flash_capture, bright_wall, BALL, 3, "bright, even backdrop"),
    (flash_capture, over_exposed, BALL, 3, "over-exposed"),
    (flash_capture, one_place, BALL, 3, "from one place"),
    (flash_capture, as_it_is, [*BALL, "--set", "dino=nowhere.onnx"], 3, "no network at"),
    (flash_capture, as_it_is, [*BALL, "--set", "level_steps=5"], 2, "differ in length"),
    (pile, no_labels, [], 3, "no labels were found"),
    (pile, no_instance, [], 3, "the labels hold no object"),
    (pile, empty_cutouts, [], 3, "the labels hold no object"),
    (pile, labels_of_another_photo, [], 3, "another shape than the photo"),
    (pile, tiny_instances, [], 3, "smaller than 24 pixels"),
    (pile, no_labels, ["--masks", "segment:nowhere.onnx"], 3, "no network at"),
    (pile, as_it_is, ["--set", "level_steps=5"], 2, "differ in length"),
    (pile, as_it_is, ["--set", "matcher_step=7"], 2, "divisor of 360"),
    (collection, three_photos, [], 3, "at least 4 are needed"),
    (collection, all_centre, [], 3, "Center"),
    (collection, unknown_quadrant, [], 3, "Did you mean 'Above'"),
    (collection, quadrants_of_others, [], 3, "answers for 0 of 6 photos"),
    (collection, empty_masks, [], 3, "all masks are black"),
    (collection, as_it_is, ["--set", "levels=32"], 2, "differ in length"),
    (collection, as_it_is, ["--set", "light_network=nowhere"], 3, "the light network is not there"),
]  # fmt: skip
KINDS = {flash_capture: "flash", pile: "duplicates", collection: "collection"}


@pytest.mark.slow
@pytest.mark.parametrize(
    "make, spoil, flags, code, said", FAULTS, ids=lambda v: v.__name__ if callable(v) else None
)
def test_spoilt_input_of_a_kind(capsys, tmp_path, make, spoil, flags, code, said):
    folder = make(tmp_path / "photos")
    spoil(folder)
    words = ["--capture", KINDS[make], "--quality", "draft", "--device", "cpu", *flags]
    got, out, err = relit(capsys, "reconstruct", folder, "-o", tmp_path / "run", *words)
    answered(got, err, code, said)
    assert out == "" and not (tmp_path / "run/asset").exists()
    assert "begun" not in err  # no stage


@pytest.mark.parametrize("make", KINDS, ids=lambda m: m.__name__)
def test_unspoilt_input_of_a_kind(capsys, tmp_path, make):
    """The table above proves nothing if this fails."""
    code, out, err = relit(
        capsys, "inspect", make(tmp_path / "photos"), "--capture", KINDS[make], "--json"
    )
    assert code == 0 and json.loads(out)["capture"] == KINDS[make], err


def test_one_instance_is_said_before_anything_is_done(capsys, tmp_path):
    folder = pile(tmp_path / "photos")
    y, x = np.mgrid[:96, :160]
    relabel(folder, 9 * ((x - 80) ** 2 + (y - 48) ** 2 < 18**2))
    code, out, _ = relit(capsys, "inspect", folder, "--json")
    assert code == 0 and any("there is only one object" in n for n in json.loads(out)["notes"])

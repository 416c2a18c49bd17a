"""MVMC's layout: run-length masks and rough cameras in annotations.json."""

import json

import numpy as np
import pytest

from relit.capture.open import open_capture
from relit.capture.readers.samurai import read_hints
from relit.errors import UserError
from relit.images import write_srgb
from relit.masks.rle import runs_from


def runs_of(mask):
    """Plain runs of a mask, down the columns, written out."""
    flat = mask.T.ravel() > 0.5
    ends = np.flatnonzero(np.diff(flat)) + 1
    counts = np.diff([0, *ends, len(flat)]).tolist()
    return {
        "counts": " ".join(map(str, counts if not flat[0] else [0, *counts])),
        "size": list(mask.shape),
    }


def look_from(azimuth):
    """PyTorch3D's camera (row vectors, x left, y up) at distance 2.5 in the horizontal plane; 0 is
    on +z."""
    a = np.radians(azimuth)
    eye = 2.5 * np.array([np.sin(a), 0, np.cos(a)])
    z = -eye / np.linalg.norm(eye)
    x = np.cross([0, 1, 0], z)
    r = np.stack([x, np.cross(z, x), z], 1)
    return {"R": r.tolist(), "T": (-eye @ r).tolist(), "fov": 60.0}


@pytest.fixture
def cars(tmp_path):
    rng, entries = np.random.default_rng(0), []
    for i, azimuth in enumerate((0, 90, 180, 270)):
        write_srgb(
            tmp_path / "images" / f"{i}.png", rng.uniform(0, 1, (30, 40, 3)).astype(np.float32)
        )
        mask = np.zeros((30, 40), np.float32)
        mask[8:20, 5 + i : 30] = 1
        entries.append(
            {"filename": f"{i}.png", "mask": runs_of(mask), "camera_initial": look_from(azimuth)}
        )
    write(tmp_path, entries[::-1])  # the order in the file is nobody's
    return tmp_path, entries


def write(folder, entries):
    (folder / "annotations.json").write_text(
        json.dumps({"id": "7", "car_model": "a car", "annotations": entries})
    )


def test_masks_and_directions(cars):
    capture = open_capture(cars[0])
    assert (capture.format, capture.kind, len(capture.photos)) == ("mvmc", "collection", 4)
    for i, photo in enumerate(capture.photos):
        mask = photo.load().mask
        assert (
            mask.shape == (30, 40) and mask[8:20, 5 + i : 30].all() and mask.sum() == 12 * (25 - i)
        )
    hints = read_hints(capture.root, [p.name for p in capture.photos])
    seen = [hints.directions[p.name] for p in capture.photos]
    assert np.allclose(seen, [[0, 0, 1], [1, 0, 0], [0, 0, -1], [-1, 0, 0]], atol=1e-6)
    assert "run lengths" in " ".join(capture.notes)
    assert open_capture(cars[0], masks="none").photos[0].load().mask is None


def test_photos_may_be_shrunk(cars):
    mask = open_capture(cars[0], max_side=20).photos[0].load().mask
    assert mask.shape == (15, 20) and mask[5:9, 4:14].min() > 0.9


def test_runs_as_a_list_and_packed():
    mask = np.zeros((4, 5))
    mask[1:3, 2:4] = 1
    plain = runs_of(mask)
    listed = {**plain, "counts": [int(v) for v in plain["counts"].split()]}
    packed = {"counts": pack([9, 2, 2, 2, 5]), "size": [4, 5]}
    for content in (plain, listed, packed):
        assert (runs_from(content, "a").decode() == mask).all()


def pack(counts):
    """COCO's packing, from its definition."""
    text = ""
    for i, count in enumerate(counts):
        x, more = count - (counts[i - 2] if i > 2 else 0), True
        while more:
            c = x & 31
            x >>= 5
            more = x != -1 if c & 16 else x != 0
            text += chr((c | 32 if more else c) + 48)
    return text


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"mask": {"counts": "10 20", "size": [30, 40]}}, "do not add up"),
        ({"mask": {"counts": "10 -2", "size": [30, 40]}}, "cannot be read|add up"),
        ({"mask": {"counts": [1.5], "size": [30, 40]}}, "do not add up"),
        ({"mask": {"size": [30, 40]}}, "no run-length mask"),
        ({"mask": {"counts": "1200", "size": [10**9, 10**9]}}, "no run-length mask"),
        ({"mask": None}, "have no mask in the file"),
        ({"filename": "9.png"}, "missing"),
        ({"filename": "../9.png"}, "outside the capture"),
    ],
)
def test_damaged_files(cars, change, words):
    folder, entries = cars
    write(folder, [{**entries[0], **change}, *entries[1:]])
    with pytest.raises(UserError, match=words):
        open_capture(folder)


def test_cameras_that_are_none(cars):
    folder, entries = cars
    write(
        folder,
        [
            {**entries[0], "camera_initial": {"R": np.zeros((3, 3)).tolist(), "T": [0, 0, 1]}},
            *entries[1:],
        ],
    )
    with pytest.raises(UserError, match="no camera"):
        read_hints(folder, ["images/0.png"])


def test_cocos_own_file_is_left_alone(tmp_path):
    for i in range(4):
        write_srgb(tmp_path / "images" / f"{i}.png", np.full((20, 20, 3), 0.2 * i, np.float32))
    (tmp_path / "annotations.json").write_text(json.dumps({"annotations": [{"image_id": 3}]}))
    assert open_capture(tmp_path).format == "photos"

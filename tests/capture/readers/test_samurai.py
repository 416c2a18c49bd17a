import json

import numpy as np
import pytest

from relit.capture.open import open_capture
from relit.capture.readers.samurai import direction_of, read_hints
from relit.errors import UserError
from relit.images import write_data, write_srgb


@pytest.fixture
def folder(tmp_path):
    """Six photos with masks in SAMURAI's layout."""
    rng = np.random.default_rng(0)
    mask = np.zeros((24, 32), np.float32)
    mask[6:18, 8:24] = 1
    for i in range(6):
        write_srgb(
            tmp_path / "image" / f"{i}.png", rng.uniform(0, 1, (24, 32, 3)).astype(np.float32)
        )
        write_data(tmp_path / "mask" / f"{i}.png", mask)
    return tmp_path


def write_quadrants(folder, answers, names=None):
    names = names or [f"{i}.jpg" for i in range(len(answers))]
    frames = [{"image_name": n, "quadrant": a} for n, a in zip(names, answers, strict=True)]
    (folder / "quadrants.json").write_text(json.dumps({"frames": frames}))


ANSWERS = [
    ["Left", "Center", "Front"],
    ["Right", "Above", "Front"],
    ["Center", "Center", "Back"],
    ["Left", "Below", "Back"],
    ["Center", "Above", "Center"],
    ["Right", "Center", "Center"],
]


def test_layout_is_recognised(folder):
    write_quadrants(folder, ANSWERS)
    (folder / "held_out.json").write_text(json.dumps({"frames": ["5.png"]}))
    capture = open_capture(folder, min_photos=4)
    assert (capture.kind, capture.format, len(capture.photos), len(capture.held_out)) == (
        "collection",
        "samurai",
        5,
        1,
    )
    assert capture.photos[0].load().mask.max() == 1
    assert not capture.has_cameras


def test_answers_are_matched_by_name(folder):
    order = [3, 1, 5, 0, 2, 4]
    write_quadrants(folder, [ANSWERS[i] for i in order], [f"{i}.png" for i in order])
    hints = read_hints(folder, [f"image/{i}.png" for i in range(6)])
    for i, answers in enumerate(ANSWERS):
        assert np.allclose(hints.directions[f"image/{i}.png"], direction_of(answers))
    assert np.allclose(hints.directions["image/4.png"], [0, 1, 0])


def test_answers_that_say_nothing_are_refused(folder):
    write_quadrants(folder, [*ANSWERS[:5], ["Center", "Center", "Center"]])
    with pytest.raises(UserError, match="all three answers") as raised:
        read_hints(folder, [f"image/{i}.png" for i in range(6)])
    assert raised.value.code == 3


def test_answers_for_other_photos_are_refused(folder):
    write_quadrants(folder, ANSWERS, [f"other_{i}.jpg" for i in range(6)])
    with pytest.raises(UserError, match="0 of 6"):
        read_hints(folder, [f"image/{i}.png" for i in range(6)])


@pytest.mark.parametrize("answers", [["Lefty", "Center", "Front"], ["Left", 3, "Front"]])
def test_words_that_are_no_answers_are_refused(folder, answers):
    write_quadrants(folder, [*ANSWERS[:5], answers])
    with pytest.raises(UserError, match="no answer"):
        read_hints(folder, [f"image/{i}.png" for i in range(6)])


def test_malformed_files_are_refused(folder):
    for text in (
        '{"frames": 3}',
        '{"frames": [3]}',
        '{"frames": [{"quadrant": ["Left"]}]}',
        "[]",
        "{",
    ):
        (folder / "quadrants.json").write_text(text)
        with pytest.raises(UserError):
            read_hints(folder, [f"image/{i}.png" for i in range(6)])


def test_angles_of_ners(tmp_path):
    names = [f"images/{c}.jpg" for c in "bca"]
    (tmp_path / "metadata.json").write_text(
        json.dumps({"azimuths": [0, 90, 180], "elevations": [0, 30, 90]})
    )
    hints = read_hints(tmp_path, names)
    assert np.allclose(hints.directions["images/a.jpg"], [0, 0, 1])
    assert np.allclose(hints.directions["images/b.jpg"], [np.cos(np.pi / 6), 0.5, 0])
    assert np.allclose(hints.directions["images/c.jpg"], [0, 1, 0], atol=1e-9)
    (tmp_path / "metadata.json").write_text(
        json.dumps({"azimuths": [0, 90], "elevations": [0, 30]})
    )
    with pytest.raises(UserError, match="2 azimuths"):
        read_hints(tmp_path, names)


def test_a_held_out_photo_that_is_not_there_is_refused(folder):
    (folder / "held_out.json").write_text(json.dumps({"frames": ["77.png"]}))
    with pytest.raises(UserError, match=r"77.png"):
        open_capture(folder)


def test_no_hints_is_none(folder):
    assert read_hints(folder, ["image/0.png"]) is None

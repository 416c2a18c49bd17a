"""`relit quadrants`: keys to answers, in the terminal and over the page's server."""

import json
import threading
import time
from dataclasses import replace
from pathlib import Path
from urllib.request import Request, urlopen

import numpy as np
import pytest

from relit.capture.open import open_capture
from relit.capture.readers.samurai import direction_of, quadrant_of, read_hints
from relit.errors import UserError
from relit.images import write_srgb
from relit.viewer import quadrants
from relit.viewer.quadrants import answers_of, ask_in_terminal, guesses_of, keys_of, quadrant_server
from support.browser import serve


@pytest.fixture
def capture(tmp_path):
    for i in range(3):
        write_srgb(tmp_path / f"{i}.png", np.full((20, 30, 3), 0.2 + 0.2 * i, np.float32))
    return open_capture(tmp_path, masks="none")


def test_keys():
    assert answers_of("af") == ["Left", "Center", "Front"]
    assert answers_of(" W b") == ["Center", "Above", "Back"]
    for keys in ("", "ad", "x", "wsf"):
        with pytest.raises(UserError):
            answers_of(keys)


def test_terminal(capture):
    said, typed = [], iter(["ad", "af", "", "w"])
    path = ask_in_terminal(capture, lambda _: next(typed), said.append)
    assert any("contradict" in text for text in said)
    hints = read_hints(path.parent, ["0.png", "2.png"])
    assert np.allclose(hints.directions["0.png"], np.array([-1, 0, 1]) / np.sqrt(2))
    assert np.allclose(hints.directions["2.png"], [0, 1, 0])
    ask_in_terminal(
        capture,
        lambda text: "d" if text.startswith("1.png (1 of 1)") else pytest.fail(text),
        said.append,
    )  # only what is left
    assert len(json.loads(path.read_text())["frames"]) == 3


def test_photos_that_are_set_aside_are_asked_for_among_the_others(capture):
    aside = replace(
        capture, photos=capture.photos[:1] + capture.photos[2:], held_out=capture.photos[1:2]
    )
    asked = []
    ask_in_terminal(aside, lambda text: asked.append(text.split()[0]) or "a", lambda _: None)
    assert [Path(name).name for name in asked] == ["0.png", "1.png", "2.png"]


def test_directions_and_answers_are_inverse():
    for keys in ("a", "df", "wb", "dsf", "s"):
        answers = answers_of(keys)
        assert quadrant_of(direction_of(answers)) == answers and set(keys_of(answers)) == set(keys)
    assert quadrant_of(np.array([0.1, 0.2, -5.0])) == ["Center", "Center", "Back"]


def test_guesses_of_a_finished_run(capture, tmp_path):
    from relit.asset.asset import cameras_to_json
    from relit.geometry.se3 import look_at
    from relit.scene import Camera

    eyes = {"0.png": [-2.0, 0, 2], "1.png": [0, 3.0, 0.1], "2.png": [2.0, 0, -0.1]}
    cameras = [
        (f"image/{n}", Camera(30, 20, 40.0, 40.0, 15.0, 10.0, look_at(np.array(e))))
        for n, e in eyes.items()
    ]
    (tmp_path / "run" / "asset").mkdir(parents=True)
    (tmp_path / "run" / "asset" / "cameras.json").write_text(json.dumps(cameras_to_json(cameras)))
    (tmp_path / "run" / "asset" / "asset.json").write_text("{}")
    guesses = guesses_of(tmp_path / "run")
    assert guesses == {
        "0.png": ["Left", "Center", "Front"],
        "1.png": ["Center", "Above", "Center"],
        "2.png": ["Right", "Center", "Center"],
    }
    typed = {"0.png": "", "1.png": "b", "2.png": "q"}  # Enter takes the guess
    path = ask_in_terminal(capture, lambda text: typed[text.split()[0]], lambda _: None, guesses)
    said = {f["image_name"]: f["quadrant"] for f in json.loads(path.read_text())["frames"]}
    assert said == {"0.png": guesses["0.png"], "1.png": ["Center", "Center", "Back"]}


def test_the_page_begins_with_the_guesses(built, capture):
    guesses = {
        "0.png": ["Left", "Center", "Front"],
        "1.png": ["Center", "Above", "Center"],
        "2.png": ["Right", "Center", "Center"],
    }
    server = quadrant_server(capture, guesses=guesses)
    try:
        assert [p["guess"] for p in server.answers["quadrants"]()["photos"]] == list(
            guesses.values()
        )
    finally:
        server.server_close()


def test_page(built, capture):
    server = quadrant_server(capture)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        with urlopen(server.url) as reply:
            assert b"where did the camera stand" in reply.read()
        with urlopen(server.url + "photo.jpg?i=1") as reply:
            assert reply.read()[:2] == b"\xff\xd8"

        def post(content):
            body, origin = json.dumps(content).encode(), {"Origin": server.url.rstrip("/")}
            with urlopen(Request(server.url + "answer", body, origin)) as reply:
                return json.load(reply)

        assert post({"i": 1, "keys": "sb"})["answer"] == ["Center", "Below", "Back"]
        with urlopen(server.url + "quadrants") as reply:
            assert [p["answer"] for p in json.load(reply)["photos"]] == [
                None,
                ["Center", "Below", "Back"],
                None,
            ]
        with pytest.raises(OSError, match="422"):
            post({"i": 1, "keys": ""})
    finally:
        server.shutdown()
        server.server_close()


def test_answering_in_a_browser(drive, capture, monkeypatch):
    """By keys; a photo that takes long to load shows nothing until it is there, and never the one
    before."""
    encode = quadrants.encode_jpeg
    monkeypatch.setattr(quadrants, "encode_jpeg", lambda rgb: (time.sleep(0.8), encode(rgb))[1])
    server = serve(lambda: quadrants.quadrant_server(capture))
    shown = "(() => { const p = document.getElementById('photo'); return [p.getAttribute('src'), p.complete && p.naturalWidth]; })()"
    there = {"wait": "document.getElementById('photo').naturalWidth === 30"}
    try:
        results = drive(
            server.url,
            [
                {"wait": "typeof photos !== 'undefined' && photos.length === 3"},
                {"eval": shown},
                there,
                {"press": "d"},
                {"press": "w"},
                {"press": "Enter"},
                {"wait": "photos[0].answer"},
                {"eval": shown},
                there,
                {"press": "a"},
                {"press": "d"},  # the other side of an axis takes its place
                {"press": "b"},
                {"press": "Enter"},
                {"wait": "photos[1].answer"},
                there,
                {"press": "Enter"},  # nothing chosen
                {"wait": "document.getElementById('note').textContent !== ''"},
                {"press": "f"},
                {"press": "Enter"},
                {"wait": "photos[2].answer"},
                {"eval": "document.getElementById('note').textContent"},
                {"press": "ArrowLeft"},
                {"eval": shown},
            ],
            errors_allowed=True,  # the refused answer
        )
    finally:
        server.shutdown()
        server.server_close()
    assert results[0][0] == "photo.jpg?i=0" and not results[0][1]
    assert results[1][0] == "photo.jpg?i=1" and not results[1][1]
    assert results[2].startswith("All answered")
    assert results[3] == ["photo.jpg?i=1", 30], "a photo that was there is there at once"
    answers = json.loads((capture.folder / "quadrants.json").read_text())["frames"]
    assert [f["quadrant"] for f in answers] == [
        ["Right", "Above", "Center"],
        ["Right", "Center", "Back"],
        ["Center", "Center", "Front"],
    ]

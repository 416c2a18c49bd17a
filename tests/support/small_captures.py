"""Small captures of each kind."""

from __future__ import annotations

import json
from pathlib import Path

from PIL import Image

from support.striped_ball import picture, write_capture


def collection(folder):
    (folder / "image").mkdir(parents=True)
    (folder / "mask").mkdir()
    for i in range(6):
        rgba = picture(i)
        Image.fromarray(rgba[..., :3]).save(folder / f"image/{i}.png")
        Image.fromarray(rgba[..., 3]).save(folder / f"mask/{i}.png")
    answer(folder, ["Left", "Center", "Front"])
    return folder


def answer(f, words, ending="png"):
    frames = [{"image_name": f"{i}.{ending}", "quadrant": words} for i in range(6)]
    (f / "quadrants.json").write_text(json.dumps({"frames": frames}))


def flash_photos(folder: Path) -> tuple[Path, list[str]]:
    """The ball with cameras in a file that tells no kind, and the words that make it a small flash
    job."""
    return write_capture(folder), ["--capture", "flash", "--set", "hollows=0"]


def collection_photos(folder: Path) -> tuple[Path, list[str]]:
    """The ball from six sides with masks and quadrants, and the words that make it a small job."""
    from support.small_captures import collection

    small = {"side": 48, "rounds": 1, "polish": 0, "keep": 1, "frozen_steps": 4, "least_score": 0.1}
    pairs = [w for k, v in small.items() for w in ("--set", f"{k}={v}")]
    return collection(folder), ["--capture", "collection", *pairs, "--set", "without=links"]

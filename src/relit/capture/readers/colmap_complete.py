"""COLMAP models as other programs write them: without points, or as text whose images lack their
second lines. pycolmap needs all files and reads every second line of images.txt as points."""

from __future__ import annotations

import re
import shutil
import tempfile
from pathlib import Path

from relit.capture.readers.colmap_binary import check_binary, without_observations
from relit.device import load_pycolmap

PARTS = ("cameras", "images", "points3D")
SPACE = "\x1f"  # stands for a space in a name: COLMAP's reader ends a name there
NO_POINTS = {"bin": bytes(8), "txt": b"# no points\n"}  # a count of zero; no line


def model_ending(folder: Path) -> str | None:
    """'bin' or 'txt' where a folder holds a model, be it without points; else None."""
    found = (e for e in ("bin", "txt") if all((folder / f"{n}.{e}").is_file() for n in PARTS[:2]))
    return next(found, None)


def load_model(folder: Path) -> tuple[object, list[str]]:
    """-> (pycolmap.Reconstruction, notes on what was completed). Raises what pycolmap raises, and
    ValueError for damaged files."""
    pycolmap = load_pycolmap()

    ending = model_ending(folder)
    complete = (folder / f"points3D.{ending}").is_file()
    notes = [] if complete else [f"the COLMAP model has no points3D.{ending}: {folder.name}/"]
    images = folder / f"images.{ending}"
    if ending == "bin":
        check_binary(folder)
        if complete:
            return pycolmap.Reconstruction(str(folder)), notes
        content = without_observations(images.read_bytes())
    else:
        text, lacking = with_second_lines(images.read_text(encoding="utf-8"), complete)
        if complete and not lacking and SPACE not in text:
            return pycolmap.Reconstruction(str(folder)), notes
        if lacking:
            notes.append(
                f"{lacking} of the images in images.txt have no second line (their points): they "
                "are read without points"
            )
        content = text.encode()
    with tempfile.TemporaryDirectory() as place:
        for file in folder.glob(f"*.{ending}"):
            if file.name != images.name:
                shutil.copy(file, place)
        Path(place, images.name).write_bytes(content)
        if not complete:
            Path(place, f"points3D.{ending}").write_bytes(NO_POINTS[ending])  # pyright: ignore[reportArgumentType]
        return pycolmap.Reconstruction(place), notes


def name_of(image) -> str:
    """The name of a pycolmap.Image of `load_model`."""
    return image.name.replace(SPACE, " ")


def with_second_lines(text: str, points: bool = True) -> tuple[str, int]:
    """images.txt with two lines for each image, and how many had but one; spaces in
    names become SPACE. points: keep the second
    lines; else they are empty. Raises ValueError for a line that is neither."""
    out: list[str] = []
    lacking, waiting = 0, False
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split()
        if line.startswith("#"):
            continue
        if _is_image(words):
            if waiting:
                out.append("")
                lacking += 1
            out.append(" ".join(words[:9]) + " " + SPACE.join(line.split(maxsplit=9)[9].split(" ")))
            waiting = True
        elif waiting and (not words or _is_points(words)):
            out.append(line if points else "")
            waiting = False
        elif words:
            raise ValueError(
                f"line {number} of images.txt is neither an image (ID, quaternion, translation, "
                "camera, name) nor its points (X, Y, ID ...)"
            )
    if waiting:
        out.append("")
    return "\n".join(out) + "\n", lacking


def _is_image(words: list[str]) -> bool:
    whole = r"[+-]?\d+"
    if len(words) < 10 or not re.fullmatch(whole, words[0]) or not re.fullmatch(whole, words[8]):
        return False
    named = not _is_number(" ".join(words[9:]))
    return all(map(_is_number, words[1:8])) and (named or len(words) == 10)


def _is_points(words: list[str]) -> bool:
    return len(words) % 3 == 0 and all(map(_is_number, words))


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True

"""Collections: photos of one object from anywhere, in SAMURAI's layout or NeRS's, and what they
tell of the cameras.

    image/ or images/   photos              mask/ or masks/     of the same names
    quadrants.json      {"frames": [{"image_name": "0.jpg", "quadrant": ["Left|Center|Right",
                        "Above|Center|Below", "Front|Center|Back"]}]}
    metadata.json       NeRS: {"azimuths": [...], "elevations": [...]}, degrees, for the photos in
                        order of name
    held_out.json       {"frames": ["5.jpg", ...]}: photos for testing only (Relit's own)

Answers are matched by name; SAMURAI's own reader takes them in order, whatever they are called.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from relit import files
from relit.capture.frames import Frame, Reading, parse_json_file
from relit.capture.listing import image_folder, listed
from relit.capture.names import stem_key
from relit.capture.readers import mvmc
from relit.errors import UserError, did_you_mean

LOOKED_FOR = "quadrants.json (SAMURAI) or metadata.json with azimuths (NeRS)"
QUADRANTS, ANGLES, HELD_OUT = "quadrants.json", "metadata.json", "held_out.json"
ANSWERS = {  # axis by axis, in the object's frame: +x right, +y up, +z to the front
    "Left": (0, -1.0),
    "Right": (0, 1.0),
    "Above": (1, 1.0),
    "Below": (1, -1.0),
    "Front": (2, 1.0),
    "Back": (2, -1.0),
}


AXES = (
    ("Left", "Right"),
    ("Below", "Above"),
    ("Back", "Front"),
)  # the negative and the positive side of each
CENTRE = 22.5  # degrees from the plane between two sides: so near a camera counts as neither


@dataclass(frozen=True)
class Hints:
    """Where photos were taken from, roughly. directions: name -> (3,) unit vector from the object
    to the camera. degrees: how far off it may be. source: the file."""

    directions: dict[str, np.ndarray]
    degrees: float
    source: str


def recognise(path: Path) -> Path | None:
    """The folder, where one of the files that only a collection has lies in it."""
    if path.is_file():
        return path.parent if path.name == QUADRANTS else None
    if (path / QUADRANTS).is_file() or (path / HELD_OUT).is_file():
        return path
    return path if "azimuths" in (_of_any_kind(path / ANGLES) or ()) else None


def _of_any_kind(file: Path) -> dict | None:
    """A JSON object, or None: a metadata.json may be any program's."""
    data = files.read_json(file)
    return data if isinstance(data, dict) else None


def read(path: Path, found: Path) -> Reading:
    """The photos; those of held_out.json are set aside."""
    folder = image_folder(found)
    if folder is None:
        raise UserError(
            "a collection holds no photos",
            f"looked in image/ and images/ beside {QUADRANTS}",
            f"add them: {found}",
        )
    listing = listed(folder)
    photos = listing.photos
    held = (
        set(_names(parse_json_file(found / HELD_OUT), found / HELD_OUT))
        if (found / HELD_OUT).is_file()
        else set()
    )
    names = {stem_key(f.name) for f in photos}
    missing = {n for n in held if stem_key(n) not in names}
    held = {stem_key(n) for n in held}
    if missing:
        name = sorted(missing)[0]
        raise UserError(
            f"{HELD_OUT} names a photo that is not there: '{name}'",
            fix=f"mend the file: {found / HELD_OUT}",
        )
    frames = tuple(
        Frame(
            f,
            f.relative_to(found).as_posix(),
            mask=listing.masks.get(f),
            held_out=stem_key(f.name) in held,
        )
        for f in photos
    )
    return Reading("samurai", found, frames, notes=listing.notes, kind="collection")


def _names(content: dict, source: Path) -> list[str]:
    frames = content.get("frames")
    if not isinstance(frames, list) or not all(isinstance(n, str) for n in frames):
        raise UserError(
            f"{source.name} has no list of names under 'frames'", fix=f"write it again: {source}"
        )
    return frames


def read_hints(root: Path, names: list[str]) -> Hints | None:
    """What quadrants.json, metadata.json or MVMC's annotations.json under `root` says about the
    photos `names` (as the capture knows them); None where there is none. Raises UserError for
    answers that are malformed, belong to other photos, or are 'Center' three times."""
    root = root if root.is_dir() else root.parent
    if (root / QUADRANTS).is_file():
        return _quadrants(root / QUADRANTS, names)
    if (root / ANGLES).is_file():
        content = _of_any_kind(root / ANGLES) or {}
        if "azimuths" in content:
            return _angles(content, root / ANGLES, names)
    cars = mvmc.recognise(root)
    if cars is not None:
        said = mvmc.directions_of(cars)
        directions = {n: said[Path(n).name] for n in names if Path(n).name in said}
        return Hints(directions, 35.0, cars.name) if directions else None
    return None


def _quadrants(path: Path, names: list[str]) -> Hints:
    frames = parse_json_file(path).get("frames")
    if not isinstance(frames, list):
        raise UserError(
            "quadrants.json has no list under 'frames'",
            fix=f"make it again with `relit quadrants`: {path}",
        )
    said: dict[str, np.ndarray] = {}
    for frame in frames:
        name = frame.get("image_name", frame.get("file_path")) if isinstance(frame, dict) else None
        answers = frame.get("quadrant") if isinstance(frame, dict) else None
        if not isinstance(name, str) or not isinstance(answers, list):
            why = "each entry needs image_name and quadrant"
            raise UserError(
                "an entry of quadrants.json is malformed",
                why,
                f"make it again with `relit quadrants`: {path}",
            )
        said[Path(name).name] = direction_of(answers, name, path)  # pyright: ignore[reportArgumentType]
    known = {stem_key(n): n for n in names}
    directions = {}
    for name, direction in said.items():
        if direction is not None and stem_key(name) in known:
            directions[known[stem_key(name)]] = direction
    if len(directions) < 0.5 * len(names):
        strange = next((n for n in said if stem_key(n) not in known), "none")
        raise UserError(
            f"quadrants.json answers for {len(directions)} of {len(names)} photos",
            f"its names are matched with those of the photos; not among them is '{strange}'",
            f"is it the file of another collection? Make it again with `relit quadrants`: {path}",
        )
    return Hints(directions, 45.0, path.name)


def direction_of(answers: list, name: str = "", path: Path | str = "") -> np.ndarray | None:
    """(3,) unit direction of SAMURAI's three answers. Raises UserError for words that are none, and
    for 'Center' three times."""
    out = np.zeros(3)
    for answer in answers:
        if isinstance(answer, str) and answer in ANSWERS:
            axis, sign = ANSWERS[answer]
            out[axis] = sign
        elif answer != "Center":
            words = [*ANSWERS, "Center"]
            what = f"'{answer}' is no answer of a quadrant ('{name}').{did_you_mean(str(answer), words)}"
            raise UserError(what, fix=f"one of {', '.join(words)}: {path}")
    if not out.any():
        raise UserError(
            f"all three answers for '{name}' are Center"
            if name
            else "all three answers are Center",
            "a camera that is neither left nor right, above nor below, before nor behind would stand inside the object",
            f"say at least one side, or leave the photo out of the file: {path}"
            if name
            else "say at least one side",
        )
    return out / np.linalg.norm(out)


def quadrant_of(direction: np.ndarray) -> list[str]:
    """SAMURAI's three answers for a camera at `direction` (3,) from the object, in the object's
    frame: the inverse of `direction_of`."""
    unit = np.asarray(direction) / np.linalg.norm(direction)
    edge = np.sin(np.radians(CENTRE))
    return [
        "Center" if abs(v) < edge else sides[int(v > 0)]
        for v, sides in zip(unit, AXES, strict=True)
    ]


def _angles(content: dict, path: Path, names: list[str]) -> Hints:
    azimuths, elevations = content.get("azimuths"), content.get("elevations", [])
    azimuths, elevations = (list(v) if isinstance(v, list) else [] for v in (azimuths, elevations))
    numbers = all(isinstance(v, (int, float)) and abs(v) < 1e6 for v in (*azimuths, *elevations))
    if not numbers or not len(azimuths) == len(elevations) == len(names):
        raise UserError(
            f"metadata.json has {len(azimuths)} azimuths and {len(elevations)} elevations for {len(names)} photos"
            + ("" if numbers else ", and not all are numbers"),
            "there must be one of each for every photo, in order of name",
            f"mend the file: {path}",
        )
    directions = {}
    for name, azimuth, elevation in zip(
        sorted(names), np.radians(azimuths), np.radians(elevations), strict=True
    ):
        c = np.cos(elevation)
        directions[name] = np.array(
            [c * np.sin(azimuth), np.sin(elevation), c * np.cos(azimuth)]
        )  # 0 is the front, 90 the right side
    return Hints(directions, 35.0, path.name)

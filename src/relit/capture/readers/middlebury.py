"""Middlebury multi-view stereo: `*_par.txt`, one line of K, R, t per image; OpenCV axes, x_camera =
R x_world + t.

Its pixel centres lie at whole numbers ("image origin is top-left"), so half a pixel is added to the
principal point.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from relit.capture.frames import Frame, Reading, pose_from, read_text
from relit.capture.names import NameIndex, path_inside
from relit.errors import UserError
from relit.images import read_header
from relit.scene import Camera

LOOKED_FOR = "*_par.txt (Middlebury)"


def recognise(path: Path) -> Path | None:
    """The parameter file, or None."""
    if path.is_file():
        return path if path.name.endswith("_par.txt") else None
    return next(iter(sorted(path.glob("*_par.txt"))), None)


def read(path: Path, found: Path) -> Reading:
    """Read the parameter file; photos that it names and that are not there are left out with a
    note."""
    index, frames, missing = NameIndex(found.parent), [], []
    for name, values in parse(read_text(found), found):
        file = index.find(name)
        if file is None:
            path_inside(found.parent, name, found)
            missing.append(name)
            continue
        k, r, t = values[:9].reshape(3, 3), values[9:18].reshape(3, 3), values[18:]
        pose = np.linalg.inv(pose_from(np.column_stack([r, t]), f"'{name}'", found))
        header = read_header(file)
        camera = Camera(*header.as_stored, k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5, pose)
        frames.append(Frame(file, file.relative_to(found.parent).as_posix(), camera))
    if not frames or len(missing) > len(frames) + 1:
        raise UserError(
            f"{len(missing)} of {len(missing) + len(frames)} photos in {found.name} are not there, for example '{missing[0]}'",
            "the images and the cameras do not belong together",
            f"put the images beside: {found}",
        )
    notes = tuple(index.notes("photos")) + (
        (f"{len(missing)} photos named in {found.name} are not there and were left out",)
        if missing
        else ()
    )
    return Reading("middlebury", found.parent, tuple(frames), notes=notes)


def parse(text: str, source: Path) -> list[tuple[str, np.ndarray]]:
    """-> [(image name, 21 numbers: K row-major, R row-major, t)]. Raises UserError with the number
    of the line that is wrong."""
    rows = []
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if not words or (number == 1 and len(words) == 1):  # the first line counts the images
            continue
        try:
            values = np.array([float(w) for w in words[1:]])
        except ValueError:
            values = np.empty(0)
        if len(values) != 21 or not np.isfinite(values).all() or values[0] <= 0 or values[4] <= 0:
            raise UserError(
                f"line {number} of a Middlebury camera file cannot be read",
                "it must be an image name and 21 numbers (K, R and t)",
                f"correct: {source}",
            )
        rows.append((words[0], values))
    if not rows:
        raise UserError("a Middlebury camera file names no image", fix=f"write it again: {source}")
    return rows

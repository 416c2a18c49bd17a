"""LLFF (also NeRD, SAMURAI): `poses_bounds.npy`, N x 17: 3 x 5 [R | t | h w f] with camera axes
down, right, back, then near and far.

Rows belong to the photos in order of name. The photos may be resized copies of those that were
calibrated.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from relit.capture.frames import Frame, Reading, pose_from
from relit.capture.listing import image_folder, list_images, photo_folders
from relit.errors import UserError
from relit.files import NO_ARRAYS
from relit.scene import Camera

LOOKED_FOR = "poses_bounds.npy (LLFF)"


def recognise(path: Path) -> Path | None:
    """The pose file, or None."""
    if path.is_file():
        return path if path.name == "poses_bounds.npy" else None
    return path / "poses_bounds.npy" if (path / "poses_bounds.npy").is_file() else None


def read(path: Path, found: Path) -> Reading:
    """Read the pose file."""
    try:
        rows = np.load(found, allow_pickle=False)
    except NO_ARRAYS as error:
        raise UserError(
            "a pose file cannot be read", str(error), f"write it again: {found}"
        ) from error
    if rows.ndim == 2 and rows.shape[1] == 14 and rows.dtype.kind == "f":
        raise UserError(
            "the rows of a pose file have 14 columns, 17 are needed",
            "height, width and focal length of each photo are missing (Nex and Shiny write them to "
            "hwf_cxcy.npy)",
            f"write 3 x 5 [R | t | h w f], then near and far: {found}",
        )
    if (
        rows.ndim != 2
        or rows.shape[1] not in (15, 17)
        or rows.dtype.kind != "f"
        or not np.isfinite(rows).all()
    ):
        raise UserError(
            "a pose file is not an N x 17 array of finite numbers",
            f"it is {rows.dtype} {rows.shape}",
            f"write it again: {found}",
        )
    folder = image_folder(found.parent)
    files = list_images(folder) if folder else []
    if len(files) != len(rows):
        raise UserError(
            f"{len(rows)} cameras and {len(files)} photos do not match",
            "each row of poses_bounds.npy belongs to one photo, in order of name",
            f"add or remove photos until the numbers agree{_elsewhere(found.parent, folder)}: {found}",
        )
    frames = []
    for file, row in zip(files, rows.astype(np.float64), strict=True):
        m, (h, w, f) = row[:15].reshape(3, 5)[:, :4], row[:15].reshape(3, 5)[:, 4]
        if not (1 <= h < 1e6 and 1 <= w < 1e6 and 0 < f < 1e7):
            raise UserError(
                f"the size or focal length of '{file.name}' is out of range",
                f"h {h:g}, w {w:g}, f {f:g}",
                f"write it again: {found}",
            )
        opencv = np.column_stack(
            [m[:, 1], m[:, 0], -m[:, 2], m[:, 3]]
        )  # down, right, back -> right, down, forward
        pose = pose_from(opencv, f"'{file.name}'", found)
        frames.append(
            Frame(
                file,
                file.relative_to(found.parent).as_posix(),
                Camera(round(w), round(h), f, f, w / 2, h / 2, pose),
            )
        )
    return Reading("llff", found.parent, tuple(frames))


def _elsewhere(root: Path, taken: Path | None) -> str:
    """Other folders that hold photos, for the message."""
    others = [f"{d.name}/ holds {n}" for d, n in photo_folders(root, 1) if d != taken]
    return f" ({', '.join(others[:4])})" if others else ""

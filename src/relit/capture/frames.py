"""What a format's reader hands to `open_capture`: files and cameras, before anything is decoded."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from relit.errors import EXIT_USAGE, UserError
from relit.geometry.lens import Lens
from relit.geometry.se3 import nearest_rotation
from relit.masks.rle import Runs
from relit.scene import Camera, Sphere

MAX_TEXT = 256 * 2**20  # bytes of a camera file; larger ones are not camera files
LEAST_SIDE = 16  # pixels that --max-side may ask for


@dataclass(frozen=True)
class Frame:
    """One photo file and its camera as calibrated.

    name: relative to the capture's root, as the user knows it. camera: in pixels of the calibration
    (the file may be a resized copy), its `distortion` filled for OpenCV's model. lens: any other
    lens, or None. mask: a mask file that the format names, or None. runs: a mask that the format
    itself holds, or None. flash_energy: see `scene.Photo`.
    """

    path: Path
    name: str
    camera: Camera | None = None
    lens: Lens | None = None
    mask: Path | None = None
    held_out: bool = False
    runs: Runs | None = None
    flash_energy: float | None = None


@dataclass(frozen=True)
class Reading:
    """The frames of one capture, with what else the format tells. points: (N, 3) world. sphere:
    given by the format, or None. presumed: it is the format's convention and stands in no file, so
    masks know better. kind: of capture, where the format tells it (see `scene.Capture`)."""

    format: str
    root: Path
    frames: tuple[Frame, ...]
    points: np.ndarray | None = None
    sphere: Sphere | None = None
    presumed: bool = False
    notes: tuple[str, ...] = ()
    kind: str = ""


def check_max_side(max_side: int | None) -> None:
    """Raises UserError (code 2) for a size at which nothing is left of a photo."""
    if max_side is not None and max_side < LEAST_SIDE:
        what = f"the photos cannot be shrunk to {max_side} pixels"
        raise UserError(
            what,
            f"--max-side is at least {LEAST_SIDE}",
            "use --max-side 800, or leave it out",
            code=EXIT_USAGE,
        )


def read_text(path: Path) -> str:
    """The text of a camera file. Raises UserError when it is no text or too large."""
    if path.stat().st_size > MAX_TEXT:
        raise UserError(
            f"a camera file is {path.stat().st_size / 2**20:.0f} MiB large",
            "camera files are small",
            f"is it the right file? {path}",
        )
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise UserError(
            "a camera file is not text", str(error), f"write it again: {path}"
        ) from error


def parse_json_file(path: Path) -> dict:
    """A JSON object. Raises UserError with line and column when it is malformed."""
    try:
        data = json.loads(read_text(path))
    except (json.JSONDecodeError, RecursionError) as error:
        raise UserError(
            "a camera file is not valid JSON",
            str(error),
            f"write it again, or repair it at that place: {path}",
        ) from error
    if not isinstance(data, dict):
        raise UserError(
            "a camera file is not a JSON object",
            f"it holds a {type(data).__name__}",
            f"write it again: {path}",
        )
    return data


def pose_from(matrix, what: str, source: Path) -> np.ndarray:
    """Any nested sequence -> (4, 4) float64 rigid pose; without any uniform scale. Raises UserError
    for all else."""
    try:
        m = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        m = np.empty(0)
    if m.shape not in ((4, 4), (3, 4)) or not np.isfinite(m).all():
        raise UserError(
            f"{what} has no valid 4 x 4 pose",
            "it must be 16 finite numbers",
            f"write it again: {source}",
        )
    out = np.eye(4)
    out[:3] = m[:3]
    scale = np.cbrt(np.abs(np.linalg.det(out[:3, :3])))
    if (
        not 1e-9 < scale < 1e9
        or not np.abs(out[:3, :3] / scale @ (out[:3, :3] / scale).T - np.eye(3)).max() < 1e-2
    ):
        raise UserError(
            f"the pose of {what} is not a rotation and a translation",
            "its axes are not at right angles",
            f"write it again: {source}",
        )
    if np.linalg.det(out[:3, :3]) < 0:
        raise UserError(
            f"the pose of {what} is mirrored",
            "the determinant of its rotation is negative",
            f"check the axes of: {source}",
        )
    # poses written with few digits are made exactly orthonormal; good ones are left as they are,
    # bit for bit
    if np.abs(out[:3, :3] @ out[:3, :3].T - np.eye(3)).max() > 1e-6:
        out[:3, :3] = nearest_rotation(out[:3, :3])
    return out

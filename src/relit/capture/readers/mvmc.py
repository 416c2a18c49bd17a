"""MVMC, the cars that NeRS was shown with: `annotations.json` beside images/, masks as run lengths,
rough cameras.

    {"id": ..., "annotations": [{"filename", "bbox", "mask": {"counts": "37576 59 391 ...", "size":
    [h, w]},
                                 "camera_initial": {"R": 3 x 3, "T": 3, "fov": degrees},
                                 "camera_optimized": {...}}, ...]}

Cameras are PyTorch3D's: row vectors, x to the left, y up, x_camera = x_world R + T. Only the
direction of `camera_initial` is taken, as a hint (a network's guess from one photo);
`camera_optimized` is what another method made of it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from relit import files
from relit.capture.frames import Frame, Reading, parse_json_file
from relit.capture.listing import image_folder
from relit.capture.names import NameIndex, path_inside
from relit.errors import UserError
from relit.masks.rle import runs_from

LOOKED_FOR = "annotations.json with masks and cameras (MVMC)"
ANNOTATIONS = "annotations.json"


def recognise(path: Path) -> Path | None:
    """The file, where it is of this kind (COCO's own annotations.json is not)."""
    found = path if path.is_file() and path.name == ANNOTATIONS else path / ANNOTATIONS
    if not found.is_file():
        return None
    data = files.read_json(found)  # any program's file may be called so
    entries = data.get("annotations") if isinstance(data, dict) else None
    return (
        found
        if isinstance(entries, list)
        and entries
        and isinstance(entries[0], dict)
        and "filename" in entries[0]
        else None
    )


def read(path: Path, found: Path) -> Reading:
    """The photos in order of name, with their masks."""
    root = found.parent
    folder = image_folder(root) or root
    index, frames = NameIndex(root), []
    for entry in entries_of(found):
        file = index.find(entry["filename"], (folder,))
        if file is None:
            path_inside(folder, entry["filename"], found)
            raise UserError(
                f"a photo of {ANNOTATIONS} is missing: '{entry['filename']}'",
                fix=f"add it to {folder}, or take its entry out",
            )
        runs = (
            runs_from(entry["mask"], entry["filename"]) if entry.get("mask") is not None else None
        )
        frames.append(Frame(file, file.relative_to(root).as_posix(), runs=runs))
    ordered = tuple(sorted(frames, key=lambda f: f.name))
    return Reading("mvmc", root, ordered, notes=tuple(index.notes("photos")), kind="collection")


def entries_of(found: Path) -> list[dict]:
    """The annotations. Raises UserError where one names no photo."""
    entries = parse_json_file(found).get("annotations")
    if not isinstance(entries, list) or not all(
        isinstance(e, dict) and isinstance(e.get("filename"), str) for e in entries
    ):
        raise UserError(
            f"an entry of {ANNOTATIONS} names no photo",
            "each needs filename, and mask or cameras",
            f"write it again: {found}",
        )
    return entries


def directions_of(found: Path) -> dict[str, np.ndarray]:
    """File name -> (3,) unit direction from the object to the camera by `camera_initial`, of the
    photos that have one."""
    out = {}
    for entry in entries_of(found):
        camera = entry.get("camera_initial")
        if camera is None:
            continue
        try:
            r, t = np.array(camera["R"], float), np.array(camera["T"], float)
            eye = -(r @ t)
            ok = (
                r.shape == (3, 3)
                and t.shape == (3,)
                and np.isfinite(eye).all()
                and np.abs(r @ r.T - np.eye(3)).max() < 0.05
            )
            ok = ok and np.linalg.norm(eye) > 1e-6
        except (KeyError, TypeError, ValueError, OverflowError):
            ok = False
        if not ok:
            what = f"camera_initial of '{entry['filename']}' is no camera"
            raise UserError(
                what,
                "R must be a rotation of 3 x 3 numbers and T three numbers",
                f"write it again: {found}",
            )
        out[entry["filename"]] = eye / np.linalg.norm(eye)
    return out

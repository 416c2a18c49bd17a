"""The truth of a synthetic capture: what `relit synthesize` writes (synthesize/multiview.py)."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from relit.conventions import world_from_cv_camera
from relit.errors import UserError
from relit.scene import Camera


@dataclass(frozen=True)
class Truth:
    """A synthetic capture's truth. train, test: cameras by name without folder and extension, in
    the true world frame.
    radius: of the object's bounding sphere, world units. meta: the content of truth.json."""

    folder: Path
    train: dict[str, Camera]
    test: dict[str, Camera]
    radius: float
    meta: dict[str, Any]

    def picture(self, relative: str) -> np.ndarray:
        """(H, W, C) or (H, W) float32 linear content of `truth/<relative>.exr`."""
        from relit.images import read_data

        return read_data(self.folder / "truth" / f"{relative}.exr")


def truth_kind(folder: str | Path) -> str:
    """The kind of capture that `relit synthesize` made of the folder, as its truth/settings.json
    says ('duplicates', 'collection'); '' where that names none."""
    try:
        said = json.loads((Path(folder) / "truth" / "settings.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return ""
    kind = said.get("kind") if isinstance(said, dict) else None
    return kind if isinstance(kind, str) else ""


def has_truth(folder: str | Path) -> bool:
    """Whether `relit synthesize` made the folder, finished or not."""
    folder = Path(folder)
    return (
        folder.name == "truth"
        or (folder / "truth" / "settings.json").is_file()
        or (folder / "truth" / "truth.json").is_file()
    )


def load_truth(folder: str | Path) -> Truth:
    """Read the cameras and the description of a synthetic capture. Raises UserError where there is
    none, or an unfinished one."""
    from relit.asset.asset import read_bounded_json

    folder = Path(folder)
    folder = folder.parent if folder.name == "truth" else folder
    file = folder / "truth" / "truth.json"
    if not file.is_file():
        why = (
            "it is unfinished: its rendering was stopped"
            if (folder / "truth" / "settings.json").exists()
            else "there is no truth/truth.json"
        )
        raise UserError(
            "the folder holds no complete truth",
            why,
            f"make one with `relit synthesize`, or give its folder: {folder}",
        )
    meta = read_bounded_json(file)
    size = meta["settings"]["resolution"]
    train, test = (
        _read_cameras(folder / f"transforms_{split}.json", size) for split in ("train", "test")
    )
    return Truth(folder, train, test, float(meta["sphere"]["radius"]), meta)


def _read_cameras(file: Path, size: int) -> dict[str, Camera]:
    from relit.asset.asset import read_bounded_json

    content = read_bounded_json(file)
    focal = size / (2 * np.tan(content["camera_angle_x"] / 2))
    return {
        camera_key(f["file_path"]): Camera(
            size,
            size,
            focal,
            focal,
            size / 2,
            size / 2,
            world_from_cv_camera(np.array(f["transform_matrix"], np.float64)),
        )
        for f in content["frames"]
    }


def camera_key(name: str) -> str:
    """What cameras are matched by: the file's name without folder and extension."""
    return Path(name).stem

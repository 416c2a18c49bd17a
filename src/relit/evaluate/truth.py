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


def ceiling_of(folder: str | Path) -> dict[str, dict[str, float]]:
    """light -> figures of the TRUE asset in Relit's own renderer against the truth's pictures
    (`synthesize.ceiling`): no fit reaches more. {} where truth.json has none."""
    try:
        said = json.loads((Path(folder) / "truth" / "truth.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    ceiling = said.get("ceiling") if isinstance(said, dict) else None
    if not isinstance(ceiling, dict):
        return {}
    numbers = {
        light: {k: float(v) for k, v in figures.items() if isinstance(v, (int, float))}
        for light, figures in ceiling.items()
        if isinstance(figures, dict)
    }
    return {light: figures for light, figures in numbers.items() if figures}


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
    train, test = (_read_cameras(_cameras_file(folder, split), size) for split in ("train", "test"))
    return Truth(folder, train, test, float(meta["sphere"]["radius"]), meta)


def _cameras_file(folder: Path, split: str) -> Path:
    """The true cameras: those of truth/ where a capture hands over others, or none."""
    hidden = folder / "truth" / f"transforms_{split}.json"
    return hidden if hidden.is_file() else folder / f"transforms_{split}.json"


def _read_cameras(file: Path, size: int) -> dict[str, Camera]:
    from relit.asset.asset import read_bounded_json

    content = read_bounded_json(file)
    return {camera_key(f["file_path"]): _camera({**content, **f}, size) for f in content["frames"]}


def _camera(entry: dict[str, Any], size: int) -> Camera:
    """The pinhole of a frame: with its own intrinsics, else a square of `size` pixels."""
    pose = world_from_cv_camera(np.array(entry["transform_matrix"], np.float64))
    if "fl_x" in entry:
        inner = (float(entry[key]) for key in ("fl_x", "fl_y", "cx", "cy"))
        return Camera(int(entry["w"]), int(entry["h"]), *inner, pose)
    focal = size / (2 * np.tan(entry["camera_angle_x"] / 2))
    return Camera(size, size, focal, focal, size / 2, size / 2, pose)


def camera_key(name: str) -> str:
    """What cameras are matched by: the file's name without folder and extension."""
    return Path(name).stem

"""Small copies of a run's photos, so that the page can lay photo and render over one another
wherever the run folder is moved."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np

from relit.files import disk_errors, write_text
from relit.images import encode_jpeg, write_bytes
from relit.scene import Capture
from relit.viewer.manifest import PHOTOS

SIDE = 1024  # pixels, longest side
MOST = 300  # photos; of a larger capture every n-th


def write_photos(run: str | Path, capture: Capture) -> Path:
    """Write RUN/photos/: JPEGs of the photos as the fit sees them (undistorted, upright), and
    index.json with their names."""
    folder = Path(run) / PHOTOS
    chosen = capture.photos[:: max(1, -(-len(capture.photos) // MOST))]
    with disk_errors(Path(run)):
        if folder.exists():
            shutil.rmtree(folder)
        folder.mkdir(parents=True)
        index = {}
        for i, photo in enumerate(chosen):
            index[photo.name] = f"{i:04d}.jpg"
            write_bytes(folder / index[photo.name], encode_jpeg(shrunk(photo.load().rgb)))
        write_text(folder / "index.json", json.dumps({"photos": index}, indent=1) + "\n")
    return folder


def shrunk(rgb: np.ndarray, side: int = SIDE) -> np.ndarray:
    """A linear image with a longest side of at most `side` pixels."""
    h, w = rgb.shape[:2]
    s = min(1.0, side / max(h, w))
    size = (max(1, round(w * s)), max(1, round(h * s)))
    return (
        rgb
        if s == 1
        else cv2.resize(np.ascontiguousarray(rgb, np.float32), size, interpolation=cv2.INTER_AREA)
    )

"""OpenCV's decoders. Of a file that they cannot read they return nothing, or raise, as for a
million pixels a side: None here."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np


def decode_bytes(data: bytes, flags: int) -> np.ndarray | None:
    """The picture in `data`, channels in OpenCV's order; None where it cannot be decoded."""
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    except cv2.error:
        return None


def decode_file(path: str | Path, flags: int) -> np.ndarray | None:
    """The picture in a file, channels in OpenCV's order; None where it cannot be decoded."""
    try:
        return cv2.imread(str(path), flags)
    except cv2.error:
        return None

"""Walks COLMAP's binary files before they are handed to its reader, which believes any count in
them and reads on past their end."""

from __future__ import annotations

import struct
from pathlib import Path

# parameters of each camera model, by COLMAP's numbers
PARAMETERS = {0: 3, 1: 4, 2: 4, 3: 5, 4: 8, 5: 8, 6: 12, 7: 5, 8: 4, 9: 5, 10: 12}


def check_binary(folder: Path) -> None:
    """Raises ValueError where the records of a binary model do not end where its files end."""
    for name, walk in WALKS.items():
        path = folder / f"{name}.bin"
        if path.is_file():
            data = path.read_bytes()
            try:
                end = walk(data)
            except (struct.error, IndexError):
                end = -1
            if end not in (len(data), None):
                raise ValueError(
                    f"{path.name} is damaged: its records do not end where the file ends"
                )


def _cameras(data: bytes) -> int | None:
    """Where the records end; None for camera models that are not known here."""
    count, at = struct.unpack_from("<Q", data)[0], 8
    for _ in range(count):
        _, model, _, _ = struct.unpack_from("<IiQQ", data, at)
        if model not in PARAMETERS:
            return None if 0 <= model < 32 and count < len(data) // 24 + 1 else -1
        at += 24 + 8 * PARAMETERS[model]
        if at > len(data):
            return -1
    return at


def _images(data: bytes) -> int:
    count, at = struct.unpack_from("<Q", data)[0], 8
    for _ in range(count):
        end = data.find(b"\0", at + 64)
        if end < 0:
            return -1
        at = end + 1
        at += 8 + 24 * struct.unpack_from("<Q", data, at)[0]
        if at > len(data):
            return -1
    return at


def without_observations(data: bytes) -> bytes:
    """images.bin whose images see no point, for a model without points."""
    count, at = struct.unpack_from("<Q", data)[0], 8
    out = [data[:8]]
    for _ in range(count):
        end = data.index(b"\0", at + 64) + 1
        out += [data[at:end], bytes(8)]
        at = end + 8 + 24 * struct.unpack_from("<Q", data, end)[0]
    return b"".join(out)


def _points(data: bytes) -> int:
    count, at = struct.unpack_from("<Q", data)[0], 8
    for _ in range(count):
        at += 51
        at = at + 8 * struct.unpack_from("<Q", data, at - 8)[0]
        if at > len(data):
            return -1
    return at


def _rigs(data: bytes) -> int:
    count, at = struct.unpack_from("<Q", data)[0], 8
    for _ in range(count):
        sensors = struct.unpack_from("<I", data, at + 4)[0]
        at += 8 + (8 if sensors else 0)
        for _ in range(sensors - 1):
            at += 9 + 56 * data[at + 8]
            if at > len(data):
                return -1
        if at > len(data):
            return -1
    return at


def _frames(data: bytes) -> int:
    count, at = struct.unpack_from("<Q", data)[0], 8
    for _ in range(count):
        at += 68 + 16 * struct.unpack_from("<I", data, at + 64)[0]
        if at > len(data):
            return -1
    return at


WALKS = {
    "cameras": _cameras,
    "images": _images,
    "points3D": _points,
    "rigs": _rigs,
    "frames": _frames,
}

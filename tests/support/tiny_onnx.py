"""ONNX files written byte by byte: the parts, and a file of one 1x1 convolution."""

from __future__ import annotations

from pathlib import Path

import numpy as np


def field(number: int, value) -> bytes:
    """One field of a protocol buffer: int, bytes or str."""

    def varint(v: int) -> bytes:
        out = bytearray()
        while v > 0x7F:
            out.append(v & 0x7F | 0x80)
            v >>= 7
        return bytes([*out, v])

    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    data = value.encode() if isinstance(value, str) else value
    return varint(number << 3 | 2) + varint(len(data)) + data


def tensor(name: str, array: np.ndarray, kind: int = 1) -> bytes:
    """array: of ONNX's `kind`, 1 for float32, 7 for int64."""
    return (
        b"".join(field(1, int(n)) for n in array.shape)
        + field(2, kind)
        + field(8, name)
        + field(9, array.tobytes())
    )


def picture(name: str, channels: int) -> bytes:
    sides = [field(1, 1), field(1, channels), field(2, "h"), field(2, "w")]
    return field(1, name) + field(
        2, field(1, field(1, 1) + field(2, b"".join(field(1, s) for s in sides)))
    )


def write_pointwise(path: Path, weight: np.ndarray, bias: np.ndarray) -> Path:
    """out[k] = sum_c weight[k, c] in[c] + bias[k] at every pixel. weight: (K, 3)."""
    kernel = field(5, field(1, "kernel_shape") + field(8, 1) + field(8, 1) + field(20, 7))
    graph = field(
        1, field(1, "x") + field(1, "w") + field(1, "b") + field(2, "y") + field(4, "Conv") + kernel
    ) + field(2, "pointwise")
    graph += field(5, tensor("w", np.asarray(weight, "<f4")[..., None, None])) + field(
        5, tensor("b", np.asarray(bias, "<f4"))
    )
    graph += field(11, picture("x", 3)) + field(12, picture("y", len(weight)))
    path.write_bytes(field(1, 8) + field(7, graph) + field(8, field(1, "") + field(2, 13)))
    return path

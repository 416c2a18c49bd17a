"""An ONNX file with the signature of DINO, written byte by byte."""

import numpy as np

from support.tiny_onnx import field, tensor

PATCH, CHANNELS = 8, 5


def integers(name: str, values) -> bytes:
    return field(5, field(1, name) + b"".join(field(8, v) for v in values) + field(20, 7))


def node(kind: str, inputs, output: str, *attributes: bytes) -> bytes:
    return field(
        1,
        b"".join(field(1, i) for i in inputs)
        + field(2, output)
        + field(4, kind)
        + b"".join(attributes),
    )


def value(name: str, *sides) -> bytes:
    shape = b"".join(field(1, field(2, s) if isinstance(s, str) else field(1, s)) for s in sides)
    return field(1, name) + field(2, field(1, field(1, 1) + field(2, shape)))


def write_network(path, weight: np.ndarray) -> None:
    """Patches of the picture times `weight` (CHANNELS, 3, PATCH, PATCH), as tokens (1, P,
    CHANNELS)."""
    graph = node(
        "Conv",
        ["x", "w"],
        "c",
        integers("kernel_shape", [PATCH, PATCH]),
        integers("strides", [PATCH, PATCH]),
    )
    graph += (
        node("Reshape", ["c", "shape"], "r")
        + node("Transpose", ["r"], "y", integers("perm", [0, 2, 1]))
        + field(2, "patches")
    )
    graph += field(5, tensor("w", weight.astype("<f4"))) + field(
        5, tensor("shape", np.array([1, CHANNELS, -1], "<i8"), 7)
    )
    graph += field(11, value("x", 1, 3, "h", "w")) + field(12, value("y", 1, "p", CHANNELS))
    path.write_bytes(field(1, 8) + field(7, graph) + field(8, field(1, "") + field(2, 13)))

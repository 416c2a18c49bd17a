"""LPIPS (Zhang et al. 2018) by a network that a user brings as an ONNX file; Relit ships none.

The file has two inputs, pictures (1, 3, H, W) in [-1, 1], and one output with one number: what
`torch.onnx.export` writes of `lpips.LPIPS(net="vgg")` or `net="alex"`. The papers differ in the
network (SfD and Stanford-ORB VGG, PIR AlexNet), so a figure is worth its network's name.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from relit.errors import EXIT_ENVIRONMENT, UserError

Lpips = Callable[[np.ndarray, np.ndarray], float]  # of two encoded pictures (H, W, 3) in [0, 1]


def load_lpips(file: str | Path) -> Lpips:
    """The distance function of an ONNX file. Raises UserError where onnxruntime or the file is
    missing, or the file is no such network."""
    file = Path(file)
    if not file.is_file():
        raise UserError(f"no network at: {file}", fix="give the path of an ONNX file of LPIPS")
    try:
        import onnxruntime  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise UserError(
            "LPIPS needs onnxruntime, which is not installed",
            fix="pip install 'relit[lpips]'",
            code=EXIT_ENVIRONMENT,
        ) from None
    try:
        session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime has a class for each fault, without a common one
        raise UserError(
            "the LPIPS network cannot be read",
            str(error).strip().splitlines()[0][:200],
            f"give an ONNX file: {file}",
        ) from None
    names = [i.name for i in session.get_inputs()]
    if len(names) != 2:
        raise UserError(
            f"the LPIPS network has {len(names)} inputs",
            "two pictures are wanted, each (1, 3, H, W) in [-1, 1]",
            f"export it with two inputs: {file}",
        )
    return lambda a, b: _distance(session, names, a, b)


def _distance(session, names: list[str], a: np.ndarray, b: np.ndarray) -> float:
    def as_input(picture):
        scaled = np.asarray(picture, np.float32) * 2 - 1
        return np.ascontiguousarray(scaled.transpose(2, 0, 1)[None])

    try:
        out = session.run(None, {names[0]: as_input(a), names[1]: as_input(b)})
    except Exception as error:
        h, w = a.shape[:2]
        raise UserError(
            f"the LPIPS network does not take pictures of {w} x {h}",
            str(error).strip().splitlines()[0][:200],
            "export it with free sides",
        ) from None
    value = np.asarray(out[0])
    if value.size != 1:
        raise UserError(
            f"the LPIPS network's output has shape {value.shape}", "one number is wanted"
        )
    return float(value.reshape(()))

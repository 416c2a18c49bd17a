"""Masks by a learned segmenter that runs in ONNX Runtime (rembg), an optional extra."""

from __future__ import annotations

import numpy as np

from relit.conventions import srgb_from_linear
from relit.errors import EXIT_ENVIRONMENT, UserError


def segmenter(model: str = "u2net"):
    """A function linear (H, W, 3) -> mask (H, W) float32 in [0, 1]. Raises UserError when the extra
    or its weights are not there."""
    try:
        import rembg  # pyright: ignore[reportMissingImports]
    except (
        ImportError,
        SystemExit,
    ) as error:  # rembg leaves the interpreter when ONNX Runtime is missing
        raise UserError(
            "masks by segmentation need an optional package",
            "rembg or onnxruntime is not installed",
            "pip install 'relit[segment]', or give mask files, or use --masks grabcut",
            code=EXIT_ENVIRONMENT,
        ) from error
    try:
        session = rembg.new_session(model)
    except Exception as error:  # rembg raises whatever its downloader raises
        raise UserError(
            f"the segmenter '{model}' could not be started",
            str(error)[:200],
            "its weights are fetched once: connect to the network, or put the .onnx file into ~/.u2net",
            code=EXIT_ENVIRONMENT,
        ) from error

    def mask_of(rgb: np.ndarray) -> np.ndarray:
        codes = (np.clip(srgb_from_linear(rgb), 0, 1) * 255 + 0.5).astype(np.uint8)
        return (
            np.asarray(rembg.remove(codes, session=session, only_mask=True), dtype=np.float32)
            / 255.0
        )

    return mask_of

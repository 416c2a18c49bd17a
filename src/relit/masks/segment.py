"""Masks by a network for salient objects (IS-Net, U2-Net) in ONNX Runtime, an optional extra.

The network is told by the side of its input: 1024 pixels IS-Net, (code - 128) / 256; 320 pixels
U2-Net, codes over 255 normalised as ImageNet's. The first output is the mask, in [0, 1].
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from relit.conventions import srgb_from_linear
from relit.errors import EXIT_ENVIRONMENT, UserError
from relit.files import cache_folder
from relit.masks.weights import COMMAND, find_segmenter, sum_of

VERSION = 1  # of what is made of a network's output; part of the names of kept masks


@dataclass(frozen=True)
class NetworkKind:
    """A kind of network. mean, spread: of sRGB codes in [0, 255]; the input is (codes - mean) /
    spread."""

    name: str
    mean: tuple[float, float, float]
    spread: tuple[float, float, float]


KINDS = {  # side of the input in pixels -> kind
    1024: NetworkKind("IS-Net", (128.0, 128.0, 128.0), (256.0, 256.0, 256.0)),
    320: NetworkKind(
        "U2-Net",
        (0.485 * 255, 0.456 * 255, 0.406 * 255),
        (0.229 * 255, 0.224 * 255, 0.225 * 255),
    ),
}


@dataclass(frozen=True)
class Segmenter:
    """A network in memory. file: of it, sum: its SHA-256. session: of ONNX Runtime. side: of its
    input, pixels."""

    file: Path
    session: Any
    side: int
    sum: str

    @property
    def name(self) -> str:
        return f"{KINDS[self.side].name} ({self.file.name})"

    def __call__(self, rgb: np.ndarray) -> np.ndarray:
        """(H, W, 3) linear -> mask (H, W) float32 in [0, 1]."""
        h, w = rgb.shape[:2]
        codes = np.clip(srgb_from_linear(rgb), 0, 1).astype(np.float32) * 255
        size = (self.side, self.side)
        kind = KINDS[self.side]
        shown = cv2.resize(codes, size, interpolation=cv2.INTER_AREA)
        blob = (shown - np.float32(kind.mean)) / np.float32(kind.spread)  # pyright: ignore
        given = {self.session.get_inputs()[0].name: blob.transpose(2, 0, 1)[None]}
        out = np.asarray(self.session.run(None, given)[0], np.float32)
        return np.clip(cv2.resize(out.reshape(self.side, self.side), (w, h)), 0, 1)

    def kept(
        self, photo: Path, shape: tuple[int, int], make: Callable[[], np.ndarray]
    ) -> np.ndarray:
        """The mask (H, W) = shape of a photo from an earlier call, else that of `make()` (H, W, 3) linear,
        which is kept in the cache by the contents of the photo and of the network."""
        told = hashlib.sha256(photo.read_bytes())
        told.update(f"{VERSION} {self.sum} {shape}".encode())
        file = cache_folder(None) / "masks" / f"{told.hexdigest()[:32]}.png"
        if file.is_file():
            codes = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
            if codes is not None and codes.shape == shape:
                return codes.astype(np.float32) / 255
        mask = self(make())
        file.parent.mkdir(parents=True, exist_ok=True)
        part = file.with_name(f".{os.getpid()}-{file.name}")
        cv2.imwrite(str(part), np.round(mask * 255).astype(np.uint8))
        part.replace(file)
        return mask


def runtime() -> Any:
    """The module onnxruntime, None where it is not installed."""
    try:
        import onnxruntime  # pyright: ignore[reportMissingImports]
    except ImportError:
        return None
    return onnxruntime


def at_hand() -> bool:
    """Whether photos can be segmented without fetching anything. Raises UserError where
    RELIT_SEGMENTER names no file."""
    return runtime() is not None and find_segmenter() is not None


def segmenter(name: str = "") -> Segmenter:
    """The segmenter `name` (see `find_segmenter`). Raises UserError where the extra or the weights are
    missing, or the file is no such network."""
    file, module = find_segmenter(name), runtime()
    if module is None:
        raise UserError(
            "masks by segmentation need an optional package",
            "onnxruntime is not installed",
            "pip install 'relit[segment]', or give mask files, or use --masks grabcut",
            code=EXIT_ENVIRONMENT,
        )
    if file is None:
        raise UserError(
            "no weights of a segmenter are at hand",
            "nothing is downloaded unless asked for",
            f"call {COMMAND} once, or give --masks segment:FILE.onnx",
            code=EXIT_ENVIRONMENT,
        )
    try:
        session = module.InferenceSession(str(file), providers=["CPUExecutionProvider"])
        side = session.get_inputs()[0].shape[-1]
    except Exception as error:  # ONNX Runtime raises classes of its own for damaged files
        first = str(error).strip().splitlines()[0][:200]
        raise UserError("the network cannot be read", first, f"give an ONNX file: {file}") from None
    if side not in KINDS:
        raise UserError(
            f"the network takes pictures of {side if isinstance(side, int) else 'any number of'} pixels a side",
            f"known are {', '.join(f'{k.name} ({n})' for n, k in KINDS.items())}",
            f"give one of these: {file}",
        )
    return Segmenter(file, session, side, sum_of(file))

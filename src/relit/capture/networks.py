"""Networks that a user brings as ONNX files: which pixel belongs to which object, and normal
priors. They run in OpenCV.

A picture goes in as (1, 3, H, W), normalised as ImageNet's, its longer side SIDE and both sides
multiples of 32.

instances   out: numbers of the objects, 0 elsewhere, as (1, H, W) or (1, 1, H, W) (a panoptic
            segmenter), or (1, N, h, w), a mask for each
            of N objects, as probabilities or as logits
normals     out: (1, 3, h, w), x right, y up, z towards the camera, in [-1, 1] or coded in [0, 1];
            called with each object alone on black
            (as in SfD)
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from relit.conventions import srgb_from_linear
from relit.errors import UserError

MEAN, SPREAD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # ImageNet's
SIDE, CROP_SIDE, MULTIPLE = 800, 384, 32
MARGIN = 0.1  # of an object's window around it
LEAST_AREA = 1e-4  # of the photo; smaller masks are no objects


class Network:
    """A network in memory, the one way in which Relit runs an ONNX file."""

    def __init__(self, file: str | Path):
        """Raises UserError for files that OpenCV cannot read."""
        self.path = Path(file)
        if not self.path.is_file():
            raise UserError(f"no network at: {self.path}", fix="give the path of an ONNX file")
        try:
            self.net = cv2.dnn.readNetFromONNX(str(self.path))
        except cv2.error as error:
            raise UserError(
                "the network cannot be read", first_line(error), f"give an ONNX file: {self.path}"
            ) from None

    def __call__(self, rgb: np.ndarray, side: int) -> np.ndarray:
        """(H, W, 3) linear in [0, 1], its longer side brought to about `side` -> what the network
        says."""
        s = side / max(rgb.shape[:2])
        h, w = (max(MULTIPLE, round(n * s / MULTIPLE) * MULTIPLE) for n in rgb.shape[:2])
        return self.run(
            cv2.resize(
                np.clip(srgb_from_linear(rgb), 0, 1).astype(np.float32),
                (w, h),
                interpolation=cv2.INTER_AREA,
            )
        )

    def run(self, shown: np.ndarray) -> np.ndarray:
        """(H, W, 3) float32 sRGB values in [0, 1], at the size that the network gets -> what it
        says. Raises UserError where it takes none of that size."""
        h, w = shown.shape[:2]
        blob = ((shown - np.float32(MEAN)) / np.float32(SPREAD)).transpose(2, 0, 1)[None]  # pyright: ignore[reportArgumentType]
        try:
            self.net.setInput(np.ascontiguousarray(blob, np.float32))
            return np.asarray(self.net.forward())
        except cv2.error as error:
            raise UserError(
                f"the network does not take a picture of {w} x {h}",
                first_line(error),
                f"export it with free sides: {self.path}",
            ) from None

    def strange(self, out: np.ndarray, wanted: str) -> UserError:
        """What to raise for an output that is not what is `wanted`."""
        return UserError(
            f"the network's output is {' x '.join(map(str, out.shape))}",
            f"{wanted} is looked for",
            f"see: {self.path}",
        )


def first_line(error: Exception) -> str:
    """The first line of what a library says, as far as it is read."""
    return str(error).strip().splitlines()[0][:200]


def found_instances(network: Network, rgb: np.ndarray) -> np.ndarray:
    """(H, W) int32 numbers of the objects that the network finds, 0 elsewhere. Where masks overlap,
    the smaller object is in front."""
    h, w = rgb.shape[:2]
    out = network(rgb, SIDE)
    if out.ndim == 4 and out.shape[:2] == (1, 1):
        out = out[0]
    if out.ndim == 3 and out.shape[0] == 1:
        labels = cv2.resize(
            np.round(out[0]).astype(np.float32), (w, h), interpolation=cv2.INTER_NEAREST
        ).astype(np.int32)
    elif out.ndim == 4 and out.shape[0] == 1:
        level = 0.5 if out.min() >= 0 and out.max() <= 1 else 0.0
        masks = [
            cv2.resize(m.astype(np.float32), (w, h), interpolation=cv2.INTER_LINEAR) > level
            for m in out[0]
        ]
        labels = np.zeros((h, w), np.int32)
        for k in sorted(range(len(masks)), key=lambda k: -masks[k].sum()):
            labels[masks[k]] = k + 1
    else:
        raise network.strange(out, "numbers (1, H, W) or masks (1, N, h, w)")
    for value in np.unique(labels):
        if value < 0 or (labels == value).mean() < LEAST_AREA:
            labels[labels == value] = 0
    if not labels.any():
        raise UserError(
            "the segmenter finds no object in the photo", fix="give labels, or another network"
        )
    return labels


def predicted_normals(network: Network, rgb: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """(H, W, 3) float32 unit normals of the labelled objects in OpenCV camera axes, 0 elsewhere."""
    out = np.zeros((*labels.shape, 3), np.float32)
    for value in np.unique(labels[labels > 0]):
        own = labels == value
        y, x = np.nonzero(own)
        grow = round(MARGIN * max(np.ptp(x), np.ptp(y)))
        window = (
            slice(max(y.min() - grow, 0), y.max() + grow + 1),
            slice(max(x.min() - grow, 0), x.max() + grow + 1),
        )
        mask = own[window][..., None]
        n = network(np.clip(rgb[window], 0, 1) * mask, CROP_SIDE)
        if n.ndim != 4 or n.shape[:2] != (1, 3):
            raise network.strange(n, "normals (1, 3, h, w)")
        n = n[0].transpose(1, 2, 0).astype(np.float32)
        n = n * 2 - 1 if n.min() >= 0 else n
        n = cv2.resize(
            np.ascontiguousarray(n), mask.shape[1::-1], interpolation=cv2.INTER_LINEAR
        ) * np.float32([1, -1, -1])  # pyright: ignore[reportArgumentType]
        out[window] += n / np.maximum(np.linalg.norm(n, axis=-1, keepdims=True), 1e-6) * mask
    return out

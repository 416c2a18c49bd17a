"""Which pixel of a photo belongs to which object: label images, cut-outs, COCO annotations, BOP's
masks."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from relit.capture.annotations import draw_outlines, outlines_of
from relit.capture.frames import parse_json_file
from relit.capture.listing import pictures_in
from relit.capture.mask_edges import is_turned
from relit.capture.photo import upright_mask
from relit.errors import UserError
from relit.images import read_header, read_small, turn_upright
from relit.images.opencv import decode_file

LEAST_SIDE = 24  # pixels; smaller objects carry no pose
MOST = 1000  # objects
BOP_TRUTH = "scene_gt.json"


def read_labels(source: Path, photo: Path, shape: tuple[int, int]) -> np.ndarray:
    """(H, W) int32 numbers of the objects, 0 for the rest. Raises UserError when the labels do not
    fit the photo."""
    if source.name == BOP_TRUTH:
        return _from_bop(source, photo, shape)
    if source.is_dir():
        return _from_cutouts(source, photo, shape)
    if source.suffix.lower() == ".json":
        return draw_outlines(outlines_of(source, photo), photo, shape)
    data = decode_file(source, cv2.IMREAD_UNCHANGED)
    if data is None:
        raise UserError(
            "the label image cannot be read",
            "it is damaged or no picture",
            f"write it again: {source}",
        )
    turn = read_header(photo).orientation
    labels = upright_mask(_numbers(data), shape, turn)
    if turn != 1 and is_turned([(read_small(photo).rgb, labels, turn)]):
        labels = turn_upright(labels, turn)
    if labels.shape != shape:
        if (
            abs(labels.shape[1] / labels.shape[0] - shape[1] / shape[0])
            > 0.01 * shape[1] / shape[0]
        ):
            raise UserError(
                f"the labels have another shape than the photo: {labels.shape[1]} x {labels.shape[0]} and {shape[1]} x {shape[0]} pixels",
                "they belong to another photo, or one of them was cropped or turned",
                f"make them from this photo: {source}",
            )
        labels = cv2.resize(labels, shape[::-1], interpolation=cv2.INTER_NEAREST)
    return labels


def _numbers(data: np.ndarray) -> np.ndarray:
    """Label numbers of a picture: its grey values, or a number for each colour; black is 0."""
    if data.ndim == 3:
        data = data[..., :3].astype(np.int64)
        grey = (data[..., 0] == data[..., 1]).all() and (data[..., 1] == data[..., 2]).all()
        data = data[..., 0] if grey else data[..., 2] * 65536 + data[..., 1] * 256 + data[..., 0]
    return data.astype(np.int32)


def cutouts_in(folder: Path) -> list[Path]:
    """The cut-outs in a folder, hidden files left out."""
    return [f for f in pictures_in(folder) if f.suffix.lower() == ".png"]


def _from_cutouts(folder: Path, photo: Path, shape: tuple[int, int]) -> np.ndarray:
    labels, turn = np.zeros(shape, np.int32), read_header(photo).orientation
    for k, file in enumerate(cutouts_in(folder), 1):
        data = decode_file(file, cv2.IMREAD_UNCHANGED)
        if data is not None:
            data = upright_mask(data, shape, turn)
        if data is None or data.ndim != 3 or data.shape[2] != 4 or data.shape[:2] != shape:
            have = (
                "unreadable"
                if data is None
                else f"{data.shape[1]} x {data.shape[0]} pixels, {1 if data.ndim == 2 else data.shape[2]} channels"
            )
            raise UserError(
                f"a cut-out does not fit the photo: {have}; the photo has {shape[1]} x {shape[0]} pixels",
                "where the object stands in the photo would be unknown",
                f"write cut-outs as RGBA at the photo's size, clear off the object: {file}",
            )
        labels[data[..., 3] > 127] = k
    return labels


def bop_object(truth: dict) -> int:
    """The obj_id of which the first picture of BOP's scene_gt.json shows the most instances."""
    first = truth[min(truth, key=int)]
    return _commonest([int(entry["obj_id"]) for entry in first])


def _from_bop(source: Path, photo: Path, shape: tuple[int, int]) -> np.ndarray:
    """Instances of the scene's commonest object, from mask_visib/ (what can be seen of each) or
    mask/."""
    try:
        truth = parse_json_file(source)
        chosen, entries = bop_object(truth), truth[str(int(photo.stem))]
        labels = np.zeros(shape, np.int32)
        for k, entry in enumerate(entries):
            if int(entry["obj_id"]) != chosen:
                continue
            name = f"{photo.stem}_{k:06d}.png"
            file = next(
                (
                    f
                    for f in (source.parent / "mask_visib" / name, source.parent / "mask" / name)
                    if f.is_file()
                ),
                None,
            )
            mask = None if file is None else decode_file(file, cv2.IMREAD_GRAYSCALE)
            if mask is None or mask.shape != shape:
                raise UserError(
                    f"no usable mask {name}",
                    "each instance needs its mask at the photo's size",
                    f"see: {source.parent}",
                )
            labels[mask > 127] = k + 1
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise UserError(
            "scene_gt.json is not as BOP writes it",
            f"{type(error).__name__}: {error}",
            f"see: {source}",
        ) from None
    return labels


def which_objects(source: Path, photo: Path) -> str | None:
    """A note on which objects count, where the labels speak of several kinds."""
    if source.name == BOP_TRUTH:
        return f"the objects are those with obj_id {bop_object(parse_json_file(source))}, the commonest of the scene"
    if source.suffix.lower() != ".json":
        return None
    kind = outlines_of(source, photo).kind
    if kind is None:
        return None
    return f"the objects are those of category {kind}, the commonest; others are left out"


def _commonest(kinds: list):
    return max(sorted(set(kinds)), key=kinds.count)


def checked_labels(labels: np.ndarray, source: Path) -> tuple[np.ndarray, list[str]]:
    """Labels without objects that are too small, and notes about them. Raises UserError when fewer
    than one object is left."""
    values, index, areas = np.unique(labels, return_inverse=True, return_counts=True)
    index, notes = index.reshape(labels.shape), []
    objects = values > 0
    if not objects.any():
        raise UserError(
            "the labels hold no object: they are black all over",
            fix=f"give each object a grey level or colour: {source}",
        )
    large = objects & (areas >= LEAST_SIDE**2 / 4)
    if large.sum() > MOST or (objects.sum() > 3 * MOST and large.sum() == 0):
        raise UserError(
            f"the label image holds {int(objects.sum())} values",
            "it is a photograph, not labels",
            f"one value per object: {source}",
        )
    typical = np.median(areas[large]) if large.any() else 0
    keep = large & (areas >= 0.02 * typical)
    boxes = [np.nonzero(index == k) for k in np.flatnonzero(keep)]
    for k, (y, x) in zip(np.flatnonzero(keep), boxes, strict=True):
        if max(np.ptp(x), np.ptp(y)) + 1 < LEAST_SIDE:
            keep[k] = False
    gone = int((objects & ~keep).sum())
    if not keep.any():
        raise UserError(
            f"every object is smaller than {LEAST_SIDE} pixels",
            "so few pixels carry no pose",
            f"take a larger photo: {source}",
        )
    if gone:
        notes.append(
            f"{gone} labels cover less than {LEAST_SIDE} pixels, or next to nothing beside the others, and are left out"
        )
    if keep.sum() == 1:
        notes.append("there is only one object: nothing but its front can be known from one photo")
    border = np.unique(np.concatenate([index[0], index[-1], index[:, 0], index[:, -1]]))
    cut = [int(k) for k in border if keep[k]]
    if cut:
        notes.append(f"{len(cut)} objects are cut by the photo's border")
    out = np.where(objects & ~keep, -1, np.where(keep, values, 0)).astype(np.int32)
    return out[index], notes

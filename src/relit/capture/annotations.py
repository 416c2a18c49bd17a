"""Outlines of objects as annotation tools write them: COCO (CVAT, Label Studio, Roboflow, Segment
Anything), labelme and VIA.

All become COCO's `images`, `annotations` and `categories` first. Coordinates are x, y in pixels of
the picture that the annotator saw; `fit_outlines` decides whether that was the upright picture or
the one as stored, where EXIF turns it.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from relit.capture.listing import image_folders, pictures_in
from relit.capture.mask_edges import CLEARER, edge_strength
from relit.capture.names import NameIndex, before_upload, folded, is_hidden, plain_parts, stem_of
from relit.errors import UserError
from relit.images import read_header, read_small, turn_upright
from relit.masks.rle import Runs, runs_from

MOST_BYTES = 64 << 20  # of an annotation file
FOLDERS_OF_ANNOTATIONS = ("annotations", "annotation", "ann", "labels", "json", "labelme", "coco")
NOT_ANNOTATIONS = ("transforms", "cam_dict", "scene_", "quadrants", "metadata", "cameras")
SAME_SHAPE = 0.02  # relative difference of width / height that rounding explains
SPILL = 2.0  # pixels by which corners may lie outside the picture
EDGE_SIDE = 512  # pixels, longest side at which edges are looked at


@dataclass(frozen=True)
class Outlines:
    """The objects of one photo. size: (width, height) that the file gives the picture, or None.
    shapes: of each object either polygons, (N, 2) each, whose union it is, or run lengths.
    boxes: objects without an outline. kind: what the objects are, where only the commonest of
    several kinds are taken."""

    size: tuple[float, float] | None
    shapes: tuple[tuple[np.ndarray, ...] | Runs, ...]
    boxes: int = 0
    kind: str | None = None


# ---------------------------------------------------------------- files and their photos


def parse_annotations(file: Path) -> dict | None:
    """The content of an annotation file in COCO's form: {"images": [...], "annotations": [...]};
    None for all other files."""
    if file.name.startswith(NOT_ANNOTATIONS) or is_hidden(file):
        return None
    try:
        state = file.stat()
    except OSError:
        return None
    return None if state.st_size > MOST_BYTES else _parsed(file, state.st_mtime_ns, state.st_size)


@lru_cache(maxsize=32)
def _parsed(file: Path, changed: int, size: int) -> dict | None:
    """`parse_annotations`, once for each state of a file."""
    try:
        data = json.loads(file.read_text(encoding="utf-8-sig"))
    except (ValueError, OSError, RecursionError):
        return None
    for convert in (_of_coco, _of_labelme, _of_via):
        if isinstance(data, dict) and (found := convert(data, file)) is not None:
            return found
    return None


def _of_coco(data: dict, file: Path) -> dict | None:
    images, annotations = data.get("images"), data.get("annotations")
    if isinstance(images, list) and isinstance(annotations, list):
        return data
    one = data.get("image")  # Segment Anything: one picture a file
    if not isinstance(one, dict) or not isinstance(annotations, list):
        return None
    listed = [{**a, "image_id": 0} for a in annotations if isinstance(a, dict)]
    return {"images": [{**one, "id": 0}], "annotations": listed}


def _of_labelme(data: dict, file: Path) -> dict | None:
    """labelme, AnyLabeling: `shapes` of one picture. Shapes of one group_id are one object."""
    shapes = data.get("shapes")
    if not isinstance(shapes, list) or "imagePath" not in data:
        return None
    objects: dict[Any, dict] = {}
    for k, shape in enumerate(s for s in shapes if isinstance(s, dict)):
        group = shape.get("group_id")
        key = (str(shape.get("label")), str(group)) if group is not None else k
        parts = objects.setdefault(
            key, {"image_id": 0, "category_id": str(shape.get("label")), "segmentation": []}
        )
        if shape.get("shape_type", "polygon") in ("polygon", None):
            parts["segmentation"].append(shape.get("points"))
    image = {"id": 0, "file_name": str(data["imagePath"])}
    size = {"width": data.get("imageWidth"), "height": data.get("imageHeight")}
    return {
        "images": [image | {k: v for k, v in size.items() if v is not None}],
        "annotations": list(objects.values()),
        "categories": [
            {"id": n, "name": n} for n in sorted({o["category_id"] for o in objects.values()})
        ],
    }


def _of_via(data: dict, file: Path) -> dict | None:
    """VGG Image Annotator: regions of several pictures, as export or as project."""
    entries = data.get("_via_img_metadata", data)
    entries = list(entries.values()) if isinstance(entries, dict) else []
    entries = [e for e in entries if isinstance(e, dict)]
    if not entries or not all("filename" in e and "regions" in e for e in entries):
        return None
    images, annotations = [], []
    for k, entry in enumerate(entries):
        images.append({"id": k, "file_name": str(entry["filename"])})
        regions = entry["regions"]
        regions = list(regions.values()) if isinstance(regions, dict) else regions
        for region in regions if isinstance(regions, list) else []:
            shape = region.get("shape_attributes") if isinstance(region, dict) else None
            if not isinstance(shape, dict):
                continue
            x, y = shape.get("all_points_x"), shape.get("all_points_y")
            both = isinstance(x, list) and isinstance(y, list) and len(x) == len(y)
            polygon = [list(p) for p in zip(x, y, strict=True)] if both else None  # pyright: ignore[reportArgumentType]
            annotations.append({"image_id": k, "segmentation": [polygon] if polygon else []})
    return {"images": images, "annotations": annotations}


def annotation_files(root: Path) -> list[tuple[Path, dict]]:
    """Annotation files of a capture with their content: in the root, beside the photos, in
    annotations/ and like folders."""
    inside = [d for d in root.iterdir() if d.is_dir() and d.name.lower() in FOLDERS_OF_ANNOTATIONS]
    folders = dict.fromkeys([*image_folders(root), *sorted(inside)])
    files = [f for d in folders for f in sorted(d.glob("*.json"))]
    parsed = ((f, parse_annotations(f)) for f in files)
    return [(f, data) for f, data in parsed if data is not None]


def annotated_photos(root: Path) -> list[tuple[Path, Path]]:
    """(photo, annotation file) of the photos of a capture that an annotation file speaks of."""
    found: dict[Path, Path] = {}
    files = annotation_files(root)
    index = NameIndex(root) if files else None
    for file, data in files:
        assert index is not None
        bases = dict.fromkeys([file.parent, *image_folders(root)])
        for entry in _images(data):
            photo = index.find(str(entry.get("file_name", "")), bases)
            if photo is not None:
                found.setdefault(photo, file)
        if len(_images(data)) == 1 and not found:
            lone = [f for d in bases if d.is_dir() for f in pictures_in(d)]
            found |= {lone[0]: file} if len(lone) == 1 else {}
    return sorted(found.items())


def are_masks(annotated: list[tuple[Path, Path]]) -> bool:
    """Whether the outlines are masks of one object seen from several sides: three photos or more,
    and none shows two objects."""
    if len(annotated) < 3:
        return False
    counts = []
    for photo, file in annotated:
        data = parse_annotations(file) or {"images": [], "annotations": []}
        ids = {str(i.get("id")) for i in _images(data) if _names(i, photo)}
        annotations = [a for a in data["annotations"] if isinstance(a, dict)]
        counts.append(sum(str(a.get("image_id")) in ids for a in annotations))
    return max(counts) == 1


def outline_mask(file: Path, photo: Path) -> Runs:
    """The union of the objects of a photo as run lengths, upright. Raises UserError as
    `outlines_of` and `draw_outlines` do."""
    header = read_header(photo)
    labels = draw_outlines(outlines_of(file, photo), photo, (header.height, header.width))
    flat = (labels.T.ravel() > 0).astype(np.int8)
    ends = np.flatnonzero(np.diff(flat)) + 1
    counts = np.diff(np.concatenate([[0], ends, [len(flat)]])).tolist()
    return Runs(tuple([0, *counts] if flat[0] else counts), labels.shape, photo.name)  # pyright: ignore[reportArgumentType]


def annotations_of(photo: Path) -> Path | None:
    """The annotation file that speaks of a photo: beside it, in the folder above, or in
    annotations/ there."""
    for base in (photo.parent, photo.parent.parent, photo.parent.parent.parent):
        for folder in (base, *(base / n for n in FOLDERS_OF_ANNOTATIONS)):
            for file in sorted(folder.glob("*.json")) if folder.is_dir() else ():
                data = parse_annotations(file)
                if data is None:
                    continue
                lone = folder == photo.parent and _is_lone(data, photo)
                if lone or any(_names(i, photo) for i in _images(data)):
                    return file
    return None


def _is_lone(data: dict, photo: Path) -> bool:
    """Whether none of the file's pictures lies beside the photo, so that it may be renamed."""
    names = {folded((plain_parts(str(i.get("file_name", ""))) or ("",))[-1]) for i in _images(data)}
    return not any(folded(f.name) in names for f in photo.parent.iterdir())


def _images(data: dict) -> list[dict]:
    return [i for i in data["images"] if isinstance(i, dict)]


def _names(entry: dict, photo: Path) -> bool:
    """Whether an entry of `images` names the photo: by its file name, in any Unicode form, letter
    case and extension of a picture."""
    written = str(entry.get("file_name", ""))
    lasts = [parts[-1] for n in (written, before_upload(written)) if (parts := plain_parts(n))]
    return folded(stem_of(photo.name)) in [folded(stem_of(last)) for last in lasts]


# ---------------------------------------------------------------- objects of one photo


def outlines_of(file: Path, photo: Path) -> Outlines:
    """The objects of a photo. Raises UserError for outlines that make no sense, and where there
    are boxes only."""
    data = parse_annotations(file)
    if data is None:
        raise UserError("an annotation file cannot be read", fix=f"write it again: {file}")
    images = _images(data)
    entry = next((i for i in images if _names(i, photo)), images[0] if len(images) == 1 else None)
    if entry is None:
        raise UserError(
            f"the annotations do not name the photo {photo.name}", fix=f"check `images`: {file}"
        )
    size = (entry.get("width"), entry.get("height"))
    if not all(v is None or (isinstance(v, (int, float)) and 1 <= v < 1e6) for v in size):
        raise UserError(
            f"the annotations give the photo {photo.name} the size {size}",
            fix=f"check `images`: {file}",
        )
    chosen, shapes, boxes, k = _category(data, photo), [], 0, 0
    for a in data["annotations"]:
        if not isinstance(a, dict) or a.get("image_id") != entry.get("id"):
            continue
        if chosen is not None and _kind(a) != chosen:
            continue
        k += 1
        shape = _shape(a.get("segmentation"), k, file)
        boxes += shape is None
        shapes += [shape] if shape is not None else []
    if boxes and not shapes:
        raise UserError(
            f"the annotations of {photo.name} hold {boxes} boxes and no outline",
            "`segmentation` is empty: which pixels belong to an object is not known",
            f"draw polygons, or export masks with the boxes: {file}",
        )
    known = None if None in size else (float(size[0]), float(size[1]))  # pyright: ignore[reportArgumentType]
    return Outlines(known, tuple(shapes), boxes, _name(data, chosen))


def _shape(segmentation, k: int, file: Path) -> tuple[np.ndarray, ...] | Runs | None:
    """Polygons or run lengths of the k-th object; None where it has no outline."""
    if segmentation is None or segmentation == [] or segmentation == [[]]:
        return None
    try:
        if isinstance(segmentation, dict):
            return runs_from(segmentation, f"annotation {k}")
        flat = all(isinstance(v, (int, float)) for v in segmentation)
        parts = [segmentation] if flat else segmentation
        polygons = tuple(np.array(p, np.float64).reshape(-1, 2) for p in parts if len(p))
        if not all(len(p) >= 1 and (np.abs(p) < 1e6).all() for p in polygons):
            raise ValueError("corners far outside the photo")
    except (TypeError, ValueError, KeyError, OverflowError) as error:
        raise UserError(
            f"annotation {k} has no usable segmentation",
            f"it must be a list of polygons [[x, y, x, y, ...]] or run lengths; {str(error)[:100]}",
            f"export it again: {file}",
        ) from None
    return polygons or None


def _category(data: dict, photo: Path):
    """Of several categories the one with the most objects in the photos that lie in the photo's
    folder; None where all objects count: there is but one, or each object has one of its own. What
    says that it is a group (iscrowd) is an object too: many tools write it of whatever has run
    lengths."""
    images = _images(data)
    stems = {folded(stem_of(f.name)) for f in photo.parent.iterdir()}
    parts = [plain_parts(str(i.get("file_name", ""))) for i in images]
    here = [i for i, p in zip(images, parts, strict=True) if p and folded(stem_of(p[-1])) in stems]
    ids = {str(i.get("id")) for i in here or images}
    kinds = [
        _kind(a)
        for a in data["annotations"]
        if isinstance(a, dict) and str(a.get("image_id")) in ids
    ]
    if len(set(kinds)) < 2 or len(set(kinds)) == len(kinds):
        return None
    return max(sorted(set(kinds), key=str), key=kinds.count)


def _kind(annotation: dict):
    """-1 where none is told."""
    kind = annotation.get("category_id")
    return kind if isinstance(kind, (int, str)) else -1


def _name(data: dict, chosen) -> str | None:
    if chosen is None:
        return None
    entries = data.get("categories")
    entries = [c for c in entries if isinstance(c, dict)] if isinstance(entries, list) else []
    return next((str(c.get("name")) for c in entries if c.get("id") == chosen), str(chosen))


# ---------------------------------------------------------------- drawing


def draw_outlines(outlines: Outlines, photo: Path, shape: tuple[int, int]) -> np.ndarray:
    """(H, W) int32 numbers of the objects, 0 for the rest, upright. Raises UserError where the
    outlines were drawn on another picture, or it cannot be told how that was turned."""
    orientation = read_header(photo).orientation
    views = _views(outlines, shape, orientation)
    if not views:
        w, h = outlines.size or (0, 0)
        raise UserError(
            f"the annotations of {photo.name} belong to a picture of another shape: {w:g} x {h:g} "
            f"and {shape[1]} x {shape[0]} pixels",
            "the photo was cropped or turned after it was annotated",
            "annotate this photo, or give the one that was annotated",
        )
    drawn = [view(outlines) for view in views]
    if len(drawn) == 1:
        return drawn[0]
    rgb = read_small(photo, EDGE_SIDE).rgb
    strength = [edge_strength(rgb, labels) for labels in drawn]
    best = int(np.argmax(strength))
    if strength[best] < CLEARER * max(s for k, s in enumerate(strength) if k != best):
        raise UserError(
            f"it cannot be told how the annotations of {photo.name} are turned",
            "their picture has width and height exchanged, and the outlines fit both",
            "save the photo upright without EXIF orientation and annotate that",
        )
    return drawn[best]


def _views(
    outlines: Outlines, shape: tuple[int, int], orientation: int
) -> list[Callable[[Outlines], np.ndarray]]:
    """How the outlines may lie in the photo (H, W), most likely first: in the upright picture, or
    in the one as stored, of which tools exchange width and height."""
    h, w = shape
    size = outlines.size or (float(w), float(h))
    runs = next((s.size for s in outlines.shapes if isinstance(s, Runs)), None)
    size = (float(runs[1]), float(runs[0])) if runs else size
    swapped = (size[1], size[0])
    upright = abs(size[0] * h / (size[1] * w) - 1) < SAME_SHAPE
    lying = abs(swapped[0] * h / (swapped[1] * w) - 1) < SAME_SHAPE
    views: list[Callable[[Outlines], np.ndarray]] = []
    if upright and _fits(outlines, size):
        views.append(lambda o: _drawn(o, size, (h, w)))
    if lying and not upright and runs is None and _fits(outlines, swapped):
        views.append(lambda o: _drawn(o, swapped, (h, w)))
    if lying and not upright and _fits(outlines, size):
        turns = (orientation,) if orientation >= 5 else (6, 8)
        for turn in turns:
            views.append(lambda o, t=turn: turn_upright(_drawn(o, size, (w, h)), t))
    if not views and upright:
        views.append(lambda o: _drawn(o, size, (h, w)))
    return views


def _fits(outlines: Outlines, size: tuple[float, float]) -> bool:
    """Whether all corners lie inside a picture of (width, height)."""
    corners = [p for s in outlines.shapes if not isinstance(s, Runs) for p in s]
    return all((p <= np.array(size) + SPILL).all() for p in corners)


def _drawn(outlines: Outlines, size: tuple[float, float], shape: tuple[int, int]) -> np.ndarray:
    """Labels (H, W) of outlines in a picture of (width, height): of one object the union."""
    scale = np.array([shape[1] / size[0], shape[0] / size[1]])
    labels = np.zeros(shape, np.int32)
    for k, s in enumerate(outlines.shapes, 1):
        if isinstance(s, Runs):
            mask = cv2.resize(s.decode(), shape[::-1], interpolation=cv2.INTER_NEAREST)
            labels[mask > 0] = k
            continue
        for polygon in s:  # one by one: drawn together their overlap would be a hole
            cv2.fillPoly(labels, [np.round(polygon * scale).astype(np.int32)], k)
    return labels

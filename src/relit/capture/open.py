"""`open_capture`: recognise what a folder holds, read it, say what was done."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from relit.capture import photo
from relit.capture.corrections import (
    Corrected,
    corrected_masks,
    corrected_sphere,
    with_corrected_masks,
)
from relit.capture.frames import Frame, Reading, check_max_side
from relit.capture.readers import (
    colmap_model,
    idr,
    iron,
    llff,
    middlebury,
    mvmc,
    samurai,
    sfd,
    transforms_json,
)
from relit.capture.sphere import SphereView, check_sphere, settled_sphere, up_direction
from relit.errors import UserError, did_you_mean
from relit.geometry.lens import lens_of
from relit.images import Header, Image, read_small
from relit.masks.files import find_mask, index_masks, judge, read_counted
from relit.masks.grabcut import grabcut
from relit.masks.segment import segmenter
from relit.masks.threshold import Backdrop, find_backdrop
from relit.scene import Capture, Photo, Sphere

# In this order; the first that recognises the folder reads it. A reader has LOOKED_FOR,
# recognise(path) and read(path, found) -> Reading; that of labelled photos gives its Source.
READERS = {
    "duplicates": sfd,
    "transforms": transforms_json,
    "iron": iron,
    "idr": idr,
    "middlebury": middlebury,
    "colmap": colmap_model,
    "samurai": samurai,
    "mvmc": mvmc,
    "llff": llff,
    "photos": photo,
}
MASKS = ("auto", "none", "alpha", "files", "threshold", "grabcut", "segment")
SMALL = 256  # pixels, longest side of the copies that masks are judged on
LOOKED_AT = 12  # photos that are looked at for a plain backdrop


def open_capture(
    path: str | Path,
    *,
    sphere: Sphere | None = None,
    masks: str = "auto",
    max_side: int | None = None,
    min_photos: int = 3,
    focal: float | None = None,
    labels: bool = True,
) -> Capture:
    """Read a capture of any known format; photos decode later, when `Photo.load` is called.

    sphere: the object sphere in the units of the cameras; found when not given. masks: 'auto' takes
    alpha channels, else mask files, else a plain backdrop, else none; 'none', 'alpha', 'files',
    'threshold', 'grabcut', 'segment' ask for one kind, and 'segment:NAME' for a network of rembg's
    other than its U^2-Net.
    max_side: photos are resized to at most so many pixels. min_photos: fewer photos are an error.
    focal: pixels, of a photo of duplicates. labels: False reads labelled photos like any others.
    Raises UserError (exit code 3) for everything that is wrong with the input.
    """
    path = Path(path).expanduser()
    if masks not in MASKS and not masks.startswith("segment:"):
        raise UserError(
            f"unknown kind of masks '{masks}'.{did_you_mean(masks, MASKS)}",
            fix=f"choose one of {', '.join(MASKS)}",
            code=2,
        )
    check_max_side(max_side)
    if not path.exists():
        raise UserError("the input is not there", fix=f"check the path: {path}")
    reading = _read(path, labels)
    if isinstance(reading, sfd.Source):
        return sfd.open_duplicates(reading, focal=focal, max_side=max_side)
    headers = photo.headers_of(reading.frames)
    notes = list(reading.notes) + _size_notes(reading, headers)
    training = sum(not f.held_out for f in reading.frames)
    if training < min_photos:
        raise UserError(
            f"{training} photo{'s are' if training != 1 else ' is'} not enough: at least {min_photos} are needed",
            "shape is found by comparing photos from different sides",
            f"add photos, 30 to 80 all around the object are good: {reading.root}",
        )
    normals = photo.index_normals(reading.root)
    photos = [
        photo.photo_from(f, h, max_side, normals)
        for f, h in zip(reading.frames, headers, strict=True)
    ]
    photos = _with_facing_normals(photos, notes)
    if any(p.load.normal for p in photos):
        notes.append(f"{sum(p.load.normal is not None for p in photos)} photos have normal priors")
    photos, small, dark = _masked(reading, headers, photos, masks, notes)
    corrected = set() if masks == "none" else set(corrected_masks(reading.root))
    empty = {
        i
        for i, m in enumerate(small)
        if m is not None and not (m > 0.5).any() and not reading.frames[i].held_out
    }
    dropped = {i for i in empty if photos[i].name not in corrected}
    views = [
        SphereView(f.camera, f.lens or lens_of(f.camera), m, f.name) if f.camera else None
        for f, m in zip(reading.frames, small, strict=True)
    ]
    photos = [with_calibration(p, f) for p, f in zip(photos, reading.frames, strict=True)]
    if corrected:
        photos = with_corrected_masks(
            photos, reading.root, masks == "grabcut" or any(m is not None for m in small), notes
        )
    train = [i for i, f in enumerate(reading.frames) if not f.held_out and i not in dropped]
    held = [i for i, f in enumerate(reading.frames) if f.held_out]

    up = None
    if all(views[i] is not None for i in train):
        cameras = [photos[i].camera for i in train]
        if sphere is None:
            sphere = corrected_sphere(reading.root)
            notes += ["the object sphere is the corrected one"] if sphere is not None else []
        if sphere is None:
            sphere, source = settled_sphere(
                reading.sphere,
                reading.presumed,
                [views[i] for i in train],  # pyright: ignore[reportArgumentType]
                reading.points,
            )
            notes += [f"the object sphere was found from {source}"] if source else []
        notes += check_sphere(sphere, cameras)  # pyright: ignore[reportArgumentType]
        up = up_direction(cameras)  # pyright: ignore[reportArgumentType]
    capture = Capture(
        root=reading.root,
        format=reading.format,
        photos=tuple(photos[i] for i in train),
        held_out=tuple(photos[i] for i in held),
        sphere=sphere,
        points=reading.points,
        up=up,
        black_background=dark,
        notes=tuple(notes),
        kind=reading.kind,
    )
    if masks == "grabcut" and not capture.has_cameras:
        return replace(
            capture,
            notes=(
                *capture.notes,
                "GrabCut is seeded by the object sphere: it waits until the cameras are found",
            ),
        )
    return with_grabcut(capture) if masks == "grabcut" else capture


def with_grabcut(capture: Capture) -> Capture:
    """The capture with masks that GrabCut guesses from the object sphere, for photos with cameras.
    Decodes every photo once."""

    def cut(p: Photo) -> Photo:
        if _is_corrected(p):
            return p
        return photo.with_mask(p, grabcut(p.load().rgb, p.camera, capture.sphere))  # pyright: ignore[reportArgumentType]

    if capture.sphere is None or not capture.has_cameras:
        raise UserError(
            "GrabCut needs cameras",
            "it is seeded by the object sphere",
            "find the cameras first, or give mask files",
        )
    note = "masks were guessed by GrabCut from the object sphere; look at them"
    photos, held = (tuple(cut(p) for p in some) for some in (capture.photos, capture.held_out))
    return replace(capture, photos=photos, held_out=held, notes=(*capture.notes, note))


def _is_corrected(p: Photo) -> bool:
    """Whether the mask was corrected by hand, be the photo undistorted since or not."""
    return any(isinstance(layer, Corrected) for layer in photo.layers(p.load))


def _with_facing_normals(photos: list[Photo], notes: list[str]) -> list[Photo]:
    """The photos without their normal priors where these do not face the camera: world axes (Shiny
    Blender's _normal.png), or y up."""
    looked = [p for p in photos if p.load.normal is not None][:5]
    facing = []
    for p in looked:
        normal = photo.read_normal(p.load.normal, (p.height, p.width))
        facing.append(
            normal[(normal != 0).any(-1)][:, 2] < 0.3
        )  # 0.3: a wide lens sees a little round the edge
    facing = np.concatenate(facing) if facing else np.empty(0)
    if len(facing) == 0 or facing.mean() > 0.9:
        return photos
    notes.append(
        f"the normal priors are not used: {100 * (1 - facing.mean()):.0f} % of them look away from the camera; they must be in its axes, "
        "x right, y down, z forward (docs/formats.md)"
    )
    return [_with(p, normal=None) for p in photos]


def with_calibration(p: Photo, frame: Frame) -> Photo:
    """The photo with the camera of its frame, undistorted; as it is when the frame has none."""
    return p if frame.camera is None else photo.with_camera(p, frame.camera, frame.lens)


def _read(path: Path, labels: bool) -> Reading | sfd.Source:
    """The reading of the first format that recognises `path`. labels: whether labelled photos are
    taken for photos of duplicates."""
    for name, module in READERS.items():
        if name == "duplicates" and not labels:
            continue
        found = module.recognise(path)
        if found is not None:
            return module.read(path, found)
    looked = "; ".join(m.LOOKED_FOR for m in READERS.values())
    if path.is_file():
        raise UserError(
            "the input is no capture",
            f"a folder is expected, or one of its camera files; looked for {looked}",
            f"give the folder of: {path}",
        )
    some = sorted(p.name + ("/" if p.is_dir() else "") for p in path.iterdir())[:8]
    raise UserError(
        "no images were found",
        f"looked for {looked}; the folder holds {', '.join(some) if some else 'nothing'}",
        f"give the folder that holds the photos: {path}",
    )


def _size_notes(reading: Reading, headers: list[Header]) -> list[str]:
    sizes = Counter((h.width, h.height) for h in headers)
    if len(sizes) <= 1:
        return []
    text = ", ".join(f"{n} of {w} x {h}" for (w, h), n in sizes.most_common(4))
    has_cameras = reading.frames[0].camera is not None
    return [
        f"the photos have {len(sizes)} sizes ({text}): "
        + ("each has its own camera" if has_cameras else "each size gets its own focal length")
    ]


# ---------------------------------------------------------------- masks


def _masked(
    reading: Reading, headers: list[Header], photos: list[Photo], wanted: str, notes: list[str]
):
    """-> (photos that know their masks, small masks (h, w) or None, True when the background is
    black)."""
    none = [None] * len(photos)
    if wanted in ("auto", "alpha") and all(h.alpha for h in headers):
        small = [
            None if f.held_out else _small(p).alpha
            for f, p in zip(reading.frames, photos, strict=True)
        ]
        if wanted == "alpha" or any((a < 0.5).any() for a in small if a is not None):
            inverted, empty = judge(_named(reading, small), "the alpha channel")
            if inverted:
                why = "it is opaque at the border and clear in the middle"
                raise UserError(
                    "the alpha channel looks inverted", why, "invert it, or use --masks none"
                )
            _say_empty(empty, notes)
            notes.append("masks come from the alpha channel; the photos are composited on black")
            return [_with(p, mask=True) for p in photos], small, True
        notes.append("the alpha channel is opaque everywhere: it is no mask")
    elif wanted == "alpha":
        raise UserError(
            f"{sum(not h.alpha for h in headers)} of {len(headers)} photos have no alpha channel",
            fix="give mask files, or another kind of masks",
        )
    elif any(h.alpha for h in headers):
        notes.append(
            f"only {sum(h.alpha for h in headers)} of {len(headers)} photos have an alpha channel: it is not used as a mask"
        )
    if wanted in ("auto", "files") and any(f.runs for f in reading.frames):
        return (*_from_runs(reading, photos, notes), False)
    if wanted in ("auto", "files"):
        result = _from_files(reading, photos, wanted == "files", notes)
        if result is not None:
            return result
    if wanted in ("auto", "threshold"):
        result = _from_backdrop(reading, photos, wanted == "threshold", notes)
        if result is not None:
            return result
    if wanted.startswith("segment"):
        mask_of = segmenter(*wanted.split(":", 1)[1:])
        masked, small = [], []
        for p in photos:
            m = mask_of(p.load().rgb)
            masked.append(photo.with_mask(p, m))
            scale = min(1.0, SMALL / max(m.shape))
            small.append(cv2.resize(m, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))
        _say_empty(judge(_named(reading, small), "the segmenter")[1], notes)
        notes.append("masks were found by the segmenter; look at them")
        return masked, small, False
    return photos, none, False


def _named(reading: Reading, small: list) -> dict[str, np.ndarray]:
    return {f.name: m for f, m in zip(reading.frames, small, strict=True) if m is not None}


def _small(p: Photo) -> Image:
    return read_small(p.load.path, SMALL, p.load.upright)


def _with(p: Photo, **changes) -> Photo:
    return replace(p, load=replace(p.load, **changes))  # pyright: ignore[reportArgumentType]


def _say_empty(empty: list[str], notes: list[str]) -> None:
    if empty:
        notes.append(
            f"{len(empty)} photos have an empty mask and are not used, for example {empty[0]}"
        )


def _from_runs(reading: Reading, photos: list[Photo], notes: list[str]):
    """(photos, small masks) of a format that holds its masks itself."""
    lacking = [f.name for f in reading.frames if f.runs is None]
    if lacking:
        what = f"{len(lacking)} of {len(photos)} photos have no mask in the file, for example {lacking[0]}"
        raise UserError(what, fix=f"add their run lengths, or use --masks none: {reading.root}")
    masked = [_with(p, mask=f.runs) for p, f in zip(photos, reading.frames, strict=True)]
    small = [
        _shrunk(photo.fitted_mask(f.runs.decode(), (p.height, p.width), p.load.orientation, f.name))
        for p, f in zip(photos, reading.frames, strict=True)
    ]
    _say_empty(judge(_named(reading, small), "the run lengths")[1], notes)
    notes.append("masks come from run lengths")
    return masked, small


def _from_files(reading: Reading, photos: list[Photo], asked: bool, notes: list[str]):
    folder, index = index_masks(reading.root)
    named = any(f.mask is not None for f in reading.frames)
    files = [
        f.mask
        if f.mask is not None and f.mask.is_file()
        else find_mask(f.path, reading.root, index)
        for f in reading.frames
    ]
    missing = [
        f.name for f, m in zip(reading.frames, files, strict=True) if m is None or not m.is_file()
    ]
    train = [f.name for f in reading.frames if not f.held_out]
    if folder is None and not asked and not named and len(missing) == len(files):
        return None
    if set(missing) & set(train):
        lacking = [n for n in missing if n in set(train)]
        raise UserError(
            f"{len(lacking)} of {len(train)} photos have no mask, for example {lacking[0]}",
            f"masks were looked for in {folder.name}/ by the photos' names"
            if folder
            else "no mask folder was found and no file ends in _mask.png",
            f"add the masks, or use --masks none: {folder or reading.root}",
        )
    looked = [
        (None, False) if f.held_out else _small_mask(m, p)  # pyright: ignore[reportArgumentType]
        for f, m, p in zip(reading.frames, files, photos, strict=True)
    ]
    small = [mask for mask, _ in looked]
    where = f"{folder.name}/" if folder else "the mask files"
    inverted, empty = judge(_named(reading, small), where)
    small = [1.0 - m if inverted and m is not None else m for m in small]
    notes.append(f"masks come from {where}")
    if any(numbered for _, numbered in looked):
        notes.append(
            "the masks hold the numbers 0 and 1 in the place of black and white: 1 is taken for the object"
        )
    if inverted:
        notes.append("the masks were white off the object and have been inverted")
    _say_empty(empty, notes)
    files = [
        m if m is not None and m.is_file() else None for m in files
    ]  # of a held-out photo it may be missing
    return (
        [_with(p, mask=m, invert=inverted) for p, m in zip(photos, files, strict=True)],
        small,
        False,
    )


def _small_mask(path: Path, p: Photo) -> tuple[np.ndarray, bool]:
    """Small copy of a mask file, and whether it holds the numbers 0 and 1 (`read_counted`)."""
    mask, numbered = read_counted(path)
    return _shrunk(photo.upright_mask(mask, (p.height, p.width), p.load.orientation)), numbered


def _shrunk(mask: np.ndarray) -> np.ndarray:
    h, w = mask.shape
    s = min(1.0, SMALL / max(h, w))
    return (
        mask
        if s == 1
        else cv2.resize(
            mask, (max(1, round(w * s)), max(1, round(h * s))), interpolation=cv2.INTER_AREA
        )
    )


def _from_backdrop(reading: Reading, photos: list[Photo], asked: bool, notes: list[str]):
    training = [p for f, p in zip(reading.frames, photos, strict=True) if not f.held_out]
    looked = [_small(p).rgb for p in training[:: max(1, len(training) // LOOKED_AT)]]
    backdrop: Backdrop | None = find_backdrop(looked)
    if backdrop is None:
        if asked:
            raise UserError(
                "the photos do not stand before a plain backdrop",
                "their borders are not of one colour",
                "give mask files, or use --masks none to fit the background as well",
            )
        return None
    small = [
        None if f.held_out else backdrop(_small(p).rgb)
        for f, p in zip(reading.frames, photos, strict=True)
    ]
    _, empty = judge(_named(reading, small), "the threshold")
    _say_empty(empty, notes)
    kind = "dark" if backdrop.dark else "plain"
    notes.append(
        f"masks were found by a threshold before the {kind} backdrop"
        + ("; what lies outside them is set to black" if backdrop.dark else "")
    )
    return [_with(p, mask=backdrop) for p in photos], small, backdrop.dark

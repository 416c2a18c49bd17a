"""Where the masks of a capture come from: alpha channels, run lengths, mask files, a plain backdrop
or a network."""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from relit.capture import photo
from relit.capture.frames import Reading
from relit.capture.listing import listed
from relit.capture.mask_edges import is_turned
from relit.errors import UserError
from relit.images import Header, Image, read_small, turn_upright
from relit.log import readable_seconds
from relit.masks.files import (
    FOLDERS,
    border_share,
    find_mask,
    index_masks,
    judge,
    read_counted,
)
from relit.masks.segment import Segmenter, at_hand, segmenter
from relit.masks.threshold import Backdrop, black_frame, find_backdrop
from relit.masks.weights import COMMAND as WEIGHTS_COMMAND
from relit.scene import Photo

SMALL = 256  # pixels, longest side of the copies that masks are judged on
# share of a photo's border that a mask before a plain backdrop may cover, and share of the photos
# in which it may cover more: objects are cut by the frame now and then
SPILL, SPILLED = 0.2, 0.25
# photos in which a threshold's masks are compared with the segmenter's, and the median overlap from
# which on they are alike
COMPARED, ALIKE = 6, 0.7
SILENT = 3.0  # seconds of segmenting after which progress is shown
PANORAMA = "EQUIRECTANGULAR"  # COLMAP's model
LOOKED_AT = 12  # photos that are looked at for a plain backdrop


def masked(
    reading: Reading, headers: list[Header], photos: list[Photo], wanted: str, notes: list[str]
):
    """-> (photos that know their masks, small masks (h, w) or None, True when the background is
    black)."""
    none = [None] * len(photos)
    network: Segmenter | None = None
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
            return [with_decoder(p, mask=True) for p in photos], small, True
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
        said: list[str] = []
        result = _from_backdrop(reading, photos, wanted == "threshold", said)
        network = _network_at_hand() if result is not None and wanted == "auto" else None
        doubt = "" if network is None else _doubt(photos, result[0], network)  # pyright: ignore
        notes += [doubt] if doubt else said
        if result is not None and not doubt:
            return result
    if wanted.startswith("segment"):
        network = segmenter("".join(wanted.split(":", 1)[1:]))
        return (*_from_segmenter(reading, photos, network, notes), False)
    if wanted == "auto" and (network is not None or at_hand()):
        try:
            return (*_from_segmenter(reading, photos, network or segmenter(), notes), False)
        except UserError as error:
            notes.append(f"the segmenter's masks are not used: {error.what}")
    elif wanted == "auto":
        notes.append(
            f"no masks: everything in the photos is reconstructed; with the extra `segment` and `{WEIGHTS_COMMAND}` the object is cut out"
        )
    return photos, none, False


def _named(reading: Reading, small: list) -> dict[str, np.ndarray]:
    return {f.name: m for f, m in zip(reading.frames, small, strict=True) if m is not None}


def _small(p: Photo) -> Image:
    return read_small(p.load.path, SMALL, p.load.upright)


def with_decoder(p: Photo, **changes) -> Photo:
    return replace(p, load=replace(p.load, **changes))  # pyright: ignore[reportArgumentType]


def _say_empty(empty: list[str], notes: list[str]) -> None:
    if empty:
        notes.append(
            f"{len(empty)} photos have an empty mask and are not used, for example {empty[0]}"
        )


def _network_at_hand() -> Segmenter | None:
    """The segmenter, None where it is missing; a damaged file takes nothing from photos that do not
    need it."""
    try:
        return segmenter() if at_hand() else None
    except UserError:
        return None


def _doubt(photos: list[Photo], found: list[Photo], network: Segmenter) -> str:
    """Why masks by a threshold are not used, '' where they are: a surface that the object lies on can
    pass for a plain backdrop in each photo alone. found: the photos with the threshold's masks. They
    are compared with those of the network in a few photos."""
    overlaps, step = [], max(1, -(-len(photos) // COMPARED))
    for p, masked_photo in list(zip(photos, found, strict=True))[::step]:
        mask = network.kept(p.load.path, (p.height, p.width), lambda p=p: p.load().rgb)
        own, other = masked_photo.load().mask > 0.5, mask > 0.5
        overlaps.append((own & other).sum() / max(int((own | other).sum()), 1))
    overlap = float(np.median(overlaps)) if overlaps else 1.0
    if overlap >= ALIKE:
        return ""
    return (
        "a threshold before a plain backdrop and the segmenter disagree (intersection over union "
        f"{overlap:.2f} in {len(overlaps)} photos): the segmenter's masks are used; --masks threshold takes the others"
    )


def _from_segmenter(reading: Reading, photos: list[Photo], network: Segmenter, notes: list[str]):
    """(photos, small masks) by a network; masks of earlier calls are read back. Raises UserError
    where its masks tell nothing."""
    found, small, began = [], [], time.monotonic()
    for k, p in enumerate(photos):
        m = network.kept(p.load.path, (p.height, p.width), lambda p=p: p.load().rgb)
        found.append(photo.with_mask(p, m))
        small.append(_shrunk(m))
        if (took := time.monotonic() - began) > SILENT and sys.stderr.isatty():
            left = readable_seconds(took / (k + 1) * (len(photos) - k - 1))
            print(f"\rmasks: {k + 1} of {len(photos)}, {left} left ", end="", file=sys.stderr)
    if time.monotonic() - began > SILENT and sys.stderr.isatty():
        print(file=sys.stderr)
    _say_empty(judge(_named(reading, small), "the segmenter")[1], notes)
    notes.append(f"masks were found by the segmenter {network.name}; look at them")
    return found, small


def _from_runs(reading: Reading, photos: list[Photo], notes: list[str]):
    """(photos, small masks) of a format that holds its masks itself."""
    lacking = [f.name for f in reading.frames if f.runs is None]
    if lacking:
        what = f"{len(lacking)} of {len(photos)} photos have no mask in the file, for example {lacking[0]}"
        raise UserError(what, fix=f"add their run lengths, or use --masks none: {reading.root}")
    masked = [with_decoder(p, mask=f.runs) for p, f in zip(photos, reading.frames, strict=True)]
    small = [
        _shrunk(photo.fitted_mask(f.runs.decode(), (p.height, p.width), p.load.orientation, f.name))
        for p, f in zip(photos, reading.frames, strict=True)
    ]
    _say_empty(judge(_named(reading, small), "the run lengths")[1], notes)
    notes.append("masks come from run lengths")
    return masked, small


def _mask_files(reading: Reading) -> tuple[Path | None, list[Path | None]]:
    """-> (the mask folder or None, of each frame its mask file or None)."""
    places = {f.path.parent.parent for f in reading.frames}
    inside = tuple(sorted(p for p in places if p.is_relative_to(reading.root)))
    folder, index = index_masks(reading.root, inside)
    named = [f.mask if f.mask is not None and f.mask.is_file() else None for f in reading.frames]
    files = [
        m or find_mask(f.path, reading.root, index)
        for f, m in zip(reading.frames, named, strict=True)
    ]
    files = files if any(files) else _lying_beside(reading)
    return folder, [m if m is not None and m.is_file() else None for m in files]


def _from_files(reading: Reading, photos: list[Photo], asked: bool, notes: list[str]):
    folder, files = _mask_files(reading)
    wanted = asked or any(f.mask is not None for f in reading.frames)
    train = [f.name for f in reading.frames if not f.held_out]
    lacking = [
        f.name for f, m in zip(reading.frames, files, strict=True) if m is None and not f.held_out
    ]
    if folder is None and not wanted and not any(files):
        return None
    if lacking and folder is not None and folder.name.lower() not in FOLDERS and not wanted:
        notes.append(
            f"{folder.name}/ holds masks by its name and is not used: {len(lacking)} of "
            f"{len(train)} photos have none there, for example {lacking[0]}"
        )
        return None
    if lacking:
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
    turn = _to_turn(photos, small)
    small = [
        turn_upright(m, p.load.orientation) if t and m is not None else m  # pyright: ignore[reportAttributeAccessIssue]
        for m, p, t in zip(small, photos, turn, strict=True)
    ]
    inverted, empty = judge(_named(reading, small), where)
    small = [1.0 - m if inverted and m is not None else m for m in small]
    notes.append(f"masks come from {where}")
    if any(turn):
        notes.append(
            f"{sum(turn)} masks were turned by the EXIF orientation of their photos: they lie on "
            "their edges so"
        )
    if any(numbered for _, numbered in looked):
        notes.append(
            "the masks hold the numbers 0 and 1 in the place of black and white: 1 is taken for the object"
        )
    if inverted:
        notes.append("the masks were white off the object and have been inverted")
    _say_empty(empty, notes)
    masked_photos = [
        with_decoder(p, mask=m, invert=inverted, turn_mask=t)
        for p, m, t in zip(photos, files, turn, strict=True)
    ]
    return masked_photos, small, False


def _lying_beside(reading: Reading) -> list[Path | None]:
    """Cut-outs and masks with the names of the photos beside them, where all training photos have
    one."""
    folders = {f.path.parent for f in reading.frames}
    beside = {p: m for d in folders for p, m in listed(d).masks.items()}
    found = [beside.get(f.path) for f in reading.frames]
    all_there = all(m or f.held_out for f, m in zip(reading.frames, found, strict=True))
    return found if all_there else [None] * len(found)


def _to_turn(photos: list[Photo], small: list[np.ndarray | None]) -> list[bool]:
    """Of which photos the masks are turned though their shape does not ask for it: all that EXIF
    turns by half or mirrors (or that are square), or none."""
    may = [
        m is not None
        and p.load.orientation != 1
        and turn_upright(m, p.load.orientation).shape == m.shape  # pyright: ignore[reportAttributeAccessIssue]
        for p, m in zip(photos, small, strict=True)
    ]
    looked = [k for k, possible in enumerate(may) if possible]
    looked = looked[:: max(1, len(looked) // LOOKED_AT)]
    pairs = [(_small(photos[k]).rgb, small[k], photos[k].load.orientation) for k in looked]  # pyright: ignore[reportAttributeAccessIssue]
    return may if is_turned(pairs) else [False] * len(may)  # pyright: ignore[reportArgumentType]


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
    if not asked and any(getattr(f.lens, "model", "") == PANORAMA for f in reading.frames):
        return None  # the border of a panorama is no backdrop
    looked = [_small(p).rgb for p in training[:: max(1, len(training) // LOOKED_AT)]]
    backdrop: Backdrop | None = find_backdrop(looked)
    frame = black_frame(looked) if asked or backdrop is not None else None
    if frame is not None:
        said = f"a black frame covers {100 * frame:.0f} % of each photo (bars, a fisheye's circle, "
        said += "edges of undistorted photos)"
        if asked:
            raise UserError(said, "it is no backdrop", "crop the photos, or give mask files")
        notes.append(f"{said}: it is no backdrop and gives no masks; cropped photos are better")
        return None
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
    # at full size, where the texture of a carpet is not averaged away
    several = training[:: max(1, -(-len(training) // COMPARED))]
    full = [with_decoder(p, mask=backdrop).load().mask for p in several if not asked]
    spilled = np.mean([border_share(m) > SPILL for m in full if m is not None]) if full else 0.0
    if not asked and spilled > SPILLED:
        notes.append(
            f"the borders of the photos are nearly of one colour, but masks by a threshold reach them in {spilled:.0%} of the photos: "
            "the object lies on something that is no plain backdrop, and the threshold is not used"
        )
        return None
    _, empty = judge(_named(reading, small), "the threshold")
    _say_empty(empty, notes)
    kind = "dark" if backdrop.dark else "plain"
    notes.append(
        f"masks were found by a threshold before the {kind} backdrop"
        + ("; what lies outside them is set to black" if backdrop.dark else "")
    )
    return [with_decoder(p, mask=backdrop) for p in photos], small, backdrop.dark

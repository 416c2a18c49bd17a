"""Which files of a folder are photos, and what is passed over: the one lister of all readers.

A photo may be there several times (RAW and JPEG, HEIC and JPEG, a cut-out, a layer of
RealityCapture's, the same frame twice); one file of each is taken. What is not read is said.
"""

from __future__ import annotations

import hashlib
import re
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from relit.capture.names import folded, is_hidden, stem_of
from relit.errors import UserError
from relit.images import EXTENSIONS, RAW, read_header, read_small
from relit.images.decode import DELIVERY, HEIC
from relit.masks.files import AFFIX, names_masks

IMAGE_FOLDERS = ("images", "image", "rgb", "input", "photos", "jpegimages", "imgs", "frames")
NOT_PHOTOS = ("_mask", ".mask", "_normal", "_depth", "_alpha", "_seg")  # ends of stems
NOT_PHOTO_STARTS = ("dynamic_mask_",)  # instant-ngp's: white is what moves
VIDEOS = (".mov", ".mp4", ".m4v", ".avi", ".mkv", ".webm", ".3gp", ".mts", ".insv")
FRAMES_OF_VIDEO = "take frames out of it: ffmpeg -i VIDEO -vf fps=2 -q:v 2 images/%04d.jpg"
UNREAD = (".gif", ".jxl", ".jp2", ".psd", ".tga", ".svg", ".pdf", ".ppm", ".x3f", ".pef", ".srw")
COMPANIONS = re.compile(
    r"(object_?)?(mask|silhouette|segmentation|normal|depth|matte)s?|mask_visib|gray|rgb"
    r"|images?_\d+|sparse|dense|colmap|truth|cutouts|cut-outs|instances|relit-corrections"
    r"|test|val|valid|held_?out.*|train"
)  # names of folders that other code reads, or that hold copies
TRACES = {  # what cameras leave behind: pattern -> what it is
    "*transforms*.json": "cameras of NeRF formats",
    "sparse/**/images.*": "a COLMAP model",
    "sparse/**/cameras.*": "a COLMAP model",
    "images.bin": "a COLMAP model",
    "images.txt": "a COLMAP model",
    "colmap.db": "a COLMAP database",
    "database.db": "a COLMAP database",
    "poses_bounds*.npy": "cameras of LLFF",
    "cameras*.npz": "cameras of IDR",
    "*.nvm": "cameras of VisualSFM",
    "bundle*.out": "cameras of Bundler",
    "*cameras*.xml": "cameras of Metashape",
    "keyframes/*cameras": "cameras of Polycam",
    "cameras.csv": "cameras of RealityCapture",
    "scene.mvs": "a scene of OpenMVS",
    "sfm_data*.json": "cameras of OpenMVG",
}
LOOKED_INTO = 3  # levels of sub-folders that are searched for photos when none was found
SAME_FORM = 0.02  # relative difference of width / height of two versions of one photo
COMPARED = 3  # pairs of two formats whose pictures are compared
ALIKE = 0.8  # correlation of their brightness
FEWEST = 3  # different photos; where fewer are left copies are named only


@dataclass(frozen=True)
class Listing:
    """Photos of one folder by name. masks: photo -> cut-out or mask of it that lies beside it.
    notes: on what lies there more than once."""

    photos: tuple[Path, ...]
    masks: dict[Path, Path]
    notes: tuple[str, ...]


def list_images(folder: Path) -> list[Path]:
    """Photos directly in a folder, sorted by name; masks, normals, hidden files, layers and second
    versions of a photo left out."""
    return list(listed(folder).photos)


def listed(folder: Path, duplicates: bool = False) -> Listing:
    """The photos directly in a folder. duplicates: leave out byte-identical copies as well."""
    files = pictures_in(folder)
    stems = {folded(f.stem) for f in files}
    photos = [f for f in files if not is_companion(f) and not _is_mask_of(f, stems)]
    photos, masks, notes = _without_layers(photos)
    photos, cut, more = _without_twins(photos)
    notes += more
    if duplicates:
        photos, more = _without_copies(photos)
        notes += more
    return Listing(tuple(photos), {**cut, **masks}, tuple(notes))


def pictures_in(folder: Path) -> list[Path]:
    """All pictures that can be read directly in a folder, but hidden ones, sorted by name."""
    if not folder.is_dir():
        return []
    return sorted(
        f
        for f in folder.iterdir()
        if f.suffix.lower() in EXTENSIONS and not is_hidden(f) and f.is_file()
    )


def is_companion(file: Path) -> bool:
    """Is it the mask, depth or normals of a photo by its name?"""
    stem = file.stem.lower()
    return stem.endswith(NOT_PHOTOS) or stem.startswith(NOT_PHOTO_STARTS)


def _is_mask_of(file: Path, stems: set[str]) -> bool:
    """Is it by its name the mask of another picture, of which `stems` has the stem? Photos of an
    object that is a mask are photos."""
    stem = folded(AFFIX.sub("", file.stem))
    return stem != folded(file.stem) and (stem in stems or folded(stem_of(stem)) in stems)


def image_folders(root: Path) -> list[Path]:
    """Folders in which photos of a capture lie by custom, in order of preference: images/,
    image/, ... in any letter case, the root, then copies at a lower resolution (images_2/ before
    images_8/)."""
    inside = [d for d in root.iterdir() if d.is_dir() and not is_hidden(d)] if root.is_dir() else []
    rank = {name: k for k, name in enumerate(IMAGE_FOLDERS)}
    named = [d for d in inside if d.name.lower() in rank]
    copies = [(int(m[1]), d) for d in inside if (m := re.fullmatch(r"images?_(\d+)", d.name))]
    return [
        *sorted(named, key=lambda d: (rank[d.name.lower()], d.name)),
        root,
        *(d for _, d in sorted(copies)),
    ]


def image_folder(root: Path) -> Path | None:
    """The first of `image_folders` that holds a photo; None when none does."""
    return next((d for d in image_folders(root) if list_images(d)), None)


def _without_layers(files: list[Path]) -> tuple[list[Path], dict[Path, Path], list[str]]:
    """RealityCapture's NAME.jpg.LAYER.png beside NAME.jpg: masks are kept as such, other layers
    are left out; so is NAME.jpg.png."""
    by_name = {folded(f.name): f for f in files}
    photos, masks, layers = [], {}, []
    for f in files:
        inner = stem_of(f.name)
        base = by_name.get(folded(inner)) or by_name.get(folded(inner.rpartition(".")[0]))
        if base is None or base == f:
            photos.append(f)
        elif inner.lower().endswith(".mask"):
            masks[base] = f
        else:
            layers.append(f.name)
    return photos, masks, _left_out(layers, "layers of another photo (NAME.jpg.LAYER.png)")


def _without_twins(files: list[Path]) -> tuple[list[Path], dict[Path, Path], list[str]]:
    """One file of each shot: a developed one before RAW and HEIC, the photo before its cut-out
    (which becomes its mask), floating point before a preview."""
    groups: dict[str, list[Path]] = defaultdict(list)
    for f in files:
        groups[folded(f.stem)].append(f)
    kept, masks = [], {}
    left: dict[str, list[str]] = defaultdict(list)
    contents: dict[str, list[str]] = defaultdict(list)
    for group in groups.values():
        first, *others = sorted(group, key=_rank)
        kept.append(first)
        for other in others:
            kind = _twin_kind(first, other, contents)
            if kind in ("cut-out", "mask"):
                masks[first] = other
            if kind:
                left[kind].append(other.name)
            else:
                kept.append(other)
    notes = []
    if "cut-out" in left:
        notes += [
            f"{len(left['cut-out'])} cut-outs with alpha lie beside the photo of the same name: "
            "their alpha is its mask"
        ]
    if "mask" in left:
        notes.append(
            f"{len(left['mask'])} black and white pictures lie beside the photo of the same name: "
            "they are its mask"
        )
    notes += _left_out(left["RAW"], "RAW files beside a developed photo of the same name")
    notes += _left_out(left["HEIC"], "HEIC files beside a photo of the same name")
    notes += _left_out(left["twin"], "second files of a photo in another format")
    return sorted(kept), masks, notes


def _rank(file: Path) -> tuple[int, str]:
    suffix = file.suffix.lower()
    order = ((".exr", ".hdr"), (".tif", ".tiff"), (".jpg", ".jpeg", ".jfif", ".jpe"), (".png",))
    place = next((k for k, some in enumerate(order) if suffix in some), len(order))
    late = 2 * len(order) * (suffix in RAW) + len(order) * (suffix in HEIC | DELIVERY)
    return place + late, file.name


def _twin_kind(first: Path, other: Path, contents: dict[str, list[str]]) -> str:
    """'RAW', 'HEIC', 'cut-out', 'mask' or 'twin'; '' where the two are different pictures.
    contents: what was found of earlier pairs by their extensions; a few are decoded."""
    if other.suffix.lower() == first.suffix.lower():
        return ""  # A.jpg and a.jpg
    if other.suffix.lower() in RAW:
        return "RAW"
    if other.suffix.lower() in HEIC:
        return "HEIC"
    try:
        a, b = read_header(first), read_header(other)
        turned = abs(a.width * b.width / (a.height * b.height) - 1) < SAME_FORM
        turned = turned and a.width != a.height
        if abs(a.width * b.height / (a.height * b.width) - 1) > SAME_FORM and not turned:
            return ""
        known = contents[first.suffix.lower() + other.suffix.lower()]
        if len(known) < COMPARED:
            known.append(_content(first, other, turned))
    except UserError:
        return ""  # the damaged one is refused with its reason
    kind = max(sorted(set(known)), key=known.count)
    return "cut-out" if kind == "twin" and b.alpha and not a.alpha else kind


def _content(first: Path, other: Path, turned: bool) -> str:
    """Of two pictures of one name and shape: 'mask' where the other is black and white, 'twin'
    where it is like the first (inside its alpha), else ''."""
    a, b = read_small(first, 64), read_small(other, 64)
    white, black = (b.rgb > 0.9).all(axis=-1).mean(), (b.rgb < 0.01).all(axis=-1).mean()
    if white > 0.005 and black > 0.005 and white + black > 0.85 and b.alpha is None:
        return "mask"
    if turned:
        return "twin"
    h, w = a.rgb.shape[:2]
    here = np.cbrt(np.maximum(a.rgb.mean(axis=-1), 0))
    there = np.cbrt(np.maximum(cv2.resize(b.rgb, (w, h)).mean(axis=-1), 0))
    shown = np.ones((h, w), bool) if b.alpha is None else cv2.resize(b.alpha, (w, h)) > 0.5
    flat = min(here[shown].std(), there[shown].std()) < 1e-3 if shown.any() else True
    alike = flat or np.corrcoef(here[shown], there[shown])[0, 1] > ALIKE
    return "twin" if alike else ""


def _without_copies(files: list[Path]) -> tuple[list[Path], list[str]]:
    """Without byte-identical copies, as frames of a video written at twice its rate."""
    sizes: dict[int, list[Path]] = defaultdict(list)
    for f in files:
        sizes[f.stat().st_size].append(f)
    seen: set[bytes] = set()
    copies = []
    for group in sizes.values():
        for f in sorted(group, key=lambda f: (len(f.name), f.name)) if len(group) > 1 else ():
            digest = hashlib.sha256(f.read_bytes()).digest()
            copies += [f] if digest in seen else []
            seen.add(digest)
    copies.sort()
    gone = set(copies)
    kept = [f for f in files if f not in gone]
    if copies and len(kept) < FEWEST:
        note = f"{len(copies)} of {len(files)} photos are byte-identical copies of another one"
        return files, [note]
    names = [f.name for f in copies]
    return kept, _left_out(names, "byte-identical copies of another photo")


def _left_out(names: list[str], what: str) -> list[str]:
    return [f"{len(names)} {what} are left out, for example {names[0]}"] if names else []


def passed_over(root: Path, used: Iterable[Path], cameras: str = "") -> list[str]:
    """Notes on what lies beside the photos and is not read. used: the photos and masks that are.
    cameras: the format's name, where the photos have cameras: photos without one are named."""
    used = {Path(f) for f in used}
    folders = sorted({f.parent for f in used} | {root})
    notes = []
    if cameras:
        notes += _without_cameras(root, used, cameras)
    inside = [f for d in folders if d.is_dir() for f in sorted(d.iterdir())]
    unread = _named(f for f in inside if f.suffix.lower() in UNREAD and not is_hidden(f))
    hidden = [f for f in inside if f.name.startswith("._") and f.suffix.lower() in EXTENSIONS]
    dynamic = [f for f in inside if f.stem.lower().startswith(NOT_PHOTO_STARTS)]
    notes += [f"pictures of formats that are not read were left out: {unread}"] if unread else []
    if hidden:
        notes.append(f"{len(hidden)} hidden files (._NAME, of a Mac) were left out")
    if dynamic:
        notes.append(
            f"{len(dynamic)} masks of what moves (dynamic_mask_NAME) are not used, for example "
            f"{dynamic[0].name}"
        )
    stems = {folded(f.stem) for f in used}
    videos = [f for f in inside if f.suffix.lower() in VIDEOS and folded(f.stem) not in stems]
    notes += [f"videos are not read: {_named(videos)}"] if videos else []
    others = [
        f"{d.relative_to(root).as_posix()}/ ({n})"
        for d, n in photo_folders(root, depth=1)
        if not COMPANIONS.fullmatch(d.name.lower())
        and not any(f.is_relative_to(d) for f in used)
        and d != root
    ]
    if others:
        notes.append(f"photos in sub-folders are not read: {', '.join(others[:4])}")
    return notes


def _without_cameras(root: Path, used: set[Path], cameras: str) -> list[str]:
    places = {f.parent for f in used if f.suffix.lower() in EXTENSIONS}
    places = {d for d in places if not COMPANIONS.fullmatch(d.name.lower()) or d.name == "train"}
    stems = {(f.parent, folded(f.stem)) for f in used}
    spare = [f for d in sorted(places) for f in list_images(d) if (d, folded(f.stem)) not in stems]
    return (
        [
            f"{len(spare)} photos have no camera in the {cameras} cameras and are left out, for "
            f"example {_short(spare[0], root)}"
        ]
        if spare
        else []
    )


def _short(file: Path, root: Path) -> str:
    return file.relative_to(root).as_posix() if file.is_relative_to(root) else file.name


def _named(files: Iterable[Path], most: int = 6) -> str:
    names = [f.name for f in files]
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if names[most:] else "")


def camera_traces(root: Path) -> list[str]:
    """Notes on camera files of a folder whose photos are read without cameras: in it, or in the
    folder above where this one is its images/."""
    above = root.parent if root.name.lower() in IMAGE_FOLDERS else None
    found: dict[str, Path] = {}
    for base in (root, above):
        for pattern, kind in TRACES.items() if base is not None else ():
            for file in sorted(base.glob(pattern)):  # pyright: ignore[reportOptionalMemberAccess]
                if file.stat().st_size or file.is_dir():
                    found.setdefault(kind, file)
    return [
        f"{kind} lies there and is not used, the cameras are estimated from the photos: {file}"
        for kind, file in found.items()
    ]


def photo_folders(root: Path, depth: int = LOOKED_INTO) -> list[tuple[Path, int]]:
    """Folders at or below `root` that hold photos, with how many, the root first."""
    if not root.is_dir() or is_hidden(root):
        return []
    photos = len([f for f in pictures_in(root) if not is_companion(f)])
    here = [(root, photos)] if photos else []
    if depth == 0:
        return here
    inside = sorted(d for d in root.iterdir() if d.is_dir() and not is_hidden(d))
    return here + [found for d in inside for found in photo_folders(d, depth - 1)]


def what_lies_there(root: Path) -> str:
    """What a folder in which no capture was recognised holds, for the message of the error: photos
    of sub-folders, videos, pictures that are not read, annotation files, else names."""
    said = [
        f"{d.relative_to(root).as_posix()}/ holds {n} photo{'s' if n > 1 else ''}"
        for d, n in photo_folders(root)
        if d != root and not is_mask_folder(d)
    ]
    said = said[:4] + ([f"{len(said) - 4} more folders hold photos"] if len(said) > 4 else [])
    files = sorted(f for f in root.iterdir() if f.is_file() and not is_hidden(f))
    for kind, ends, hint in (
        ("videos", VIDEOS, f" ({FRAMES_OF_VIDEO})"),
        ("pictures that are not read", UNREAD, ""),
        ("text that may be annotations", (".json", ".xml"), ""),
    ):
        some = [f for f in files if f.suffix.lower() in ends]
        said += [f"{kind}: {_named(some)}{hint}"] if some else []
    if not said:
        names = sorted(p.name + ("/" if p.is_dir() else "") for p in root.iterdir())[:8]
        said = [f"the folder holds {', '.join(names) if names else 'nothing'}"]
    return "; ".join(said)


def is_mask_folder(folder: Path) -> bool:
    """Whether a folder's name says that it holds masks."""
    return names_masks(folder.name)

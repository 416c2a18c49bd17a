"""`open_capture`: recognise what a folder holds, read it, say what was done."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np

from relit.capture import photo
from relit.capture.corrections import (
    Corrected,
    corrected_masks,
    corrected_sphere,
    with_corrected_masks,
)
from relit.capture.frames import Frame, Reading, check_max_side
from relit.capture.listing import (
    FRAMES_OF_VIDEO,
    IMAGE_FOLDERS,
    VIDEOS,
    passed_over,
    what_lies_there,
)
from relit.capture.mask_sources import masked, with_decoder
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
from relit.images import Header
from relit.masks.grabcut import grabcut
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
KINDS_OF_FILES = {  # extension -> what a file given in the place of a folder is, what to do
    **{v: ("a video", FRAMES_OF_VIDEO) for v in VIDEOS},
    **{z: ("an archive", "unpack it and give its folder") for z in (".zip", ".rar", ".7z", ".tar")},
}
MOST_LENSES = 4  # focal lengths by EXIF that are named; more are a zoom that was turned


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
    alpha channels, else mask files, else a plain backdrop, else a segmenter, else none; 'none', 'alpha', 'files',
    'threshold', 'grabcut', 'segment' ask for one kind, and 'segment:FILE.onnx' for a network of the
    user's.
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
    notes = [*reading.notes, *_size_notes(reading, headers)]
    notes += [*_lens_notes(reading, headers), *photo.camera_notes(reading.frames, headers)]
    training = sum(not f.held_out for f in reading.frames)
    if training < min_photos:
        raise UserError(
            f"{training} photo{'s are' if training != 1 else ' is'} not enough: at least {min_photos} are needed",
            "shape is found by comparing photos from different sides" + _lying_there(reading),
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
    photos, small, dark = masked(reading, headers, photos, masks, notes)
    notes += passed_over(reading.root, _files_of(reading, photos), _cameras_of(reading))
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


def _files_of(reading: Reading, photos: list[Photo]) -> list[Path]:
    """The files of the photos and of their masks."""
    masks = [f.mask for f in reading.frames] + [getattr(p.load, "mask", None) for p in photos]
    return [f.path for f in reading.frames] + [m for m in masks if isinstance(m, Path)]


def _cameras_of(reading: Reading) -> str:
    """The format's name where the photos have cameras, else ''."""
    return reading.format if any(f.camera is not None for f in reading.frames) else ""


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
    return [with_decoder(p, normal=None) for p in photos]


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
            reading = module.read(path, found)
            return _of_project(path, reading) if name == "photos" else reading
    looked = "; ".join(m.LOOKED_FOR for m in READERS.values())
    if path.is_file() and (kind := KINDS_OF_FILES.get(path.suffix.lower())):
        raise UserError(
            f"the input is {kind[0]}", "a folder of photos is expected", f"{kind[1]}: {path}"
        )
    if path.is_file():
        raise UserError(
            "the input is no capture",
            f"a folder is expected, or one of its camera files; looked for {looked}",
            f"give the folder of: {path}",
        )
    raise UserError(
        "no images were found",
        f"{what_lies_there(path)}. Looked for {looked}",
        "give the folder that holds the photos; those of several folders belong into one "
        f"images/: {path}",
    )


def _lying_there(reading: Reading) -> str:
    """What else the folder holds, for the message that photos are too few."""
    said = what_lies_there(reading.root) if reading.root.is_dir() else ""
    return f"; {said}" if said and not said.startswith("the folder holds") else ""


def _of_project(path: Path, reading: Reading) -> Reading:
    """The reading of the folder above, where `path` is its images/ and it knows the cameras of
    these photos; else the reading as it is."""
    if path.name.lower() not in IMAGE_FOLDERS:
        return reading
    cameras = [m for n, m in READERS.items() if n not in ("duplicates", "photos")]
    for module in cameras:
        found = module.recognise(path.parent)
        if found is None:
            continue
        try:
            above = module.read(path.parent, found)
        except UserError as error:
            note = f"the cameras of the folder above cannot be used ({error.what}): {found}"
            return replace(reading, notes=(*reading.notes, note))
        if above.frames and all(f.path.is_relative_to(path) for f in above.frames):
            note = f"the {above.format} cameras of the folder above are used: {found}"
            return replace(above, notes=(*above.notes, note))
        break
    return reading


def _lens_notes(reading: Reading, headers: list[Header]) -> list[str]:
    """A note where photos of one size without cameras were taken with several focal lengths."""
    focal: dict[tuple[int, int], Counter] = {}
    for frame, header in zip(reading.frames, headers, strict=True):
        if header.focal is not None and frame.camera is None:
            size = (header.width, header.height)
            focal.setdefault(size, Counter())[round(header.focal)] += 1
    return [
        f"the photos of {w} x {h} pixels have {len(counts)} focal lengths by EXIF ("
        + ", ".join(f"{n} of {f} pixels" for f, n in counts.most_common(MOST_LENSES))
        + "): each gets its own camera"
        for (w, h), counts in focal.items()
        if 1 < len(counts) <= MOST_LENSES
    ]


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

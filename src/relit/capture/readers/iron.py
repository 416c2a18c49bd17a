"""IRON, PIR: `cam_dict_norm.json` beside `image/`, in the folder itself or in `train/` and `test/`.
Photos under the camera's own flash.

The file holds, by the photo's name, K and W2C (4 x 4, row-major; OpenCV axes, pixel centres at +.5
as IRON's surface stage takes them). Photos may be PNG although the names end otherwise, or linear
EXR. Masks in `mask/` are used where they are there; IRON takes none. The cameras are normalised to
the object in the unit sphere; where it does not stand there, the sphere is found anew.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from relit.capture.frames import Frame, Reading, parse_json_file, pose_from, read_text
from relit.capture.listing import list_images, pictures_in
from relit.capture.names import stem_key
from relit.conventions import cv_from_mitsuba_axes
from relit.errors import UserError
from relit.scene import Camera, Sphere

AXES = "# OpenCV camera axes: right, down, forward"  # the first line of our own light_offset.txt
NAME = "cam_dict_norm.json"
LOOKED_FOR = f"{NAME} (IRON, PIR)"
IN_VIEW = 0.9  # share of the cameras that must have the unit sphere's centre in the picture


def recognise(path: Path) -> Path | None:
    """The camera file, or None."""
    if path.is_file():
        return path if path.name == NAME else None
    return next((p for p in (path / NAME, path / "train" / NAME) if p.is_file()), None)


def read(path: Path, found: Path) -> Reading:
    """Read the training photos, and those of `test/` as held out."""
    both = found.parent.name == "train" and path != found and path != found.parent
    root = found.parent.parent if both else found.parent
    frames = _frames(found, root, False)
    if both and (root / "test" / NAME).is_file():
        frames += _frames(root / "test" / NAME, root, True)
    masked = all(f.mask is not None for f in frames if not f.held_out)
    notes = []
    sphere = None if masked else Sphere(np.zeros(3), 1.0)
    if not masked and np.mean([_sees_origin(f.camera) for f in frames]) < IN_VIEW:  # pyright: ignore[reportArgumentType]
        sphere = None
        notes.append("the object does not stand in the unit sphere: its sphere is found anew")
    return Reading(
        "iron", root, tuple(frames), sphere=sphere, presumed=True, notes=tuple(notes), kind="flash"
    )


def _frames(file: Path, root: Path, held_out: bool) -> list[Frame]:
    content, folder = parse_json_file(file), file.parent / "image"
    photos = {stem_key(p.name): p for p in list_images(folder)}
    entries = {stem_key(name): entry for name, entry in content.items()}
    if not entries or set(photos) != set(entries):
        odd = sorted(set(photos) ^ set(entries))
        raise UserError(
            f"{len(entries)} cameras and {len(photos)} photos do not match"
            + (f", for example '{odd[0]}'" if odd else ""),
            "each photo of image/ needs its entry by name, and the other way round",
            f"add or remove photos until they agree: {file}",
        )
    frames = []
    for stem in sorted(entries):
        mask = next(
            (m for m in pictures_in(file.parent / "mask") if stem_key(m.name) == stem),
            None,
        )
        name = photos[stem].relative_to(root).as_posix()
        frames.append(
            Frame(
                photos[stem], name, _camera(entries[stem], stem, file), mask=mask, held_out=held_out
            )
        )
    return frames


def _camera(entry, stem: str, file: Path) -> Camera:
    try:
        k = np.array(entry["K"], np.float64).reshape(4, 4)
        w2c = np.array(entry["W2C"], np.float64).reshape(4, 4)
        width, height = (int(v) for v in entry["img_size"])
        if not np.isfinite(k).all() or min(k[0, 0], k[1, 1], width, height) <= 0:
            raise ValueError("focal lengths and sizes must be positive")
        pose = np.linalg.inv(w2c)
    except (KeyError, TypeError, ValueError, np.linalg.LinAlgError, OverflowError) as error:
        why = f"{type(error).__name__}: {error}"
        raise UserError(
            f"the camera of '{stem}' cannot be read",
            f"K, W2C (16 numbers each) and img_size are needed; {why}",
            f"see: {file}",
        ) from None
    return Camera(
        width, height, k[0, 0], k[1, 1], k[0, 2], k[1, 2], pose_from(pose, f"'{stem}'", file)
    )


def _sees_origin(camera: Camera) -> bool:
    u, v, z = camera.project(np.zeros(3))
    return bool(z > 1.0 and 0 < u < camera.width and 0 < v < camera.height)


def read_flash_light(root: Path) -> tuple[float | None, np.ndarray | None]:
    """The true radiant intensity (light.txt) and offset (light_offset.txt; returned in OpenCV
    camera axes), of the folder or of its test/ or train/; None for what is not there. Raises
    UserError for files that hold no such numbers.

    PIR writes the offset along Mitsuba's camera axes, left, up, forward. Relit's own captures have
    OpenCV's and say so in a first line (AXES); those of before it are told by their
    truth/truth.json.
    """
    out = []
    for name, count in (("light.txt", 1), ("light_offset.txt", 3)):
        file = next(
            (p for p in (root / name, root / "test" / name, root / "train" / name) if p.is_file()),
            None,
        )
        out.append(None if file is None else _numbers(file, count))
        if name == "light_offset.txt" and file is not None:
            ours = (
                "opencv" in read_text(file).partition("\n")[0].lower()
                or (root / "truth" / "truth.json").is_file()
            )
            out[-1] = out[-1] if ours else cv_from_mitsuba_axes(out[-1])
    return None if out[0] is None else float(out[0][0]), out[1]


def _numbers(file: Path, count: int) -> np.ndarray:
    try:
        lines = [line.partition("#")[0] for line in read_text(file).splitlines()]
        out = np.array([float(w) for w in " ".join(lines).replace(",", " ").split()])
    except ValueError:
        out = np.empty(0)
    if out.shape != (count,) or not np.isfinite(out).all():
        raise UserError(
            f"{file.name} does not hold {count} number{'s' if count > 1 else ''}",
            fix=f"write it again: {file}",
        )
    return out

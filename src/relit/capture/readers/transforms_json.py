"""NeRF-synthetic, nerfstudio and instant-ngp: `transforms*.json` with OpenGL camera axes, pixel
centres at +0.5."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from relit.capture.frames import Frame, Reading, parse_json_file, pose_from
from relit.capture.listing import image_folders
from relit.capture.names import NameIndex, path_inside
from relit.conventions import world_from_cv_camera
from relit.errors import UserError
from relit.geometry.lens import FisheyeLens
from relit.images import EXTENSIONS, read_header
from relit.scene import Camera

LOOKED_FOR = "transforms.json or transforms_train.json"
OTHERS = ("cam_dict_norm.json", "quadrants.json", "annotations.json")  # of other readers
# last what Synthetic4Relight leaves out: train/000_rgb.exr, test/000_rgba.png
SUFFIXES = (
    ".png",
    ".jpg",
    ".jpeg",
    ".exr",
    ".PNG",
    ".JPG",
    ".hdr",
    ".webp",
    "_rgb.exr",
    "_rgb.png",
    "_rgba.png",
)
PINHOLE, OPENCV, FISHEYE = (
    {"PINHOLE", "SIMPLE_PINHOLE"},
    {"OPENCV", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV"},
    {"OPENCV_FISHEYE"},
)


def recognise(path: Path) -> Path | None:
    """The JSON file of the training photos, or None."""
    if path.is_file():
        return path if path.suffix.lower() == ".json" and path.name not in OTHERS else None
    return next(
        (path / n for n in ("transforms_train.json", "transforms.json") if (path / n).is_file()),
        None,
    )


def read(path: Path, found: Path) -> Reading:
    """Read the training file and, where there is one, the test split beside it (as held-out
    frames)."""
    root, notes = found.parent, []
    data = parse_json_file(found)
    index = NameIndex(root)
    frames, missing = _frames(data, index, found)
    told = NameIndex(root)
    test = {told.find(str(n), anywhere=False) for n in _list(data.get("test_filenames"))}
    frames = [
        Frame(f.path, f.name, f.camera, f.lens, f.mask, f.held_out or f.path in test)
        for f in frames
    ]
    test = root / "transforms_test.json"
    if test.is_file() and test != found:
        held, gone = _frames(parse_json_file(test), index, test)
        frames += [Frame(f.path, f.name, f.camera, f.lens, f.mask, True) for f in held]
        if gone:
            notes.append(
                f"{len(gone)} test photos named in {test.name} are not there and were left out"
            )
    _complain(found, frames, missing, notes)
    notes += index.notes(f"photos of {found.name}")
    if data.get("from_na") is True:
        notes.append("the poses have OpenCV camera axes (from_na of NeuS2)")
    return Reading("transforms", root, tuple(frames), notes=tuple(notes))


def _complain(found: Path, frames: list[Frame], missing: list[str], notes: list[str]) -> None:
    present = sum(not f.held_out for f in frames)
    if present == 0 or len(missing) > present + 1:
        example = f", for example '{missing[0]}'" if missing else ""
        raise UserError(
            f"{len(missing)} of {len(missing) + present} photos in {found.name} are not there{example}",
            "the images and the cameras do not belong together, or the images were renamed or not copied",
            f"put the images where file_path says, or correct it: {found}",
        )
    if missing:
        notes.append(
            f"{len(missing)} photos named in {found.name} are not there and were left out, for example {missing[0]}"
        )
    moved = sum(f.held_out for f in frames)
    if moved:
        notes.append(f"{moved} photos are set aside for testing")


def _list(value) -> list:
    return value if isinstance(value, list) else []


def _frames(data: dict, index: NameIndex, source: Path) -> tuple[list[Frame], list[str]]:
    """-> (frames whose file is there, names whose file is not)."""
    root = index.root
    entries = data.get("frames")
    if not isinstance(entries, list) or not entries:
        raise UserError(
            "a transforms file has no frames",
            "the key 'frames' must be a list of photos with their poses",
            f"write it again: {source}",
        )
    found, missing = [], []
    # test/ of a split with a file of its own holds other photos, of the same names
    prefixes = (
        ("heldout", "held_out")
        if (root / "transforms_test.json").is_file()
        else ("heldout", "held_out", "test")
    )
    asides = [
        d for d in sorted(root.iterdir()) if d.is_dir() and d.name.lower().startswith(prefixes)
    ]
    for i, entry in enumerate(entries):
        what = f"frame {i}"
        if (
            not isinstance(entry, dict)
            or not isinstance(entry.get("file_path"), str)
            or not entry["file_path"]
        ):
            raise UserError(
                f"{what} of a transforms file has no file_path",
                "each frame names its photo",
                f"write it again: {source}",
            )
        what = f"'{entry['file_path'][:200]}'"
        pose = pose_from(entry.get("transform_matrix"), what, source)
        if data.get("from_na") is not True:  # NeuS2's own poses have OpenCV axes already
            pose = world_from_cv_camera(pose)
        file, aside = _image_file(entry["file_path"], index, asides, source)
        if file is None:
            missing.append(entry["file_path"])
            continue
        camera, lens = _camera({**data, **entry}, pose, file, what, source)
        mask = entry.get("mask_path")
        mask = _mask_file(mask, index, source) if isinstance(mask, str) and mask else None
        found.append(Frame(file, file.relative_to(root).as_posix(), camera, lens, mask, aside))
    return found, missing


def _mask_file(name: str, index: NameIndex, source: Path) -> Path:
    """The file of mask_path, be it there or not."""
    return index.find(name, anywhere=False) or path_inside(index.root, name, source)


def _image_file(
    name: str, index: NameIndex, asides: list[Path], source: Path
) -> tuple[Path | None, bool]:
    """The file that file_path means (its extension may be left out), and whether it lies in a
    folder of held-out photos."""
    try:
        wanted = path_inside(index.root, name, source)
    except UserError:
        file = index.find(name, (index.root, *image_folders(index.root)), anywhere=False)
        if file is None:
            raise
        return file, file.parent in asides
    file, aside = _by_suffix(wanted, asides)
    if file is None:
        file = index.find(name, (index.root, *image_folders(index.root)), anywhere=False)
        aside = file is not None and file.parent in asides
    return file, aside


def _by_suffix(wanted: Path, asides: list[Path]) -> tuple[Path | None, bool]:
    for folder, aside in [
        (wanted.parent, False),
        *((d, True) for d in asides if d != wanted.parent),
    ]:
        exact = folder / wanted.name
        try:
            if exact.is_file() and exact.suffix.lower() in EXTENSIONS:
                return exact, aside
            for suffix in SUFFIXES:
                if (folder / (wanted.name + suffix)).is_file():
                    return folder / (wanted.name + suffix), aside
        except OSError:  # a name that the file system cannot hold
            return None, False
    return None, False


def _number(
    data: dict, key: str, what: str, source: Path, default: float | None = None
) -> float | None:
    if data.get(key) is None:
        return default
    try:
        value = float(data[key])
    except (TypeError, ValueError, OverflowError):
        value = math.nan
    if not math.isfinite(value):
        raise UserError(
            f"{key} of {what} is not a number",
            f"it is {str(data[key])[:80]!r}",
            f"write it again: {source}",
        )
    return value


def _with_matrix(data: dict, what: str, source: Path) -> dict:
    """The entry with fl_x, fl_y, cx, cy of NeuS2's intrinsic_matrix, where it has one."""
    if data.get("intrinsic_matrix") is None:
        return data
    try:
        k = np.array(data["intrinsic_matrix"], dtype=np.float64)
        named = {"fl_x": k[0, 0], "fl_y": k[1, 1], "cx": k[0, 2], "cy": k[1, 2]}
        if not np.isfinite(list(named.values())).all():
            raise ValueError("not finite")
    except (TypeError, ValueError, IndexError, OverflowError) as error:
        raise UserError(
            f"intrinsic_matrix of {what} is no matrix of numbers",
            str(error)[:100],
            f"write it again: {source}",
        ) from None
    return {**named, **{k: v for k, v in data.items() if v is not None}}


def _camera(data: dict, pose: np.ndarray, file: Path, what: str, source: Path):
    """-> (Camera, lens or None) in the pixels that w and h declare, or the file's own where they
    are not given."""

    def number(key, default=None):
        return _number(data, key, what, source, default)

    w, h = number("w"), number("h")
    if w is None or h is None:
        header = read_header(file)
        w, h = header.as_stored
    data = _with_matrix(data, what, source)
    fx = number("fl_x") or number("focal")
    if not fx:
        angle = number("camera_angle_x")
        if angle is None or not 1e-3 < angle < math.pi - 1e-3:
            raise UserError(
                f"{what} has no focal length",
                "neither fl_x nor camera_angle_x (radians) is given, or it is out of range",
                f"add it to: {source}",
            )
        fx = 0.5 * w / math.tan(0.5 * angle)
    fy = number("fl_y") or fx
    if not (0 < fx < 1e7 and 0 < fy < 1e7 and 1 <= w < 1e6 and 1 <= h < 1e6):
        raise UserError(
            f"the intrinsics of {what} are out of range",
            f"fl_x {fx:g}, fl_y {fy:g}, w {w:g}, h {h:g}",
            f"correct them in: {source}",
        )
    model = str(
        data.get("camera_model")
        or ("OPENCV_FISHEYE" if data.get("is_fisheye") is True else "OPENCV")
    ).upper()
    if model not in PINHOLE | OPENCV | FISHEYE:
        raise UserError(
            f"the camera model '{model[:40]}' of {what} is not known",
            fix=f"use one of {', '.join(sorted(PINHOLE | OPENCV | FISHEYE))}: {source}",
        )
    k = [number(f"k{i}", 0.0) for i in range(1, 7)]
    distortion, lens = (), None
    if model in FISHEYE:
        lens = FisheyeLens(tuple(k[:4]))  # pyright: ignore[reportArgumentType]
    elif model in OPENCV:
        full = (k[0], k[1], number("p1", 0.0), number("p2", 0.0), k[2], k[3], k[4], k[5])
        if model != "FULL_OPENCV" and (
            k[3] or k[4] or k[5]
        ):  # k4 of nerfstudio's plain model is a fourth radial term, not a denominator
            raise UserError(
                f"{what} has radial terms beyond k3",
                "they are known only for FULL_OPENCV and OPENCV_FISHEYE",
                f"undistort the images first: {source}",
            )
        last = max((i + 1 for i, v in enumerate(full) if v), default=0)
        distortion = full[: (0 if last == 0 else 4 if last <= 4 else 5 if last == 5 else 8)]
    camera = Camera(
        round(w),
        round(h),
        fx,
        fy,
        number("cx", w / 2),  # pyright: ignore[reportArgumentType]
        number("cy", h / 2),  # pyright: ignore[reportArgumentType]
        pose,
        distortion,  # pyright: ignore[reportArgumentType]
    )
    return camera, lens

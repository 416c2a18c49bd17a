"""COLMAP models, binary or text, read by pycolmap; OpenCV axes, pixel centres at +0.5. Of several
models the one that belongs to the photos is taken."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from relit.capture.frames import Frame, Reading
from relit.capture.listing import image_folders
from relit.capture.names import NameIndex, path_inside
from relit.capture.readers.colmap_complete import load_model, model_ending, name_of
from relit.device import load_pycolmap
from relit.errors import UserError
from relit.geometry.lens import FisheyeLens, Lens
from relit.images import read_header
from relit.scene import Camera

LOOKED_FOR = "sparse/ with cameras and images as .bin or .txt (COLMAP)"
ONE_FOCAL = {  # models of COLMAP with parameters f, cx, cy, ...
    "SIMPLE_PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "SIMPLE_FISHEYE",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
}
TWO_FOCAL = {"PINHOLE", "OPENCV", "FULL_OPENCV", "FISHEYE", "OPENCV_FISHEYE"}  # fx, fy, cx, cy, ...
MAX_ERROR = 2.0  # pixels; sparse points with a larger reprojection error are not used


@dataclass(frozen=True)
class ColmapLens:
    """Any lens that COLMAP knows: model name and parameters as COLMAP orders them, for the image
    size that they were fitted to."""

    model: str
    width: int
    height: int
    parameters: tuple[float, ...]

    @cached_property
    def _camera(self):
        pycolmap = load_pycolmap()

        return pycolmap.Camera(
            model=self.model, width=self.width, height=self.height, params=list(self.parameters)
        )

    def __call__(self, xy: np.ndarray) -> np.ndarray:
        c = self._camera
        pixels = c.img_from_cam(np.concatenate([xy, np.ones((len(xy), 1))], axis=1))
        return (pixels - centre_of(c)) / focal_of(c)


def model_folders(path: Path) -> list[Path]:
    """Folders at or below `path` that hold a model, in the places where COLMAP and nerfstudio put
    them. points3D may be missing."""
    dense = path / "dense"
    parts = sorted(d / "sparse" for d in dense.iterdir()) if dense.is_dir() else []
    tops = [path, path / "sparse", path / "colmap" / "sparse", dense / "sparse", *parts]
    places = [
        d
        for top in tops
        if top.is_dir()
        for d in (top, *sorted(x for x in top.iterdir() if x.is_dir()))
    ]
    return [d for d in dict.fromkeys(places) if model_ending(d) is not None]


def recognise(path: Path) -> Path | None:
    """The first folder with a model, or None."""
    return next(iter(model_folders(path)), None) if path.is_dir() else None


@dataclass(frozen=True)
class Located:
    """A model and where its photos lie. files: of each registered image (pycolmap.Image, by name)
    its photo, or None. index: how they were found."""

    model: Any
    folder: Path
    root: Path
    base: Path
    files: tuple[tuple[Any, Path | None], ...]
    index: NameIndex
    notes: tuple[str, ...]

    @cached_property
    def rank(self) -> tuple[int, int, int]:
        """Photos of exactly the calibrated size, photos that are there, images: the model that
        belongs to the photos has most. Of a workspace with sparse/ and dense/0/ the photos that
        are there may be the undistorted ones."""
        there = [(i, f) for i, f in self.files if f is not None]
        exact = sum(read_header(f).as_stored == _size(i.camera) for i, f in there)
        return exact, len(there), len(self.files)


def read(path: Path, found: Path) -> Reading:
    """Read the model that belongs to the photos; of several such the largest."""
    folders = model_folders(path)
    located = [_located(path, folder) for folder in folders]
    chosen = max(located, key=lambda m: m.rank) if len(located) > 1 else located[0]
    notes = list(chosen.notes)
    if len(located) > 1:
        sizes = ", ".join(str(len(m.files)) for m in located)
        largest = sum(len(m.files) >= len(chosen.files) for m in located) == 1
        which = "the largest" if largest else "the one that belongs to the photos"
        notes.append(
            f"{len(located)} COLMAP models with {sizes} photos: {which} was read "
            f"({chosen.folder.relative_to(path)})"
        )
    try:
        frames = tuple(_frames(chosen, notes))
    except (RuntimeError, ValueError, IndexError, ZeroDivisionError) as error:
        raise _unusable("used", error, chosen.folder) from None
    points = sparse_points(chosen.model)
    return Reading("colmap", chosen.root, frames, points=points, notes=tuple(notes))


def _size(camera) -> tuple[int, int]:
    return camera.width, camera.height


def _unusable(what: str, error: Exception, folder: Path) -> UserError:
    reason = (str(error).splitlines() or [type(error).__name__])[0]
    return UserError(f"a COLMAP model cannot be {what}", reason[:200], f"export it again: {folder}")


def _located(path: Path, folder: Path) -> Located:
    """Load a model and find its photos."""
    try:
        model, notes = load_model(folder)
        images = sorted((model.image(i) for i in model.reg_image_ids()), key=name_of)  # pyright: ignore[reportAttributeAccessIssue]
    except (RuntimeError, ValueError, IndexError, MemoryError, OSError, struct.error) as error:
        raise _unusable("read", error, folder) from error
    root = path
    if path == folder:
        above = (folder, *folder.parents[:2])
        root = next((p for p in above if len(image_folders(p)) > 1), folder)
    # the images beside the model (dense/images with dense/sparse) before those of the folder that
    # was opened
    places = [
        p
        for p in dict.fromkeys((folder.parent, folder.parent.parent, root))
        if p.is_relative_to(root)
    ]
    bases = [d for p in places for d in image_folders(p) if d != p] or [root]
    index = NameIndex(root)
    files = [index.find(name_of(i), bases, anywhere=False) for i in images]
    if not any(files):  # of photos that are partly there no others are taken
        files = [index.find(name_of(i), bases) for i in images]
    for image, file in zip(images, files, strict=True):
        if file is None:
            path_inside(bases[0], name_of(image), folder)
    pairs = tuple(zip(images, files, strict=True))
    return Located(model, folder, root, bases[0], pairs, index, tuple(notes))


def _frames(located: Located, notes: list[str]) -> list[Frame]:
    root, frames, missing = located.root, [], []
    for image, file in located.files:
        if file is None:
            missing.append(name_of(image))
            continue
        camera, lens = camera_from_colmap(image.camera, world_from_camera(image))
        numbers = [
            camera.fx,
            camera.fy,
            camera.cx,
            camera.cy,
            *camera.distortion,
            *camera.world_from_camera.ravel(),
        ]
        if (
            min(camera.width, camera.height, camera.fx, camera.fy) <= 0
            or not np.isfinite(numbers).all()
            or not is_pose(camera)
        ):
            raise ValueError(f"the camera of {image.name} makes no sense")
        frames.append(Frame(file, file.relative_to(root).as_posix(), camera, lens))
    if not frames or len(missing) > len(frames) + 1:
        example = f", for example '{missing[0]}'" if missing else ""
        raise UserError(
            f"{len(missing)} of {len(located.files)} photos of the COLMAP model are not there"
            + example,
            "the images and the cameras do not match by name"
            if missing
            else "the model registers no image",
            f"put the images in: {located.base}",
        )
    notes += located.index.notes("photos of the COLMAP model")
    if missing:
        notes.append(
            f"{len(missing)} photos of the COLMAP model are not there and were left out, for example {missing[0]}"
        )
    return frames


def is_pose(camera: Camera) -> bool:
    """Is the rotation one? A damaged quaternion may be zero."""
    return abs(np.linalg.det(camera.world_from_camera[:3, :3]) - 1) < 1e-3


def world_from_camera(image) -> np.ndarray:
    """(4, 4) pose of a pycolmap.Image."""
    out = np.eye(4)
    out[:3] = image.cam_from_world().inverse().matrix()
    return out


def sparse_points(model) -> np.ndarray | None:
    """(N, 3) points seen by at least three photos with a small reprojection error (two, where that
    leaves fewer than 50)."""
    rows = [(p.xyz, p.track.length(), p.error) for p in model.points3D.values()]
    for least in (3, 2):
        kept = np.array(
            [xyz for xyz, n, e in rows if n >= least and e < MAX_ERROR and np.isfinite(xyz).all()]
        )
        if len(kept) >= 50:
            return kept
    return kept if len(kept) else None


def camera_from_colmap(camera, pose: np.ndarray) -> tuple[Camera, Lens | None]:
    """pycolmap.Camera and a pose -> (Camera, lens or None for a pinhole or OpenCV's model)."""
    model, p = camera.model.name, [float(v) for v in camera.params]
    lens: Lens | None = None
    distortion: tuple[float, ...] = ()
    if model not in ONE_FOCAL | TWO_FOCAL:
        fx = fy = focal_of(camera)
        cx, cy = centre_of(camera)
        lens = ColmapLens(model, camera.width, camera.height, tuple(p))
        return Camera(camera.width, camera.height, fx, fy, cx, cy, pose, distortion), lens
    fx, fy, cx, cy, *k = [p[0], *p] if model in ONE_FOCAL else p
    if "FISHEYE" in model:
        lens = FisheyeLens(tuple(k))
    elif model == "SIMPLE_RADIAL":
        distortion = (k[0], 0.0, 0.0, 0.0)
    elif model == "RADIAL":
        distortion = (k[0], k[1], 0.0, 0.0)
    elif model in ("OPENCV", "FULL_OPENCV"):
        distortion = tuple(k)
    return Camera(camera.width, camera.height, fx, fy, cx, cy, pose, distortion), lens


def focal_of(camera) -> float:
    """Pixels per radian (a panorama) or per unit at depth 1 of a pycolmap.Camera."""
    if camera.model.name == "EQUIRECTANGULAR":
        return camera.width / (2 * np.pi)
    return camera.mean_focal_length()


def centre_of(camera) -> tuple[float, float]:
    """The principal point of a pycolmap.Camera, of a panorama its middle, in pixels."""
    if camera.model.name == "EQUIRECTANGULAR":
        return camera.width / 2, camera.height / 2
    return camera.principal_point_x, camera.principal_point_y

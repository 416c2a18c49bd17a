"""COLMAP models, binary or text, read by pycolmap; OpenCV axes, pixel centres at +0.5. The largest
of several models is taken."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from relit.capture.frames import IMAGE_FOLDERS, Frame, Reading, path_inside
from relit.capture.readers.colmap_binary import check_binary
from relit.device import load_pycolmap
from relit.errors import UserError
from relit.geometry.lens import FisheyeLens, Lens
from relit.images import EXTENSIONS
from relit.scene import Camera

LOOKED_FOR = "sparse/ with cameras, images and points3D as .bin or .txt (COLMAP)"
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
        return (pixels - (c.principal_point_x, c.principal_point_y)) / (
            c.mean_focal_length(),
            c.mean_focal_length(),
        )


def model_folders(path: Path) -> list[Path]:
    """Folders at or below `path` that hold a model, in the places where COLMAP and nerfstudio put
    them."""
    tops = [path, path / "sparse", path / "colmap" / "sparse", path / "dense" / "sparse"]
    places = [
        d
        for top in tops
        if top.is_dir()
        for d in (top, *sorted(x for x in top.iterdir() if x.is_dir()))
    ]
    unique = dict.fromkeys(places)
    return [
        d
        for d in unique
        if any(
            all((d / f"{n}.{e}").is_file() for n in ("cameras", "images", "points3D"))
            for e in ("bin", "txt")
        )
    ]


def recognise(path: Path) -> Path | None:
    """The first folder with a model, or None."""
    return next(iter(model_folders(path)), None) if path.is_dir() else None


def read(path: Path, found: Path) -> Reading:
    """Read the largest model."""
    pycolmap = load_pycolmap()

    models, notes = [], []
    for folder in model_folders(path):
        try:
            check_binary(folder)
            models.append((pycolmap.Reconstruction(str(folder)), folder))
        except (RuntimeError, ValueError, IndexError, MemoryError, OSError) as error:
            raise UserError(
                "a COLMAP model cannot be read",
                str(error).splitlines()[0][:200],
                f"export it again: {folder}",
            ) from error
    model, folder = max(models, key=lambda m: m[0].num_reg_images())
    if len(models) > 1:
        sizes = ", ".join(str(m.num_reg_images()) for m, _ in models)
        notes.append(
            f"{len(models)} COLMAP models with {sizes} photos: the largest was read ({folder.relative_to(path)})"
        )
    root = (
        path
        if path != folder
        else next(
            (
                p
                for p in (folder, *folder.parents[:2])
                if any((p / n).is_dir() for n in IMAGE_FOLDERS)
            ),
            folder,
        )
    )
    try:
        frames = tuple(_frames(model, root, folder, notes))
    except (RuntimeError, ValueError, IndexError, ZeroDivisionError) as error:
        raise UserError(
            "a COLMAP model cannot be used",
            str(error).splitlines()[0][:200],
            f"export it again: {folder}",
        ) from None
    return Reading("colmap", root, frames, points=sparse_points(model), notes=tuple(notes))


def _frames(model, root: Path, folder: Path, notes: list[str]) -> list[Frame]:
    # the images beside the model (dense/images with dense/sparse) before those of the folder that
    # was opened
    places = [
        p
        for p in dict.fromkeys((folder.parent, folder.parent.parent, root))
        if p.is_relative_to(root)
    ]
    base = next((p / n for p in places for n in IMAGE_FOLDERS if (p / n).is_dir()), root)
    images = [model.image(i) for i in model.reg_image_ids()]
    named = {path_inside(base, i.name, folder) for i in images}  # these belong to their own cameras
    spare = [
        f for f in sorted(base.rglob("*")) if f.suffix.lower() in EXTENSIONS and f not in named
    ]
    by_name, by_stem = _unique(spare, "name"), _unique(spare, "stem")
    frames, missing = [], []
    for image in sorted(images, key=lambda i: i.name):
        file = path_inside(base, image.name, folder)
        file = (
            file
            if file.is_file()
            else by_name.get(Path(image.name).name) or by_stem.get(Path(image.name).stem)
        )
        if file is None:
            missing.append(image.name)
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
        raise UserError(
            f"{len(missing)} of {len(missing) + len(frames)} photos of the COLMAP model are not there, for example '{missing[0]}'",
            "the images and the cameras do not match by name",
            f"put the images in: {base}",
        )
    if missing:
        notes.append(
            f"{len(missing)} photos of the COLMAP model are not there and were left out, for example {missing[0]}"
        )
    return frames


def _unique(files: list[Path], key: str) -> dict[str, Path]:
    """name or stem -> file, of those that only one file has."""
    counts = Counter(getattr(f, key) for f in files)
    return {getattr(f, key): f for f in files if counts[getattr(f, key)] == 1}


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
    single = model in (
        "SIMPLE_PINHOLE",
        "SIMPLE_RADIAL",
        "RADIAL",
        "SIMPLE_RADIAL_FISHEYE",
        "RADIAL_FISHEYE",
    )
    fx, fy, cx, cy, *k = [p[0], *p] if single else p
    lens: Lens | None = None
    distortion: tuple[float, ...] = ()
    if model in ("SIMPLE_PINHOLE", "PINHOLE"):
        pass
    elif model == "SIMPLE_RADIAL":
        distortion = (k[0], 0.0, 0.0, 0.0)
    elif model == "RADIAL":
        distortion = (k[0], k[1], 0.0, 0.0)
    elif model in ("OPENCV", "FULL_OPENCV"):
        distortion = tuple(k)
    elif model in ("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE"):
        lens = FisheyeLens(tuple(k))
    else:
        fx = fy = camera.mean_focal_length()
        cx, cy = camera.principal_point_x, camera.principal_point_y
        lens = ColmapLens(model, camera.width, camera.height, tuple(p))
    return Camera(camera.width, camera.height, fx, fy, cx, cy, pose, distortion), lens

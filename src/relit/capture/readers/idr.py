"""IDR, NeuS, DTU: `cameras_sphere.npz` or `cameras.npz` with world_mat_i = K [R | t] (4 x 4,
OpenCV) and scale_mat_i.

scale_mat carries the unit sphere that holds the object into the world. Pixel centres lie at whole
numbers (the loaders of IDR and NeuS sample rays there), so half a pixel is added to the principal
point. Photos are matched to matrices by their order of name.

WildLight writes besides light_energy_i, the energy of the flash in three channels; where some
photos have it, the others had no flash.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.linalg import rq

from relit.capture.frames import Frame, Reading
from relit.capture.listing import image_folder, list_images
from relit.conventions import scale_of
from relit.errors import UserError
from relit.files import NO_ARRAYS
from relit.images import read_header
from relit.scene import Camera, Sphere

LOOKED_FOR = "cameras_sphere.npz or cameras.npz (IDR, NeuS)"


def recognise(path: Path) -> Path | None:
    """The camera file, or None."""
    if path.is_file():
        return path if path.name in ("cameras_sphere.npz", "cameras.npz") else None
    return next(
        (path / n for n in ("cameras_sphere.npz", "cameras.npz") if (path / n).is_file()), None
    )


def read(path: Path, found: Path) -> Reading:
    """Read the camera file. The frame is the world's; the object sphere is scale_mat's."""
    try:
        with np.load(found, allow_pickle=False) as data:
            arrays = {
                k: data[k]
                for k in data.files
                if k.startswith(("world_mat_", "scale_mat_", "light_energy_")) and "inv" not in k
            }
    except NO_ARRAYS as error:
        raise UserError(
            "a camera file cannot be read", str(error), f"write it again: {found}"
        ) from error
    indices = sorted(int(k[10:]) for k in arrays if k.startswith("world_mat_") and k[10:].isdigit())
    folder = image_folder(found.parent)
    files = list_images(folder) if folder else []
    if not indices or len(files) != len(indices):
        raise UserError(
            f"{len(indices)} cameras and {len(files)} photos do not match",
            f"each world_mat_i belongs to the i-th photo by name in {folder.name if folder else 'image'}/",
            f"add or remove photos until the numbers agree: {found}",
        )
    energies = flash_energies(arrays, indices, found)
    frames = []
    for index, file in zip(indices, files, strict=True):
        world_mat = arrays[f"world_mat_{index}"]
        if world_mat.shape not in ((4, 4), (3, 4)) or not np.isfinite(world_mat).all():
            raise UserError(
                f"world_mat_{index} is not a 4 x 4 matrix of finite numbers",
                fix=f"write it again: {found}",
            )
        k, pose = decompose_projection(world_mat[:3], f"world_mat_{index}", found)
        header = read_header(file)
        camera = Camera(*header.as_stored, k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5, pose)
        frames.append(
            Frame(
                file,
                file.relative_to(found.parent).as_posix(),
                camera,
                flash_energy=energies.get(index),
            )
        )
    scale_mat = arrays.get(f"scale_mat_{indices[0]}")
    sphere = None
    if scale_mat is not None:
        if (
            scale_mat.shape != (4, 4)
            or not np.isfinite(scale_mat).all()
            or not scale_of(scale_mat) > 0
        ):
            raise UserError(
                f"scale_mat_{indices[0]} is not a similarity",
                "it must scale evenly and move",
                f"write it again: {found}",
            )
        sphere = Sphere(scale_mat[:3, 3].astype(np.float64), scale_of(scale_mat))
    return Reading("idr", found.parent, tuple(frames), sphere=sphere)


def flash_energies(
    arrays: dict[str, np.ndarray], indices: list[int], source: Path
) -> dict[int, float]:
    """Mean over the channels of light_energy_i for each photo, 0 where the file has none for it;
    nothing where it has none at all."""
    if not any(k.startswith("light_energy_") for k in arrays):
        return {}
    out = {}
    for index in indices:
        energy = np.asarray(arrays.get(f"light_energy_{index}", 0.0))
        if (
            energy.dtype.kind not in "fiu"
            or not energy.size
            or not np.isfinite(energy).all()
            or (energy < 0).any()
        ):
            why = "it must be finite and not negative"
            raise UserError(
                f"light_energy_{index} is not the energy of a flash",
                why,
                f"write it again: {source}",
            )
        out[index] = float(energy.mean())
    return out


def decompose_projection(p: np.ndarray, what: str, source: Path) -> tuple[np.ndarray, np.ndarray]:
    """P = K [R | t] (3, 4), up to scale -> (K with K[2, 2] = 1, world_from_camera (4, 4)). Hartley
    and Zisserman, section 6.2.4."""
    p = np.asarray(p, dtype=np.float64)
    det = np.linalg.det(p[:, :3])
    if abs(det) < 1e-12 * max(np.abs(p[:, :3]).max(), 1e-300) ** 3:
        raise UserError(
            f"{what} is not a projection",
            "its left 3 x 3 part is singular",
            f"write it again: {source}",
        )
    p = p * np.sign(det)
    k, r = rq(p[:, :3])
    signs = np.sign(np.diag(k))
    k, r = k * signs, signs[:, None] * r
    pose = np.eye(4)
    pose[:3, :3] = r.T
    pose[:3, 3] = -np.linalg.solve(p[:, :3], p[:, 3])
    k = k / k[2, 2]
    if abs(k[0, 1]) > 1e-3 * k[0, 0]:
        raise UserError(
            f"{what} has skewed pixels",
            f"skew {k[0, 1]:.3g} beside a focal length of {k[0, 0]:.3g}",
            f"rectify the images: {source}",
        )
    return k, pose

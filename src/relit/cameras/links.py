"""Which photos of a collection can be linked by matching features on the object, and how they lie
to each other.

Photos from anywhere share no surroundings and no camera: features are looked for inside the masks
only, all pairs are matched and verified, and every photo has a focal length of its own. What COLMAP
can put together are groups of photos with relative poses: evidence for the search, never a demand
on the capture.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from relit.cameras.sfm import quiet
from relit.capture.readers.colmap_model import camera_from_colmap, sparse_points, world_from_camera
from relit.device import load_pycolmap
from relit.images import write_data, write_srgb

SIDE = 1600  # pixels, longest side of the copies that are matched
MATCHES = 15  # verified ones that link two photos
LEAST = 4  # photos of a group
ERROR = 2.5  # pixels of mean reprojection error above which a group is not believed


@dataclass(frozen=True)
class Group:
    """photos: (n,) numbers. poses: (n, 4, 4) world_from_camera (OpenCV axes) in a frame of the
    group's own, of arbitrary scale. focals: (n,) in units of the photo's longer side. points: (M,
    3) on the object. views: (M,) how many photos see each."""

    photos: np.ndarray
    poses: np.ndarray
    focals: np.ndarray
    points: np.ndarray
    views: np.ndarray


def link_photos(
    photos: Sequence[tuple[np.ndarray, np.ndarray, float]],
    workdir: Path,
    seed: int = 0,
    say: Callable[[str], None] = lambda line: None,
) -> list[Group]:
    """Groups of linked photos, the largest first; none where nothing matches.

    photos: (rgb (H, W, 3) linear, mask (H, W), focal length in pixels of it or 0 where unknown).
    workdir: a folder, made and removed.
    """
    pycolmap = load_pycolmap()
    workdir = Path(workdir)
    shutil.rmtree(workdir, ignore_errors=True)
    for name in ("images", "masks", "models"):
        (workdir / name).mkdir(parents=True)
    try:
        with quiet(pycolmap):
            models = _map(pycolmap, photos, workdir, seed)
            groups = sorted((_group(m) for m in models), key=lambda g: -len(g.photos))
    finally:
        shutil.rmtree(workdir, ignore_errors=True)
    taken: set[int] = set()
    kept = []
    for group in groups:
        if len(group.photos) >= LEAST and not taken & set(group.photos.tolist()):
            kept.append(group)
            taken |= set(group.photos.tolist())
    say(
        f"{len(taken)} of {len(photos)} photos are linked by matches on the object, in {len(kept)} groups"
    )
    return kept


def _map(pycolmap, photos, workdir: Path, seed: int) -> list:
    database, images, threads = (
        workdir / "database.db",
        workdir / "images",
        min(4, os.cpu_count() or 1),
    )
    pycolmap.set_random_seed(seed)
    side = max(max(rgb.shape[:2]) for rgb, _, _ in photos)
    extraction = pycolmap.FeatureExtractionOptions(num_threads=threads, use_gpu=False)
    extraction.sift.peak_threshold = 0.003
    extraction.sift.max_num_features = 4096
    extraction.sift.first_octave = 0 if side > 700 else -1
    for i, (rgb, mask, focal) in enumerate(photos):
        _write(workdir, i, rgb, mask)
        h, w = rgb.shape[:2]
        s = min(1.0, SIDE / max(h, w))
        reader = pycolmap.ImageReaderOptions(
            camera_model="SIMPLE_RADIAL", mask_path=str(workdir / "masks")
        )
        if focal > 0:
            reader.camera_params = f"{focal * s:.3f},{round(w * s) / 2},{round(h * s) / 2},0"
        pycolmap.extract_features(
            database,
            images,
            [_name(i)],
            pycolmap.CameraMode.PER_IMAGE,
            reader,
            extraction,
            device=pycolmap.Device.cpu,
        )
    matching = pycolmap.FeatureMatchingOptions(
        num_threads=threads, use_gpu=False, guided_matching=True
    )
    verification = pycolmap.TwoViewGeometryOptions(min_num_inliers=MATCHES)
    verification.ransac.random_seed = seed
    pycolmap.match_exhaustive(
        database, matching, verification_options=verification, device=pycolmap.Device.cpu
    )
    o = pycolmap.IncrementalPipelineOptions(
        num_threads=threads, random_seed=seed, extract_colors=False
    )
    o.min_model_size, o.min_num_matches, o.max_num_models = LEAST, MATCHES, 10
    o.mapper.init_min_num_inliers, o.mapper.init_min_tri_angle = 30, 8.0
    o.mapper.abs_pose_min_num_inliers, o.mapper.abs_pose_min_inlier_ratio = 12, 0.15
    try:
        models = pycolmap.incremental_mapping(database, images, workdir / "models", o)
    except (RuntimeError, ValueError):  # pycolmap's word for "no first pair"
        return []
    out = []
    for model in models.values():
        model.update_point_3d_errors()
        if model.compute_mean_reprojection_error() < ERROR:
            out.append(model)
    return out


def _group(model) -> Group:
    images = [model.image(i) for i in model.reg_image_ids()]
    numbers = np.array([int(i.name[:5]) for i in images])
    order = np.argsort(numbers)
    cameras = [camera_from_colmap(images[k].camera, world_from_camera(images[k]))[0] for k in order]
    focals = np.array([c.fx / max(c.width, c.height) for c in cameras])
    views = np.array([p.track.length() for p in model.points3D.values()])
    return Group(
        numbers[order],
        np.array([c.world_from_camera for c in cameras]),
        focals,
        sparse_points(model),  # pyright: ignore[reportArgumentType]
        views,
    )


def _write(workdir: Path, i: int, rgb: np.ndarray, mask: np.ndarray) -> None:
    """A copy on a grey scale of its own, and the mask a little grown, so that the outline's own
    corners are not cut."""
    h, w = rgb.shape[:2]
    s = min(1.0, SIDE / max(h, w))
    size = (max(1, round(w * s)), max(1, round(h * s)))
    inside = rgb[mask > 0.5]
    level = float(np.percentile(inside, 95)) if len(inside) else 1.0
    picture = np.clip(rgb * (0.8 / max(level, 1e-4)), 0, 1).astype(np.float32)
    write_srgb(
        workdir / "images" / _name(i),
        cv2.resize(picture, size, interpolation=cv2.INTER_AREA) if s < 1 else picture,
    )
    small = cv2.resize(np.asarray(mask, np.float32), size) > 0.5
    write_data(
        workdir / "masks" / f"{_name(i)}.png", cv2.dilate(small.astype(np.float32), np.ones((5, 5)))
    )


def _name(index: int) -> str:
    return f"{index:05d}.png"

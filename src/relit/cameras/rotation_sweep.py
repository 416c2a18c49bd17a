"""Poses of identical objects in one photo from feature matches (SfD Sec. 3.1).

Every instance is the photo itself, seen by a virtual camera: the mask says which object is meant,
the intrinsics are the full photo's. Structure from motion over these cameras gives ξ_cam_i, the
photo's camera in the object's frame of each instance, and with it SfD's ξ_obj_i = ξ_ref ∘
(ξ_cam_i)^-1.

Instances are turned against each other about the line of sight, which features for upright photos
do not survive. So one picture of a pair turns in steps of STEP degrees, the matches of each turn
are counted, the counts are smoothed over neighbouring turns, and the best turn's matches are
carried back. Here that is exact and cheap: a SIFT descriptor of the turned picture is the
descriptor of the picture as it is, with the keypoint's orientation set to the turn, so nothing is
resampled and keypoints stay in the photo's pixels.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np

from relit.conventions import similarity
from relit.device import load_pycolmap
from relit.scene import Camera

STEP = 4  # degrees of a turn, as in SfD
COARSE = 3  # only every third turn is tried first
SMOOTH = 3  # counts are averaged over so many coarse turns
SIDE = 480  # pixels of the enlarged window that features are found in
FEATURES = 700  # of each instance
RATIO = 0.85  # Lowe's, loose: geometry sorts out what is wrong
LEAST = 20  # verified matches that link a pair
CHANCE = 1.5  # times the verified matches at a wrong turn


@dataclass(frozen=True)
class Features:
    """Keypoints of one instance. points: (F, 2) pixels of the PHOTO (centres at +.5). descriptors:
    (T, F, 128) float32 unit, for turns of t * STEP degrees."""

    points: np.ndarray
    descriptors: np.ndarray


@dataclass(frozen=True)
class Link:
    """Verified matches of a pair. a, b: (M,) indices of the keypoints. turn: degrees that the
    second picture was turned. rotation: (3, 3) that carries the first object onto the second in the
    photo, from these two alone, or None."""

    a: np.ndarray
    b: np.ndarray
    turn: float
    rotation: np.ndarray | None = None


def find_features(
    rgb: np.ndarray, mask: np.ndarray, offset: tuple[float, float], pixel: float = 1.0
) -> Features:
    """SIFT keypoints of one instance's window, with descriptors for every turn.

    rgb: (H, W, 3) linear, mask: (H, W). offset: of the window's corner in the photo. pixel: photo
    pixels a window pixel.
    """
    s = SIDE / max(rgb.shape[:2])
    size = (round(rgb.shape[1] * s), round(rgb.shape[0] * s))
    grey = np.clip(rgb @ np.array([0.2126, 0.7152, 0.0722], np.float32), 0, None)
    inside = mask > 0.5
    high = float(np.percentile(grey[inside], 99)) if inside.any() else 1.0
    level = np.where(inside, np.clip(grey / max(high, 1e-6), 0, 1) ** (1 / 2.2), 0.3)
    picture = cv2.resize((level * 255).astype(np.uint8), size, interpolation=cv2.INTER_CUBIC)
    solid = cv2.erode((cv2.resize(mask, size) > 0.5).astype(np.uint8), np.ones((7, 7)))
    sift = cv2.SIFT_create(nfeatures=FEATURES, contrastThreshold=0.006, edgeThreshold=15)  # pyright: ignore[reportAttributeAccessIssue]
    found = sift.detect(picture, solid * 255)
    # one keypoint a place and size: SIFT doubles those with several orientations, which do not
    # count here
    unique = {(round(k.pt[0], 1), round(k.pt[1], 1), round(k.size, 1)): k for k in found}
    keys = list(unique.values())
    turns = range(0, 360, STEP)
    if not keys:
        return Features(np.zeros((0, 2)), np.zeros((len(turns), 0, 128), np.float32))
    turned = [
        cv2.KeyPoint(k.pt[0], k.pt[1], k.size, float(t), k.response, k.octave)
        for t in turns
        for k in keys
    ]
    kept, d = sift.compute(picture, turned)
    if len(kept) != len(turned):
        return Features(np.zeros((0, 2)), np.zeros((len(turns), 0, 128), np.float32))
    d = np.sqrt(d / np.maximum(d.sum(1, keepdims=True), 1e-6)).astype(
        np.float32
    )  # RootSIFT (Arandjelović & Zisserman 2012)
    points = (np.array([k.pt for k in keys]) + 0.5) / s * pixel + np.asarray(offset)
    return Features(points, d.reshape(len(turns), len(keys), 128))


def mutual_matches(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Indices of mutual nearest neighbours of unit descriptors that pass the ratio test."""
    if len(a) < 2 or len(b) < 2:
        return np.zeros(0, int), np.zeros(0, int)
    s = a @ b.T
    first = s.argmax(1)
    i = np.arange(len(a))
    top = s[i, first]
    back = s.argmax(0)
    s[i, first] = -1
    second = s.max(1)
    near = np.sqrt(np.maximum(2 - 2 * top, 1e-9)) < RATIO * np.sqrt(
        np.maximum(2 - 2 * second, 1e-9)
    )
    good = near & (back[first] == i)
    return i[good], first[good]


def best_turn(counts: np.ndarray) -> int:
    """Index of the turn with the most matches after a running average around the circle."""
    smooth = sum(np.roll(counts, k) for k in range(-(SMOOTH // 2), SMOOTH // 2 + 1)) / SMOOTH
    return int(np.argmax(smooth))


def match_pair(a: Features, b: Features, sweep: bool = True) -> Link | None:
    """Matches at the best turn of b against a, or None where there are hardly any. sweep: False
    leaves the pictures as they are."""
    if min(len(a.points), len(b.points)) < LEAST:
        return None
    upright = a.descriptors[0]
    turns = range(0, len(b.descriptors), COARSE) if sweep else (0,)
    counts = np.array([len(mutual_matches(upright, b.descriptors[t])[0]) for t in turns], float)
    at = best_turn(counts) * COARSE if sweep else 0
    if sweep:
        around = [(at + k) % len(b.descriptors) for k in range(-COARSE + 1, COARSE)]
        at = max(around, key=lambda t: len(mutual_matches(upright, b.descriptors[t])[0]))
    i, j = mutual_matches(upright, b.descriptors[at])
    return Link(i, j, at * float(STEP)) if len(i) >= LEAST else None


def verified(
    link: Link, a: Features, b: Features, camera: Camera, error: float, second: Camera | None = None
) -> Link | None:
    """The matches that one essential matrix of the photo's intrinsics explains, or None. error:
    pixels. second: the camera of b where it is from another photo."""
    pycolmap = load_pycolmap()

    options = pycolmap.TwoViewGeometryOptions(
        min_num_inliers=LEAST, detect_watermark=False, compute_relative_pose=True
    )
    options.ransac.max_error, options.ransac.random_seed, options.ransac.max_num_trials = (
        error,
        0,
        3000,
    )
    matches = np.stack([link.a, link.b], 1).astype(np.uint32)
    geometry = pycolmap.estimate_calibrated_two_view_geometry(
        colmap_camera(camera), a.points, colmap_camera(second or camera), b.points, matches, options
    )
    inliers = np.asarray(geometry.inlier_matches, int)
    if len(inliers) < LEAST:
        return None
    relative = geometry.cam2_from_cam1
    rotation = None if relative is None else np.asarray(relative.rotation.matrix())
    return Link(inliers[:, 0], inliers[:, 1], link.turn, rotation)


def colmap_camera(camera: Camera, number: int = 1):
    """The photo's pinhole camera for pycolmap, focal known."""
    pycolmap = load_pycolmap()

    return pycolmap.Camera(
        model="PINHOLE",
        width=int(camera.width),
        height=int(camera.height),
        params=[camera.fx, camera.fy, camera.cx, camera.cy],
        has_prior_focal_length=True,
        camera_id=number,
    )


def each(camera: Camera | list[Camera], count: int) -> list[Camera]:
    """A camera for each of `count` instances."""
    return [camera] * count if isinstance(camera, Camera) else camera


def link_instances(
    features: list[Features], camera: Camera | list[Camera], error: float, *, sweep: bool = True
) -> dict[tuple[int, int], Link]:
    """Links of the pairs (i < j) whose verified matches stand out from chance: at least CHANCE
    times as many as at turns a quarter, half and three quarters of a circle away, where all are
    wrong. camera: of the photo, or one for each instance. error: pixels."""
    links, cameras = {}, each(camera, len(features))
    for i, j in combinations(range(len(features)), 2):
        a, b = features[i], features[j]
        link = match_pair(a, b, sweep)
        link = None if link is None else verified(link, a, b, cameras[i], error, cameras[j])
        if link is None:
            continue
        wrong = 0
        for away in (90, 180, 270):
            t = round((link.turn + away) / STEP) % len(b.descriptors)
            x, y = mutual_matches(a.descriptors[0], b.descriptors[t])
            control = (
                verified(Link(x, y, 0.0), a, b, cameras[i], error, cameras[j])
                if len(x) >= LEAST
                else None
            )
            wrong = max(wrong, 0 if control is None else len(control.a))
        if len(link.a) >= CHANCE * max(wrong, LEAST / CHANCE):
            links[i, j] = link
    return links


def map_instances(
    features: list[Features],
    links: dict[tuple[int, int], Link],
    camera: Camera | list[Camera],
    seed: int = 0,
) -> list[dict[int, np.ndarray]]:
    """Clusters of instances that the links place in one frame, largest first: index ->
    camera_from_object (4, 4), each cluster in a frame and scale of its own. The focal length is
    fixed."""
    pycolmap = load_pycolmap()

    if not links:
        return []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "database.db"
        with pycolmap.Database.open(path) as db:
            numbers: dict[int, int] = {}
            for k, (f, own) in enumerate(zip(features, each(camera, len(features)), strict=True)):
                if id(own) not in numbers:
                    numbers[id(own)] = db.write_camera(
                        colmap_camera(own, len(numbers) + 1), use_camera_id=True
                    )
                number = numbers[id(own)]
                db.write_image(
                    pycolmap.Image(name=f"{k:05d}", camera_id=number, image_id=k + 1),
                    use_image_id=True,
                )
                db.write_keypoints(k + 1, f.points.astype(np.float32))
            for (i, j), link in links.items():
                db.write_matches(i + 1, j + 1, np.stack([link.a, link.b], 1).astype(np.uint32))
        pairs = Path(folder) / "pairs.txt"
        pairs.write_text("".join(f"{i:05d} {j:05d}\n" for i, j in links))
        two = pycolmap.TwoViewGeometryOptions(min_num_inliers=LEAST, detect_watermark=False)
        two.ransac.random_seed = seed
        pycolmap.verify_matches(path, pairs, two)
        o = pycolmap.IncrementalPipelineOptions(
            num_threads=2, random_seed=seed, extract_colors=False
        )
        o.min_model_size, o.min_num_matches, o.max_num_models = 2, LEAST, 20
        o.ba_refine_focal_length = o.ba_refine_principal_point = o.ba_refine_extra_params = False
        o.mapper.abs_pose_refine_focal_length = o.mapper.abs_pose_refine_extra_params = False
        o.mapper.init_min_num_inliers, o.mapper.init_min_tri_angle = LEAST, 8.0
        o.mapper.abs_pose_min_num_inliers, o.mapper.abs_pose_min_inlier_ratio = 8, 0.2
        try:
            models = pycolmap.incremental_mapping(path, folder, folder, o)
        except (RuntimeError, ValueError):  # pycolmap's word for "no first pair"
            models = {}
        clusters = []
        for model in models.values():
            poses = {}
            for k in model.reg_image_ids():
                m = np.asarray(model.image(k).cam_from_world().matrix())
                poses[int(k) - 1] = similarity(m[:, :3], m[:, 3])
            clusters.append(poses)
        return sorted(clusters, key=len, reverse=True)

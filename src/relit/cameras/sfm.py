"""Cameras from photos alone: SIFT, matching and incremental mapping by pycolmap, with a verdict
that says why photos are missing."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from relit.cameras.strays import stray_photos
from relit.capture.photo import with_camera
from relit.capture.readers.colmap_model import camera_from_colmap, sparse_points, world_from_camera
from relit.capture.sphere import SphereView, check_sphere, find_sphere, up_direction
from relit.device import load_pycolmap
from relit.errors import EXIT_FAILED, UserError
from relit.images import write_bytes, write_data, write_srgb
from relit.scene import Capture, Photo, Sphere

MAX_SIDE = 1600  # pixels; features are found on copies of at most this size
EXHAUSTIVE = 120  # photos; larger captures are matched along their order of name
ENOUGH = 0.9  # share of registered photos at which no further try is made
LEAST, LEAST_SHARE = (
    3,
    0.15,
)  # registered photos, and their share, below which no shape is worth the wait
FEW_FEATURES, FEW_MATCHES = 150, 15  # below these a photo is called textureless, without overlap
SMALL_MASK = 256


@dataclass(frozen=True)
class Settings:
    """One try.

    features: at most so many per photo. upsampled: look for them at twice the size as well (three
    times slower).
    inliers: matches that a photo needs to be registered. start, start_angle: matches and angle
    (degrees) that the first pair needs.
    peak: SIFT's threshold. ratio: Lowe's. focal_factor: focal length to start with / longer side.
    """

    title: str
    inliers: int
    start: int
    start_angle: float
    features: int = 2048
    upsampled: bool = True
    peak: float = 0.0067
    ratio: float = 0.8
    guided: bool = False
    with_masks: bool = True
    focal_factor: float = 1.2


STANDARD = Settings("standard", inliers=20, start=60, start_angle=12.0)
LOOSE = Settings(
    "more and weaker features, guided matching",
    inliers=12,
    start=30,
    start_angle=6.0,
    features=6000,
    peak=0.002,
    ratio=0.85,
    guided=True,
)


@dataclass(frozen=True)
class Verdict:
    """How the search for cameras went. mean_error: pixels, at the size of the photos that were
    matched. tries: one line each."""

    registered: int
    total: int
    reason: str
    mean_error: float
    tries: tuple[str, ...]
    seconds: float

    def __str__(self) -> str:
        text = f"{self.registered} of {self.total} photos registered"
        return (
            text
            + (f", because {self.reason}" if self.reason else "")
            + f"; mean reprojection error {self.mean_error:.2f} px"
        )


def find_cameras(
    capture: Capture,
    *,
    seed: int = 0,
    workdir: Path,
    focals: list[float] | None = None,
    say: Callable[[str], None] = lambda line: None,
) -> tuple[Capture, Verdict]:
    """Find the cameras of `capture.photos`; photos that could not be registered are left out with a
    note.

    focals: focal length of each photo in pixels of it as decoded (`Photo.width`), kept fixed; else
    EXIF's is refined, else it is found.
    say: told what is being done, a line at a time.
    workdir: a folder of its own. The model found stays there: a second call with the same photos
    reads it instead of searching again. The frame is COLMAP's (arbitrary, scale as well).
    Raises UserError (exit code 4) when fewer than three photos, or 15 % of them, can be registered,
    or the cameras look apart.
    """
    pycolmap = load_pycolmap()

    began = time.monotonic()
    photos = list(capture.photos)
    if len(photos) < 3:
        raise UserError(
            f"{len(photos)} photos are not enough to find cameras",
            "at least 3 that overlap are needed",
            "add photos",
        )
    workdir = Path(workdir)
    key = _key(capture, seed, focals)
    kept = kept_cameras(capture, seed=seed, workdir=workdir, focals=focals)
    if kept is not None:
        return kept
    for name in ("images", "masks", "tries", "model"):
        shutil.rmtree(workdir / name, ignore_errors=True)
        (workdir / name).mkdir(parents=True)
    names, scales, small = _write_photos(photos, workdir)
    has_masks = all(m is not None for m in small)
    tries, best, features = [], None, {}
    with quiet(pycolmap):
        for number, settings in enumerate(_plan(photos, capture, has_masks, focals is not None)):
            say(f"try {number + 1}: {settings.title}")
            found = _attempt(
                photos, names, scales, workdir, settings, number, seed, focals, has_masks
            )
            took = " + ".join(f"{s:.0f}" for s in found.seconds)
            tries.append(
                f"{settings.title}: {found.count} of {len(photos)}, {found.models} models ({took or 0} s: features, matching, mapping)"
            )
            say(tries[-1])
            features = features or found.features
            if best is None or (found.count, -found.error) > (best.count, -best.error):
                best, features = found, found.features
            if best.count >= ENOUGH * len(photos):
                break
    seconds = time.monotonic() - began
    reason = _reason(best, photos, names, features)  # pyright: ignore[reportArgumentType]
    if best.count < max(LEAST, LEAST_SHARE * len(photos)):
        raise UserError(
            f"{'no' if best.count < LEAST else 'too few'} cameras were found: {best.count} of {len(photos)} photos registered",
            reason,
            "take sharp photos that overlap by two thirds, with texture in view (a newspaper under a plain object), or give cameras",
            code=EXIT_FAILED,
        )
    strays, points = _strays(best.model, names, small)
    if strays:
        named = ", ".join(photos[names.index(n)].name for n in strays)
        text = f"{len(strays)} were put where they were not taken ({named}): what the others see of the object lies beside their masks"
        reason = f"{reason}; {text}" if reason else text
    verdict = Verdict(
        best.count - len(strays), len(photos), reason, best.error, tuple(tries), seconds
    )
    sphere, source = _sphere(best.model, names, small, strays, points)
    model = _Model(best.model, tuple(strays), points)
    result = _registered(capture, model, sphere, source, verdict)  # may raise: then nothing is kept
    _keep(workdir, key, model, sphere, source, verdict)
    return result, verdict


def kept_cameras(
    capture: Capture, *, seed: int = 0, workdir: Path, focals: list[float] | None = None
) -> tuple[Capture, Verdict] | None:
    """What an earlier `find_cameras` with the same arguments found, or None where nothing is kept
    or it cannot be read."""
    kept = _kept(Path(workdir), _key(capture, seed, focals))
    return None if kept is None else (_registered(capture, *kept), kept[-1])


def _key(capture: Capture, seed: int, focals: list[float] | None) -> list:
    return [seed, focals, *([p.name, p.width, p.height, p.focal_hint] for p in capture.photos)]


def _plan(
    photos: list[Photo], capture: Capture, has_masks: bool, focals_known: bool
) -> list[Settings]:
    large = (
        max(max(p.width, p.height) for p in photos) >= 800
    )  # small photos need every feature that there is
    few = len(photos) < 20
    first = replace(STANDARD, inliers=15, start=40, start_angle=8.0) if few else STANDARD
    first = replace(first, upsampled=few or not large)
    plan = [first, LOOSE]
    if has_masks and not capture.black_background:
        # the surroundings may carry the texture that the object lacks, and a try is quick
        alone = [replace(s, title=s.title + ", without masks", with_masks=False) for s in plan]
        plan = [first, alone[0], LOOSE, alone[1]]
    if not focals_known and not any(p.focal_hint for p in photos):
        plan.append(
            replace(
                LOOSE, title=LOOSE.title + ", a longer focal length to start with", focal_factor=2.5
            )
        )
    return plan


# ---------------------------------------------------------------- one try


@dataclass
class _Found:
    model: Any = None
    count: int = 0
    models: int = 0
    error: float = float("inf")
    features: dict | None = None  # name -> number of features
    matches: dict | None = None  # name -> most verified matches with one other photo
    seconds: tuple[float, ...] = ()  # features, matching, mapping


def _attempt(photos, names, scales, workdir, settings, number, seed, focals, has_masks) -> _Found:
    pycolmap = load_pycolmap()

    folder = workdir / "tries" / str(number)
    folder.mkdir()
    database, images = folder / "database.db", workdir / "images"
    threads = min(4, os.cpu_count() or 1)
    marks = [time.monotonic()]
    pycolmap.set_random_seed(seed)
    extraction = pycolmap.FeatureExtractionOptions(num_threads=threads, use_gpu=False)
    extraction.sift.peak_threshold = settings.peak
    extraction.sift.max_num_features = settings.features
    extraction.sift.first_octave = -1 if settings.upsampled else 0
    for indices in _groups(photos, focals):
        p = photos[indices[0]]
        s, side = scales[indices[0]], max(p.width, p.height)
        reader = pycolmap.ImageReaderOptions(default_focal_length_factor=settings.focal_factor)
        reader.camera_model = (
            "OPENCV"
            if len(indices) >= 20
            else "SIMPLE_RADIAL"
            if len(indices) >= 5
            else "SIMPLE_PINHOLE"
        )
        guess = focals[indices[0]] if focals else p.focal_hint
        if guess:
            reader.camera_params = _parameters(
                reader.camera_model, guess * s, p.width * s / 2, p.height * s / 2
            )
        elif settings.focal_factor != STANDARD.focal_factor:
            reader.camera_params = _parameters(
                reader.camera_model,
                settings.focal_factor * side * s,
                p.width * s / 2,
                p.height * s / 2,
            )
        if has_masks and settings.with_masks:
            reader.mask_path = str(workdir / "masks")
        chosen = [names[i] for i in indices]
        pycolmap.extract_features(
            database,
            images,
            chosen,
            pycolmap.CameraMode.SINGLE,
            reader,
            extraction,
            device=pycolmap.Device.cpu,
        )
    marks.append(time.monotonic())
    matching = pycolmap.FeatureMatchingOptions(
        num_threads=threads, use_gpu=False, guided_matching=settings.guided
    )
    matching.sift.max_ratio = settings.ratio
    verification = pycolmap.TwoViewGeometryOptions(min_num_inliers=FEW_MATCHES)
    verification.ransac.random_seed = seed
    if len(photos) <= EXHAUSTIVE:
        pycolmap.match_exhaustive(
            database, matching, verification_options=verification, device=pycolmap.Device.cpu
        )
    else:
        pairing = pycolmap.SequentialPairingOptions(overlap=20, quadratic_overlap=True)
        pycolmap.match_sequential(
            database, matching, pairing, verification, device=pycolmap.Device.cpu
        )
    marks.append(time.monotonic())
    found = _Found(features=_features(database), matches=_matches(database))
    if not any(found.matches.values()):
        return found
    try:
        models = pycolmap.incremental_mapping(
            database, images, folder, _mapping(settings, seed, threads, focals is not None)
        )
    except (RuntimeError, ValueError):  # pycolmap's word for "no first pair"; the verdict says why
        models = {}
    marks.append(time.monotonic())
    found.seconds = tuple(round(b - a, 1) for a, b in pairwise(marks))
    if models:
        model = max(models.values(), key=lambda m: m.num_reg_images())
        model.update_point_3d_errors()
        found.model, found.count, found.models, found.error = (
            model,
            model.num_reg_images(),
            len(models),
            model.compute_mean_reprojection_error(),
        )
    return found


def _parameters(model: str, f: float, cx: float, cy: float) -> str:
    head = [f, f, cx, cy] if model == "OPENCV" else [f, cx, cy]
    extra = {"OPENCV": 4, "SIMPLE_RADIAL": 1, "SIMPLE_PINHOLE": 0}[model]
    return ",".join(f"{v:.6f}" for v in head + [0.0] * extra)


def _mapping(settings: Settings, seed: int, threads: int, focals_known: bool):
    pycolmap = load_pycolmap()

    o = pycolmap.IncrementalPipelineOptions(
        num_threads=threads, random_seed=seed, extract_colors=False
    )
    o.min_model_size, o.min_num_matches, o.max_num_models = 3, FEW_MATCHES, 10
    o.mapper.init_min_num_inliers = settings.start
    o.mapper.init_min_tri_angle = settings.start_angle
    o.mapper.abs_pose_min_num_inliers = settings.inliers
    o.mapper.abs_pose_min_inlier_ratio = 0.2
    if focals_known:
        o.ba_refine_focal_length = False
        o.mapper.abs_pose_refine_focal_length = False
    return o


def _groups(photos: list[Photo], focals: list[float] | None) -> list[list[int]]:
    """Numbers of the photos that share intrinsics: the same size, EXIF focal length and given focal
    length."""
    groups = defaultdict(list)
    for i, p in enumerate(photos):
        hint = None if p.focal_hint is None else round(p.focal_hint, 1)
        groups[(p.width, p.height, hint, None if focals is None else round(focals[i], 1))].append(i)
    return list(groups.values())


def _features(database: Path) -> dict[str, int]:
    """Number of features per photo."""
    pycolmap = load_pycolmap()

    with pycolmap.Database.open(database) as db:
        return {i.name: db.num_keypoints_for_image(i.image_id) for i in db.read_all_images()}


def _matches(database: Path) -> dict[str, int]:
    """Per photo, the most verified matches that it shares with one other photo."""
    pycolmap = load_pycolmap()

    with pycolmap.Database.open(database) as db:
        names = {i.image_id: i.name for i in db.read_all_images()}
        best = dict.fromkeys(names.values(), 0)
        for pair, count in zip(*db.read_two_view_geometry_num_inliers(), strict=True):
            for i in pycolmap.pair_id_to_image_pair(int(pair)) if np.ndim(pair) == 0 else pair:  # pyright: ignore[reportGeneralTypeIssues]
                best[names[int(i)]] = max(best[names[int(i)]], int(count))
    return best


@contextmanager
def quiet(pycolmap):
    """COLMAP's log would bury our own lines."""
    log = pycolmap.logging
    before = log.minloglevel, log.stderrthreshold
    log.minloglevel, log.stderrthreshold = 3, 3
    try:
        yield
    finally:
        log.minloglevel, log.stderrthreshold = before


# ---------------------------------------------------------------- in and out


def _write_photos(
    photos: list[Photo], workdir: Path
) -> tuple[list[str], list[float], list[np.ndarray | None]]:
    """Write upright copies and masks for COLMAP -> (file names, scales of the copies, small
    masks)."""
    names, scales, small = [], [], []
    for i, p in enumerate(photos):
        pixels = p.load()
        s = min(1.0, MAX_SIDE / max(p.width, p.height))
        size = (max(1, round(p.width * s)), max(1, round(p.height * s)))
        rgb = pixels.rgb
        if (
            rgb.max() > 4 or pixels.clipped is None
        ):  # an HDR photo: expose it so that its median is mid grey
            middle = float(np.median(rgb[rgb > 1e-6])) if (rgb > 1e-6).any() else 1.0
            rgb = rgb * (0.18 / max(middle, 1e-6))
        name = _name(i)
        write_srgb(
            workdir / "images" / name,
            cv2.resize(rgb, size, interpolation=cv2.INTER_AREA) if s < 1 else rgb,
        )
        mask = pixels.mask
        if mask is not None:
            grown = cv2.dilate((cv2.resize(mask, size) > 0.5).astype(np.float32), np.ones((9, 9)))
            write_data(workdir / "masks" / f"{name}.png", grown)
            t = min(1.0, SMALL_MASK / max(mask.shape))
            mask = cv2.resize(
                mask,
                (max(1, round(p.width * t)), max(1, round(p.height * t))),
                interpolation=cv2.INTER_AREA,
            )
        names.append(name)
        scales.append(s)
        small.append(mask)
    return names, scales, small


@dataclass(frozen=True)
class _Model:
    """What was found. strays: image names of `model` that are left out. points: (N, 3) on the
    object, or None."""

    model: Any
    strays: tuple[str, ...]
    points: np.ndarray | None


def _strays(
    model, names: list[str], small: list[np.ndarray | None]
) -> tuple[list[str], np.ndarray | None]:
    """Image names of photos that were put where they were not taken, and the sparse points without
    theirs."""
    masks = dict(zip(names, small, strict=True))
    images = [model.image(i) for i in model.reg_image_ids()]
    points = sparse_points(model)
    if any(masks[i.name] is None for i in images):
        return [], points
    cameras = [camera_from_colmap(i.camera, world_from_camera(i))[0] for i in images]
    odd, agreed = stray_photos(cameras, [masks[i.name] for i in images], points)  # pyright: ignore[reportArgumentType]
    return sorted(images[k].name for k in odd), None if points is None else points[agreed]


def _sphere(
    model, names: list[str], small: list[np.ndarray | None], strays: list[str], points
) -> tuple[Sphere, str]:
    masks = dict(zip(names, small, strict=True))
    images = [i for i in map(model.image, model.reg_image_ids()) if i.name not in strays]
    views = [
        SphereView(*camera_from_colmap(i.camera, world_from_camera(i)), masks[i.name])
        for i in images
    ]
    try:
        return find_sphere(views, points)
    except UserError as error:  # its advice is about given poses; these were found
        raise UserError(
            f"{error.what}; the cameras were found from the photos",
            "the photos do not go around one object, or the object turned before a still background, which the cameras were found from",
            "photograph the object from all around, in the middle of every photo; on a turntable use a plain backdrop or masks (--masks)",
            code=EXIT_FAILED,
        ) from None


def _registered(
    capture: Capture, found: _Model, sphere: Sphere, source: str, verdict: Verdict
) -> Capture:
    """The capture with the cameras of a model; photo i is the model's image '0000i.png'."""
    images = {
        i.name: i
        for i in map(found.model.image, found.model.reg_image_ids())
        if i.name not in found.strays
    }
    kept = []
    for i, p in enumerate(capture.photos):
        image = images.get(_name(i))
        if image is not None:
            kept.append(with_camera(p, *camera_from_colmap(image.camera, world_from_camera(image))))
    cameras = [p.camera for p in kept]
    notes = [
        *capture.notes,
        f"cameras: {verdict}",
        f"the object sphere was found from {source}",
        *check_sphere(sphere, cameras),
    ]
    return replace(
        capture,
        photos=tuple(kept),
        sphere=sphere,
        points=found.points,
        up=up_direction(cameras),
        notes=tuple(notes),
    )


def _name(index: int) -> str:
    return f"{index:05d}.png"


def _keep(
    workdir: Path, key: list, found: _Model, sphere: Sphere, source: str, verdict: Verdict
) -> None:
    """Store what was found; `found.json` comes last, so that it never speaks of a model that is not
    whole."""
    found.model.write_binary(str(workdir / "model"))
    points = None if found.points is None else found.points.tolist()
    record = {"strays": found.strays, "points": points}
    record |= {
        "key": key,
        "centre": sphere.centre.tolist(),
        "radius": sphere.radius,
        "source": source,
        "verdict": asdict(verdict),
    }
    write_bytes(workdir / "found.json", json.dumps(record).encode())
    for name in ("images", "masks", "tries"):
        shutil.rmtree(workdir / name, ignore_errors=True)


def _kept(workdir: Path, key: list):
    """-> (model, sphere, its source, verdict) of an earlier call with the same photos, or None."""
    pycolmap = load_pycolmap()

    try:
        record = json.loads((workdir / "found.json").read_text())
        if record["key"] != json.loads(json.dumps(key)):
            return None
        verdict = Verdict(**{**record["verdict"], "tries": tuple(record["verdict"]["tries"])})
        sphere = Sphere(np.array(record["centre"], dtype=np.float64), float(record["radius"]))
        points = None if record["points"] is None else np.array(record["points"], dtype=np.float64)
        model = _Model(
            pycolmap.Reconstruction(str(workdir / "model")), tuple(record["strays"]), points
        )
        return model, sphere, str(record["source"]), verdict
    except (OSError, ValueError, KeyError, TypeError, RuntimeError):
        return None  # nothing there, or a damaged record: the search starts again


def _reason(found: _Found, photos: list[Photo], names: list[str], features: dict) -> str:
    """Why photos are missing, in one clause; empty when none is."""
    registered = (
        set()
        if found.model is None
        else {found.model.image(i).name for i in found.model.reg_image_ids()}
    )
    missing = [n for n in names if n not in registered]
    if not missing:
        return ""
    poor = [n for n in missing if features.get(n, 0) < FEW_FEATURES]
    alone = [
        n for n in missing if n not in poor and (found.matches or {}).get(n, 0) < 2 * FEW_MATCHES
    ]
    rest = len(missing) - len(poor) - len(alone)
    user_name = dict(zip(names, (p.name for p in photos), strict=True))
    parts = []
    if poor:
        parts.append(
            f"{len(poor)} have fewer than {FEW_FEATURES} features (no texture, blur, too dark), for example {user_name[poor[0]]}"
        )
    if alone:
        parts.append(
            f"{len(alone)} share hardly any matches with another photo (too little overlap, glare), such as {user_name[alone[0]]}"
        )
    if rest:
        why = (
            f"do not join the largest of {found.models} groups of photos"
            if found.models > 1
            else "match, but fit no common geometry"
        )
        parts.append(f"{rest} {why}")
    return "; ".join(parts)

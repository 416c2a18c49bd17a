"""The photos of a collection as its recipe works on them: decoded, shrunk, cut out, with a first
guess of the focal length."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from relit.capture.readers.samurai import Hints, read_hints
from relit.errors import UserError
from relit.fit.collection.options import CollectionOptions
from relit.fit.passes.load_photos import partly_clipped, resize
from relit.fit.registration.photos.poses import even_colours
from relit.fit.registration.register import Crop, crop_photo
from relit.geometry.se3 import rotation_from
from relit.masks.grabcut import centre_cut
from relit.scene import Camera, Capture, Photo

LEAST_PHOTOS = 4
FIELD = 50.0  # degrees along the longer side, where EXIF tells nothing
GIVEN = 20.0  # degrees that directions from given cameras may be off


@dataclass(frozen=True)
class CollectionPhoto:
    """One photo, decoded. rgb: (H, W, 3) linear, mask: (H, W). camera: intrinsics by EXIF or guess,
    pose the identity.
    direction: (3,) hint, or 0. given: (4, 4) world_from_camera in the capture's own frame, where
    hints are of given cameras, or None. ignored: (H, W) bool, pixels that tell nothing
    (`partly_clipped`), or None."""

    photo: Photo
    rgb: np.ndarray
    mask: np.ndarray
    camera: Camera
    direction: np.ndarray
    given: np.ndarray | None = None
    ignored: np.ndarray | None = None

    @property
    def tint(self) -> np.ndarray:
        """(3,) mean colour of the object."""
        inside = self.mask > 0.9
        inside = inside if inside.any() else self.mask >= self.mask.max()
        return np.maximum(self.rgb[inside].mean(0), 1e-3)


@dataclass(frozen=True)
class PhotoSet:
    """The photos of a collection. shots: those that the fit uses. held: those set aside. degrees:
    largest error of the hints."""

    shots: list[CollectionPhoto]
    held: list[CollectionPhoto]
    degrees: float

    @property
    def tints(self) -> np.ndarray:
        """(P, 3) mean linear colour of the object in each of `shots`."""
        return np.array([s.tint for s in self.shots])

    def with_cameras(self, cameras: list[Camera]) -> PhotoSet:
        """The set with the intrinsics of these cameras for `shots`."""
        none = np.eye(4)
        shots = [
            replace(s, camera=c.with_pose(none)) for s, c in zip(self.shots, cameras, strict=True)
        ]
        return replace(self, shots=shots)

    @property
    def names(self) -> list[str]:
        return [s.photo.name for s in self.shots]


def load_shots(capture: Capture, options: CollectionOptions, run) -> PhotoSet:
    """Decode all photos; what has no mask or camera gets a guess."""
    photos, held = list(capture.photos), list(capture.held_out)
    if options.holdout > 1 and not held:
        held = photos[options.holdout // 2 :: options.holdout]
        photos = [p for p in photos if p not in held]
    if len(photos) < LEAST_PHOTOS:
        what = f"{len(photos)} photos are not enough: a collection needs at least {LEAST_PHOTOS}"
        raise UserError(
            what,
            "shape is found by comparing photos from different sides",
            "add photos; 30 to 80 all around are good",
        )
    use = options.hints and "quadrants" not in options.without
    hints = read_hints(capture.root, [p.name for p in (*photos, *held)]) if use else None
    of_cameras = hints is None and use and capture.has_cameras and capture.sphere is not None
    if of_cameras:
        hints = hints_of_cameras(capture, [*photos, *held])
    if hints is not None:
        run.say(
            f"{len(hints.directions)} of {len(photos) + len(held)} photos have a hint where they were taken from ({hints.source})"
        )
    guessed, shots = 0, []
    for photo in (*photos, *held):
        pixels = photo.load()
        mask, rgb = pixels.mask, pixels.rgb
        shrink = min(1.0, options.side / max(photo.width, photo.height))
        w, h = max(16, round(photo.width * shrink)), max(16, round(photo.height * shrink))
        rgb = resize(rgb, w, h)
        if mask is None:
            mask, guessed = centre_cut(rgb), guessed + 1
        else:
            mask = np.clip(resize(mask, w, h), 0, 1)
        direction = np.zeros(3) if hints is None else hints.directions.get(photo.name, np.zeros(3))
        given = photo.camera.world_from_camera if of_cameras and photo.camera is not None else None
        shots.append(
            CollectionPhoto(
                photo,
                rgb,
                mask,
                guessed_camera(photo, w, h),
                direction,
                given,
                partly_clipped(pixels, rgb),
            )
        )
    if guessed:
        run.say(
            f"note: {guessed} photos have no mask; they were guessed by GrabCut from the pictures' middle: look at them"
        )
    empty = [s.photo.name for s in shots if (s.mask > 0.5).sum() < 30]
    if empty:
        run.say(
            f"note: {len(empty)} photos have an empty mask and are not used, for example {empty[0]}"
        )
    kept = [s for s in shots if s.photo.name not in empty]
    training = [s for s in kept if s.photo in photos]
    if len(training) < LEAST_PHOTOS:
        raise UserError(
            f"only {len(training)} photos have a mask with anything in it",
            fix="give masks that are white on the object",
        )
    degrees = 45.0 if hints is None else hints.degrees
    return PhotoSet(training, [s for s in kept if s.photo in held], degrees)


def hints_of_cameras(capture: Capture, photos: list[Photo]) -> Hints:
    """The directions of given cameras (LLFF's, COLMAP's), about the object sphere, turned so that
    the photos' own upward directions have +y as their mean."""
    away = {p.name: p.camera.centre - capture.sphere.centre for p in photos if p.camera is not None}
    up = -np.mean([p.camera.world_from_camera[:3, 1] for p in photos if p.camera is not None], 0)
    turn = rotation_from(up, np.array([0.0, 1.0, 0.0])) if np.linalg.norm(up) > 1e-6 else np.eye(3)
    return Hints(
        {name: turn @ v / np.linalg.norm(v) for name, v in away.items()},
        GIVEN,
        f"cameras of {capture.format}",
    )


def guessed_camera(photo: Photo, width: int, height: int) -> Camera:
    """Intrinsics at width x height: known ones, EXIF's focal length, or FIELD degrees."""
    if photo.camera is not None:
        return photo.camera.resized(width, height).with_pose(np.eye(4))
    focal = 0.5 * max(width, height) / np.tan(np.radians(FIELD) / 2)
    if photo.focal_hint is not None:
        focal = photo.focal_hint * width / photo.width
    return Camera(width, height, focal, focal, width / 2, height / 2, np.eye(4))


def collection_crops(shots: list[CollectionPhoto]) -> list[Crop]:
    """What registration compares."""
    return even_colours([crop_photo(s.rgb, s.mask, s.camera) for s in shots])

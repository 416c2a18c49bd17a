"""Turntable captures with known truth: camera, light and background are still; the object and the
plate that it stands on turn by known steps.

Photos, and what is handed over, are those of `synthesize.delivery`; the truth is that of
`synthesize.object_truth`, in the frame of the object: true cameras are relative to the object, so
that they go around it. The light is still in the frame of the camera: truth/environment.exr and
the test views are those of angle 0, where both frames are one. truth.json has "turntable": the
angle of each photo in degrees (x_rig = R_y(angle) x_object) and the elevations.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from relit.errors import EXIT_USAGE, UserError
from relit.geometry.se3 import exp_so3, look_at
from relit.scene import Camera
from relit.synthesize.camera_model import CameraModel, Shot
from relit.synthesize.delivery import (
    Delivery,
    delivered_shots,
    delivery_truth,
    pinholes,
    write_cameras,
    write_photo,
)
from relit.synthesize.everyday import ASPECT, hand_held_cameras
from relit.synthesize.multiview import RADIUS, claim_folder, tell_progress, write_json
from relit.synthesize.object_truth import (
    CaptureFiles,
    Sampling,
    settings_for,
    stage_truth,
    write_object_truth,
)
from relit.synthesize.surroundings import Support, staged, table_texture

TURNTABLE_SAMPLING = Sampling(views=36, test_views=8, resolution=400, spp=128, test_spp=192)
# A camera on a tripod with everything set by hand.
TURNTABLE = Delivery(CameraModel(jpeg=95, exif=True, shot_noise=1 / 12000), cameras=False)
ELEVATIONS = (25.0,)  # degrees; each is one turn of the plate
FIELD = 32.0  # degrees along the longer side
FILL = 0.9  # of half the shorter side, by the object's sphere
PLATE = 1.15 * RADIUS
PLATE_HEIGHT = 0.06 * RADIUS  # of the plate above the table
TABLE = 4.0 * RADIUS
BACKGROUND_BLUR = 0.5  # degrees


def synthesize_turntable(
    files: CaptureFiles,
    out: str | Path,
    sampling: Sampling = TURNTABLE_SAMPLING,
    *,
    elevations: tuple[float, ...] = ELEVATIONS,
    delivery: Delivery = TURNTABLE,
    say: Callable[[str], None] = lambda text: None,
) -> Path:
    """Render a turntable capture with its truth into `out`; returns `out`.

    elevations: of the camera in degrees, one turn of the plate for each; views are shared evenly.
    Of the camera model, what moves a camera (partial, crops, motion, turned) is switched off.
    Deterministic by the seed; takes up where a killed call stopped. Raises UserError as
    `synthesize_multiview`.
    """
    out, elevations = Path(out), tuple(float(e) for e in elevations)
    if not elevations or not all(5 <= e <= 85 for e in elevations):
        raise UserError(
            "an elevation of the camera is out of range",
            fix="give one or more between 5 and 85 degrees",
            code=EXIT_USAGE,
        )
    delivery = replace(delivery, camera=still(delivery.camera))
    settings = settings_for("turntable", files, sampling, delivery, elevations=list(elevations))
    if claim_folder(out, settings):
        return out
    angles, rig = turntable_views(sampling.views, sampling.resolution, elevations)
    shots = delivered_shots(delivery, rig, sampling.seed)
    around = [(name, on_object(shot, a)) for (name, shot), a in zip(shots, angles, strict=True)]
    test = hand_held_cameras(sampling.test_views, sampling.resolution, sampling.seed + 1, "t_")
    write_cameras(out, delivery, around, test)
    truth = stage_truth(out, files, sampling, test, say)
    seed = sampling.seed
    mat, wood = table_texture("speckle", seed), table_texture("wood", seed)
    table = Support("square", TABLE, truth.lowest - PLATE_HEIGHT, *wood, turn=0.35)
    for i, ((name, shot), angle) in enumerate(zip(shots, angles, strict=True)):
        if not (out / "truth" / "photos" / f"{name}.json").exists():
            plate = Support("disc", PLATE, truth.lowest, *mat, turn=angle)
            mesh, material, placed = truth.thing
            thing = (mesh, material, turn_about_y(angle) @ placed)
            stage = staged(thing, truth.environment, (table, plate), BACKGROUND_BLUR)
            write_photo(out, delivery, name, shot, stage.take, sampling.spp)
        tell_progress(say, "photo", i, len(shots))
    content = write_object_truth(truth, files, pinholes(around), test)
    degrees = {name: float(np.degrees(a)) for (name, _), a in zip(shots, angles, strict=True)}
    content |= {
        "settings": settings,
        "turntable": {"angles": degrees, "elevations": list(elevations)},
        **delivery_truth(out, delivery, shots),
    }
    write_json(out / "truth" / "truth.json", content)
    return out


def still(model: CameraModel) -> CameraModel:
    """The camera model without what moves or turns a camera."""
    return replace(model, partial=0.0, crops=0.0, motion=0.0, turned=0.0)


def turn_about_y(angle: float) -> np.ndarray:
    """(4, 4) rotation about the vertical by `angle` radians: x_rig = R x_object."""
    out = np.eye(4)
    out[:3, :3] = exp_so3(np.array([0.0, angle, 0.0]))
    return out


def on_object(shot: Shot, angle: float) -> Shot:
    """The shot with its camera in the frame of the object, which is turned by `angle` radians."""
    pose = turn_about_y(-angle) @ np.asarray(shot.camera.world_from_camera)
    return replace(shot, camera=shot.camera.with_pose(pose))


def turntable_views(
    count: int, resolution: int, elevations: tuple[float, ...]
) -> tuple[list[float], list[tuple[str, Camera]]]:
    """Angle of the plate in radians, and (name, still camera in the frame of the rig), of each
    photo."""
    angles, cameras = [], []
    w, h = resolution, round(resolution * ASPECT)
    focal = 0.5 * w / np.tan(np.radians(FIELD) / 2)
    distance = RADIUS * np.hypot(1, focal / (0.5 * h * FILL))
    shares = np.array_split(np.arange(count), len(elevations))
    for elevation, members in zip(np.radians(elevations), shares, strict=True):
        pose = look_at(distance * np.array([0.0, np.sin(elevation), np.cos(elevation)]))
        for k, i in enumerate(members):
            angles.append(float(2 * np.pi * k / len(members)))
            cameras.append((f"v_{i:03d}", Camera(w, h, focal, focal, w / 2, h / 2, pose)))
    return angles, cameras

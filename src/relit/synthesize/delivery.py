"""What a person hands over: photos of a camera model, with or without masks and cameras, and the
truth about them.

    images/NAME.jpg             8 bit, as stored: EXIF may turn it
    masks/NAME.png              upright, by a segmenter; only with masks
    transforms.json             cameras of the photos as stored, with k1; only with cameras
    truth/transforms_train.json, truth/transforms_test.json
                                true pinhole cameras (no lens), in the world frame
    truth/masks/NAME.png        visible part of the object, upright, distorted as the photo is
    truth/photos/NAME.json      what was drawn for the photo; all of them in truth.json as well
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from relit.conventions import sample_environment, world_from_gl_camera
from relit.files import write_text
from relit.images import write_bytes, write_data
from relit.scene import Camera
from relit.synthesize.camera_model import (
    SUBPIXELS,
    CameraModel,
    Shot,
    develop,
    distorted_picture,
    draw_shot,
    encode_photo,
    wide_pinhole,
)
from relit.synthesize.mask_errors import (
    MaskErrors,
    draw_fault,
    fault_record,
    occluded,
    segmented,
)

# A photo before the camera: camera, samples a pixel, seed -> (H, W, 3) linear radiance of the whole
# scene and (H, W) coverage of the object.
Take = Callable[[Camera, int, int], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Delivery:
    """camera, mask_errors: how photos and masks are made. masks, cameras: whether they are handed
    over."""

    camera: CameraModel = field(default_factory=CameraModel)
    mask_errors: MaskErrors = field(default_factory=MaskErrors)
    masks: bool = True
    cameras: bool = True

    def settings(self) -> dict[str, Any]:
        """For the truth file and the hash of a capture."""
        return asdict(self)


def delivered_shots(
    delivery: Delivery, cameras: Sequence[tuple[str, Camera]], seed: int
) -> list[tuple[str, Shot]]:
    """(name, choices) of each photo of (name, ideal camera)."""
    return [
        (Path(name).name, draw_shot(delivery.camera, camera, seed * 1_000_003 + i))
        for i, (name, camera) in enumerate(cameras)
    ]


def pinholes(shots: Sequence[tuple[str, Shot]]) -> list[tuple[str, Camera]]:
    """(name, camera without its lens) of each photo: what the truth is rendered with."""
    return [(name, replace(shot.camera, distortion=())) for name, shot in shots]


def write_cameras(
    out: Path,
    delivery: Delivery,
    shots: Sequence[tuple[str, Shot]],
    test: Sequence[tuple[str, Camera]],
) -> None:
    """transforms.json where cameras are handed over, and the true ones."""
    suffix = delivery.camera.suffix
    given = [
        (f"images/{name}{suffix}", stored_camera(shot.camera, shot.orientation))
        for name, shot in shots
    ]
    if delivery.cameras:
        write_json_file(out / "transforms.json", transforms_of(given))
    truth = [(f"images/{name}{suffix}", camera) for name, camera in pinholes(shots)]
    write_json_file(out / "truth" / "transforms_train.json", transforms_of(truth))
    write_json_file(out / "truth" / "transforms_test.json", transforms_of(test))


# EXIF orientation -> upright camera axes from those of the stored photo (3, 3); other orientations
# mirror and are not drawn
STORED_AXES = {
    1: np.eye(3),
    3: np.diag([-1.0, -1.0, 1.0]),
    6: np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]),
    8: np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
}


def stored_camera(camera: Camera, orientation: int) -> Camera:
    """The camera of a photo as the file holds it, which is what formats of known cameras mean, from
    that of the upright photo."""
    turn = STORED_AXES[orientation]
    pose = np.array(camera.world_from_camera)
    pose[:3, :3] = pose[:3, :3] @ turn
    w, h = camera.width, camera.height
    # the principal point turns about the picture's middle as the axes do
    off = turn[:2, :2].T @ np.array([camera.cx - w / 2, camera.cy - h / 2])
    swapped = orientation in (6, 8)
    w, h = (h, w) if swapped else (w, h)
    fx, fy = (camera.fy, camera.fx) if swapped else (camera.fx, camera.fy)
    return replace(
        camera,
        width=w,
        height=h,
        fx=fx,
        fy=fy,
        cx=float(w / 2 + off[0]),
        cy=float(h / 2 + off[1]),
        world_from_camera=pose,
    )


def transforms_of(cameras: Sequence[tuple[str, Camera]]) -> dict[str, Any]:
    """The content of a transforms.json (nerfstudio's keys) with intrinsics of each photo."""
    frames = []
    for name, c in cameras:
        frame: dict[str, Any] = {
            "file_path": name,
            "w": c.width,
            "h": c.height,
            "fl_x": c.fx,
            "fl_y": c.fy,
            "cx": c.cx,
            "cy": c.cy,
            "transform_matrix": world_from_gl_camera(c.world_from_camera).tolist(),
        }
        if any(c.distortion):
            frame["k1"] = float(c.distortion[0])
        frames.append(frame)
    model = "OPENCV" if any(any(c.distortion) for _, c in cameras) else "PINHOLE"
    return {"camera_model": model, "frames": frames}


def write_photo(out: Path, delivery: Delivery, name: str, shot: Shot, take: Take, spp: int) -> None:
    """One photo with its masks and its record, the record last; what is complete is kept.

    spp: samples a pixel of the photo."""
    record_file = out / "truth" / "photos" / f"{name}.json"
    if record_file.exists():
        return
    radiance, alpha = seen_through(shot, take, spp)
    fault = draw_fault(delivery.mask_errors, shot.seed)
    radiance, visible = occluded(radiance, alpha, fault)
    codes, record = develop(delivery.camera, shot, radiance)
    write_data(out / "truth" / "masks" / f"{name}.png", visible)
    if delivery.masks:
        mask = segmented(visible, delivery.mask_errors, fault)
        write_data(out / "masks" / f"{name}.png", mask)
    photo = encode_photo(delivery.camera, shot, codes, record)
    write_bytes(out / "images" / f"{name}{delivery.camera.suffix}", photo)
    write_json_file(record_file, {**record, "mask": fault_record(fault)})


def seen_through(shot: Shot, take: Take, spp: int) -> tuple[np.ndarray, np.ndarray]:
    """Radiance (H, W, 3) and coverage (H, W) as the lens throws them on the sensor."""
    if not any(shot.camera.distortion):
        return take(shot.camera, spp, shot.seed)
    wide = wide_pinhole(shot.camera)
    radiance, alpha = take(wide, max(1, round(spp / SUBPIXELS**2)), shot.seed)
    both = distorted_picture(shot.camera, wide, np.concatenate([radiance, alpha[..., None]], -1))
    return both[..., :3], both[..., 3]


def in_front_of(
    light: np.ndarray, camera: Camera, rgba: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Radiance (H, W, 3) of a premultiplied picture (H, W, 4) in front of a lat-long light, and its
    coverage (H, W)."""
    behind = sample_environment(light, pixel_directions(camera))
    return rgba[..., :3] + behind * (1 - rgba[..., 3:]), rgba[..., 3]


def pixel_directions(camera: Camera) -> np.ndarray:
    """(H, W, 3) unit world directions through the pixel centres of a pinhole."""
    u, v = np.meshgrid(
        (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx,
        (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy,
    )
    d = np.stack([u, v, np.ones_like(u)], -1) @ np.asarray(camera.world_from_camera)[:3, :3].T
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def delivery_truth(
    out: Path, delivery: Delivery | None, shots: Sequence[tuple[str, Shot]]
) -> dict[str, Any]:
    """{"delivery": settings, "photos": records by name} for truth.json; empty without a
    delivery."""
    if delivery is None:
        return {}
    folder = out / "truth" / "photos"
    photos = {name: json.loads((folder / f"{name}.json").read_text()) for name, _ in shots}
    return {"delivery": delivery.settings(), "photos": photos}


def write_json_file(path: Path, content: Any) -> None:
    """Write JSON atomically, its folder made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, json.dumps(content, indent=1))

"""A camera that people have: from scene radiance to the file of a phone, every effect settable and
off by default.

The order is that of a camera. Light: lens distortion (rendered from a wider pinhole and warped),
defocus, motion, vignetting. Sensor: exposure and white balance, shot and read noise, clipping.
Processing: response curve, 8 bits, orientation of the stored picture, JPEG, EXIF.

`draw_shot` makes every random choice of a photo, `develop` applies them; what was drawn or measured
is a `Shot` and a dictionary for the truth file. Values in pixels hold for a photo whose longer side
has REFERENCE pixels and scale with it.
"""

from __future__ import annotations

import io
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import cv2
import numpy as np
from PIL import Image as PilImage
from PIL import TiffImagePlugin

from relit.conventions import linear_from_srgb, srgb_from_linear
from relit.errors import EXIT_USAGE, UserError, did_you_mean
from relit.geometry.lens import Lens, ideal_from_pixels, lens_of
from relit.geometry.se3 import exp_so3
from relit.images.write import codes_of
from relit.scene import Camera

REFERENCE = 400.0  # pixels of the longer side, for which blurs and outlines are given
RESPONSES = ("srgb", "gamma", "phone")
CONTRAST = 0.45  # weight of the smoothstep in the curve of "phone": monotone below 1
TABLE = 1 << 14  # entries of the table that inverts a curve; its step is below 1/32 of a code
FULL_FRAME_DIAGONAL = 43.2666  # mm, what a 35 mm equivalent refers to
PHONE_DIAGONAL = 9.6  # mm, a sensor of 1/1.67 inch
F_NUMBER = 1.8
BASE_TIME, LONGEST_TIME = 1 / 120, 1 / 30  # s: at gain 1 and ISO 100; longer times blur by hand
BASE_ISO, LEAST_ISO = 100.0, 50.0
MARGIN = 2  # pixels of a wide pinhole beyond the outermost pixel, for interpolation
SUBPIXELS = 2  # a side: the wide pinhole is rendered finer, so that warping costs no sharpness
NO_FLASH = 0x10  # EXIF: flash did not fire, compulsory off
SWITCH = {"1": True, "true": True, "0": False, "false": False}
# What a person holds: upright, on its left, on its right, upside down. Others are mirrored.
ORIENTATIONS = (1, 6, 8, 3)
TURN_BACK = {6: 8, 8: 6}  # the orientation that undoes one; others undo themselves


def check_ranges(settings: Any, ranges: dict[str, tuple[float, float]]) -> None:
    """Raise UserError for a number of a dataclass outside (least, most)."""
    for key, (least, most) in ranges.items():
        value = getattr(settings, key)
        if not least <= value <= most:
            raise UserError(
                f"{key} = {value:g} is out of range",
                fix=f"between {least:g} and {most:g}",
                code=EXIT_USAGE,
            )


@dataclass(frozen=True)
class CameraModel:
    """Settings of a camera; the defaults are an ideal one: a pinhole, linear up to 8-bit sRGB PNG.

    distortion: k1 of OpenCV's and COLMAP's radial model. vignetting: share of light lost in the
    farthest corner (quadratic in the radius). defocus: largest standard deviation of a Gaussian
    blur, motion: largest length of a straight one, both in pixels (drawn for each photo from 0 up).
    partial: share of photos whose frame cuts the object. crops: share of photos that were cut from
    a larger one, so that the principal point is off the middle.

    auto_exposure: linear mean of the luminance of every photo, 0 for a gain of 1. exposure:
    standard deviation of the log2 of the gain. white_balance: standard deviation of the log of the
    gains of red and of blue. shot_noise: variance at linear 1 and ISO 100. read_noise: standard
    deviation in linear units at ISO 100; both grow with ISO.

    response: one of RESPONSES. jpeg: quality, 0 for PNG. exif: write it. turned: share of photos
    stored on a side or upside down, with the orientation in EXIF.
    """

    distortion: float = 0.0
    vignetting: float = 0.0
    defocus: float = 0.0
    motion: float = 0.0
    partial: float = 0.0
    crops: float = 0.0
    auto_exposure: float = 0.0
    exposure: float = 0.0
    white_balance: float = 0.0
    shot_noise: float = 0.0
    read_noise: float = 0.0
    response: str = "srgb"
    jpeg: int = 0
    exif: bool = False
    turned: float = 0.0

    def __post_init__(self) -> None:
        check_ranges(
            self,
            {
                "distortion": (-0.3, 0.3),
                "vignetting": (0, 0.95),
                "defocus": (0, 20),
                "motion": (0, 40),
                "partial": (0, 1),
                "crops": (0, 1),
                "auto_exposure": (0, 0.9),
                "exposure": (0, 3),
                "white_balance": (0, 1),
                "shot_noise": (0, 0.1),
                "read_noise": (0, 0.1),
                "jpeg": (0, 100),
                "turned": (0, 1),
            },
        )
        if self.response not in RESPONSES:
            raise UserError(
                f"unknown response '{self.response}'.{did_you_mean(self.response, RESPONSES)}",
                fix=f"choose one of: {', '.join(RESPONSES)}",
                code=EXIT_USAGE,
            )
        if self.turned and not self.exif:
            raise UserError(
                "photos are turned but their EXIF is not written",
                "no reader could turn them back",
                "set exif=1, or turned=0",
                code=EXIT_USAGE,
            )
        if self.exif and not self.jpeg:
            raise UserError(
                "EXIF is written to JPEG files only", fix="set jpeg=92, or exif=0", code=EXIT_USAGE
            )

    @property
    def suffix(self) -> str:
        return ".jpg" if self.jpeg else ".png"


# Shot noise: a full well of 6000 electrons. Read noise: 2 electrons of it. Mean .15: below a
# grey card, as phones spare highlights.
PRESETS = {
    "off": CameraModel(),
    "phone": CameraModel(
        distortion=0.04,
        vignetting=0.3,
        defocus=0.6,
        motion=1.0,
        partial=0.1,
        crops=0.15,
        auto_exposure=0.15,
        exposure=0.1,
        white_balance=0.05,
        shot_noise=1 / 6000,
        read_noise=1 / 3000,
        response="phone",
        jpeg=92,
        exif=True,
        turned=0.5,
    ),
}


def parse_settings(text: str, presets: dict[str, Any], what: str) -> Any:
    """A dataclass from 'NAME', 'key=value,...' or 'NAME,key=value,...'. NAME: of `presets`, whose
    'off' gives what is not named. Raises UserError."""
    words = [w.strip() for w in text.split(",") if w.strip()]
    settings = presets["off"]
    if words and "=" not in words[0]:
        name = words.pop(0)
        if name not in presets:
            raise UserError(
                f"unknown {what} '{name}'.{did_you_mean(name, presets)}",
                fix=f"choose one of: {', '.join(presets)}, or give key=value,...",
                code=EXIT_USAGE,
            )
        settings = presets[name]
    known = {f.name: getattr(presets["off"], f.name) for f in fields(settings)}
    changes = {}
    for word in words:
        key, _, value = (part.strip() for part in word.partition("="))
        if key not in known:
            raise UserError(
                f"unknown setting '{key}' of the {what}.{did_you_mean(key, known)}",
                fix=f"choose among: {', '.join(known)}",
                code=EXIT_USAGE,
            )
        try:
            changes[key] = _converted(value, known[key])
        except ValueError as error:
            raise UserError(
                f"'{word}' of the {what} is not understood", fix="give a number", code=EXIT_USAGE
            ) from error
    return replace(settings, **changes)


def _converted(value: str, default: Any) -> Any:
    if isinstance(default, bool):
        if value.lower() not in SWITCH:
            raise ValueError(value)
        return SWITCH[value.lower()]
    return value if isinstance(default, str) else type(default)(value)


def parse_camera_model(text: str) -> CameraModel:
    """`parse_settings` of a camera: 'phone', 'jpeg=80,vignetting=.3', 'phone,distortion=0'."""
    return parse_settings(text, PRESETS, "camera model")


# ---------------------------------------------------------------- what is drawn for a photo


@dataclass(frozen=True)
class Shot:
    """The choices for one photo.

    camera: with its distortion and its pose after `partial` and `crops`. full_diagonal: pixels of
    the photo before it was cropped. defocus, motion: pixels of this photo; angle: of the motion,
    radians. ev: log2 of the gain beside auto exposure. white: (3,) gains. orientation: EXIF's.
    seed: of the noise.
    """

    camera: Camera
    full_diagonal: float
    partial: bool
    cropped: bool
    defocus: float
    motion: float
    angle: float
    ev: float
    white: tuple[float, float, float]
    orientation: int
    seed: int


# Share of the shorter side by which a cut object is off the middle: at least the sphere's outline
# leaves the frame where it fills two thirds of it.
PARTIAL_OFFSET = (0.3, 0.5)
CROP_OFFSET = (0.08, 0.2)  # of each side: the full photo is larger by twice that


def draw_shot(model: CameraModel, camera: Camera, seed: int) -> Shot:
    """The choices for one photo of an ideal camera that looks at the object. Deterministic; settings
    that are off change no other draw."""
    rng = np.random.default_rng([seed, 65])
    scale = max(camera.width, camera.height) / REFERENCE
    u = rng.random(8)
    signs = rng.choice([-1.0, 1.0], 2)
    normal = rng.normal(size=3)
    w, h = camera.width, camera.height
    pose = np.array(camera.world_from_camera, np.float64)
    partial, cropped = bool(u[0] < model.partial), bool(u[1] < model.crops)
    off = np.zeros(2)  # of the object from the middle of the frame, pixels
    if partial:
        share = PARTIAL_OFFSET[0] + np.ptp(PARTIAL_OFFSET) * u[2]
        direction = np.array([np.cos(2 * np.pi * u[3]), np.sin(2 * np.pi * u[3])])
        off = share * min(w, h) * direction
    shift, full = np.zeros(2), np.hypot(w, h)
    if cropped:
        share = CROP_OFFSET[0] + np.ptp(CROP_OFFSET) * u[4]
        shift = share * signs * np.array([w, h])
        full = full * (1 + 2 * share)
    away = off - shift  # of the object from the principal point
    axis = np.array([away[1] / camera.fy, -away[0] / camera.fx, 0.0])
    length = np.linalg.norm(axis)
    if length > 0:
        pose[:3, :3] = pose[:3, :3] @ exp_so3(axis / length * np.arctan(length))
    turned = u[5] < model.turned
    orientation = ORIENTATIONS[1 + int(u[5] / max(model.turned, 1e-9) * 3)] if turned else 1
    gains = np.exp(model.white_balance * normal[:2])
    k1 = model.distortion
    return Shot(
        camera=replace(
            camera,
            cx=camera.cx + float(shift[0]),
            cy=camera.cy + float(shift[1]),
            world_from_camera=pose,
            distortion=(k1, 0.0, 0.0, 0.0) if k1 else (),
        ),
        full_diagonal=float(full),
        partial=partial,
        cropped=cropped,
        defocus=float(model.defocus * u[6] * scale),
        motion=float(model.motion * u[7] * scale),
        angle=float(np.pi * rng.random()),
        ev=float(model.exposure * normal[2]),
        white=(float(gains[0]), 1.0, float(gains[1])),
        orientation=orientation,
        seed=int(seed),
    )


# ---------------------------------------------------------------- lens


def wide_pinhole(camera: Camera) -> Camera:
    """The pinhole whose picture holds all that a distorted camera sees, SUBPIXELS times as fine.
    Raises UserError where the lens has no inverse inside the frame."""
    lens = lens_of(camera)
    w, h = camera.width, camera.height
    s = np.linspace(0, 1, 65)
    border = np.concatenate(
        [np.stack([a * w, b * h], -1) for a, b in ((s, 0 * s), (s, 0 * s + 1), (0 * s, s))]
        + [np.stack([0 * s + w, s * h], -1)]
    )
    ideal = ideal_from_pixels(camera, lens, border)
    if not np.isfinite(ideal).all():
        raise UserError(
            "the lens distortion cannot be inverted inside the frame",
            f"k1 = {camera.distortion[0]:g} folds the picture at this field of view",
            "use a smaller distortion",
            code=EXIT_USAGE,
        )
    low = np.floor(ideal.min(0) * (camera.fx, camera.fy)) - MARGIN
    high = np.ceil(ideal.max(0) * (camera.fx, camera.fy)) + MARGIN
    size = (high - low).astype(int)
    pinhole = replace(
        camera,
        width=int(size[0]),
        height=int(size[1]),
        cx=float(-low[0]),
        cy=float(-low[1]),
        distortion=(),
    )
    return pinhole.resized(SUBPIXELS * pinhole.width, SUBPIXELS * pinhole.height)


def distorted_picture(camera: Camera, wide: Camera, picture: np.ndarray) -> np.ndarray:
    """(H, W, C) float32: the picture (H', W', C) of `wide_pinhole(camera)` through the lens of
    `camera`; mean over SUBPIXELS^2 points of each pixel."""
    lens: Lens | None = lens_of(camera)
    n = SUBPIXELS
    x = (np.arange(camera.width * n) + 0.5) / n
    y = (np.arange(camera.height * n) + 0.5) / n
    grid = np.stack(np.meshgrid(x, y), -1)
    ideal = ideal_from_pixels(camera, lens, grid.reshape(-1, 2)).reshape(grid.shape)
    u = (ideal[..., 0] * wide.fx + wide.cx - 0.5).astype(np.float32)
    v = (ideal[..., 1] * wide.fy + wide.cy - 0.5).astype(np.float32)
    fine = cv2.remap(
        np.asarray(picture, np.float32), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    fine = fine.reshape(camera.height, n, camera.width, n, -1)
    return fine.mean((1, 3)).astype(np.float32)


def blurred(picture: np.ndarray, shot: Shot) -> np.ndarray:
    """Defocus (Gaussian) and motion (straight line) of a picture (H, W, C)."""
    out = np.asarray(picture, np.float32)
    if shot.defocus > 0.05:
        out = cv2.GaussianBlur(out, (0, 0), shot.defocus, borderType=cv2.BORDER_REPLICATE)
    if shot.motion > 0.1:
        kernel = motion_kernel(shot.motion, shot.angle)
        out = cv2.filter2D(out, -1, kernel, borderType=cv2.BORDER_REPLICATE)
    return out.reshape(np.shape(picture))


def motion_kernel(length: float, angle: float) -> np.ndarray:
    """(K, K) float32, sum 1: a line of `length` pixels through the middle, bilinear."""
    radius = int(np.ceil(length / 2)) + 1
    kernel = np.zeros((2 * radius + 1,) * 2, np.float64)
    for t in (np.arange(64) + 0.5) / 64 - 0.5:
        x, y = radius + t * length * np.cos(angle), radius + t * length * np.sin(angle)
        i, j = int(x), int(y)
        fx, fy = x - i, y - j
        kernel[j, i] += (1 - fx) * (1 - fy)
        kernel[j, i + 1] += fx * (1 - fy)
        kernel[j + 1, i] += (1 - fx) * fy
        kernel[j + 1, i + 1] += fx * fy
    return (kernel / kernel.sum()).astype(np.float32)


def vignette(camera: Camera, loss: float) -> np.ndarray:
    """(H, W) factor on the light: 1 at the principal point, 1 - loss at the farthest corner."""
    x = np.arange(camera.width) + 0.5 - camera.cx
    y = np.arange(camera.height) + 0.5 - camera.cy
    far = max(camera.cx, camera.width - camera.cx) ** 2
    far += max(camera.cy, camera.height - camera.cy) ** 2
    return (1 - loss * (x[None] ** 2 + y[:, None] ** 2) / far).astype(np.float32)


# ---------------------------------------------------------------- sensor and curve


def respond(linear: np.ndarray, response: str) -> np.ndarray:
    """[0, 1] linear -> [0, 1] code value / 255, strictly increasing, by one of RESPONSES."""
    x = np.clip(np.asarray(linear, np.float64), 0, 1)
    if response == "gamma":
        return x ** (1 / 2.2)
    s = np.asarray(srgb_from_linear(x), np.float64)
    if response == "srgb":
        return s
    return (1 - CONTRAST) * s + CONTRAST * s * s * (3 - 2 * s)


def inverse_response(codes: np.ndarray, response: str) -> np.ndarray:
    """[0, 1] code value / 255 -> [0, 1] linear, the inverse of `respond`."""
    y = np.clip(np.asarray(codes, np.float64), 0, 1)
    if response == "gamma":
        return y**2.2
    if response == "srgb":
        return np.asarray(linear_from_srgb(y), np.float64)
    s = np.linspace(0, 1, TABLE)
    curve = (1 - CONTRAST) * s + CONTRAST * s * s * (3 - 2 * s)
    return np.asarray(linear_from_srgb(np.interp(y, curve, s)), np.float64)


def exposure_of(gain: float) -> tuple[float, float]:
    """(seconds, ISO) of a gain: time up to LONGEST_TIME first, as a phone does; their product is
    proportional to the gain."""
    time = min(BASE_TIME * gain * BASE_ISO / LEAST_ISO, LONGEST_TIME)
    return time, BASE_ISO * gain * BASE_TIME / time


def develop(model: CameraModel, shot: Shot, radiance: np.ndarray) -> tuple[np.ndarray, dict]:
    """Codes (H, W, 3) uint8 of scene radiance (H, W, 3), linear, already through the lens's
    distortion, upright; and what was drawn or measured, for the truth file."""
    light = blurred(radiance, shot) * vignette(shot.camera, model.vignetting)[..., None]
    gain = 2.0**shot.ev
    if model.auto_exposure:
        mean = float(np.clip(light @ np.array([0.2126, 0.7152, 0.0722]), 0, 4).mean())
        gain *= model.auto_exposure / max(mean, 1e-6)
    time, iso = exposure_of(gain)
    signal = light.astype(np.float64) * gain * np.array(shot.white)
    amplified = iso / BASE_ISO
    variance = model.shot_noise * amplified * np.maximum(signal, 0)
    variance = variance + (model.read_noise * amplified) ** 2
    rng = np.random.default_rng([shot.seed, 66])
    if model.shot_noise or model.read_noise:
        signal = signal + np.sqrt(variance) * rng.normal(size=signal.shape)
    record = asdict(replace(shot, camera=None))  # pyright: ignore[reportArgumentType]
    del record["camera"]
    record |= {"gain": gain, "exposure_time": time, "iso": iso}
    record["k1"] = float(shot.camera.distortion[0]) if shot.camera.distortion else 0.0
    record["white"] = list(shot.white)
    return codes_of(respond(np.clip(signal, 0, 1), model.response)), record


# ---------------------------------------------------------------- file


def stored(array: np.ndarray, orientation: int) -> np.ndarray:
    """The array (H, W[, C]) as a file with this EXIF orientation holds it: the inverse of
    `images.turn_upright`."""
    from relit.images import turn_upright

    return turn_upright(array, TURN_BACK.get(orientation, orientation))


def encode_photo(model: CameraModel, shot: Shot, codes: np.ndarray, record: dict) -> bytes:
    """Bytes of the photo's file (JPEG or PNG) of upright codes (H, W, 3)."""
    image = PilImage.fromarray(stored(codes, shot.orientation))
    out = io.BytesIO()
    if not model.jpeg:
        image.save(out, "PNG", compress_level=4)
    elif model.exif:
        image.save(out, "JPEG", quality=model.jpeg, exif=exif_of(shot, record))
    else:
        image.save(out, "JPEG", quality=model.jpeg)
    return out.getvalue()


def exif_of(shot: Shot, record: dict) -> PilImage.Exif:
    """EXIF of a photo: orientation, exposure, ISO, f-number, flash (off) and focal lengths; those
    refer to the photo before it was cropped, as programs that crop leave them."""
    rational = TiffImagePlugin.IFDRational
    full = shot.camera.fx / shot.full_diagonal  # focal length in diagonals
    exif = PilImage.Exif()
    exif[0x010F], exif[0x0110] = "Relit", "synthetic phone"
    exif[0x0112] = shot.orientation
    exif[0x8769] = {
        0x829A: rational(round(record["exposure_time"] * 1_000_000), 1_000_000),
        0x829D: rational(round(F_NUMBER * 10), 10),
        0x8827: min(65535, max(1, round(record["iso"]))),
        0x9209: NO_FLASH,
        0x920A: rational(round(full * PHONE_DIAGONAL * 100), 100),
        0xA405: max(1, round(full * FULL_FRAME_DIAGONAL)),
    }
    return exif

"""Collections with known truth: photos of one object, each in another place, under another light,
by another camera.

The folder has SAMURAI's layout, with the truth beside it:

    image/000.jpg ...       8-bit sRGB with the surroundings in view, in landscape and portrait
    mask/000.png ...        roughened: the outline wanders by a pixel or two
    quadrants.json          SAMURAI's three answers for each photo
    held_out.json           {"frames": [names]}: photos that are for testing only
    truth/truth.json        what was rendered and how; written last
    truth/cameras.json      all cameras, in the world frame (y up)
    truth/mesh.ply
    truth/lights/NAME.exr   the light of each photo in the world frame, in units of the photo's
                            linear pixels
    truth/test/NAME.exr     linear RGBA, premultiplied on black, with
                            NAME_{albedo,normal,roughness,metallic,depth}.exr
    truth/train_albedo/NAME.exr     linear RGBA of a few training views, to fix the albedo scale

World frame: as in `synthesize.multiview`.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from relit.capture.readers.samurai import quadrant_of
from relit.conventions import sample_environment
from relit.errors import UserError
from relit.geometry.se3 import exp_so3, look_at
from relit.scene import Camera
from relit.synthesize.multiview import (
    LOWEST,
    RADIUS,
    claim_folder,
    identity_of,
    object_frame,
    overridden,
    radiance,
    tell_progress,
    write_json,
    write_mesh,
    write_test_view,
    write_training_view,
)

VERSION = 1
FIELD = (35.0, 65.0)  # degrees, along the longer side
FILL = (0.6, 0.9)  # the object sphere's share of the shorter side
ROLL, AIM = 12.0, 0.1  # degrees; share of the shorter side by which the object is off the middle
LEVEL = (0.45, 0.85)  # linear value of the 95th percentile of the object's brightest channel
WHITE_BALANCE = 0.12  # standard deviation of the log gain of red and of blue
LIGHT_ROWS = 64  # of the lights that are kept as truth
SCALE_VIEWS = 8


@dataclass(frozen=True)
class PhotoPlan:
    """One photo before it is taken. light: index of the HDRI, yaw: share of a turn. level, white:
    see LEVEL, WHITE_BALANCE."""

    name: str
    camera: Camera
    light: int
    yaw: float
    level: float
    white: np.ndarray
    test: bool


def synthesize_collection(
    asset_file: str | Path,
    light_files: Sequence[str | Path] | str | Path,
    out: str | Path,
    *,
    views: int = 60,
    test_views: int = 6,
    relights: Sequence[str | Path] = (),
    resolution: int = 400,
    spp: int = 48,
    test_spp: int = 192,
    seed: int = 0,
    roughness: float | None = None,
    metallic: float | None = None,
    rough_masks: float = 1.0,
    max_depth: int = 6,
    say: Callable[[str], None] = lambda text: None,
) -> Path:
    """Render a collection of one object with its truth into `out`; returns `out`.

    light_files: one or more lat-long .hdr or .exr; every photo takes one of them, turned about the
    vertical. resolution: the longer side.
    rough_masks: pixels by which outlines of masks wander, at resolution 400; 0 for true masks.
    relights stands for the call's shape. Deterministic by `seed`; takes up where a killed call
    stopped. Raises UserError as `synthesize_multiview`.
    """
    asset_file, out = Path(asset_file), Path(out)
    lights = [
        Path(f) for f in ([light_files] if isinstance(light_files, (str, Path)) else light_files)
    ]
    if relights:
        raise UserError(
            "a collection has no relighting truth: every photo has a light of its own",
            fix="leave out --relight",
            code=2,
        )
    least = {
        "views": (views, 4),
        "test_views": (test_views, 0),
        "resolution": (resolution, 16),
        "spp": (spp, 1),
        "test_spp": (test_spp, 1),
    }
    for label, (value, low) in least.items():
        if value < low:
            raise UserError(f"{label} = {value} is too few", fix=f"at least {low}", code=2)
    options = {
        "views": views,
        "test_views": test_views,
        "resolution": resolution,
        "spp": spp,
        "test_spp": test_spp,
        "seed": seed,
    }
    more = {
        "roughness": roughness,
        "metallic": metallic,
        "rough_masks": rough_masks,
        "max_depth": max_depth,
    }
    settings = settings_of(asset_file, lights, **options, **more)
    if claim_folder(out, settings):
        return out

    from relit.asset.asset import cameras_to_json
    from relit.asset.gltf import read_asset_file
    from relit.images import read_image

    mesh, material = read_asset_file(asset_file)
    material = overridden(material, roughness, metallic)
    world_from_asset = object_frame(mesh)
    shots = plan_shots(views, test_views, resolution, len(lights), seed)
    write_mesh(out / "truth" / "mesh.ply", mesh, world_from_asset)
    frames = [
        {"image_name": f"{s.name}.jpg", "quadrant": quadrant_of(s.camera.centre)} for s in shots
    ]
    write_json(out / "quadrants.json", {"frames": frames})
    test = [f"{s.name}.jpg" for s in shots if s.test]
    if test:
        write_json(out / "held_out.json", {"frames": test})
    write_json(
        out / "truth" / "cameras.json",
        cameras_to_json([(f"image/{s.name}.jpg", s.camera) for s in shots]),
    )
    training = [s.name for s in shots if not s.test]
    scale_names = {
        training[i]
        for i in np.unique(
            np.linspace(0, len(training) - 1, min(SCALE_VIEWS, len(training))).round().astype(int)
        )
    }
    environments = [read_image(file).rgb for file in lights]
    for i, shot in enumerate(shots):
        samples = test_spp if shot.test else spp
        take(
            out,
            shot,
            mesh,
            material,
            world_from_asset,
            environments,
            samples,
            max_depth,
            seed * 1_000_003 + i,
            rough_masks,
            scale_names,
        )
        tell_progress(say, "photo", i, len(shots))
    sphere = {"centre": [0.0, 0.0, 0.0], "radius": RADIUS}
    head = {
        "settings": settings,
        "world_from_asset": world_from_asset.tolist(),
        "sphere": sphere,
        "ior": material.ior,
    }
    names = {
        "train": training,
        "test": [s.name for s in shots if s.test],
        "train_albedo": sorted(scale_names),
        "relight": [],
    }
    write_json(out / "truth" / "truth.json", {**head, **names})
    return out


def settings_of(
    asset_file: str | Path, light_files: Sequence[str | Path], **options: Any
) -> dict[str, Any]:
    """Everything that a capture depends on."""
    lights = [
        Path(f) for f in ([light_files] if isinstance(light_files, (str, Path)) else light_files)
    ]
    if not lights:
        raise UserError("no light was given", fix="give one or more .hdr or .exr files", code=2)
    for what, file in (("asset", Path(asset_file)), *(("light", f) for f in lights)):
        if not file.is_file():
            raise UserError(f"no {what} file: {file}", fix="give an existing file")
    plain = {
        key: options.get(key, value)
        for key, value in synthesize_collection.__kwdefaults__.items()
        if key not in ("relights", "say")
    }
    return {
        "version": VERSION,
        "kind": "collection",
        "asset": identity_of(Path(asset_file)),
        "lights": [identity_of(f) for f in lights],
        **plain,
    }


# ---------------------------------------------------------------- where the cameras stand


def plan_shots(
    views: int, test_views: int, resolution: int, lights: int, seed: int
) -> list[PhotoPlan]:
    """All photos; test photos are spread evenly among the others."""
    rng, count = np.random.default_rng(seed), views + test_views
    order = rng.permutation(count)  # neighbours on the spiral are not neighbours in name
    test = {int((k + 0.5) * count / test_views) for k in range(test_views)}
    low = np.sin(np.radians(LOWEST))
    shots = []
    for i in range(count):
        j = int(order[i])
        y = np.clip(1 - (1 - low) * (j + 0.5 + rng.uniform(-0.3, 0.3)) / count, low, 0.998)
        azimuth = j * np.pi * (3 - np.sqrt(5)) + rng.normal() * 0.3 / np.sqrt(count)
        r = np.sqrt(1 - y * y)
        direction = np.array([r * np.cos(azimuth), y, r * np.sin(azimuth)])
        long, short = resolution, round(resolution * 0.75)
        w, h = (long, short) if rng.random() < 0.6 else (short, long)
        focal = 0.5 * long / np.tan(np.radians(rng.uniform(*FIELD)) / 2)
        seen = (
            0.5 * short * rng.uniform(*FILL)
        )  # pixels from the middle of the object to its sphere's outline
        distance = RADIUS * np.hypot(1, focal / seen)
        pose = look_at(direction * distance, roll=np.radians(rng.uniform(-ROLL, ROLL)))
        room = 0.5 * short - seen
        off = rng.uniform(-1, 1, 2) * min(AIM * short, room)
        pose[:3, :3] = pose[:3, :3] @ exp_so3(np.array([off[1], -off[0], 0]) / focal)
        white = np.exp(rng.normal(size=3) * WHITE_BALANCE * np.array([1, 0, 1]))
        camera = Camera(w, h, focal, focal, w / 2, h / 2, pose)
        shots.append(
            PhotoPlan(
                f"{i:03d}",
                camera,
                int(rng.integers(lights)),
                float(rng.random()),
                float(rng.uniform(*LEVEL)),
                white,
                i in test,
            )
        )
    return shots


# ---------------------------------------------------------------- one photo


def take(
    out: Path,
    shot: PhotoPlan,
    mesh,
    material,
    world_from_asset,
    environments,
    spp,
    max_depth,
    seed,
    rough_masks,
    scale_names,
) -> None:
    """Render one photo, its mask and its truth, unless they are there."""
    from relit.images import write_bytes, write_data, write_linear
    from relit.images.write import encode_jpeg
    from relit.reference.mitsuba_scene import build_scene

    photo, light_file = (
        out / "image" / f"{shot.name}.jpg",
        out / "truth" / "lights" / f"{shot.name}.exr",
    )
    if photo.exists():
        return
    environment = environments[shot.light]
    environment = np.roll(environment, round(shot.yaw * environment.shape[1]), axis=1)
    scene = build_scene(mesh, material, world_from_asset, environment)
    camera = shot.camera
    small = camera.resized(max(8, round(camera.width / 4)), max(8, round(camera.height / 4)))
    glimpse = radiance(scene, small, 48, max_depth, seed + 77)
    inside = glimpse[..., 3] > 0.99
    level = float(np.percentile(glimpse[..., :3][inside].max(-1), 95)) if inside.any() else 0.0
    if not level > 0:
        raise UserError(
            "the object is black under this light",
            "the light file holds no light, or the asset covers no pixel",
        )
    gain = (shot.white * shot.level / level).astype(np.float32)
    light = (environment * gain).astype(np.float32)
    shrink = max(1, environment.shape[0] // LIGHT_ROWS)
    write_linear(
        light_file,
        cv2.resize(
            light,
            (light.shape[1] // shrink, light.shape[0] // shrink),
            interpolation=cv2.INTER_AREA,
        ),
    )
    if shot.test or shot.name in scale_names:
        lit = build_scene(mesh, material, world_from_asset, light)
        if shot.test:
            write_test_view(out / "truth" / "png", lit, shot.name, camera, spp, max_depth, seed)
        else:
            write_training_view(out / "truth" / "png", lit, shot.name, camera, 16, 2, seed, True)
        keep_truth(out)
    rgba = radiance(scene, camera, spp, max_depth, seed)
    rgba[..., :3] *= gain
    behind = sample_environment(light, camera_directions(camera))
    write_data(out / "mask" / f"{shot.name}.png", roughened(rgba[..., 3], rough_masks, seed))
    picture = np.clip(rgba[..., :3] + behind * (1 - rgba[..., 3:]), 0, 1)
    write_bytes(photo, encode_jpeg(picture, 93))  # last: it says that the shot is complete


def keep_truth(out: Path) -> None:
    """Move what the multiview synthesizer wrote for a view to this layout's place."""
    made = out / "truth" / "png"
    for file in sorted((made / "truth").rglob("*.exr")):
        target = out / "truth" / file.relative_to(made / "truth")
        target.parent.mkdir(parents=True, exist_ok=True)
        file.replace(target)
    shutil.rmtree(made, ignore_errors=True)


def camera_directions(camera: Camera) -> np.ndarray:
    """(H, W, 3) unit world directions through the pixel centres."""
    u, v = np.meshgrid(
        (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx,
        (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy,
    )
    d = np.stack([u, v, np.ones_like(u)], -1) @ np.asarray(camera.world_from_camera)[:3, :3].T
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def roughened(alpha: np.ndarray, pixels: float, seed: int) -> np.ndarray:
    """A mask (H, W) whose outline wanders by about `pixels` (at 400 pixels a side) in and out over
    stretches of some pixels."""
    if pixels <= 0:
        return alpha
    scale = max(alpha.shape) / 400
    inside = cv2.distanceTransform(
        (alpha > 0.5).astype(np.uint8), cv2.DIST_L2, 5
    ) - cv2.distanceTransform((alpha <= 0.5).astype(np.uint8), cv2.DIST_L2, 5)
    noise = np.random.default_rng(seed + 5).normal(size=alpha.shape).astype(np.float32)
    noise = cv2.GaussianBlur(noise, (0, 0), max(4 * scale, 0.5))
    noise *= pixels * scale / max(float(noise.std()), 1e-6)
    return np.clip(0.5 + (inside - 0.5 * np.sign(inside) + noise) / (2 * scale), 0, 1).astype(
        np.float32
    )

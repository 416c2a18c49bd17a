"""Collections with known truth: photos of one object, each in another place, under another light,
by another camera.

The folder has SAMURAI's layout, with the truth beside it:

    image/000.jpg ...       8-bit sRGB with the surroundings in view, in landscape and portrait
    mask/000.png ...        roughened: the outline wanders by a pixel or two
    quadrants.json          SAMURAI's three answers for each photo, some of them wrong on demand
    held_out.json           {"frames": [names]}: photos that are for testing only
    truth/truth.json        what was rendered and how; written last
    truth/cameras.json      all cameras, in the world frame (y up)
    truth/mesh.ply
    truth/lights/NAME.exr   the light of each photo in the world frame, in units of the photo's
                            linear pixels
    truth/test/NAME.exr     linear RGBA, premultiplied on black, with
                            NAME_{albedo,normal,roughness,metallic,depth}.exr
    truth/train_albedo/NAME.exr     linear RGBA of a few training views, to fix the albedo scale
    truth/relight/LIGHT.exr  truth/relight/LIGHT/NAME.exr   other lights, and the views of the test
                                                            photos under them

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
from relit.synthesize.ceiling import ceilings
from relit.synthesize.mask_errors import MaskErrors, MaskFault, draw_fault, occluded
from relit.synthesize.multiview import (
    LOWEST,
    RADIUS,
    check_relight_names,
    claim_folder,
    exposed,
    identity_of,
    object_frame,
    overridden,
    radiance,
    tell_progress,
    write_json,
    write_mesh,
    write_radiance,
    write_scale_view,
    write_test_view,
)
from relit.synthesize.renderers import TrueObject, build_truth, depth_of, require_renderer

VERSION = 1
FIELD = (35.0, 65.0)  # degrees, along the longer side
FILL = (0.6, 0.9)  # the object sphere's share of the shorter side
ROLL, AIM = 12.0, 0.1  # degrees; share of the shorter side by which the object is off the middle
LEVEL = (0.45, 0.85)  # linear value of the 95th percentile of the object's brightest channel
WHITE_BALANCE = 0.12  # standard deviation of the log gain of red and of blue
LIGHT_ROWS = 64  # of the lights that are kept as truth
SCALE_VIEWS = 8
# Options that came later: a capture at these values has the settings, and the hash, of before.
LATER = {"renderer": "relit", "roll": ROLL, "wrong_hints": 0.0, "occluders": 0.0, "relights": []}


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
    renderer: str = "relit",
    roughness: float | None = None,
    metallic: float | None = None,
    rough_masks: float = 1.0,
    roll: float = ROLL,
    wrong_hints: float = 0.0,
    occluders: float = 0.0,
    max_depth: int | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> Path:
    """Render a collection of one object with its truth into `out`; returns `out`.

    light_files: one or more lat-long .hdr or .exr; every photo takes one of them, turned about the
    vertical. resolution: the longer side.
    rough_masks: pixels by which outlines of masks wander, at resolution 400; 0 for true masks.
    relights: lights of the relighting truth. renderer: one of `synthesize.renderers.RENDERERS`.
    roll: largest turn of a camera about its axis, degrees. wrong_hints: share of the photos, rounded
    up, whose answers are those of another octant. occluders: share of the training photos with a
    hand or a stand in front of the object; it is no part of the mask. Deterministic by `seed`; takes
    up where a killed call stopped. Raises UserError as `synthesize_multiview`.
    """
    asset_file, out = Path(asset_file), Path(out)
    lights = [
        Path(f) for f in ([light_files] if isinstance(light_files, (str, Path)) else light_files)
    ]
    relights, max_depth = [Path(r) for r in relights], depth_of(renderer, max_depth)
    check_relight_names(relights)
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
    _check_shares(wrong_hints=wrong_hints, occluders=occluders, roll=roll / 180)
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
    more |= {
        "renderer": renderer,
        "roll": roll,
        "wrong_hints": wrong_hints,
        "occluders": occluders,
        "relights": relights,
    }
    settings = settings_of(asset_file, lights, **options, **more)
    if not (out / "truth" / "truth.json").exists():
        require_renderer(renderer)  # before anything is written
    if claim_folder(out, settings):
        return out

    from relit.asset.asset import cameras_to_json
    from relit.asset.gltf import read_asset_file
    from relit.images import read_image

    mesh, material = read_asset_file(asset_file)
    material = overridden(material, roughness, metallic)
    thing = TrueObject(mesh, material, object_frame(mesh))
    shots = plan_shots(views, test_views, resolution, len(lights), (seed, roll))
    write_mesh(out / "truth" / "mesh.ply", mesh, thing.world_from_asset)
    hints, wrong = octant_hints(shots, wrong_hints, seed)
    frames = [{"image_name": f"{name}.jpg", "quadrant": hint} for name, hint in hints.items()]
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
    stage = _Stage(
        out,
        thing,
        [read_image(file).rgb for file in lights],
        renderer,
        max_depth,
        rough_masks,
        MaskErrors(occluders=occluders),
        frozenset(scale_names),
    )
    for i, shot in enumerate(shots):
        take(stage, shot, test_spp if shot.test else spp, seed * 1_000_003 + i)
        tell_progress(say, "photo", i, len(shots))
    held = [(s.name, s.camera) for s in shots if s.test]
    under = _relighting_truth(stage, relights, held, test_spp, seed * 1_000_003 + 600_000)
    head = {
        "settings": settings,
        "world_from_asset": thing.world_from_asset.tolist(),
        "sphere": {"centre": [0.0, 0.0, 0.0], "radius": RADIUS},
        "ior": material.ior,
        "wrong_hints": wrong,
        **({"ceiling": ceilings(thing, under, test_spp, seed, say)} if under else {}),
    }
    names = {
        "train": training,
        "test": [s.name for s in shots if s.test],
        "train_albedo": sorted(scale_names),
        "relight": [file.stem for file in relights] if held else [],
    }
    write_json(out / "truth" / "truth.json", {**head, **names})
    return out


def _check_shares(**shares: float) -> None:
    for label, value in shares.items():
        if not 0 <= value <= 1:
            what = "roll is outside 0 to 180 degrees" if label == "roll" else f"{label} = {value}"
            raise UserError(what, "" if label == "roll" else "it is a share", code=2)


def settings_of(
    asset_file: str | Path, light_files: Sequence[str | Path], **options: Any
) -> dict[str, Any]:
    """Everything that a capture depends on."""
    lights = [
        Path(f) for f in ([light_files] if isinstance(light_files, (str, Path)) else light_files)
    ]
    if not lights:
        raise UserError("no light was given", fix="give one or more .hdr or .exr files", code=2)
    relights = [Path(f) for f in options.pop("relights", ())]
    for what, file in (("asset", Path(asset_file)), *(("light", f) for f in [*lights, *relights])):
        if not file.is_file():
            raise UserError(f"no {what} file: {file}", fix="give an existing file")
    plain = {
        key: options.get(key, value)
        for key, value in synthesize_collection.__kwdefaults__.items()
        if key not in ("relights", "say")
    }
    plain["max_depth"] = depth_of(plain["renderer"], plain["max_depth"])
    plain |= {"relights": [identity_of(f) for f in relights]}
    plain = {k: v for k, v in plain.items() if k not in LATER or v != LATER[k]}
    return {
        "version": VERSION,
        "kind": "collection",
        "asset": identity_of(Path(asset_file)),
        "lights": [identity_of(f) for f in lights],
        **plain,
    }


# ---------------------------------------------------------------- where the cameras stand


def octant_hints(
    shots: Sequence[PhotoPlan], wrong: float, seed: int
) -> tuple[dict[str, Any], list[str]]:
    """({name: SAMURAI's answers}, names of those that are wrong). wrong: share of the photos,
    rounded up, whose answers are those for a random camera in another octant."""
    hints = {s.name: quadrant_of(s.camera.centre) for s in shots}
    rng = np.random.default_rng([seed, 73])
    count = int(np.ceil(wrong * len(shots)))
    chosen = sorted(shots[i].name for i in rng.permutation(len(shots))[:count])
    for name in chosen:
        true = hints[name]
        while hints[name] == true:
            hints[name] = quadrant_of(rng.normal(size=3))
    return hints, chosen


def plan_shots(
    views: int, test_views: int, resolution: int, lights: int, draw: tuple[int, float]
) -> list[PhotoPlan]:
    """All photos; test photos are spread evenly among the others. draw: seed, and the largest roll
    in degrees."""
    seed, roll = draw
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
        pose = look_at(direction * distance, roll=np.radians(rng.uniform(-roll, roll)))
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


@dataclass(frozen=True)
class _Stage:
    """What all photos share. environments: radiance of the lights. rough_masks: see
    `synthesize_collection`. scale: names of photos whose albedo is kept."""

    out: Path
    thing: TrueObject
    environments: Sequence[np.ndarray]
    renderer: str
    max_depth: int
    rough_masks: float
    errors: MaskErrors
    scale: frozenset[str]


def take(stage: _Stage, shot: PhotoPlan, spp: int, seed: int) -> None:
    """Render one photo, its mask and its truth, unless they are there."""
    from relit.images import write_bytes, write_data, write_linear
    from relit.images.write import encode_jpeg

    out, max_depth = stage.out, stage.max_depth
    photo, light_file = (
        out / "image" / f"{shot.name}.jpg",
        out / "truth" / "lights" / f"{shot.name}.exr",
    )
    if photo.exists():
        return
    environment = stage.environments[shot.light]
    environment = np.roll(environment, round(shot.yaw * environment.shape[1]), axis=1)
    scene = build_truth(stage.renderer, stage.thing, environment, max_depth)
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
    if shot.test or shot.name in stage.scale:
        lit = build_truth(stage.renderer if shot.test else "relit", stage.thing, light, max_depth)
        if shot.test:
            write_test_view(out / "truth" / "png", lit, shot.name, camera, spp, max_depth, seed)
        else:
            write_scale_view(out / "truth" / "png", lit, shot.name, camera)
        lit.close()
        keep_truth(out)
    rgba = radiance(scene, camera, spp, max_depth, seed)
    scene.close()
    rgba[..., :3] *= gain
    behind = sample_environment(light, camera_directions(camera))
    picture, mask = rgba[..., :3] + behind * (1 - rgba[..., 3:]), rgba[..., 3]
    fault = MaskFault(False, "", "", seed) if shot.test else draw_fault(stage.errors, seed)
    if fault.occluder:
        picture, mask = occluded(picture, mask, fault)
    write_data(out / "mask" / f"{shot.name}.png", roughened(mask, stage.rough_masks, seed))
    picture = np.clip(picture, 0, 1)
    write_bytes(photo, encode_jpeg(picture, 93))  # last: it says that the shot is complete


def _relighting_truth(
    stage: _Stage,
    relights: Sequence[Path],
    test: Sequence[tuple[str, Camera]],
    spp: int,
    seed: int,
) -> dict[str, tuple[Path, list[tuple[Path, Camera]]]]:
    """Render the views of the test photos under each light; returns the files by light, as
    `ceilings` takes them."""
    from relit.images import read_image, write_linear

    under = {}
    for j, file in enumerate(relights if test else ()):
        folder = stage.out / "truth" / "relight" / file.stem
        scene, light = exposed(
            stage.renderer, stage.thing, read_image(file).rgb, test, stage.max_depth
        )
        write_linear(folder.with_suffix(".exr"), light)
        pictures = [(folder / f"{name}.exr", camera) for name, camera in test]
        for i, (target, camera) in enumerate(pictures):
            write_radiance(target, scene, camera, spp, stage.max_depth, seed + 1000 * j + i)
        scene.close()
        under[file.stem] = (folder.with_suffix(".exr"), pictures)
    return under


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

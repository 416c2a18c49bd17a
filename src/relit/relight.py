"""Pictures of an asset under another light."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from relit.asset.asset import find_asset, load_asset, read_cameras
from relit.conventions import move_points, move_pose, rotate_environment, srgb_from_linear
from relit.errors import EXIT_ENVIRONMENT, EXIT_USAGE, UserError
from relit.images import read_image, write_linear, write_srgb
from relit.lighting.spherical_gaussians import environment_of, read_lobes
from relit.reference.mitsuba_scene import render
from relit.reference.photographed import lit_scene
from relit.scene import Asset, Camera, Material

FRAMES_PER_SECOND = 24
ORBIT_SIZE = 512  # pixels
ORBIT_ELEVATION = 20.0  # degrees
ORBIT_FIELD = 35.0  # degrees, vertical
MAX_ORBIT = 10_000


def relight(
    folder_or_run: str | Path,
    light: str | Path,
    out: str | Path,
    *,
    cameras: str | Path = "capture",
    spp: int = 64,
    size: int | None = None,
    exr: bool = False,
    albedo_scale=None,
    rotate: float = 0.0,
    max_depth: int = 6,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> list[Path]:
    """Render the asset under `light` and return the files written.

    light: lat-long .hdr / .exr, or .json of spherical Gaussians, upright in the asset's frame (its
    top over the object's top); a file in the asset's own `lights/` stands in the world frame, as it
    was recovered. rotate: turns the light about the object's up, degrees.
    cameras: 'capture' (the asset's own), 'orbit:N' (a turntable of N pictures), or a
    transforms.json in the world frame.
    out: a folder (PNG on black, sRGB, clipped at 1; also linear RGBA .exr with exr=True) or
    FILE.mp4 (24 pictures a second). Of duplicates cameras of the world show all instances on their
    ground, a turntable the object alone.
    size: longer side in pixels. albedo_scale: number or 3 that multiply the base colour. progress:
    called with (done, all), in samples a pixel of all pictures.
    """
    out, light = Path(out), Path(light)
    if spp < 1 or (size is not None and not 8 <= size <= 16384):
        raise UserError("--spp must be at least 1 and --size between 8 and 16384", code=EXIT_USAGE)
    folder = find_asset(folder_or_run)
    asset = load_asset(folder)
    views = _views(asset, cameras, size)
    environment = _placed_light(light, folder, asset, rotate)
    material = asset.material if albedo_scale is None else _scaled(asset.material, albedo_scale)
    scene = lit_scene(
        replace(asset, material=material, environment=environment),
        whole=not str(cameras).startswith("orbit"),
    )
    files = []
    video = out.suffix.lower() == ".mp4"
    with _video(out, views[0][1]) if video else _folder(out) as add:
        for i, (name, camera) in enumerate(views):
            if video and (camera.width, camera.height) != (views[0][1].width, views[0][1].height):
                raise UserError(
                    "the cameras have different sizes, a video has one",
                    fix="write pictures to a folder, or use orbit:N",
                )
            told = (
                None
                if progress is None
                else lambda samples, of, i=i: progress(i * of + samples, len(views) * of)
            )
            files += add(
                name,
                render(scene, camera, spp=spp, seed=seed + i, max_depth=max_depth, progress=told),
                exr,
            )
    return [out] if video else files


# ---------------------------------------------------------------- light


def read_light(path: Path) -> np.ndarray:
    """(H, W, 3) lat-long radiance from .hdr, .exr or spherical Gaussians in .json. Raises
    UserError."""
    suffix = path.suffix.lower()
    if suffix == ".json":
        return environment_of(read_lobes(path))
    if suffix not in (".hdr", ".exr"):
        fix = f"give a lat-long .hdr or .exr, or a .json of spherical Gaussians: {path}"
        raise UserError(f"'{suffix}' is not a light", "a light needs linear radiance", fix)
    image = read_image(path).rgb
    if (image < 0).any():
        image = np.maximum(image, 0)
    if not image.any():
        raise UserError(
            "the light is black", "every texel of the map is 0", f"choose another: {path}"
        )
    return image


def _placed_light(path: Path, folder: Path, asset: Asset, degrees: float) -> np.ndarray:
    """The light in the world frame."""
    light = read_light(path)
    own = (folder / "lights").resolve() in path.resolve().parents
    a = np.radians(degrees)
    turn = np.array(
        [[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]]
    )  # about +Y of the asset frame
    rotation = asset.world_from_asset[:3, :3] / np.cbrt(
        np.linalg.det(asset.world_from_asset[:3, :3])
    )
    world_from_light = rotation @ turn @ (rotation.T if own else np.eye(3))
    return (
        light
        if np.allclose(world_from_light, np.eye(3), atol=1e-9)
        else rotate_environment(light, world_from_light)
    )


def _scaled(material: Material, scale) -> Material:
    scale = np.asarray(scale, np.float32).ravel()
    if scale.size not in (1, 3) or not np.isfinite(scale).all() or (scale <= 0).any():
        raise UserError("the albedo scale must be one or three positive numbers", code=EXIT_USAGE)
    return replace(
        material, base_color=np.clip(material.base_color * scale, 0, 1).astype(np.float32)
    )


# ---------------------------------------------------------------- cameras


def orbit(asset: Asset, count: int, size: int = ORBIT_SIZE) -> list[tuple[str, Camera]]:
    """A turntable: `count` square views round the object's up that hold its bounding sphere, in the
    world frame."""
    return [
        (f"{i:04d}", orbit_camera(asset, 360 * i / count, ORBIT_ELEVATION, size))
        for i in range(count)
    ]


def orbit_camera(asset: Asset, azimuth: float, elevation: float, size: int = ORBIT_SIZE) -> Camera:
    """A square view that holds the object's bounding sphere, in the world frame. azimuth: degrees
    round the object's up, from +Z towards +X. elevation: degrees above its horizon, -90 to 90."""
    low, high = asset.mesh.vertices.min(0), asset.mesh.vertices.max(0)
    centre = (low + high).astype(np.float64) / 2
    radius = max(float(np.linalg.norm(asset.mesh.vertices - centre, axis=1).max()), 1e-9)
    half, a, e = np.radians([ORBIT_FIELD / 2, azimuth, elevation])
    distance, focal = 1.05 * radius / np.sin(half), 0.5 * size / np.tan(half)
    back = np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
    right = np.array([np.cos(a), 0, -np.sin(a)])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(-back, right), -back], 1)
    pose[:3, 3] = centre + distance * back
    return Camera(
        size, size, focal, focal, size / 2, size / 2, move_pose(asset.world_from_asset, pose)
    )


def _views(asset: Asset, which: str | Path, size: int | None) -> list[tuple[str, Camera]]:
    text = str(which)
    if text == "capture":
        views = list(asset.cameras)
        if not views:
            raise UserError(
                "the asset has no cameras",
                "it was made without them",
                "use --cameras orbit:60 or a transforms.json",
            )
    elif text.startswith("orbit"):
        match = re.fullmatch(r"orbit:(\d{1,6})", text)
        if match is None or not 1 <= int(match[1]) <= MAX_ORBIT:
            raise UserError(
                f"'{text}' is not a turntable",
                fix=f"write orbit:N with N from 1 to {MAX_ORBIT}",
                code=EXIT_USAGE,
            )
        return orbit(asset, int(match[1]), size or ORBIT_SIZE)
    else:
        views = list(read_cameras(text))
        if not views:
            raise UserError("the camera file has no frames", fix=f"check it: {text}")
    views = [
        (name, replace(camera, distortion=())) for name, camera in views
    ]  # pictures are those of the undistorted photos
    if size is not None:
        views = [(name, _resized(camera, size)) for name, camera in views]
    _in_sight(asset, views)
    return list(zip(_file_names([n for n, _ in views]), [c for _, c in views], strict=True))


def _resized(camera: Camera, size: int) -> Camera:
    s = size / max(camera.width, camera.height)
    return camera.resized(max(round(camera.width * s), 1), max(round(camera.height * s), 1))


def _in_sight(asset: Asset, views) -> None:
    """Refuse cameras none of which has the object before it: a file in another frame."""
    corners = move_points(
        asset.world_from_asset, asset.mesh.vertices[:: max(len(asset.mesh.vertices) // 500, 1)]
    )
    for _, camera in views:
        x, y, z = camera.project(corners).T
        if ((z > 0) & (x > 0) & (x < camera.width) & (y > 0) & (y < camera.height)).any():
            return
    raise UserError(
        "no camera sees the object",
        "the cameras are probably in another frame than the asset's cameras.json",
        "check the file",
    )


def _file_names(names: list[str]) -> list[str]:
    """Short unique file names: the stem where it is unique, else the whole path with separators
    replaced."""
    stems = [Path(n).stem for n in names]
    if len(set(stems)) < len(stems):
        stems = [
            re.sub(r"[^\w.-]+", "_", str(Path(n).with_suffix(""))).strip("._") or "view"
            for n in names
        ]
    if len(set(stems)) < len(stems):
        stems = [f"{i:04d}" for i in range(len(names))]
    return stems


# ---------------------------------------------------------------- output


@contextmanager
def _folder(out: Path) -> Iterator[Callable]:
    if out.exists() and not out.is_dir():
        raise UserError(
            "the output is a file, not a folder",
            "pictures go to a folder, a video to FILE.mp4",
            f"give another -o: {out}",
        )

    def add(name: str, picture: np.ndarray, exr: bool) -> list[Path]:
        files = [out / f"{name}.png"]
        write_srgb(files[0], picture[..., :3])
        if exr:
            files.append(out / f"{name}.exr")
            write_linear(files[1], picture)
        return files

    yield add


@contextmanager
def _video(out: Path, camera: Camera) -> Iterator[Callable]:
    """A video that appears under its name when it is whole: H.264 by imageio-ffmpeg (an optional
    extra), else MPEG-4 by OpenCV."""
    width, height = camera.width - camera.width % 2, camera.height - camera.height % 2
    out.parent.mkdir(parents=True, exist_ok=True)
    partial = out.with_name(f".{out.stem}-{os.getpid()}.mp4")
    push, close = _encoder(partial, width, height)

    def add(_name: str, picture: np.ndarray, _exr: bool) -> list[Path]:
        codes = (np.clip(srgb_from_linear(picture[:height, :width, :3]), 0, 1) * 255 + 0.5).astype(
            np.uint8
        )
        push(np.ascontiguousarray(codes))
        return []

    try:
        yield add
        close()
        os.replace(partial, out)
    except OSError as e:
        raise UserError(
            "the video could not be written",
            str(e),
            f"free some space, or write pictures: {out}",
            code=EXIT_ENVIRONMENT,
        ) from e
    finally:
        with suppress(Exception):
            close()
        partial.unlink(missing_ok=True)


def _encoder(path: Path, width: int, height: int) -> tuple[Callable, Callable]:
    """(function that takes an RGB uint8 picture, function that finishes the file)."""
    try:
        import imageio_ffmpeg  # pyright: ignore[reportMissingImports]
    except ImportError:
        import cv2

        writer = cv2.VideoWriter(
            str(path),
            cv2.VideoWriter_fourcc(*"mp4v"),  # pyright: ignore[reportAttributeAccessIssue]
            FRAMES_PER_SECOND,
            (width, height),
        )
        if not writer.isOpened():
            fix = "pip install 'relit[video]', or write pictures to a folder"
            raise UserError(
                "OpenCV cannot write MPEG-4 videos here",
                "its build has no such encoder",
                fix,
                code=EXIT_ENVIRONMENT,
            ) from None
        return (lambda rgb: writer.write(rgb[..., ::-1])), writer.release
    frames = imageio_ffmpeg.write_frames(
        str(path), (width, height), fps=FRAMES_PER_SECOND, quality=8, macro_block_size=1
    )
    frames.send(None)
    return frames.send, frames.close

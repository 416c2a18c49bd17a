"""The asset folder: what `reconstruct` leaves and everything after it reads.

    asset.json  object.glb  textures/{base_color,roughness,metallic,specular,normal}.png
    cameras.json  lights/environment.{exr,hdr} lights/flash.json  textures/diffuse_albedo.exr

Nothing in it is absolute: the folder can be moved. `object.glb` is the one source of shape and
material; `textures/` holds copies of its images for other tools. One thing a GLB cannot say: of a
rough plastic the base colour in it is what looks like the diffuse albedo under glTF, and the
diffuse albedo itself is textures/diffuse_albedo.exr (`diffuse_albedo` in asset.json names it).
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from relit.asset.colmap_text import write_colmap
from relit.asset.gltf import read_asset_file, write_glb
from relit.asset.instances import read_instances, write_instances
from relit.asset.mitsuba_plastic import DIFFUSE
from relit.conventions import world_from_cv_camera, world_from_gl_camera
from relit.errors import EXIT_ENVIRONMENT, UserError
from relit.images import read_image, write_data, write_linear, write_srgb
from relit.lighting.flash import flash_json, read_flash
from relit.materials.plastic_as_gltf import base_colour
from relit.scene import Asset, Camera, Material

SCHEMA = 1
MAX_JSON = 64 << 20  # bytes
RESERVED = ("schema", "world_from_asset", "diffuse_albedo")
DISTORTION = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


# ---------------------------------------------------------------- cameras.json


def cameras_to_json(cameras) -> dict:
    """(name, Camera) pairs -> nerfstudio's `transforms.json`: OpenGL axes, pixels, one intrinsics
    block a frame."""
    frames = []
    for name, c in cameras:
        frame = {
            "file_path": str(name),
            "w": c.width,
            "h": c.height,
            "fl_x": c.fx,
            "fl_y": c.fy,
            "cx": c.cx,
            "cy": c.cy,
        }
        frame |= {k: float(v) for k, v in zip(DISTORTION, c.distortion, strict=False)}
        frame["transform_matrix"] = world_from_gl_camera(c.world_from_camera).tolist()
        frames.append(frame)
    return {"camera_model": "OPENCV", "frames": frames}


def cameras_from_json(data: dict, where: str | Path = "") -> tuple[tuple[str, Camera], ...]:
    """Inverse of `cameras_to_json`; keys may also stand once for all frames. Raises UserError for
    missing or senseless numbers."""
    out = []
    try:
        for i, frame in enumerate(data["frames"]):
            f = {**{k: v for k, v in data.items() if k != "frames"}, **frame}
            pose = np.array(f["transform_matrix"], np.float64)
            pose = np.vstack([pose, [0, 0, 0, 1]]) if pose.shape == (3, 4) else pose
            width, height = int(f["w"]), int(f["h"])
            if "fl_x" not in f and "camera_angle_x" in f:
                f["fl_x"] = 0.5 * width / np.tan(0.5 * float(f["camera_angle_x"]))
            numbers = [
                float(f["fl_x"]),
                float(f.get("fl_y", f["fl_x"])),
                float(f.get("cx", width / 2)),
                float(f.get("cy", height / 2)),
            ]
            if (
                pose.shape != (4, 4)
                or not np.isfinite(pose).all()
                or not np.isfinite(numbers).all()
                or min(numbers[:2]) <= 0
            ):
                raise ValueError(f"frame {i} has a pose or intrinsics that make no sense")
            if not (0 < width <= 32768 and 0 < height <= 32768):
                raise ValueError(f"frame {i} is {width} x {height} pixels")
            if abs(np.linalg.det(pose[:3, :3]) - 1) > 1e-2:
                raise ValueError(f"the rotation of frame {i} is not a rotation")
            k = [float(f.get(name, 0.0)) for name in DISTORTION]
            while k and k[-1] == 0.0:
                k.pop()
            k += [0.0] * (max(0, 4 - len(k)) if k else 0)
            out.append(
                (
                    str(f.get("file_path", f"{i:04d}")),
                    Camera(width, height, *numbers, world_from_cv_camera(pose), tuple(k)),  # pyright: ignore[reportCallIssue]
                )
            )
    except (KeyError, TypeError, ValueError, OverflowError) as e:
        raise UserError(
            "the camera file cannot be used", f"{type(e).__name__}: {e}", f"check it: {where}"
        ) from None
    return tuple(out)


def read_cameras(path: str | Path) -> tuple[tuple[str, Camera], ...]:
    """(name, Camera) pairs of a `cameras.json` / `transforms.json` file with w, h, fl_x (or
    camera_angle_x) and OpenGL poses."""
    return cameras_from_json(read_bounded_json(Path(path)), path)


def read_bounded_json(path: Path) -> dict:
    """A JSON object from a file of bounded size. Raises UserError."""
    if not path.is_file():
        raise UserError("a file is missing", fix=f"check the path: {path}")
    if path.stat().st_size > MAX_JSON:
        raise UserError(
            f"a JSON file is larger than {MAX_JSON >> 20} MB",
            "it is not one of Relit's",
            f"check the path: {path}",
        )
    try:
        data = json.loads(path.read_text())
    except (ValueError, RecursionError) as e:
        raise UserError(
            "a JSON file cannot be read", str(e), f"mend it or write it again: {path}"
        ) from None
    if not isinstance(data, dict):
        raise UserError("a JSON file holds no object", fix=f"check the path: {path}")
    return data


# ---------------------------------------------------------------- the folder


def find_asset(folder_or_run: str | Path) -> Path:
    """The asset folder itself, or `asset/` in a run folder. Raises UserError saying what was looked
    for."""
    root = Path(folder_or_run)
    for folder in (root, root / "asset"):
        if (folder / "asset.json").is_file():
            return folder
    why = (
        "neither asset.json nor asset/asset.json is there"
        if root.is_dir()
        else "the folder does not exist"
    )
    if (root / "config.toml").is_file():
        why = "the reconstruction in it has not finished"
    raise UserError(
        "this is not an asset folder",
        why,
        f"give the folder that `relit reconstruct -o` wrote: {root}",
    )


def save_textures(folder: Path, material: Material) -> None:
    """Write the maps of a material as 8-bit PNGs: base_color in sRGB, the others without a curve
    (normal as (n + 1) / 2); the diffuse albedo of a rough plastic as linear EXR."""
    folder.mkdir(parents=True, exist_ok=True)
    write_srgb(folder / "base_color.png", material.base_color)
    write_data(folder / "roughness.png", material.roughness)
    write_data(folder / "metallic.png", material.metallic)
    if material.specular is not None:
        write_data(folder / "specular.png", material.specular)
    if material.normal is not None:
        write_data(folder / "normal.png", np.asarray(material.normal) * 0.5 + 0.5)
    if material.diffuse is not None:
        write_linear(folder / DIFFUSE, material.diffuse)


def save_asset(folder: str | Path, asset: Asset) -> Path:
    """Write the asset folder, whole or not at all; an asset folder that is there is replaced, any
    other is refused. Returns the folder."""
    folder = Path(folder)
    if folder.exists() and (
        not folder.is_dir() or (any(folder.iterdir()) and not (folder / "asset.json").is_file())
    ):
        raise UserError(
            "there is something else at the place of the asset folder",
            "it is not overwritten",
            f"choose another: {folder}",
        )
    taken = [k for k in RESERVED if k in asset.meta]
    if taken:
        raise ValueError(f"asset.meta must not hold {taken}")
    head = {
        "schema": SCHEMA,
        "world_from_asset": np.asarray(asset.world_from_asset, np.float64).tolist(),
        **asset.meta,
    }
    if asset.material.diffuse is not None:
        head["diffuse_albedo"] = f"textures/{DIFFUSE}"
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        new = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
        try:
            os.chmod(new, 0o755)
            write_glb(new / "object.glb", asset.mesh, asset.material)
            save_textures(new / "textures", asset.material)
            _write_json(new / "cameras.json", cameras_to_json(asset.cameras))
            if asset.environment is not None:
                (new / "lights").mkdir()
                write_linear(new / "lights" / "environment.exr", asset.environment)
                write_linear(new / "lights" / "environment.hdr", asset.environment)
            if asset.lights:  # a collection: its cameras are a result that other programs want
                write_colmap(new / "colmap", asset.cameras)
            for i, light in enumerate(asset.lights):
                (new / "lights").mkdir(exist_ok=True)
                write_linear(new / "lights" / f"photo_{i:04d}.exr", light)
            if asset.flash is not None:
                (new / "lights").mkdir(exist_ok=True)
                (new / "lights" / "flash.json").write_text(flash_json(asset.flash))
            if asset.instances:
                write_instances(new, asset)
            _write_json(new / "asset.json", head)
            _swap(new, folder)
        finally:
            shutil.rmtree(new, ignore_errors=True)
    except OSError as e:
        raise UserError(
            "the asset could not be written",
            str(e),
            f"free some space or choose another folder: {folder}",
            code=EXIT_ENVIRONMENT,
        ) from e
    return folder


def _write_json(path: Path, data: dict) -> None:
    path.write_text(json.dumps(data, indent=1, allow_nan=False) + "\n")


def _swap(new: Path, folder: Path) -> None:
    """Put `new` in the place of `folder`; the old one stands beside it under a hidden name until
    the new one is there."""
    if not folder.exists():
        os.replace(new, folder)
        return
    old = Path(tempfile.mkdtemp(prefix=f".{folder.name}-old-", dir=folder.parent))
    os.replace(folder, old)
    os.replace(new, folder)
    shutil.rmtree(old, ignore_errors=True)


def load_asset(folder_or_run: str | Path) -> Asset:
    """Read an asset folder (or the one in a run folder). Raises UserError for folders that are no
    asset, damaged or too new."""
    folder = find_asset(folder_or_run)
    head = read_bounded_json(folder / "asset.json")
    schema = head.get("schema")
    if not isinstance(schema, int):
        raise UserError(
            "asset.json has no schema version",
            "it is not one of Relit's",
            f"check the folder: {folder}",
        )
    if schema > SCHEMA:
        raise UserError(
            f"the asset has schema version {schema}, this Relit reads up to {SCHEMA}",
            "a newer Relit wrote it",
            "update Relit",
        )
    try:
        world_from_asset = np.array(head["world_from_asset"], np.float64)
        singular = (
            not np.isfinite(world_from_asset).all() or abs(np.linalg.det(world_from_asset)) < 1e-30
        )
        if world_from_asset.shape != (4, 4) or singular:
            raise ValueError("not a regular 4 x 4 matrix")
    except (KeyError, TypeError, ValueError, OverflowError) as e:
        why = f"{type(e).__name__}: {e}"
        raise UserError(
            "world_from_asset in asset.json cannot be used", why, f"reconstruct again: {folder}"
        ) from None
    mesh, material = read_asset_file(folder / "object.glb")
    light = next(
        (
            folder / "lights" / f"environment.{s}"
            for s in ("exr", "hdr")
            if (folder / "lights" / f"environment.{s}").is_file()
        ),
        None,
    )
    environment = None if light is None else read_image(light).rgb
    cameras = read_cameras(folder / "cameras.json") if (folder / "cameras.json").is_file() else ()
    flash = (
        read_flash(folder / "lights" / "flash.json")
        if (folder / "lights" / "flash.json").is_file()
        else None
    )
    files = [folder / "lights" / f"photo_{i:04d}.exr" for i in range(len(cameras))]
    lights = (
        tuple(read_image(f).rgb for f in files) if files and all(f.is_file() for f in files) else ()
    )
    meta = {k: v for k, v in head.items() if k not in RESERVED}
    instances, ground = read_instances(folder)
    material = _with_diffuse(material, head, folder)
    return Asset(
        mesh,
        material,
        world_from_asset,
        environment,
        cameras,
        meta,
        flash,
        instances,
        ground,
        lights,
    )


def _with_diffuse(material: Material, head: dict, folder: Path) -> Material:
    """The material as the GLB tells it, with the diffuse albedo of a rough plastic."""
    if "diffuse_albedo" in head:
        file = folder / "textures" / DIFFUSE
        if not file.is_file():
            why = "a flash capture's diffuse albedo is not in the GLB"
            raise UserError(
                "textures/diffuse_albedo.exr is missing",
                why,
                f"put it back, or reconstruct again: {folder}",
            )
        return replace(material, diffuse=read_image(file).rgb)
    if head.get("material") != "rough_plastic":
        return material
    diffuse = material.base_color  # Relit up to 0.1 wrote the diffuse albedo itself as base colour
    return replace(
        material,
        diffuse=diffuse,
        base_color=base_colour(diffuse, material.roughness, material.specular, material.ior),
    )

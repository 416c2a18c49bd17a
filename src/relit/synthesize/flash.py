"""Flash captures with known truth: photos of a rough plastic in a dark room, lit by a point light
that moves with the camera.

The folder has the layout of IRON and PIR, with what Relit measures besides under `truth/`:

    train/cam_dict_norm.json  train/image/r_000.exr  train/mask/r_000.png
    test/cam_dict_norm.json   test/image/t_000.exr   test/mask/t_000.png
    test/{diffuse_albedo,specular_albedo,specular_roughness}/t_000.exr     linear; roughness is the
    lobe's width alpha
    light.txt  light_offset.txt             radiant intensity; offset in OpenCV camera axes (its
                                            first line says so), world units
    truth/truth.json  truth/mesh.ply  truth/normal/t_000.exr               coverage is the normals'
    alpha

The object: shape and colours of a GLB or OBJ. Colours are the diffuse albedo; specular albedo and
roughness vary over the surface with the paint (three groups of colours) and slowly with the place.
Or, with material='own', the file's own metallic-roughness material by Mitsuba's `principled`
(`synthesize.flash_room`).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from relit.capture.readers.iron import AXES
from relit.conventions import srgb_from_linear
from relit.errors import UserError
from relit.files import write_text
from relit.scene import Camera, Flash, Material, Mesh
from relit.synthesize.flash_room import FlashRoom, flash_room, painted, plastic_coat, room_light
from relit.synthesize.multiview import (
    claim_folder,
    identity_of,
    object_frame,
    orbit_cameras,
    tell_progress,
    write_json,
    write_mesh,
)

VERSION = 1
WHITE = 0.8  # linear value of the 95th percentile of the object's pixels; highlights are brighter
OFFSET = (-0.11, -0.06, 0.0)  # to the left and above, about 3 degrees as seen from the object
SIDE = 1024  # texels of the maps
SPECULAR = (0.45, 1.0, 0.7)  # of the dark, the middle and the bright paint
ALPHA = (0.30, 0.14, 0.22)
WAVE = 0.12  # relative swing of both over the object
# Options that came later: a capture at these values has the settings, and the hash, of before.
LATER = {"paint": "own", "material": "plastic", "ambient": 0.0}
MAPS = {"diffuse": "diffuse_albedo", "specular": "specular_albedo", "alpha": "specular_roughness"}


def synthesize_flash(
    asset_file: str | Path,
    light_file=(),
    out: str | Path = "",
    *,
    views: int = 120,
    test_views: int = 20,
    relights: Sequence[str | Path] = (),
    nodes: Sequence[str] = (),
    resolution: int = 400,
    spp: int = 64,
    test_spp: int = 256,
    seed: int = 0,
    offset: Sequence[float] = OFFSET,
    max_depth: int = 5,
    png: bool = False,
    paint: str = "own",
    material: str = "plastic",
    ambient: float = 0.0,
    say: Callable[[str], None] = lambda text: None,
) -> Path:
    """Render a flash capture of one object into `out`; returns `out`. relights stands for the call's
    shape alone, and light_file where `ambient` is 0.

    asset_file: .glb, .gltf or .obj. nodes: names of the glTF nodes to take, all where empty. spp,
    test_spp: samples a pixel of training photos and of what is measured against. offset: of the
    flash, OpenCV camera axes, where the object's radius is 0.8. png: training photos as 8-bit PNG,
    clipped, instead of linear EXR. paint: 'own', 'dark' or 'bright' colours. material: 'plastic' or
    'own'. ambient: light of the room, light_file, as a share of the flash's mean radiance on the
    object; in the training photos only. Deterministic by `seed`; takes up where a killed call stopped.
    Raises UserError for files that cannot be read, senseless numbers, and an `out` that holds
    something else.
    """
    asset_file, out = Path(asset_file), Path(out)
    light = room_light(light_file, relights, ambient)
    for label, value, least in [
        ("views", views, 3),
        ("test_views", test_views, 1),
        ("resolution", resolution, 8),
        ("spp", spp, 1),
    ]:
        if value < least:
            raise UserError(f"{label} = {value} is too few", fix=f"at least {least}", code=2)
    if len(offset) != 3 or not np.isfinite(offset).all() or np.linalg.norm(offset) > 1:
        raise UserError(
            "the flash's offset must be three numbers, together no longer than 1",
            "the object's radius is 0.8",
            code=2,
        )
    options = {
        "views": views,
        "test_views": test_views,
        "nodes": list(nodes),
        "resolution": resolution,
        "spp": spp,
        "test_spp": test_spp,
        "paint": paint,
        "material": material,
        "ambient": ambient,
    }
    settings = settings_of(
        asset_file,
        light_file,
        **options,
        seed=seed,
        offset=list(offset),
        max_depth=max_depth,
        png=png,
    )
    if claim_folder(out, settings):
        return out

    from relit.asset.gltf import read_asset_file

    mesh, own = read_asset_file(asset_file, nodes)
    own = painted(own, paint)
    plastic = plastic_of(mesh, own) if material == "plastic" else plastic_coat(own)
    world_from_asset = object_frame(mesh)
    train = orbit_cameras(views, resolution, seed=seed, prefix="r_")
    test = orbit_cameras(test_views, resolution, seed=seed + 1, prefix="t_")
    room = flash_room((mesh, own, world_from_asset), plastic, material)
    write_mesh(out / "truth" / "mesh.ply", mesh, world_from_asset)
    flash = Flash(
        np.array(offset, np.float64),
        np.full(3, flash_intensity_for(room, train, np.array(offset, np.float64), max_depth)),
    )
    lit = room if light is None else room.under(light, ambient, (train, flash), max_depth)
    write_text(out / "light.txt", f"{flash.intensity[0]:.8g}\n")
    write_text(
        out / "light_offset.txt", f"{AXES}\n" + " ".join(f"{v:.8g}" for v in flash.offset) + "\n"
    )
    _write_cameras(out / "train" / "cam_dict_norm.json", train)
    _write_cameras(out / "test" / "cam_dict_norm.json", test)
    for i, (name, camera) in enumerate(train):
        _photo(
            out / "train",
            name,
            lambda c=camera, i=i: lit.photo(c, flash, spp, seed * 1_000_003 + i, max_depth),
            png,
        )
        tell_progress(say, "training photo", i, views)
    for i, (name, camera) in enumerate(test):
        number = seed * 1_000_003 + 500_000 + i
        _test_maps(out, room.maps, name, camera)
        _photo(
            out / "test",
            name,
            lambda c=camera, k=number: room.photo(c, flash, test_spp, k, max_depth),
            False,
        )
        tell_progress(say, "test view", i, test_views)
    head = {
        "settings": settings,
        "world_from_asset": world_from_asset.tolist(),
        "sphere": {"centre": [0.0, 0.0, 0.0], "radius": 0.8},
    }
    names = {"train": [n for n, _ in train], "test": [n for n, _ in test]}
    lamp = {"offset": flash.offset.tolist(), "intensity": flash.intensity.tolist()}
    write_json(out / "truth" / "truth.json", {**head, **names, "flash": lamp, "ior": plastic.ior})
    return out


def settings_of(asset_file: str | Path, light_file=(), **options: Any) -> dict[str, Any]:
    """Everything that a capture depends on."""
    asset = Path(asset_file)
    if not asset.is_file():
        raise UserError(f"no asset file: {asset}", fix="give an existing GLB or OBJ file")
    plain = {
        key: options.get(key, value)
        for key, value in synthesize_flash.__kwdefaults__.items()
        if key not in ("relights", "say")
    }
    plain = {
        key: list(value) if isinstance(value, (tuple, list)) else value
        for key, value in plain.items()
    }
    plain = {k: v for k, v in plain.items() if k not in LATER or v != LATER[k]}
    light = room_light(light_file, (), plain.get("ambient", 0.0))
    more = {} if light is None else {"light": identity_of(light)}
    return {"version": VERSION, "kind": "flash", "asset": identity_of(asset), **more, **plain}


# ---------------------------------------------------------------- the material


def plastic_of(mesh: Mesh, material: Material) -> Material:
    """The rough plastic of a coloured object: see the module's text. The normal map is kept."""
    from relit.materials.rough_plastic import IOR

    base = np.clip(np.asarray(material.base_color, np.float32), 0.01, 0.9)
    if base.shape[0] == 1 or mesh.uvs is None:
        one = np.ones((1, 1), np.float32)
        return replace(
            material,
            base_color=base[:1, :1],
            roughness=np.sqrt(ALPHA[2]) * one,
            metallic=0 * one,
            specular=SPECULAR[2] * one,
            ior=IOR,
        )
    if max(base.shape) > SIDE:
        base = cv2.resize(base, (SIDE, SIDE), interpolation=cv2.INTER_AREA)
    groups = colour_groups(base)
    wave = 1 + WAVE * slow_wave(mesh, base.shape[:2])
    alpha = np.clip(sum(a * g for a, g in zip(ALPHA, groups, strict=True)) * wave, 0.08, 0.5)
    specular = np.clip(
        sum(s * g for s, g in zip(SPECULAR, groups, strict=True)) * (2 - wave), 0.1, 1.2
    )
    return replace(
        material,
        base_color=base,
        roughness=np.sqrt(alpha).astype(np.float32),
        metallic=np.zeros((1, 1), np.float32),
        specular=specular.astype(np.float32),
        ior=IOR,
    )


def colour_groups(base: np.ndarray) -> np.ndarray:
    """(3, H, W) shares, summing to 1, of three paints: the colours' groups by k-means, in order of
    brightness, blurred by a texel."""
    shown = srgb_from_linear(base).reshape(-1, 3)
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
    cv2.setRNGSeed(3)
    rng = np.random.default_rng(3)
    some = shown[rng.integers(0, len(shown), 20_000)]
    _, _, centres = cv2.kmeans(some, 3, None, criteria, 5, cv2.KMEANS_PP_CENTERS)
    centres = centres[np.argsort(centres.sum(1))]
    which = np.square(shown[:, None] - centres[None]).sum(-1).argmin(1).reshape(base.shape[:2])
    return np.stack(
        [cv2.GaussianBlur((which == k).astype(np.float32), (0, 0), 1.0) for k in range(3)]
    )


def slow_wave(mesh: Mesh, shape: tuple[int, int]) -> np.ndarray:
    """(H, W) in [-1, 1], slow over the surface; by vertex, spread over the texture by its faces."""
    from relit.geometry.bake import fill_gutters, interpolate, rasterise_atlas

    v = np.asarray(mesh.vertices, np.float64)
    p = (v - v.mean(0)) / np.ptp(v, axis=0).max()
    value = np.sin(7 * p[:, 0] + 2) * np.cos(6 * p[:, 1]) * np.sin(5 * p[:, 2] + 1)
    face, bary = rasterise_atlas(replace(mesh, uvs=np.asarray(mesh.uvs) % 1.0), 512)
    texture = fill_gutters(interpolate(value[:, None], mesh.faces, face, bary), face >= 0)[..., 0]
    return cv2.resize(texture, shape[::-1], interpolation=cv2.INTER_LINEAR)


# ---------------------------------------------------------------- pictures and files


def flash_intensity_for(
    room: FlashRoom, cameras: Sequence[tuple[str, Camera]], offset: np.ndarray, max_depth: int
) -> float:
    """The intensity that puts the 95th percentile, over the object's pixels in 6 small views, of
    the brightest channel at WHITE."""
    values = []
    for i in np.unique(np.linspace(0, len(cameras) - 1, min(6, len(cameras))).round().astype(int)):
        small = cameras[i][1].resized(100, 100)
        picture = room.photo(small, Flash(offset, np.ones(3)), 32, int(i), max_depth)
        values.append(picture[..., :3][picture[..., 3] > 0.99].max(-1))
    values = np.concatenate(values)
    if not values.size or not np.percentile(values, 95) > 0:
        raise UserError(
            "the object is black under the flash",
            "the asset covers no pixel, or its colours are black",
        )
    return WHITE / float(np.percentile(values, 95))


def _write_cameras(path: Path, cameras: Sequence[tuple[str, Camera]]) -> None:
    """IRON's cam_dict_norm.json: {"NAME.png": {"K": 16, "W2C": 16, "img_size": [w, h]}}, row-major,
    OpenCV axes."""
    content = {}
    for name, c in cameras:
        k = np.eye(4)
        k[:3, :3] = c.intrinsics
        content[f"{name}.png"] = {
            "K": k.ravel().tolist(),
            "W2C": c.camera_from_world.ravel().tolist(),
            "img_size": [c.width, c.height],
        }
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, json.dumps(content, indent=1))


def _photo(folder: Path, name: str, render: Callable[[], np.ndarray], png: bool) -> None:
    from relit.images import write_data, write_linear, write_srgb

    photo = folder / "image" / f"{name}.{'png' if png else 'exr'}"
    if photo.exists():
        return
    picture = render()
    write_data(folder / "mask" / f"{name}.png", picture[..., 3])
    (write_srgb if png else write_linear)(photo, np.clip(picture[..., :3], 0, 1 if png else None))


def _test_maps(out: Path, scene, name: str, camera: Camera) -> None:
    from relit.images import write_linear
    from relit.reference.flash_scene import render_maps

    target = out / "truth" / "normal" / f"{name}.exr"
    if target.exists():
        return
    maps = render_maps(scene, camera, spp=256)
    for key, folder in MAPS.items():
        m = maps[key]
        cover = maps["coverage"] if m.ndim == 2 else maps["coverage"][..., None]
        write_linear(
            out / "test" / folder / f"{name}.exr", m * cover
        )  # on black, as a renderer's buffers are
    write_linear(target, np.concatenate([maps["normal"], maps["coverage"][..., None]], -1))

"""Captures with known truth: photos of a GLB or OBJ under an HDRI, by a renderer of choice
(`synthesize.renderers`).

The folder is a NeRF-synthetic capture (`transforms_{train,test}.json`, 8-bit sRGB RGBA with
straight alpha) with the truth beside it:

    transforms_train.json  train/r_000.png ...
    transforms_test.json   test/t_000.png ...
    truth/truth.json                                   what was rendered and how; written last
    truth/mesh.ply  truth/environment.exr              in the world frame (y up); the light as
                                                       scaled by the exposure
    truth/test/NAME.exr                                linear RGBA, premultiplied on black
    truth/test/NAME_{albedo,normal,roughness,metallic,depth}.exr     albedo and normal carry the
                                                                     coverage as their alpha
    truth/train_albedo/NAME.exr                        linear RGBA of a few training views, to fix
                                                       the albedo scale
    truth/relight/LIGHT.exr  truth/relight/LIGHT/NAME.exr            other lights, and the test
                                                                     views under them

World frame: the middle of the object's bounding box is the origin and its farthest vertex lies at
RADIUS. Cameras look at the origin.

truth.json also has the renderer and the capture's ceiling (`synthesize.ceiling`).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from relit.conventions import move_points, similarity, world_from_gl_camera
from relit.errors import UserError
from relit.files import write_text
from relit.geometry.se3 import look_at
from relit.scene import Camera, Material, Mesh
from relit.synthesize.ceiling import ceilings
from relit.synthesize.delivery import (
    Delivery,
    delivered_shots,
    delivery_truth,
    in_front_of,
    pinholes,
    write_cameras,
    write_photo,
)
from relit.synthesize.renderers import (
    TrueObject,
    TruthScene,
    as_truth,
    build_truth,
    depth_of,
    describe_renderer,
    require_renderer,
    truth_picture,
)

VERSION = 1  # of the layout and of what is rendered; part of the settings' hash
RADIUS = 0.8  # of the object's bounding sphere, world units
FOV = 40.0  # degrees, both axes
LOWEST = -35.0  # degrees of elevation below which no camera stands (a table would be in the way)
WHITE = 0.9  # linear value of the 99th percentile of the object's pixels
SCALE_VIEWS = 8  # training views whose albedo is kept to fix the albedo scale


def synthesize_multiview(
    asset_file: str | Path,
    light_file: str | Path,
    out: str | Path,
    *,
    views: int = 60,
    test_views: int = 12,
    relights: Sequence[str | Path] = (),
    resolution: int = 400,
    spp: int = 64,
    test_spp: int = 256,
    seed: int = 0,
    renderer: str = "relit",
    roughness: float | None = None,
    metallic: float | None = None,
    max_depth: int | None = None,
    delivery: Delivery | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> Path:
    """Render a multi-view capture of one object under one light, with its truth, into `out`;
    returns `out`.

    asset_file: .glb, .gltf or .obj. light_file, relights: lat-long .hdr or .exr in Mitsuba's axes.
    spp, test_spp: samples a pixel of the training photos and of everything that is measured
    against. roughness, metallic: replace the file's maps by a constant (an OBJ has none).
    renderer: one of `synthesize.renderers.RENDERERS`. max_depth: longest path in edges (2 = direct
    light only), None for what the renderer usually has.

    delivery: None for the layout above (ideal photos with alpha); else training photos, masks and
    cameras are those of `synthesize.delivery`, with the light in view behind the object.

    Deterministic by `seed`. A call with the same settings takes up where a killed one stopped and
    returns at once when all is there.

    Raises UserError when a file cannot be read, a number makes no sense, or `out` holds something
    else.
    """
    asset_file, light_file, out = Path(asset_file), Path(light_file), Path(out)
    relights = [Path(r) for r in relights]
    max_depth = depth_of(renderer, max_depth)
    _check_counts(views, test_views, resolution, spp, test_spp)
    _check_material(roughness, metallic)
    check_relight_names(relights)
    settings = settings_of(
        asset_file,
        light_file,
        views=views,
        test_views=test_views,
        relights=relights,
        resolution=resolution,
        spp=spp,
        test_spp=test_spp,
        seed=seed,
        renderer=renderer,
        roughness=roughness,
        metallic=metallic,
        max_depth=max_depth,
        **({} if delivery is None else {"delivery": delivery.settings()}),
    )
    if not (out / "truth" / "truth.json").exists():
        require_renderer(renderer)  # before anything is written
    if claim_folder(out, settings):
        return out

    from relit.asset.gltf import read_asset_file
    from relit.images import read_image, write_linear

    mesh, material = read_asset_file(asset_file)
    material = overridden(material, roughness, metallic)
    thing = TrueObject(mesh, material, object_frame(mesh))
    train = orbit_cameras(views, resolution, seed=seed, prefix="train/r_")
    test = orbit_cameras(test_views, resolution, seed=seed + 1, prefix="test/t_")
    truth = out / "truth"
    shots = [] if delivery is None else delivered_shots(delivery, train, seed)
    train = pinholes(shots) or train
    write_mesh(truth / "mesh.ply", mesh, thing.world_from_asset)
    _write_all_cameras(out, delivery, shots, (train, test), resolution)

    def lit(file: Path) -> tuple[TruthScene, np.ndarray]:
        """Scene under a light whose exposure fits the object, and that light."""
        return exposed(renderer, thing, read_image(file).rgb, train, max_depth)

    scene, environment = lit(light_file)
    write_linear(truth / "environment.exr", environment)
    scale_names = [
        train[i][0]
        for i in np.unique(np.linspace(0, views - 1, min(SCALE_VIEWS, views)).round().astype(int))
    ]
    plan = _TrainingPlan(train, shots, delivery, scale_names)
    _write_training_photos(out, scene, environment, plan, _Sampling(spp, max_depth, seed, say))
    for i, (name, camera) in enumerate(test):
        write_test_view(
            out, scene, name, camera, test_spp, max_depth, seed * 1_000_003 + 500_000 + i
        )
        tell_progress(say, "test view", i, test_views)
    made_by = describe_renderer(renderer, scene)
    scene.close()
    for j, file in enumerate(relights):
        scene, environment = lit(file)
        folder = truth / "relight" / file.stem
        write_linear(folder.with_suffix(".exr"), environment)
        for i, (name, camera) in enumerate(test):
            number = seed * 1_000_003 + 600_000 + 1000 * j + i
            target = folder / f"{Path(name).name}.exr"
            write_radiance(target, scene, camera, test_spp, max_depth, number)
            tell_progress(say, f"test view under {file.stem}", i, test_views)
        scene.close()

    names = [name for name, _ in test]
    write_json(
        truth / "truth.json",
        {
            "settings": settings,
            "renderer": made_by,
            "ceiling": ceilings(thing, files_of_lights(truth, relights, test), test_spp, seed, say),
            "world_from_asset": thing.world_from_asset.tolist(),
            "sphere": {"centre": [0.0, 0.0, 0.0], "radius": RADIUS},
            "ior": material.ior,
            "train": [name for name, _ in train],
            "test": names,
            "train_albedo": [Path(n).name for n in scale_names],
            "relight": [file.stem for file in relights],
            **delivery_truth(out, delivery, shots),
        },
    )
    return out


@dataclass(frozen=True)
class _Sampling:
    """spp: samples a pixel of training photos. max_depth: longest path in edges. say: called with lines of progress."""

    spp: int
    max_depth: int
    seed: int
    say: Callable[[str], None]


@dataclass(frozen=True)
class _TrainingPlan:
    """cameras: (name, camera) of the training photos. shots: what `delivery` makes of them. scale:
    names of the views whose albedo is kept."""

    cameras: Sequence[tuple[str, Camera]]
    shots: Sequence[Any]
    delivery: Delivery | None
    scale: Sequence[str]


def _write_training_photos(
    out: Path, scene: TruthScene, light: np.ndarray, plan: _TrainingPlan, sampling: _Sampling
) -> None:
    """The training photos, as they are delivered."""
    depth, spp = sampling.max_depth, sampling.spp

    def take(camera: Camera, samples: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
        return in_front_of(light, camera, radiance(scene, camera, samples, depth, seed))

    for i, (name, camera) in enumerate(plan.cameras):
        keep = name in plan.scale
        if plan.delivery is None:
            number = sampling.seed * 1_000_003 + i
            write_training_view(out, scene, name, camera, spp, depth, number, keep)
        else:
            write_photo(out, plan.delivery, name, plan.shots[i][1], take, spp)
            if keep:
                write_scale_view(out, scene, name, camera)
        tell_progress(sampling.say, "training photo", i, len(plan.cameras))


def write_radiance(
    target: Path, scene: TruthScene, camera: Camera, spp: int, max_depth: int, seed: int
) -> None:
    """Render `target`, unless it is there."""
    from relit.images import write_linear

    if not target.exists():
        write_linear(target, radiance(scene, camera, spp, max_depth, seed))


def files_of_lights(
    truth: Path, relights: Sequence[Path], test: Sequence[tuple[str, Camera]]
) -> dict[str, tuple[Path, list[tuple[Path, Camera]]]]:
    """For each light of a capture its file and the test pictures under it."""

    def pictures(folder: Path) -> list[tuple[Path, Camera]]:
        return [(folder / f"{Path(name).name}.exr", camera) for name, camera in test]

    folders = {file.stem: truth / "relight" / file.stem for file in relights}
    return {"capture": (truth / "environment.exr", pictures(truth / "test"))} | {
        name: (folder.with_suffix(".exr"), pictures(folder)) for name, folder in folders.items()
    }


# ---------------------------------------------------------------- where things stand


def object_frame(mesh: Mesh, radius: float = RADIUS) -> np.ndarray:
    """world_from_asset (4, 4): the middle of the bounding box goes to the origin, the farthest
    vertex to `radius`."""
    v = np.asarray(mesh.vertices, np.float64)
    centre = (v.min(0) + v.max(0)) / 2
    reach = np.linalg.norm(v - centre, axis=1).max()
    if not reach > 0:
        raise UserError("the asset has no extent", "all its vertices coincide")
    return similarity(np.eye(3), -radius / reach * centre, radius / reach)


def orbit_cameras(
    count: int,
    resolution: int,
    *,
    seed: int = 0,
    prefix: str = "r_",
    fov: float = FOV,
    radius: float = RADIUS,
) -> list[tuple[str, Camera]]:
    """(name, Camera) pairs on a jittered Fibonacci spiral over the sphere above LOWEST, each with
    the whole bounding sphere in frame.

    The distance is the least that frames the sphere times a random 1 to 1.08; roll within 5
    degrees.
    """
    rng = np.random.default_rng(seed)
    low = np.sin(np.radians(LOWEST))
    focal = resolution / (2 * np.tan(np.radians(fov) / 2))
    least = radius / np.sin(np.radians(fov) / 2)
    turn, cameras = rng.uniform(0, 2 * np.pi), []
    for i in range(count):
        y = np.clip(1 - (1 - low) * (i + 0.5 + rng.uniform(-0.3, 0.3)) / count, low, 0.998)
        azimuth = turn + i * np.pi * (3 - np.sqrt(5)) + rng.normal() * 0.3 / np.sqrt(count)
        r = np.sqrt(1 - y * y)
        centre = (
            np.array([r * np.cos(azimuth), y, r * np.sin(azimuth)]) * least * rng.uniform(1.0, 1.08)
        )
        pose = look_at(centre, roll=np.radians(rng.uniform(-5, 5)))
        half = resolution / 2
        cameras.append(
            (f"{prefix}{i:03d}", Camera(resolution, resolution, focal, focal, half, half, pose))
        )
    return cameras


# ---------------------------------------------------------------- rendering


def radiance(scene, camera: Camera, spp: int, max_depth: int, seed: int) -> np.ndarray:
    """(H, W, 4) float32 linear premultiplied radiance and coverage. scene: a TruthScene, or one of
    Mitsuba."""
    return truth_picture(as_truth(scene), camera, spp, max_depth, seed)


def exposed(
    renderer: str,
    thing: TrueObject,
    environment: np.ndarray,
    cameras: Sequence[tuple[str, Camera]],
    max_depth: int,
) -> tuple[TruthScene, np.ndarray]:
    """The scene under a light whose exposure fits the object (`exposure_factor`), that light."""
    scene = build_truth(renderer, thing, environment, max_depth)
    factor = exposure_factor(scene, cameras, max_depth)
    lit = (environment * factor).astype(np.float32)
    if scene.cycles is not None:
        return scene.brighter(factor), lit
    return build_truth(renderer, thing, lit, max_depth), lit


def exposure_factor(scene, cameras: Sequence[tuple[str, Camera]], max_depth: int) -> float:
    """Factor on the light that puts the 99th percentile, over the object's pixels in 8 small views,
    of the brightest channel at WHITE."""
    values = []
    for i in np.unique(np.linspace(0, len(cameras) - 1, min(8, len(cameras))).round().astype(int)):
        picture = radiance(scene, cameras[i][1].resized(100, 100), 64, max_depth, 77 + int(i))
        inside = picture[..., 3] > 0.99
        values.append(picture[..., :3][inside].max(-1))
    values = np.concatenate(values) if values else np.zeros(0)
    level = float(np.percentile(values, 99)) if values.size else 0.0
    if not level > 0:
        raise UserError(
            "the object is black under this light",
            "the light file holds no light, or the asset covers no pixel",
        )
    return WHITE / level


def write_training_view(
    out: Path, scene, name: str, camera: Camera, spp: int, max_depth: int, seed: int, albedo: bool
) -> None:
    """NAME.png, and with `albedo` its base colour in truth/train_albedo; what is there already is
    kept."""
    photo = out / f"{name}.png"
    if not photo.exists():
        _write_rgba(photo, radiance(scene, camera, spp, max_depth, seed))
    if albedo:
        write_scale_view(out, scene, name, camera)


def write_scale_view(out: Path, scene, name: str, camera: Camera) -> None:
    """The base colour of a training view in truth/train_albedo, unless it is there."""
    target = out / "truth" / "train_albedo" / f"{Path(name).name}.exr"
    if not target.exists():
        from relit.images import write_linear
        from relit.reference.mitsuba_scene import render_channels

        channels = render_channels(as_truth(scene).channels, camera, spp=16)
        write_linear(target, np.concatenate([channels["albedo"], channels["alpha"][..., None]], -1))


def write_test_view(
    out: Path, scene, name: str, camera: Camera, spp: int, max_depth: int, seed: int
) -> None:
    """NAME.png, truth/test/NAME.exr and its channels; a view that is complete is kept."""
    from relit.images import write_linear
    from relit.reference.mitsuba_scene import render_channels

    stem = out / "truth" / "test" / Path(name).name
    picture, photo = stem.with_suffix(".exr"), out / f"{name}.png"
    if picture.exists() and photo.exists():
        return
    channels = render_channels(as_truth(scene).channels, camera, spp=64)
    for key in ("albedo", "normal"):
        write_linear(
            stem.with_name(f"{stem.name}_{key}.exr"),
            np.concatenate([channels[key], channels["alpha"][..., None]], -1),
        )
    for key in ("roughness", "metallic", "depth"):
        write_linear(stem.with_name(f"{stem.name}_{key}.exr"), channels[key])
    rgba = radiance(scene, camera, spp, max_depth, seed)
    _write_rgba(photo, rgba)
    write_linear(picture, rgba)  # last: its presence says that the view is complete


# ---------------------------------------------------------------- files


def check_relight_names(relights: Sequence[Path]) -> None:
    """Raise UserError for lights that the truth cannot keep by name."""
    if len({f.stem for f in relights}) < len(relights):
        raise UserError(
            "two relighting files have one name", "the truth is kept by name", "rename one of them"
        )
    if any(f.stem == "capture" for f in relights):
        raise UserError(
            "a relighting file is named 'capture'",
            "truth.json keeps the light of the photos under that name",
            "rename it",
        )


def _check_counts(views: int, test_views: int, resolution: int, spp: int, test_spp: int) -> None:
    for label, value, least in [
        ("views", views, 2),
        ("test_views", test_views, 1),
        ("resolution", resolution, 8),
    ]:
        if value < least:
            raise UserError(f"{label} = {value} is too few", fix=f"at least {least}", code=2)
    if spp < 1 or test_spp < 1:
        raise UserError("samples per pixel must be at least 1", code=2)


def _check_material(roughness: float | None, metallic: float | None) -> None:
    for label, value in [("roughness", roughness), ("metallic", metallic)]:
        if value is not None and not 0 <= value <= 1:
            raise UserError(f"{label} = {value} is outside [0, 1]", code=2)


def identity_of(file: Path) -> dict[str, str]:
    """{"name", "sha256"} of a file, what lies beside an OBJ or a glTF counted: the same content is
    the same capture."""
    digest = hashlib.sha256(file.read_bytes())
    if file.suffix.lower() in (".obj", ".gltf"):  # what they refer to lies beside them
        for sibling in sorted(p for p in file.parent.iterdir() if p.is_file() and p != file):
            digest.update(sibling.name.encode() + sibling.read_bytes())
    return {"name": file.name, "sha256": digest.hexdigest()[:16]}


def settings_of(asset_file: str | Path, light_file: str | Path, **options: Any) -> dict[str, Any]:
    """Everything that a capture depends on: the options of `synthesize_multiview`, its defaults,
    and digests of the files."""
    files = {"asset": Path(asset_file), "light": Path(light_file)}
    relights = [Path(r) for r in options.pop("relights", ())]
    for what, file in [*files.items(), *(("light", r) for r in relights)]:
        if not file.is_file():
            raise UserError(
                f"no {what} file: {file}",
                fix=f"give an existing {'GLB or OBJ' if what == 'asset' else 'HDR or EXR'} file",
            )
    defaults = synthesize_multiview.__kwdefaults__
    plain = {
        key: options.get(key, value)
        for key, value in defaults.items()
        if key not in ("relights", "say", "delivery")
    }
    plain["max_depth"] = depth_of(plain["renderer"], plain["max_depth"])
    if "delivery" in options:
        plain["delivery"] = options["delivery"]
    digests = {what: identity_of(file) for what, file in files.items()}
    return {
        "version": VERSION,
        "kind": "multiview",
        **digests,
        "relights": [identity_of(r) for r in relights],
        **plain,
    }


def settings_hash(settings: dict[str, Any]) -> str:
    """12 hex digits that name a set of settings."""
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:12]


def claim_folder(out: Path, settings: dict[str, Any]) -> bool:
    """Whether `out` is complete already. Marks it as ours; refuses a folder that holds anything
    else."""
    marker = out / "truth" / "settings.json"
    if marker.exists():
        if json.loads(marker.read_text()) != settings:
            raise UserError(
                "the output folder holds a capture rendered with other settings",
                fix=f"choose another folder, or delete this one: {out}",
            )
        return (out / "truth" / "truth.json").exists()
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UserError(
            "the output folder is not empty and holds no synthetic capture",
            fix=f"choose a new folder: {out}",
        )
    write_json(marker, settings)
    return False


def overridden(material: Material, roughness: float | None, metallic: float | None) -> Material:
    """The material with these constants in the place of its maps, None: as it is."""
    for key, value in (("roughness", roughness), ("metallic", metallic)):
        if value is not None:
            material = replace(material, **{key: np.full_like(getattr(material, key), value)})
    return material


def write_json(path: Path, content: Any) -> None:
    """Write JSON atomically, its folder made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, json.dumps(content, indent=1))


def _write_all_cameras(
    out: Path, delivery: Delivery | None, shots, cameras: tuple[list, list], resolution: int
) -> None:
    """The camera files of the training and the test views, as they are delivered."""
    if delivery is not None:
        write_cameras(out, delivery, shots, cameras[1])
        return
    for split, some in zip(("train", "test"), cameras, strict=True):
        _write_transforms(out / f"transforms_{split}.json", some, resolution)


def _write_transforms(path: Path, cameras: Sequence[tuple[str, Camera]], resolution: int) -> None:
    angle = 2 * np.arctan(resolution / (2 * cameras[0][1].fx))
    frames = [
        {
            "file_path": f"./{name}",
            "transform_matrix": world_from_gl_camera(camera.world_from_camera).tolist(),
        }
        for name, camera in cameras
    ]
    write_json(path, {"camera_angle_x": float(angle), "frames": frames})


def _write_rgba(path: Path, picture: np.ndarray) -> None:
    """8-bit sRGB PNG with straight alpha of a linear premultiplied picture (H, W, 4)."""
    from relit.images import write_srgb

    alpha = np.clip(picture[..., 3:], 0, 1)
    rgb = np.clip(picture[..., :3] / np.maximum(alpha, 1e-4), 0, 1) * (alpha > 0)
    write_srgb(path, np.concatenate([rgb, alpha], -1))


def write_mesh(path: Path, mesh: Mesh, world_from_asset: np.ndarray) -> None:
    """The mesh in the world frame as PLY, atomically."""
    import trimesh

    from relit.images import write_bytes

    moved = trimesh.Trimesh(move_points(world_from_asset, mesh.vertices), mesh.faces, process=False)
    write_bytes(path, moved.export(file_type="ply"))


def tell_progress(say: Callable[[str], None], what: str, index: int, count: int) -> None:
    """'training view 10 of 36', for the first, the last and every tenth."""
    if index == 0 or index + 1 == count or (index + 1) % 10 == 0:
        say(f"{what} {index + 1} of {count}")

"""What is measured on a reconstructed asset against the truth of a synthetic capture, and how each figure is defined.

The truth folder is what `relit synthesize` writes (`capture/synthetic.py`). Pictures are rendered by the same path tracer as the truth.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from relit.conventions import move_points, rotate_environment, similarity, world_from_cv_camera
from relit.errors import UserError
from relit.evaluate import metrics as m
from relit.evaluate.align import align_cameras, pose_errors, same_frame
from relit.evaluate.definitions import DEFINITIONS, ROUNDTRIP_SIDE, ROUNDTRIP_SPP, ROUNDTRIP_VIEWS, SURFACE_SAMPLES
from relit.scene import Asset, Camera, Flash, Mesh


@dataclass(frozen=True)
class Truth:
    """A synthetic capture's truth. train, test: cameras by name without folder and extension, in the true world frame.
    radius: of the object's bounding sphere, world units. meta: the content of truth.json."""

    folder: Path
    train: dict[str, Camera]
    test: dict[str, Camera]
    radius: float
    meta: dict[str, Any]

    def picture(self, relative: str) -> np.ndarray:
        """(H, W, C) or (H, W) float32 linear content of `truth/<relative>.exr`."""
        from relit.images import read_data

        return read_data(self.folder / "truth" / f"{relative}.exr")


def truth_kind(folder: str | Path) -> str:
    """The kind of capture that `relit synthesize` made of the folder, as its truth/settings.json says ('duplicates', 'collection'); ''
    where that names none."""
    try:
        said = json.loads((Path(folder) / "truth" / "settings.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return ""
    kind = said.get("kind") if isinstance(said, dict) else None
    return kind if isinstance(kind, str) else ""


def has_truth(folder: str | Path) -> bool:
    """Whether `relit synthesize` made the folder, finished or not."""
    folder = Path(folder)
    return folder.name == "truth" or (folder / "truth" / "settings.json").is_file() or (folder / "truth" / "truth.json").is_file()


def load_truth(folder: str | Path) -> Truth:
    """Read the cameras and the description of a synthetic capture. Raises UserError where there is none, or an unfinished one."""
    from relit.asset.asset import read_json

    folder = Path(folder)
    folder = folder.parent if folder.name == "truth" else folder
    file = folder / "truth" / "truth.json"
    if not file.is_file():
        why = (
            "it is unfinished: its rendering was stopped"
            if (folder / "truth" / "settings.json").exists()
            else "there is no truth/truth.json"
        )
        raise UserError("the folder holds no complete truth", why, f"make one with `relit synthesize`, or give its folder: {folder}")
    meta = read_json(file)
    size = meta["settings"]["resolution"]
    train, test = (_read_cameras(folder / f"transforms_{split}.json", size) for split in ("train", "test"))
    return Truth(folder, train, test, float(meta["sphere"]["radius"]), meta)


def _read_cameras(file: Path, size: int) -> dict[str, Camera]:
    from relit.asset.asset import read_json

    content = read_json(file)
    focal = size / (2 * np.tan(content["camera_angle_x"] / 2))
    return {
        camera_key(f["file_path"]): Camera(
            size, size, focal, focal, size / 2, size / 2, world_from_cv_camera(np.array(f["transform_matrix"], np.float64))
        )
        for f in content["frames"]
    }


def camera_key(name: str) -> str:
    """What cameras are matched by: the file's name without folder and extension."""
    return Path(name).stem


def evaluate(run_or_asset: str | Path, truth_folder: str | Path, *, spp: int = 256, seed: int = 0) -> dict[str, Any]:
    """Every figure that the truth allows, for the asset in a run or asset folder. truth_folder: what `relit synthesize` wrote; or the
    capture that the asset was made from, whose photos are the truth then (evaluate/photos.py, evaluate/collection_photos.py).

    spp: samples a pixel of the pictures that are compared; their noise counts as error. Returns {"metrics": {name: {"value", "unit",
    "definition"}}, "per_view": {view: {name: value}}, "albedo_scale": [r, g, b], "alignment": "identity" or "sim3"}.
    Call `relit.device.use_device` first.
    """
    from relit.asset.asset import load_asset
    from relit.evaluate.duplicates import evaluate_duplicates, evaluate_on_photo
    from relit.evaluate.flash import evaluate_flash, is_flash_truth

    folder = Path(truth_folder)
    folder = folder.parent if folder.name == "truth" and (folder / "settings.json").is_file() else folder
    kind = truth_kind(folder)
    if kind == "duplicates":
        return evaluate_duplicates(run_or_asset, folder, spp=min(spp, 64), seed=seed)
    if is_flash_truth(folder):
        return evaluate_flash(run_or_asset, folder, spp=spp, seed=seed)
    asset = load_asset(run_or_asset)
    if kind == "collection":
        from relit.evaluate.collection import evaluate_collection

        result = evaluate_collection(run_or_asset, folder, spp=spp, seed=seed)
    elif has_truth(folder):
        result = evaluate_asset(asset, load_truth(folder), spp=spp, seed=seed)
    elif asset.instances:
        result = evaluate_on_photo(run_or_asset, folder, spp=min(spp, 64), seed=seed)
    elif asset.lights:
        from relit.evaluate.collection_photos import evaluate_on_collection

        result = evaluate_on_collection(asset, folder, run=Path(run_or_asset), spp=spp, seed=seed)
    else:
        from relit.evaluate.photos import evaluate_on_photos

        result = evaluate_on_photos(asset, folder, run=Path(run_or_asset), spp=spp, seed=seed)
    value = glb_roundtrip(asset, Path(run_or_asset) / "stages" / "asset")
    if value is not None:
        result["metrics"].update(entry("glb_roundtrip_psnr", value))
    return result


def evaluate_asset(asset: Asset, truth: Truth, *, spp: int = 256, seed: int = 0) -> dict[str, Any]:
    """As `evaluate`, for an asset in memory; all but the GLB's round trip."""
    from relit.rendering.mitsuba_scene import build_scene

    recovered = {camera_key(name): camera for name, camera in asset.cameras}
    asset, alignment = aligned(asset, truth.train, recovered)
    world_from_asset = asset.world_from_asset
    values: dict[str, float] = {}
    per_view: dict[str, dict[str, float]] = {name: {} for name in truth.test}

    scene = build_scene(asset.mesh, asset.material, world_from_asset, asset.environment)
    scale = fixed_albedo_scale(scene, truth)
    for name, camera in truth.test.items():
        per_view[name].update(material_figures(scene, camera, truth, name, scale))
    if asset.environment is not None:
        for i, (name, camera) in enumerate(truth.test.items()):
            per_view[name].update(_picture_figures("novel", scene, camera, truth.picture(f"test/{name}"), spp, seed + i))
        light = truth.picture("environment")[..., :3]
        values["environment_mse"] = m.environment_mse(asset.environment, light)
        values["environment_mse_scaled"] = m.environment_mse(asset.environment / scale, light)
        values["environment_log_rmse"] = m.environment_log_rmse(asset.environment / scale, light)

    scaled = replace(asset.material, base_color=np.clip(asset.material.base_color * scale, 0, 1).astype(np.float32))
    for light_name in truth.meta["relight"]:
        light = truth.picture(f"relight/{light_name}")[..., :3]
        for material, tail, samples in ((scaled, "", spp), (asset.material, "_unscaled", max(1, spp // 4))):
            scene = build_scene(asset.mesh, material, world_from_asset, light)
            for i, (name, camera) in enumerate(truth.test.items()):
                reference = truth.picture(f"relight/{light_name}/{name}")
                figures = _picture_figures("relit", scene, camera, reference, samples, seed + i)
                per_view[name].update({f"{key}{tail}:{light_name}": value for key, value in figures.items()})

    values.update(chamfer_figures(asset.mesh, world_from_asset, truth))
    if alignment == "sim3":
        rotations, distances = pose_errors({k: c for k, c in _cameras_of(asset)}, truth.train, np.eye(4))
        values["camera_rotation"] = float(np.median(rotations))
        values["camera_centre_percent"] = float(100 * np.median(distances) / (2 * truth.radius))
    values = {**_means(per_view), **values}
    return {
        "metrics": {k: v for name in DEFINITIONS if name in values for k, v in entry(name, values[name]).items()},
        "per_view": per_view,
        "albedo_scale": [float(x) for x in scale],
        "alignment": alignment,
    }


# ---------------------------------------------------------------- frames


def aligned(asset: Asset, truth: dict[str, Camera], recovered: dict[str, Camera]) -> tuple[Asset, str]:
    """The asset carried into the frame of the true cameras, and how: 'identity' when its cameras stand there already (they were given) or
    it has none, 'sim3' when they were recovered from photos and the frame is free."""
    from relit.conventions import move_pose, scale_of

    if not recovered or same_frame(recovered, truth):
        return asset, "identity"
    s = align_cameras(recovered, truth)
    k = scale_of(s)
    flash = None if asset.flash is None else Flash(asset.flash.offset * k, asset.flash.intensity * k**2)
    environment = None if asset.environment is None else rotate_environment(asset.environment, s)
    cameras = tuple((name, camera.with_pose(move_pose(s, camera.world_from_camera))) for name, camera in asset.cameras)
    placed = s @ asset.world_from_asset
    return replace(asset, world_from_asset=placed, environment=environment, cameras=cameras, flash=flash), "sim3"


def _cameras_of(asset: Asset):
    return [(camera_key(name), camera) for name, camera in asset.cameras]


# ---------------------------------------------------------------- figures


def fixed_albedo_scale(scene, truth: Truth) -> np.ndarray:
    """(3,) the albedo scale of the whole evaluation: over the pixels of the kept training views that both the truth (coverage >= MASK)
    and the prediction cover."""
    from relit.rendering.mitsuba_scene import render_channels

    predicted, true = [], []
    for name in truth.meta["train_albedo"]:
        channels = render_channels(scene, truth.train[name], spp=16)
        reference = truth.picture(f"train_albedo/{name}")
        inside = (reference[..., 3] >= m.MASK) & (channels["alpha"] > 0)
        predicted.append(channels["albedo"][inside])
        true.append(reference[..., :3][inside])
    return m.albedo_scale(np.concatenate(predicted), np.concatenate(true))


def material_figures(scene, camera: Camera, truth: Truth, name: str, scale: np.ndarray) -> dict[str, float]:
    """Albedo, normal, roughness, metallic and mask figures of one test view."""
    from relit.rendering.mitsuba_scene import render_channels

    p = render_channels(scene, camera, spp=32)
    albedo, normal = truth.picture(f"test/{name}_albedo"), truth.picture(f"test/{name}_normal")
    inside = albedo[..., 3] >= m.MASK
    t, q = albedo[..., :3], p["albedo"]
    return {
        "albedo_psnr": m.psnr(m.encode(q * scale), m.encode(t), inside),
        "albedo_psnr_linear": m.psnr(np.clip(q * scale, 0, 1), np.clip(t, 0, 1), inside),
        "albedo_psnr_unscaled": m.psnr(m.encode(q), m.encode(t), inside),
        "normal_mae": float(m.normal_angles(p["normal"], normal[..., :3])[inside].mean()),
        "roughness_mse": float(np.square(p["roughness"] - truth.picture(f"test/{name}_roughness"))[inside].mean()),
        "metallic_mse": float(np.square(p["metallic"] - truth.picture(f"test/{name}_metallic"))[inside].mean()),
        "mask_iou": m.mask_iou(p["alpha"], albedo[..., 3]),
    }


def _picture_figures(prefix: str, scene, camera: Camera, reference: np.ndarray, spp: int, seed: int) -> dict[str, float]:
    from relit.rendering.mitsuba_scene import render

    a, b = m.encode(render(scene, camera, spp=spp, seed=seed)[..., :3]), m.encode(reference[..., :3])
    inside, s = reference[..., 3] >= m.MASK, m.ssim_map(a, b)
    return {
        f"{prefix}_psnr": m.psnr(a, b),
        f"{prefix}_psnr_masked": m.psnr(a, b, inside),
        f"{prefix}_ssim": float(s.mean()),
        f"{prefix}_ssim_masked": float(s[inside].mean()) if inside.any() else float("nan"),
    }


def write_own_renders(folder: str | Path, asset: Asset) -> None:
    """Keep pictures of an asset as the fit holds it, before any file format: `own_0000.exr` (0000 = index of the camera), linear RGBA.

    ROUNDTRIP_VIEWS of its cameras, at most ROUNDTRIP_SIDE pixels a side, under its own light. `glb_roundtrip` compares with them.
    """
    from relit.images import write_linear
    from relit.rendering.mitsuba_scene import build_scene, render

    count = len(asset.cameras)
    if asset.environment is None or count == 0:
        return
    scene = build_scene(asset.mesh, asset.material, asset.world_from_asset, asset.environment)
    for i in np.unique(np.linspace(0, count - 1, min(ROUNDTRIP_VIEWS, count)).round().astype(int)):
        picture = render(scene, _small(asset.cameras[i][1]), spp=ROUNDTRIP_SPP, seed=int(i))
        write_linear(Path(folder) / f"own_{i:04d}.exr", picture)


def glb_roundtrip(asset: Asset, folder: str | Path) -> float | None:
    """Mean PSNR of an asset that was read back from its folder against the pictures of `write_own_renders` in `folder`: the same views,
    light and random numbers. None where there are no such pictures."""
    from relit.images import read_data
    from relit.rendering.mitsuba_scene import build_scene, render

    files = sorted(Path(folder).glob("own_*.exr"))
    if not files or asset.environment is None:
        return None
    scene = build_scene(asset.mesh, asset.material, asset.world_from_asset, asset.environment)
    values = []
    for file in files:
        i = int(file.stem.removeprefix("own_"))
        picture = render(scene, _small(asset.cameras[i][1]), spp=ROUNDTRIP_SPP, seed=i)
        values.append(m.psnr(m.encode(picture[..., :3]), m.encode(read_data(file)[..., :3])))
    return float(np.mean(values))


def _small(camera: Camera) -> Camera:
    factor = min(1.0, ROUNDTRIP_SIDE / max(camera.width, camera.height))
    return camera.resized(max(1, round(camera.width * factor)), max(1, round(camera.height * factor)))


def visible(mesh: Mesh, world_from_asset, points: np.ndarray, cameras: list[Camera]) -> np.ndarray:
    """(N,) bool: whether the segment from a world point (N, 3) on the mesh to some camera's centre is free of the mesh.

    Segments start 1e-4 of the mesh's extent off the point, towards the camera.
    """
    import drjit as dr
    import mitsuba as mi

    from relit.rendering.mitsuba_scene import build_geometry

    world = move_points(world_from_asset, mesh.vertices)
    low, high = world.min(0), world.max(0)
    unit_from_world = similarity(np.eye(3), -(low + high) / np.ptp(world, axis=0).max(), 2 / np.ptp(world, axis=0).max())
    vertices = move_points(unit_from_world, world).astype(np.float32)
    scene = build_geometry(Mesh(vertices, mesh.faces, np.zeros_like(vertices)))  # queries look at no shading normal
    start, gap = move_points(unit_from_world, points).astype(np.float32), 2e-4
    p, seen = mi.Point3f(*[mi.Float(np.ascontiguousarray(start[:, k])) for k in range(3)]), dr.zeros(mi.Bool, len(start))
    for camera in cameras:
        centre = mi.Point3f(*[dr.opaque(mi.Float, float(x)) for x in move_points(unit_from_world, camera.centre)])
        d = mi.Vector3f(centre - p)
        length = dr.norm(d)
        d /= length
        seen = seen | ~scene.ray_test(mi.Ray3f(p + gap * d, d, length - gap, 0.0, []))
        dr.eval(seen)
    return seen.numpy().astype(bool)


def chamfer_figures(mesh: Mesh, world_from_asset, truth: Truth, count: int = SURFACE_SAMPLES) -> dict[str, float]:
    """The Chamfer figures between the surfaces that cameras can see (`DEFINITIONS['chamfer']`)."""
    import trimesh

    cameras = [*truth.train.values(), *truth.test.values()]
    loaded = trimesh.load(truth.folder / "truth" / "mesh.ply", process=False)
    true_mesh = Mesh(np.asarray(loaded.vertices, np.float32), np.asarray(loaded.faces, np.int32))
    samples = []
    for i, (each, frame) in enumerate(((mesh, world_from_asset), (true_mesh, np.eye(4)))):
        surface = m.sample_surface(move_points(frame, each.vertices), each.faces, count, seed=i)
        seen = visible(each, frame, surface.points, cameras)
        if not (seen & surface.uniform).any():
            raise UserError("no part of the mesh can be seen by any camera", "it lies elsewhere than the cameras look, or is empty")
        samples.append(surface.only(seen))
    mean, accuracy, completeness = m.chamfer(*samples)
    return {
        "chamfer": mean,
        "chamfer_percent": 100 * mean / (2 * truth.radius),
        "chamfer_accuracy": accuracy,
        "chamfer_completeness": completeness,
    }


# ---------------------------------------------------------------- results


def entry(name: str, value: float) -> dict[str, dict[str, Any]]:
    unit, definition = DEFINITIONS[name]
    return {name: {"value": float(value), "unit": unit, "definition": definition}}


def _means(per_view: dict[str, dict[str, float]]) -> dict[str, float]:
    """Mean of each per-view figure over views, and over lights where there are several ('name:light')."""
    gathered: dict[str, list[float]] = {}
    for figures in per_view.values():
        for key, value in figures.items():
            gathered.setdefault(key.split(":")[0], []).append(value)
    return {key: float(np.mean(values)) for key, values in gathered.items()}


def table(result: dict[str, Any], title: str = "", definitions: bool = True):
    """A rich Table of the figures, with what each means."""
    from rich.table import Table

    out = Table(title=title or None)
    out.add_column("figure")
    out.add_column("value", justify="right")
    out.add_column("unit")
    if definitions:
        out.add_column("definition", overflow="fold")
    for name, entry in result["metrics"].items():
        row = [name, f"{entry['value']:.4g}", entry["unit"]]
        out.add_row(*row, *([entry["definition"]] if definitions else []))
    return out

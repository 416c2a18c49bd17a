"""Truth of an object whose photos show more than the object: the layout of
`synthesize.multiview`, all of it below truth/, in the object's frame.

    truth/mesh.ply  truth/environment.exr
    truth/transforms_{train,test}.json       true cameras (see `synthesize.delivery`)
    truth/test/NAME.exr, NAME_{albedo,normal,roughness,metallic,depth}.exr
    truth/test_png/NAME.png                  the same views, 8 bit
    truth/train_albedo/NAME.exr
    truth/relight/LIGHT.exr  truth/relight/LIGHT/NAME.exr

Test views show the object alone, without what it stands on.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from relit.errors import EXIT_USAGE, UserError
from relit.images import read_image, write_linear
from relit.scene import Camera, Material, Mesh
from relit.synthesize.ceiling import ceilings
from relit.synthesize.delivery import Delivery
from relit.synthesize.multiview import (
    RADIUS,
    exposure_factor,
    files_of_lights,
    identity_of,
    object_frame,
    overridden,
    radiance,
    tell_progress,
    write_mesh,
    write_scale_view,
    write_test_view,
)
from relit.synthesize.renderers import TrueObject
from relit.synthesize.surroundings import MAX_DEPTH

SCALE_VIEWS = 8
VERSION = 1


@dataclass(frozen=True)
class CaptureFiles:
    """asset: .glb, .gltf or .obj. light, relights: lat-long .hdr or .exr. roughness, metallic:
    constants in place of the file's textures, or None."""

    asset: Path
    light: Path
    relights: tuple[Path, ...] = ()
    roughness: float | None = None
    metallic: float | None = None

    def identity(self) -> dict[str, Any]:
        """Digests for the settings. Raises UserError for a missing file or two relights of one
        name."""
        for what, file in (("asset", self.asset), *(("light", f) for f in self.lights())):
            if not file.is_file():
                raise UserError(f"no {what} file: {file}", fix="give an existing file")
        if len({f.stem for f in self.relights}) < len(self.relights):
            raise UserError(
                "two relighting files have one name",
                "the truth is kept by name",
                "rename one of them",
            )
        return {
            "asset": identity_of(self.asset),
            "light": identity_of(self.light),
            "relights": [identity_of(f) for f in self.relights],
            "roughness": self.roughness,
            "metallic": self.metallic,
        }

    def lights(self) -> tuple[Path, ...]:
        return (self.light, *self.relights)


@dataclass(frozen=True)
class Sampling:
    """Numbers and sizes. resolution: longer side of the photos in pixels. spp, test_spp: samples a
    pixel of photos and of the truth."""

    views: int
    test_views: int
    resolution: int
    spp: int
    test_spp: int
    seed: int = 0

    def __post_init__(self) -> None:
        least = {"views": 2, "test_views": 1, "resolution": 16, "spp": 1, "test_spp": 1}
        for key, low in least.items():
            if getattr(self, key) < low:
                raise UserError(
                    f"{key} = {getattr(self, key)} is too few",
                    fix=f"at least {low}",
                    code=EXIT_USAGE,
                )


@dataclass(frozen=True)
class StagedTruth:
    """The object (in the object's frame), its exposed light (H, W, 3) and where truth is
    written."""

    out: Path
    mesh: Mesh
    material: Material
    world_from_asset: np.ndarray
    environment: np.ndarray
    sampling: Sampling
    say: Callable[[str], None]

    @property
    def thing(self) -> tuple[Mesh, Material, np.ndarray]:
        return self.mesh, self.material, self.world_from_asset

    @property
    def lowest(self) -> float:
        """Height of the object's lowest vertex, world units."""
        m = self.world_from_asset
        return float((np.asarray(self.mesh.vertices) @ m[1, :3] + m[1, 3]).min())


def settings_for(
    kind: str, files: CaptureFiles, sampling: Sampling, delivery: Delivery, **options: Any
) -> dict[str, Any]:
    """Everything that a capture of this kind depends on."""
    return {
        "version": VERSION,
        "kind": kind,
        **files.identity(),
        **vars(sampling),
        "delivery": delivery.settings(),
        "max_depth": MAX_DEPTH,
        **options,
    }


def stage_truth(
    out: Path,
    files: CaptureFiles,
    sampling: Sampling,
    cameras: Sequence[tuple[str, Camera]],
    say: Callable[[str], None],
) -> StagedTruth:
    """Read the object and its light, exposed for the object in `cameras`; writes mesh and light."""
    from relit.asset.gltf import read_asset_file
    from relit.reference.mitsuba_scene import build_scene

    mesh, material = read_asset_file(files.asset)
    material = overridden(material, files.roughness, files.metallic)
    placed = object_frame(mesh)
    environment = read_image(files.light).rgb
    scene = build_scene(mesh, material, placed, environment, bsdf="principled")
    factor = exposure_factor(scene, cameras, MAX_DEPTH)
    environment = (environment * factor).astype(np.float32)
    write_mesh(out / "truth" / "mesh.ply", mesh, placed)
    write_linear(out / "truth" / "environment.exr", environment)
    return StagedTruth(out, mesh, material, placed, environment, sampling, say)


def write_object_truth(
    t: StagedTruth,
    files: CaptureFiles,
    train: Sequence[tuple[str, Camera]],
    test: Sequence[tuple[str, Camera]],
) -> dict[str, Any]:
    """Everything of the layout above but the cameras. train, test: (name, pinhole) in the object's
    frame. Returns the entries of truth.json that `evaluate` needs."""
    from relit.reference.mitsuba_scene import build_scene

    seed = t.sampling.seed * 1_000_003
    truth, spp = t.out / "truth", t.sampling.test_spp
    scene = build_scene(*t.thing, t.environment, bsdf="principled")
    count = min(SCALE_VIEWS, len(train))
    chosen = np.unique(np.linspace(0, len(train) - 1, count).round().astype(int))
    for i in chosen:
        write_scale_view(t.out, scene, *train[i])
    for i, (name, camera) in enumerate(test):
        place = f"truth/test_png/{name}"
        write_test_view(t.out, scene, place, camera, spp, MAX_DEPTH, seed + 500_000 + i)
        tell_progress(t.say, "test view", i, len(test))
    for j, file in enumerate(files.relights):
        environment = read_image(file).rgb
        lit = build_scene(*t.thing, environment, bsdf="principled")
        factor = exposure_factor(lit, test, MAX_DEPTH)
        environment = (environment * factor).astype(np.float32)
        lit = build_scene(*t.thing, environment, bsdf="principled")
        folder = truth / "relight" / file.stem
        write_linear(folder.with_suffix(".exr"), environment)
        for i, (name, camera) in enumerate(test):
            target = folder / f"{name}.exr"
            if not target.exists():
                number = seed + 600_000 + 1000 * j + i
                write_linear(target, radiance(lit, camera, spp, MAX_DEPTH, number))
            tell_progress(t.say, f"test view under {file.stem}", i, len(test))
    lights = files_of_lights(truth, files.relights, test)
    return {
        "ceiling": ceilings(TrueObject(*t.thing), lights, spp, t.sampling.seed, t.say),
        "world_from_asset": t.world_from_asset.tolist(),
        "sphere": {"centre": [0.0, 0.0, 0.0], "radius": RADIUS},
        "ior": t.material.ior,
        "train": [name for name, _ in train],
        "test": [name for name, _ in test],
        "train_albedo": [train[i][0] for i in chosen],
        "relight": [file.stem for file in files.relights],
    }

"""The truth of a synthetic pile, and the test views of a recovered one beside it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from relit.conventions import move_points, world_from_cv_camera
from relit.errors import UserError
from relit.evaluate import metrics as m
from relit.evaluate.picture_figures import Draw
from relit.evaluate.pile_alignment import grown_about
from relit.scene import Asset, Camera, Ground, Material

COVERED = 0.5  # of a pixel; the truth's coverage is that of the pixel's centre, 0 or 1


@dataclass(frozen=True)
class PileTruth:
    """What `relit synthesize duplicates` wrote. content: of truth.json. cameras: of the test views,
    by name. photo: the camera of the photo. poses: label -> world_from_object (4, 4)."""

    folder: Path
    content: dict[str, Any]
    cameras: list[tuple[str, Camera]]
    photo: Camera
    poses: dict[int, np.ndarray]

    def picture(self, name: str) -> np.ndarray:
        """A linear picture below truth/."""
        from relit.images import read_data

        return read_data(self.folder / "truth" / f"{name}.exr")


def load_pile_truth(folder: Path) -> PileTruth:
    """The truth of a rendered pile. Raises UserError where its rendering was stopped."""
    from relit.asset.asset import read_bounded_json

    if not (folder / "truth" / "truth.json").is_file():
        raise UserError(
            "the folder holds no complete truth",
            "its rendering was stopped",
            f"make it again: {folder}",
        )
    content = read_bounded_json(folder / "truth" / "truth.json")
    return PileTruth(
        folder,
        content,
        read_transforms(folder / "transforms_test.json"),
        read_transforms(folder / "transforms_train.json")[0][1],
        {i["label"]: np.array(i["world_from_object"]) for i in content["instances"]},
    )


@dataclass(frozen=True)
class PileViews:
    """A recovered pile in the test views. moved: world_from_object (4, 4) of the registered
    instances, grown about the photo's camera. predicted: view -> channels of the objects alone
    (`render_channels`). albedo: view -> true base colour and coverage (H, W, 4). inside: view -> (H,
    W) bool, coverage >= MASK."""

    asset: Asset
    truth: PileTruth
    moved: list[np.ndarray]
    ground: Ground | None
    predicted: dict[str, dict[str, np.ndarray]]
    albedo: dict[str, np.ndarray]
    inside: dict[str, np.ndarray]

    @staticmethod
    def of(asset: Asset, truth: PileTruth, scale: float) -> PileViews:
        """Render the channels of all test views. scale: about the photo's camera."""
        from relit.reference.mitsuba_scene import build_scene, render_channels
        from relit.reference.pile import build_pile

        centre = truth.photo.centre
        moved = [grown_about(centre, scale) @ p for p in registered_poses(asset).values()]
        ground = None if asset.ground is None else scaled_ground(asset.ground, centre, scale)
        objects = build_pile(asset.mesh, asset.material, moved)
        bare = build_scene(objects.mesh, objects.material, np.eye(4), None)
        predicted = {name: render_channels(bare, camera, spp=16) for name, camera in truth.cameras}
        albedo = {name: truth.picture(f"test/{name}_albedo") for name in predicted}
        inside = {name: a[..., 3] >= m.MASK for name, a in albedo.items()}
        return PileViews(asset, truth, moved, ground, predicted, albedo, inside)

    def pictures(
        self, material: Material, light: np.ndarray, folder: str, draw: Draw
    ) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """view -> (recovered, true) linear pictures (H, W, 3) under a light, black where no object
        is: each by its own coverage, cut at COVERED. folder: of the truth's pictures."""
        from relit.reference.mitsuba_scene import build_scene, render
        from relit.reference.pile import build_pile

        pile = build_pile(self.asset.mesh, material, self.moved, self.ground)
        scene = build_scene(pile.mesh, pile.material, np.eye(4), light)
        depth, out = self.truth.content["settings"]["max_depth"], {}
        for i, (name, camera) in enumerate(self.truth.cameras):
            shown = render(scene, camera, spp=draw.spp, seed=draw.seed + i, max_depth=depth)
            covered = (self.predicted[name]["alpha"] >= COVERED)[..., None]
            true = self.truth.picture(f"{folder}/{name}")[..., :3]
            out[name] = shown[..., :3] * covered, true * (self.albedo[name][..., 3:] > 0)
        return out


def registered_poses(asset: Asset) -> dict[int, np.ndarray]:
    """label -> world_from_object (4, 4) of the registered instances. The labels of the photos of a
    synthetic pile agree; where one stands twice, the first photo's counts."""
    out: dict[int, np.ndarray] = {}
    for i in sorted(asset.instances, key=lambda one: one.photo):
        if i.registered:
            out.setdefault(i.label, np.asarray(i.world_from_object))
    return out


def scaled_ground(g: Ground, centre: np.ndarray, scale: float) -> Ground:
    """The ground grown about a point."""
    return replace(
        g, point=move_points(grown_about(centre, scale), g.point), radius=g.radius * scale
    )


def read_transforms(file: Path) -> list[tuple[str, Camera]]:
    """(name, Camera) pairs of a transforms file with one focal length."""
    from relit.asset.asset import read_bounded_json

    data = read_bounded_json(file)
    w, h, f = data["w"], data["h"], float(data["focal"])
    return [
        (
            Path(x["file_path"]).stem,
            Camera(
                w,
                h,
                f,
                f,
                w / 2,
                h / 2,
                world_from_cv_camera(np.array(x["transform_matrix"], np.float64)),
            ),
        )
        for x in data["frames"]
    ]

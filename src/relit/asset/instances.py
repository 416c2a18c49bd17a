"""The instances of a photo of duplicates in the asset folder: `instances.json`, and `scene.glb`
with one node for each of them.

    {"instances": [{"label": 42, "world_from_object": 4x4, "registered": true}, {"label": 85,
    "registered": false, "reason": "..."}],
     "ground": {"point": [x, y, z], "normal": [x, y, z], "radius": r, "colour": [r, g, b],
     "roughness": .8}}

An instance that the first photo does not show has the number of the photo whose label it is,
`"photo": 2`. A registered instance has a reason where its pose is uncertain, and the chance that it
is wrong, `"chance_wrong": .04`, by its agreement with a model of the others. The object frame is the
asset frame (the GLB's coordinates after its node transforms), the world that of `cameras.json`.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from relit.asset.gltf import write_glb
from relit.errors import UserError
from relit.scene import Asset, Ground, Instance

MAX_BYTES = 16 << 20


def write_instances(folder: Path, asset: Asset) -> None:
    """Write instances.json and scene.glb into the asset folder."""
    listed = []
    for i in asset.instances:
        entry: dict = {"label": int(i.label), "registered": i.registered}
        if i.photo:
            entry["photo"] = int(i.photo) + 1
        if i.registered:
            entry["world_from_object"] = np.asarray(i.world_from_object, np.float64).tolist()
        if i.chance_wrong is not None:
            entry["chance_wrong"] = round(float(i.chance_wrong), 3)
        if i.reason or not i.registered:
            entry["reason"] = i.reason
        listed.append(entry)
    data: dict = {"instances": listed}
    if asset.ground is not None:
        g = asset.ground
        data["ground"] = {
            "point": np.asarray(g.point, np.float64).tolist(),
            "normal": np.asarray(g.normal, np.float64).tolist(),
            "radius": float(g.radius),
            "colour": np.asarray(g.colour, np.float64).tolist(),
            "roughness": float(g.roughness),
        }
    (folder / "instances.json").write_text(json.dumps(data, indent=1, allow_nan=False) + "\n")
    poses = [(node_name(i), i.world_from_object) for i in asset.instances if i.registered]
    asset_from_world = np.linalg.inv(asset.world_from_asset)  # +Y stays up
    write_glb(
        folder / "scene.glb",
        asset.mesh,
        asset.material,
        instances=[(name, asset_from_world @ np.asarray(pose)) for name, pose in poses],
    )


def node_name(instance: Instance) -> str:
    """The name of an instance's node in scene.glb."""
    photo = f"photo_{instance.photo + 1}_" if instance.photo else ""
    return f"{photo}instance_{instance.label}"


def read_instances(folder: Path) -> tuple[tuple[Instance, ...], Ground | None]:
    """What instances.json holds; nothing where there is none. Raises UserError for a damaged
    file."""
    file = folder / "instances.json"
    if not file.is_file():
        return (), None
    try:
        if file.stat().st_size > MAX_BYTES:
            raise ValueError("it is too large")
        data = json.loads(file.read_text())
        instances = []
        for entry in data["instances"]:
            pose = None
            if entry.get("registered", True):
                pose = np.array(entry["world_from_object"], np.float64)
                if (
                    pose.shape != (4, 4)
                    or not np.isfinite(pose).all()
                    or abs(np.linalg.det(pose)) < 1e-30
                ):
                    raise ValueError("a pose is no regular 4 x 4 matrix")
            photo = int(entry.get("photo", 1)) - 1
            instances.append(
                Instance(
                    int(entry["label"]),
                    pose,
                    str(entry.get("reason", "")),
                    photo,
                    None if entry.get("chance_wrong") is None else float(entry["chance_wrong"]),
                )
            )
        ground = None
        if data.get("ground"):
            g = data["ground"]
            point, normal, colour = (
                np.array(g[k], np.float64).reshape(3) for k in ("point", "normal", "colour")
            )
            ground = Ground(
                point,
                normal / np.linalg.norm(normal),
                float(g["radius"]),
                colour,
                float(g.get("roughness", 0.8)),
            )
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as e:
        raise UserError(
            "instances.json cannot be used",
            f"{type(e).__name__}: {e}",
            f"reconstruct again: {folder}",
        ) from None
    return tuple(instances), ground

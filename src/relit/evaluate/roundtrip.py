"""What the file formats cost: an asset read back from its folder against pictures of it as the fit
held it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from relit.evaluate import metrics as m
from relit.evaluate.definitions import ROUNDTRIP_SIDE, ROUNDTRIP_SPP, ROUNDTRIP_VIEWS
from relit.evaluate.picture_figures import picture_figures
from relit.scene import Asset, Camera


def write_own_renders(folder: str | Path, asset: Asset) -> None:
    """Keep pictures of an asset as the fit holds it, before any file format: `own_0000.exr` (0000 =
    index of the camera), linear RGBA.

    ROUNDTRIP_VIEWS of its cameras, at most ROUNDTRIP_SIDE pixels a side, under its own light.
    `glb_roundtrip` compares with them.
    """
    from relit.images import write_linear
    from relit.reference.mitsuba_scene import build_scene, render

    count = len(asset.cameras)
    if asset.environment is None or count == 0:
        return
    scene = build_scene(asset.mesh, asset.material, asset.world_from_asset, asset.environment)
    for i in np.unique(np.linspace(0, count - 1, min(ROUNDTRIP_VIEWS, count)).round().astype(int)):
        picture = render(scene, _small(asset.cameras[i][1]), spp=ROUNDTRIP_SPP, seed=int(i))
        write_linear(Path(folder) / f"own_{i:04d}.exr", picture)


def glb_roundtrip(asset: Asset, folder: str | Path) -> dict[str, float]:
    """The glb_roundtrip figures, means over views, of an asset that was read back from its folder
    against the pictures of `write_own_renders` in `folder`: the same views, light and random
    numbers. {} where there are no such pictures."""
    from relit.images import read_data
    from relit.reference.mitsuba_scene import build_scene, render

    files = sorted(Path(folder).glob("own_*.exr"))
    if not files or asset.environment is None:
        return {}
    scene = build_scene(asset.mesh, asset.material, asset.world_from_asset, asset.environment)
    found = []
    for file in files:
        i = int(file.stem.removeprefix("own_"))
        picture, own = (
            render(scene, _small(asset.cameras[i][1]), spp=ROUNDTRIP_SPP, seed=i),
            read_data(file),
        )
        found.append(picture_figures(picture[..., :3], own[..., :3], own[..., 3] >= m.MASK))
    return {f"glb_roundtrip_{k}": float(np.nanmean([f[k] for f in found])) for k in found[0]}


def _small(camera: Camera) -> Camera:
    return camera.within(ROUNDTRIP_SIDE)

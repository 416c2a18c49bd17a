"""An asset as its photos show it: with everything that stands in them, under the light of each."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from relit.reference.flash_scene import build_flash_scene, render_flash
from relit.reference.mitsuba_scene import Scene, build_scene, render
from relit.reference.pile import build_pile
from relit.scene import Asset, Camera

FLASH_DEPTH = 5  # longest path in edges under the flash

Shower = Callable[..., np.ndarray]


def as_photographed(asset: Asset) -> Shower:
    """show(name, camera, spp=, seed=0, where=None, progress=None) -> (H, W, 4) float32: linear
    radiance premultiplied on black, and alpha.

    name: of one of the asset's photos, camera: any (the photo's own, resized). Of a flash capture:
    the rough plastic under the flash where it is when `camera` takes its photo. Of duplicates: all
    registered instances on their ground. Of a collection: under the light of the photo `name`, its
    exposure in it; under the environment for other names. Else: the object under the environment.
    where, progress: see `mitsuba_scene.sample_sums`.
    """
    if asset.flash is not None:
        flash_scene = build_flash_scene(asset.mesh, asset.material, asset.world_from_asset)

        def show(name: str, camera: Camera, *, spp: int, seed: int = 0, **how) -> np.ndarray:
            return render_flash(
                flash_scene, camera, asset.flash, spp, seed=seed, max_depth=FLASH_DEPTH, **how
            )

    elif asset.lights:
        lights = {name: light for (name, _), light in zip(asset.cameras, asset.lights, strict=True)}

        def show(name: str, camera: Camera, *, spp: int, seed: int = 0, **how) -> np.ndarray:
            light = lights.get(name, asset.environment)
            return render(
                build_scene(asset.mesh, asset.material, asset.world_from_asset, light),
                camera,
                spp=spp,
                seed=seed,
                **how,
            )

    else:
        scene = lit_scene(asset)

        def show(name: str, camera: Camera, *, spp: int, seed: int = 0, **how) -> np.ndarray:
            return render(scene, camera, spp=spp, seed=seed, **how)

    return show


def lit_scene(asset: Asset, ground: bool = True, whole: bool = True) -> Scene:
    """The object, or of duplicates all registered instances, under the asset's environment. ground:
    with the ground that they lie on.
    whole: False for the object alone."""
    poses = [i.world_from_object for i in asset.instances if i.registered and whole]
    if not poses:
        return build_scene(asset.mesh, asset.material, asset.world_from_asset, asset.environment)
    pile = build_pile(asset.mesh, asset.material, poses, asset.ground if ground else None)
    return build_scene(pile.mesh, pile.material, np.eye(4), asset.environment)

"""The base colour of the ground under a pile, told by the photo: the light and everything that
shadows the ground are known by then."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from relit.reference.photographed import as_photographed
from relit.scene import Asset, Pixels

SIDE = 240  # pixels of the picture that is compared, longer side
SAMPLES = 16
# highlights and what goes back and forth between ground and objects do not grow with its colour
ROUNDS = 3
DARKEST, BRIGHTEST = 0.02, 0.95


def ground_as_shown(asset: Asset, pixels: Pixels, seed: int = 0) -> Asset:
    """The asset with its ground's base colour (3,) scaled until the ground, rendered with the pile
    on it under the asset's environment, is as bright as the first photo, `pixels`, shows it: in
    each channel by the median over what is ground in both. The ground is one colour; an asset whose
    photo shows none of it stays as it is."""
    if asset.ground is None or pixels.labels is None:
        return asset
    name, camera = asset.cameras[0]
    camera = camera.within(SIDE)
    size = (camera.width, camera.height)
    photo = cv2.resize(pixels.rgb, size, interpolation=cv2.INTER_AREA)
    free = (
        cv2.resize((pixels.labels == 0).astype(np.float32), size, interpolation=cv2.INTER_AREA)
        > 0.999
    )
    for _ in range(ROUNDS):
        picture = as_photographed(asset)(name, camera, spp=SAMPLES, seed=seed)
        where = free & (picture[..., 3] > 0.999) & (picture[..., :3] > 0).all(-1)
        if not where.any():
            return asset
        ratio = np.median(photo[where] / picture[where, :3], axis=0)
        colour = np.clip(np.asarray(asset.ground.colour) * ratio, DARKEST, BRIGHTEST)
        asset = replace(asset, ground=replace(asset.ground, colour=colour))
    return asset

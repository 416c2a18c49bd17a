"""Search for the pose of an object of which a part is hidden.

`fit.registration.register.search` lays the middle and the spread of the silhouette that is seen on those of a
rendering. Of an object behind another neither is known. Where the middle may lie, and how far the
whole may reach, is tried then, on a small grid; pixels where the object may be hidden carry no
weight.
"""

from __future__ import annotations

import numpy as np

from relit.fit.registration.instances.views import InstanceView
from relit.fit.registration.register import Crop, Gallery, Hypotheses, Rings, rings_of, search
from relit.geometry.se3 import rotation_angle

# share of the outline that ends at known background, from which on an object counts as seen whole
WHOLE = 0.9
STEPS = np.arange(-1.2, 1.21, 0.4)  # of the middle, in spreads of what is seen
REACH = 1.25  # of these steps
SIZES = (0.85, 1.0, 1.15)  # times the usual spread of the renderings


def look_for(
    views: list[InstanceView],
    crops: list[Crop],
    gallery: Gallery,
    rings: Rings,
    parts,
    keep: int = 4,
    apart: float = 20.0,
) -> Hypotheses:
    """As `fit.registration.register.search`. rings: of the crops under the weights `parts`."""
    found = search(crops, gallery, keep=keep, rings=rings, apart=apart)
    for k, (view, crop) in enumerate(zip(views, crops, strict=True)):
        if view.seen >= WHOLE:
            continue
        more = shifted(crop, gallery, rings.centre[k], rings.spread[k], parts)
        also = search([crop] * len(more.norm), gallery, keep=1, rings=more, apart=apart)
        poses = np.concatenate([found.poses[k], also.poses[:, 0]])
        scores = np.concatenate([found.scores[k], also.scores[:, 0]])
        seen = np.concatenate([found.view[k], also.view[:, 0]])
        chosen: list[int] = []
        for i in np.argsort(-scores):
            if len(chosen) < keep and all(
                rotation_angle(poses[i][:3, :3].T @ poses[j][:3, :3]) >= apart for j in chosen
            ):
                chosen.append(int(i))
        for arrays, best in ((found.poses, poses), (found.scores, scores), (found.view, seen)):
            arrays[k, : len(chosen)] = best[chosen]
    return found


def shifted(crop: Crop, gallery: Gallery, centre: np.ndarray, spread: float, parts) -> Rings:
    """What is compared of a crop (whose seen part has this centre and spread, in pixels) for other
    middles and sizes of the whole."""
    usual = float(np.median(gallery.rings.spread)) * crop.camera.fx / gallery.cameras[0].fx
    x, y = np.meshgrid(STEPS, STEPS)
    steps = np.stack([x.ravel(), y.ravel()], -1)[(x**2 + y**2).ravel() < REACH**2]
    sizes = np.repeat(usual * np.array(SIZES), len(steps))
    centres = np.tile(centre + spread * steps, (len(SIZES), 1))
    pictures = [
        np.broadcast_to(a, (len(sizes), *a.shape)) for a in (crop.rgb, crop.mask, crop.weight)
    ]
    return rings_of(*pictures, centres, sizes, parts)

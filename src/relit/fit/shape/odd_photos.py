"""Photos whose masks do not agree with the finished shape: their cameras are wrong, or their masks.

Structure from motion can take two sides of an object that look alike for one, and puts a whole set
of photos half a turn away, with small reprojection errors. The shape is then a compromise, which
nothing but its outlines in the photos tells.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from relit.fit.shape.outlines import trace_rays
from relit.reference.mitsuba_scene import build_geometry
from relit.run import Run
from relit.scene import Camera, Mesh

OVERLAP = 0.8  # less is odd; see `mask_overlaps`
NOTHING = 0.5  # of the median photo; less, and it is no shape of the object
LOOKED_AT = 20_000  # pixels of a photo, about
NAMED = 12  # photos


def mask_overlaps(mesh: Mesh, cameras: Sequence[Camera], masks: Sequence[np.ndarray]) -> np.ndarray:
    """(views,) intersection over union of each mask (h, w) and the silhouette of the mesh, over an
    even grid of pixels; 1 where both are empty. cameras: in the frame of the mesh."""
    scene, out = build_geometry(mesh), []
    for camera, mask in zip(cameras, masks, strict=True):
        step = max(1, round(np.sqrt(mask.size / LOOKED_AT)))
        y, x = (
            a.ravel()
            for a in np.mgrid[step // 2 : mask.shape[0] : step, step // 2 : mask.shape[1] : step]
        )
        shown, inside = (
            np.isfinite(trace_rays(scene, camera, x + 0.5, y + 0.5)[0]),
            mask[y, x] > 0.5,
        )
        either = np.count_nonzero(shown | inside)
        out.append(np.count_nonzero(shown & inside) / either if either else 1.0)
    return np.array(out)


def check_overlaps(overlaps: np.ndarray, run: Run) -> None:
    """Refuse a shape that fills hardly any mask. overlaps: of `mask_overlaps`."""
    if np.median(overlaps) < NOTHING:
        run.refuse(
            f"the shape does not fill the masks (intersection over union {np.median(overlaps):.2f}, median of the photos)",
            "the cameras or the masks are wrong, or the object sphere misses the object",
            "look at `relit inspect INPUT`; give --sphere X,Y,Z,RADIUS",
        )


def note_of_odd_photos(overlaps: np.ndarray, names: Sequence[str]) -> str:
    """A line on photos whose masks the shape does not fill, or ""."""
    odd = [k for k in np.argsort(overlaps) if overlaps[k] < OVERLAP]
    if not odd:
        return ""
    some = ", ".join(f"{names[k]} {overlaps[k]:.2f}" for k in odd[:NAMED])
    share = f"{len(odd)} of {len(overlaps)} photos"
    return (
        f"note: the shape does not fill the masks of {share} (intersection over union below {OVERLAP}: {some}): "
        "their cameras or masks are wrong, and bend the shape: leave them out, or mend their masks; where the object looks alike from two "
        "sides, photos of both may have been taken for one: put something with print beside it, or give cameras"
    )

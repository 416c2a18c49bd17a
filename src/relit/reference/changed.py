"""What a change does to a photo: differential rendering (Debevec 1998, Sec. 4), as finely as the
change shows.

Where the changed thing itself is seen, the picture is rendered. Everywhere else the photo stays,
plus what the change does to it, render
after minus render before: contact shadows and inter-reflections fall on what was photographed. On
most of a photo that is nothing, or changes slowly from place to place. So both are rendered at a
quarter of the size first, and at full size only where their difference has detail.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from relit.scene import Camera

COARSE = 4  # times smaller
LEAST = 256  # pixels, the longer side of photos that are rendered as they are
DETAIL = 0.03  # part of the photo's own radiance, from which on detail is rendered at full size
DARK = 0.02  # radiance, added to the photo's: in the dark more is needed to be seen
SMOOTH, SMOOTHER = (
    1.0,
    3.0,
)  # coarse pixels, standard deviations: against noise of the difference, and what is no detail
# coarse pixels around detail, and around the changed thing, which pixels beside `own` still show in
# part
REACH = 1

Show = Callable[
    ..., np.ndarray
]  # show(camera, where=None, progress=None) -> (H, W, 4), see `mitsuba_scene.render`


def change_of(
    before: Show,
    after: Show,
    camera: Camera,
    picture: np.ndarray,
    own: np.ndarray,
    rim: np.ndarray | None = None,
    progress=None,
) -> tuple[np.ndarray, np.ndarray]:
    """(after, change), (H, W, 3) each: the render after the change, in the pixels of `own` and
    `rim`; and by how much the change makes the photo brighter, in all pixels but those of `own`.

    picture: (H, W, 3) linear radiance of the photo. own: (H, W) bool, the changed thing itself.
    rim: (H, W) bool, pixels that it shares.
    progress: called with (done, all) in thousands of pixels; all is a guess until it is known where
    there is detail.
    """
    h, w = own.shape
    rim = np.zeros_like(own) if rim is None else rim & ~own
    told = JointProgress(progress)
    if max(h, w) <= LEAST:
        change, near = np.zeros_like(picture), ~own
    else:
        small = camera.resized(max(1, w // COARSE), max(1, h // COARSE))
        size = (small.width, small.height)
        told.all = 2 * small.width * small.height + 3 * int(own.sum())
        coarse = (
            after(small, progress=told.of(size[0] * size[1]))
            - before(small, progress=told.of(size[0] * size[1]))
        )[..., :3]
        around = np.ones((2 * REACH + 1, 2 * REACH + 1), np.uint8)
        outside = (
            cv2.dilate(
                cv2.resize(own.astype(np.float32), size, interpolation=cv2.INTER_AREA), around
            )
            == 0
        )
        smooth, smoother = (_smoothed(coarse, outside, width) for width in (SMOOTH, SMOOTHER))
        bright = cv2.resize(picture, size, interpolation=cv2.INTER_AREA) + DARK
        seen = (np.abs(smooth - smoother) > DETAIL * bright).any(-1) | ~outside
        seen = cv2.dilate(seen.astype(np.uint8), around)
        near = (cv2.resize(seen, (w, h), interpolation=cv2.INTER_NEAREST) > 0) & ~own | rim
        change = cv2.resize(smooth, (w, h), interpolation=cv2.INTER_LINEAR)
    shown = np.zeros_like(picture)
    told.all = told.done + 2 * int(near.sum()) + int(own.sum())
    for part, both in (
        (near, True),
        (own, False),
    ):  # noise cancels where both draw the same numbers, so for the same pixels
        if part.any():
            shown[part] = after(camera, where=part, progress=told.of(int(part.sum())))[part, :3]
            if both:
                change[part] = (
                    shown[part]
                    - before(camera, where=part, progress=told.of(int(part.sum())))[part, :3]
                )
    return shown, change


def _smoothed(picture: np.ndarray, where: np.ndarray, width: float) -> np.ndarray:
    """Gaussian means (H, W, 3) of what a picture shows in the pixels of `where`, (H, W) bool,
    alone."""
    share = cv2.GaussianBlur(where.astype(np.float32), (0, 0), width)[..., None]
    return cv2.GaussianBlur(picture * where[..., None], (0, 0), width) / np.maximum(share, 1e-3)


class JointProgress:
    """Counts pixels of several renderings as one progress."""

    def __init__(self, progress: Callable[[int, int], None] | None):
        self.progress, self.done, self.all = progress, 0, 0

    def of(self, pixels: int) -> Callable[[int, int], None]:
        """What the next rendering, of so many pixels, is to call."""
        begun = self.done
        self.done += pixels

        def show(samples: int, spp: int) -> None:
            if self.progress is not None:
                self.progress((begun + pixels * samples // spp) // 1000, self.all // 1000 + 1)

        return show

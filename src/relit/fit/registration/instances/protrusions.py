"""The turn of identical bodies of revolution about their axes, from what sticks out of them: the
handle of a cup, the spout of a can.

Around the body the space is cut into cells, by distance from the axis, height and turn. Where a
view looks through a cell beside the body it shows either background, and the cell is empty, or the
object, and some cell on that line of sight is filled. Laid over each other
(fit/registration/instances/azimuth_maps.py) the views agree on which cells are filled in their true
turns alone, front and back told apart; decoration that repeats around the body does not tell these.
"""

from __future__ import annotations

import cv2
import numpy as np

from relit.fit.registration.instances.azimuth_maps import (
    AzimuthEstimate,
    Cells,
    Evidence,
    best_laid,
    cells_read,
    leads_of,
    turned_about,
)
from relit.fit.registration.instances.revolution import drawn, radius_at
from relit.fit.registration.instances.views import InstanceView, best_seen, nearest_pixels

TURNS, RADII, HEIGHTS = 72, 9, 22  # cells around the body
MAP = RADII * HEIGHTS, TURNS  # of fit/registration/instances/azimuth_maps.py
REACH, BEYOND = (
    (0.1, 1.25),
    0.1,
    # radii of the first and the last cells, and how far they go beyond the ends of the body (unit
    # lengths)
)
# shares of the window's side: next to the drawn body the outline is its own; next to the object
# background may be a pose that is not exact
OUTLINE, VAGUE = 0.013, 0.02
# log of how much likelier a line of sight shows the object, or background, where a cell on it is
# filled; and the share of filled cells
SHOWN, EMPTY, FILLED = np.log(0.95 / 0.15), np.log(0.05 / 0.85), 0.02
LARGEST = 30.0  # such a sum is certain
AT_ONCE = 14  # views that are laid together; the others are laid on what these have made
APART = 25.0  # degrees from which on a turn is another one
SOME = 10  # cells in which a view that is sure of its turn has to show something,
CLEAR = (
    5.0,
    0.04,
)  # and evidence by which that turn has to lead: so much, and so much for each of them
FEWEST = 4  # views that are sure: of fewer, what an outline has beside the body can be chance


def filled(total: np.ndarray) -> np.ndarray:
    """Log evidence of the readings of a cell that is filled or empty, over that of an empty one;
    total: sum of SHOWN and EMPTY."""
    return np.log1p(FILLED * np.expm1(np.clip(total, -LARGEST, LARGEST)))


FILLED_OR_EMPTY = Evidence(
    lambda values: np.stack([values == SHOWN, values == EMPTY]).astype(np.float64),
    lambda _, total: np.stack([filled(total + SHOWN), filled(total + EMPTY)]) - filled(total),
)


def cells_around(profile: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Middles (RADII * HEIGHTS * TURNS, 3) of the cells, turns fastest, and which of them lie
    outside the body."""
    r, y = (
        np.linspace(*REACH, RADII),
        np.linspace(profile[0] - BEYOND, profile[1] + BEYOND, HEIGHTS),
    )
    r, y, a = np.meshgrid(r, y, (np.arange(TURNS) + 0.5) * 2 * np.pi / TURNS, indexing="ij")
    return np.stack([r * np.sin(a), y, r * np.cos(a)], -1).reshape(-1, 3), (
        r > radius_at(profile, y) + 0.03
    ).ravel()


def wider(mask: np.ndarray, share: float) -> np.ndarray:
    """(H, W) bool: the mask and what lies within the share of its longer side."""
    reach = max(1, round(share * max(mask.shape)))
    return cv2.dilate((mask > 0.5).astype(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1))) > 0


def protrusion_cells(view: InstanceView, profile: np.ndarray, pose: np.ndarray) -> Cells:
    """What a view shows of the cells around the body."""
    points, outside = cells_around(profile)
    camera = view.camera.with_pose(pose)
    body, near = (
        wider(a, share) for a, share in ((drawn(profile, camera), OUTLINE), (view.mask, VAGUE))
    )
    u, v, ok = nearest_pixels(camera, points)
    known, own = outside & ((view.known[v, u] > 0.5) | ~ok), (view.mask[v, u] > 0.5) & ok
    shown, empty = known & own & ~body[v, u], known & ~(near[v, u] & ok)
    index = np.flatnonzero(shown | empty)
    row, column = np.divmod(index, TURNS)
    read = np.where(shown[index], SHOWN, EMPTY)
    return cells_read(
        FILLED_OR_EMPTY, MAP, row, column, read, np.hypot(points[index, 0], points[index, 2])
    )


def turned_by_outline(
    views: list[InstanceView], profile: np.ndarray, poses: np.ndarray
) -> AzimuthEstimate | None:
    """The turns of views whose axes are known (poses: (N, 4, 4)); None where fewer than FEWEST are
    sure of theirs."""
    read = [
        [protrusion_cells(view, profile, pose)] for view, pose in zip(views, poses, strict=True)
    ]
    _, seats, turns = best_laid(read, best_seen(views)[:AT_ONCE], FILLED_OR_EMPTY, MAP)
    show = np.array([(one.values > 0).sum() for (one,) in read])
    sure = (show >= SOME) & (
        leads_of(read, seats, turns, FILLED_OR_EMPTY, MAP, APART)
        >= np.maximum(CLEAR[0], CLEAR[1] * show)
    )
    turned = np.array(
        [turned_about(pose, t * 2 * np.pi / TURNS) for pose, t in zip(poses, turns, strict=True)]
    )
    return AzimuthEstimate(turned, sure) if sure.sum() >= FEWEST else None

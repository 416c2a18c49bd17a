"""The turn of identical bodies of revolution about their axes, from their decoration.

The pixels of each are unrolled onto the body: latitude about its middle, and turn about its axis.
Two pictures of one decoration then differ by a shift (fit/registration/instances/azimuth_maps.py):
for every cell of the map the evidence that what was seen there are noisy readings of one value,
against readings that have nothing in common (marginal likelihood of a Gaussian).

What shading leaves in the maps can be laid on top of each other as well, and of some channels it is
nearly all there is. So each channel answers for itself, and a model of all says which answer agrees
best (fit/registration/instances/revolution_search.py).
"""

from __future__ import annotations

from dataclasses import dataclass

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
from relit.fit.registration.instances.revolution import radius_at
from relit.fit.registration.instances.views import InstanceView
from relit.scene import Camera

TURNS, LATITUDES = 120, 48  # cells of a map
CHANNELS = (
    "red",
    "blue",
    "brightness",
)  # two shares of the colour, and log luminance, against their surroundings
FINE = 0.08  # of the root of the silhouette's area: standard deviation of the surroundings
FACING = 0.4  # cosine of the angle to the line of sight from which on pixels count
RAY = 128  # samples on a ray through the unit sphere
NORMALS, BANDS, FEW = (
    12,
    8,
    3.0,
    # bins of normals a side and of latitudes in which shading is averaged, and pixels that count as
    # none
)
FLOORS = (0.01, 0.01, 0.1)  # of a channel's standard deviation: what is not decoration
CLIPPED = 6.0  # standard deviations
AT_ONCE = 14  # views whose shifts are sought together; the others are laid on what these have made
APART = 25.0  # degrees from which on a turn is another one
CLEAR = 0.3  # evidence for each of its cells, by which the turn of a view that is sure of it leads


# ---------------------------------------------------------------- unrolling


def hits(
    profile: np.ndarray, camera: Camera, mask: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows and columns of the pixels of a mask whose rays meet the body, and where (P, 3) they do
    first."""
    rows, columns = np.nonzero(mask)
    x = np.stack(
        [
            (columns + 0.5 - camera.cx) / camera.fx,
            (rows + 0.5 - camera.cy) / camera.fy,
            np.ones(len(rows)),
        ],
        -1,
    )
    d = x @ np.asarray(camera.world_from_camera)[:3, :3].T
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    o = camera.centre
    b, c = d @ o, o @ o - 1.0
    root = np.sqrt(np.maximum(b * b - c, 0))
    t = (-b - root)[:, None] + 2 * root[:, None] * np.linspace(0, 1, RAY)
    p = o + t[..., None] * d[:, None]
    inside = radius_at(profile, p[..., 1]) > np.hypot(p[..., 0], p[..., 2])
    met = inside.any(1) & (root > 0)
    first = p[np.arange(len(rows)), inside.argmax(1)]
    return rows[met], columns[met], first[met]


def normals_at(profile: np.ndarray, p: np.ndarray, step: float = 0.03) -> np.ndarray:
    """Unit normals (P, 3) of the body at points on it; those of its two ends point along the
    axis."""
    rho, y = np.hypot(p[:, 0], p[:, 2]), p[:, 1]
    below, above = (
        radius_at(profile, np.clip(y + s, profile[0], profile[1])) for s in (-step, step)
    )
    n = np.stack(
        [
            p[:, 0] / np.maximum(rho, 1e-6),
            (below - above) / (2 * step),
            p[:, 2] / np.maximum(rho, 1e-6),
        ],
        -1,
    )
    end = np.where(y > profile[1] - step, 1.0, np.where(y < profile[0] + step, -1.0, 0.0)) * (
        rho < radius_at(profile, y) - 0.05
    )
    n[end != 0] = end[end != 0, None] * np.array([0.0, 1.0, 0.0])
    return n / np.linalg.norm(n, axis=1, keepdims=True)


def local_channels(view: InstanceView) -> np.ndarray:
    """(H, W, 3) of CHANNELS, against their surroundings on the object."""
    inside = ((view.mask > 0.5) & (view.known > 0.5)).astype(np.float32)
    tint = view.rgb[inside > 0].mean(0)
    solid = view.rgb / np.maximum(tint, 1e-4)  # each has its own exposure and white
    shares = solid / (solid.sum(-1, keepdims=True) + 0.15)
    sigma, out = max(1.0, FINE * np.sqrt(inside.sum())), []
    around = np.maximum(cv2.GaussianBlur(inside, (0, 0), sigma), 1e-3)
    for a in (shares[..., 0], shares[..., 2], np.log(np.maximum(solid.mean(-1), 0) + 0.06)):
        a = (a * inside).astype(np.float32)
        out.append((a - cv2.GaussianBlur(a, (0, 0), sigma) / around) * inside)
    return np.stack(out, -1)


@dataclass(frozen=True)
class UnrolledPixels:
    """row, column: (P,) cells of the map. band, facing: (P,) bins of latitude and of the normal in
    the photo's axes. values: (P, 3)."""

    row: np.ndarray
    column: np.ndarray
    band: np.ndarray
    facing: np.ndarray
    values: np.ndarray


def unrolled(view: InstanceView, profile: np.ndarray, pose: np.ndarray) -> UnrolledPixels:
    """The pixels of a view that show the body, on its map."""
    known = ((view.mask > 0.5) & (view.known > 0.5)).astype(np.uint8)
    rows, columns, p = hits(
        profile, view.camera.with_pose(pose), cv2.erode(known, np.ones((3, 3))) > 0
    )
    normal, eye = normals_at(profile, p), pose[:3, 3] - p
    rho = np.hypot(p[:, 0], p[:, 2])
    keep = ((normal * eye).sum(1) > FACING * np.linalg.norm(eye, axis=1)) & (rho > 0.04)
    p, rho, normal = p[keep], rho[keep], normal[keep] @ pose[:3, :3]
    latitude = np.arctan2(p[:, 1] - profile[:2].mean(), rho) / np.pi + 0.5
    turn = np.arctan2(p[:, 0], p[:, 2]) / (2 * np.pi) + 0.5
    facing = np.clip((normal[:, :2] + 1) / 2 * NORMALS, 0, NORMALS - 1).astype(int) @ np.array(
        [NORMALS, 1]
    )
    return UnrolledPixels(
        np.clip((latitude * LATITUDES).astype(int), 0, LATITUDES - 1),
        (turn * TURNS).astype(int) % TURNS,
        np.clip((latitude * BANDS).astype(int), 0, BANDS - 1),
        facing,
        local_channels(view)[rows[keep], columns[keep]],
    )


def without_shading(pixels: list[list[UnrolledPixels]]) -> list[list[np.ndarray]]:
    """The values (P, 3) of each view in each seat, less the mean of their latitude, and less what
    all show where they face alike: they lie under one light."""
    firsts = [seats[0] for seats in pixels]
    level, count = np.zeros((LATITUDES, 3)), np.zeros(LATITUDES)
    for one in firsts:
        np.add.at(level, one.row, one.values)
        np.add.at(count, one.row, 1)
    level /= np.maximum(count, 1)[:, None]
    shade, count = np.zeros((BANDS, NORMALS**2, 3)), np.zeros((BANDS, NORMALS**2))
    for one in firsts:
        np.add.at(shade, (one.band, one.facing), one.values - level[one.row])
        np.add.at(count, (one.band, one.facing), 1)
    shade, count = (
        np.stack(
            [
                cv2.GaussianBlur(a.reshape(NORMALS, NORMALS, -1), (0, 0), 0.7).reshape(
                    NORMALS**2, -1
                )
                for a in b
            ]
        )
        for b in (shade, count)
    )
    shade = shade / (count + FEW)
    return [
        [one.values - level[one.row] - shade[one.band, one.facing] for one in seats]
        for seats in pixels
    ]


def map_of(one: UnrolledPixels, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(LATITUDES, TURNS) bool, cells that are seen, and their mean values (3, LATITUDES, TURNS)."""
    count, total = (
        np.zeros((LATITUDES, TURNS), np.float32),
        np.zeros((3, LATITUDES, TURNS), np.float32),
    )
    np.add.at(count, (one.row, one.column), 1)
    for c in range(3):
        np.add.at(total[c], (one.row, one.column), values[:, c])

    def spread(a):  # to the neighbours, around
        return cv2.GaussianBlur(np.concatenate([a[:, -6:], a, a[:, :6]], 1), (0, 0), 1.0)[:, 6:-6]

    count, total = spread(count), np.stack([spread(a) for a in total])
    return count > 0.15, total / np.maximum(count, 1e-6)


def maps_of(
    views: list[InstanceView], profile: np.ndarray, seats: list[list[np.ndarray]]
) -> list[list[tuple[np.ndarray, np.ndarray]]]:
    """`map_of` of each view in each seat, the values in standard deviations."""
    pixels = [
        [unrolled(view, profile, pose) for pose in poses]
        for view, poses in zip(views, seats, strict=True)
    ]
    values = without_shading(pixels)
    maps = [
        [map_of(p, v) for p, v in zip(ps, vs, strict=True)]
        for ps, vs in zip(pixels, values, strict=True)
    ]
    seen = np.concatenate([values[:, shown] for (shown, values), *_ in maps], 1)
    scale = np.sqrt(seen.var(1) + np.array(FLOORS) ** 2)[:, None, None]
    return [
        [(shown, np.clip(values / scale, -CLIPPED, CLIPPED)) for shown, values in one]
        for one in maps
    ]


# ---------------------------------------------------------------- shifts


def pattern_cells(shown: np.ndarray, values: np.ndarray) -> Cells:
    """values: (C, LATITUDES, TURNS) of the channels that are asked, which lie below one another."""
    row, column = np.nonzero(shown)
    weight = np.cos((row + 0.5) / LATITUDES * np.pi - np.pi / 2)
    count = len(values)
    rows = np.concatenate([row + c * LATITUDES for c in range(count)])
    read = values[:, row, column].ravel().astype(np.float64)
    return cells_read(
        ONE_VALUE,
        (count * LATITUDES, TURNS),
        rows,
        np.tile(column, count),
        read,
        np.tile(weight, count),
    )


def one_value(count: np.ndarray, total: np.ndarray) -> np.ndarray:
    """Twice the log evidence that readings of variance 1 (half of it noise) have a common value,
    against none; count of them, and total."""
    return 2 * total**2 / (1 + count) - np.log1p(count)


def gains_of_one_value(count: np.ndarray, total: np.ndarray) -> np.ndarray:
    """(3, ...) what 1, v and the square of v are multiplied by, of a further reading v."""
    return np.stack(
        [
            one_value(count + 1, total) - one_value(count, total),
            4 * total / (2 + count),
            2 / (2 + count),
        ]
    )


ONE_VALUE = Evidence(lambda v: np.stack([np.ones_like(v), v, v**2]), gains_of_one_value)


def turned_by_decoration(
    views: list[InstanceView], profile: np.ndarray, seats: list[list[np.ndarray]]
) -> dict[str, AzimuthEstimate]:
    """The seat and the turn about the axis of each view, as each of CHANNELS tells it, and all
    together."""
    maps, out = maps_of(views, profile, seats), {}
    group = sorted(range(len(views)), key=lambda k: -maps[k][0][0].sum())[:AT_ONCE]
    for channel, use in (
        *((name, [c]) for c, name in enumerate(CHANNELS)),
        ("colour and brightness", [0, 1, 2]),
    ):
        shape = len(use) * LATITUDES, TURNS
        read = [[pattern_cells(shown, values[use]) for shown, values in one] for one in maps]
        _, chosen, turns = best_laid(read, group, ONE_VALUE, shape)
        poses = np.array(
            [
                turned_about(some[i], t * 2 * np.pi / TURNS)
                for some, i, t in zip(seats, chosen, turns, strict=True)
            ]
        )
        size = [max(len(some[i].values), 1) for some, i in zip(read, chosen, strict=True)]
        out[channel] = AzimuthEstimate(
            poses, leads_of(read, chosen, turns, ONE_VALUE, shape, APART) >= CLEAR * np.array(size)
        )
    return out

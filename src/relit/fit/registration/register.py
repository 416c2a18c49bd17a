"""Registration by rendering: where does a photo see a known coarse model from?

Poses are not convex, so they are searched, not descended. The model is rendered once from
viewpoints all around it; every photo's crop is compared with every viewpoint under every in-plane
turn. What is compared is a descriptor that hardly knows the light: silhouette, chromaticity and
standardised log luminance, sampled on rings around the silhouette's centre in units of its spread.
Turning the picture then is a shift along the rings, so all turns of all pairs come from one product
per Fourier frequency. Pixels of a photo may be unknown (outside the frame, behind something else):
they carry weight 0.

    crop_photo         a photo -> Crop: a virtual camera that looks at the object, its picture, mask
                       and weights
    make_gallery       a model and viewpoints -> Gallery
    search             crops, gallery -> Hypotheses, the best few poses of each crop with scores
    refine             poses of crops -> better poses, by renderings from near-by viewpoints
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.fft import irfft, rfft

from relit.conventions import similarity
from relit.fit.passes.pixels import RayBatch, camera_rows, rays_through
from relit.fit.passes.volume import VolumeModel
from relit.geometry.hull import NoShape
from relit.geometry.se3 import exp_so3, look_at, rotation_angle, rotation_from
from relit.rendering.march import march, sphere_interval
from relit.scene import Camera

SIDE = 64  # pixels of crops and renderings
# half the side of a crop, in spreads of the silhouette (a disc's edge lies at 1.41, a rod's at
# 1.73)
REACH = 2.4
RINGS, TURNS = 18, 72
RING_REACH = 2.1  # outermost ring, in spreads
AT_ONCE = (
    64  # pictures that are described together: what comes in between stays in the processor's cache
)
FINE = 3.0  # pixels, standard deviation of the surroundings that detail is told from
PARTS = (
    0.6,
    2.0,
    0.15,
    # weights of silhouette, chromaticity and log luminance, and where there are four of detail (see
    # `detail`)
)
AHEAD = np.array([0.0, 0.0, 1.0])  # the optical axis in a camera's own axes
CHUNK = 1 << 20  # rays that are rendered at a time

REFINE = (0, 0, 6.0, 3.0, 1.5, 0.75)  # degrees, the rounds of `refine`

Render = Callable[
    [list[Camera]], tuple[np.ndarray, np.ndarray]
]  # cameras in the model's frame, all of one size -> rgb, alpha


@dataclass(frozen=True)
class Crop:
    """camera: the virtual camera, SIDE x SIDE; its `world_from_camera` is the rotation
    photo_from_crop (4, 4).
    rgb: (S, S, 3) linear. mask: (S, S) in [0, 1]. weight: (S, S), 0 where the photo does not
    tell."""

    camera: Camera
    rgb: np.ndarray
    mask: np.ndarray
    weight: np.ndarray


@dataclass(frozen=True)
class Gallery:
    """Renderings of a model. cameras: one of each view, in the model's frame. rings: what is
    compared, see `Rings`."""

    cameras: list[Camera]
    rings: Rings


@dataclass(frozen=True)
class Rings:
    """Pictures sampled on rings, as Fourier transforms along the turn (F frequencies).

    spectrum, plain: (N, F, RINGS * channels) complex64, of weight * descriptor and of the
    descriptor. squares, weights: (N, F, RINGS), of the sum over channels of descriptor^2 and of the
    pixel weights. norm: (N,) of the weighted descriptor. centre: (N, 2),
    spread: (N,), both in pixels: where the rings lie."""

    spectrum: np.ndarray
    plain: np.ndarray
    squares: np.ndarray
    weights: np.ndarray
    norm: np.ndarray
    centre: np.ndarray
    spread: np.ndarray


@dataclass(frozen=True)
class Hypotheses:
    """poses: (P, K, 4, 4) model_from_camera of the PHOTO's camera (OpenCV axes), scores: (P, K) in
    [-1, 1], best first. view: (P, K) index in the gallery. Where fewer than K were allowed the
    score is -1."""

    poses: np.ndarray
    scores: np.ndarray
    view: np.ndarray


# ---------------------------------------------------------------- crops


def crop_photo(
    rgb: np.ndarray,
    mask: np.ndarray,
    camera: Camera,
    weight: np.ndarray | None = None,
    side: int = SIDE,
) -> Crop:
    """Look at the object of a photo with a camera of its own: turned to the silhouette's centre, so
    that a wide photo's stretching off its middle is gone, and zoomed to REACH spreads of the
    silhouette.

    rgb: (H, W, 3) linear, mask: (H, W), weight: (H, W) or None (all known). camera: intrinsics
    only. Raises NoShape for an empty mask.
    """
    known = mask if weight is None else mask * weight
    if not known.sum() > 1:
        raise NoShape("the mask is empty")
    centre, spread = (a[0] for a in moments(known[None]))
    u, v = centre
    ray = np.array([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0])
    turn = rotation_from(AHEAD, ray)
    # a pixel off the middle covers a smaller angle: 1 / |ray|^1.5 is the mean of both directions
    focal = 0.5 * side / REACH / max(spread / camera.fx, 1e-6) * np.linalg.norm(ray) ** 1.5
    virtual = Camera(side, side, focal, focal, side / 2, side / 2, similarity(turn, np.zeros(3)))
    half = np.array(
        [[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]]
    )  # cv2's pixel centres lie at whole numbers
    photo_from_crop = (
        half @ camera.intrinsics @ turn @ np.linalg.inv(virtual.intrinsics) @ np.linalg.inv(half)
    )
    shrink = max(1.0, 2 * REACH * spread / side)  # area-average before a point-sampled warp
    size = (max(8, round(rgb.shape[1] / shrink)), max(8, round(rgb.shape[0] / shrink)))
    scale = np.diag([size[0] / rgb.shape[1], size[1] / rgb.shape[0], 1.0])
    scale[:2, 2] = 0.5 * (np.diag(scale)[:2] - 1)
    small = [
        cv2.resize(np.asarray(a, np.float32), size, interpolation=cv2.INTER_AREA)
        for a in (rgb, mask)
    ]
    weight = np.ones(mask.shape, np.float32) if weight is None else np.asarray(weight, np.float32)
    seen = cv2.resize(weight, size, interpolation=cv2.INTER_AREA)

    def warp(a):
        return cv2.warpPerspective(
            a, scale @ photo_from_crop, (side, side), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        )

    return Crop(virtual, warp(small[0]), warp(small[1]), warp(seen))


# ---------------------------------------------------------------- renderings


def volume_render(model: VolumeModel, step: float = 0.9) -> Render:
    """Renders a volume model's colours on black, its opacity as alpha."""

    def render(cameras: list[Camera]) -> tuple[np.ndarray, np.ndarray]:
        side, rgb, alpha = cameras[0].width, [], []
        inv_s, dt = dr.opaque(mi.Float, model.inv_s), dr.opaque(mi.Float, step * model.grid.h)
        each = max(1, CHUNK // side**2)
        for first in range(0, len(cameras), each):
            some = cameras[first : first + each]
            index = dr.arange(mi.UInt32, len(some) * side * side)
            pixel = index % (side * side)
            x, y = mi.Float(pixel % side) + 0.5, mi.Float(pixel // side) + 0.5
            rows = mi.Float(camera_rows(some))
            o, d = rays_through(rows, index // (side * side), x, y)
            t0, t1 = sphere_interval(o, d)
            dr.eval(o, d, t0, t1)
            m = march(model.grid, o, d, t0, t1, inv_s, dt)
            colour, _ = model.shade(
                m, RayBatch(o, d, None, None, index // (side * side), pixel), rows
            )
            inside = t1 > t0
            colour, opacity = dr.select(inside, colour, 0), dr.select(inside, m.opacity, 0)
            dr.eval(colour, opacity)
            rgb.append(np.array(colour).T.reshape(-1, side, side, 3))
            alpha.append(np.array(opacity).reshape(-1, side, side))
        return np.concatenate(rgb), np.concatenate(alpha)

    return render


def directions_around(count: int, seed: int = 0) -> np.ndarray:
    """(count, 3) unit vectors, evenly spread (Fibonacci spiral, turned by the seed)."""
    rng = np.random.default_rng(seed)
    i = (np.arange(count) + 0.5 + rng.uniform(-0.3, 0.3)) / count
    z, a = (
        1 - 2 * np.clip(i, 0, 1),
        np.arange(count) * np.pi * (3 - np.sqrt(5)) + rng.uniform(0, 2 * np.pi),
    )
    r = np.sqrt(np.maximum(1 - z * z, 0))
    return np.stack([r * np.cos(a), z, r * np.sin(a)], 1)


def views_from(directions: np.ndarray, distance: float = 3.0, side: int = SIDE) -> list[Camera]:
    """Cameras that look at the origin from `directions` (V, 3), the unit sphere just in frame, +y
    up in the picture."""
    focal = 0.5 * side * np.sqrt(distance**2 - 1)
    return [
        Camera(side, side, focal, focal, side / 2, side / 2, pose)
        for pose in look_at(directions * distance)
    ]


def make_gallery(render: Render, cameras: list[Camera], parts=PARTS) -> Gallery:
    """Render the views. Views that see next to nothing never match."""
    return make_galleries(render, cameras, (parts,))[0]


def make_galleries(render: Render, cameras: list[Camera], several) -> list[Gallery]:
    """The same views, rendered once, as each of several weights (see PARTS) describes them."""
    rgb, alpha = render(cameras)
    return [Gallery(cameras, rings_of(rgb, alpha, parts=parts)) for parts in several]


# ---------------------------------------------------------------- what is compared


def rings_of(
    rgb: np.ndarray,
    mask: np.ndarray,
    weight: np.ndarray | None = None,
    centre=None,
    spread=None,
    parts=PARTS,
) -> Rings:
    """Descriptors of pictures: rgb (N, S, S, 3) linear (premultiplied or not), mask (N, S, S),
    weight (N, S, S) or None. centre (N, 2), spread (N,): pixels, by default those of mask * weight.
    parts: weights as PARTS."""
    if len(mask) > AT_ONCE:
        given = (rgb, mask, weight, centre, spread)
        some = [
            [None if a is None else a[k : k + AT_ONCE] for a in given]
            for k in range(0, len(mask), AT_ONCE)
        ]
        with ThreadPoolExecutor(
            os.cpu_count()
        ) as pool:  # OpenCV and NumPy let go of the interpreter
            rings = list(pool.map(lambda each: rings_of(*each, parts=parts), some))
        return Rings(*(np.concatenate([getattr(r, f.name) for r in rings]) for f in fields(Rings)))
    mask = np.asarray(mask, np.float32)
    known = mask if weight is None else mask * weight
    if centre is None:
        centre, spread = moments(known)
    radius = (np.arange(RINGS) + 0.5) / RINGS * RING_REACH
    turn = np.arange(TURNS) * (2 * np.pi / TURNS)
    x = centre[:, 0, None, None] + spread[:, None, None] * radius[:, None] * np.cos(turn)
    y = centre[:, 1, None, None] + spread[:, None, None] * radius[:, None] * np.sin(turn)
    at = np.stack([x, y], -1).astype(np.float32) - 0.5  # cv2's pixel centres lie at whole numbers

    def look(pictures):
        return np.stack(
            [
                cv2.remap(p, m, None, cv2.INTER_LINEAR)
                for p, m in zip(np.ascontiguousarray(pictures, np.float32), at, strict=True)
            ]
        )

    seen = look(
        np.concatenate([mask[..., None], np.asarray(rgb, np.float32) * mask[..., None]], -1)
    )
    a, colour = seen[..., 0], seen[..., 1:]
    w = np.ones_like(a) if weight is None else look(weight)
    area = w * radius[:, None].astype(np.float32)
    inside = (a > 0.5) * area
    total = np.maximum(inside.sum((1, 2)), 1e-6)
    solid = colour / np.maximum(a, 0.05)[..., None]
    tint = (solid * inside[..., None]).sum((1, 2)) / total[:, None]
    solid = (
        solid / np.maximum(tint, 1e-4)[:, None, None]
    )  # each photo has its own exposure and white
    chroma = (solid / (solid.sum(-1, keepdims=True) + 0.15) - 1 / 3) * a[..., None]
    bright = np.log(solid.mean(-1) + 0.06)
    mean = (bright * inside).sum((1, 2)) / total
    bright = (bright - mean[:, None, None]) * (a > 0.5)
    deviation = np.sqrt((bright**2 * inside).sum((1, 2)) / total)
    bright = np.clip(bright / (deviation[:, None, None] + 0.02), -2.5, 2.5)
    channels = [parts[0] * a[..., None], parts[1] * chroma, parts[2] * bright[..., None]]
    if len(parts) > 3:
        channels.append(parts[3] * (look(detail(rgb, mask)) * (a > 0.5))[..., None])
    f = np.concatenate(channels, -1)  # (N, RINGS, TURNS, channels)
    weighted = f * area[..., None]

    def spectrum(g):
        return (
            np.moveaxis(rfft(g, axis=2), 2, 1)
            .reshape(len(g), TURNS // 2 + 1, -1)
            .astype(np.complex64)
        )

    squares = (f * f).sum(-1)
    norm = np.sqrt((squares * area).sum((1, 2)))
    return Rings(
        spectrum(weighted), spectrum(f), spectrum(squares), spectrum(area), norm, centre, spread
    )


def detail(rgb: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """(N, S, S) log luminance against its surroundings on the object, in standard deviations:
    decoration without most of the shading."""
    inside = (mask > 0.5).astype(np.float32)
    count = np.maximum(inside.sum((1, 2)), 1)
    level = rgb.mean(-1) / np.maximum(mask, 0.05) * inside
    usual = np.maximum(level.sum((1, 2)) / count, 1e-4)
    bright = np.log(level / usual[:, None, None] + 0.1) * inside
    around = smooth_pictures(bright) / np.maximum(smooth_pictures(inside), 1e-3)
    fine = (bright - around) * inside
    deviation = np.sqrt((fine**2).sum((1, 2)) / count)
    return np.clip(fine / (deviation[:, None, None] + 0.03), -2.5, 2.5).astype(np.float32)


def smooth_pictures(pictures: np.ndarray) -> np.ndarray:
    """(N, S, S) smoothed by FINE pixels."""
    size = 2 * round(4 * FINE) + 1
    return np.stack(
        [cv2.GaussianBlur(p, (size, size), FINE, borderType=cv2.BORDER_REFLECT) for p in pictures]
    )


def moments(known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centre (N, 2) and spread (N,) in pixels of (N, H, W) weights; the picture's middle and a
    quarter of its side where there are none."""
    h, w = known.shape[1:]
    total = known.sum((1, 2)).astype(np.float64)
    ok, t = total > 1.0, np.maximum(total, 1e-6)
    xs, ys = np.arange(w) + 0.5, np.arange(h) + 0.5
    columns, rows = known.sum(1), known.sum(2)
    x, y = columns @ xs / t, rows @ ys / t
    second = (columns * (xs - x[:, None]) ** 2).sum(1) + (rows * (ys - y[:, None]) ** 2).sum(1)
    centre = np.where(ok[:, None], np.stack([x, y], 1), [w / 2, h / 2])
    return centre, np.where(ok, np.sqrt(second / t), w / 4)


def all_scores(photos: Rings, views: Rings) -> np.ndarray:
    """(P, V, TURNS): normalised correlation, over the photo's known pixels, of each photo with each
    view turned by each angle."""
    top = _correlate(photos.spectrum, views.plain)
    below = _correlate(photos.weights, views.squares)
    return top / (photos.norm[:, None, None] * np.sqrt(np.maximum(below, 1e-6)) + 1e-9)


def _correlate(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """(P, V, TURNS) from spectra (P, F, J), (V, F, J): entry s sums p(θ + s) q(θ)."""
    product = np.matmul(p.transpose(1, 0, 2), q.conj().transpose(1, 2, 0))  # (F, P, V)
    return irfft(product, TURNS, axis=0).transpose(1, 2, 0).astype(np.float32)


def pair_scores(photos: Rings, views: Rings, photo: np.ndarray) -> np.ndarray:
    """(V, TURNS): view i against photo[i] only."""
    top = irfft((photos.spectrum[photo] * views.plain.conj()).sum(-1), TURNS, axis=1)
    below = irfft((photos.weights[photo] * views.squares.conj()).sum(-1), TURNS, axis=1)
    return (top / (photos.norm[photo, None] * np.sqrt(np.maximum(below, 1e-6)) + 1e-9)).astype(
        np.float32
    )


def turn_angles(shift: np.ndarray) -> np.ndarray:
    """Radians in (-pi, pi] of shifts along the rings."""
    a = np.asarray(shift) * (2 * np.pi / TURNS)
    return (a + np.pi) % (2 * np.pi) - np.pi


def _peak(scores: np.ndarray, shift: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Shift (fractional) and height of a parabola through a peak (N,) and its neighbours; scores:
    (N, TURNS)."""
    i = np.arange(len(scores))
    l, c, r = scores[i, (shift - 1) % TURNS], scores[i, shift], scores[i, (shift + 1) % TURNS]
    bend = np.minimum(l - 2 * c + r, -1e-9)
    offset = np.clip(0.5 * (l - r) / bend, -0.5, 0.5)
    return shift + offset, c - 0.25 * (l - r) * offset


# ---------------------------------------------------------------- from a match to a pose


def pose_from_match(
    crop: Camera, view: Camera, centre, spread, crop_centre, crop_spread, angle: float
) -> np.ndarray:
    """model_from_photo_camera (4, 4). The view's silhouette (centre, spread: pixels), turned by
    `angle`, lies on that of the crop."""
    k = crop_spread / spread
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s], [s, c]])
    eye = view.centre
    model_from_view = np.asarray(view.world_from_camera)[:3, :3]
    axis = model_from_view.T @ -eye  # where the origin lies, in the view's axes
    distance = float(np.linalg.norm(axis))
    origin = np.array(
        [view.fx * axis[0] / axis[2] + view.cx, view.fy * axis[1] / axis[2] + view.cy]
    )
    at = np.asarray(crop_centre) + k * turn @ (origin - np.asarray(centre))
    ray = np.array([(at[0] - crop.cx) / crop.fx, (at[1] - crop.cy) / crop.fy, 1.0])
    roll = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    crop_from_view = rotation_from(AHEAD, ray) @ roll @ rotation_from(AHEAD, axis).T
    photo_from_view = np.asarray(crop.world_from_camera)[:3, :3] @ crop_from_view
    model_from_photo = model_from_view @ photo_from_view.T
    ahead = np.asarray(crop.world_from_camera)[:3, :3] @ (ray / np.linalg.norm(ray))
    away = distance * crop.fx / (k * view.fx)
    return similarity(model_from_photo, -away * (model_from_photo @ ahead))


def crop_views(crops: list[Crop], poses: np.ndarray) -> list[Camera]:
    """The crops' cameras in the model's frame, for model_from_photo_camera poses (P, 4, 4)."""
    return [
        c.camera.with_pose(pose @ c.camera.world_from_camera)
        for c, pose in zip(crops, poses, strict=True)
    ]


# ---------------------------------------------------------------- search and refinement


def crop_rings(crops: list[Crop], parts=PARTS) -> Rings:
    """What is compared of the crops; compute once, they do not change."""
    return rings_of(
        *(np.stack([getattr(c, name) for c in crops]) for name in ("rgb", "mask", "weight")),
        parts=parts,
    )


def chosen_rings(rings: Rings, chosen: list[int]) -> Rings:
    """The rings of some of the pictures."""
    return Rings(*(getattr(rings, f.name)[chosen] for f in fields(Rings)))


def search(
    crops: list[Crop],
    gallery: Gallery,
    keep: int = 4,
    *,
    rings: Rings | None = None,
    allowed: np.ndarray | None = None,
    prior: np.ndarray | None = None,
    max_roll: float | None = None,
    apart: float = 20.0,
) -> Hypotheses:
    """The `keep` best poses of each crop, at least `apart` degrees from each other.

    rings: of the crops, where they are at hand. allowed: (P, V) bool, viewpoints that may be taken
    (see `near`). prior: (P, V) or (P, V, TURNS), added to the scores that decide (not to those that
    are returned). max_roll: radians of turn against a picture in which +y of the model is up, or
    None for all.
    """
    rings = crop_rings(crops) if rings is None else rings
    scores = all_scores(rings, gallery.rings)
    upright = (
        np.ones(TURNS, bool)
        if max_roll is None
        else np.abs(turn_angles(np.arange(TURNS))) <= max_roll
    )
    p = len(crops)
    poses, best, view = (
        np.tile(np.eye(4), (p, keep, 1, 1)),
        np.full((p, keep), -1.0),
        np.zeros((p, keep), int),
    )
    for i, crop in enumerate(crops):
        judged = (
            scores[i]
            if prior is None
            else scores[i] + (prior[i] if prior.ndim == 3 else prior[i][:, None])
        )
        shift = np.where(upright, judged, -1).argmax(1)
        height = judged[np.arange(len(shift)), shift]
        if allowed is not None:
            height[~allowed[i]] = -np.inf
        kept = 0
        for v in np.argsort(-height):
            if kept == keep or height[v] == -np.inf:
                break
            at, top = _peak(scores[i, v : v + 1], shift[v : v + 1])
            g = gallery.rings
            pose = pose_from_match(
                crop.camera,
                gallery.cameras[v],
                g.centre[v],
                g.spread[v],
                rings.centre[i],
                rings.spread[i],
                float(turn_angles(at)[0]),
            )
            if (
                kept
                and min(rotation_angle(pose[:3, :3].T @ q[:3, :3]) for q in poses[i, :kept]) < apart
            ):
                continue
            poses[i, kept], best[i, kept], view[i, kept] = pose, top[0], v
            kept += 1
    return Hypotheses(poses, best, view)


def near(gallery: Gallery, directions: np.ndarray, degrees: float) -> np.ndarray:
    """(P, V) bool: views within `degrees` of each of `directions` (P, 3), unit, from the origin to
    the camera."""
    seen = np.array([c.centre / np.linalg.norm(c.centre) for c in gallery.cameras])
    return np.asarray(directions) @ seen.T >= np.cos(np.radians(degrees))


def hint_prior(gallery: Gallery, directions: np.ndarray, degrees: float, roll: float) -> np.ndarray:
    """(P, V, TURNS): -(angle / degrees)^2 - (turn / roll)^2 for the angle between each view and
    each of `directions` (P, 3), unit, and the turn against upright; all in degrees."""
    seen = np.array([c.centre / np.linalg.norm(c.centre) for c in gallery.cameras])
    angle = np.degrees(np.arccos(np.clip(np.asarray(directions) @ seen.T, -1, 1)))
    turn = np.degrees(turn_angles(np.arange(TURNS)))
    return -((angle / degrees)[..., None] ** 2) - (turn / roll) ** 2


def refine(
    crops: list[Crop],
    poses: np.ndarray,
    render: Render,
    *,
    rings: Rings | None = None,
    steps=REFINE,
    turn=12.0,
    parts=PARTS,
):
    """Better poses (P, 4, 4) and their scores (P,): in each round the model is rendered, through
    each crop's own camera, from the present viewpoint and six around it at steps[i] degrees; the
    best takes its place, with turn, shift and distance from the match.

    turn: degrees of in-plane turn that one round may make. Unknown pixels are left out of the
    silhouettes of both; rounds of step 0, which only put turn, shift and distance right, let the
    part that is seen settle first.
    """
    rings = crop_rings(crops, parts) if rings is None else rings
    poses, best = np.array(poses, np.float64), np.full(len(crops), -1.0)
    weight = np.stack([c.weight for c in crops])
    reach = np.abs(turn_angles(np.arange(TURNS))) <= np.radians(turn) + 1e-6
    for step in (0.0, *steps):
        tilts = [np.zeros(2)]
        if step > 0:
            tilts += [
                np.radians(step) * np.array([np.cos(a), np.sin(a)])
                for a in np.arange(6) * np.pi / 3
            ]
        photo = np.repeat(np.arange(len(crops)), len(tilts))
        tilted = np.array([_tilted(poses[i], t) for i in range(len(crops)) for t in tilts])
        cameras = crop_views([crops[i] for i in photo], tilted)
        rgb, alpha = render(cameras)
        centre, spread = moments(alpha * weight[photo])
        views = rings_of(rgb, alpha, weight[photo], centre, spread, parts)
        scores = pair_scores(rings, views, photo)
        shift = np.where(reach, scores, -1).argmax(1)
        at, top = _peak(scores, shift)
        top = np.where(spread > 1e-3, top, -1).reshape(len(crops), len(tilts))
        for i in range(len(crops)):
            j = int(top[i].argmax())
            if top[i, j] <= best[i] and step > 0:
                continue
            v = i * len(tilts) + j
            angle = float(turn_angles(at[v]))
            poses[i] = pose_from_match(
                crops[i].camera,
                cameras[v],
                centre[v],
                spread[v],
                rings.centre[i],
                rings.spread[i],
                angle,
            )
            best[i] = top[i, j]
    return poses, best


def _tilted(pose: np.ndarray, tilt: np.ndarray) -> np.ndarray:
    """The pose seen from another viewpoint: turned about the origin by `tilt` radians about the
    camera's x and y axes."""
    axes = pose[:3, :3]
    turn = exp_so3(axes[:, 0] * tilt[0] + axes[:, 1] * tilt[1])
    return similarity(turn @ axes, turn @ pose[:3, 3])

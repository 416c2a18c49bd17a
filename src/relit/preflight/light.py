"""Classification of the light regime from the photos, before any fit.

Four regimes: 'fixed' (object and lamps fixed, camera moves), 'flash' (a lamp at the camera in a
dark room), 'varied' (each photo under its own light), 'moving light' (fixed camera, moving lamp).
The evidence is returned with the result.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import cv2
import numpy as np

from relit.errors import UserError
from relit.preflight.look import Look, look_at_photos
from relit.scene import Capture, Sphere

# correlation of edges; .46 for six photos from one tripod under a moving lamp, below .28 where the
# camera moved
SAME_VIEW = 0.38
# overlap of the background's chromaticity histograms; .54 and .70 in one room, .19 to .47 for one
# object in several places
SAME_PLACE = 0.45
DARK = 0.02  # linear radiance: background of a flash photo
CELLS = (24, 48)  # rows, columns of directions on the object sphere
SAMPLES = 1500  # pixels per photo
FOLLOWS = "surfaces that face the camera are brightest: the light moves with the camera"
NO_LIMB = 0.6  # slope below which there is no lamp at the camera; unit as LIMB
NO_FRONT = 0.6  # share of frontally lit photos below which there is no lamp at the camera
ENOUGH = 12  # photos; with fewer, texture can be mistaken for directional shading
BLACK, BURNT = 0.004, 0.98  # linear radiance; beyond these no shading is visible
# log brightness per unit of an inflated mask's normal, towards the camera; 1.5 to 3 under a flash,
# below .6 elsewhere
LIMB = 1.2


def light_regime(capture: Capture, looks: list[Look] | None = None) -> dict:
    """{'guess': 'fixed' | 'flash' | 'varied' | 'moving light', 'confidence': 0 to 1, 'evidence':
    [sentences]}.

    looks: decoded copies, if available. Photos with an alpha channel but without EXIF and cameras
    give little evidence; the result is then 'fixed' with low confidence.
    """
    looks = look_at_photos(capture) if looks is None else looks
    evidence: list[str] = []
    votes = {"fixed": 0.4, "flash": 0.0, "varied": 0.0, "moving light": 0.0}
    if len(looks) > 1 and _same_view(looks, evidence):
        changes = shading_change(looks)
        evidence.append(f"shading at fixed pixels changes by {100 * changes:.0f} % between photos")
        if changes > 0.08:
            votes["moving light"] += 1.5
    fired = [x.exif.flash for x in looks if x.exif.flash is not None]
    if fired:
        share = float(np.mean(fired))
        evidence.append(f"EXIF: the flash fired in {100 * share:.0f} % of the photos with this tag")
        votes["flash"] += 1.0 if share > 0.8 else 0.0
        votes["fixed"] += 0.3 if share < 0.2 else 0.0
    _surroundings(looks, votes, evidence)
    _limb(looks, votes, evidence)
    if capture.sphere is not None and len([x for x in looks if x.camera is not None]) >= 4:
        _shading(looks, capture.sphere, votes, evidence)
    guess = max(votes, key=votes.__getitem__)
    others = max(v for k, v in votes.items() if k != guess)
    return {
        "guess": guess,
        "confidence": round(
            float(np.clip((votes[guess] - others) / max(votes[guess], 0.5), 0.05, 0.95)), 2
        ),
        "evidence": evidence,
    }


def check_flash_light(
    capture: Capture, say: Callable[[str], None], looks: list[Look] | None = None
) -> None:
    """Raises UserError where the photos were clearly not lit by a flash at the camera; prints a
    note where that is uncertain.

    Clear cases: one viewpoint under a moving lamp, or, in ENOUGH photos, no darkening of the object
    towards its outline, which a lamp at the camera causes for any material. looks: as for
    `light_regime`.
    """
    looks = look_at_photos(capture) if looks is None else looks
    regime, slopes = light_regime(capture, looks), limb_slopes(looks)
    fired = [x.exif.flash for x in looks if x.exif.flash is not None]
    follows = (bool(fired) and float(np.mean(fired)) > 0.5) or any(
        FOLLOWS in e for e in regime["evidence"]
    )
    elsewhere = (
        len(slopes) >= ENOUGH
        and not follows
        and np.median(slopes[:, 2]) < NO_LIMB
        and _frontal(slopes) < NO_FRONT
    )
    # a dark background alone is not enough: renderings on black have one too
    if regime["guess"] == "flash" and not elsewhere:
        return
    onward = "to skip this check: --set check_light=false"
    if regime["guess"] == "moving light":
        raise UserError(
            "all photos are taken from one viewpoint, under a light that moves between photos",
            "a flash capture needs viewpoints all around the object, with the light at the camera",
            f"photograph from all around the object with the flash at the camera; {onward}",
        )
    seen = "; ".join(regime["evidence"])
    if elsewhere:
        raise UserError(
            f"the light does not move with the camera: it appears to be {'varied' if regime['guess'] == 'varied' else 'fixed'}",
            "under a flash at the camera an object darkens evenly towards its outline; "
            f"this holds in {100 * _frontal(slopes):.0f} % of the photos. {seen}",
            f"use --capture {'collection' if regime['guess'] == 'varied' else 'multiview'}; {onward}",
        )
    say(
        f"note: the light may not be a flash at the camera ({seen}); if it is not, the material will be wrong"
    )


# ---------------------------------------------------------------- one camera


def _same_view(looks: list[Look], evidence: list[str]) -> bool:
    """Whether all photos show the same view: from the poses where known, otherwise from edges."""
    if all(x.camera is not None for x in looks):
        centres = np.stack([x.camera.centre for x in looks])
        turns = [
            np.trace(
                looks[0].camera.world_from_camera[:3, :3].T @ x.camera.world_from_camera[:3, :3]
            )
            for x in looks
        ]
        reach = np.abs(centres).max() + 1e-9
        same = np.ptp(centres, axis=0).max() < 1e-3 * reach and min(turns) > 3 - 1e-4
    else:
        agreement = edge_agreement(looks)
        same = agreement > SAME_VIEW
        if same:
            evidence.append(f"the edges of the photos coincide (correlation {agreement:.2f})")
    if same:
        evidence.append("all photos are taken from one viewpoint")
    return bool(same)


def edge_agreement(looks: list[Look]) -> float:
    """Median pixelwise correlation of the edge maps of consecutive photos; high when the camera did
    not move."""
    maps = []
    for x in looks:
        gray = cv2.resize(np.log(x.gray + 0.01), (128, 128), interpolation=cv2.INTER_AREA)
        gray = cv2.GaussianBlur(gray, (0, 0), 1)
        edges = np.hypot(cv2.Sobel(gray, cv2.CV_32F, 1, 0), cv2.Sobel(gray, cv2.CV_32F, 0, 1))
        edges = np.minimum(edges, np.percentile(edges, 98))
        maps.append((edges - edges.mean()) / max(edges.std(), 1e-6))
    pairs = [float((a * b).mean()) for a, b in itertools.pairwise(maps)]
    return float(np.median(pairs))


def shading_change(looks: list[Look]) -> float:
    """Relative variation of normalised pixel brightness over photos from one viewpoint: 90th
    percentile over bright pixels (inside the masks where there are some)."""
    stack = np.stack([cv2.resize(x.gray, (96, 96), interpolation=cv2.INTER_AREA) for x in looks])
    bright = stack.mean(0) > 0.25 * np.percentile(stack.mean(0), 95)
    masks = [x.mask for x in looks if x.mask is not None]
    if len(masks) == len(looks):
        small = [cv2.resize(m, (96, 96), interpolation=cv2.INTER_AREA) for m in masks]
        inside = np.mean(small, axis=0) > 0.9
        bright = bright & inside if (bright & inside).sum() > 20 else bright
    stack = stack / np.maximum(np.median(stack[:, bright], axis=1), 1e-6)[:, None, None]
    return float(np.percentile((stack.std(0) / np.maximum(stack.mean(0), 1e-6))[bright], 90))


# ---------------------------------------------------------------- what surrounds the object


def _surroundings(looks: list[Look], votes: dict, evidence: list[str]) -> None:
    seen = [x for x in looks if x.opaque]
    if not seen:
        evidence.append("the background is transparent (alpha channel) and gives no evidence")
        return
    around = np.array([_around(x) for x in seen])  # (N, 3) median colour
    level = np.log2(np.maximum(around.mean(1), 1e-4))
    dark = float((around.mean(1) < DARK).mean())
    if dark > 0.8:
        evidence.append(
            f"the background is dark in {100 * dark:.0f} % of the photos (below {DARK} of white)"
        )
        votes["flash"] += 0.6
        return
    chroma = around / np.maximum(around.sum(1, keepdims=True), 1e-6)
    spread, tint = float(level.std()), float(chroma.std(0).max())
    evidence.append(
        f"the background varies by {spread:.1f} EV and {tint:.2f} in chromaticity between photos"
    )
    cameras = {x.exif.camera for x in seen if x.exif.camera}
    sizes = {tuple(sorted(x.rgb.shape[:2])) for x in seen}
    if len(cameras) > 2:
        evidence.append(f"the photos come from {len(cameras)} different cameras")
        votes["varied"] += 0.7
    if len(sizes) > max(2, len(seen) // 3):
        evidence.append(f"the photos have {len(sizes)} different sizes")
        votes["varied"] += 0.4
    if spread > 1.0:
        votes["varied"] += 0.35
    if tint > 0.06:
        votes["varied"] += 0.35
    if len(seen) > 2:
        overlap = colour_overlap(seen)
        evidence.append(f"the background colours overlap by {100 * overlap:.0f} % between photos")
        votes["varied"] += 0.5 if overlap < SAME_PLACE else 0.0
    if spread < 0.6 and tint < 0.04:
        votes["fixed"] += 0.3


def colour_overlap(looks: list[Look]) -> float:
    """Histogram intersection of the chromaticity of the image margins, median over pairs of photos;
    1 for equal histograms."""
    found = []
    for x in looks:
        h, w = x.rgb.shape[:2]
        k = max(2, min(h, w) // 6)
        margin = np.ones((h, w), bool)
        margin[k:-k, k:-k] = False
        rgb = x.rgb[margin]
        chroma = rgb[:, :2] / (rgb.sum(1, keepdims=True) + 1e-3)
        histogram, *_ = np.histogram2d(*chroma.T, bins=24, range=[[0.1, 0.6], [0.1, 0.6]])
        found.append(cv2.GaussianBlur(histogram / max(histogram.sum(), 1), (0, 0), 0.7))
    return float(
        np.median([np.minimum(a, b).sum() for i, a in enumerate(found) for b in found[:i]])
    )


def _around(x: Look) -> np.ndarray:
    h, w = x.rgb.shape[:2]
    k = max(2, min(h, w) // 12)
    border = np.ones((h, w), bool)
    border[k:-k, k:-k] = False
    if x.mask is not None:
        border = x.mask < 0.05 if (x.mask < 0.05).mean() > 0.1 else border & (x.mask < 0.5)
    return np.median(x.rgb[border], axis=0) if border.any() else np.zeros(3)


# ---------------------------------------------------------------- shading inside the masks


def _limb(looks: list[Look], votes: dict, evidence: list[str]) -> None:
    slopes = limb_slopes(looks)
    if len(slopes) < 3:
        return
    frontal = _frontal(slopes)
    if np.median(slopes[:, 2]) > LIMB and frontal > 0.8:
        evidence.append(
            f"in {100 * frontal:.0f} % of the photos the object darkens evenly towards its outline: light at the camera"
        )
        votes["flash"] += 1.2


def _frontal(slopes: np.ndarray) -> float:
    """Share of the photos in which brightness depends more on the normal's component towards the
    camera than on the others."""
    return float((slopes[:, 2] > np.hypot(slopes[:, 0], slopes[:, 1])).mean())


def limb_slopes(looks: list[Look]) -> np.ndarray:
    """(N, 3): slope of log brightness over the normal of the inflated mask (x right, y down, z
    towards the camera), one row per photo with a mask. A lamp at the camera gives a z component
    only."""
    found = []
    for x in looks:
        inside = None if x.mask is None else x.mask > 0.9
        if inside is None or not 200 <= inside.sum() < 0.9 * inside.size:
            continue
        if not BLACK < np.median(x.gray[inside]) < BURNT:
            continue
        far = cv2.distanceTransform(np.pad(inside, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
        height = cv2.GaussianBlur(
            np.sqrt(far * far.max()), (0, 0), max(1.5, 0.03 * float(np.sqrt(inside.sum())))
        )
        down, right = np.gradient(height)
        normal = np.stack([-right, -down, np.ones_like(height)], -1)[inside]
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        basis = np.concatenate([normal, np.ones((len(normal), 1))], 1)
        slope, *_ = np.linalg.lstsq(basis, np.log(x.gray[inside] + 0.004), rcond=None)
        found.append(slope[:3])
    return np.array(found).reshape(-1, 3)


# ---------------------------------------------------------------- shading of the object sphere


def _shading(looks: list[Look], sphere: Sphere, votes: dict, evidence: list[str]) -> None:
    found = shading_fits(looks, sphere)
    if found is None:
        return
    spread, camera, photo, facing = found
    evidence.append(
        f"surface points vary by {spread:.2f} (log) between photos; the direction to the camera "
        f"explains {100 * camera:.0f} % of it, the photo {100 * photo:.0f} %"
    )
    if spread > 0.2 and camera > 0.3 and facing > 0.3:
        evidence.append(FOLLOWS)
        votes["flash"] += 0.9
    elif spread > 0.3 and photo > 0.5:
        votes["varied"] += 0.8
    elif spread < 0.3 or photo < 0.4:
        votes["fixed"] += 0.4


def shading_fits(looks: list[Look], sphere: Sphere) -> tuple[float, float, float, float] | None:
    """Variation of the brightness of surface points between photos; the object sphere stands in for
    the surface.

    Subtracting the mean of each cell of directions removes texture. Returns (standard deviation of
    log brightness about the cell means; share of its variance explained by a linear function of the
    normal in CAMERA axes; share explained by a linear function of the normal in WORLD axes, one per
    photo; slope of the first function towards the camera, per unit of the normal's component), or
    None when too few cells are visible in enough photos.
    """
    places, values, camera_normals, world_normals, photos = [], [], [], [], []
    for i, x in enumerate(looks):
        if x.camera is None:
            continue
        n, rgb = _on_sphere(x, sphere, i)
        cell = _cell(n)
        places.append(cell)
        values.append(np.log(rgb + 0.004))
        camera_normals.append(n @ x.camera.world_from_camera[:3, :3])
        world_normals.append(n)
        photos.append(np.full(len(n), i))
    place, y, nc, nw, photo = (
        np.concatenate(a) for a in (places, values, camera_normals, world_normals, photos)
    )
    # mean over the pixels of a cell in a photo, then over photos
    key = place * len(looks) + photo
    keys, inverse, count = np.unique(key, return_inverse=True, return_counts=True)
    mean = lambda a: np.bincount(inverse, a) / count  # noqa: E731
    y, nc, nw = mean(y), np.stack([mean(c) for c in nc.T], 1), np.stack([mean(c) for c in nw.T], 1)
    place, photo = keys // len(looks), keys % len(looks)
    places, inverse, count = np.unique(place, return_inverse=True, return_counts=True)
    often = count[inverse] >= 4
    if often.sum() < 60:
        return None
    about = lambda a: (a - (np.bincount(inverse, a) / count)[inverse])[often]  # noqa: E731
    r = about(y)
    total = float((r**2).mean())
    if total < 1e-8:
        return 0.0, 0.0, 0.0, 0.0
    camera = np.stack([about(c) for c in nc.T], 1)
    slope, *_ = np.linalg.lstsq(camera, r, rcond=None)
    explained = 1 - float(((r - camera @ slope) ** 2).mean()) / total
    left, photo, nw = r.copy(), photo[often], nw[often]
    for i in np.unique(photo):
        mine = photo == i
        basis = np.concatenate([np.ones((mine.sum(), 1)), nw[mine]], 1)
        if mine.sum() > 8:
            left[mine] = r[mine] - basis @ np.linalg.lstsq(basis, r[mine], rcond=None)[0]
    return float(np.sqrt(total)), explained, 1 - float((left**2).mean()) / total, float(-slope[2])


def _on_sphere(x: Look, sphere: Sphere, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """World normals (N, 3) and luminance (N,) of at most SAMPLES pixels whose rays hit the object
    sphere."""
    c = x.camera
    rows, columns = (
        np.nonzero(x.mask > 0.9) if x.mask is not None else np.nonzero(np.ones(x.gray.shape, bool))
    )
    if len(rows) == 0:
        return np.zeros((0, 3)), np.zeros(0)
    few = np.random.default_rng(seed).permutation(len(rows))[: 4 * SAMPLES]
    rows, columns = rows[few], columns[few]
    d = (
        np.stack([(columns + 0.5 - c.cx) / c.fx, (rows + 0.5 - c.cy) / c.fy, np.ones(len(rows))], 1)
        @ c.world_from_camera[:3, :3].T
    )
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    to = c.centre - sphere.centre
    b, q = d @ to, to @ to - (0.85 * sphere.radius) ** 2
    root = b * b - q
    hit = root > 0
    n = (to + (-b - np.sqrt(np.maximum(root, 0)))[:, None] * d) / (0.85 * sphere.radius)
    keep = np.nonzero(hit)[0][:SAMPLES]
    return n[keep], x.gray[rows[keep], columns[keep]]


def _cell(n: np.ndarray) -> np.ndarray:
    rows = np.minimum(
        (np.arccos(np.clip(n[:, 1], -1, 1)) / np.pi * CELLS[0]).astype(int), CELLS[0] - 1
    )
    columns = np.minimum(
        ((np.arctan2(n[:, 0], n[:, 2]) / (2 * np.pi) + 0.5) * CELLS[1]).astype(int), CELLS[1] - 1
    )
    return rows * CELLS[1] + columns

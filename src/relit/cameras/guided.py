"""Matches between identical objects sought again once their poses are known, and poses adjusted
over them.

SfD (Sec. 3.1) matches once, and what is not linked then is lost. Where a search has placed all
instances, in one frame, matching can be
much less strict: the turn of one picture against the other is known, a match must lie near an
epipolar line, and the point it tells must lie inside the object. Bundle adjustment over what is
found moves the poses; each keeps a belief in where the search has put it, so that instances with
few matches, or none, stay.
"""

from __future__ import annotations

from collections import defaultdict
from itertools import combinations

import numpy as np
from scipy.optimize import least_squares
from scipy.sparse import lil_matrix

from relit.cameras.rotation_sweep import CHANCE, LEAST, STEP, Features, Link, verified
from relit.conventions import similarity
from relit.geometry.se3 import exp_so3, rotation_angle
from relit.scene import Camera

NEAR = 60.0  # degrees between two lines of sight up to which features look alike
BAND = 0.1  # radii of the object, the distance from the epipolar line within which a match may lie
RATIO = 0.8  # Lowe's, among the candidates
PIXEL = 0.03  # radii, standard deviation of a keypoint with all that is wrong about a match
FARTHEST = 8.0  # degrees that an instance is turned at most
TURN, ASIDE, ALONG = (
    np.radians(2.0),
    0.02,
    0.02,
)  # belief in the search: radians, unit lengths across, share of the distance


def guided_links(
    features: list[Features],
    poses: np.ndarray,
    cameras: list[Camera],
    error: float,
    radius: float = 0.85,
) -> dict[tuple[int, int], Link]:
    """Matches of the pairs (i < j) that the poses (N, 4, 4) object_from_camera allow, where more of
    them than at wrong turns are explained by one essential matrix. cameras: the photo's, one for
    each instance. error: pixels. radius: of the object, unit lengths."""
    towards = poses[:, :3, 3] / np.linalg.norm(poses[:, :3, 3], axis=1, keepdims=True)
    links = {}
    for i, j in combinations(range(len(features)), 2):
        if towards[i] @ towards[j] < np.cos(np.radians(NEAR)):
            continue
        a, b = features[i], features[j]
        turn = relative_turn(poses[i], poses[j])
        told = [
            allowed_matches(a, b, poses[[i, j]], (cameras[i], cameras[j]), turn + away, radius)
            for away in (0, 90, 180, 270)
        ]
        if len(told[0].a) < CHANCE * max(LEAST, *(len(t.a) for t in told[1:])):
            continue
        link = verified(told[0], a, b, cameras[i], error, cameras[j])
        if link is not None:
            links[i, j] = link
    return links


def consistent_matches(
    features: list[Features],
    links: dict[tuple[int, int], Link],
    poses: np.ndarray,
    cameras: list[Camera],
    radius: float = 0.85,
) -> dict[tuple[int, int], Link]:
    """The matches of `links` that the poses allow, of pairs that keep at least LEAST."""
    out = {}
    for (i, j), link in links.items():
        p, q = features[i].points[link.a], features[j].points[link.b]
        ok = allowed(*midpoints(p, q, poses[[i, j]], (cameras[i], cameras[j])), radius)
        if ok.sum() >= LEAST:
            out[i, j] = Link(link.a[ok], link.b[ok], link.turn, link.rotation)
    return out


def allowed(points: np.ndarray, off: np.ndarray, radius: float) -> np.ndarray:
    """Whether a match may be one: its two lines of sight meet, inside the object. As `midpoints`
    returns."""
    return (off < BAND * radius) & (np.linalg.norm(points, axis=-1) < radius * (1 + BAND))


def relative_turn(first: np.ndarray, second: np.ndarray) -> float:
    """Degrees, in the picture and clockwise, by which what stands at the pose `second`
    (object_from_camera) is turned against `first`."""
    ahead = (
        first[:3, 3] + second[:3, 3]
    )  # between both lines of sight: neither is foreshortened more
    ahead /= np.linalg.norm(ahead)
    across = np.linalg.svd(ahead[None])[2][1:]  # two directions of the object that both see
    one, two = (across @ p[:3, :3] for p in (first, second))  # in the cameras' axes
    c, s = (one[:, :2] * two[:, :2]).sum(), (one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]).sum()
    return float(np.degrees(np.arctan2(s, c)) % 360)


def allowed_matches(
    a: Features, b: Features, poses: np.ndarray, cameras, turn: float, radius: float
) -> Link:
    """Mutual nearest neighbours among the pairs of keypoints that the two poses allow."""
    none = Link(np.zeros(0, int), np.zeros(0, int), turn)
    if min(len(a.points), len(b.points)) < 2:
        return none
    likeness = a.descriptors[0] @ b.descriptors[round(turn / STEP) % len(b.descriptors)].T
    x, y = np.meshgrid(np.arange(len(a.points)), np.arange(len(b.points)), indexing="ij")
    s = np.where(
        allowed(*midpoints(a.points[x], b.points[y], poses, cameras), radius), likeness, -1.0
    )
    first, back = s.argmax(1), s.argmax(0)
    i = np.arange(len(s))
    top = s[i, first]
    near = np.linalg.norm(b.points[None, :, :] - b.points[first][:, None, :], axis=-1)
    size = BAND * radius * cameras[1].fx / np.linalg.norm(poses[1][:3, 3])
    second = np.where(near > 0.3 * size, s, -1.0).max(1)  # the same place again is no rival
    good = (
        (top > 0)
        & (back[first] == i)
        & (
            np.sqrt(np.maximum(2 - 2 * top, 1e-9))
            < RATIO * np.sqrt(np.maximum(2 - 2 * second, 1e-9))
        )
    )
    return Link(i[good], first[good], turn)


def midpoints(
    p: np.ndarray, q: np.ndarray, poses: np.ndarray, cameras
) -> tuple[np.ndarray, np.ndarray]:
    """(..., 3) points of the object nearest to both lines of sight of pixels p, q (..., 2), and
    half their distance (...)."""
    rays = []
    for pixels, pose, c in zip((p, q), poses, cameras, strict=True):
        d = np.stack(
            [
                (pixels[..., 0] - c.cx) / c.fx,
                (pixels[..., 1] - c.cy) / c.fy,
                np.ones(pixels.shape[:-1]),
            ],
            -1,
        )
        rays.append((d / np.linalg.norm(d, axis=-1, keepdims=True)) @ pose[:3, :3].T)
    (u, v), w = rays, poses[0][:3, 3] - poses[1][:3, 3]
    b, d, e = (u * v).sum(-1), u @ w, v @ w
    room = np.maximum(1 - b * b, 1e-9)
    one = poses[0][:3, 3] + ((b * e - d) / room)[..., None] * u
    two = poses[1][:3, 3] + ((e - b * d) / room)[..., None] * v
    return 0.5 * (one + two), 0.5 * np.linalg.norm(one - two, axis=-1)


def tracks_of(links: dict[tuple[int, int], Link]) -> list[list[tuple[int, int]]]:
    """Groups of (instance, keypoint) that the links join; those that hold two keypoints of one
    instance are left out."""
    parent: dict[tuple[int, int], tuple[int, int]] = {}

    def root(x):
        parent.setdefault(x, x)
        while parent[x] != x:
            parent[x] = parent[parent[x]]
            x = parent[x]
        return x

    for (i, j), link in links.items():
        for a, b in zip(link.a.tolist(), link.b.tolist(), strict=True):
            parent[root((i, a))] = root((j, b))
    groups = defaultdict(list)
    for x in parent:
        groups[root(x)].append(x)
    return [sorted(g) for g in groups.values() if len({k for k, _ in g}) == len(g)]


def bundle_adjusted(
    features: list[Features],
    links: dict[tuple[int, int], Link],
    poses: np.ndarray,
    cameras: list[Camera],
    radius: float = 0.85,
) -> tuple[np.ndarray, np.ndarray, tuple[float, float]]:
    """Bundle adjustment with a belief in the poses that it begins with: (poses (N, 4, 4),
    observations of each instance (N,), median distance in pixels between keypoints and points
    before and after). The focal length stays; wrong matches count little (soft L1)."""
    tracks = tracks_of(links)
    view = np.array([k for t in tracks for k, _ in t], int)
    track = np.array([n for n, t in enumerate(tracks) for _ in t], int)
    counts = np.bincount(view, minlength=len(poses))
    if not tracks:
        return poses, counts, (0.0, 0.0)
    seen = np.array([features[k].points[f] for t in tracks for k, f in t])
    start = np.linalg.inv(poses)
    points = np.zeros((len(tracks), 3))
    for n, t in enumerate(tracks):
        (i, f), (j, g) = t[0], t[-1]
        points[n] = midpoints(
            features[i].points[f], features[j].points[g], poses[[i, j]], (cameras[i], cameras[j])
        )[0]
    centre = start[:, :3, 3]
    far = np.linalg.norm(centre, axis=1)
    focal = np.array([c.fx for c in cameras])
    one = PIXEL * radius * focal / far  # pixels
    lens = np.array([[c.fx, c.fy, c.cx, c.cy] for c in cameras])
    size = 6 * len(poses)

    def placed(x: np.ndarray) -> np.ndarray:
        """camera_from_object of the numbers in x, which are in units of the belief."""
        out = []
        for m, c in zip(start, x[:size].reshape(-1, 6), strict=True):
            out.append(
                similarity(
                    exp_so3(TURN * c[:3]) @ m[:3, :3],
                    m[:3, 3] * np.exp(ALONG * c[5]) + ASIDE * np.array([c[3], c[4], 0.0]),
                )
            )
        return np.array(out)

    def misses(x: np.ndarray) -> np.ndarray:
        m, p = placed(x), x[size:].reshape(-1, 3)[track]
        q = np.einsum("nij,nj->ni", m[view, :3, :3], p) + m[view, :3, 3]
        return q[:, :2] / q[:, 2:] * lens[view, :2] + lens[view, 2:] - seen

    def residuals(x: np.ndarray) -> np.ndarray:
        d = misses(x) / one[view][:, None]
        length = np.linalg.norm(d, axis=1, keepdims=True)
        robust = np.sqrt(2 * (np.sqrt(1 + length**2) - 1)) / np.maximum(
            length, 1e-9
        )  # soft L1 of each distance
        return np.concatenate([(d * robust).ravel(), x[:size]])

    rows = 2 * len(view)
    pattern = lil_matrix((rows + size, size + 3 * len(tracks)), dtype=np.int8)
    for r, (k, n) in enumerate(zip(view, track, strict=True)):
        pattern[2 * r : 2 * r + 2, 6 * k : 6 * k + 6] = 1
        pattern[2 * r : 2 * r + 2, size + 3 * n : size + 3 * n + 3] = 1
    pattern[np.arange(rows, rows + size), np.arange(size)] = 1
    x = np.concatenate([np.zeros(size), points.ravel()])
    found = least_squares(
        residuals, x, jac_sparsity=pattern, method="trf", x_scale="jac", max_nfev=40
    ).x
    before, after = (float(np.median(np.linalg.norm(misses(y), axis=1))) for y in (x, found))
    return np.linalg.inv(placed(found)), counts, (before, after)


def guided(
    features: list[Features],
    links: dict[tuple[int, int], Link],
    poses: np.ndarray,
    cameras: list[Camera],
    error: float,
) -> tuple[np.ndarray, int]:
    """Poses after matches guided by them and bundle adjustment, twice: (poses (N, 4, 4), pairs that
    are linked). links: from before, for features that have no descriptors (a matcher's); those of
    SIFT are matched anew. Poses stay where nothing is linked, and those of instances that would
    turn by more than FARTHEST: matches that ask for it are wrong ones."""
    found, count = poses, 0
    for _ in range(2):
        if all(f.descriptors.size for f in features):
            now = guided_links(features, found, cameras, error)
        else:
            now = consistent_matches(features, links, found, cameras)
        if not now:
            break
        count = len(now)
        moved, _, (before, after) = bundle_adjusted(features, now, poses, cameras)
        near = np.array(
            [
                rotation_angle(a[:3, :3].T @ b[:3, :3]) < FARTHEST
                for a, b in zip(moved, poses, strict=True)
            ]
        )
        if after > before:
            break
        found = np.where(near[:, None, None], moved, poses)
    return found, count

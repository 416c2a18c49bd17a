"""Do the cameras agree with the photos, and do they see the object from enough sides?"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from relit.preflight.look import Look
from relit.scene import Camera, Capture, Sphere

PAIRS = 6  # that are matched
NEAR = 40.0  # degrees, largest angle between the views of a pair
LEAST = 25  # matches that say something
AGREES = (
    0.02  # of the longer side: farther from its epipolar line, a match is wrong or the cameras are
)
SHARE = 0.5  # of the matches that lie near their lines when the cameras are right


@dataclass(frozen=True)
class MatchedPair:
    """Two matched photos. points: (N, 2, 2) pixels of the downscaled copies. distance: (N,) pixels
    to the epipolar line in the second photo, from the given cameras."""

    first: Look
    second: Look
    points: np.ndarray
    distance: np.ndarray


def fundamental(first: Camera, second: Camera) -> np.ndarray:
    """(3, 3) F with q^T F p = 0 for pixels p of the first camera and q of the second,
    homogeneous."""
    relative = second.camera_from_world @ first.world_from_camera
    r, t = relative[:3, :3], relative[:3, 3]
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    return np.linalg.inv(second.intrinsics).T @ cross @ r @ np.linalg.inv(first.intrinsics)


def match(first: Look, second: Look) -> MatchedPair | None:
    """SIFT matches (ratio test, mutual) of two photos and their distances to the epipolar lines, or
    None for too few. Both photos have cameras."""
    assert first.camera is not None and second.camera is not None
    sift = cv2.SIFT_create(nfeatures=1500)  # pyright: ignore[reportAttributeAccessIssue]
    found = []
    for x in (first, second):
        gray = (np.clip(np.sqrt(np.maximum(x.gray, 0)), 0, 1) * 255).astype(np.uint8)
        found.append(sift.detectAndCompute(gray, None))
    (ka, da), (kb, db) = found
    if da is None or db is None or len(ka) < LEAST or len(kb) < LEAST:
        return None
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    there = {
        m.queryIdx: m.trainIdx
        for m, n in (p for p in matcher.knnMatch(da, db, k=2) if len(p) == 2)
        if m.distance < 0.75 * n.distance
    }
    back = {
        m.queryIdx: m.trainIdx
        for m, n in (p for p in matcher.knnMatch(db, da, k=2) if len(p) == 2)
        if m.distance < 0.8 * n.distance
    }
    both = [(i, j) for i, j in there.items() if back.get(j) == i]
    if len(both) < LEAST:
        return None
    # OpenCV's origin is the centre of the first pixel
    points = np.array([[ka[i].pt, kb[j].pt] for i, j in both]) + 0.5
    p, q = (np.concatenate([points[:, k], np.ones((len(points), 1))], 1) for k in (0, 1))
    line = p @ fundamental(first.camera, second.camera).T
    distance = np.abs((q * line).sum(1)) / np.maximum(np.linalg.norm(line[:, :2], axis=1), 1e-12)
    return MatchedPair(first, second, points, distance)


def matched_pairs(looks: list[Look]) -> list[MatchedPair]:
    """Matched pairs of neighbouring views: each of a few evenly spaced photos with the photo of the
    nearest optical axis."""
    seen = [x for x in looks if x.camera is not None]
    axes = np.array([x.camera.world_from_camera[:3, 2] for x in seen])
    if len(seen) < 2:
        return []
    angle = np.degrees(np.arccos(np.clip(axes @ axes.T, -1, 1)))
    moved = np.linalg.norm(
        np.array([x.camera.centre for x in seen])[:, None]
        - np.array([x.camera.centre for x in seen])[None],
        axis=-1,
    )
    angle[moved < 1e-6 * max(moved.max(), 1e-12)] = np.inf  # no epipolar lines without a baseline
    chosen: dict[tuple[int, int], float] = {}
    for i in np.unique(
        np.linspace(0, len(seen) - 1, min(2 * PAIRS, len(seen))).round().astype(int)
    ):
        j = int(np.argmin(angle[i]))
        if angle[i, j] < NEAR:
            chosen[(min(i, j), max(i, j))] = float(angle[i, j])
    matched = [match(seen[i], seen[j]) for i, j in list(chosen)[:PAIRS]]
    return [m for m in matched if m is not None]


def epipolar_agreement(looks: list[Look]) -> tuple[dict | None, list[MatchedPair]]:
    """({pairs, matches, median (pixels of the downscaled copies), share (near their epipolar
    lines)}, the pairs); None without matches."""
    pairs = matched_pairs(looks)
    if not pairs:
        return None, []
    near = [p.distance < AGREES * max(p.second.gray.shape) for p in pairs]
    # a wrong match can lie anywhere, so the median is over matches near their lines
    good = np.concatenate([p.distance[n] for p, n in zip(pairs, near, strict=True)])
    share = float(np.concatenate(near).mean())
    median = float(np.median(good)) if len(good) else None
    return {
        "pairs": len(pairs),
        "matches": int(sum(len(p.distance) for p in pairs)),
        "share": round(share, 3),
        "median": None if median is None else round(median, 3),
    }, pairs


def reprojection(capture: Capture, looks: list[Look]) -> dict | None:
    """Share of the given sparse points that project into the images."""
    if capture.points is None or len(capture.points) == 0:
        return None
    points = capture.points[:: max(1, len(capture.points) // 5000)]
    if capture.sphere is not None:
        points = points[
            np.linalg.norm(points - capture.sphere.centre, axis=1) < capture.sphere.radius
        ]
    if len(points) == 0:
        return None
    inside = []
    for x in looks:
        if x.camera is not None:
            q = x.camera.project(points)
            inside.append(
                float(
                    (
                        (q[:, 2] > 0)
                        & (q[:, 0] > 0)
                        & (q[:, 1] > 0)
                        & (q[:, 0] < x.camera.width)
                        & (q[:, 1] < x.camera.height)
                    ).mean()
                )
            )
    return (
        {"points": len(points), "in_the_pictures": round(float(np.mean(inside)), 3)}
        if inside
        else None
    )


def camera_coverage(capture: Capture) -> dict | None:
    """Coverage of the object sphere by the cameras: its diameter as a share of the frame's shorter
    side, photos that crop it, the widest gap between views."""
    if not capture.has_cameras or capture.sphere is None:
        return None
    sphere, cameras = capture.sphere, [p.camera for p in capture.photos]
    # a sphere that was sized by the photos' frames cannot be cropped by them
    guessed = any("viewing directions" in note for note in capture.notes)
    fill, cut, towards = [], [], []
    for photo, camera in zip(capture.photos, cameras, strict=True):
        x, y, z = camera.project(sphere.centre)
        r = camera.fx * sphere.radius / max(z, 1e-9)
        fill.append(2 * r / min(camera.width, camera.height))
        outside = (
            z <= 0
            or x - 0.6 * r < 0
            or y - 0.6 * r < 0
            or x + 0.6 * r > camera.width
            or y + 0.6 * r > camera.height
        )
        if outside and not guessed:
            cut.append(photo.name)
        towards.append(
            (camera.centre - sphere.centre)
            / max(np.linalg.norm(camera.centre - sphere.centre), 1e-12)
        )
    return {
        "fill": round(float(np.median(fill)), 3),
        "cut": cut,
        "photos": len(capture.photos),
        "widest_gap": round(widest_view_gap(np.array(towards)), 1),
    }


def widest_view_gap(towards: np.ndarray) -> float:
    """Largest angle in degrees from a direction, on the hemisphere of the mean view, to the nearest
    view. towards: (N, 3) unit vectors from the object to the cameras."""
    axis = towards.mean(0)
    n = 600
    z = 1 - 2 * (np.arange(n) + 0.5) / n
    phi = np.pi * (1 + 5**0.5) * np.arange(n)
    s = np.sqrt(1 - z * z)
    d = np.stack([s * np.cos(phi), s * np.sin(phi), z], 1)
    if (
        np.linalg.norm(axis) > 0.2
    ):  # the side away from the cameras, such as the underside, does not count
        d = d[d @ axis > 0]
    return float(np.degrees(np.arccos(np.clip((d @ towards.T).max(1).min(), -1, 1))))


def sphere_outline(camera: Camera, sphere: Sphere) -> tuple[float, float, float]:
    """Approximate centre and radius in pixels of the projected object sphere."""
    x, y, z = camera.project(sphere.centre)
    return float(x), float(y), float(camera.fx * sphere.radius / max(z, 1e-9))


def camera_warnings(found: dict | None, around: dict | None) -> list[dict]:
    """Warnings for the results of `epipolar_agreement` and `camera_coverage`."""
    out = []
    if found is not None and found["matches"] >= LEAST and found["share"] < SHARE:
        out.append(
            {
                "what": f"only {100 * found['share']:.0f} % of the matches between neighbouring photos lie near their epipolar lines",
                "fix": "check that the cameras belong to these photos, and their axes and intrinsics",
            }
        )
    if around is not None:
        if around["fill"] < 0.25:
            out.append(
                {
                    "what": f"the object sphere fills {100 * around['fill']:.0f} % of the frame",
                    "fix": "move closer, or give --sphere",
                }
            )
        if len(around["cut"]) > 0.5 * around["photos"]:
            out.append(
                {
                    "what": f"{len(around['cut'])} photos crop the centre of the object sphere",
                    "fix": "move back, or give --sphere",
                }
            )
        if around["widest_gap"] > 75:
            what = (
                f"the nearest photo to some directions is {around['widest_gap']:.0f} degrees away"
            )
            out.append(
                {"what": what, "fix": "photograph from all around; unseen sides are extrapolated"}
            )
    return out

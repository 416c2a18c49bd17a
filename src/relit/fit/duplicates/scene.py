"""A photographed pile as a scene for the surface pass: the ground under it, all instances as one
mesh, the photo's pixels.

The scene frame has the world's axes, the object's unit of length, and its origin in the middle of
the pile.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import mitsuba as mi
import numpy as np
from scipy.ndimage import map_coordinates, minimum_filter

from relit.conventions import (
    environment_directions,
    environment_solid_angles,
    move_points,
    similarity,
)
from relit.fit.duplicates.placed_pile import PlacedPile
from relit.fit.passes.pixels import make_bank
from relit.fit.registration.instances.views import nearest_pixels
from relit.reference.pile import ground_square
from relit.rendering.transport import Blockers, TraceableMesh
from relit.scene import Camera, Ground, Mesh, Pixels

TOUCHES = 0.08  # unit lengths within which an instance counts as touching the ground
SETTLED = 4  # instances that must touch the ground before their distances follow it
FARTHEST = 0.02  # of its distance that an instance is moved at most
# the same for what is moved onto another instance, or from farther above the ground: that it rests
# there is a guess
BESIDE = 0.005
# of that way that it goes: its size tells its distance to .035 radii, touching another to .05, as
# few see the undersides
ONTO = 0.35
TILT = 5.0  # degrees that the ground may turn meanwhile
# unit lengths, the standard deviation of a distance that the ground tells: neither feet nor the
# plane are exact
PLANE = 0.009
FAR = 3.0  # standard deviations
# sine of the angle at which the photo must look down on the ground for objects to be moved onto
# something
STEEP = 0.3
GROUND_ROWS = 96
# unit lengths between instances that are to stand alone: one fills a ten-thousandth of what its
# neighbour sees
ROOM = 40.0

Distance = Callable[
    [np.ndarray], np.ndarray
]  # of points (..., 3) in the object's frame from its surface, negative inside


def find_ground(vertices: np.ndarray, poses: np.ndarray) -> np.ndarray | None:
    """Point and unit normal, (2, 3), in the photo's frame (unit lengths) of the plane that most
    instances touch with all of them on the camera's side; None where fewer than three touch
    one."""
    from scipy.spatial import ConvexHull, QhullError

    standing = [
        move_points(np.linalg.inv(p), vertices[:: max(1, len(vertices) // 4000)]) for p in poses
    ]
    if len(standing) < 3:
        return None
    try:
        hull = ConvexHull(np.concatenate(standing))
    except QhullError:
        return None
    best, found = 2, None
    for normal, offset in {tuple(np.round(e, 3)): (e[:3], e[3]) for e in hull.equations}.values():
        up = -normal
        if -offset <= 0:  # the camera (the origin) must stand above
            continue
        gaps = np.array([(s @ up - offset).min() for s in standing])
        touching = int((gaps < TOUCHES).sum())
        if touching > best:
            lowest = np.array(
                [s[np.argmin(s @ up)] for s, g in zip(standing, gaps, strict=True) if g < TOUCHES]
            )
            best, found = (
                touching,
                np.stack([lowest.mean(0) - up * ((lowest - lowest.mean(0)) @ up).max(), up]),
            )
    return found


def set_down(
    vertices: np.ndarray, poses: np.ndarray, plane: np.ndarray, distance: Distance
) -> tuple[np.ndarray, np.ndarray, int]:
    """Poses (N, 4, 4) and the plane after every instance was moved along its line of sight towards
    where it rests on the ground (`parts_of_the_way`), or a part of the way until it rests on
    another, and how many were. distance: of points in the object's frame from its surface, negative
    inside.

    The distance of an object is known by its size alone, and half a per cent of the distance is a
    tenth of an object; the plane under many of them is known far better, and nothing hangs in the
    air or lies below the ground. The plane goes through the middle of the lowest points of those
    that stand on it. Fewer than SETTLED leave everything as it is: any three objects touch some
    plane.
    """
    points = vertices[:: max(1, len(vertices) // 4000)]
    lowest = [move_points(np.linalg.inv(p), points) for p in poses]
    point, up = plane
    for _ in range(6):
        feet = np.array([s[np.argmin(s @ up)] for s in lowest])
        gaps = (feet - point) @ up
        near = np.abs(gaps - np.median(gaps[np.abs(gaps) < 2 * TOUCHES])) < TOUCHES
        if near.sum() < SETTLED:
            return poses, plane, 0
        point = feet[near].mean(0)
        normal = np.linalg.svd(feet[near] - point)[2][2]
        normal = normal if normal @ up > 0 else -normal
        up = normal if normal @ plane[1] > np.cos(np.radians(TILT)) else plane[1]
    gaps = np.array([((s - point) @ up).min() for s in lowest])
    standing, placed, count = np.linalg.inv(poses), [], 0
    steep = -(standing[:, :3, 3] @ up) / np.linalg.norm(standing[:, :3, 3], axis=1)
    ways = gaps / np.maximum(steep, STEEP)  # along the lines of sight, unit lengths
    parts = parts_of_the_way(ways, (gaps < TOUCHES) & (steep > STEEP))
    for k in np.argsort(gaps):
        ray = standing[k][:3, 3]
        if steep[k] > STEEP:
            ground = ways[k] / np.linalg.norm(ray)
            share, most = (
                parts[k] * ground,
                FARTHEST,
            )  # of the distance: the object's middle moves by share * ray
            if gaps[k] > TOUCHES:
                onto = resting_share(points, standing, k, placed, distance, ground)
                share, most = ONTO * onto, ONTO * BESIDE
            if 0 < abs(share) < most:
                standing[k][:3, 3] += share * ray
                count += 1
        placed.append(k)
    return np.linalg.inv(standing), np.stack([point, up]), count


def parts_of_the_way(ways: np.ndarray, stands: np.ndarray) -> np.ndarray:
    """How much of its way along the line of sight to the ground each instance goes. ways: (N,) of
    all. stands: (N,) bool, who stands there.

    Each has been measured twice, by its size and by the ground, and goes to the mean of both, each
    by the inverse of its variance: the ground's is PLANE², and what the ways scatter is that of
    both. Whose way is FAR times as long was not measured by its size."""
    scatter = max(1.48 * float(np.median(np.abs(ways[stands]))), PLANE) if stands.any() else PLANE
    return 1 - (PLANE / np.where(np.abs(ways) > FAR * scatter, np.abs(ways), scatter)) ** 2


def resting_share(
    points: np.ndarray,
    standing: np.ndarray,
    k: int,
    placed: list[int],
    distance: Distance,
    ground: float,
) -> float:
    """The share of its distance by which instance k moves until it lies on one of those that are
    placed, or on the ground (which takes the share `ground`); the one next to where it is now.
    standing: (N, 4, 4) photo_from_object."""
    shares = np.linspace(-FARTHEST, FARTHEST, 81)
    room = ground - shares  # negative once it is too far away
    own = move_points(standing[k], points[::3])
    ray = standing[k][:3, 3]
    back = np.linalg.inv(standing[k])
    for j in placed:
        if np.linalg.norm(standing[j][:3, 3] - ray) > 2 + FARTHEST * np.linalg.norm(ray):
            continue
        there = np.linalg.inv(standing[j])
        mine = move_points(there, own) + shares[:, None, None] * (there[:3, :3] @ ray)
        theirs = move_points(back @ standing[j], points[::3]) - shares[:, None, None] * (
            back[:3, :3] @ ray
        )
        room = np.minimum(room, np.minimum(distance(mine).min(1), distance(theirs).min(1)))
    rests = np.flatnonzero((room[:-1] > 0) & (room[1:] <= 0))
    if len(rests) == 0:
        return np.inf
    found = shares[rests] + (shares[1] - shares[0]) * room[rests] / (room[rests] - room[rests + 1])
    return float(found[np.argmin(np.abs(found))])


def distance_in(values: np.ndarray) -> Distance:
    """Signed distance of points (..., 3) of the unit frame from the nodes' (n, n, n), trilinear;
    beyond the cube what it takes to get there comes on top."""

    def distance(points: np.ndarray) -> np.ndarray:
        inside = np.clip(points, -1, 1)
        at = (inside[..., ::-1] + 1) * (0.5 * (values.shape[0] - 1))
        return map_coordinates(
            values, np.moveaxis(at, -1, 0), order=1, mode="nearest"
        ) + np.linalg.norm(points - inside, axis=-1)

    return distance


def spread_moves(standing: list[np.ndarray], scene_from_photo: np.ndarray) -> np.ndarray:
    """(N, 3) moves, scene frame, that carry instances standing at (4, 4) photo_from_object so far
    apart that none shadows another."""
    side = int(np.ceil(np.sqrt(len(standing))))
    k = np.arange(len(standing))
    places = ROOM * (
        np.stack([k % side, np.zeros(len(k)), k // side], 1)
        - 0.5 * (side - 1) * np.array([1, 0, 1])
    )
    return places - np.array([(scene_from_photo @ pose)[:3, 3] for pose in standing])


def alone_bank(
    photos: list,
    cameras: list[Camera],
    shown: list[dict[int, int]],
    moves: np.ndarray,
    max_pixels: int,
):
    """As `photo_bank` for instances that were moved apart: a view of each, from a camera that was
    moved with it. shown: for each photo label -> number of the instance."""
    cut, own, labels = [], [], []
    for pixels, camera, instances in zip(photos, cameras, shown, strict=True):
        for label, number in instances.items():
            rows, columns = (np.flatnonzero((pixels.labels == label).any(axis)) for axis in (1, 0))
            top, left = max(rows[0] - 1, 0), max(columns[0] - 1, 0)
            part = (slice(top, rows[-1] + 2), slice(left, columns[-1] + 2))
            inside = replace(
                pixels,
                rgb=pixels.rgb[part],
                mask=None,
                normal=None,
                clipped=None,
                labels=pixels.labels[part],
            )
            h, w = inside.labels.shape
            pose = similarity(np.eye(3), moves[number]) @ camera.world_from_camera
            cut.append(inside)
            own.append(
                replace(
                    camera,
                    width=w,
                    height=h,
                    cx=camera.cx - left,
                    cy=camera.cy - top,
                    world_from_camera=pose,
                )
            )
            labels.append({label})
    return photo_bank(cut, own, labels, max_pixels)


@dataclass(frozen=True)
class PileScene:
    """Meshes in the scene frame, linear radiance (V, 3) of their vertices. instances: all of them,
    one after the other. ground: carries no texels and only blocks, or None."""

    instances: Mesh
    radiance: np.ndarray
    ground: Blockers | None

    def traceable(self) -> TraceableMesh:
        return TraceableMesh(self.instances, self.radiance, self.ground)


def instance_meshes(
    pile: PlacedPile, scene_from_photo: np.ndarray, moves: np.ndarray | None = None
) -> tuple[Mesh, np.ndarray]:
    """All instances as one mesh in the scene frame, and the radiance (V, 3) of its vertices. moves:
    (K, 3) of `spread_moves`, or None."""
    mesh, count = pile.mesh, len(pile.mesh.vertices)
    places = [scene_from_photo @ np.linalg.inv(p) for p in pile.poses]
    if moves is not None:
        places = [similarity(np.eye(3), s) @ m for s, m in zip(moves, places, strict=True)]
    together = Mesh(
        np.concatenate([move_points(m, mesh.vertices) for m in places]).astype(np.float32),
        np.concatenate(
            [mesh.faces.astype(np.int64) + k * count for k in range(len(places))]
        ).astype(np.int32),
        np.concatenate([mesh.normals @ m[:3, :3].T for m in places]).astype(np.float32),
        np.concatenate([mesh.uvs for _ in places]).astype(np.float32),
    )
    return together, np.concatenate(list(pile.radiance)).astype(np.float32)


def pile_scene(
    pile: PlacedPile, scene_from_photo: np.ndarray, pixels: Pixels, camera: Camera
) -> PileScene:
    """All instances and the ground, where there is one, in the scene frame. pixels, camera: of the
    first photo."""
    mesh, radiance = instance_meshes(pile, scene_from_photo)
    if pile.plane is None:
        return PileScene(mesh, radiance, None)
    point = move_points(scene_from_photo, pile.plane[0])
    normal = scene_from_photo[:3, :3] @ pile.plane[1]
    reach = 4 * float(np.linalg.norm(mesh.vertices - point, axis=1).max())
    v, f = ground_square(Ground(point, normal, reach, np.ones(3)), GROUND_ROWS)
    uvs = (v - v.min(0))[:, [0, 2]] / np.maximum(np.ptp(v, axis=0)[[0, 2]], 1e-6)
    ground = Mesh(
        v.astype(np.float32),
        f.astype(np.int32),
        np.repeat(normal[None], len(v), 0).astype(np.float32),
        uvs.astype(np.float32),
    )
    shown = ground_radiance(v, scene_from_photo, pixels, camera).astype(np.float32)
    return PileScene(mesh, radiance, Blockers(ground, shown))


def ground_radiance(
    points: np.ndarray, scene_from_photo: np.ndarray, pixels, camera: Camera
) -> np.ndarray:
    """(V, 3) what the photo shows of the ground at points of the scene frame; the median of it
    where the photo does not."""
    x, y, ok = nearest_pixels(camera.with_pose(scene_from_photo), points)
    ok &= pixels.labels[y, x] == 0
    free = pixels.labels == 0
    usual = np.median(pixels.rgb[free], axis=0) if free.any() else np.full(3, 0.1)
    return np.where(ok[:, None], pixels.rgb[y, x], usual)


def ground_colour(pixels, plane: np.ndarray | None) -> np.ndarray:
    """(3,) median radiance of what is no object; 0 without a ground."""
    free = pixels.labels == 0
    known = free.any() and plane is not None
    return np.median(pixels.rgb[free], axis=0) if known else np.zeros(3)


def ground_reflectance(environment: np.ndarray, up: np.ndarray, radiance: np.ndarray) -> np.ndarray:
    """(3,) base colour of a diffuse ground that shows `radiance` (3,) under the whole sky of the
    environment (H, W, 3): what hides a part of the sky is left to
    `ground_paint.ground_as_shown`."""
    h, w = environment.shape[:2]
    cosine = np.maximum(
        environment_directions(h, w) @ np.asarray(up, np.float64), 0
    ) * environment_solid_angles(h, w)
    return np.clip(
        radiance * np.pi / np.maximum((environment * cosine[..., None]).sum((0, 1)), 1e-6),
        0.02,
        0.95,
    )


def light_below(environment: np.ndarray, up: np.ndarray, radiance: np.ndarray) -> np.ndarray:
    """The environment (H, W, 3) with `radiance` (3,) where directions point below a ground whose
    unit normal is `up`, both in the frame of
    the map: every object stands above, and the best guess is that the ground goes on. A blend of a
    few degrees at the horizon."""
    height = environment_directions(*environment.shape[:2]) @ np.asarray(up, np.float64)
    below = np.clip(-height / 0.1, 0, 1)[..., None]
    return (environment * (1 - below) + radiance * below).astype(np.float32)


def photo_bank(photos: list, cameras: list[Camera], labels: list[set[int]], max_pixels: int):
    """The pixels of the photos that lie inside an instance of their `labels`, one pixel off its
    border; every n-th where there are more than max_pixels."""
    solid = [
        (minimum_filter(p.labels, 3) == p.labels) & np.isin(p.labels, list(own))
        for p, own in zip(photos, labels, strict=True)
    ]
    bank = make_bank(
        cameras, [p.rgb for p in photos], [s.astype(np.float32) for s in solid], radius=1e6
    )
    inside = np.flatnonzero(np.concatenate([s.ravel() for s in solid])).astype(np.uint32)
    bank.candidates = mi.UInt32(inside[:: max(1, len(inside) // max_pixels)])
    return bank

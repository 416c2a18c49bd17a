"""A photographed pile as a scene for the surface pass: the ground under it, all instances as one mesh, the photo's pixels.

The scene frame has the world's axes, the object's unit of length, and its origin in the middle of the pile.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np
from scipy.ndimage import minimum_filter

from relit.conventions import environment_directions, environment_solid_angles, move_points
from relit.fit.pixels import make_bank
from relit.rendering.pile import ground_square
from relit.scene import Camera, Ground, Mesh

TOUCHES = 0.08  # unit lengths within which an instance counts as touching the ground
SETTLED = 4  # instances that must touch the ground before their distances follow it
FARTHEST = 0.02  # of its distance that an instance is moved at most
TILT = 5.0  # degrees that the ground may turn meanwhile
GROUND_ROWS = 96


def find_ground(vertices: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Point and unit normal, (2, 3), in the photo's frame (unit lengths) of the plane that most instances touch with all of them on the
    camera's side; (0, 3) where fewer than three touch one."""
    from scipy.spatial import ConvexHull, QhullError

    standing = [move_points(np.linalg.inv(p), vertices[:: max(1, len(vertices) // 4000)]) for p in poses]
    if len(standing) < 3:
        return np.zeros((0, 3))
    try:
        hull = ConvexHull(np.concatenate(standing))
    except QhullError:
        return np.zeros((0, 3))
    best, found = 2, np.zeros((0, 3))
    for normal, offset in {tuple(np.round(e, 3)): (e[:3], e[3]) for e in hull.equations}.values():
        up = -normal
        if -offset <= 0:  # the camera (the origin) must stand above
            continue
        gaps = np.array([(s @ up - offset).min() for s in standing])
        touching = int((gaps < TOUCHES).sum())
        if touching > best:
            lowest = np.array([s[np.argmin(s @ up)] for s, g in zip(standing, gaps, strict=True) if g < TOUCHES])
            best, found = touching, np.stack([lowest.mean(0) - up * ((lowest - lowest.mean(0)) @ up).max(), up])
    return found


def set_down(vertices: np.ndarray, poses: np.ndarray, plane: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Poses (N, 4, 4) and the plane after what stands on the ground was moved along its line of sight until it touches, and how many were.

    The distance of an object is known by its size alone, and half a per cent of the distance is a tenth of an object; the plane under many
    of them is known far better. It goes through the middle of the lowest points of those that stand on it. Fewer than SETTLED leave
    everything as it is: any three objects touch some plane.
    """
    lowest = [move_points(np.linalg.inv(p), vertices[:: max(1, len(vertices) // 4000)]) for p in poses]
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
    feet = np.array([s[np.argmin(s @ up)] for s in lowest])
    gaps = (feet - point) @ up
    moved, count = np.array(poses), 0
    for k, gap in enumerate(gaps):
        ray = np.linalg.inv(poses[k])[:3, 3]
        share = gap / -(ray @ up)  # of the distance: the object's middle moves by share * ray
        if abs(gap) < TOUCHES and ray @ up < 0 and abs(share) < FARTHEST:
            standing = np.linalg.inv(poses[k])
            standing[:3, 3] += share * ray
            moved[k] = np.linalg.inv(standing)
            count += 1
    return moved, np.stack([point, up]), count


def scene_mesh(mesh: Mesh, parts, standing, scene_from_photo, pixels, camera: Camera, *, alone: bool) -> tuple[Mesh, np.ndarray]:
    """All instances and the ground as one mesh in the scene frame, and the radiance (V, 3) of its vertices. Faces with negative texture
    coordinates only block (the ground). alone: spread the instances so far apart that none shadows another, no ground."""
    vertices, normals, faces, uvs, radiance, count = [], [], [], [], [], 0
    for k, pose in enumerate(standing):
        m = scene_from_photo @ pose
        vertices.append(move_points(m, mesh.vertices))
        normals.append(mesh.normals @ m[:3, :3].T)
        faces.append(mesh.faces.astype(np.int64) + count)
        uvs.append(mesh.uvs)
        radiance.append(parts["radiance"][k] * (0.0 if alone else 1.0))
        count += len(mesh.vertices)
    if len(parts["plane"]) and not alone:
        point, normal = move_points(scene_from_photo, parts["plane"][0]), scene_from_photo[:3, :3] @ parts["plane"][1]
        reach = 4 * max(np.linalg.norm(v - point, axis=1).max() for v in vertices)
        v, f = ground_square(Ground(point, normal, reach, np.ones(3)), GROUND_ROWS)
        vertices.append(v)
        normals.append(np.repeat(normal[None], len(v), 0))
        faces.append(f + count)
        uvs.append(-1.0 - (v - v.min(0))[:, [0, 2]] / np.maximum(np.ptp(v, axis=0)[[0, 2]], 1e-6))
        radiance.append(ground_radiance(v, scene_from_photo, pixels, camera))
    whole = Mesh(
        np.concatenate(vertices).astype(np.float32),
        np.concatenate(faces).astype(np.int32),
        np.concatenate(normals).astype(np.float32),
        np.concatenate(uvs).astype(np.float32),
    )
    return whole, np.concatenate(radiance).astype(np.float32)


def ground_radiance(points: np.ndarray, scene_from_photo: np.ndarray, pixels, camera: Camera) -> np.ndarray:
    """(V, 3) what the photo shows of the ground at points of the scene frame; the median of it where the photo does not."""
    q = camera.with_pose(scene_from_photo).project(points)
    x, y = np.floor(q[:, 0]).astype(int), np.floor(q[:, 1]).astype(int)
    ok = (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height) & (q[:, 2] > 0)
    x, y = np.clip(x, 0, camera.width - 1), np.clip(y, 0, camera.height - 1)
    ok &= pixels.labels[y, x] == 0
    free = pixels.labels == 0
    usual = np.median(pixels.rgb[free], axis=0) if free.any() else np.full(3, 0.1)
    return np.where(ok[:, None], pixels.rgb[y, x], usual)


def ground_colour(pixels, camera: Camera, plane: np.ndarray) -> np.ndarray:
    """(3,) median radiance of what is no object."""
    free = pixels.labels == 0
    return np.median(pixels.rgb[free], axis=0) if free.any() and len(plane) else np.zeros(3)


def ground_reflectance(environment: np.ndarray, up: np.ndarray, radiance: np.ndarray) -> np.ndarray:
    """(3,) base colour of a diffuse ground that shows `radiance` (3,) under the whole sky of the environment (H, W, 3)."""
    h, w = environment.shape[:2]
    cosine = np.maximum(environment_directions(h, w) @ np.asarray(up, np.float64), 0) * environment_solid_angles(h, w)
    return np.clip(radiance * np.pi / np.maximum((environment * cosine[..., None]).sum((0, 1)), 1e-6), 0.02, 0.95)


def light_below(environment: np.ndarray, up: np.ndarray, radiance: np.ndarray) -> np.ndarray:
    """The environment (H, W, 3) with `radiance` (3,) where directions point below a ground whose unit normal is `up`, both in the frame of
    the map: every object stands above, and the best guess is that the ground goes on. A blend of a few degrees at the horizon."""
    height = environment_directions(*environment.shape[:2]) @ np.asarray(up, np.float64)
    below = np.clip(-height / 0.1, 0, 1)[..., None]
    return (environment * (1 - below) + radiance * below).astype(np.float32)


def photo_bank(photos: list, cameras: list[Camera], labels: list[set[int]], max_pixels: int):
    """The pixels of the photos that lie inside an instance of their `labels`, one pixel off its border; every n-th where there are more
    than max_pixels."""
    solid = [(minimum_filter(p.labels, 3) == p.labels) & np.isin(p.labels, list(own)) for p, own in zip(photos, labels, strict=True)]
    bank = make_bank(cameras, [p.rgb for p in photos], [s.astype(np.float32) for s in solid], radius=1e6)
    inside = np.flatnonzero(np.concatenate([s.ravel() for s in solid])).astype(np.uint32)
    bank.candidates = mi.UInt32(inside[:: max(1, len(inside) // max_pixels)])
    return bank

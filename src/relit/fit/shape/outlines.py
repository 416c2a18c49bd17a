"""The last part of a pixel: the mesh is moved until its outlines lie where the masks have them.

The volume pass ends with outlines that are off by a tenth of a pixel or two, as wide as its surface
is soft. Here the coverage of each pixel along the outlines is traced and compared with the mask;
what is missing or too much, added up across the outline, says by how many pixels it must move. That
is a linear equation for the displacements, along their normals, of the vertices there, and with a
smooth field of displacements for all the others (a bi-Laplacian over the mesh) least squares tells
them all.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import map_coordinates
from scipy.sparse import coo_matrix, diags, identity
from scipy.sparse.linalg import cg

from relit.fit.passes.pixels import camera_rows, rays_through
from relit.geometry.se3 import exp_so3
from relit.geometry.tangents import edges, vertex_normals
from relit.reference.mitsuba_scene import build_geometry
from relit.scene import Camera, Mesh

SUB = 4  # rays a side of a pixel
REACH, STRIDE = (
    1.5,
    0.25,
)  # pixels to either side of an outline over which coverage is compared, and the steps there
FAR = 0.75  # pixels; a displacement of so much counts a quarter
FARTHEST = 1.0  # pixels, in one round
MARGIN = 4  # pixels
CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)
SIDEWAYS = 0.5  # of the normal, that must point across the outline in the picture
# weight of the bi-Laplacian of the displacements in pixels, squared, beside evidence by its
# precision
STIFF = 2000.0
REST = 10.0  # of the displacements themselves
SURE = 0.1  # pixels; outlines are told no better than this


@dataclass(frozen=True)
class Outline:
    """Samples of the outline of a mesh against the background in photos. corners, weights: (N, 3)
    vertices of the faces there, and their shares. point: (N, 3) in the camera's axes. outward: (N,
    2) unit, across the outline in the picture. scale: (N,) pixels that the outline moves for a unit
    of displacement along the normal. shift: (N,) pixels that it should move, outwards."""

    corners: np.ndarray
    weights: np.ndarray
    point: np.ndarray
    outward: np.ndarray
    scale: np.ndarray
    shift: np.ndarray


def follow_outlines(
    mesh: Mesh, cameras: list[Camera], masks: list[np.ndarray], rounds: int = 2
) -> Mesh:
    """The mesh (unit frame, welded, with normals) with its vertices moved along their normals.
    cameras: unit frame. masks: (H, W), the part of each pixel that the object covers. rounds: of
    tracing and solving."""
    for _ in range(rounds):
        scene = build_geometry(mesh)
        mesh = moved_along_normals(
            mesh,
            solve(
                mesh, [outline_of(mesh, scene, c, m) for c, m in zip(cameras, masks, strict=True)]
            ),
        )
    return mesh


def follow_with_poses(
    mesh: Mesh,
    cameras: list[Camera],
    masks,
    known,
    rounds: int = 3,
    turning: bool = True,
    still: bool = False,
    scene=None,
) -> tuple[Mesh, np.ndarray]:
    """As `follow_outlines`, with the poses of the cameras (N, 4, 4) moved too, each round before
    the mesh. known: (H, W) each, 1 where what the mask says counts. turning: False where the
    cameras move along and across their lines of sight alone. still: the mesh stays.
    scene: of `build_geometry`, where there is one of the mesh as it comes."""
    for _ in range(rounds):
        scene = scene or build_geometry(mesh)
        for _ in range(2):
            found = [
                outline_of(mesh, scene, c, m, k)
                for c, m, k in zip(cameras, masks, known, strict=True)
            ]
            cameras = [
                c.with_pose(moved_camera(c, outline, turning))
                for c, outline in zip(cameras, found, strict=True)
            ]
        if not still:
            mesh = moved_along_normals(
                mesh,
                solve(
                    mesh,
                    [
                        outline_of(mesh, scene, c, m, k)
                        for c, m, k in zip(cameras, masks, known, strict=True)
                    ],
                ),
            )
            scene = None
    return mesh, np.array([c.world_from_camera for c in cameras])


def outline_misfit(mesh: Mesh, cameras: list[Camera], masks, known) -> float:
    """Pixels by which outlines lie beside the masks: the median of all samples."""
    scene = build_geometry(mesh)
    found = [
        outline_of(mesh, scene, c, m, k).shift
        for c, m, k in zip(cameras, masks, known, strict=True)
    ]
    return float(np.median(np.abs(np.concatenate(found)))) if sum(map(len, found)) else 0.0


def moved_camera(camera: Camera, outline: Outline, turning: bool = True) -> np.ndarray:
    """The camera's pose (4, 4) with which the outline moves as its samples ask for: one
    Gauss-Newton step over turns about the middle of what is seen, unless turning is False, and
    translations."""
    if len(outline.point) < 30:
        return np.asarray(camera.world_from_camera, np.float64)
    middle, free = outline.point.mean(0), slice(0 if turning else 3, 6)
    rows, trust = by_motion(camera, outline, middle)[:, free], precision(outline.shift)
    normal = (rows * trust[:, None]).T @ rows
    normal += 1e-6 * np.diag(np.diag(normal))
    step = np.zeros(6)
    step[free] = np.linalg.solve(normal, rows.T @ (trust * outline.shift))
    return after_motion(camera, step, middle)


def by_motion(camera: Camera, outline: Outline, middle: np.ndarray) -> np.ndarray:
    """Derivatives (N, 6) of the outline's place across itself, in pixels, by a motion of what is
    seen: turns about `middle` (3,) and translations, both in the camera's axes."""
    x, m = outline.point, outline.outward * [camera.fx, camera.fy]
    across = np.stack([m[:, 0], m[:, 1], -(m * x[:, :2]).sum(1) / x[:, 2]], -1) / x[:, 2:]
    return np.concatenate([np.cross(x - middle, across), across], 1)


def after_motion(camera: Camera, step: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """The camera's pose (4, 4) from which it looks as if what is seen had made the motion `step`
    (6,), see `by_motion`."""
    motion = np.eye(4)
    motion[:3, :3] = exp_so3(step[:3])
    motion[:3, 3] = middle + step[3:] - motion[:3, :3] @ middle
    return np.asarray(camera.world_from_camera, np.float64) @ np.linalg.inv(motion)


def spread_of(shift: np.ndarray) -> float:
    """The robust spread of samples (N,), as a standard deviation."""
    return 1.48 * float(np.median(np.abs(shift - np.median(shift))))


def precision(shift: np.ndarray, spread: float | None = None, far: float = FAR) -> np.ndarray:
    """The weight of each sample, by its own size against `far` and by the spread of all, their own
    where none is given (in pixels)."""
    spread = max(spread_of(shift) if spread is None else spread, SURE)
    return 1 / (spread * (1 + (shift / far) ** 2)) ** 2


def moved_along_normals(mesh: Mesh, distance: np.ndarray) -> Mesh:
    """The mesh with its vertices moved by `distance` (V,) along their normals, which turn as the
    faces do."""
    before = vertex_normals(mesh)
    out = replace(
        mesh, vertices=(mesh.vertices + distance[:, None] * mesh.normals).astype(np.float32)
    )
    normals = mesh.normals + vertex_normals(out) - before
    return replace(
        out,
        normals=(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)).astype(
            np.float32
        ),
    )


def outline_of(
    mesh: Mesh, scene, camera: Camera, mask: np.ndarray, known: np.ndarray | None = None
) -> Outline:
    """The outline of the mesh in one photo, where the mask is known (everywhere for None)."""
    coverage, at, depth, face, uv = covered_by(mesh, scene, camera, mask)
    corners = mesh.faces[face]
    weights = np.stack([1 - uv.sum(1), uv[:, 0], uv[:, 1]], -1)
    normal = (mesh.normals[corners] * weights[..., None]).sum(1) @ np.asarray(
        camera.world_from_camera
    )[:3, :3]
    ray = np.stack([(at[:, 0] - camera.cx) / camera.fx, (at[:, 1] - camera.cy) / camera.fy], -1)
    z = depth / np.sqrt(1 + (ray**2).sum(1))
    outward = -np.stack([looked_up(c, at) for c in slope_of(coverage)], -1)
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9)
    size = ((normal[:, :2] - ray * normal[:, 2:]) * outward).sum(
        1
    )  # z d(picture) / d(displacement)
    places = at[:, None] + np.arange(-REACH, REACH + 0.01, STRIDE)[:, None] * outward[:, None]
    shift = looked_up(mask - coverage, places).sum(1) * STRIDE
    use = (
        (size > SIDEWAYS)
        & (places > 1).all((1, 2))
        & (places < [camera.width - 1, camera.height - 1]).all((1, 2))
    )
    if known is not None:
        use &= looked_up(known, places).min(1) > 0.99
    point = np.concatenate([ray, np.ones((len(ray), 1))], 1) * z[:, None]
    scale = size * 0.5 * (camera.fx + camera.fy) / z
    return Outline(*(part[use] for part in (corners, weights, point, outward, scale, shift)))


def covered_by(mesh: Mesh, scene, camera: Camera, mask: np.ndarray):
    """coverage (H, W) of the pixels by the mesh, exact to 1 / SUB^2 along its outline and where the
    mask differs; and the rays that just
    meet it: positions (N, 2) in pixels, distance (N,), face (N,), barycentrics (N, 2)."""
    left, top, right, bottom = box_of(mesh, camera, mask)
    y, x = (part.ravel() for part in np.mgrid[top:bottom, left:right])
    covered = np.zeros(mask.shape, np.uint8)
    covered[top:bottom, left:right] = np.isfinite(
        trace_rays(scene, camera, x + 0.5, y + 0.5)[0]
    ).reshape(bottom - top, right - left)
    edge = cv2.dilate(covered, CROSS) - cv2.erode(covered, CROSS)
    y, x = np.nonzero(cv2.dilate(edge, CROSS) | (np.abs(mask - covered) > 0.02))
    part = (np.arange(SUB) + 0.5) / SUB
    at = np.stack(
        np.broadcast_arrays(x[:, None, None] + part, y[:, None, None] + part[:, None]), -1
    ).reshape(-1, 2)
    depth, face, uv = trace_rays(scene, camera, *at.T)
    hit = np.isfinite(depth)
    coverage = covered.astype(np.float32)
    coverage[y, x] = hit.reshape(-1, SUB * SUB).mean(1)
    fine = np.repeat(np.repeat(covered, SUB, 0), SUB, 1)
    column, row = (at.T * SUB).astype(np.int64)
    fine[row, column] = hit
    border = hit & (cv2.erode(fine, CROSS)[row, column] == 0)
    return coverage, at[border], depth[border], face[border], uv[border]


def looked_up(picture: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Values of a picture (H, W) at positions (..., 2) in pixels, bilinear."""
    return map_coordinates(picture, [at[..., 1] - 0.5, at[..., 0] - 0.5], order=1, mode="nearest")


def slope_of(coverage: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """d/dx and d/dy of the coverage, blurred by a pixel."""
    blurred = cv2.GaussianBlur(coverage, (7, 7), 1.0)
    return cv2.Sobel(blurred, cv2.CV_32F, 1, 0, ksize=1), cv2.Sobel(
        blurred, cv2.CV_32F, 0, 1, ksize=1
    )


def box_of(mesh: Mesh, camera: Camera, mask: np.ndarray) -> tuple[int, int, int, int]:
    """left, top, right, bottom of the pixels that show the mesh or the mask, with a margin."""
    pose = np.linalg.inv(camera.world_from_camera)
    p = mesh.vertices @ pose[:3, :3].T + pose[:3, 3]
    p = p[p[:, 2] > 1e-3]
    x, y = camera.fx * p[:, 0] / p[:, 2] + camera.cx, camera.fy * p[:, 1] / p[:, 2] + camera.cy
    rows, columns = np.nonzero(mask.any(1))[0], np.nonzero(mask.any(0))[0]
    x, y = np.append(x, columns), np.append(y, rows)
    low = np.clip([x.min() - MARGIN, y.min() - MARGIN], 0, [camera.width, camera.height]).astype(
        int
    )
    high = np.clip([x.max() + MARGIN, y.max() + MARGIN], 0, [camera.width, camera.height]).astype(
        int
    )
    return *low, *high


def trace_rays(scene, camera: Camera, x: np.ndarray, y: np.ndarray):
    """Distance (infinite where nothing is met), face and its barycentrics (N, 2) along the rays
    through pixel positions."""
    if len(x) == 0:
        return np.zeros(0, np.float32), np.zeros(0, np.uint32), np.zeros((0, 2), np.float32)
    o, d = rays_through(mi.Float(camera_rows([camera])), mi.UInt32(0), mi.Float(x), mi.Float(y))
    met = scene.ray_intersect_preliminary(mi.Ray3f(mi.Point3f(o), d), coherent=True)
    hit = met.is_valid()
    t = dr.select(hit, met.t, dr.inf)
    dr.eval(t, met)
    return np.array(t), np.array(met.prim_index), np.array(met.prim_uv).T


def solve(mesh: Mesh, outlines: list[Outline]) -> np.ndarray:
    """Displacements (V,) of the vertices along their normals by weighted least squares in pixels.

    The more the photos contradict one another (masks made by hand or by threshold), the less each
    of them moves.
    """
    n = len(mesh.vertices)
    joined = lambda name: np.concatenate([getattr(o, name) for o in outlines])  # noqa: E731
    corners, weights, scale, shift = (
        joined(name) for name in ("corners", "weights", "scale", "shift")
    )
    if not len(shift):
        return np.zeros(n)
    typical = float(np.median(scale))
    trust = precision(shift)
    rows = np.repeat(np.arange(len(shift)), 3)
    a = coo_matrix(
        ((weights * (scale / typical)[:, None]).ravel(), (rows, corners.ravel())), (len(shift), n)
    ).tocsr()
    smooth = laplacian(mesh.faces, n)
    normal = a.T @ diags(trust) @ a + STIFF * (smooth.T @ smooth) + REST * identity(n)
    d, _ = cg(normal, a.T @ (trust * shift), rtol=1e-5, maxiter=500, M=diags(1 / normal.diagonal()))
    return np.clip(d, -FARTHEST, FARTHEST) / typical


def laplacian(faces: np.ndarray, count: int):
    """Each vertex less the mean of its neighbours (count, count), sparse."""
    i, j = edges(faces).T
    links = coo_matrix(
        (np.ones(2 * len(i)), (np.concatenate([i, j]), np.concatenate([j, i]))), (count, count)
    ).tocsr()
    links.data[:] = 1.0
    degree = np.maximum(np.asarray(links.sum(1)).ravel(), 1)
    return identity(count) - diags(1 / degree) @ links

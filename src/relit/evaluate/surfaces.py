"""How far two surfaces are from each other, where cameras can see them."""

from __future__ import annotations

import numpy as np

from relit.conventions import move_points, similarity
from relit.errors import UserError
from relit.evaluate import metrics as m
from relit.evaluate.definitions import SURFACE_SAMPLES
from relit.evaluate.truth import Truth
from relit.scene import Camera, Mesh


def visible(mesh: Mesh, world_from_asset, points: np.ndarray, cameras: list[Camera]) -> np.ndarray:
    """(N,) bool: whether the segment from a world point (N, 3) on the mesh to some camera's centre
    is free of the mesh.

    Segments start 1e-4 of the mesh's extent off the point, towards the camera.
    """
    import drjit as dr
    import mitsuba as mi

    from relit.reference.mitsuba_scene import build_geometry

    world = move_points(world_from_asset, mesh.vertices)
    low, high = world.min(0), world.max(0)
    unit_from_world = similarity(
        np.eye(3), -(low + high) / np.ptp(world, axis=0).max(), 2 / np.ptp(world, axis=0).max()
    )
    vertices = move_points(unit_from_world, world).astype(np.float32)
    scene = build_geometry(
        Mesh(vertices, mesh.faces, np.zeros_like(vertices))
    )  # queries look at no shading normal
    start, gap = move_points(unit_from_world, points).astype(np.float32), 2e-4
    p, seen = (
        mi.Point3f(*[mi.Float(np.ascontiguousarray(start[:, k])) for k in range(3)]),
        dr.zeros(mi.Bool, len(start)),
    )
    for camera in cameras:
        centre = mi.Point3f(
            *[dr.opaque(mi.Float, float(x)) for x in move_points(unit_from_world, camera.centre)]
        )
        d = mi.Vector3f(centre - p)
        length = dr.norm(d)
        d /= length
        seen = seen | ~scene.ray_test(mi.Ray3f(p + gap * d, d, length - gap, 0.0, []))
        dr.eval(seen)
    return seen.numpy().astype(bool)


def chamfer_figures(
    mesh: Mesh, world_from_asset, truth: Truth, count: int = SURFACE_SAMPLES
) -> dict[str, float]:
    """The Chamfer figures between the surfaces that cameras can see (`DEFINITIONS['chamfer']`)."""
    import trimesh

    cameras = [*truth.train.values(), *truth.test.values()]
    loaded = trimesh.load(truth.folder / "truth" / "mesh.ply", process=False)
    true_mesh = Mesh(np.asarray(loaded.vertices, np.float32), np.asarray(loaded.faces, np.int32))
    samples = []
    for i, (each, frame) in enumerate(((mesh, world_from_asset), (true_mesh, np.eye(4)))):
        surface = m.sample_surface(move_points(frame, each.vertices), each.faces, count, seed=i)
        seen = visible(each, frame, surface.points, cameras)
        if not (seen & surface.uniform).any():
            raise UserError(
                "no part of the mesh can be seen by any camera",
                "it lies elsewhere than the cameras look, or is empty",
            )
        samples.append(surface.only(seen))
    mean, accuracy, completeness = m.chamfer(*samples)
    return {
        "chamfer": mean,
        "chamfer_percent": 100 * mean / (2 * truth.radius),
        "chamfer_accuracy": accuracy,
        "chamfer_completeness": completeness,
    }

"""Mirrored rays: where they go, which of them count, and that they bound what no view shows."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh
from scipy.ndimage import binary_dilation, binary_erosion

from relit.conventions import similarity
from relit.fit.duplicates.mirrored_silhouettes import (
    MirroredRays,
    Symmetry,
    even_pixels,
    find_symmetry,
    mirrored_rays,
    mirrored_views,
)
from relit.fit.duplicates.pose_passes import bounded_from_one_side
from relit.fit.passes.optimiser import NoStage
from relit.fit.passes.pixels import RayBatch
from relit.fit.passes.volume import VolumeOptions, fit_volume, start_model
from relit.fit.registration.instances.views import carved, pixel_bank, views_of
from relit.fit.shape.outlines import trace_rays
from relit.geometry.mesh import extract_mesh
from relit.geometry.sdf import dense_values
from relit.geometry.se3 import exp_so3
from relit.geometry.symmetry import Plane
from relit.records import from_arrays, to_arrays
from relit.reference.mitsuba_scene import build_geometry
from relit.scene import Camera, Mesh

SIDE = 80
ACROSS = Plane(np.array([1.0, 0.0, 0.0]), 0.0)


def body(*parts) -> Mesh:
    """Ellipsoids (semi-axes, middle) as one mesh."""
    balls = [
        trimesh.creation.icosphere(subdivisions=3).apply_scale(axes).apply_translation(at)
        for axes, at in parts
    ]
    whole = trimesh.util.concatenate(balls)
    return Mesh(
        np.asarray(whole.vertices, np.float32),
        np.asarray(whole.faces, np.int32),
        np.asarray(whole.vertex_normals, np.float32),
    )


def around(angles) -> np.ndarray:
    """Poses of cameras that are turned by `angles` (degrees about +y)."""
    turns = [exp_so3(np.array([0.0, np.radians(a), 0.0])) for a in angles]
    return np.array([similarity(turn, -4.0 * turn[:, 2]) for turn in turns])


def views_of_mesh(mesh: Mesh, angles) -> tuple[list, np.ndarray]:
    """Grey views of a mesh, turned by `angles` (degrees about +y), and their poses."""
    camera = Camera(SIDE, SIDE, 200.0, 200.0, SIDE / 2, SIDE / 2, np.eye(4))
    x, y = (a.ravel() + 0.5 for a in np.meshgrid(np.arange(SIDE), np.arange(SIDE)))
    views, poses = [], around(angles)
    for k, pose in enumerate(poses):
        mask = np.isfinite(
            trace_rays(build_geometry(mesh), camera.with_pose(pose), x, y)[0]
        ).reshape(SIDE, SIDE)
        views += views_of(
            np.repeat(0.4 * mask[..., None], 3, -1).astype(np.float32),
            mask.astype(np.int32) * (k + 1),
            camera,
            10**6,
        )
    return views, poses


def test_rays_are_mirrored_and_only_the_others_move_poses():
    plane = Plane(np.array([0.6, 0.0, 0.8]), 0.25)
    rays = MirroredRays(mi.Vector3f(*plane.normal.tolist()), mi.Float(plane.offset), mi.UInt32([0]))
    rng = np.random.default_rng(0)
    o, d = rng.standard_normal((2, 6, 3)).astype(np.float32)
    start = mi.Float(o[:, 0])
    dr.enable_grad(start)
    batch = RayBatch(mi.Vector3f(start, o[:, 1], o[:, 2]), mi.Vector3f(d.T), None, None, None, None)
    which = np.array([True, False, True, True, False, False])
    rays.turned(batch, mi.Bool(which))
    m = plane.mirror
    assert np.allclose(
        np.array(batch.o).T, np.where(which[:, None], o @ m[:3, :3].T + m[:3, 3], o), atol=1e-6
    )
    assert np.allclose(np.array(batch.d).T, np.where(which[:, None], d @ m[:3, :3].T, d), atol=1e-6)
    dr.backward(dr.sum(batch.o.x))
    assert np.allclose(np.array(dr.grad(start)), np.where(which, 0, 1))


def test_every_third_ray_is_drawn_from_the_pixels_that_count():
    rays = MirroredRays(mi.Vector3f(1, 0, 0), mi.Float(0), mi.UInt32([7, 8, 9]))
    pixel, mirrored = rays.drawn(mi.UInt32(np.full(3000, 100, np.uint32)), mi.PCG32(size=3000))
    pixel, mirrored = np.array(pixel), np.array(mirrored)
    assert mirrored.sum() == 1000 and (pixel[~mirrored] == 100).all()
    counts = np.bincount(pixel[mirrored])[7:]
    assert counts.sum() == 1000 and counts.min() > 250


def test_what_one_side_alone_has_is_left_out():
    main, arm = ((0.35, 0.5, 0.4), (0, 0, 0)), ((0.12, 0.12, 0.12), (0.45, 0.1, 0))
    lopsided = body(main, arm)
    views, poses = views_of_mesh(lopsided, [0])
    even = even_pixels(Symmetry(ACROSS, lopsided), views[0], poses[0])
    view = views[0]
    scale = view.camera.fx / 4
    row, left, right = (
        round(scale * at + middle)
        for at, middle in ((0.1, view.camera.cy), (-0.5, view.camera.cx), (0.5, view.camera.cx))
    )
    assert not even[row, left] and not even[row, right]
    assert even[int(view.camera.cy), int(view.camera.cx)] and even.mean() > 0.6
    both = body(main, arm, ((0.12, 0.12, 0.12), (-0.45, 0.1, 0)))
    views, poses = views_of_mesh(both, [0])
    even, own = even_pixels(Symmetry(ACROSS, both), views[0], poses[0]), views[0].mask > 0.5
    assert np.array_equal(
        ~even, binary_dilation(own) & ~binary_erosion(own)
    )  # along outlines alone
    bank = pixel_bank(views, poses)
    shown, there = mirrored_views(Symmetry(ACROSS, both), views, poses)
    assert (
        dr.width(mirrored_rays(Symmetry(ACROSS, both), bank, shown).pixels)
        == dr.width(bank.candidates) - (~even).sum()
    )
    assert np.allclose(there[0][:3, 3], poses[0][:3, 3] * [-1, 1, 1]) and np.linalg.det(
        there[0][:3, :3]
    ) == pytest.approx(-1)
    nothing = [replace(v, known=np.zeros_like(v.known)) for v in shown]
    assert mirrored_rays(Symmetry(ACROSS, both), bank, nothing) is None


@pytest.mark.slow
def test_an_even_mesh_has_its_plane_and_a_lopsided_one_none():
    two = body(
        ((0.3, 0.5, 0.4), (0, 0, 0)),
        ((0.1, 0.1, 0.5), (0, 0.3, 0.3)),
        ((0.3, 0.1, 0.1), (0, -0.4, 0.2)),
    )
    large, small = ([SimpleNamespace(mask=np.zeros((40, side)))] for side in (134, 133))
    poses = around(
        [0, 40]
    )  # mirrored at x = 0 the second one looks from 40 degrees beyond the first
    found = find_symmetry(two, large, poses)
    assert (
        found is not None and abs(found.plane.normal[0]) > 0.999 and abs(found.plane.offset) < 0.005
    )
    assert find_symmetry(two, small, poses) is None
    first, next_one = SimpleNamespace(symmetry=None), SimpleNamespace(symmetry=found)
    assert bounded_from_one_side(two, found, None) and bounded_from_one_side(two, found, first)
    assert not bounded_from_one_side(two, found, next_one) and not bounded_from_one_side(
        two, None, None
    )
    round_one = body(((0.3, 0.5, 0.3), (0, 0, 0)))  # its mirror images show nothing new
    assert not bounded_from_one_side(round_one, Symmetry(ACROSS, round_one), None)
    kept = from_arrays(Symmetry, to_arrays(found))
    assert np.array_equal(kept.plane.mirror, found.plane.mirror)
    assert np.array_equal(kept.mesh.faces, two.faces) and build_geometry(kept.mesh) is not None
    crooked = body(
        ((0.3, 0.5, 0.4), (0, 0, 0)),
        ((0.4, 0.1, 0.1), (0.4, 0.4, 0)),
        ((0.1, 0.1, 0.5), (-0.2, -0.3, 0.4)),
        ((0.1, 0.5, 0.1), (0.2, -0.4, -0.4)),
    )
    assert find_symmetry(crooked, large, poses) is None
    assert (
        find_symmetry(two, large, around([-70, -40, -25, 0, 30, 65])) is None
    )  # what mirrored views show is seen already


@pytest.mark.slow
def test_views_from_one_side_bound_the_other_one_too():
    mesh = body(((0.35, 0.5, 0.5), (0, 0, 0)))
    views, poses = views_of_mesh(mesh, [20, 60, 110])
    symmetry = Symmetry(ACROSS, mesh)
    shown, _ = mirrored_views(symmetry, views, poses)

    def volume(mirrored: bool) -> float:
        bank = pixel_bank(views, poses)
        model = start_model(carved(views, poses, 32, 0.0, 2.5), np.full(3, 0.4), None, full=False)
        model.mirrored = mirrored_rays(symmetry, bank, shown) if mirrored else None
        fit_volume(bank, model, VolumeOptions((32,), (120,), 2048), NoStage(), 0)
        found = extract_mesh(dense_values(model.grid))
        return trimesh.Trimesh(found.vertices, found.faces, process=False).volume

    true = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).volume
    assert volume(False) > 1.08 * true and volume(True) == pytest.approx(true, rel=0.03)

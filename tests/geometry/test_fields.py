"""Hull, distance field, fusion, mesh, atlas."""

import numpy as np
import pytest
import trimesh

from relit.errors import UserError
from relit.fit.passes.volume import next_level, start_model
from relit.geometry.atlas import cells, unwrap
from relit.geometry.bake import fill_gutters, interpolate, rasterise_atlas
from relit.geometry.fusion import fuse_depths
from relit.geometry.hull import distance_of, visual_hull
from relit.geometry.mesh import extract_mesh
from relit.geometry.sdf import (
    dense_values,
    make_grid,
    node_positions,
    redistance,
    resample,
    smoothness_gradient,
)
from relit.scene import Camera
from support.twins.sdf import eikonal_energy


def ball(n: int, radius: float) -> np.ndarray:
    """Signed distance (n, n, n) of a ball around the origin."""
    return (np.linalg.norm(node_positions(n), axis=-1) - radius).astype(np.float32)


def views(count=16, size=64, distance=2.5):
    """Cameras around the origin on a spiral."""
    out = []
    for i in range(count):
        z = 1 - 2 * (i + 0.5) / count
        s = np.sqrt(1 - z * z)
        o = distance * np.array([s * np.cos(2.4 * i), s * np.sin(2.4 * i), z])
        f = -o / np.linalg.norm(o)
        r = np.cross(f, [0.1, 0.2, 1.0])
        r /= np.linalg.norm(r)
        pose = np.eye(4)
        pose[:3, :4] = np.stack([r, np.cross(f, r), f, o], 1)
        out.append(Camera(size, size, 1.3 * size, 1.3 * size, size / 2, size / 2, pose))
    return out


def ray_grid(camera):
    u, v = np.meshgrid(
        (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx,
        (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy,
    )
    d = np.stack([u, v, np.ones_like(u)], -1)
    return (d / np.linalg.norm(d, axis=-1, keepdims=True)) @ camera.world_from_camera[:3, :3].T


def ball_depth(camera, radius):
    """Distance (H, W) to the ball around the origin, inf where a ray misses it."""
    d = ray_grid(camera)
    b = d @ camera.centre
    disc = b * b - (camera.centre @ camera.centre - radius**2)
    return np.where(disc > 0, -b - np.sqrt(np.maximum(disc, 0)), np.inf)


def test_hull_of_a_ball_and_one_bad_mask():
    cameras = views(32)
    masks = [np.isfinite(ball_depth(c, 0.6)).astype(np.float32) for c in cameras]
    inside = visual_hull(cameras, masks, 40) < 0
    truth = ball(40, 0.6) < 0
    assert (inside & truth).sum() > 0.95 * truth.sum()  # masks of 64 pixels cost the rim a little
    assert inside.sum() < 1.25 * truth.sum()
    masks[4] = np.zeros_like(masks[4])
    assert (visual_hull(cameras, masks, 40) < 0).sum() > 0.97 * inside.sum()


def test_hull_of_contradicting_masks_is_an_error():
    cameras = views(8)
    with pytest.raises(ValueError):
        visual_hull(cameras, [np.zeros((64, 64), np.float32)] * 8, 16)


def test_redistance_keeps_the_surface():
    values = ball(48, 0.55) * 3.0  # not a distance
    out = redistance(values)
    p = np.linalg.norm(node_positions(48), axis=-1) - 0.55
    near = np.abs(p) < 2 * 2 / 47
    assert np.abs(out - p)[near].max() < 0.2 * 2 / 47
    assert ((out < 0) == (values < 0)).all()


def test_resample_is_exact_for_linear_fields():
    p = node_positions(9)
    field = 0.3 * p[..., 0] - 0.2 * p[..., 1] + 0.7 * p[..., 2]
    q = node_positions(17)
    np.testing.assert_allclose(
        resample(field, 17), 0.3 * q[..., 0] - 0.2 * q[..., 1] + 0.7 * q[..., 2], atol=1e-5
    )


def test_eikonal_gradient_against_finite_differences():
    import drjit as dr
    import mitsuba as mi

    rng = np.random.default_rng(0)
    values = (ball(12, 0.6) + 0.02 * rng.normal(size=(12, 12, 12))).astype(np.float32)
    grid = make_grid(values, 4, band=np.inf)
    slope = np.array(smoothness_gradient(grid, dr.opaque(mi.Float, 1.0))[0])[1:]
    direction = np.sign(slope).reshape(12, 12, 12)
    energy = [
        eikonal_energy(
            make_grid((values + s * 1e-3 * direction).astype(np.float32), 4, band=np.inf)
        )
        for s in (1, -1)
    ]
    numeric, analytic = (energy[0] - energy[1]) / 2e-3, np.abs(slope).sum()
    assert abs(numeric - analytic) < 0.02 * numeric
    assert dense_values(grid).shape == (12, 12, 12)


@pytest.mark.parametrize("band", [1.5, np.inf])
def test_eikonal_gradient_of_a_narrow_band(band):
    """Each node of the band passes its slope on to those of its neighbours that lie in the band."""
    import drjit as dr
    import mitsuba as mi

    n, rng = 10, np.random.default_rng(1)
    values = (ball(n, 0.6) + 0.02 * rng.normal(size=(n, n, n))).astype(np.float32)
    grid = make_grid(values, 4, band=band)
    inside = np.isin(np.arange(n**3), np.array(grid.nodes)).reshape(n, n, n)
    inner = inside & (np.pad(np.ones((n - 2,) * 3), 1) > 0)
    steps = [
        (np.roll(values, -1, axis) - np.roll(values, 1, axis)) / (2 * grid.h) for axis in range(3)
    ]
    weight = (
        2
        / inside.sum()
        * (1 - 1 / np.maximum(np.sqrt(sum(s**2 for s in steps)), 0.05))
        * inner
        / (2 * grid.h)
    )
    expected = sum(
        np.roll(weight * s, 1, axis) - np.roll(weight * s, -1, axis) for axis, s in enumerate(steps)
    )
    slope = np.array(smoothness_gradient(grid, dr.opaque(mi.Float, 1.0))[0])
    assert slope[0] == 0
    np.testing.assert_allclose(
        slope[1:], expected.ravel()[np.array(grid.nodes)], atol=1e-5 * np.abs(expected).max()
    )


def test_fused_depths_give_the_ball_back():
    cameras = views(24)
    depths = [np.minimum(ball_depth(c, 0.6), 10.0) for c in cameras]
    values = fuse_depths(cameras, depths, 40, truncation=0.12)
    mesh = extract_mesh(values)
    assert abs(np.linalg.norm(mesh.vertices, axis=1).mean() - 0.6) < 0.02


def test_mesh_of_a_ball():
    values = ball(48, 0.6)
    mesh = extract_mesh(values, faces=2000)
    m = trimesh.Trimesh(mesh.vertices, mesh.faces)
    assert m.is_watertight and m.volume > 0
    assert 1500 < len(mesh.faces) < 2500
    r = np.linalg.norm(mesh.vertices, axis=1)
    assert np.abs(r - 0.6).max() < 0.5 * 2 / 47
    assert ((mesh.vertices / r[:, None]) * mesh.normals).sum(1).min() > 0.99


def test_floaters_are_dropped_and_the_cube_is_closed():
    p = node_positions(40)
    values = np.minimum(
        np.linalg.norm(p, axis=-1) - 0.5, np.linalg.norm(p - 0.75, axis=-1) - 0.06
    ).astype(np.float32)
    assert np.linalg.norm(extract_mesh(values).vertices, axis=1).max() < 0.6
    assert trimesh.Trimesh(
        *[getattr(extract_mesh(ball(24, 1.2)), k) for k in ("vertices", "faces")]
    ).is_watertight


def test_no_surface_is_an_error():
    with pytest.raises(UserError) as error:
        extract_mesh(np.ones((16, 16, 16), np.float32))
    assert error.value.code == 4


@pytest.mark.parametrize("how", ["xatlas", "cells"])
def test_atlas(how):
    plain = extract_mesh(ball(24, 0.6), faces=600)
    if how == "xatlas":
        mesh, found = unwrap(plain, 128)
        assert found == "xatlas"
    else:
        mesh = cells(plain, 256)
    assert len(mesh.faces) == len(plain.faces)
    assert mesh.uvs.min() >= 0 and mesh.uvs.max() <= 1
    face, bary = rasterise_atlas(mesh, 256)
    area = (
        0.5
        * np.abs(
            np.cross(*[mesh.uvs[mesh.faces[:, k]] - mesh.uvs[mesh.faces[:, 0]] for k in (1, 2)])
        ).sum()
    )
    assert (
        abs((face >= 0).mean() - area) < 0.25 * area
    )  # overlapping faces would cover less than the sum of their areas
    positions = interpolate(mesh.vertices, mesh.faces, face, bary)
    r = np.linalg.norm(positions[face >= 0], axis=-1)
    assert np.abs(r - 0.6).max() < 0.05


def test_atlas_falls_back(monkeypatch):
    import relit.geometry.atlas as atlas

    monkeypatch.setattr(atlas, "SCRIPT", "import time; time.sleep(60)")
    mesh, how = unwrap(extract_mesh(ball(16, 0.6)), 256, seconds=0.1)
    assert how == "cells" and mesh.uvs is not None


def test_gutters_take_the_nearest_value():
    texture, known = np.zeros((4, 4, 1), np.float32), np.zeros((4, 4), bool)
    texture[1, 1], known[1, 1] = 5, True
    assert (fill_gutters(texture, known) == 5).all()


def test_the_second_level_begins_with_what_is_mended():
    p = node_positions(64)
    hollow = distance_of(np.linalg.norm(p - [0, 0, 0.3], axis=-1) < 0.2)
    model = start_model(
        np.linalg.norm(node_positions(24), axis=-1).astype(np.float32) - 0.3,
        np.full(3, 0.5),
        None,
        full=False,
    )
    next_level(model, 64, 5.0, lambda values: np.maximum(values, -hollow))
    values = dense_values(model.grid)
    inside = (np.linalg.norm(p, axis=-1) < 0.27) & (hollow > 0.03)
    assert (values < 0)[inside].all() and (values >= 0)[hollow < 0].all()
    rim = (np.linalg.norm(p, axis=-1) < 0.3) & (np.abs(hollow) < 0.02)
    assert (np.array(model.grid.index).reshape(values.shape) > 0)[
        rim
    ].all()  # and it is optimised there

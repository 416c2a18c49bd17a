"""Copies of an object and the ground as one mesh; the appearance whose light stands with the
camera."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from relit.conventions import similarity
from relit.fit.passes.pixels import RayBatch, camera_rows
from relit.geometry.se3 import exp_so3, look_at
from relit.reference.mitsuba_scene import build_scene, render_channels
from relit.reference.pile import build_pile, instance_ids
from relit.rendering.appearance.world_light import MAP, SHADE, shade_world, start_world_light
from relit.rendering.march import Marched
from relit.scene import Camera, Ground, Material, Mesh


def cube():
    import trimesh

    box = trimesh.creation.box((1, 1, 1))
    return Mesh(
        np.asarray(box.vertices, np.float32),
        np.asarray(box.faces, np.int32),
        None,
        np.full((8, 2), 0.3, np.float32),
    )


def plain(colour):
    return Material(
        np.full((1, 1, 3), colour, np.float32),
        np.full((1, 1), 0.6, np.float32),
        np.zeros((1, 1), np.float32),
    )


def test_copies_stand_where_they_are_put_on_ground_of_its_own_material():
    ground = Ground(np.zeros(3), np.array([0.0, 1.0, 0.0]), 8.0, np.array([0.1, 0.5, 0.1]), 0.9)
    poses = [
        similarity(np.eye(3), [-1.5, 0.5, 0]),
        similarity(exp_so3(np.array([0, 0.5, 0])), [1.5, 0.5, 0]),
    ]
    pile = build_pile(cube(), plain(0.8), poses, ground)
    scene = build_scene(pile.mesh, pile.material)
    camera = Camera(60, 40, 60.0, 60.0, 30.0, 20.0, look_at([0, 6, 4]))
    ids = instance_ids(scene, pile, camera, samples=1)
    assert set(np.unique(ids)) == {-1, 0, 1}
    for k, pose in enumerate(poses):
        u, v, _ = camera.project(pose[:3, 3])
        assert ids[int(v), int(u)] == k
    shown = render_channels(scene, camera, spp=4)
    assert np.allclose(shown["albedo"][ids >= 0].mean(0), 0.8, atol=0.05)
    free = (ids < 0) & (shown["alpha"] > 0.99)
    assert np.allclose(np.median(shown["albedo"][free], 0), [0.1, 0.5, 0.1], atol=0.02)
    assert np.median(shown["normal"][free] @ [0, 1, 0]) == pytest.approx(1, abs=1e-3)


def rays(count=5):
    rng = np.random.default_rng(0)
    cameras = [
        Camera(8, 8, 9.0, 9.0, 4.0, 4.0, look_at([3, 1, 0.5])),
        Camera(8, 8, 9.0, 9.0, 4.0, 4.0, look_at([-2, 2, 1], roll=1.0)),
    ]
    f = [mi.Float(rng.uniform(0.2, 1, count)) for _ in range(4)]
    n = mi.Vector3f(rng.normal(size=(3, count)))
    m = Marched(
        f, n, mi.Float(rng.uniform(1, 2, count)), mi.Float(np.full(count, 0.05)), mi.UInt32(0)
    )
    d = dr.normalize(mi.Vector3f(rng.normal(size=(3, count))))
    view = mi.UInt32(np.arange(count) % 2)
    return m, RayBatch(mi.Vector3f(0.1), d, None, None, view, view), mi.Float(camera_rows(cameras))


def test_the_light_stands_with_the_camera():
    """The same normal in the photo's frame is shaded the same in every pose of the object."""
    learnt = np.array(start_world_light(0.5, 2)[0])
    learnt[MAP:SHADE] = np.random.default_rng(1).normal(0, 0.3, 27)
    learnt[:MAP] = -20.0
    poses = [look_at([3, 1, 0.5]), look_at([-2, 2, 1], roll=1.0)]
    cameras = mi.Float(camera_rows([Camera(8, 8, 9.0, 9.0, 4.0, 4.0, p) for p in poses]))
    fixed = np.array([0.3, -0.5, -0.8])
    n = np.stack([p[:3, :3] @ fixed for p in poses], 1)
    one = mi.Float([1.0, 1.0])
    m = Marched(
        [one, one, one, mi.Float([0.0, 0.0])],
        mi.Vector3f(n),
        one,
        mi.Float([0.0, 0.0]),
        mi.UInt32(0),
    )
    view = mi.UInt32([0, 1])
    colour, _ = shade_world(
        m,
        RayBatch(mi.Vector3f(0.0), mi.Vector3f(0, 0, 1), None, None, view, view),
        cameras,
        mi.Float(learnt),
    )
    colour = np.array(colour)
    assert np.allclose(colour[:, 0], colour[:, 1], rtol=1e-4) and np.ptp(colour[:, 0]) > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("entry", [40, MAP + 4, MAP + 20, SHADE, SHADE + 2, SHADE + 6])
def test_gradient_of_what_is_learnt(entry):
    m, batch, cameras = rays()
    start = np.array(start_world_light(0.5, 2)[0])
    start += np.random.default_rng(2).normal(0, 0.2, len(start)).astype(np.float32)

    def total(values):
        learnt = mi.Float(values.astype(np.float32))
        dr.enable_grad(learnt)
        colour, _ = shade_world(m, batch, cameras, learnt)
        return dr.sum(colour.x + 2 * colour.y + 3 * colour.z), learnt

    value, learnt = total(start)
    dr.backward(value)
    gradient = np.array(dr.grad(learnt))
    entry = int(np.argmax(np.abs(gradient[:MAP]))) if entry < MAP else entry
    step = np.zeros_like(start)
    step[entry] = 1e-2
    difference = (float(total(start + step)[0][0]) - float(total(start - step)[0][0])) / 2e-2
    assert gradient[entry] == pytest.approx(difference, rel=0.02, abs=1e-3)
    assert difference != 0

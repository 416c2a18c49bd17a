"""Light transport on a mesh: against the reference renderer, and its gradients against finite
differences."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh

from relit.fit.passes.losses import dual_loss
from relit.fit.passes.pixels import camera_rows, rays_through
from relit.lighting.environment import Environment
from relit.materials.field import MaterialField, material_at, pictures
from relit.reference.mitsuba_scene import build_scene, render
from relit.rendering.transport import TraceableMesh, first_hits, reflected, sample_lights
from relit.scene import Camera, Material, Mesh


def ball():
    m = trimesh.creation.icosphere(subdivisions=4, radius=0.6)
    n = np.asarray(m.vertices) / 0.6
    uv = np.stack(
        [np.arctan2(n[:, 1], n[:, 0]) / (2 * np.pi) + 0.5, np.arccos(n[:, 2].clip(-1, 1)) / np.pi],
        -1,
    )
    return Mesh(
        np.asarray(m.vertices, np.float32),
        np.asarray(m.faces, np.int32),
        n.astype(np.float32),
        uv.astype(np.float32),
    )


def camera(size=24):
    pose = np.eye(4)
    pose[:3, :3] = np.diag([1.0, -1.0, -1.0])
    pose[:3, 3] = [0, 0, 2.0]
    return Camera(size, size, 1.4 * size, 1.4 * size, size / 2, size / 2, pose)


def scene(rough=0.4, metal=0.3):
    rng = np.random.default_rng(0)
    light = rng.uniform(0.1, 1.0, (8, 16, 3)).astype(np.float32)
    light[2, 5] = 12.0
    field = MaterialField(
        2,
        mi.Float(np.tile([0.7, 0.4, 0.2, rough], 4)),
        mi.Float(np.full(4, metal, np.float32)),
        dr.zeros(mi.Float, 8),
    )
    return field, Environment.from_image(light), light


def points_of(mesh, cam):
    rows = mi.Float(camera_rows([cam]))
    k = dr.arange(mi.UInt32, cam.width * cam.height)
    o, d = rays_through(
        rows,
        dr.zeros(mi.UInt32, len(k)),
        mi.Float(k % cam.width) + 0.5,
        mi.Float(k // cam.width) + 0.5,
    )
    points = first_hits(mesh, o, d)
    dr.eval(points)
    return points


def estimate(mesh, points, field, environment, count, seed):
    surface = material_at(field, points.uv, points.valid)
    lights = sample_lights(
        mesh, points, surface, environment, count, mi.PCG32(size=dr.width(points.x), initstate=seed)
    )
    return reflected(points, lights, surface, environment)


@pytest.mark.slow
@pytest.mark.parametrize("rough, metal", [(0.6, 0.0), (0.3, 1.0)])
def test_radiance_agrees_with_the_reference_renderer(rough, metal):
    cam, mesh = camera(), ball()
    field, environment, light = scene(rough, metal)
    traceable = TraceableMesh(mesh, np.zeros((len(mesh.vertices), 3)))
    points = points_of(traceable, cam)
    a, b = estimate(traceable, points, field, environment, 512, 1)
    base, roughness, metallic = pictures(field)
    want = render(
        build_scene(mesh, Material(base, roughness, metallic), np.eye(4), light), cam, spp=512
    )[..., :3].reshape(-1, 3)
    inside = np.array(points.valid) & (np.array(dr.dot(points.n, points.v)) > 0.3)
    got = ((np.array(a) + np.array(b)) / 2).T
    assert inside.sum() > 100
    assert abs(got[inside].mean() / want[inside].mean() - 1) < 0.01


def test_the_two_halves_are_independent():
    """The product of their errors has no mean, the square of one does: or the fit would prefer
    materials with less noise."""
    cam, mesh = camera(), ball()
    field, environment, _ = scene(0.4, 0.5)
    traceable = TraceableMesh(mesh, np.zeros((len(mesh.vertices), 3)))
    points = points_of(traceable, cam)
    inside = np.array(points.valid) & (np.array(dr.dot(points.n, points.v)) > 0.3)
    exact = (
        sum(np.array(x).T[inside] for x in estimate(traceable, points, field, environment, 4096, 1))
        / 2
    )
    product, square = [], []
    for seed in range(2, 8):
        a, b = (
            np.array(x).T[inside] - exact
            for x in estimate(traceable, points, field, environment, 16, seed)
        )
        product.append((a * b).mean())
        square.append((a * a).mean())
    assert abs(np.mean(product)) < 0.1 * np.mean(square)


def test_a_blocked_direction_brings_the_blocker_s_radiance():
    lower = trimesh.creation.box(extents=[0.4, 0.4, 0.02])
    upper = trimesh.creation.box(
        extents=[1.6, 1.6, 0.02], transform=trimesh.transformations.translation_matrix([0, 0, 0.1])
    )
    m = trimesh.util.concatenate([lower, upper])
    m.unmerge_vertices()
    n = np.repeat(m.face_normals, 3, axis=0)
    uvs = np.zeros((len(m.vertices), 2), np.float32)
    mesh = Mesh(
        np.asarray(m.vertices, np.float32), np.asarray(m.faces, np.int32), n.astype(np.float32), uvs
    )
    radiance = np.where(np.asarray(m.vertices)[:, 2:] > 0.05, 2.0, 0.0).repeat(3, 1)
    traceable = TraceableMesh(mesh, radiance)
    field = MaterialField(
        2,
        mi.Float(np.tile([0.5, 0.5, 0.5, 1.0], 4)),
        mi.Float(np.zeros(4, np.float32)),
        dr.zeros(mi.Float, 8),
    )
    dark = Environment.from_image(np.full((4, 8, 3), 1e-3, np.float32))
    points = first_hits(traceable, mi.Point3f(0, 0, 0.06), mi.Vector3f(0, 0, -1))
    dr.eval(points)
    a, b = estimate(traceable, points, field, dark, 4096, 3)
    got = (np.array(a) + np.array(b)).mean() / 2
    share = 0.7**2 / (0.7**2 + 0.08**2)  # the plate fills nearly all of the hemisphere
    assert 0.8 * share < got / (0.5 * 2.0) < 1.25


def loss_of(traceable, points, lights, target, field, log_light, height):
    environment = Environment(dr.exp(log_light), height, 2 * height)
    environment.radiance = dr.exp(log_light)
    a, b = reflected(points, lights, material_at(field, points.uv, points.valid), environment)
    return dual_loss(a, b, target, points.valid)


@pytest.mark.parametrize(
    "what, step", [("base", 2e-3), ("roughness", 1e-3), ("metallic", 2e-3), ("light", 2e-3)]
)
def test_gradients_agree_with_finite_differences(what, step):
    cam, mesh = camera(16), ball()
    field, environment, light = scene()
    traceable = TraceableMesh(mesh, np.zeros((len(mesh.vertices), 3)))
    points = points_of(traceable, cam)
    surface = material_at(field, points.uv, points.valid)
    dr.eval(surface.base, surface.roughness, surface.metallic)
    lights = sample_lights(
        traceable, points, surface, environment, 64, mi.PCG32(size=dr.width(points.x), initstate=7)
    )
    target = mi.Color3f(0.3, 0.2, 0.4)
    log_light = mi.Float(np.log(light).ravel())
    params = [field.colour, field.metallic, log_light]
    dr.enable_grad(*params)
    dr.backward(loss_of(traceable, points, lights, target, field, log_light, 8))
    slopes = {
        k: np.array(dr.grad(p))
        for k, p in zip(("colour", "metallic", "light"), params, strict=True)
    }
    channel = np.arange(len(slopes["colour"])) % 4
    key, mask = {
        "base": ("colour", channel < 3),
        "roughness": ("colour", channel == 3),
        "metallic": ("metallic", True),
        "light": ("light", True),
    }[what]
    direction = np.sign(slopes[key]) * mask
    before = {
        "colour": np.array(dr.detach(params[0])),
        "metallic": np.array(dr.detach(params[1])),
        "light": np.array(dr.detach(params[2])),
    }

    def value(s):
        now = dict(before)
        now[key] = (before[key] + s * step * direction).astype(np.float32)
        moved = MaterialField(2, mi.Float(now["colour"]), mi.Float(now["metallic"]), field.slope)
        return float(
            loss_of(traceable, points, lights, target, moved, mi.Float(now["light"]), 8)[0]
        )

    numeric = (value(1) - value(-1)) / (2 * step)
    analytic = float((slopes[key] * direction).sum())
    assert analytic > 0
    assert abs(numeric - analytic) < 0.02 * abs(numeric)

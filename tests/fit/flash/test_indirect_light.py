"""Inter-reflection under an offset flash, in a bowl of rough plastic: the surface pass's term
against Mitsuba's path tracer with its own `roughplastic`, and the first guess of it that is there
before any fit."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from relit.fit.flash.ambient import find_ambient
from relit.fit.flash.features import FlashLamp, FlashPhotos, capture_features, flash_views_of
from relit.fit.passes.pixels import batch_of, make_bank
from relit.geometry.se3 import look_at
from relit.lighting.flash import light_position
from relit.materials.plastic_field import plastic_at, start_plastic
from relit.materials.rough_plastic import IOR, Coat
from relit.rendering.transport import TraceableMesh, first_hits
from relit.rendering.transport_flash import direct, indirect, lit
from relit.scene import Camera, Mesh
from support.flash_ball import OFFSET, ball, bowl

DIFFUSE, SPECULAR, ALPHA = (0.7, 0.5, 0.3), 0.8, 0.2
LIGHT, EYE = (0.5, 2.6, 0.3), (0.0, 2.6, 0.0)
SIDE, SAMPLES = 12, 384


def looking_down():
    """Rays (o, d), SAMPLES through the middle of each of SIDE² pixels, pixel-major."""
    x, z = np.meshgrid(
        np.linspace(-0.497, 0.511, SIDE), np.linspace(-0.509, 0.493, SIDE)
    )  # not along edges
    there = np.stack([x, 0 * x - 0.2, z], -1).reshape(-1, 3)
    d = np.repeat(there - np.array(EYE), SAMPLES, axis=0)
    d = (d / np.linalg.norm(d, axis=1, keepdims=True)).T.astype(np.float32)
    return mi.Point3f(*[float(c) for c in EYE]) + mi.Vector3f(0 * d), mi.Vector3f(d)


def by_mitsuba(mesh: Mesh, o, d, depth: int):
    """As `per_pixel`."""
    rgb = {"type": "rgb", "value": list(DIFFUSE)}
    coat = {
        "type": "roughplastic",
        "distribution": "ggx",
        "alpha": ALPHA,
        "int_ior": IOR,
        "diffuse_reflectance": rgb,
    }
    coat["specular_reflectance"] = {"type": "rgb", "value": [SPECULAR] * 3}
    shape = mi.Mesh(
        "bowl", len(mesh.vertices), len(mesh.faces), has_vertex_normals=True, props=with_bsdf(coat)
    )
    parameters = mi.traverse(shape)
    parameters["vertex_positions"], parameters["vertex_normals"] = (
        mi.Float(mesh.vertices.ravel()),
        mi.Float(mesh.normals.ravel()),
    )
    parameters["faces"] = mi.UInt32(mesh.faces.ravel())
    parameters.update()
    light = {
        "type": "point",
        "position": list(LIGHT),
        "intensity": {"type": "rgb", "value": [1.0, 1.0, 1.0]},
    }
    scene = mi.load_dict({"type": "scene", "bowl": shape, "light": light})
    path = mi.load_dict(
        {"type": "path", "max_depth": depth, "rr_depth": 1000, "hide_emitters": True}
    )
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(depth, dr.width(d))
    colour, _, _ = path.sample(scene, sampler, mi.RayDifferential3f(mi.Ray3f(o, d)))
    return per_pixel(colour)


def with_bsdf(coat: dict):
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(coat)
    return props


def per_pixel(colour):
    """(SIDE², 3) means over each pixel's samples, and what they are uncertain by."""
    values = np.array(mi.Color3f(colour)).T.reshape(SIDE * SIDE, SAMPLES, 3)
    return values.mean(1), values.std(1) / np.sqrt(SAMPLES)


@pytest.fixture(scope="module")
def scene(device):
    mesh = bowl()
    traceable = TraceableMesh(mesh, np.zeros_like(mesh.vertices))
    flat = np.ones((4, 4), np.float32)
    o, d = looking_down()
    dr.eval(o, d)
    return (
        mesh,
        traceable,
        start_plastic(np.array(DIFFUSE) * flat[..., None], SPECULAR * flat, ALPHA * flat),
        o,
        d,
    )


@pytest.mark.slow
@pytest.mark.parametrize("bounces", [1, 2])
def test_against_the_path_tracer(scene, bounces):
    mesh, traceable, field, o, d = scene
    points = first_hits(traceable, o, d)
    dr.eval(points)
    plastic, _ = plastic_at(field, points.uv, points.valid)
    flash, one, coat = mi.Vector3f(*LIGHT), mi.Float(1), Coat()
    straight, _ = per_pixel(
        direct(
            points, plastic, coat, points.n, flash, one, lit(traceable, points, flash, points.valid)
        )
    )
    rng = mi.PCG32(size=dr.width(d), initstate=bounces)
    got, noise = per_pixel(
        indirect(traceable, field, coat, points, plastic, points.n, flash, one, rng, bounces)
    )
    true_direct, _ = by_mitsuba(mesh, o, d, 2)
    true, true_noise = by_mitsuba(mesh, o, d, 2 + bounces)
    assert straight.mean() == pytest.approx(true_direct.mean(), rel=0.01)
    true = true - true_direct
    assert (
        true.mean() > 0.15 * true_direct.mean()
    )  # a third of the light in the bowl comes by way of the bowl
    assert got.mean() == pytest.approx(true.mean(), rel=0.02)
    deviation = (got - true) / np.sqrt(noise**2 + true_noise**2 + (0.02 * true) ** 2)
    assert np.mean(np.abs(deviation) > 3) < 0.02


@pytest.fixture(scope="module")
def photos(scene):
    """(bank, cameras) of 20 photos of the bowl from above, with two bounces, under a flash of
    intensity 6."""
    _, traceable, field, _, _ = scene
    size, count, views = 32, 20, []
    for i in range(count):
        a, r = i * np.pi * (3 - np.sqrt(5)), 1.9 * np.sqrt((i + 0.5) / count)
        views.append(
            Camera(
                size,
                size,
                55.0,
                55.0,
                size / 2,
                size / 2,
                look_at(np.array([r * np.cos(a), 2.3, r * np.sin(a)])),
            )
        )
    blank = make_bank(
        views,
        [np.zeros((size, size, 3), np.float32)] * count,
        [np.ones((size, size), np.float32)] * count,
    )
    batch = batch_of(blank, dr.arange(mi.UInt32, blank.total))
    points = first_hits(traceable, batch.o, batch.d)
    position = light_position(blank.cameras, batch.view, mi.Vector3f(*OFFSET))
    plastic, _ = plastic_at(field, points.uv, points.valid)
    dr.eval(points, position, plastic)
    six, coat = mi.Float(6), Coat()
    total = np.array(
        direct(
            points,
            plastic,
            coat,
            points.n,
            position,
            six,
            lit(traceable, points, position, points.valid),
        )
    )
    for k in range(8):
        rng = mi.PCG32(size=blank.total, initstate=k)
        total = (
            total
            + np.array(
                indirect(traceable, field, coat, points, plastic, points.n, position, six, rng, 2)
            )
            / 8
        )
    hit = np.array(points.valid)
    images = np.where(hit[:, None], total.T, 0).reshape(count, size, size, 3).astype(np.float32)
    return make_bank(
        views, list(images), list(hit.reshape(count, size, size).astype(np.float32))
    ), views


@pytest.fixture(scope="module")
def ambient(scene, photos):
    return find_ambient(*photos, scene[0], Coat(), FlashLamp(np.array(OFFSET), 6.0), max(DIFFUSE))


@pytest.mark.slow
def test_first_colours_do_not_hold_the_bowl_s_own_light(scene, photos, ambient):
    traceable = scene[1]
    bank, views = photos
    flash, coat = FlashLamp(np.array(OFFSET), 6.0), Coat()
    rng = np.random.default_rng(1)
    n = rng.normal(size=(600, 3)) * [1, 0, 1] + [0, 1.5, 0]
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    shown = FlashPhotos(bank, views, traceable, coat, flash)
    without = capture_features(shown, -0.8 * n, n)
    found = capture_features(shown, -0.8 * n, n, ambient)
    assert found.seen.mean() > 0.95
    wrong, right = (np.median(f.albedo[f.seen] / DIFFUSE, axis=0) for f in (without, found))
    assert (
        wrong[0] > 1.25 and wrong[0] > wrong[2] + 0.1
    )  # the brighter the bowl, the more of its own light
    np.testing.assert_allclose(right, 1, atol=0.08)


def test_the_volume_pass_looks_the_light_up_by_place_and_photo(ambient):
    size = 32
    z, y, x = np.meshgrid(*[np.linspace(-1, 1, size)] * 3, indexing="ij")
    distance = (0.8 - np.sqrt(x * x + y * y + z * z)).astype(
        np.float32
    )  # solid outside the bowl's ball
    around = ambient.around(distance, Coat())
    at = np.array([[0.1, -0.79, 0.05], [0.5, -0.62, 0.0]])
    index, weight = ambient.near(at, -at / np.linalg.norm(at, axis=1, keepdims=True))
    expected = (ambient.light[3][index] * weight[..., None]).sum(1)
    got = np.array(around.at(mi.UInt32(3, 3), mi.Point3f(np.ascontiguousarray(at.T, np.float32)))).T
    np.testing.assert_allclose(got, expected, rtol=0.15)
    assert got.min() > 0


def test_a_ball_does_not_light_itself(device):
    mesh = ball(20, 40)
    camera = Camera(16, 16, 25.0, 25.0, 8.0, 8.0, look_at(np.array([0.0, 0.5, 3.0])))
    bank = make_bank(
        [camera] * 3,
        [np.full((16, 16, 3), 0.3, np.float32)] * 3,
        [np.ones((16, 16), np.float32)] * 3,
    )
    assert (
        find_ambient(
            bank, [camera] * 3, mesh, Coat(), FlashLamp(np.array(OFFSET), 6.0), 0.8
        ).light.max()
        < 1e-4
    )


def test_a_flash_that_throws_no_shadow_throws_none_anywhere(scene):
    """A light low beside the bowl: its rim shades the bottom, from photos and from secondary hits,
    unless shadows are switched off."""
    mesh, traceable, field, o, d = scene
    camera = Camera(64, 64, 110.0, 110.0, 32.0, 32.0, look_at(np.array([0.3, 2.4, 0.0])))
    bank = make_bank([camera], [np.ones((64, 64, 3), np.float32)], [np.ones((64, 64), np.float32)])
    low = np.array([2.0, 0.5, 0.0])
    offset = camera.world_from_camera[:3, :3].T @ (low - camera.centre)
    x, n = (
        mi.Vector3f(np.ascontiguousarray(a[mesh.vertices[:, 1] < -0.5].T))
        for a in (mesh.vertices, mesh.normals)
    )
    dr.eval(x, n)
    for lit_only in (False, True):
        dark, bright = (
            np.array(
                flash_views_of(
                    FlashPhotos(bank, [camera], traceable, Coat(), FlashLamp(offset, 1.0, shadow)),
                    0,
                    x,
                    n,
                    lit_only,
                ).ok
            )
            for shadow in (True, False)
        )
        assert bright.mean() > 0.9 and dark.mean() < 0.6
    points = first_hits(traceable, o, d)
    dr.eval(points)
    plastic, _ = plastic_at(field, points.uv, points.valid)
    args = (
        traceable,
        field,
        Coat(),
        points,
        plastic,
        points.n,
        mi.Vector3f(*low.tolist()),
        mi.Float(1),
    )
    shaded, open_ = (
        np.array(indirect(*args, mi.PCG32(size=dr.width(d), initstate=1), 1, shadow)).mean()
        for shadow in (True, False)
    )
    assert open_ > 1.2 * shaded

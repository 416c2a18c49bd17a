"""The reference renderer: orientation, cameras, light, normal maps, furnace, and no compilation
from view to view."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from relit.conventions import sample_environment, similarity
from relit.errors import UserError
from relit.reference.mitsuba_scene import build_scene, environment_bitmap, render, render_channels
from relit.scene import Camera, Material, Mesh

# unit square in the plane z = 0, seen from +z; uv (0, 0) at the top left
QUAD = Mesh(
    np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]], np.float32),
    np.array([[0, 2, 1], [0, 3, 2]], np.int32),
    np.array([[0, 0, 1]] * 4, np.float32),
    np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32),
)


def plain(base=0.5, roughness=0.5, metallic=0.0) -> Material:
    return Material(
        np.full((1, 1, 3), base, np.float32),
        np.full((1, 1), roughness, np.float32),
        np.full((1, 1), metallic, np.float32),
    )


def look_at(position, target=(0, 0, 0), size=32, focal=40.0, offset=(0.0, 0.0)) -> Camera:
    position = np.asarray(position, float)
    z = np.asarray(target, float) - position
    z /= np.linalg.norm(z)
    x = np.cross(z, [0, 1, 0])
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([x, np.cross(z, x), z], 1), position
    return Camera(size, size, focal, focal, size / 2 + offset[0], size / 2 + offset[1], pose)


def sphere(level=3) -> Mesh:
    import trimesh

    s = trimesh.creation.icosphere(level)
    return Mesh(
        s.vertices.astype(np.float32), s.faces.astype(np.int32), s.vertices.astype(np.float32)
    )


def test_textures_are_upright_and_not_mirrored():
    base = np.zeros((2, 2, 3), np.float32)
    base[0, 0], base[0, 1], base[1, 0] = [1, 0, 0], [0, 1, 0], [0, 0, 1]
    material = replace(
        plain(), base_color=base, roughness=np.array([[0.2, 0.4], [0.6, 0.8]], np.float32)
    )
    picture = render_channels(build_scene(QUAD, material), look_at((0, 0, 3)))
    red, green, blue = (picture["albedo"][..., c] for c in range(3))
    assert red[8:13, 8:13].mean() > 0.5
    assert green[8:13, 19:24].mean() > 0.5
    assert blue[19:24, 8:13].mean() > 0.5
    assert (
        picture["roughness"][20, 20]
        > picture["roughness"][20, 11]
        > picture["roughness"][11, 20]
        > picture["roughness"][11, 11]
    )


def test_pixels_land_where_the_camera_projects_them():
    """Coverage of a small square agrees with Camera.project, off-centre principal point and
    similarity included."""
    world_from_asset = similarity(np.diag([1, -1, -1]), [30, 20, -10], 0.05)
    camera = look_at((30.3, 20.2, -10.5), (30.02, 20, -10), size=40, focal=90, offset=(3.5, -2.25))
    channels = render_channels(build_scene(QUAD, plain(), world_from_asset), camera, spp=64)
    alpha, depth = channels["alpha"], channels["depth"]
    corners = QUAD.vertices @ (0.05 * np.diag([1, -1, -1])) + [30, 20, -10]
    xy = camera.project(corners)
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    centre = np.array([(alpha * x).sum(), (alpha * y).sum()]) / alpha.sum()
    a, b = xy[[0, 1, 2, 3], :2], xy[[1, 2, 3, 0], :2]
    cross = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    area = cross.sum() / 2
    assert alpha.sum() == pytest.approx(abs(area), rel=0.01)
    assert np.allclose(centre, ((a + b) * cross[:, None]).sum(0) / (6 * area), atol=0.05)
    inside = alpha == 1
    assert xy[:, 2].min() - 1e-4 < depth[inside].min() < depth[inside].max() < xy[:, 2].max() + 1e-4
    middle = camera.project(np.array([30, 20, -10.0]))
    assert depth[int(middle[1]), int(middle[0])] == pytest.approx(middle[2], rel=0.01)
    assert np.allclose(channels["normal"][inside], [0, 0, -1], atol=1e-4)


def test_environment_is_the_one_of_the_conventions():
    rng = np.random.default_rng(0)
    image = rng.random((6, 10, 3)).astype(np.float32)
    d = rng.normal(size=(3000, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    emitter = build_scene(QUAD, plain(), None, image).mi_scene.environment()
    si = dr.zeros(mi.SurfaceInteraction3f, len(d))
    si.wi = mi.Vector3f(*(-d.T).astype(np.float32))
    assert np.abs(np.array(emitter.eval(si)).T - sample_environment(image, d)).max() < 1e-4
    assert environment_bitmap(image).shape == (13, 10, 3)


def test_light_comes_from_where_it_stands():
    """A lamp at +X lights the right side of a ball seen from +Z, a lamp at +Y its top."""
    for lamp, half in [(np.s_[15:17, 15:17], np.s_[:, 16:]), (np.s_[:1, :], np.s_[:16, :])]:
        light = np.zeros((32, 64, 3), np.float32)
        light[lamp] = 10
        picture = render(build_scene(sphere(2), plain(), None, light), look_at((0, 0, 3)), spp=8)[
            ..., :3
        ].sum(-1)
        assert picture[half].sum() > 0.9 * picture.sum() > 0


@pytest.mark.parametrize(("roughness", "metallic"), [(0.9, 1.0), (0.3, 1.0), (0.6, 0.0)])
def test_white_furnace(roughness, metallic):
    """A white ball in a white room disappears."""
    picture = render(
        build_scene(
            sphere(), plain(1.0, roughness, metallic), None, np.ones((4, 8, 3), np.float32)
        ),
        look_at((0, 0, 3)),
        spp=64,
    )
    assert picture[..., :3].sum() / 3 / picture[..., 3].sum() == pytest.approx(1, abs=0.02)
    assert picture[..., 3].max() == 1
    assert picture[0, 0].max() == 0  # the room is not seen


def test_principled_agrees_on_a_matte_ball():
    light = np.random.default_rng(1).random((4, 8, 3)).astype(np.float32)
    a, b = (
        render(
            build_scene(sphere(), plain(0.5, 0.5), None, light, bsdf=k), look_at((0, 0, 3)), spp=64
        )
        for k in ("relit", "principled")
    )
    inside = a[..., 3] == 1
    assert a[inside].mean() == pytest.approx(b[inside].mean(), rel=0.04)


@pytest.mark.parametrize("bsdf", ["relit", "principled"])
def test_both_sides_of_a_surface_have_its_material(bsdf):
    """A ball whose faces and normals look inwards looks like the ball: meshes of photos without
    masks are open."""
    light = np.random.default_rng(1).random((4, 8, 3)).astype(np.float32)
    ball = sphere()
    inside_out = replace(
        ball, faces=np.ascontiguousarray(ball.faces[:, ::-1]), normals=-ball.normals
    )
    a, b = (
        render(
            build_scene(m, plain(0.5, 0.4, 0.5), None, light, bsdf=bsdf), look_at((0, 0, 3)), spp=64
        )
        for m in (ball, inside_out)
    )
    covered = a[..., 3] == 1
    assert b[covered].mean() == pytest.approx(a[covered].mean(), rel=0.01)
    assert np.abs(a - b)[covered].mean() < 0.05 * a[covered].mean()


def test_inter_reflection_adds_light_and_shadows_take_it():
    """A valley: its two sides light each other and keep each other from the sky."""
    v = np.array(
        [[-1, 1, 1], [-1, 1, -1], [0, 0, 1], [0, 0, -1], [1, 1, 1], [1, 1, -1]], np.float32
    )
    n = np.array([[1, 1, 0]] * 4 + [[-1, 1, 0]] * 4, np.float32) / np.sqrt(2)
    mesh = Mesh(
        v[[0, 2, 3, 1, 2, 4, 5, 3]],
        np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.int32),
        n,
    )
    scene = build_scene(mesh, plain(0.8, 1.0), None, np.ones((4, 8, 3), np.float32))
    camera = replace(look_at((0, 4, 0.01)), fx=80.0, fy=80.0)
    direct, full = (render(scene, camera, spp=64, max_depth=d) for d in (2, 8))
    inside = direct[..., 3] == 1
    assert direct[inside][:, :3].mean() < 0.72
    assert direct[inside][:, :3].mean() + 0.05 < full[inside][:, :3].mean() < 1.0


def test_facets_do_not_shade_themselves():
    """A coarse ball lit from the side by a lamp: along the terminator it looks like a fine ball."""
    light = np.zeros((32, 64, 3), np.float32)
    light[15:17, 15:17] = 200
    camera = look_at((0, 0, 3))
    fine, coarse = (
        render(build_scene(sphere(k), plain(0.8, 0.8), None, light), camera, spp=64)[..., 0]
        for k in (5, 2)
    )
    mitsuba = render(
        replace(build_scene(sphere(2), plain(0.8, 0.8), None, light), origins=None), camera, spp=64
    )[..., 0]
    band = (fine > 0.01 * fine.max()) & (fine < 0.25 * fine.max())
    band[:, :14] = False  # rims, where the silhouettes differ
    band &= np.hypot(*(np.mgrid[:32, :32] - 15.5)) < 9
    assert band.sum() > 10
    ours, theirs = np.abs(coarse - fine)[band].mean(), np.abs(mitsuba - fine)[band].mean()
    assert ours < 0.5 * theirs


def test_normal_map_tilts_to_the_right_and_up():
    """glTF: +R tilts towards +u (right), +G towards the top of the picture; also where the uvs are
    mirrored or turned."""
    for uvs in (QUAD.uvs, QUAD.uvs[:, ::-1], QUAD.uvs * [-1, 1] + [1, 0]):
        mesh = replace(QUAD, uvs=np.ascontiguousarray(uvs, np.float32))
        e1, e2 = mesh.vertices[1] - mesh.vertices[0], mesh.vertices[3] - mesh.vertices[0]
        d1, d2 = mesh.uvs[1] - mesh.uvs[0], mesh.uvs[3] - mesh.uvs[0]
        along_u, along_v = np.linalg.solve(np.stack([d1, d2]), np.stack([e1, e2]))
        n = np.broadcast_to(np.array([0.6, 0.0, 0.8], np.float32), (2, 2, 3))
        for k, expected in ((n, along_u), (n[..., [1, 0, 2]], -along_v)):
            channels = render_channels(
                build_scene(mesh, replace(plain(), normal=k)), look_at((0, 0, 3))
            )
            want = 0.6 * expected / np.linalg.norm(expected) + [0, 0, 0.8]
            assert np.allclose(channels["normal"][16, 16], want, atol=1e-3)


def test_normal_map_looks_like_the_bumps_it_stands_for():
    """A flat sheet with the normal map of a wavy one is lit like it."""
    count = 65
    y, x = np.meshgrid(np.linspace(1, -1, count), np.linspace(-1, 1, count), indexing="ij")
    wave = lambda x, y: 0.02 * np.sin(6 * x + 3 * y)  # noqa: E731
    slope = lambda x, y: 0.02 * np.cos(6 * x + 3 * y)  # noqa: E731
    normals = lambda x, y: np.stack([-6 * slope(x, y), -3 * slope(x, y), np.ones_like(x)], -1)  # noqa: E731
    index = np.arange(count * count).reshape(count, count)
    a, b, c, d = (
        i.ravel() for i in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:])
    )
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).astype(np.int32)
    uvs = np.stack([(x + 1) / 2, (1 - y) / 2], -1).reshape(-1, 2).astype(np.float32)
    unit = lambda n: (n / np.linalg.norm(n, axis=-1, keepdims=True)).astype(np.float32)  # noqa: E731
    wavy = Mesh(
        np.stack([x, y, wave(x, y)], -1).reshape(-1, 3).astype(np.float32),
        faces,
        unit(normals(x, y)).reshape(-1, 3),
        uvs,
    )
    t = (np.arange(128) + 0.5) / 128 * 2 - 1
    texels = unit(normals(t[None, :] + 0 * t[:, None], -t[:, None] + 0 * t[None, :]))
    light = np.random.default_rng(2).random((8, 16, 3)).astype(np.float32) ** 4
    camera = look_at((0.3, 0.4, 3))
    bumps = render(build_scene(wavy, plain(0.8, 0.6), None, light), camera, spp=64)
    mapped = render(
        build_scene(QUAD, replace(plain(0.8, 0.6), normal=texels), None, light), camera, spp=64
    )
    flat = render(build_scene(QUAD, plain(0.8, 0.6), None, light), camera, spp=64)
    inside = (bumps[..., 3] == 1) & (flat[..., 3] == 1)
    error = lambda p: np.sqrt(np.mean((p - bumps)[inside] ** 2))  # noqa: E731
    assert error(mapped) < 0.35 * error(flat)


def test_same_seed_same_picture_and_passes_add_up(monkeypatch):
    scene = build_scene(sphere(2), plain(), None, np.ones((4, 8, 3), np.float32))
    camera = look_at((0, 0, 3))
    once = render(scene, camera, spp=4, seed=3)
    assert np.array_equal(once, render(scene, camera, spp=4, seed=3))
    assert not np.array_equal(once, render(scene, camera, spp=4, seed=4))
    monkeypatch.setattr("relit.reference.mitsuba_scene.RAYS_PER_PASS", 3 * 32 * 32)
    pieces = render(scene, camera, spp=16, seed=3)
    monkeypatch.undo()
    whole = render(scene, camera, spp=16, seed=3)
    assert np.allclose(pieces.mean((0, 1)), whole.mean((0, 1)), rtol=0.02)


def test_a_new_view_compiles_nothing():
    scene = build_scene(sphere(2), plain(), None, np.ones((4, 8, 3), np.float32))
    kernels = []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for k in range(4):
            camera = look_at((np.sin(k), 0.3 * k, 3), focal=40 + k)
            dr.kernel_history()
            render(scene, camera, spp=2, seed=k)
            render_channels(scene, camera, spp=2)
            kernels.append(
                [h["hash"] for h in dr.kernel_history() if h["type"] == dr.KernelType.JIT]
            )
    assert kernels[0]
    assert kernels[1] == kernels[2] == kernels[3]


def test_mistakes_get_an_answer():
    with pytest.raises(UserError, match="unknown bsdf"):
        build_scene(QUAD, plain(), bsdf="phong")
    with pytest.raises(UserError, match="no texture coordinates"):
        build_scene(
            replace(QUAD, uvs=None), replace(plain(), normal=np.ones((2, 2, 3), np.float32))
        )
    with pytest.raises(UserError, match="distortion"):
        render(
            build_scene(QUAD, plain()),
            replace(look_at((0, 0, 3)), distortion=(0.1, 0, 0, 0)),
            spp=1,
        )

"""Material textures: where texels lie, the top row, and that the renderer reads the exported
textures the same way."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from relit.materials.field import MIN_ROUGHNESS, material_at, pictures, project, start_material

S = 8


@pytest.fixture
def field():
    rng = np.random.default_rng(0)
    field = start_material(S, rng.uniform(0.1, 0.9, (S, S, 3)), 0.5, 0.0)
    colour = np.array(field.colour).reshape(S, S, 4)
    colour[..., 3] = rng.uniform(0.2, 0.9, (S, S))
    field.colour, field.metallic = (
        mi.Float(colour.ravel()),
        mi.Float(rng.uniform(0, 1, S * S).astype(np.float32)),
    )
    return field


def look(field, uv):
    uv = np.asarray(uv, np.float32)
    m = material_at(field, mi.Point2f(mi.Float(uv[:, 0].copy()), mi.Float(uv[:, 1].copy())))
    return np.array(m.base).T, np.array(m.roughness), np.array(m.metallic)


def centres():
    x, y = np.meshgrid(np.arange(S), np.arange(S))
    return np.stack([(x.ravel() + 0.5) / S, (y.ravel() + 0.5) / S], -1)


def test_at_texel_centres_it_is_the_texel(field):
    base, roughness, metallic = pictures(field)
    for got, expected in zip(
        look(field, centres()),
        (base.reshape(-1, 3), roughness.ravel(), metallic.ravel()),
        strict=True,
    ):
        np.testing.assert_allclose(
            got, expected, atol=2e-3
        )  # the last row and column mix in a thousandth of their neighbour


def test_v_0_is_the_top_row_of_the_pictures(field):
    base, roughness, metallic = pictures(field)
    u = (np.arange(S) + 0.5) / S
    for v, row in ((0.0, 0), (1.0, S - 1)):
        got = look(field, np.stack([u, np.full(S, v)], -1))
        for value, expected in zip(got, (base[row], roughness[row], metallic[row]), strict=True):
            np.testing.assert_allclose(value, expected, atol=2e-3)


def test_between_centres_it_is_bilinear(field):
    base, _, metallic = pictures(field)
    (got,), _, (metal,) = look(field, [[(2.5 + 0.25) / S, (4.5 + 0.75) / S]])
    w = np.array([[0.75 * 0.25, 0.25 * 0.25], [0.75 * 0.75, 0.25 * 0.75]])
    np.testing.assert_allclose(got, (base[4:6, 2:4] * w[..., None]).sum((0, 1)), atol=1e-5)
    assert metal == pytest.approx((metallic[4:6, 2:4] * w).sum(), abs=1e-5)


def test_the_renderer_reads_the_pictures_where_the_fit_does(field):
    """A square with uv = position, v = 0 at the top: base colour in the picture against the fit's
    look-up at the same uv."""
    from relit.geometry.se3 import look_at
    from relit.reference.mitsuba_scene import build_scene, render_channels
    from relit.scene import Camera, Material, Mesh

    base, roughness, metallic = pictures(field)
    uvs = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    vertices = np.concatenate([2 * uvs - 1, np.zeros((4, 1))], 1).astype(np.float32)
    mesh = Mesh(
        vertices,
        np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        np.tile(np.float32([0, 0, 1]), (4, 1)),
        uvs,
    )
    scene = build_scene(
        mesh, Material(base, roughness, metallic), np.eye(4), np.ones((4, 8, 3), np.float32)
    )
    size, distance = 40, 4.0
    camera = Camera(
        size,
        size,
        size * distance / 2,
        size * distance / 2,
        size / 2,
        size / 2,
        look_at([0, 0, distance]),
    )
    seen = render_channels(scene, camera, spp=64)
    x, y = np.meshgrid(
        (np.arange(size) + 0.5) / size, 1 - (np.arange(size) + 0.5) / size
    )  # pixel rows go down, y goes up
    got, rough, metal = look(field, np.stack([x.ravel(), y.ravel()], -1))
    inner = np.zeros((size, size), bool)
    inner[3:-3, 3:-3] = (
        True  # at the border a texture repeats or not: no texel of an atlas lies there
    )
    for a, b in (
        (seen["albedo"], got.reshape(size, size, 3)),
        (seen["roughness"], rough.reshape(size, size)),
    ):
        difference = np.abs(a - b)[inner]  # a pixel is a mean over a fifth of a texel
        assert difference.mean() < 0.01 and difference.max() < 0.1
    assert np.abs(seen["metallic"] - metal.reshape(size, size))[inner].mean() < 0.01


def test_gradients_of_texels_against_finite_differences(field):
    rng = np.random.default_rng(1)
    uv = rng.uniform(0, 1, (200, 2))
    weight = [mi.Float(rng.normal(size=200).astype(np.float32)) for _ in range(5)]

    def loss(colour, metallic):
        field.colour, field.metallic = colour, metallic
        m = material_at(
            field,
            mi.Point2f(
                mi.Float(uv[:, 0].astype(np.float32)), mi.Float(uv[:, 1].astype(np.float32))
            ),
        )
        values = (m.base.x, m.base.y, m.base.z, m.roughness, m.metallic)
        return sum(dr.sum(w * dr.square(v)) for w, v in zip(weight, values, strict=True))

    start = [np.array(field.colour), np.array(field.metallic)]
    arrays = [mi.Float(a) for a in start]
    dr.enable_grad(*arrays)
    dr.backward(loss(*arrays))
    for k, array in enumerate(arrays):
        g = np.array(dr.grad(array))
        ends = []
        for s in (1, -1):
            moved = [
                a + np.float32(s * 1e-2) * np.sign(g) * (i == k) if i == k else a
                for i, a in enumerate(start)
            ]
            ends.append(float(loss(*[mi.Float(a.astype(np.float32)) for a in moved])[0]))
        assert (ends[0] - ends[1]) / 2e-2 == pytest.approx(np.abs(g).sum(), rel=0.02)


def test_project_keeps_a_material_possible(field):
    rng = np.random.default_rng(2)
    field.colour = mi.Float(rng.normal(0.5, 1, S * S * 4).astype(np.float32))
    field.metallic = mi.Float(rng.normal(0.5, 1, S * S).astype(np.float32))
    before = np.array(field.colour).reshape(S, S, 4)
    project(field)
    base, roughness, metallic = pictures(field)
    np.testing.assert_allclose(base, before[..., :3].clip(0, 1))
    np.testing.assert_allclose(roughness, before[..., 3].clip(MIN_ROUGHNESS, 1))
    assert metallic.min() >= 0 and metallic.max() <= 1

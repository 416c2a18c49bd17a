"""What no photo shows is painted like what is next to it; what one shows stays."""

import numpy as np
import pytest

from relit.geometry.bake import fill_gutters, rasterise_atlas
from relit.scene import Camera

SIZE = 128


@pytest.fixture(scope="module")
def ball():
    """A ball with an atlas, and cameras that see its front alone."""
    import trimesh

    from relit.geometry.atlas import unwrap
    from relit.geometry.se3 import look_at
    from relit.scene import Mesh

    shape = trimesh.creation.icosphere(4, 0.6)
    v = np.asarray(shape.vertices, np.float32)
    mesh, _ = unwrap(Mesh(v, np.asarray(shape.faces, np.int32), v / 0.6), SIZE)
    eyes = np.array([[-0.5, 0.2, 3], [0.5, 0, 3], [0, -0.3, 3]])
    return mesh, [Camera(100, 100, 220.0, 220.0, 50.0, 50.0, look_at(e)) for e in eyes]


def painted(mesh, cameras, red):
    """(textures before, after, positions (S, S, 3), known (S, S)) where base colour is `red` of
    each texel's place, and noise behind."""
    from relit.fit.shape.inpaint import painted_over
    from relit.fit.shape.unseen import seen_faces
    from relit.geometry.bake import interpolate

    face, bary = rasterise_atlas(mesh, SIZE)
    known, at = face >= 0, interpolate(mesh.vertices, mesh.faces, face, bary)
    base = np.repeat(red(at)[..., None], 3, -1).astype(np.float32) * np.array(
        [1, 0.5, 0.25], np.float32
    )
    behind = known & (at[..., 2] < -0.1)
    base[behind] = np.random.default_rng(0).uniform(0, 1, (int(behind.sum()), 3))
    before = {
        "base_color": fill_gutters(base, known),
        "roughness": fill_gutters(np.where(behind, 0.9, 0.3).astype(np.float32), known),
    }
    return before, painted_over(mesh, seen_faces(mesh, cameras), before, face, bary), at, known


def test_back_is_continued_from_the_front(ball):
    before, after, at, known = painted(*ball, lambda p: 0.5 + 0.3 * p[..., 1] / 0.6)
    front, back = known & (at[..., 2] > 0.25), known & (at[..., 2] < -0.25)
    for name in before:
        assert before[name].shape == after[name].shape and after[name].dtype == np.float32
        assert np.array_equal(before[name][front], after[name][front])
    colour, rough = after["base_color"][back], after["roughness"][back]
    assert np.allclose(colour[:, 1], colour[:, 0] / 2, atol=0.01), (
        "no colour that the front has not"
    )
    assert np.abs(rough - 0.3).max() < 0.02
    top, bottom = (after["base_color"][back & (s * at[..., 1] > 0.3)][:, 0].mean() for s in (1, -1))
    assert top - bottom > 0.1, "what is above the rim is continued above, and what is below below"


def test_nothing_changes_where_all_or_nothing_is_seen(ball):
    from relit.fit.shape.inpaint import painted_over

    mesh, _ = ball
    face, bary = rasterise_atlas(mesh, SIZE)
    textures = {
        "base_color": np.random.default_rng(1).uniform(0, 1, (SIZE, SIZE, 3)).astype(np.float32)
    }
    for seen in (True, False):
        assert painted_over(mesh, np.full(len(mesh.faces), seen), textures, face, bary) is textures


def test_part_that_hangs_on_nothing_seen_takes_the_mean(ball):
    from dataclasses import replace

    from relit.fit.shape.inpaint import continued

    mesh, _ = ball
    n = len(mesh.vertices)
    both = replace(
        mesh,
        vertices=np.concatenate([mesh.vertices, mesh.vertices + 5]),
        normals=np.concatenate([mesh.normals] * 2),
        uvs=np.concatenate([mesh.uvs] * 2),
        faces=np.concatenate([mesh.faces, mesh.faces + n]),
    )
    seen = np.repeat([True, False], len(mesh.faces))
    texture = np.full((SIZE, SIZE, 1), 0.4)
    texture[: SIZE // 2] = 0.6
    values = continued(both, seen, texture)
    assert values[:n].min() > 0.399 and values[:n].max() < 0.601
    assert np.ptp(values[n:]) < 1e-3 and 0.4 < values[n, 0] < 0.6


def test_specks_at_the_rim_are_not_carried_over_the_back(ball):
    """A texel in twenty of the front is noise."""
    from relit.fit.shape.inpaint import painted_over
    from relit.fit.shape.unseen import seen_faces

    mesh, cameras = ball
    face, bary = rasterise_atlas(mesh, SIZE)
    seen = seen_faces(mesh, cameras)
    rng = np.random.default_rng(0)
    paint = np.where(
        rng.uniform(size=(SIZE, SIZE, 1)) < 0.05, rng.uniform(size=(SIZE, SIZE, 3)), [0.8, 0.6, 0.1]
    ).astype(np.float32)
    back = (face >= 0) & ~seen[np.maximum(face, 0)]
    off = np.abs(
        painted_over(mesh, seen, {"base_color": paint}, face, bary)["base_color"][back]
        - [0.8, 0.6, 0.1]
    )
    assert off.max() < 0.2

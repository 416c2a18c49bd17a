"""Light from what no photo shows: gathered as the light and the material of a pass are."""

import mitsuba as mi
import numpy as np
import pytest
import trimesh

from relit.fit.duplicates.indirect_light import HiddenLight, hidden_from
from relit.geometry.se3 import look_at
from relit.lighting.environment import Environment
from relit.materials.field import start_material
from relit.rendering.transport import TraceableMesh
from relit.scene import Camera, Mesh

SKY = 0.5  # radiance from everywhere
BASE = 0.6


def mesh_of(*parts) -> Mesh:
    """Of (trimesh, whether it has texels)."""
    vertices = np.concatenate([p.vertices for p, _ in parts])
    starts = np.cumsum([0, *(len(p.vertices) for p, _ in parts)])
    faces = np.concatenate([p.faces + k for (p, _), k in zip(parts, starts, strict=False)])
    normals = np.concatenate([p.vertex_normals for p, _ in parts])
    uvs = np.concatenate(
        [np.full((len(p.vertices), 2), 0.5 if texels else -1.5) for p, texels in parts]
    )
    return Mesh(
        vertices.astype(np.float32),
        faces.astype(np.int32),
        normals.astype(np.float32),
        uvs.astype(np.float32),
    )


def even_light() -> Environment:
    return Environment(mi.Float(np.full(8 * 16 * 3, SKY, np.float32)), 8, 16)


def paint():
    return start_material(4, np.full((4, 4, 3), BASE, np.float32), 1.0, 0.0, f0=0.0)


def floor(half: float, rows: int) -> trimesh.Trimesh:
    x, z = np.meshgrid(*2 * [np.linspace(-half, half, rows + 1)], indexing="ij")
    i = (np.arange(rows)[:, None] * (rows + 1) + np.arange(rows)).ravel()
    faces = np.concatenate(
        [np.stack([i, i + 1, i + rows + 1], 1), np.stack([i + 1, i + rows + 2, i + rows + 1], 1)]
    )
    return trimesh.Trimesh(np.stack([x, 0 * x, z], -1).reshape(-1, 3), faces, process=False)


def test_a_ball_under_an_even_sky_reflects_its_base_colour():
    ball = trimesh.creation.icosphere(subdivisions=3)
    traced = TraceableMesh(mesh_of((ball, True)), np.full((len(ball.vertices), 3), 9.0))
    hidden = ball.vertices[:, 1] < 0
    HiddenLight(traced, hidden, np.zeros(len(hidden), bool)).gather(paint(), even_light(), 0)
    shown = np.array(traced.radiance).reshape(-1, 3)
    assert (shown[~hidden] == 9).all()  # what is seen stays as the photos show it
    assert shown[hidden].mean() == pytest.approx(BASE * SKY, rel=0.03)
    assert np.abs(shown[hidden] - BASE * SKY).max() < 0.1


def test_ground_beneath_a_lid_is_dark_and_takes_its_reflectance_from_where_it_is_seen():
    ground, lid = floor(4, 40), trimesh.creation.box((3, 0.1, 3))
    lid = lid.subdivide_to_size(0.3)
    lid.apply_translation([0, 0.25, 0])
    n = len(ground.vertices)
    traced = TraceableMesh(
        mesh_of((ground, False), (lid, True)), np.full((n + len(lid.vertices), 3), 0.3 * SKY)
    )
    is_ground = np.arange(n + len(lid.vertices)) < n
    under = (np.abs(traced.mesh.vertices[:, [0, 2]]) < 1.4).all(1) & is_ground
    light = HiddenLight(traced, under | ~is_ground, is_ground)
    light.gather(paint(), even_light(), 0)
    shown = np.array(traced.radiance).reshape(-1, 3)
    middle = under & (np.abs(traced.mesh.vertices[:, [0, 2]]) < 0.6).all(1)
    assert shown[middle].mean() < 0.25 * 0.3 * SKY
    away = (np.abs(traced.mesh.vertices[:, [0, 2]]) > 3).any(1) & is_ground
    assert np.allclose(shown[away], 0.3 * SKY)
    below = ~is_ground & (traced.mesh.vertices[:, 1] < 0.25)
    assert shown[below].mean() < shown[~is_ground & ~below].mean()


def test_what_a_camera_sees_is_not_hidden():
    ball, other = (
        trimesh.creation.icosphere(subdivisions=3),
        trimesh.creation.icosphere(subdivisions=3),
    )
    other.apply_translation([0, 0, -4])
    both = mesh_of((ball, True), (other, True))
    traced = TraceableMesh(both, np.ones((len(both.vertices), 3)))
    camera = Camera(64, 64, 60.0, 60.0, 32.0, 32.0, look_at(np.array([0.0, 0.0, 6.0])))
    hidden = hidden_from(traced, [camera])
    assert not hidden[: len(ball.vertices)][ball.vertices[:, 2] > 0.5].any()
    assert hidden[: len(ball.vertices)][ball.vertices[:, 2] < 0].all()
    assert hidden[len(ball.vertices) :].all()  # it stands behind the first one
    beside = Camera(
        64,
        64,
        60.0,
        60.0,
        32.0,
        32.0,
        look_at(np.array([8.0, 0.0, -2.0]), np.array([0.0, 0.0, -2.0])),
    )
    assert not hidden_from(traced, [camera, beside])[len(ball.vertices) :][
        other.vertices[:, 0] > 0.5
    ].any()

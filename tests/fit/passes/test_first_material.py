"""What each place begins as: balls of two materials, metal and paint, glossy and dull."""

from dataclasses import replace

import numpy as np
import pytest

from relit.capture.open import open_capture
from relit.fit.multiview.recipe import MultiviewOptions, reconstruct
from relit.fit.passes import first_material as first
from relit.fit.passes.material_priors import SurfaceOptions
from relit.run import Run
from support import flash_ball

SMALL = MultiviewOptions(
    hollows=0,
    levels=(24, 40),
    level_steps=(60, 60),
    rays=2048,
    faces=2000,
    texture=64,
    surface_steps=400,
    points=512,
    light=16,
)
SIZE = 64


def photographed_ball(out, metallic, roughness):
    """Twenty 64x64 photos of a ball, gold above the equator and red below; metallic, roughness:
    (above, below)."""
    import json

    import trimesh

    from relit.conventions import world_from_gl_camera
    from relit.geometry.se3 import look_at
    from relit.images import write_linear
    from relit.reference.mitsuba_scene import build_scene, render
    from relit.scene import Camera, Material, Mesh

    ball = trimesh.creation.uv_sphere(0.5, count=[32, 32])
    v = np.asarray(ball.vertices, np.float32)
    n = v / np.linalg.norm(v, axis=1, keepdims=True)
    uvs = np.stack(
        [np.arctan2(n[:, 1], n[:, 0]) / (2 * np.pi) + 0.5, np.arccos(n[:, 2].clip(-1, 1)) / np.pi],
        -1,
    ).astype(np.float32)
    base = np.full((16, 16, 3), (0.8, 0.6, 0.2), np.float32)
    base[8:] = (0.6, 0.1, 0.1)
    sides = [
        np.repeat(np.array(a, np.float32), 8)[:, None] * np.ones(16, np.float32)
        for a in (roughness, metallic)
    ]
    light = np.full((16, 32, 3), 0.2, np.float32)
    light[2:5, 4:8], light[6:8, 14:16], light[5:9, 24:26] = (9.0, 8.5, 8.0), 12.0, (4.0, 5.0, 6.0)
    material = Material(base, *sides)
    scene = build_scene(
        Mesh(v, np.asarray(ball.faces, np.int32), n, uvs), material, np.eye(4), light
    )
    (out / "train").mkdir(parents=True)
    frames, focal = [], 0.5 * SIZE / np.tan(np.radians(20))
    for i in range(20):
        z = 1 - 2 * (i + 0.5) / 20
        eye = 2.0 * np.array(
            [np.sqrt(1 - z * z) * np.cos(2.4 * i), np.sqrt(1 - z * z) * np.sin(2.4 * i), z]
        )
        pose = look_at(eye, np.zeros(3), np.array([0, 0, 1.0]))
        picture = render(
            scene, Camera(SIZE, SIZE, focal, focal, SIZE / 2, SIZE / 2, pose), spp=64, seed=i
        )
        write_linear(out / "train" / f"r_{i}.exr", picture)
        frames.append(
            {
                "file_path": f"train/r_{i}.exr",
                "transform_matrix": world_from_gl_camera(pose).tolist(),
            }
        )
    (out / "transforms_train.json").write_text(
        json.dumps({"camera_angle_x": float(np.radians(40)), "frames": frames})
    )
    return out


def found(tmp_path, metallic, roughness=(0.3, 0.3), **options):
    """Mean metallic and roughness that come out, each (above the equator, below it)."""
    capture = open_capture(photographed_ball(tmp_path / "ball", metallic, roughness))
    with Run.open(tmp_path / "run", {}) as run:
        asset = reconstruct(capture, run, replace(SMALL, **options), 0)
    z = (asset.mesh.vertices @ asset.world_from_asset[:3, :3].T)[:, 2] / np.cbrt(
        np.linalg.det(asset.world_from_asset[:3, :3])
    )
    uv = np.clip((asset.mesh.uvs * 64).astype(int), 0, 63)
    maps = [m[uv[:, 1], uv[:, 0]] for m in (asset.material.metallic, asset.material.roughness)]
    return [(m[z > 0.1].mean(), m[z < -0.1].mean()) for m in maps]


@pytest.mark.slow
def test_the_metal_half_is_found(tmp_path):
    (above, below), _ = found(tmp_path, (1.0, 0.0))
    assert above > 0.6 and below < 0.2, (above, below)


@pytest.mark.slow
def test_dull_and_glossy_paint_come_out_as_they_are(tmp_path):
    metallic, (above, below) = found(tmp_path, (0.0, 0.0), (0.7, 0.3), surface_steps=600)
    assert max(metallic) < 0.15, metallic
    assert above > 0.55 and below < 0.45, (above, below)


def test_groups_of_like_colours():
    colour = np.zeros((16, 16, 3), np.float32)
    colour[:, :8], colour[:, 8:] = (0.9, 0.2, 0.2), (0.2, 0.2, 0.9)
    colour += np.random.default_rng(0).normal(0, 0.01, colour.shape).astype(np.float32)
    known = np.ones((16, 16), bool)
    centres, group = first.groups_of(colour, known)
    assert 2 <= len(centres) <= first.GROUPS
    assert not set(group[:, :8].ravel()) & set(group[:, 8:].ravel())


@pytest.mark.parametrize(
    "metal, metallic, dull, taken",
    [
        (0.7, 0.6, 1.1, (True, False)),
        (0.95, 0.6, 1.1, (False, False)),
        (0.7, 0.5, 1.1, (False, False)),  # did not become more of a metal
        (0.7, 0.6, 0.6, (False, True)),  # dull paint explains it better still
        (1.2, 0.4, 0.9, (False, True)),
        (1.2, 0.4, 0.98, (False, False)),
    ],
)
def test_a_group_begins_on_the_side_that_explains_it_clearly_better(metal, metallic, dull, taken):
    """Of two groups the second is best explained as it is; the first loses or gains as given."""
    sides = ((1, 0.1, 50), (metal, metallic, 60), (dull, 0.1, 55))
    fits = [np.array([[100.0 * e, 100 * m, 100], [worse, 5, 100]]) for e, m, worse in sides]
    is_metal, is_dull = first.explained_better(*fits)
    assert (is_metal[0], is_dull[0]) == taken
    assert not is_metal[1] and not is_dull[1]


def test_paint_that_gains_by_the_light_of_a_metal_beside_it_stays_paint():
    """Groups that lose a half, a third and a sixth of their error; alone, the last one is metal."""
    gains = np.array([0.5, 0.33, 0.17])
    paint, dull = (np.stack([e * np.ones(3), [10] * 3, [100] * 3], 1) for e in (100.0, 110.0))
    metal = np.stack([100 * (1 - gains), [80] * 3, [100] * 3], 1)
    assert first.explained_better(paint, metal, dull)[0].tolist() == [True, True, False]
    assert first.explained_better(paint[2:], metal[2:], dull[2:])[0].tolist() == [True]


@pytest.mark.parametrize("other, taken", [(0.8, True), (1.0, False), (1.2, False)])
def test_paint_that_hardly_gains_follows_the_rest_of_the_paint(other, taken):
    """The first group gains 2 % as dull paint, which short fits leave uncertain; the second, twice
    as large, decides, not the metal."""
    pixels = np.array([100, 200, 100])
    as_paint, as_metal, as_dull = ([1.0, 1, 5], [1.1, 1.1, 1], [0.98, other, 4])
    fits = [
        np.stack([100 * np.array(e) * [1, 2, 1], [10, 20, 90], pixels], 1)
        for e in (as_paint, as_metal, as_dull)
    ]
    is_metal, is_dull = first.explained_better(*fits)
    assert list(is_metal) == [False, False, True]
    assert list(is_dull) == [taken, other == 0.8, False]


@pytest.mark.slow
def test_a_dull_start_is_taken_where_the_short_fit_is_better(tmp_path, monkeypatch):
    """What the decision says reaches the pass: everything that is called dull begins so."""
    monkeypatch.setattr(
        first, "explained_better", lambda paint, metal, dull: (paint[:, 0] < 0, paint[:, 0] >= 0)
    )
    _, begun = found(tmp_path, (0.0, 0.0), surface_steps=2)
    assert min(begun) > 0.55, begun


@pytest.mark.slow
@pytest.mark.parametrize("normals, fits", [(False, 2), (True, 3)])
def test_the_fit_that_tells_dull_paint_is_spared_where_nothing_asks_for_it(normals, fits):
    """It is made where texels have normals of their own."""
    bank, _, mesh, _ = flash_ball.capture(size=16, count=4)
    base, known, steps = np.full((8, 8, 3), 0.5, np.float32), np.ones((8, 8), bool), []
    texels = first.TexelStart(base, known, 1.0, base if normals else None)
    options = SurfaceOptions(steps=4, points=256, directions=8)
    metallic, roughness = first.first_material(bank, mesh, texels, options, 0, steps.append)
    assert len(steps) == steps[-1] == fits * 2
    assert (metallic == first.PAINT).all()
    assert np.isin(roughness, [np.float32(options.roughness_start), np.float32(first.DULL)]).all()

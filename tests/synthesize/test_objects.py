"""Objects of a seed: closed shapes, materials that do not follow colour, the same at each call."""

from dataclasses import replace

import numpy as np
import pytest

from relit.asset.gltf import read_asset_file
from relit.cli.main import main
from relit.errors import UserError
from relit.reference.mitsuba_scene import build_scene, render_channels
from relit.synthesize.multiview import object_frame, orbit_cameras
from relit.synthesize.objects import (
    LEAST_ROUGHNESS,
    OBJECT_KINDS,
    ObjectSpec,
    material_of,
    object_file,
    object_spec,
    procedural_object,
    sample,
    texel_points,
)


@pytest.fixture(scope="module")
def objects():
    return {kind: procedural_object(ObjectSpec(5, kind)) for kind in ("blob", "bowl", "thin")}


def material(kind: str, seed: int):
    """A material at random points of one part."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (96, 96, 3)).astype(np.float32)
    return material_of(kind, rng, points, np.zeros((96, 96), int))


@pytest.mark.slow
def test_shapes_are_closed_and_differ_by_kind(objects):
    volume, area = {}, {}
    for kind, (mesh, _) in objects.items():
        corners = mesh.vertices[mesh.faces].astype(np.float64)
        welded = np.unique(np.round(mesh.vertices, 5), axis=0, return_inverse=True)[1][mesh.faces]
        sides = np.sort(np.concatenate([welded[:, [0, 1]], welded[:, [1, 2]], welded[:, [2, 0]]]))
        counts = np.unique(sides, axis=0, return_counts=True)[1]
        assert np.mean(counts == 2) > 0.999, kind
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        volume[kind] = (corners[:, 0] * cross).sum() / 6
        area[kind] = np.linalg.norm(cross, axis=1).sum() / 2
        assert (cross * mesh.normals[mesh.faces].mean(1)).sum(-1).mean() > 0, kind
        assert np.abs(mesh.vertices).max() <= 1
    assert all(v > 0 for v in volume.values())
    thickness = {kind: volume[kind] / area[kind] for kind in objects}
    assert thickness["thin"] < 0.03 < thickness["blob"]
    assert thickness["bowl"] < thickness["blob"]


@pytest.mark.slow
def test_a_bowl_is_hollow_and_holds_things(objects):
    """From above, most of the opening shows a floor or contents below the rim."""
    mesh, _ = objects["bowl"]
    v = mesh.vertices
    rim = v[:, 1] > np.quantile(v[:, 1], 0.98) - 0.3
    inner = np.hypot(v[:, 0], v[:, 2]) < 0.35
    upward = mesh.normals[:, 1] > 0.3
    assert rim.any() and (inner & upward & (v[:, 1] < 0.2)).sum() > 300


def test_gloss_does_not_follow_colour():
    """Over seeds, roughness and luminance correlate as independent fields do, lacquer aside."""
    found = []
    for seed in range(8):
        m = material("blob", seed)
        plain = (m.metallic == 0) & (m.base_color.max(-1) > 0.06)  # no metal, no dark lacquer
        assert m.roughness.min() >= LEAST_ROUGHNESS - 1e-6
        assert np.ptp(m.roughness) > 0.25
        found.append(np.corrcoef(m.roughness[plain], m.base_color[plain].mean(-1))[0, 1])
    assert abs(np.mean(found)) < 0.15


def test_kinds_have_their_materials():
    assert (material("metal", 1).metallic == 1).all()
    gloss = material("gloss", 1)
    assert np.ptp(gloss.roughness) == 0 and gloss.base_color.max() < 0.06
    assert gloss.metallic.max() == 0


@pytest.mark.slow
def test_texels_lie_on_the_surface(objects):
    """A texture of positions shows, through the renderer's look-up, the positions that are hit."""
    mesh, paint = objects["blob"]
    where = texel_points(mesh, 1024) * 0.5 + 0.5
    camera = orbit_cameras(3, 64, seed=1)[1][1]
    frame = object_frame(mesh)
    seen = render_channels(
        build_scene(mesh, replace(paint, base_color=where), frame), camera, spp=16
    )
    inside = seen["alpha"] == 1
    y, x = np.nonzero(inside)
    local = np.stack([(x + 0.5 - camera.cx) / camera.fx, (y + 0.5 - camera.cy) / camera.fy], -1)
    p = np.concatenate([local, np.ones((len(x), 1))], -1) * seen["depth"][inside][:, None]
    world = p @ camera.world_from_camera[:3, :3].T + camera.world_from_camera[:3, 3]
    asset = (world - frame[:3, 3]) @ np.linalg.inv(frame[:3, :3]).T
    error = np.linalg.norm((seen["albedo"][inside] - 0.5) * 2 - asset, axis=-1)
    assert np.median(error) < 0.01


def test_a_field_is_sampled_in_x_y_z():
    a = np.linspace(-1, 1, 9, dtype=np.float32)
    z, y, x = np.meshgrid(a, a, a, indexing="ij")
    points = np.array([[0.1, -0.3, 0.7], [0.9, 0.2, -0.5]], np.float32)
    for k, field in enumerate((x, y, z)):
        np.testing.assert_allclose(sample(field, points), points[:, k], atol=1e-6)


def test_names_of_objects(tmp_path, monkeypatch):
    monkeypatch.setenv("RELIT_CACHE", str(tmp_path))
    assert object_spec("mug.glb") is None and object_file("a/mug.glb").name == "mug.glb"
    assert object_spec("procedural:7") == ObjectSpec(7, OBJECT_KINDS[7 % len(OBJECT_KINDS)])
    for wrong in ("procedural:", "procedural:x", "procedural:1:teapot", "procedural:1:bowl:2"):
        with pytest.raises(UserError):
            object_spec(wrong)


@pytest.mark.slow
def test_the_command_line_takes_a_seed_and_makes_the_same_object(tmp_path, monkeypatch, capsys):
    from relit.images import write_linear

    monkeypatch.setenv("RELIT_CACHE", str(tmp_path / "cache"))
    write_linear(tmp_path / "light.exr", np.ones((8, 16, 3), np.float32))
    words = "--views 2 --test-views 1 --resolution 16 --spp 2 --test-spp 2".split()
    command = ["synthesize", "multiview", "--asset", "procedural:3:gloss", *words]
    command += ["--light", str(tmp_path / "light.exr"), "-o", str(tmp_path / "out")]
    assert main(command) == 0
    assert (tmp_path / "out" / "truth" / "truth.json").is_file()
    assert main([*command[:3], "procedural:3:teapot", *command[4:]]) == 2
    assert "teapot" in capsys.readouterr().err
    file = object_file("data/procedural:3:gloss")
    content = file.read_bytes()
    mesh, paint = read_asset_file(file)
    assert len(mesh.faces) > 5000 and paint.base_color.max() < 0.06
    file.unlink()
    assert object_file("procedural:3:gloss").read_bytes() == content

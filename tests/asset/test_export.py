"""Other forms of the asset say the same."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest

from relit.asset.asset import save_asset
from relit.asset.export import export_asset, write_mitsuba
from relit.asset.gltf import read_asset_file
from relit.conventions import environment_directions, environment_solid_angles, rotate_environment
from relit.errors import UserError
from relit.lighting.spherical_gaussians import environment_of, read_lobes
from relit.reference.mitsuba_scene import build_scene, render
from relit.scene import Flash


@pytest.fixture(scope="module")
def folder(tmp_path_factory, asset):
    asset = replace(asset, material=replace(asset.material, specular=None))
    return save_asset(tmp_path_factory.mktemp("run") / "asset", asset)


def test_glb_and_obj_are_the_same_object(folder, tmp_path):
    export_asset(folder, "glb", tmp_path / "out" / "a.glb")
    files = export_asset(folder, "obj", tmp_path / "obj" / "a.obj")
    assert {p.name for p in files} == {p.name for p in (tmp_path / "obj").iterdir()}
    (m, t), (m2, t2) = (
        read_asset_file(tmp_path / "out" / "a.glb"),
        read_asset_file(tmp_path / "obj" / "a.obj"),
    )
    corners, corners2 = m.vertices[m.faces], m2.vertices[m2.faces]
    assert np.allclose(corners, corners2, atol=1e-5)
    assert np.allclose(m.uvs[m.faces], m2.uvs[m2.faces], atol=1e-5)
    for key in ("base_color", "roughness", "metallic", "normal"):
        assert np.abs(getattr(t, key) - getattr(t2, key)).max() < 0.01
    assert t2.ior == pytest.approx(1.33)


def test_gaussians_light_the_object_from_where_the_environment_did(asset, tmp_path):
    light = np.full((16, 32, 3), 0.2, np.float32)
    light[3:6, 4:8] = (6.0, 4.0, 2.0)  # a window, in the world frame
    light[9:11, 20:22] = (0.5, 2.0, 4.0)
    export_asset(
        save_asset(tmp_path / "asset", replace(asset, environment=light)),
        "gaussians",
        tmp_path / "light.json",
    )
    lobes = read_lobes(tmp_path / "light.json")
    assert len(lobes.sharpness) == 128
    found = rotate_environment(environment_of(lobes, 32, 64), asset.world_from_asset)
    assert not np.allclose(
        asset.world_from_asset[:3, :3], np.diag(np.diag(asset.world_from_asset[:3, :3]))
    )  # a turn that could be lost
    faces = np.concatenate([np.eye(3), -np.eye(3)])

    def irradiance(map_):
        d = environment_directions(*map_.shape[:2]).reshape(-1, 3)
        energy = (map_ * environment_solid_angles(*map_.shape[:2])[..., None]).reshape(-1, 3)
        return np.maximum(faces @ d.T, 0) @ energy

    assert np.abs(irradiance(found) / irradiance(light) - 1).max() < 0.08


def test_an_asset_without_an_environment_has_no_gaussians(asset, tmp_path):
    folder = save_asset(
        tmp_path / "asset", replace(asset, environment=None, flash=Flash(np.zeros(3), np.ones(3)))
    )
    with pytest.raises(UserError, match="no environment light"):
        export_asset(folder, "gaussians", tmp_path / "light.json")


def test_ply_has_the_colours(folder, tmp_path):
    import trimesh

    export_asset(folder, "ply", tmp_path / "a.ply")
    got = trimesh.load(tmp_path / "a.ply", process=False)
    m, _ = read_asset_file(folder / "object.glb")
    assert np.allclose(got.vertices, m.vertices)
    assert np.array_equal(got.faces, m.faces)
    red = np.asarray(got.visual.vertex_colors)[:, 0]
    inside = (m.uvs[:, 0] > 0.05) & (m.uvs[:, 0] < 0.95)
    assert (
        np.corrcoef(red[inside], m.uvs[inside, 0])[0, 1] > 0.97
    )  # the base colour's red grows with u
    assert np.ptp(red) > 100


def test_mitsuba_scene_renders_like_the_asset(folder, asset, tmp_path, load_scene):
    files = export_asset(folder, "mitsuba", tmp_path / "scene")
    assert {"scene.xml", "object.ply", "environment.exr", "base_color.png"} <= {
        p.name for p in files
    }
    scene = load_scene(tmp_path / "scene" / "scene.xml")
    picture = np.array(mi.render(scene, spp=64))
    m, t = read_asset_file(folder / "object.glb")
    ours = render(
        build_scene(m, t, asset.world_from_asset, asset.environment, bsdf="principled"),
        asset.cameras[0][1],
        spp=64,
    )
    inside = ours[..., 3] > 0.999
    assert inside.sum() > 100
    a, b = picture[..., :3][inside].clip(0, 1), ours[..., :3][inside].clip(0, 1)
    assert -10 * np.log10(np.mean((a - b) ** 2)) > 25  # noise; a shift of one pixel costs more
    assert np.abs(a.mean(0) - b.mean(0)).max() < 0.01


@pytest.mark.slow
def test_mitsuba_scene_of_a_rough_plastic_renders_like_the_asset(asset, tmp_path, load_scene):
    from relit.reference.flash_scene import build_flash_scene, render_flash

    size = asset.material.base_color.shape[:2]
    ramp = np.linspace(0.35, 0.65, size[1], dtype=np.float32)[None].repeat(size[0], 0)
    material = replace(
        asset.material,
        roughness=ramp,
        metallic=np.zeros((1, 1), np.float32),
        specular=1.2 - ramp,
        ior=1.49,
        normal=None,
    )
    camera = asset.cameras[0][1]
    flash = Flash(np.array([-0.2, -0.1, 0.0]), np.full(3, 3 * float(np.sum(camera.centre**2))))
    plastic = replace(asset, material=material, flash=flash, environment=None)
    write_mitsuba(tmp_path / "scene", plastic)
    picture = np.array(mi.render(load_scene(tmp_path / "scene" / "scene.xml"), spp=64))[..., :3]
    ours = render_flash(
        build_flash_scene(plastic.mesh, material, plastic.world_from_asset),
        camera,
        flash,
        64,
        max_depth=6,
    )
    inside = ours[..., 3] > 0.999
    a, b = picture[inside].clip(0, 1), ours[..., :3][inside].clip(0, 1)
    assert inside.sum() > 100 and b.max() > 0.3
    assert -10 * np.log10(np.mean((a - b) ** 2)) > 28
    assert np.abs(a.mean(0) - b.mean(0)).max() < 0.01


def test_mistakes_get_an_answer(folder, tmp_path):
    with pytest.raises(UserError, match="Did you mean 'glb'"):
        export_asset(folder, "glbb", tmp_path / "a.glb")
    with pytest.raises(UserError, match="must end in"):
        export_asset(folder, "obj", tmp_path / "a.glb")
    with pytest.raises(UserError, match="not an asset folder"):
        export_asset(tmp_path, "glb", tmp_path / "a.glb")
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "me.jpg").write_bytes(b"x")
    with pytest.raises(UserError, match="something else"):
        export_asset(folder, "mitsuba", tmp_path / "photos")

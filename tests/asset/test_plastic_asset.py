"""The asset of a flash capture: base colour for glTF in the GLB, the diffuse albedo beside it, and
assets from before that was so."""

import json
from dataclasses import replace

import numpy as np
import pytest

from relit.asset.asset import load_asset, save_asset
from relit.asset.export import export_asset
from relit.asset.gltf import read_asset_file
from relit.edit import edit
from relit.errors import UserError
from relit.images import read_data
from relit.materials.plastic_as_gltf import base_colour
from relit.reference.flash_scene import build_flash_scene, render_maps
from relit.scene import Flash


@pytest.fixture(scope="module")
def plastic(asset):
    m = asset.material
    diffuse = (0.9 * m.base_color).astype(np.float32)
    alpha = np.clip(m.roughness, 0.1, 0.6) ** 2
    roughness = np.sqrt(alpha).astype(np.float32)
    base = base_colour(diffuse, roughness, m.specular, 1.49)
    m = replace(
        m,
        base_color=base,
        roughness=roughness,
        metallic=np.zeros((1, 1), np.float32),
        ior=1.49,
        diffuse=diffuse,
    )
    flash = Flash(np.array([0.1, 0, 0]), np.ones(3))
    return replace(
        asset, material=m, environment=None, meta={"material": "rough_plastic"}, flash=flash
    )


@pytest.mark.slow
def test_the_folder_keeps_the_diffuse_albedo(tmp_path, plastic):
    folder = save_asset(tmp_path / "asset", plastic)
    assert (
        json.loads((folder / "asset.json").read_text())["diffuse_albedo"]
        == "textures/diffuse_albedo.exr"
    )
    got = load_asset(folder)
    np.testing.assert_allclose(got.material.diffuse, plastic.material.diffuse, atol=1e-3)
    assert np.abs(got.material.base_color - plastic.material.base_color).max() < 0.006
    assert got.meta == plastic.meta
    again = load_asset(save_asset(tmp_path / "again", got))
    np.testing.assert_array_equal(again.material.diffuse, got.material.diffuse)
    _, alone = read_asset_file(folder / "object.glb")
    assert alone.diffuse is None and np.array_equal(alone.base_color, got.material.base_color)


def test_what_is_measured_is_the_diffuse_albedo(tmp_path, plastic):
    """`relit evaluate` renders maps of the plastic, not of what the GLB says."""
    got = load_asset(save_asset(tmp_path / "asset", plastic))
    camera = plastic.cameras[0][1]
    place = plastic.world_from_asset
    maps = render_maps(build_flash_scene(got.mesh, got.material, place), camera)
    truth = replace(plastic.material, base_color=plastic.material.diffuse, diffuse=None)
    true = render_maps(build_flash_scene(plastic.mesh, truth, place), camera)
    inside = maps["coverage"] > 0.99
    np.testing.assert_allclose(maps["diffuse"][inside], true["diffuse"][inside], atol=3e-3)
    gltf = render_maps(
        build_flash_scene(got.mesh, replace(got.material, diffuse=None), place), camera
    )
    assert (gltf["diffuse"][inside] < true["diffuse"][inside] - 0.01).any()


def test_folders_from_before(tmp_path, plastic):
    """Their GLB holds the diffuse albedo as base colour, and asset.json names no file."""
    m = plastic.material
    folder = save_asset(
        tmp_path / "asset",
        replace(plastic, material=replace(m, base_color=m.diffuse, diffuse=None)),
    )
    assert not (folder / "textures" / "diffuse_albedo.exr").exists()
    got = load_asset(folder).material
    assert np.abs(got.diffuse - m.diffuse).max() < 0.006
    assert np.abs(got.base_color - m.base_color).max() < 0.012


def test_a_lost_diffuse_albedo_is_told(tmp_path, plastic):
    folder = save_asset(tmp_path / "asset", plastic)
    (folder / "textures" / "diffuse_albedo.exr").unlink()
    with pytest.raises(UserError, match=r"diffuse_albedo\.exr is missing"):
        load_asset(folder)


def test_mitsubas_plastic_takes_the_diffuse_albedo(tmp_path, plastic, load_scene):
    folder = save_asset(tmp_path / "asset", plastic)
    export_asset(folder, "mitsuba", tmp_path / "scene")
    text = (tmp_path / "scene" / "scene.xml").read_text()
    assert "textures/diffuse_albedo.exr" in text and "base_color.png" not in text
    np.testing.assert_allclose(
        read_data(tmp_path / "scene" / "textures" / "diffuse_albedo.exr"),
        plastic.material.diffuse,
        atol=1e-3,
    )
    assert load_scene(tmp_path / "scene" / "scene.xml") is not None


def test_editing_keeps_both_together(tmp_path, plastic):
    folder = save_asset(tmp_path / "asset", plastic)
    edit(folder, tmp_path / "tinted", tint=(0.5, 1, 1))
    tinted = load_asset(tmp_path / "tinted").material
    np.testing.assert_allclose(
        tinted.diffuse[..., 0], 0.5 * plastic.material.diffuse[..., 0], atol=1e-3
    )
    edit(folder, tmp_path / "rough", roughness=0.8)
    rough = load_asset(tmp_path / "rough").material
    np.testing.assert_allclose(rough.diffuse, plastic.material.diffuse, atol=1e-3)
    assert rough.base_color.mean() < 0.8 * plastic.material.base_color.mean()
    edit(folder, tmp_path / "painted", base_color=(0.2, 0.1, 0.1))
    painted = load_asset(tmp_path / "painted").material
    expected = base_colour(painted.diffuse, painted.roughness, painted.specular, painted.ior)
    np.testing.assert_allclose(
        expected, np.broadcast_to(painted.base_color, expected.shape), atol=0.01
    )


def test_the_recipe_fills_both(plastic, tmp_path):
    from pathlib import Path

    from relit.fit.flash.recipe import PlasticMaps, assemble
    from relit.scene import Capture, Photo, Sphere

    m = plastic.material
    alpha = m.roughness**2
    maps = PlasticMaps(m.diffuse, m.specular, alpha, m.normal, np.zeros(3), np.ones(1))
    photo = Photo("a.png", None, 48, 48, plastic.cameras[0][1])
    capture = Capture(Path("."), "test", (photo,), sphere=Sphere(np.zeros(3), 1.0))
    made = assemble(capture, plastic.mesh, maps, 1.49)
    np.testing.assert_array_equal(made.material.diffuse, m.diffuse)
    np.testing.assert_allclose(made.material.base_color, m.base_color, atol=1e-6)

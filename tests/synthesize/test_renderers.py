"""Renderers of truth by name, and the ceiling of a capture."""

import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.ndimage import binary_erosion, uniform_filter

from relit.asset.gltf import write_glb
from relit.conventions import environment_directions
from relit.errors import UserError
from relit.images import write_linear
from relit.reference.mitsuba_scene import build_scene, principled_eta, render
from relit.scene import Material, Mesh
from relit.synthesize.ceiling import ceiling_under
from relit.synthesize.multiview import orbit_cameras, settings_of, synthesize_multiview
from relit.synthesize.renderers import (
    DEPTHS,
    RENDERERS,
    TrueObject,
    build_truth,
    depth_of,
    truth_picture,
)


def constant(base=0.5, roughness=0.5, metallic=0.0, specular=None) -> Material:
    return Material(
        np.full((1, 1, 3), base, np.float32),
        np.full((1, 1), roughness, np.float32),
        np.full((1, 1), metallic, np.float32),
        specular=specular,
    )


def ball(level=3) -> Mesh:
    s = trimesh.creation.icosphere(level, radius=0.8)
    n = (s.vertices / 0.8).astype(np.float32)
    return Mesh(s.vertices.astype(np.float32), s.faces.astype(np.int32), n)


@pytest.fixture
def files(tmp_path):
    write_glb(tmp_path / "ball.glb", ball(), constant(0.4, 0.4))
    light = np.full((8, 16, 3), 0.5, np.float32)
    light[1:3, 3:6] = 20
    write_linear(tmp_path / "light.exr", light)
    write_linear(tmp_path / "other.exr", light[:, ::-1])
    return tmp_path / "ball.glb", tmp_path / "light.exr", tmp_path / "other.exr"


def test_each_renderer_has_its_depth():
    assert depth_of("relit", None) == 6  # of all captures there have been
    assert all(DEPTHS[r] >= 10 for r in RENDERERS if r != "relit")
    assert depth_of("cycles", 4) == 4
    with pytest.raises(UserError, match="Did you mean 'mitsuba'"):
        depth_of("mitsubo", None)


def test_settings_name_the_renderer(files):
    asset, light, _ = files
    usual = settings_of(asset, light)
    assert usual["renderer"] == "relit" and usual["max_depth"] == 6
    assert settings_of(asset, light, renderer="mitsuba")["max_depth"] == 10
    assert usual == settings_of(asset, light, renderer="relit", max_depth=6)


def test_principled_has_the_dielectrics_reflectance():
    """A constant specular factor becomes an index of refraction; a texture is refused."""
    factor = np.full((1, 1), 1.58, np.float32)
    eta = principled_eta(constant(specular=factor))
    assert ((eta - 1) / (eta + 1)) ** 2 == pytest.approx(0.04 * 1.58, rel=1e-4)
    assert principled_eta(constant()) == 1.5
    with pytest.raises(UserError, match="specular texture"):
        principled_eta(constant(specular=np.array([[0.5, 1.0]], np.float32)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("material", "mean", "pixels"),
    # Burley's diffuse keeps what the coat reflects; a rough metal without compensation is darker
    [(constant(0.5, 0.6, 0.0), 0.065, 0.075), (constant(0.6, 0.3, 1.0), 0.02, 0.03)],
    ids=["rough dielectric", "metal"],
)
def test_mitsuba_agrees_with_the_own_renderer_under_one_lobe(material, mean, pixels):
    d = environment_directions(32, 64)
    light = 0.4 + 20 * np.exp(60 * (d @ np.array([0.5, 0.6, 0.62]) - 1))[..., None]
    light = np.repeat(light, 3, -1).astype(np.float32)
    thing, camera = TrueObject(ball(4), material, np.eye(4)), orbit_cameras(3, 48)[1][1]
    own, theirs = (
        truth_picture(build_truth(name, thing, light, 10), camera, 256, 10, 1)
        for name in ("relit", "mitsuba")
    )
    inside = binary_erosion(own[..., 3] > 0.999, iterations=3)
    x, y = (uniform_filter(p[..., :3], (3, 3, 0))[inside] for p in (own, theirs))
    assert abs(x.mean() / y.mean() - 1) < mean and np.abs(x - y).mean() / y.mean() < pixels


def test_ceiling_of_a_known_difference(tmp_path):
    """Truth that is the own rendering times a factor: the figure says so, and a gain explains it."""
    thing = TrueObject(ball(4), constant(0.4, 0.5), np.eye(4))
    light = np.full((8, 16, 3), 0.9, np.float32)
    light[:4] = 1.6
    write_linear(tmp_path / "light.exr", light)
    scene = build_scene(ball(4), constant(0.4, 0.5), np.eye(4), light)
    shown = []
    for name, camera in orbit_cameras(2, 32):
        picture = render(scene, camera, spp=256) * np.array([1.2, 1.0, 0.8, 1.0], np.float32)
        write_linear(tmp_path / f"{name}.exr", picture)
        shown.append((tmp_path / f"{name}.exr", camera))
    found = ceiling_under(thing, tmp_path / "light.exr", shown, spp=256, seed=0)
    np.testing.assert_allclose(found["gain"], [1.2, 1.0, 0.8], rtol=0.01)
    assert found["psnr_masked"] < 30 < 35 < found["psnr_masked_gain"]
    assert found["psnr"] > found["psnr_masked"]


@pytest.mark.slow
@pytest.mark.parametrize("renderer", ["relit", "mitsuba"])
def test_a_capture_has_its_ceiling(files, tmp_path, renderer):
    asset, light, other = files
    said: list[str] = []
    out = synthesize_multiview(
        asset,
        light,
        tmp_path / "capture",
        views=2,
        test_views=2,
        relights=[other],
        resolution=32,
        spp=4,
        test_spp=128,
        renderer=renderer,
        say=said.append,
    )
    truth = json.loads((out / "truth" / "truth.json").read_text())
    assert truth["renderer"]["name"] == renderer
    assert set(truth["ceiling"]) == {"definition", "capture", "other"}
    for name in ("capture", "other"):
        figures = truth["ceiling"][name]
        assert min(figures["psnr"], figures["psnr_masked"]) > 28
        assert any(f"ceiling under {name}" in line for line in said)
    if renderer == "relit":
        assert figures["gain"] == pytest.approx([1, 1, 1], abs=0.03)
    else:  # Mitsuba's diffuse does not lose what the coat reflects
        assert all(1.0 < g < 1.1 for g in figures["gain"])


def test_a_light_may_not_be_named_as_the_capture(files, tmp_path):
    asset, light, _ = files
    clash = tmp_path / "capture.exr"
    clash.write_bytes(light.read_bytes())
    with pytest.raises(UserError, match="named 'capture'"):
        synthesize_multiview(asset, light, tmp_path / "out", relights=[clash])


def test_mirrored_and_plain_parts_are_one_object():
    """Half of the faces mirrored: `principled` splits them, coverage stays, no face is lost."""
    mesh = ball()
    uvs = np.stack([mesh.vertices[:, 0], -mesh.vertices[:, 1]], -1).astype(np.float32)
    mesh = replace(mesh, uvs=uvs)  # seen from behind the texture is mirrored
    flat = replace(constant(), normal=np.array([[[0, 0, 1]]], np.float32))
    light = np.full((4, 8, 3), 1.0, np.float32)
    for _, camera in orbit_cameras(2, 32):
        own, theirs = (
            render(build_scene(mesh, flat, None, light, bsdf=b), camera, spp=16)
            for b in ("relit", "principled")
        )
        np.testing.assert_allclose(theirs[..., 3], own[..., 3], atol=1e-6)
        assert len(build_scene(mesh, flat, None, light, bsdf="principled").mi_scene.shapes()) == 2

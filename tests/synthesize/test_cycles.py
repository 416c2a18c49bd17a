"""Cycles as a renderer of truth: the same conventions as Mitsuba and the own renderer.

Tests that render are skipped where Blender's wheel is missing (see INSTALL of synthesize.cycles).
"""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.ndimage import binary_erosion, uniform_filter

from relit.conventions import environment_directions, similarity, uv_from_direction
from relit.errors import UserError
from relit.geometry.se3 import look_at
from relit.images import write_linear
from relit.scene import Camera, Material, Mesh
from relit.synthesize import cycles
from relit.synthesize.multiview import synthesize_multiview
from relit.synthesize.renderers import TrueObject, build_truth, truth_picture


@pytest.fixture(scope="module")
def blender():
    if reason := cycles.cycles_missing():
        pytest.skip(f"Cycles is not there: {reason}")


def lobe(towards, sharpness=60.0, peak=25.0, sky=1.0) -> np.ndarray:
    """(64, 128, 3) a sky that darkens downwards, with one warm lobe."""
    d = environment_directions(64, 128)
    towards = np.asarray(towards, float) / np.linalg.norm(towards)
    dome = sky * np.array([0.3, 0.35, 0.45]) * (0.7 + 0.5 * d[..., 1:2])
    sun = peak * np.exp(sharpness * (d @ towards - 1))[..., None] * np.array([1, 0.9, 0.7])
    return (dome + sun).astype(np.float32)


LIGHT = lobe((0.5, 0.6, 0.62))


def plain(base, roughness, metallic) -> Material:
    return Material(
        np.array([[base]], np.float32),
        np.full((1, 1), roughness, np.float32),
        np.full((1, 1), metallic, np.float32),
    )


def ball() -> TrueObject:
    s = trimesh.creation.icosphere(4)
    v = s.vertices.astype(np.float32)
    return TrueObject(
        Mesh(v, s.faces.astype(np.int32), v), plain((0.8, 0.5, 0.2), 0.4, 0), np.eye(4)
    )


def camera(size=48) -> Camera:
    return Camera(size, size, size * 1.2, size * 1.2, size / 2, size / 2, look_at((0.8, 0.9, 2.8)))


def pictures(thing: TrueObject, light, view: Camera, names, spp=64) -> dict[str, np.ndarray]:
    out = {}
    for name in names:
        scene = build_truth(name, thing, light, 10)
        out[name] = truth_picture(scene, view, spp, 10, 3)
        scene.close()
    return out


def difference(a, b, inside) -> tuple[float, float]:
    """Relative difference of the means, and mean absolute difference of pixels over the mean, of
    pictures smoothed over 3 x 3 pixels (against noise)."""
    x, y = (uniform_filter(p[..., :3], (3, 3, 0))[inside] for p in (a, b))
    return abs(x.mean() / y.mean() - 1), np.abs(x - y).mean() / y.mean()


def within(picture, rim=4) -> np.ndarray:
    return binary_erosion(picture[..., 3] > 0.999, iterations=rim)


def test_blenders_map_in_blenders_axes_is_ours_in_ours():
    """Blender looks a direction up at u = .5 - atan2(y, x) / 2 pi and v = 1 - acos(z) / pi, upwards
    (direction_to_equirectangular of Cycles)."""
    d = np.random.default_rng(0).normal(size=(200, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    turn = cycles.BLENDER_FROM_WORLD[:3, :3]
    x, y, z = (d @ turn.T).T
    assert np.linalg.det(turn) == pytest.approx(1)
    ours = uv_from_direction(d)
    np.testing.assert_allclose(
        (0.5 - np.arctan2(y, x) / (2 * np.pi)) % 1, ours[:, 0] % 1, atol=1e-6
    )
    np.testing.assert_allclose(np.arccos(z) / np.pi, ours[:, 1], atol=1e-6)


def test_a_missing_blender_is_explained(monkeypatch, tmp_path):
    thing = ball()
    monkeypatch.setenv(cycles.PYTHON, "/nowhere/python")
    with pytest.raises(UserError, match="cycles is not there") as caught:
        build_truth("cycles", thing, LIGHT, 10)
    assert "pip install" in str(caught.value.fix) and cycles.PYTHON in str(caught.value.fix)
    for name in ("asset.glb", "light.exr"):
        (tmp_path / name).touch()
    with pytest.raises(UserError, match="cycles is not there"):
        synthesize_multiview(
            tmp_path / "asset.glb", tmp_path / "light.exr", tmp_path / "out", renderer="cycles"
        )
    assert not (tmp_path / "out").exists()
    monkeypatch.setenv(cycles.PYTHON, sys.executable)
    if cycles.cycles_missing():  # this interpreter has no bpy
        with pytest.raises(UserError, match="cycles is not there"):
            build_truth("cycles", thing, LIGHT, 10)


def test_a_worker_that_dies_is_reported(monkeypatch, tmp_path):
    monkeypatch.setattr(cycles, "require_cycles", lambda: None)
    monkeypatch.setenv(cycles.PYTHON, sys.executable)
    worker = tmp_path / "worker.py"
    worker.write_text("import sys; print('Blender said this'); sys.exit(3)")
    monkeypatch.setattr(cycles, "WORKER", worker)
    with pytest.raises(UserError, match="Cycles stopped") as caught:
        build_truth("cycles", ball(), LIGHT, 10)
    assert "code 3" in str(caught.value.why) and "Blender said this" in str(caught.value.why)


def test_degenerate_faces_are_left_out(tmp_path):
    thing = ball()
    faces = np.concatenate([thing.mesh.faces, [[0, 0, 1], [2, 3, 2]]]).astype(np.int32)
    job = cycles.write_job(
        tmp_path, replace(thing.mesh, faces=faces), thing.material, np.eye(4), cycles.CyclesLook(6)
    )
    with np.load(job["arrays"]) as arrays:
        np.testing.assert_array_equal(arrays["faces"], thing.mesh.faces)
    assert job["bounces"] == 4 and job["constants"]["Roughness"] == pytest.approx(0.4)


# Mitsuba's `principled` does not take the specular reflection from the diffuse light (Burley's
# diffuse), which Cycles and the own BRDF do: 4 to 5 % on a dielectric. Its lobe has no compensation
# of multiple scattering: 1 % on a metal of roughness .3.
@pytest.mark.parametrize(
    ("material", "own", "mitsuba"),
    [
        (plain((0.8, 0.5, 0.2), 0.6, 0.0), (0.01, 0.03), (0.06, 0.075)),
        (plain((0.8, 0.5, 0.2), 0.3, 1.0), (0.01, 0.04), (0.02, 0.05)),
    ],
    ids=["rough dielectric", "metal"],
)
def test_the_renderers_agree_on_a_ball(blender, material, own, mitsuba):
    thing = replace(ball(), material=material)
    seen = pictures(thing, LIGHT, camera(), ("relit", "mitsuba", "cycles"), spp=128)
    inside = within(seen["cycles"])
    assert np.abs(seen["cycles"][..., 3].sum() / seen["relit"][..., 3].sum() - 1) < 0.002
    for name, (mean, pixels) in (("relit", own), ("mitsuba", mitsuba)):
        found = difference(seen["cycles"], seen[name], inside)
        assert found[0] < mean and found[1] < pixels, (name, found)


def asymmetric() -> TrueObject:
    """A bent slab with random textures, a bump map, a seam and no symmetry."""
    rng = np.random.default_rng(4)
    box = trimesh.creation.box((1.6, 1.0, 0.4)).subdivide().subdivide()
    v = np.asarray(box.vertices, np.float32)
    v = v + 0.25 * np.stack([0 * v[:, 0], v[:, 0] ** 2, v[:, 1] * v[:, 0]], -1)
    faces = box.faces.astype(np.int32)
    flat = v[faces.ravel()]
    corner = np.asarray(box.vertices)[faces.ravel()]
    uvs = np.stack([corner[:, 0] / 1.8 + 0.5, 0.5 - corner[:, 1] / 1.2], -1)
    back = np.repeat(box.face_normals[:, 2] < -0.5, 3)
    uvs[back, 0] = 1 - uvs[back, 0]
    side = np.repeat(np.abs(box.face_normals[:, 2]) < 0.5, 3)
    uvs[side] = uvs[side] * 0.5 + corner[side, 2:] * 0.3
    normals = np.repeat(trimesh.Trimesh(v, faces, process=False).face_normals, 3, axis=0)
    mesh = Mesh(
        flat,
        np.arange(len(flat), dtype=np.int32).reshape(-1, 3),
        normals.astype(np.float32),
        uvs.astype(np.float32),
    )
    material = Material(
        rng.uniform(0.05, 0.9, (4, 6, 3)).astype(np.float32).repeat(8, 0).repeat(8, 1),
        rng.uniform(0.35, 0.9, (16, 16)).astype(np.float32),
        (rng.random((8, 8)) < 0.3).astype(np.float32),
    )
    turn = trimesh.transformations.rotation_matrix(0.7, (0.3, 1, 0.2))[:3, :3]
    return TrueObject(mesh, material, similarity(turn, (0.1, -0.05, 0.05), 0.8))


def test_texture_light_and_camera_have_the_same_orientation(blender):
    """A textured mesh without symmetry, an off-axis camera with unequal focal lengths: Cycles is as
    the own renderer, and far from it with a mirrored texture or light."""
    thing, light = asymmetric(), lobe((0.9, 0.5, 0.1), sharpness=20, peak=8)
    view = Camera(72, 56, 80.0, 64.0, 38.0, 26.0, look_at((-0.9, 1.1, 2.4), roll=0.3))
    seen = pictures(thing, light, view, ("relit", "mitsuba", "cycles"), spp=96)
    inside = within(seen["cycles"], 2)
    assert inside.sum() > 300
    assert np.abs(seen["cycles"][..., 3] - seen["relit"][..., 3]).mean() < 0.01
    mean, pixels = difference(seen["cycles"], seen["relit"], inside)
    assert mean < 0.02 and pixels < 0.05, (mean, pixels)
    assert difference(seen["cycles"], seen["mitsuba"], inside)[1] < 0.1
    material, uvs = thing.material, np.asarray(thing.mesh.uvs)
    wrong = [
        (replace(thing, mesh=replace(thing.mesh, uvs=uvs * [1, -1] + [0, 1])), light),
        (replace(thing, mesh=replace(thing.mesh, uvs=uvs * [-1, 1] + [1, 0])), light),
        (thing, light[:, ::-1]),
        (thing, light[::-1]),
        (thing, np.roll(light, 32, 1)),
        (replace(thing, material=replace(material, roughness=material.roughness**2)), light),
    ]
    for other, lit in wrong:
        far = pictures(other, np.ascontiguousarray(lit), view, ("relit",), spp=96)["relit"]
        assert difference(seen["cycles"], far, inside)[1] > 2 * pixels


def two_quads() -> TrueObject:
    """Two squares side by side with one tilted normal, the right one with a mirrored texture."""
    v = np.array([[-1, 0.5, 0], [0, 0.5, 0], [0, -0.5, 0], [-1, -0.5, 0]], np.float32)
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    mesh = Mesh(
        np.concatenate([v, v + np.array([1, 0, 0])]).astype(np.float32),
        np.array([[0, 2, 1], [0, 3, 2], [4, 6, 5], [4, 7, 6]], np.int32),
        np.array([[0, 0, 1]] * 8, np.float32),
        np.concatenate([uv, uv * [-1, 1] + [1, 0]]).astype(np.float32),
    )
    n = np.array([0.5, 0.35, 0.8])
    normal = np.broadcast_to(n / np.linalg.norm(n), (2, 2, 3)).astype(np.float32)
    return TrueObject(mesh, replace(plain((0.8, 0.8, 0.8), 0.8, 0), normal=normal), np.eye(4))


def tilts(picture) -> np.ndarray:
    """Mean radiance in the middle of the left and of the right square."""
    return np.array([picture[14:18, 8:13, :3].mean(), picture[14:18, 19:24, :3].mean()])


@pytest.mark.parametrize("towards", [(1, 0, 1), (0, 1, 1)], ids=["right", "up"])
def test_mitsuba_tilts_normals_where_the_texture_is_mirrored(towards):
    light = lobe(towards, peak=40, sky=0.1)
    seen = pictures(two_quads(), light, face_on(), ("relit", "mitsuba"))
    own = tilts(seen["relit"])
    np.testing.assert_allclose(tilts(seen["mitsuba"]), own, rtol=0.2)  # Burley's diffuse
    if towards[0]:
        assert own[0] > 2 * own[1]  # the right square tilts away from the light
    else:
        assert own[0] == pytest.approx(own[1], rel=0.05)  # both tilt up


def face_on() -> Camera:
    return Camera(32, 32, 40.0, 40.0, 16.0, 16.0, look_at((0, 0, 3)))


def test_cycles_tilts_normals_as_gltf_says(blender):
    light = lobe((1, 0.7, 1), peak=40, sky=0.1)
    seen = pictures(two_quads(), light, face_on(), ("relit", "cycles"))
    np.testing.assert_allclose(tilts(seen["cycles"]), tilts(seen["relit"]), rtol=0.04)


def test_a_capture_by_cycles(blender, tmp_path):
    """A capture with its truth, renderer and ceiling."""
    from relit.asset.gltf import write_glb

    thing = ball()
    write_glb(tmp_path / "ball.glb", thing.mesh, thing.material)
    write_linear(tmp_path / "light.exr", LIGHT)
    out = synthesize_multiview(
        tmp_path / "ball.glb",
        tmp_path / "light.exr",
        tmp_path / "capture",
        views=2,
        test_views=1,
        resolution=32,
        spp=4,
        test_spp=64,
        renderer="cycles",
    )
    truth = json.loads((out / "truth" / "truth.json").read_text())
    assert truth["renderer"]["name"] == "cycles" and "Blender" in truth["renderer"]["version"]
    assert truth["settings"]["max_depth"] == 10
    assert truth["ceiling"]["capture"]["psnr_masked"] > 30
    assert truth["ceiling"]["capture"]["gain"] == pytest.approx([1, 1, 1], abs=0.04)


def test_a_seed_gives_the_same_picture(blender):
    scene = build_truth("cycles", ball(), LIGHT, 10)
    a, c, b = (truth_picture(scene, camera(24), 4, 10, seed) for seed in (1, 2, 1))
    np.testing.assert_array_equal(a, b)
    assert not np.array_equal(a, c)
    brighter = truth_picture(scene.brighter(2.0), camera(24), 4, 10, 1)
    np.testing.assert_allclose(brighter[..., :3], 2 * a[..., :3], rtol=1e-6)
    np.testing.assert_array_equal(brighter[..., 3], a[..., 3])
    folder = scene.cycles.folder
    scene.close()
    assert not folder.exists() and scene.cycles.process.poll() == 0

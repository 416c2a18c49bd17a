"""The evaluation of an asset that IS the truth, and of ones that are off by a known amount."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from relit.conventions import move_points, move_pose, rotate_environment, scale_of, similarity
from relit.errors import UserError
from relit.evaluate import metrics
from relit.evaluate import multiview as protocols
from relit.evaluate.alignment import aligned
from relit.evaluate.definitions import DEFINITIONS
from relit.evaluate.results import figures_table
from relit.evaluate.surfaces import chamfer_figures, visible
from relit.evaluate.truth import camera_key, load_truth
from relit.images import write_linear, write_srgb
from relit.scene import Asset, Mesh
from relit.synthesize.multiview import synthesize_multiview

# the noise of both pictures, most of it at the rims of so few pixels, must lie below 45 dB
SPP = 1400


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    """A rounded box of two colours, 48 x 48 pixels, with a hidden ball inside it."""
    folder = tmp_path_factory.mktemp("truth")
    shell = trimesh.creation.icosphere(3)
    shell.vertices = np.sign(shell.vertices) * np.abs(shell.vertices) ** 0.6
    hidden = trimesh.creation.icosphere(2, radius=0.3)
    both = trimesh.util.concatenate([shell, hidden])
    uv = np.stack(
        [np.where(both.vertices[:, 1] < 0, 0.25, 0.75), np.full(len(both.vertices), 0.5)], 1
    )
    lines = [
        "mtllib o.mtl",
        "usemtl m",
        *("v {:.6f} {:.6f} {:.6f}".format(*v) for v in both.vertices),
    ]
    lines += ["vt {:.4f} {:.4f}".format(*t) for t in uv] + [
        "f " + " ".join(f"{i}/{i}" for i in f) for f in both.faces + 1
    ]
    (folder / "o.obj").write_text("\n".join(lines) + "\n")
    (folder / "o.mtl").write_text("newmtl m\nmap_Kd o.png\n")
    texture = np.empty((8, 8, 3), np.float32)
    texture[:, :4], texture[:, 4:] = (0.5, 0.3, 0.1), (0.1, 0.25, 0.4)
    write_srgb(folder / "o.png", texture)
    for name, lamp in (("day", 6), ("eve", 22)):
        light = np.full((8, 16, 3), 1.0, np.float32) * [0.8, 0.9, 1.0]
        light[5:] *= 0.2  # dark enough below to stay unclipped in the light's figure
        light[1:4, lamp // 2 : lamp // 2 + 3] += 0.5
        write_linear(folder / f"{name}.exr", light)
    out = synthesize_multiview(
        folder / "o.obj",
        folder / "day.exr",
        folder / "capture",
        views=6,
        test_views=1,
        relights=[folder / "eve.exr"],
        resolution=48,
        spp=8,
        test_spp=SPP,
        roughness=0.5,
        metallic=0.0,
    )
    return load_truth(out)


@pytest.fixture(scope="module")
def itself(truth):
    """The asset that the capture was rendered from, in its own frame."""
    from relit.asset.gltf import read_asset_file

    mesh, material = read_asset_file(truth.folder.parent / "o.obj")
    one = np.ones((1, 1), np.float32)
    material = replace(material, roughness=0.5 * one, metallic=0 * one)
    cameras = tuple((f"train/{name}.png", camera) for name, camera in truth.train.items())
    return Asset(
        mesh,
        material,
        np.array(truth.meta["world_from_asset"]),
        truth.picture("environment")[..., :3],
        cameras,
    )


def value(result, name):
    return result["metrics"][name]["value"]


@pytest.mark.slow
def test_the_truth_against_itself(truth, itself):
    result = protocols.evaluate_asset(itself, truth, spp=SPP, seed=5)
    assert result["alignment"] == "identity"
    np.testing.assert_allclose(result["albedo_scale"], 1.0, atol=0.01)
    for name, least in (("novel_psnr", 45), ("relit_psnr", 45), ("relit_psnr_unscaled", 39)):
        assert value(result, name) > least, name
    assert value(result, "albedo_psnr") > 38 and value(result, "normal_mae") < 1.0
    assert value(result, "roughness_mse") < 1e-6 and value(result, "mask_iou") > 0.98
    assert value(result, "environment_mse") < 1e-9 and value(result, "novel_ssim") > 0.98
    assert value(result, "chamfer_percent") < 0.01
    assert set(result["metrics"]) <= set(DEFINITIONS)
    assert all(entry["definition"] for entry in result["metrics"].values())


@pytest.mark.slow
def test_an_albedo_of_another_scale_is_undone_by_the_scale_alone(truth, itself):
    factors = np.array([0.7, 0.8, 0.9], np.float32)
    wrong = replace(itself.material, base_color=itself.material.base_color * factors)
    asset = replace(itself, material=wrong, environment=itself.environment / factors)
    result = protocols.evaluate_asset(asset, truth, spp=64)
    np.testing.assert_allclose(result["albedo_scale"], 1 / factors, rtol=0.02)
    assert value(result, "albedo_psnr") > 38 > 30 > value(result, "albedo_psnr_unscaled")
    assert value(result, "relit_psnr") > value(result, "relit_psnr_unscaled") + 5
    assert value(result, "environment_mse_scaled") < 1e-4 < value(result, "environment_mse")


@pytest.mark.slow
def test_a_recovered_frame_is_aligned_by_its_cameras(truth, itself):
    free = similarity(
        Rotation.from_euler("y", 90, degrees=True).as_matrix(), [1, 2, 3], 0.25
    )  # free_from_world
    cameras = tuple(
        (name, c.with_pose(move_pose(free, c.world_from_camera))) for name, c in itself.cameras
    )
    environment = rotate_environment(
        itself.environment, free
    )  # a turn by whole texels: nothing is lost
    asset = replace(
        itself,
        world_from_asset=free @ itself.world_from_asset,
        cameras=cameras,
        environment=environment,
    )
    back, how = aligned(asset, truth.train, {camera_key(n): c for n, c in cameras})
    assert how == "sim3"
    np.testing.assert_allclose(back.world_from_asset, itself.world_from_asset, atol=1e-9)
    np.testing.assert_allclose(back.environment, itself.environment, atol=1e-3)
    assert scale_of(back.world_from_asset) == pytest.approx(scale_of(itself.world_from_asset))


@pytest.mark.slow
def test_a_larger_object_has_the_known_chamfer_distance_and_hidden_parts_do_not_count(
    truth, itself
):
    same = chamfer_figures(itself.mesh, itself.world_from_asset, truth, count=20_000)
    keep = itself.mesh.faces[
        np.linalg.norm(itself.mesh.vertices[itself.mesh.faces[:, 0]], axis=1) > 0.5
    ]
    assert len(keep) < len(itself.mesh.faces)
    shell = chamfer_figures(
        Mesh(itself.mesh.vertices, keep), itself.world_from_asset, truth, count=20_000
    )
    assert shell["chamfer"] == pytest.approx(same["chamfer"], rel=0.1)
    moved = similarity(np.eye(3), [0, 0.1, 0]) @ itself.world_from_asset
    assert (
        same["chamfer"]
        < 0.01
        < chamfer_figures(itself.mesh, moved, truth, count=20_000)["chamfer"]
        < 0.1
    )


@pytest.mark.slow
def test_what_can_be_seen_from_around_is_the_outer_surface(truth, itself):
    surface = metrics.sample_surface(itself.mesh.vertices, itself.mesh.faces, 5000)
    outer = (
        np.linalg.norm(surface.points, axis=1) > 0.5
    )  # of the asset; the hidden ball has radius .3
    points = move_points(itself.world_from_asset, surface.points)
    cameras = [*truth.train.values(), *truth.test.values()]
    seen = visible(itself.mesh, itself.world_from_asset, points, cameras)
    assert not seen[~outer].any() and (~outer).any()
    assert (
        0.8 < seen[outer].mean() <= 1
    )  # seven cameras above -35 degrees leave some of the underside unseen
    one = visible(itself.mesh, itself.world_from_asset, points, cameras[:1])
    facing = ((cameras[0].centre - points) * points).sum(1) > 0.3  # of a nearly round thing
    assert one[outer & facing].mean() > 0.97 and 0.25 < one[outer].mean() < 0.55


@pytest.mark.slow
def test_missing_surface_counts_as_an_error(truth, itself):
    half = itself.mesh.faces[itself.mesh.vertices[itself.mesh.faces].mean(1)[:, 1] > 0]
    asset = replace(
        itself,
        mesh=Mesh(itself.mesh.vertices, half, itself.mesh.normals, itself.mesh.uvs),
        environment=None,
    )
    truth = replace(truth, meta={**truth.meta, "relight": []})
    result = protocols.evaluate_asset(asset, truth, spp=8)
    assert value(result, "normal_mae") > 10 and value(result, "albedo_psnr") < 20
    assert value(result, "chamfer_completeness") > 3 * value(result, "chamfer_accuracy")
    assert "novel_psnr" not in result["metrics"] and "relit_psnr" not in result["metrics"]


def test_an_unfinished_or_missing_truth_is_a_user_error(tmp_path):
    with pytest.raises(UserError, match="no complete truth"):
        load_truth(tmp_path)
    (tmp_path / "truth").mkdir()
    (tmp_path / "truth" / "settings.json").write_text("{}")
    with pytest.raises(UserError) as error:
        load_truth(tmp_path)
    assert "unfinished" in error.value.why
    (tmp_path / "truth" / "truth.json").write_text('{"settings": {')
    with pytest.raises(UserError, match="cannot be read"):
        load_truth(tmp_path)


@pytest.mark.slow
def test_the_table_shows_every_figure(truth, itself):
    from io import StringIO

    from rich.console import Console

    result = {"metrics": {"novel_psnr": {"value": 33.333, "unit": "dB", "definition": "as said"}}}
    text = StringIO()
    Console(file=text, width=120).print(figures_table(result, "A title"))
    assert all(
        word in text.getvalue() for word in ("A title", "novel_psnr", "33.33", "dB", "as said")
    )

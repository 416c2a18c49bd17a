"""`relit evaluate` on collections: an asset that IS what was photographed, against a synthetic
truth, photos set aside, given cameras."""

import json
from dataclasses import replace

import numpy as np
import pytest

from relit.asset.asset import read_cameras, save_asset
from relit.cli.main import main
from relit.conventions import move_pose, similarity
from relit.errors import UserError
from relit.evaluate.collection_photos import evaluate_on_collection
from relit.evaluate.dispatch import evaluate
from relit.geometry.se3 import exp_so3, look_at
from relit.images import read_image, write_data, write_srgb
from relit.reference.mitsuba_scene import build_scene, render
from relit.scene import Asset, Camera
from relit.synthesize.procedural import pawn

KNOWN = similarity(
    exp_so3(np.array([0.4, -1.2, 0.3])), np.array([3.0, -1.0, 2.0]), 2.5
)  # given from recovered


@pytest.fixture(scope="module")
def asset() -> Asset:
    """A pawn, seven photos of sizes and lights of their own, the last two set aside."""
    mesh, material = pawn(rows=10, columns=14, texture=16)
    middle = (mesh.vertices.min(0) + mesh.vertices.max(0)) / 2
    lights, cameras, rng = [], [], np.random.default_rng(0)
    for i in range(7):
        angle, (w, h) = 0.9 * i, ((44, 60), (60, 44))[i % 2]
        pose = look_at(
            middle + 5 * np.array([np.sin(angle), 0.15 * (i - 3), np.cos(angle)]), middle
        )
        cameras.append(
            (f"image/{i}.png", Camera(w, h, 80.0 + 3 * i, 80.0 + 3 * i, w / 2, h / 2, pose))
        )
        lights.append(
            (0.15 + 0.12 * (i % 3)) * rng.uniform(0.3, 1.5, (8, 16, 3)).astype(np.float32)
        )
    held = {"held_out": [name for name, _ in cameras[5:]]}
    environment = np.median(lights, 0).astype(np.float32)
    return Asset(mesh, material, np.eye(4), environment, tuple(cameras), held, lights=tuple(lights))


@pytest.fixture(scope="module")
def folder(asset, tmp_path_factory):
    """The photos, each before a wall, with masks; no answers, no cameras."""
    out = tmp_path_factory.mktemp("photos")
    for i, ((name, camera), light) in enumerate(zip(asset.cameras, asset.lights, strict=True)):
        picture = render(
            build_scene(asset.mesh, asset.material, asset.world_from_asset, light),
            camera,
            spp=256,
            seed=50 + i,
        )
        write_srgb(out / name, picture[..., :3] + 0.3 * (1 - picture[..., 3:]))
        write_data(out / "mask" / f"{i}.png", picture[..., 3])
    return out


def copied(folder, to, *, poses=None, held=(), answers=False):
    """The photos with what else a collection may hold. poses: cameras for poses_bounds.npy."""
    for part in ("image", "mask"):
        (to / part).mkdir()
        for file in (folder / part).iterdir():
            (to / part / file.name).write_bytes(file.read_bytes())
    if poses is not None:
        rows = []
        for camera in poses:
            m = camera.world_from_camera
            head = np.column_stack(
                [m[:3, 1], m[:3, 0], -m[:3, 2], m[:3, 3], [camera.height, camera.width, camera.fx]]
            )
            rows.append([*head.ravel(), 1.0, 9.0])
        np.save(to / "poses_bounds.npy", np.array(rows))
    if held:
        (to / "held_out.json").write_text(json.dumps({"frames": list(held)}))
    if answers:
        frames = [
            {"image_name": f"{i}.png", "quadrant": ["Left", "Above", "Front"]} for i in range(7)
        ]
        (to / "quadrants.json").write_text(json.dumps({"frames": frames}))
    return to


def given(asset, turned=None):
    """The cameras as another program knows them; `turned`: degrees by which the first is off."""
    out = [c.with_pose(move_pose(KNOWN, c.world_from_camera)) for _, c in asset.cameras]
    if turned:
        out[0] = out[0].with_pose(
            out[0].world_from_camera
            @ similarity(exp_so3(np.array([0, 0, np.radians(turned)])), np.zeros(3))
        )
    return out


def values(result):
    assert all(e["definition"] for e in result["metrics"].values())
    return {k: e["value"] for k, e in result["metrics"].items()}


@pytest.mark.slow
def test_photos_that_were_set_aside_are_compared_under_their_own_lights(
    asset, folder, tmp_path, capsys
):
    save_asset(
        tmp_path / "asset", asset
    )  # set aside by `--set holdout`: only the asset knows which
    words = ["evaluate", str(tmp_path), "--truth", str(folder), "--spp", "64", "--device", "cpu"]
    assert main([*words, "--json", str(tmp_path / "f.json")]) == 0
    assert "novel_psnr" in capsys.readouterr().out
    result = json.loads((tmp_path / "f.json").read_text())
    got = values(result)
    assert set(result["per_view"]) == {"image/5.png", "image/6.png"} and "rotation_mean" not in got
    assert (
        got["novel_psnr"] > 30
        and got["novel_ssim"] > 0.95
        and got["novel_psnr_masked"] > 27
        and got["novel_mask_iou"] > 0.95
    )
    assert "masks for the true coverage" in result["metrics"]["novel_psnr"]["definition"]
    wrong = replace(asset, lights=(*asset.lights[:5], *asset.lights[3:5]))
    assert (
        values(evaluate_on_collection(wrong, folder, spp=16))["novel_psnr_masked"]
        < got["novel_psnr_masked"] - 5
    )


@pytest.mark.parametrize(
    "answers", [False, True]
)  # with quadrants.json the folder is not read as LLFF's
def test_cameras_are_compared_after_procrustes(asset, folder, tmp_path, answers):
    capture = copied(
        folder,
        tmp_path,
        poses=given(asset, turned=30),
        held=["5.png", "6.png"] if answers else (),
        answers=answers,
    )
    result = evaluate_on_collection(asset, capture, spp=16)
    got = values(result)
    assert (
        got["rotation_mean"] == pytest.approx(6, abs=0.1) and got["rotation_median"] < 0.1
    )  # one of five is off by 30
    assert got["rotation_within_10"] == pytest.approx(80) and got["held_out_rotation"] < 0.1
    assert (
        got["translation_percent"] < 0.1 and got["focal_percent"] < 1e-6 and got["novel_psnr"] > 25
    )
    assert ("poses_bounds.npy" if answers else "llff") in result["metrics"]["rotation_mean"][
        "definition"
    ]


def test_cameras_alone_or_guessed_masks_do(asset, folder, tmp_path):
    capture = copied(folder, tmp_path, poses=given(asset))
    none_held = values(evaluate_on_collection(replace(asset, meta={}), capture, spp=4))
    assert (
        none_held["rotation_mean"] < 0.1
        and "novel_psnr" not in none_held
        and "held_out_rotation" not in none_held
    )
    (tmp_path / "config.toml").write_text('masks = "none"\n')  # as the run was asked for
    said = evaluate_on_collection(asset, capture, run=tmp_path, spp=4)["metrics"]["novel_psnr"][
        "definition"
    ]
    assert "2 of 2 guessed by GrabCut" in said


def test_without_a_photo_set_aside_or_a_camera_there_is_no_figure(asset, folder, tmp_path):
    save_asset(tmp_path / "asset", replace(asset, meta={}))
    with pytest.raises(UserError, match="nothing to measure") as raised:
        evaluate(tmp_path, folder)
    assert raised.value.code == 3 and "holdout=16" in raised.value.fix
    other = replace(
        asset, cameras=tuple((f"other/{i}.png", c) for i, (_, c) in enumerate(asset.cameras))
    )
    with pytest.raises(UserError, match="none of the asset's photos"):
        evaluate_on_collection(other, folder)


@pytest.mark.slow
def test_the_truth_of_a_synthetic_collection(tmp_path):
    """The asset that was photographed, with the true cameras and lights, in a frame of its own."""
    from relit.asset.gltf import read_asset_file, write_glb
    from relit.images import write_linear
    from relit.synthesize.collection import synthesize_collection

    write_glb(tmp_path / "pawn.glb", *pawn(rows=10, columns=14, texture=16))
    light = np.full((8, 16, 3), 0.4, np.float32)
    light[1:3, 3:6] = 2.0
    write_linear(tmp_path / "light.exr", light)
    options = {"views": 4, "test_views": 1, "resolution": 48, "spp": 16, "test_spp": 256}
    capture = synthesize_collection(
        tmp_path / "pawn.glb", tmp_path / "light.exr", tmp_path / "capture", **options
    )
    meta = json.loads((capture / "truth" / "truth.json").read_text())
    cameras = read_cameras(capture / "truth" / "cameras.json")
    lights = tuple(
        read_image(capture / "truth" / "lights" / f"{n.split('/')[1][:-4]}.exr").rgb
        for n, _ in cameras
    )
    turn = similarity(
        exp_so3(np.array([0, np.pi / 2, 0])), np.zeros(3)
    )  # the lights are turned by whole texels
    lights = tuple(np.roll(light, -light.shape[1] // 4, axis=1) for light in lights)
    moved = tuple((n, c.with_pose(move_pose(turn, c.world_from_camera))) for n, c in cameras)
    held = {"held_out": [n for n, _ in cameras if n.split("/")[1][:-4] in meta["test"]]}
    mesh, material = read_asset_file(tmp_path / "pawn.glb")
    save_asset(
        tmp_path / "run",
        Asset(
            mesh,
            material,
            turn @ np.array(meta["world_from_asset"]),
            lights[0],
            moved,
            held,
            lights=lights,
        ),
    )
    # relighting is measured where the truth has it: the object itself under another light
    from relit.reference.mitsuba_scene import build_scene, render

    scene = build_scene(mesh, material, np.array(meta["world_from_asset"]), light)
    write_linear(capture / "truth" / "relight" / "eve.exr", light)
    for name, camera in cameras:
        if (stem := name.split("/")[1][:-4]) in meta["test"]:
            picture = render(scene, camera, spp=256, seed=9)
            write_linear(capture / "truth" / "relight" / "eve" / f"{stem}.exr", picture)
    meta["relight"] = ["eve"]
    (capture / "truth" / "truth.json").write_text(json.dumps(meta))
    for folder in (capture, capture / "truth"):
        result = evaluate(tmp_path / "run", folder, spp=64)
        got = values(result)
        assert got["relit_psnr"] > 28 and got["relit_psnr_masked"] > 22
        baselines = {k: e["baseline"] for k, e in result["metrics"].items() if "baseline" in e}
        assert baselines["albedo_psnr"] < got["albedo_psnr"]
        assert baselines["rotation_mean"] > 50 and "focal_percent" not in baselines
        assert (
            got["rotation_mean"] < 0.01
            and got["novel_psnr"] > 30
            and got["albedo_psnr"] > 35
            and got["chamfer_percent"] < 0.1
        )
    got = values(evaluate(tmp_path / "run", capture, spp=64, protocol="samurai"))
    assert got["rotation_mean"] < 0.01 and got["novel_psnr"] > 28 and got["cameras"] == 100
    save_asset(
        tmp_path / "run",
        Asset(mesh, material, np.array(meta["world_from_asset"]), lights[0], cameras),
    )
    with pytest.raises(UserError, match="no light for each photo"):
        evaluate(tmp_path / "run", capture)

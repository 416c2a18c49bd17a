"""What the suites of the report ask of synthesizers: paints, the room of a flash, wrong hints,
occluders, relighting truth; tiny, each with what the truth says checked against the pictures."""

import json
from functools import partial

import cv2
import numpy as np
import pytest

from relit.benchmark.photographed import (
    everyday_settings,
    phone_settings,
    synthesize_phone,
    synthesize_turntable_item,
    turntable_settings,
)
from relit.capture.open import open_capture
from relit.capture.readers.samurai import quadrant_of
from relit.errors import UserError
from relit.evaluate.truth import ceiling_of, load_truth
from relit.images import read_data, write_linear
from relit.scene import Material
from relit.synthesize.collection import octant_hints, plan_shots, synthesize_collection
from relit.synthesize.flash import settings_of, synthesize_flash
from relit.synthesize.flash_room import painted, plastic_coat
from support.lump import lump

TINY = {"views": 4, "test_views": 1, "resolution": 40, "spp": 16, "test_spp": 16}


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A lump, a dielectric, and two lights."""
    from relit.asset.gltf import write_glb

    folder = tmp_path_factory.mktemp("files")
    write_glb(folder / "lump.glb", *lump())
    for name, column in (("light", 3), ("other", 11)):
        light = np.full((8, 16, 3), 0.4, np.float32)
        light[1:3, column : column + 3] = 4.0
        write_linear(folder / f"{name}.exr", light)
    return folder


# ---------------------------------------------------------------- flash


def test_the_light_of_the_room_has_its_share(files, tmp_path):
    make = partial(synthesize_flash, files / "lump.glb", max_depth=3, **TINY)
    dark = make((), tmp_path / "dark")
    room = make(files / "light.exr", tmp_path / "room", ambient=0.2)

    def photos(capture, split):
        return [
            read_data(p)[..., :3][read_data(capture / split / "mask" / f"{p.stem}.png") > 0.9]
            for p in sorted((capture / split / "image").glob("*.exr"))
        ]

    pairs = [photos(c, "train") for c in (dark, room)]
    shares = [b.mean() / a.mean() - 1 for a, b in zip(*pairs, strict=True)]
    assert 0.13 < np.mean(shares) < 0.27 and np.ptp(shares) > 0.01  # not the same from all sides
    for a, b in zip(photos(dark, "test"), photos(room, "test"), strict=True):
        np.testing.assert_array_equal(a, b)  # what is measured against has the flash alone


def test_a_metal_under_the_flash(files, tmp_path):
    from relit.asset.gltf import read_asset_file, write_glb

    mesh, material = read_asset_file(files / "lump.glb")
    one = np.ones((1, 1), np.float32)
    gold = Material(np.full((1, 1, 3), (1.0, 0.71, 0.29), np.float32), 0.35 * one, one)
    write_glb(tmp_path / "gold.glb", mesh, gold)
    capture = synthesize_flash(
        tmp_path / "gold.glb", (), tmp_path / "c", material="own", max_depth=3, **TINY
    )
    photo = read_data(capture / "test" / "image" / "t_000.exr")
    inside = read_data(capture / "test" / "mask" / "t_000.png") > 0.9
    r, _, b = photo[..., :3][inside].sum(0)
    assert 0.2 < b / r < 0.4  # the reflection has the colour of the metal
    diffuse = read_data(capture / "test" / "diffuse_albedo" / "t_000.exr")
    assert np.abs(diffuse).max() < 1e-4
    specular = read_data(capture / "test" / "specular_albedo" / "t_000.exr")
    f0 = ((1.49 - 1) / (1.49 + 1)) ** 2
    assert np.median(specular[inside]) == pytest.approx((1.0 + 0.71 + 0.29) / 3 / f0, rel=0.02)
    alpha = read_data(capture / "test" / "specular_roughness" / "t_000.exr")
    assert np.median(alpha[inside]) == pytest.approx(0.35**2, rel=0.02)
    assert material.metallic.max() == 0


def test_paints_move_the_colours_and_maps_keep_their_values():
    base = np.array([[[0.2, 0.4, 0.6], [0.8, 0.5, 0.1]]], np.float32)
    material = Material(base, np.full((1, 1), 0.5, np.float32), np.zeros((2, 2), np.float32))
    assert painted(material, "dark").base_color.max() == pytest.approx(0.08)
    assert painted(material, "bright").base_color.min() == pytest.approx(0.73)
    assert painted(material, "own") is material
    with pytest.raises(UserError, match="paint"):
        painted(material, "blue")
    plastic = plastic_coat(material)
    assert plastic.base_color.shape[:2] == plastic.specular.shape == plastic.roughness.shape


def test_options_that_came_later_leave_the_names_of_captures(files, tmp_path):
    asset = files / "lump.glb"
    plain = settings_of(asset, ())
    assert not {"paint", "material", "ambient", "light"} & set(plain)
    assert settings_of(asset, (), paint="dark")["paint"] == "dark"
    assert settings_of(asset, files / "light.exr", ambient=0.1)["light"]["name"] == "light.exr"
    with pytest.raises(UserError, match="no light but the flash"):
        synthesize_flash(asset, files / "light.exr", tmp_path / "x", **TINY)
    with pytest.raises(UserError, match="light of the room"):
        synthesize_flash(asset, (), tmp_path / "x", ambient=0.1, **TINY)
    from relit.synthesize import collection, duplicates

    same = collection.settings_of(asset, files / "light.exr")
    assert same["max_depth"] == 6 and not set(collection.LATER) & set(same)
    same = duplicates.settings_of(asset, files / "light.exr")
    assert same["max_depth"] == 5 and "renderer" not in same


# ---------------------------------------------------------------- collection


def test_a_tenth_of_the_hints_is_wrong():
    shots = plan_shots(30, 6, 400, 2, (3, 12.0))
    hints, wrong = octant_hints(shots, 0.1, seed=3)
    true = {s.name: quadrant_of(s.camera.centre) for s in shots}
    assert len(wrong) == 4 and wrong == [n for n in hints if hints[n] != true[n]]
    assert octant_hints(shots, 0.0, seed=3) == (true, [])


def test_rolls_go_as_far_as_they_may():
    def rolls(most):
        for shot in plan_shots(200, 0, 400, 1, (1, most)):
            pose = shot.camera.world_from_camera
            if abs(pose[1, 2]) > 0.7:  # looks up or down: its roll is not determined
                continue
            up = pose[:3, :3].T @ np.array([0.0, 1.0, 0.0])
            yield abs(np.degrees(np.arctan2(up[0], -up[1])))

    assert max(rolls(12.0)) < 20 and max(rolls(180.0)) > 150


@pytest.fixture(scope="module")
def collection(files, tmp_path_factory):
    return synthesize_collection(
        files / "lump.glb",
        files / "light.exr",
        tmp_path_factory.mktemp("collection") / "c",
        relights=[files / "other.exr"],
        renderer="mitsuba",
        wrong_hints=0.1,
        occluders=1.0,
        rough_masks=0.0,
        max_depth=3,
        **{**TINY, "views": 5, "resolution": 64},
    )


def test_a_collection_has_relighting_truth(collection):
    meta = json.loads((collection / "truth" / "truth.json").read_text())
    assert meta["relight"] == ["other"] and len(meta["wrong_hints"]) == 1
    name = meta["test"][0]
    relit = read_data(collection / "truth" / "relight" / "other" / f"{name}.exr")
    photo = read_data(collection / "truth" / "test" / f"{name}.exr")
    assert relit.shape == photo.shape and relit[..., :3].max() > 0.1
    assert ((relit[..., 3] > 0.5) ^ (photo[..., 3] > 0.5)).mean() < 0.02  # from the same camera
    assert np.abs(relit[..., :3] - photo[..., :3]).max() > 0.05
    assert ceiling_of(collection)["other"]["psnr"] > 20


def test_occluders_are_no_part_of_masks_and_spare_the_test_photos(collection):
    from relit.asset.asset import read_cameras
    from relit.evaluate.collection import load_collection_truth

    meta = json.loads((collection / "truth" / "truth.json").read_text())
    truth = load_collection_truth(collection)
    assert set(truth.train) == set(meta["train"])
    name = meta["test"][0]
    mask = read_data(collection / "mask" / f"{name}.png")
    alpha = read_data(collection / "truth" / "test" / f"{name}.exr")[..., 3]
    assert ((mask > 0.5) ^ (alpha > 0.5)).mean() < 0.02
    assert len(list(read_cameras(collection / "truth" / "cameras.json"))) == 6
    shrunk = 0
    for each in meta["train_albedo"]:
        mask = read_data(collection / "mask" / f"{each}.png") > 0.5
        true = read_data(collection / "truth" / "train_albedo" / f"{each}.exr")[..., 3] > 0.5
        assert (mask & ~true).mean() < 0.02
        shrunk += (true & ~mask).sum() > 0.02 * true.sum()
    assert shrunk >= 3


# ---------------------------------------------------------------- through a camera model


def test_phone_captures_are_named_by_the_model(files, tmp_path):
    names = (files / "lump.glb", files / "light.exr")
    options = {**TINY, "relights": [files / "other.exr"]}
    phone, mild = (
        phone_settings(*names, **options),
        phone_settings(*names, **options, camera_model="phone,jpeg=80", mask_errors="off"),
    )
    assert phone["delivery"]["camera"]["jpeg"] == 92 and mild["delivery"]["camera"]["jpeg"] == 80
    out = synthesize_phone(*names, tmp_path / "c", **options, cameras=False)
    assert json.loads((out / "truth" / "settings.json").read_text()) == json.loads(
        json.dumps(phone_settings(*names, **options, cameras=False))
    )
    assert not (out / "transforms.json").exists() and len(list((out / "images").iterdir())) == 4
    assert load_truth(out).train.keys() == {f"r_{i:03d}" for i in range(4)}


@pytest.mark.slow
def test_a_turntable_has_a_ceiling_and_the_settings_that_name_it(files, tmp_path):
    names = (files / "lump.glb", files / "light.exr")
    options = {**TINY, "elevations": (20, 45), "relights": [files / "other.exr"]}
    out = synthesize_turntable_item(*names, tmp_path / "c", **options)
    said = json.loads((out / "truth" / "settings.json").read_text())
    assert said == json.loads(json.dumps(turntable_settings(*names, **options)))
    assert {"capture", "other"} <= set(ceiling_of(out))
    assert len(open_capture(out).photos) == 4
    kinds = everyday_settings(*names, **TINY, table="cloth")
    assert kinds["kind"] == "everyday" and kinds["texture"] == "cloth"


def test_one_pile_by_another_renderer(files, tmp_path):
    from relit.synthesize.duplicates import synthesize_duplicates

    sizes = {"count": 2, "resolution": 64, "test_resolution": 24, "test_views": 1}
    make = partial(
        synthesize_duplicates,
        files / "lump.glb",
        files / "light.exr",
        **sizes,
        spp=16,
        test_spp=16,
        relights=[files / "other.exr"],
    )
    ours, theirs = make(tmp_path / "a"), make(tmp_path / "b", renderer="mitsuba")
    labels = [
        cv2.imread(str(c / "train" / "000_instance_seg.png"), cv2.IMREAD_UNCHANGED)
        for c in (ours, theirs)
    ]
    np.testing.assert_array_equal(*labels)
    a, b = (read_data(c / "train" / "000_rgb.png")[labels[0] > 0].mean(0) for c in (ours, theirs))
    np.testing.assert_allclose(a, b, rtol=0.15)
    said = json.loads((theirs / "truth" / "settings.json").read_text())
    assert said["renderer"] == "mitsuba" and said["max_depth"] == 10

"""The photo of a pile, changed: on a made-up asset whose photo is its own rendering."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cv2 import imwrite as cv_write

from relit.asset.asset import load_asset, save_asset
from relit.edit import as_shown, camera_of, edit, insert
from relit.errors import UserError
from relit.files import digests
from relit.geometry.se3 import look_at
from relit.images import read_data, read_image, write_linear, write_srgb
from relit.reference.mitsuba_scene import build_scene, render
from relit.reference.photographed import as_photographed
from relit.reference.pile import build_pile, instance_ids
from relit.relight import relight
from relit.scene import Asset, Camera, Flash, Instance
from support.two_pawns import two_pawns


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """(asset folder, photo): two objects on the ground, lit from one side."""
    folder = tmp_path_factory.mktemp("edit")
    mesh, material, poses, ground, environment = two_pawns()
    camera = Camera(72, 54, 80.0, 80.0, 36.0, 27.0, look_at([0, 3.5, 5.0], (0, 0.4, 0)))
    instances = (Instance(10, poses[0]), Instance(20, poses[1]))
    asset = Asset(
        mesh, material, poses[0], environment, (("photo.png", camera),), {}, None, instances, ground
    )
    pile = build_pile(mesh, material, poses, ground)
    picture = render(
        build_scene(pile.mesh, pile.material, np.eye(4), environment), camera, spp=64, seed=9
    )
    write_srgb(folder / "photo.png", np.clip(picture[..., :3], 0, 1))
    return save_asset(folder / "asset", asset), folder / "photo.png"


@pytest.mark.slow
def test_the_photo_changes_only_where_the_object_and_what_it_lights_are(run, tmp_path):
    folder, photo = run
    edit(folder, tmp_path / "red", photo=photo, base_color=(0.8, 0.05, 0.05), spp=16)
    before, after = read_image(photo).rgb, read_image(tmp_path / "red" / "photo.png").rgb
    assert np.abs(after - before)[:6].max() < 0.06  # far from the objects
    changed = np.abs(after - before).max(-1) > 0.15
    assert changed.mean() > 0.03 and (after[changed][:, 0] > after[changed][:, 1]).mean() > 0.9
    assert np.allclose(
        load_asset(tmp_path / "red").material.base_color.reshape(-1, 3)[0],
        [0.8, 0.05, 0.05],
        atol=0.01,
    )


def test_a_removed_instance_leaves_ground_without_its_shadow(run, tmp_path):
    folder, photo = run
    edit(folder, tmp_path / "one", photo=photo, remove=[20], spp=32)
    after, asset = read_image(tmp_path / "one" / "photo.png").rgb, load_asset(folder)
    camera = asset.cameras[0][1]
    u, v, _ = camera.project(np.array([1.0, 0.6, 0.0])).astype(int)
    place = after[v - 2 : v + 3, u - 2 : u + 3].reshape(-1, 3)
    assert np.ptp(place.mean(0)) < 0.06  # grey ground, not the coloured object
    assert [i.label for i in load_asset(tmp_path / "one").instances] == [10]
    with pytest.raises(UserError, match="label 30"):
        edit(folder, tmp_path / "none", remove=[30])
    with pytest.raises(UserError, match="nothing would be left"):
        edit(folder, tmp_path / "none", remove=[10, 20])


def test_an_instance_that_only_a_further_photo_shows_can_be_removed(run, tmp_path):
    """It is in the scene like any other; where the first photo has its label, that one is meant."""
    folder, photo = run
    asset = load_asset(folder)
    near, far = asset.instances
    save_asset(tmp_path / "asset", replace(asset, instances=(near, replace(far, photo=1))))
    edit(tmp_path / "asset", tmp_path / "one", photo=photo, remove=[20], spp=32)
    after, camera = read_image(tmp_path / "one" / "photo.png").rgb, asset.cameras[0][1]
    u, v, _ = camera.project(np.array([1.0, 0.6, 0.0])).astype(int)
    assert np.ptp(after[v - 2 : v + 3, u - 2 : u + 3].reshape(-1, 3).mean(0)) < 0.06
    assert [i.label for i in load_asset(tmp_path / "one").instances] == [10]
    twins = (near, replace(far, label=10, photo=1))
    save_asset(tmp_path / "twins", replace(asset, instances=twins))
    edit(tmp_path / "twins", tmp_path / "left", remove=[10])
    assert [i.photo for i in load_asset(tmp_path / "left").instances] == [1]


@pytest.mark.parametrize("labels", [False, True])
def test_no_rim_of_a_removed_instance_stays_where_the_model_is_too_small(run, tmp_path, labels):
    folder, photo = run
    asset = load_asset(folder)
    thin = replace(
        asset.mesh,
        vertices=(asset.mesh.vertices * np.float32([0.6 if labels else 0.85, 1, 1])).astype(
            np.float32
        ),
    )
    poses = [i.world_from_object for i in asset.instances]
    true = build_pile(asset.mesh, asset.material, poses, asset.ground)
    ids = instance_ids(
        build_scene(true.mesh, true.material, np.eye(4), asset.environment),
        true,
        asset.cameras[0][1],
    )
    save_asset(tmp_path / "thin", replace(asset, mesh=thin))
    write_srgb(tmp_path / "photo.png", read_image(photo).rgb)
    if labels:
        cv_write(str(tmp_path / "photo_labels.png"), np.array([10, 20, 0], np.uint8)[ids])
    edit(tmp_path / "thin", tmp_path / "one", photo=tmp_path / "photo.png", remove=[20], spp=32)
    after = read_image(tmp_path / "one" / "photo.png").rgb
    left = np.ptp(after, axis=-1)[ids == 1]  # the ground is grey, the object is not
    assert np.ptp(read_image(photo).rgb, axis=-1)[ids == 1].max() > 0.2 and left.max() < 0.1
    kept = ids == 0
    assert (
        np.abs(after - read_image(photo).rgb)[kept].max(-1).mean() < 0.05
    )  # the other one is the photo's


def test_an_inserted_object_stands_on_the_ground_and_darkens_it(run, tmp_path):
    folder, photo = run
    camera = load_asset(folder).cameras[0][1]
    foot = camera.project(np.array([0.0, 0.0, 0.9]))[:2]
    out = insert(
        folder, folder, tmp_path / "new.png", photo=photo, at=tuple(foot), size=0.6, spp=32
    )
    before, after = read_image(photo).rgb, read_image(out).rgb
    u, v = foot.astype(int)
    assert np.abs(after - before)[v - 8 : v - 1, u - 2 : u + 3].mean() > 0.04  # its body
    near = (after - before)[v : v + 3, u - 5 : u + 6].mean()
    assert near < 0.002  # contact shadow: no brighter than before
    assert np.abs(after - before)[:5].max() < 0.06
    with pytest.raises(UserError, match="outside the photo"):
        insert(folder, folder, tmp_path / "x.png", photo=photo, at=(500, 5))
    with pytest.raises(UserError, match="does not meet the ground"):
        look_up = camera.with_pose(look_at([0, 1, 5.0], (0, 3, 0)))
        from relit.edit import mesh_on_ground

        asset = load_asset(folder)
        mesh_on_ground(asset.mesh, asset, look_up, (36, 5), 1.0, 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["collection", "flash"])
def test_a_photo_is_changed_under_its_own_light(run, tmp_path, kind):
    """Of a collection it is four times as bright as the median of the lights; of a flash capture
    there is no environment at all."""
    pile = load_asset(run[0])
    one = replace(pile, instances=(), ground=None, world_from_asset=np.eye(4))
    if kind == "collection":
        asset = replace(
            one,
            lights=(4 * one.environment, one.environment),
            cameras=(one.cameras[0], ("other.png", one.cameras[0][1])),
        )
    else:
        material = replace(
            one.material, diffuse=one.material.base_color, metallic=np.zeros((1, 1), np.float32)
        )
        flash = Flash(np.array([-0.5, 0.2, 0.0]), np.full(3, 60.0))
        asset = replace(one, material=material, environment=None, flash=flash)
    shown = as_photographed(asset)("photo.png", asset.cameras[0][1], spp=64)
    write_srgb(tmp_path / "photo.png", np.clip(shown[..., :3], 0, 1))
    edit(
        save_asset(tmp_path / "asset", asset),
        tmp_path / "same",
        photo=tmp_path / "photo.png",
        tint=(1, 1, 1),
        spp=32,
    )
    before, after = (
        read_image(tmp_path / "photo.png").rgb,
        read_image(tmp_path / "same" / "photo.png").rgb,
    )
    inside = shown[..., 3] > 0.99
    assert before[inside].mean() > 0.05 and after[inside].mean() == pytest.approx(
        before[inside].mean(), rel=0.08
    )
    edit(
        tmp_path / "asset",
        tmp_path / "dark",
        photo=tmp_path / "photo.png",
        tint=(0.2, 0.2, 0.2),
        spp=32,
    )
    assert (
        read_image(tmp_path / "dark" / "photo.png").rgb[inside].mean()
        < 0.75 * before[inside].mean()
    )


def test_the_pile_under_another_light(run, tmp_path):
    """From the photo's camera all objects on their ground; on a turntable the object alone."""
    folder, asset = run[0], load_asset(run[0])
    write_linear(tmp_path / "even.exr", np.ones((8, 16, 3), np.float32))
    file = relight(
        folder, tmp_path / "even.exr", tmp_path / "photo", cameras="capture", spp=8, exr=True
    )[1]
    shown, camera = read_data(file), asset.cameras[0][1]
    bare = render(
        build_scene(
            asset.mesh, asset.material, asset.world_from_asset, np.ones((8, 16, 3), np.float32)
        ),
        camera,
        spp=8,
    )
    for x in (-1.0, 1.0):
        u, v, _ = camera.project(np.array([x, 0.6, 0.0])).astype(int)
        assert np.ptp(shown[v, u, :3]) > 0.05, x  # the objects are coloured
    assert (shown[..., 3] > 0.99).mean() > 0.7 > (bare[..., 3] > 0.99).mean()  # the ground
    turned = read_data(
        relight(
            folder,
            tmp_path / "even.exr",
            tmp_path / "orbit",
            cameras="orbit:1",
            size=48,
            spp=8,
            exr=True,
        )[1]
    )
    assert turned[0, 0, 3] == 0 and turned[-1, 0, 3] == 0


def test_another_photo_is_refused(run, tmp_path):
    write_srgb(tmp_path / "photo.png", np.zeros((20, 80, 3), np.float32))
    with pytest.raises(UserError, match="another photo"):
        edit(run[0], tmp_path / "a", photo=tmp_path / "photo.png", roughness=0.5)
    write_srgb(tmp_path / "holiday.png", read_image(run[1]).rgb)
    for change in (
        lambda: edit(run[0], tmp_path / "a", photo=tmp_path / "holiday.png", roughness=0.5),
        lambda: insert(
            run[0], run[0], tmp_path / "x.png", photo=tmp_path / "holiday.png", at=(5, 5)
        ),
    ):
        with pytest.raises(UserError, match="none of the photos") as error:
            change()
        assert "photo.png" in error.value.why and "holiday.png" in error.value.fix


@pytest.fixture(scope="module")
def two(run, tmp_path_factory):
    """(asset folder, folder of photos): the same pile in two photos from different sides; the
    second one's labels are its own."""
    folder, asset = tmp_path_factory.mktemp("two"), load_asset(run[0])
    poses = [i.world_from_object for i in asset.instances]
    pile = build_pile(asset.mesh, asset.material, poses, asset.ground)
    scene = build_scene(pile.mesh, pile.material, np.eye(4), asset.environment)
    second = asset.cameras[0][1].with_pose(look_at([4.0, 3.5, 2.5], (0, 0.4, 0)))
    cameras = (("a/photo.png", asset.cameras[0][1]), ("b/photo.png", second))
    for name, camera in cameras:
        write_srgb(folder / name, np.clip(render(scene, camera, spp=64, seed=9)[..., :3], 0, 1))
    ids = instance_ids(scene, pile, second)
    cv_write(
        str(folder / "b" / "photo_labels.png"), np.array([20, 10, 0], np.uint8)[ids]
    )  # the other way round
    meta = {"inputs": digests(folder, [name for name, _ in cameras])}
    return save_asset(folder / "asset", replace(asset, cameras=cameras, meta=meta)), folder


def test_the_camera_is_that_of_the_photo(two, tmp_path):
    run, folder = two
    asset = load_asset(run)
    assert [camera_of(asset, folder / name)[0] for name in ("a/photo.png", "b/photo.png")] == [
        "a/photo.png",
        "b/photo.png",
    ]
    (tmp_path / "copy.png").write_bytes((folder / "b" / "photo.png").read_bytes())
    assert camera_of(asset, tmp_path / "copy.png")[0] == "b/photo.png"  # by its content
    (tmp_path / "photo.png").write_bytes((folder / "b" / "photo.png").read_bytes())
    assert camera_of(asset, tmp_path / "photo.png")[0] == "b/photo.png"  # by name it could be both
    (tmp_path / "photo.png").write_bytes(b"retouched")
    with pytest.raises(UserError, match="cannot be told"):
        camera_of(asset, tmp_path / "photo.png")


def test_the_second_photo_of_a_pile_is_changed_from_its_own_camera(two, tmp_path):
    run, folder = two
    photo, asset = folder / "b" / "photo.png", load_asset(run)
    before, camera = read_image(photo).rgb, asset.cameras[1][1]
    edit(run, tmp_path / "same", photo=photo, tint=(1, 1, 1), spp=16)
    after = read_image(tmp_path / "same" / "photo.png").rgb
    assert (
        np.abs(after - before).mean() < 0.03
    )  # an unchanged material lies where the photo shows it
    edit(run, tmp_path / "one", photo=photo, remove=[20], spp=16)
    after = read_image(tmp_path / "one" / "photo.png").rgb
    (u, v, _), (x, y, _) = (
        camera.project(np.array([s, 0.6, 0.0])).astype(int) for s in (1.0, -1.0)
    )
    assert np.ptp(after[v - 2 : v + 3, u - 2 : u + 3].reshape(-1, 3).mean(0)) < 0.06  # grey ground
    assert np.abs(after - before)[y - 3 : y + 4, x - 3 : x + 4].mean() < 0.02  # the other one stays
    foot = camera.project(np.array([1.0, 0.0, 1.6]))[:2]
    out = insert(run, run, tmp_path / "new.png", photo=photo, at=tuple(foot), size=0.6, spp=16)
    u, v = foot.astype(int)
    assert np.abs(read_image(out).rgb - before)[v - 8 : v - 1, u - 2 : u + 3].mean() > 0.04


def test_labels_of_another_photo_in_the_numbers_of_the_run():
    shown = np.array([[10, 10, 20, 20, 0, 0]])
    assert as_shown(np.array([[7, 7, 8, 0, 9, 9]]), shown).tolist() == [[10, 10, 20, 0, 0, 0]]

"""The recipe of flash captures: what it refuses, what its options do, and a small capture from its
photos to figures."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from relit.capture.photo import with_camera
from relit.errors import UserError
from relit.fit.flash import recipe as flash
from relit.fit.passes.load_photos import UnitPhotos
from relit.fit.passes.pixels import make_bank
from relit.masks.threshold import Backdrop
from relit.rendering.appearance.flash_light import start_learnt
from relit.scene import Capture, Photo, Sphere
from support import flash_ball as scene


def photos_of(views, value):
    """Photos of one brightness, all object."""
    size, count = views[0].width, len(views)
    masks = [np.ones((size, size), np.float32)] * count
    bank = make_bank(views, [np.full((size, size, 3), value, np.float32)] * count, masks)
    return UnitPhotos(bank, views, masks, np.full(3, value), [f"{k}.png" for k in range(count)])


def test_photos_of_a_lit_room_are_refused(device):
    photos = photos_of(scene.cameras(4, 16), 0.3)
    with pytest.raises(UserError, match="surroundings are not dark"):
        flash.check_photos(replace(photos, masks=None))


def test_photos_before_a_bright_backdrop_are_refused():
    photo = lambda mask: SimpleNamespace(load=SimpleNamespace(mask=mask))  # noqa: E731
    with pytest.raises(UserError, match="surroundings are not dark") as error:
        flash.check_backdrop(
            SimpleNamespace(photos=[photo(Backdrop(False, 0.05))] * 3 + [photo(None)])
        )
    with pytest.raises(
        UserError, match="surroundings are not dark"
    ):  # of photos that are undistorted or scaled, too
        flash.check_backdrop(
            SimpleNamespace(photos=[SimpleNamespace(load=photo(Backdrop(False, 0.05)))] * 4)
        )
    assert "--capture multiview" in error.value.fix
    for masks in ([Backdrop(True, 0.05)] * 3, [Path("a.png")] * 3, [None]):
        flash.check_backdrop(SimpleNamespace(photos=[photo(m) for m in masks]))


def test_a_bright_backdrop_is_noticed_behind_a_lens_too():
    """Cameras that structure from motion finds, and COLMAP's, have a distortion, and the photo is
    undistorted as it is read."""
    camera = scene.cameras(1, 64)[0]
    taken = Photo("a.jpg", SimpleNamespace(mask=Backdrop(False, 0.05)), 64, 64)
    photo = with_camera(taken, replace(camera, distortion=(0.1, 0.0, 0.0, 0.0)))
    assert photo.load is not taken.load
    with pytest.raises(UserError, match="surroundings are not dark"):
        flash.check_backdrop(SimpleNamespace(photos=[photo] * 3))


def test_a_flash_that_did_not_fire(device):
    views = scene.cameras(4, 16)
    photos = photos_of(views, 0.001)
    with pytest.raises(UserError, match="black") as error:
        flash.check_photos(photos)
    assert "did not fire" in error.value.why
    with pytest.raises(
        UserError, match="photos are black"
    ):  # no backdrop is found in them either: that is not their fault
        flash.check_photos(replace(photos, masks=None))


def test_over_exposed_photos(device):
    views = scene.cameras(4, 16)
    photos = photos_of(views, 1.0)
    with pytest.raises(UserError, match="100 % of the object's pixels are over-exposed"):
        flash.check_photos(photos)


def test_cameras_at_one_spot(device):
    views = [scene.cameras(4, 16)[0]] * 4
    photos = photos_of(views, 0.3)
    with pytest.raises(UserError, match="from one place"):
        flash.check_photos(photos)


def test_good_photos_pass(device):
    views = scene.cameras(6, 16)
    photos = photos_of(views, 0.3)
    flash.check_photos(photos)


def test_options():
    assert (
        flash.options_for("draft").texture
        < flash.options_for("standard").texture
        < flash.options_for("high").texture
    )
    with pytest.raises(UserError, match="is not known"):
        flash.options_for("draf")
    with pytest.raises(ValueError, match="without=shadows is not known"):
        flash.FlashOptions(without=("shadows",))
    with pytest.raises(ValueError, match="bounces"):
        flash.FlashOptions(bounces=0)


@pytest.mark.parametrize(
    "part, name, value",
    [
        ("offset", "offset_rate", 0.0),
        ("refinement", "slope_rate", 0.0),
        ("interreflection", "directions", 0),
        ("shadow", "shadow", False),
    ],
)
def test_parts_that_are_switched_off(part, name, value):
    full, less = (flash.surface_options(flash.FlashOptions(without=w)) for w in ((), (part,)))
    assert getattr(full, name) != value and getattr(less, name) == value
    assert replace(full, **{name: value}) == less


def test_the_flash_is_held_until_the_shape_stands(device):
    rates = flash.rates_by_step(start_learnt()[1], 30)
    early, late = np.array(rates(29)), np.array(rates(30))
    assert (early[:3] == 0).all() and (late[:3] > 0).all() and (early[3:] == late[3:]).all()


@pytest.mark.slow
def test_the_asset_stands_in_the_frame_of_the_cameras():
    """A sphere of radius 2 around (1, 0, 0): lengths double, intensity goes with their square, the
    product with the albedo stays."""
    view = scene.cameras(1, 16)[0]
    photo = Photo("a.png", None, 16, 16, view)
    capture = Capture(Path("."), "test", (photo,), sphere=Sphere(np.array([1.0, 0, 0]), 2.0))
    one = np.ones((4, 4), np.float32)
    normal = np.zeros((4, 4, 3), np.float32)
    normal[..., 2] = 1
    offset = np.array([0.1, -0.05, 0])
    maps = flash.PlasticMaps(
        normal + 0.2, 0.5 * one, 0.09 * one, normal, offset, intensity=np.array([3.0])
    )
    asset = flash.assemble(capture, scene.ball(6, 8), maps, 1.49)
    np.testing.assert_allclose(asset.flash.offset, [0.2, -0.1, 0])
    np.testing.assert_allclose(asset.flash.intensity, 12)
    np.testing.assert_allclose(asset.material.roughness, 0.3, rtol=1e-6)
    placed = asset.mesh.vertices @ asset.world_from_asset[:3, :3].T + asset.world_from_asset[:3, 3]
    np.testing.assert_allclose((placed.max(0) + placed.min(0)) / 2, [1, 0, 0], atol=1e-5)
    assert np.ptp(placed[:, 1]) == pytest.approx(2 * 2 * 0.7, rel=1e-4)


@pytest.mark.slow
def test_from_photos_to_figures(device, tmp_path):
    from relit.asset.gltf import write_glb
    from relit.capture.open import open_capture
    from relit.evaluate.flash import evaluate_flash_asset, load_flash_truth
    from relit.run import Run
    from relit.synthesize.flash import synthesize_flash
    from relit.synthesize.procedural import pawn

    mesh, material = pawn(24, 36, 64)
    write_glb(tmp_path / "pawn.glb", mesh, material)
    folder = synthesize_flash(
        tmp_path / "pawn.glb",
        (),
        tmp_path / "c",
        views=12,
        test_views=1,
        resolution=40,
        spp=8,
        test_spp=16,
    )
    options = flash.FlashOptions(
        levels=(40,),
        level_steps=(80,),
        rays=1024,
        faces=2000,
        texture=64,
        surface_steps=48,
        points=1024,
        bounces=1,
    )
    with Run.open(tmp_path / "run", {}) as run:
        asset = flash.reconstruct(open_capture(folder), run, options)
    figures = {
        k: v["value"]
        for k, v in evaluate_flash_asset(asset, load_flash_truth(folder), spp=8)["metrics"].items()
    }
    assert figures["novel_psnr"] > 24 and figures["chamfer_percent"] < 2
    assert figures["flash_angle"] < 2.9  # 3.0 where it stands at the camera
    assert asset.meta["material"] == "rough_plastic"

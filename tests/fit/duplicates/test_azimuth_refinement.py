"""Turns about an axis that were guessed, told by rendering: a glossy vase beside another one, under
a sun."""

from dataclasses import replace

import numpy as np
import pytest

from relit.conventions import similarity
from relit.fit.duplicates import azimuth_refinement as module
from relit.fit.duplicates import recipe as duplicates
from relit.fit.duplicates.azimuth_refinement import turned_as_shown
from relit.fit.duplicates.placed_pile import PlacedPile
from relit.fit.registration.instances.azimuth import turned_by
from relit.fit.registration.instances.views import InstanceView, ViewId
from relit.geometry.se3 import look_at, rotation_angle
from relit.recipe import FitContext
from relit.reference.photographed import as_photographed
from relit.run import Run
from relit.scene import Asset, Camera, Instance, Material
from support.vase import AXIS, vase

SIZE = 96


@pytest.fixture(scope="module")
def photographed():
    """(asset, camera, view of the vase 7, its object_from_world)."""
    mesh = vase()
    mesh = replace(mesh, uvs=(mesh.vertices[:, [0, 2]] + 0.5).astype(np.float32))
    rng = np.random.default_rng(3)
    paint = np.kron(rng.uniform(0.1, 0.9, (8, 8, 3)), np.ones((8, 8, 1))).astype(np.float32)
    light = np.full((16, 32, 3), 0.4, np.float32)
    light[3, 20] = 60.0
    places = {
        3: similarity(np.eye(3), np.array([1.2, 0, 0])),
        7: similarity(np.eye(3), np.array([0, 0, 0.1])),
    }
    eye = np.array([0.3, 0.8, 2.2])
    camera = Camera(
        SIZE,
        SIZE,
        1.6 * SIZE,
        1.6 * SIZE,
        SIZE / 2,
        SIZE / 2,
        look_at(eye, np.array([0, 0, 0.1]), np.array([0, 1.0, 0])),
    )
    instances = tuple(Instance(k, place) for k, place in places.items())
    material = Material(paint, np.full((64, 64), 0.25, np.float32), np.zeros((64, 64), np.float32))
    asset = Asset(
        mesh, material, places[3], light, (("photo", camera),), {}, None, instances=instances
    )
    picture = as_photographed(asset)("photo", camera, spp=64)
    own = as_photographed(replace(asset, instances=instances[1:]))("photo", camera, spp=16)[..., 3]
    view = InstanceView(
        7,
        camera.with_pose(np.eye(4)),
        picture[..., :3],
        (own > 0.5).astype(np.float32),
        np.ones((SIZE, SIZE), np.float32),
        1.0,
    )
    return asset, camera, view, np.linalg.inv(places[7])


@pytest.mark.slow
@pytest.mark.parametrize("angle", [0.0, 1.9, 3.14])
def test_the_turn_that_looks_like_the_photo_is_found(photographed, angle):
    asset, camera, view, pose = photographed
    guess = turned_by(pose, AXIS, angle)
    begun = module.with_instances_moved(asset, {ViewId(0, 7): np.linalg.inv(guess) @ pose})
    seen = []
    found = turned_as_shown(begun, [view], [camera], guess[None], AXIS, progress=seen.append)
    assert rotation_angle(found[0][:3, :3] @ pose[:3, :3].T) < 3.0
    assert np.allclose(
        found[0] @ np.array([0, 0.2, 0.1, 1]), pose @ np.array([0, 0.2, 0.1, 1]), atol=1e-6
    )  # the axis stays where it is
    assert seen == list(range(1, module.SCENES + 1))
    assert begun.instances[0].world_from_object is asset.instances[0].world_from_object


@pytest.mark.slow
def test_only_guessed_instances_are_turned_and_a_rerun_reads_them_back(
    photographed, tmp_path, monkeypatch
):
    asset, camera, view, pose = photographed
    guess = turned_by(pose, AXIS, 2.5)
    begun = module.with_instances_moved(asset, {ViewId(0, 7): np.linalg.inv(guess) @ pose})
    other = np.linalg.inv(asset.instances[0].world_from_object)
    names = (ViewId(0, 3), ViewId(0, 7))
    pile = PlacedPile(
        mesh=asset.mesh,
        radiance=np.zeros((2, 1, 3)),
        poses=np.array([other, guess]) @ camera.world_from_camera,
        ids=names,
        views=names,
        view_instances=np.arange(2),
        motions=np.eye(4)[None],
        related=np.ones(1, bool),
        guessed=names[1:],
    )
    views = [replace(view, label=3), view]
    with Run.open(tmp_path / "run", {}) as run:
        poses = duplicates.turns_stage(begun, pile, views, camera, FitContext(run, None, 0)).poses
        assert np.array_equal(poses[0], pile.poses[0])
        assert rotation_angle(poses[1][:3, :3] @ (pose @ camera.world_from_camera)[:3, :3].T) < 3.0
        monkeypatch.setattr(duplicates, "turned_as_shown", None)
        assert np.array_equal(
            duplicates.turns_stage(begun, pile, views, camera, FitContext(run, None, 0)).poses,
            poses,
        )


def test_what_shows_nothing_whole_stays_as_it_is(photographed):
    asset, camera, view, pose = photographed
    hidden = replace(view, known=np.zeros_like(view.known))
    assert np.allclose(turned_as_shown(asset, [hidden], [camera], pose[None], AXIS)[0], pose)


@pytest.mark.slow
@pytest.mark.parametrize("angle", [0.0, np.pi])
def test_where_two_turns_look_alike_the_one_it_has_stays(photographed, angle):
    asset, camera, view, pose = photographed
    paint = asset.material.base_color
    alike = replace(
        asset, material=replace(asset.material, base_color=(paint + paint[::-1, ::-1]) / 2)
    )
    picture = as_photographed(alike)("photo", camera, spp=64)[..., :3]
    guess = turned_by(pose, AXIS, angle)
    begun = module.with_instances_moved(alike, {7: np.linalg.inv(guess) @ pose})
    found = turned_as_shown(
        begun, [replace(view, rgb=picture * 0.9)], [camera], guess[None], AXIS
    )  # a light that is somewhat off
    assert rotation_angle(found[0][:3, :3] @ guess[:3, :3].T) < 3.0


def test_a_picture_that_lies_a_pixel_aside_differs_no_more(photographed):
    asset, camera, view, _ = photographed
    scene = module.lit_scene(asset)
    photo, solid = module.compared(view)
    aside = module.moved_by(photo, np.array([[1, 0, 1.0], [0, 1, -0.8]]))
    there, off = (module.difference(scene, camera, p, solid, 0) for p in (photo, aside))
    plain = float(((aside - photo)[solid] ** 2).mean())
    assert plain > 1e-3  # it would have counted
    assert abs(off - there) < 0.1 * plain

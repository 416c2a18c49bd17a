"""Photos without masks: the whole scene first, then a shape from its depths, then the volume pass
before the fitted background."""

from dataclasses import replace

import numpy as np
import pytest

from relit.asset.asset import save_asset
from relit.asset.gltf import has_border
from relit.capture.open import open_capture
from relit.conventions import environment_directions, move_points, sample_environment
from relit.evaluate.photos import directions
from relit.fit.multiview.recipe import MultiviewOptions, reconstruct
from relit.images import write_linear
from relit.reference.mitsuba_scene import build_scene, render
from relit.run import Run
from relit.scene import Sphere
from support.lump import cameras, distance_to_truth, lump, write_cameras

OPTIONS = MultiviewOptions(
    hollows=0,
    levels=(24, 40),
    level_steps=(80, 80),
    rays=2048,
    background=48,
    explore_steps=200,
    faces=3000,
    texture=64,
    surface_steps=4,
    points=256,
    directions=16,
    light=8,
)


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    """The lump under and before a light with structure. So few photos all around that each sees a
    patch of background which no other
    sees: it could explain the photo without any object."""
    folder = tmp_path_factory.mktemp("unmasked")
    mesh, material = lump()
    d = environment_directions(32, 64)
    light = (0.5 + 0.3 * np.sin(5 * d) * np.cos(4 * d[..., [1, 2, 0]])).astype(np.float32)
    scene = build_scene(mesh, material, np.eye(4), light)
    for i, camera in enumerate(cameras()):
        picture = render(scene, camera, spp=16, seed=i)
        behind = sample_environment(light, directions(camera)) * (1 - picture[..., 3:])
        write_linear(folder / f"r_{i:02d}.exr", picture[..., :3] + behind)
    write_cameras(folder, cameras())
    return folder


@pytest.mark.slow
def test_a_shape_is_found_without_masks(photos, tmp_path):
    capture = open_capture(photos, masks="none", sphere=Sphere(np.zeros(3), 0.75))
    assert capture.photos[0].load().mask is None
    with Run.open(tmp_path / "run", {}) as run:
        asset = reconstruct(capture, run, OPTIONS, 0)
    assert (tmp_path / "run/stages/explore/DONE").exists()
    vertices = move_points(asset.world_from_asset, asset.mesh.vertices)
    assert distance_to_truth(vertices) < 0.02


@pytest.mark.slow
def test_photos_of_one_side_leave_the_other_side_open(photos, tmp_path):
    capture = open_capture(photos, masks="none", sphere=Sphere(np.zeros(3), 0.75))
    upper = tuple(p for p in capture.photos if p.camera.centre[1] > -0.6)
    with Run.open(tmp_path / "run", {}) as run:
        asset = reconstruct(replace(capture, photos=upper), run, OPTIONS, 0)
    assert has_border(asset.mesh)
    path = save_asset(tmp_path / "asset", asset)
    assert b'"doubleSided"' in (path / "object.glb").read_bytes()

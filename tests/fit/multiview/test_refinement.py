"""Camera refinement and normal priors on a capture that the test renders."""

from dataclasses import replace

import numpy as np
import pytest

from relit.capture.open import open_capture
from relit.conventions import move_points
from relit.fit.multiview.recipe import MultiviewOptions, reconstruct
from relit.geometry.se3 import camera_errors
from relit.images import read_data, write_linear
from relit.run import Run
from relit.scene import Sphere
from support.lump import cameras, distance_to_truth, shaken, write_cameras, write_photos

OPTIONS = MultiviewOptions(
    levels=(24, 48),
    level_steps=(80, 120),
    rays=1024,
    hollows=0,
    faces=3000,
    texture=64,
    surface_steps=4,
    points=256,
    light=8,
    directions=16,
)
BALL = Sphere(np.zeros(3), 0.75)


def poses(some):
    return np.array([c.world_from_camera for c in some])


def fit(folder, out, **changes):
    with Run.open(out, {}) as run:
        return reconstruct(open_capture(folder, sphere=BALL), run, replace(OPTIONS, **changes), 0)


def world_vertices(asset):
    return move_points(asset.world_from_asset, asset.mesh.vertices)


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    return write_photos(tmp_path_factory.mktemp("photos"), normals=1.0)


@pytest.fixture(scope="module")
def shaken_capture(photos, tmp_path_factory):
    folder = tmp_path_factory.mktemp("shaken")
    for file in photos.glob("r_??.exr"):
        (folder / file.name).write_bytes(file.read_bytes())
    write_cameras(folder, shaken(cameras(), 1.0, 0.02))
    return folder


@pytest.mark.slow
def test_refinement_brings_cameras_and_shape_nearer_to_the_truth(shaken_capture, tmp_path):
    before_angle, before_distance = camera_errors(
        poses(shaken(cameras(), 1.0, 0.02)), poses(cameras())
    )
    plain = fit(shaken_capture, tmp_path / "plain")
    refined = fit(shaken_capture, tmp_path / "refined", refine_cameras=2e-3)
    np.testing.assert_allclose(
        poses(c for _, c in plain.cameras), poses(shaken(cameras(), 1.0, 0.02)), atol=1e-9
    )
    angle, distance = camera_errors(poses(c for _, c in refined.cameras), poses(cameras()))
    assert (
        angle.mean() < 0.7 * before_angle.mean() and distance.mean() < 0.85 * before_distance.mean()
    )
    a, b = (distance_to_truth(world_vertices(asset)) for asset in (plain, refined))
    assert b < 0.8 * a


def volume_only(folder, out, normal):
    """Distance from the truth after a few steps of the volume pass, and the loss terms that were
    reported."""
    with Run.open(out, {}) as run:
        options = replace(OPTIONS, level_steps=(40, 40), normal=normal)
        asset = reconstruct(open_capture(folder, sphere=BALL), run, options, 0)
    return distance_to_truth(world_vertices(asset))


def with_normals(photos, folder, signs):
    """The same photos, with their normals times `signs` (x, y, z of the camera axes)."""
    folder.mkdir()
    for file in photos.iterdir():
        if "_normal" in file.name:
            write_linear(folder / file.name, np.array(signs, np.float32) * read_data(file)[..., :3])
        else:
            (folder / file.name).write_bytes(file.read_bytes())
    return folder


@pytest.mark.slow
def test_normal_priors_from_files_help_and_those_that_look_away_are_refused(photos, tmp_path):
    """The same photos, with true normals, none, normals with x the other way, and normals that look
    away from the camera."""
    mirrored, away = (
        with_normals(photos, tmp_path / "mirrored", (-1, 1, 1)),
        with_normals(photos, tmp_path / "away", (-1, -1, -1)),
    )
    assert any("16 photos have normal priors" in n for n in open_capture(photos, sphere=BALL).notes)
    none = volume_only(photos, tmp_path / "none", 0.0)
    true = volume_only(photos, tmp_path / "true", 0.3)
    wrong = volume_only(mirrored, tmp_path / "wrong", 0.3)  # z is still right
    assert true < 0.7 * none and true < 0.7 * wrong
    refused = open_capture(away, sphere=BALL)
    assert any(
        "normal priors are not used" in n and "look away from the camera" in n
        for n in refused.notes
    )
    assert all(photo.load().normal is None for photo in refused.photos)

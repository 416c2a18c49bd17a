"""A ball that is alike from all sides but for what is painted on it, under lights of its own in
every photo."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from relit.conventions import similarity
from relit.geometry.se3 import look_at
from relit.scene import Camera, Material, Mesh

SIZE, SPP = 160, 32


def painted_ball(plain: bool) -> tuple[Mesh, Material]:
    ball = trimesh.creation.uv_sphere(0.6, count=[80, 80])
    n = np.asarray(ball.vertices, np.float64) / 0.6
    uvs = np.stack(
        [np.arctan2(n[:, 1], n[:, 0]) / (2 * np.pi) + 0.5, np.arccos(n[:, 2].clip(-1, 1)) / np.pi],
        -1,
    )
    mesh = Mesh(
        ball.vertices.astype(np.float32),
        np.asarray(ball.faces, np.int32),
        n.astype(np.float32),
        uvs.astype(np.float32),
    )
    base = (
        np.full((36, 72, 3), 0.4, np.float32)
        if plain
        else np.random.default_rng(4).uniform(0.1, 0.8, (36, 72, 3)).astype(np.float32)
    )
    return mesh, Material(base, np.full((2, 2), 0.6, np.float32), np.zeros((2, 2), np.float32))


def turned(camera: Camera, degrees: float) -> Camera:
    """The camera about the vertical."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    return camera.with_pose(similarity(turn, np.zeros(3)) @ camera.world_from_camera)


def photos(plain: bool):
    """(mesh, pictures, cameras) of twelve photos."""
    from relit.fit.registration.fine_detail import detail_of
    from relit.reference.mitsuba_scene import build_scene, render

    (mesh, material), rng, pictures, cameras = painted_ball(plain), np.random.default_rng(1), [], []
    for i in range(12):
        a = 2.4 * i
        y = 0.2 + 0.6 * (i % 4) / 3
        eye = 2.2 * np.array([np.sqrt(1 - y * y) * np.cos(a), y, np.sqrt(1 - y * y) * np.sin(a)])
        camera = Camera(SIZE, SIZE, 1.5 * SIZE, 1.5 * SIZE, SIZE / 2, SIZE / 2, look_at(eye))
        light = np.full((8, 16, 3), 0.4, np.float32)
        light[1:3, rng.integers(0, 12) :][:, :3] = rng.uniform(2, 5, 3)
        picture = render(build_scene(mesh, material, np.eye(4), light), camera, spp=SPP, seed=i)
        pictures.append(detail_of(picture[..., :3], picture[..., 3]))
        cameras.append(camera)
    return mesh, pictures, cameras


@pytest.fixture(scope="module")
def painted(device):
    return photos(plain=False)


@pytest.mark.slow
def test_a_photo_from_the_wrong_side_is_told_by_what_is_painted(painted):
    from relit.fit.registration.fine_detail import compare_detail, surface_of

    mesh, pictures, truth = painted
    cameras = [turned(c, 180) if i in (3, 7) else c for i, c in enumerate(truth)]
    choices = [(i, turned(c, t)) for i, c in enumerate(cameras) for t in (90, 180, 270)]
    told = compare_detail(surface_of(mesh), pictures, cameras, choices)
    found = told.moved
    assert set(found) == {3, 7} and not told.as_well
    for i, camera in found.items():
        assert np.allclose(camera.world_from_camera, truth[i].world_from_camera, atol=1e-6)


@pytest.mark.slow
def test_a_new_photo_is_held_against_the_others(painted):
    from relit.fit.registration.fine_detail import compare_detail, photo_values_at, surface_of

    mesh, pictures, truth = painted
    surface = surface_of(mesh)
    laid = np.array(
        [photo_values_at(surface, c, p) for c, p in zip(truth[1:], pictures[1:], strict=True)]
    )
    wrong = turned(truth[0], 180)
    choices = [(0, turned(truth[0], t)) for t in (0, 90, 270)]
    assert compare_detail(surface, pictures[:1], [wrong], choices, laid).moved == {0: choices[0][1]}
    assert compare_detail(surface, pictures[:1], truth[:1], choices[1:], laid).moved == {}


@pytest.mark.slow
def test_a_plain_ball_tells_nothing(device):
    from relit.fit.registration.fine_detail import compare_detail, surface_of

    mesh, pictures, cameras = photos(plain=True)
    choices = [(i, turned(c, t)) for i, c in enumerate(cameras) for t in (90, 180, 270)]
    told = compare_detail(surface_of(mesh), pictures, cameras, choices)
    assert len(told.moved) <= 1 and len(told.as_well) >= 6  # and so it is said


@pytest.mark.slow
def test_likeness_of_poses(painted):
    from relit.fit.registration.fine_detail import expected, likeness, photo_values_at, surface_of

    mesh, pictures, cameras = painted
    surface = surface_of(mesh)
    laid = np.array(
        [photo_values_at(surface, c, p) for c, p in zip(cameras, pictures, strict=True)]
    )
    side = (np.asarray(mesh.vertices) @ cameras[0].centre) > 0
    assert (
        np.isfinite(laid[0]).sum() > 100 and not np.isfinite(laid[0][~side]).any()
    )  # it sees its own side alone
    shown = expected(laid[1:])
    right = likeness(surface, cameras[0], pictures[0], shown)
    assert right > 0.5
    for degrees in (3, 90, 180):
        own = likeness(surface, turned(cameras[0], degrees), pictures[0], shown)
        assert own > right - 0.15 if degrees == 3 else own < 0.3
    behind = cameras[0].with_pose(look_at(cameras[0].centre, 2 * cameras[0].centre))
    assert likeness(surface, behind, pictures[0], shown) == -1
    assert np.isnan(expected(laid[:3])).all()  # too few see anything


@pytest.mark.slow
def test_photos_in_wrong_places_are_not_borne_out(painted):
    from relit.fit.registration.fine_detail import detail_correlation, surface_of

    mesh, pictures, truth = painted
    surface = surface_of(mesh)
    wrong = [turned(c, 180) if i in (3, 7) else c for i, c in enumerate(truth)]
    detail = detail_correlation(surface, pictures, wrong)
    assert detail[[3, 7]].max() < 0.25 < np.delete(detail, [3, 7]).min()
    away = [turned(c, 73 * i) for i, c in enumerate(truth)]
    assert np.median(detail_correlation(surface, pictures, away)) < 0.25
    four = detail_correlation(surface, pictures[:5], truth[:5])  # a single other photo has to do
    assert np.median(four) > 0.25


def test_what_is_said_of_photos_that_are_not_borne_out():
    from relit.fit.collection.recipe import say_borne_out

    def said(detail, as_well=()):
        lines, turns = [], np.zeros(len(detail))
        turns[list(as_well)] = 90.0
        say_borne_out(
            np.array(detail),
            turns,
            [f"{i}.jpg" for i in range(len(detail))],
            SimpleNamespace(say=lines.append),
        )
        return lines

    assert len(said([0.5, 0.6, 0.4])) == 1
    assert "1.jpg" in said([0.5, 0.1, 0.4])[1] and "0.jpg" not in said([0.5, 0.1, 0.4])[1]
    assert "most photos" in said([0.5, 0.1, -1.0])[1] and len(said([0.5, 0.1, -1.0], [1, 2])) == 2
    assert "3.jpg" in said([0.5] * 9, [3])[1] and "alike" not in said([0.5] * 9, [3])[1]
    assert (
        "alike from several sides" in said([0.5] * 9, [0, 3])[1]
        and "90 degrees" in said([0.5] * 9, [0, 3])[1]
    )
    # whose own place is not borne out says nothing of the object
    assert (
        len(said([0.5] * 6 + [0.1] * 4, [6, 7, 8, 9])) == 2
        and "9.jpg" in said([0.5] * 6 + [0.1] * 4, [6, 7, 8, 9])[1]
    )
    assert (
        "1 of 6 photos fit" in said([0.5] * 6 + [0.1] * 4, [0, 6, 7])[2]
        and "alike" in said([0.5] * 6 + [0.1] * 4, [0])[2]
    )
    assert said([0.5] * 12 + [0.1] * 11)[1].endswith("21.jpg ...")

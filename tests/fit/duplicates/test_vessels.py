"""Ends of bodies of revolution: cut off where no silhouette needs them, and opened where the light
says that they are mouths."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from relit.asset.gltf import write_glb
from relit.capture.open import open_capture
from relit.conventions import scale_of
from relit.fit.duplicates import shape, vessel_trial
from relit.fit.duplicates.poses import all_views
from relit.fit.duplicates.vessel_trial import FLOORS, lowest_of
from relit.fit.duplicates.vessels import End, body_axis, ends_of, floor_under, hollowed, mouths
from relit.fit.passes.material_priors import SurfaceOptions
from relit.fit.registration.instances.views import InstanceView
from relit.geometry.hull import distance_of
from relit.geometry.mesh import extract_mesh
from relit.geometry.revolution_axis import Axis, revolution_axis
from relit.geometry.sdf import node_positions
from relit.geometry.se3 import look_at
from relit.images import write_linear
from relit.recipe import FitContext
from relit.run import Run
from relit.scene import Camera
from relit.synthesize.duplicates import synthesize_duplicates
from relit.synthesize.procedural import studio
from support.lathe import BASE, BOTTOM, CUP, FLOOR, PLUG, RIM, TOP, WALL, side, spotted, turned
from support.pile_of_pawns import small_options, true_poses

N = 64
P = node_positions(N)
UP = Axis(np.zeros(3), np.array([0.0, 1.0, 0.0]))


def coned(scale=1.0, n=N):
    """The plug with the cone on its mouth that silhouettes from above the rim leave."""
    p = node_positions(n) / scale
    r, y = np.hypot(p[..., 0], p[..., 2]), p[..., 1]
    return scale * np.maximum(r - np.where(y < TOP, side(y), RIM - 1.2 * (y - TOP)), BOTTOM - y)


def silhouettes(values, heights=(1.2, 1.6, 2.2, -1.4, -2.0)):
    """What cameras see of a body whose end they all see from above or below."""
    cameras, views = [], []
    for k, height in enumerate(heights):
        a = 2.4 * k
        eye = np.array([np.cos(a), 0, np.sin(a)]) * np.sqrt(9 - height**2) + [0, height, 0]
        c = Camera(96, 96, 110.0, 110.0, 48.0, 48.0, look_at(eye))
        cover = np.zeros((96, 96), np.float32)
        q = c.project(node_positions(160)[values].astype(float))
        cover[np.clip(q[:, 1].astype(int), 0, 95), np.clip(q[:, 0].astype(int), 0, 95)] = 1
        cameras.append(c)
        views.append(InstanceView(k, c, np.zeros((96, 96, 3)), cover, np.ones((96, 96)), 1.0))
    return views, cameras


def test_axis_of_a_body_of_revolution_and_of_a_box():
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    p = P @ turn  # the body is turned by its inverse
    r, y = np.hypot(p[..., 0] - 0.1, p[..., 2]), p[..., 1]
    handle = np.hypot(p[..., 2], np.hypot(p[..., 0] - 0.65, y) - 0.16) - 0.06
    axis = body_axis(extract_mesh(np.minimum(np.maximum(np.abs(y) - 0.35, r - side(y)), handle)))
    assert abs(axis.direction @ turn[:, 1]) > np.cos(np.radians(1.5))
    assert axis.radii(turn @ [0.1, 0, 0]) < 0.02
    assert np.allclose(axis.heights(axis.point + 0.3 * axis.direction), 0.3)
    assert body_axis(extract_mesh((np.abs(P) - [0.5, 0.45, 0.3]).max(-1))) is None


def test_normals_that_meet_a_line_tell_it():
    rng = np.random.default_rng(1)
    a = rng.uniform(0, 2 * np.pi, 4000)
    h = rng.uniform(-1, 1, 4000)
    r = 0.4 + 0.2 * h**2
    n = np.stack([np.cos(a), -0.4 * h, np.sin(a)], -1)
    p = np.stack([r * np.cos(a) + 3, h, r * np.sin(a) - 2], -1)
    axis, missed = revolution_axis(p, n / np.linalg.norm(n, axis=1, keepdims=True))
    assert (
        missed < 1e-6
        and axis.radii(np.array([3.0, 7.0, -2.0])) < 1e-6
        and abs(axis.direction[1]) > 1 - 1e-9
    )


def test_ends_are_cut_where_silhouettes_let_them_be():
    fine = node_positions(160)
    plug = (np.abs(fine[..., 1]) < TOP) & (
        np.hypot(fine[..., 0], fine[..., 2]) < side(fine[..., 1])
    )
    views, cameras = silhouettes(plug)
    flat, ends = ends_of(coned(), UP, views, cameras)
    top, bottom = ends
    voxel = 2 / (N - 1)
    assert (top.sign, bottom.sign) == (1, -1)
    assert abs(top.height - TOP) < 2 * voxel and abs(bottom.height + BOTTOM) < 2 * voxel
    assert abs(top.radius - RIM) < 2 * voxel
    assert (
        not (flat[P[..., 1] > TOP + 2 * voxel] < 0).any()
        and (coned()[P[..., 1] > TOP + 2 * voxel] < 0).any()
    )
    assert [e.sign for e in mouths(flat, UP, ends)] == [1, -1]
    tip = (np.abs(fine[..., 1]) < TOP) & (
        np.hypot(fine[..., 0], fine[..., 2]) < 0.6 * (TOP - fine[..., 1])
    )
    views, cameras = silhouettes(tip, (0.0, 0.2, -0.1))  # from the side a cone is a cone
    y = P[..., 1]
    cone = distance_of((np.abs(y) < TOP) & (np.hypot(P[..., 0], P[..., 2]) < 0.6 * (TOP - y)))
    flat, ends = ends_of(cone, UP, views, cameras)
    assert ends[0].height > TOP - 3 * voxel and [e.sign for e in mouths(flat, UP, ends)] == [-1]


def test_a_thin_tip_stays():
    """Thinner than a voxel in the photos, and a node wide in the body: its silhouette is there all
    the same."""
    fine = node_positions(160)
    r, y = np.hypot(fine[..., 0], fine[..., 2]), fine[..., 1]
    views, cameras = silhouettes(
        ((np.abs(y) < TOP) & (r < side(y))) | ((y > 0) & (y < 0.75) & (r < 0.02))
    )
    r, y = np.hypot(P[..., 0], P[..., 2]), P[..., 1]
    body = np.maximum(np.abs(y) - TOP, r - side(y))
    ends = ends_of(
        np.minimum(body, np.maximum(np.abs(y - 0.4) - 0.35, r - 0.04)), UP, views, cameras
    )[1]
    assert ends[0].height > 0.65 and abs(ends[1].height - TOP) < 0.06


@pytest.mark.slow
def test_a_hollow_has_a_wall_and_a_floor():
    n = 96
    p, voxel = node_positions(n), 2 / 95
    r, y = np.hypot(p[..., 0], p[..., 2]), p[..., 1]
    values = coned(n=n)
    flat, end = np.maximum(values, y - TOP), End(1, TOP, RIM)
    body = hollowed(values, flat, UP, end)
    gone = (flat < 0) & (body >= 0)
    middle = np.abs(y) < 0.2
    assert (
        gone[middle & (r < side(y) - 3.5 * voxel)].all()
        and not gone[middle & (r > side(y) - voxel)].any()
    )
    assert (
        not gone[y < BOTTOM + voxel].any()
        and gone[(y > BOTTOM + 3 * voxel) & (r < 0.2) & (y < TOP - voxel)].all()
    )
    raised = hollowed(values, flat, UP, end, 0.5)
    assert (raised[(y < -2 * voxel) & (r < 0.2) & (y > BOTTOM + voxel)] < 0).all()
    assert abs(floor_under(flat, UP, end) - BOTTOM) < 2 * voxel
    goblet = distance_of(
        ((y > 0) & (y < TOP) & (r < 0.3 + y))
        | ((y <= 0) & (y > -0.4) & (r < 0.1))
        | ((np.abs(y + 0.45) < 0.06) & (r < 0.3))
    )
    assert -0.42 < floor_under(goblet, UP, end) < 0.02  # on the stem, not in the foot
    assert hollowed(values, flat, UP, End(1, TOP, RIM), 1.0) is None
    for end in (
        End(1, TOP, RIM),
        End(-1, -BOTTOM, BASE),
    ):  # an end that was flat before can be opened too
        opened = hollowed(flat, flat, UP, end)
        beside = (r < 0.25) & (np.abs(end.sign * y - end.height + 3 * voxel) < 3 * voxel)
        assert (opened[beside] > 0).all() and (
            flat[beside & (end.sign * y < end.height - voxel)] < 0
        ).all()


def test_floor_is_where_the_error_is_least():
    assert lowest_of([(f - 0.27) ** 2 + 0.1 for f in FLOORS]) == pytest.approx(0.27)
    assert lowest_of([0.4, 0.5, 0.6]) == FLOORS[0] and lowest_of([0.6, 0.5, 0.35]) == FLOORS[-1]


def asked(folder, profile, monkeypatch):
    """What the stage makes of the plug with a cone on its mouth, from the true poses of a pile of
    what the profile tells; the scale of the asset in the unit frame; what was said."""
    folder.mkdir()
    write_glb(folder / "thing.glb", turned(profile), spotted())
    write_linear(folder / "light.exr", studio(32))
    sizes = {
        "count": 8,
        "seed": 1,
        "resolution": 400,
        "test_resolution": 16,
        "spp": 32,
        "test_spp": 1,
        "test_views": 1,
    }
    photo = synthesize_duplicates(
        folder / "thing.glb", folder / "light.exr", folder / "photo", **sizes
    )
    truth = json.loads((photo / "truth" / "truth.json").read_text())
    scale = scale_of(np.array(truth["instances"][0]["world_from_object"]))
    options = small_options(levels=(24, N), level_steps=(10, 10), surface_steps=120, points=1024)
    capture = open_capture(photo)
    shots = [(p.load(), p.camera.with_pose(np.eye(4))) for p in capture.photos]
    views, poses = all_views(shots, 160, options), true_poses(photo)
    monkeypatch.setattr(shape, "built_again", lambda *_: coned(scale))
    with Run.open(folder / "run", {}) as run:
        last = SimpleNamespace(values=coned(scale), symmetry=None)
        found = shape.vessel_stage(shots, views, poses, last, FitContext(run, options, 0))
        again = shape.vessel_stage(shots, views, poses, last, FitContext(run, options, 0))
    assert np.array_equal(found, again)
    return found, scale, (folder / "run" / "log.txt").read_text()


@pytest.mark.slow
def test_light_tells_a_cup_from_a_plug(tmp_path, monkeypatch):
    cup, scale, said = asked(tmp_path / "cup", CUP, monkeypatch)
    plug, same, silent = asked(tmp_path / "plug", PLUG, monkeypatch)
    r, y = np.hypot(P[..., 0], P[..., 2]) / scale, P[..., 1] / scale
    inside = (y > FLOOR + 0.1) & (y < TOP - 0.05) & (r < side(y) - 2 * WALL)
    assert "hollow under one end" in said and (cup[inside] > 0).mean() > 0.95
    assert (
        "hollow" not in silent
        and (
            plug[(np.hypot(P[..., 0], P[..., 2]) / same < 0.3) & (np.abs(P[..., 1]) / same < 0.25)]
            < 0
        ).all()
    )
    for found, s in ((cup, scale), (plug, same)):  # the cone is gone from either
        assert not (found[P[..., 1] / s > TOP + 0.1] < 0).any()


def test_the_second_end_is_asked_of_the_fit_with_the_first_hollow(monkeypatch):
    """A fit takes long: five for two ends, one of them a mouth, and the other one is compared with
    the likeliest hollow of the first."""
    fitted, compared = [], []

    class Fake(SimpleNamespace):
        def fit(self, *_):
            fitted.append(self.name)

        def texels_of(self, faces):
            return faces

    def change(closed, opened, *_):
        compared.append((closed.name, opened.name))
        return {"mouth 0.0": 0.5, "mouth 0.2": 0.3, "mouth 0.4": 0.6}.get(opened.name, 0.95)

    replaced = {
        "extract_mesh": lambda *_, **__: None,
        "body_axis": lambda mesh: UP,
        "ends_of": lambda values, *_: (np.full_like(values, 0.0), None),
        "mouths": lambda *_: ["mouth", "foot"],
        "hollowed": lambda values, shape, axis, end, raised: np.full(
            values.shape, f"{end} {raised}".startswith("mouth") * (1 + raised)
        ),
        "lid_of": lambda *_: None,
        "pixels_on_texels": lambda *_: vessel_trial.PIXELS,
        "change_of_error": change,
        "redistance": lambda values: values,
    }
    for name, by in replaced.items():
        monkeypatch.setattr(vessel_trial, name, by)
    names = iter(["flat", "mouth 0.0", "mouth 0.2", "mouth 0.4", "foot 0.0"])
    monkeypatch.setattr(
        vessel_trial.TrialShape, "of", staticmethod(lambda *_: Fake(mesh=None, name=next(names)))
    )
    said = []
    found = vessel_trial.vessel_of(
        np.full((2, 2, 2), -1.0), [], [], None, SurfaceOptions(), said.append
    )
    assert fitted == ["flat", "mouth 0.0", "mouth 0.2", "mouth 0.4", "foot 0.0"]
    assert compared == [
        ("flat", "mouth 0.0"),
        ("flat", "mouth 0.2"),
        ("flat", "mouth 0.4"),
        ("mouth 0.2", "foot 0.0"),
    ]
    assert len(said) == 1 and np.allclose(found, 1 + lowest_of([0.5, 0.3, 0.6]))

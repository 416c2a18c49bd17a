"""A body of revolution with bumps from poses that lean: round, and its instances upright."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from test_outlines import coverage, looking_at_origin

from relit.cameras.se3 import exp_so3
from relit.fit.duplicates_options import DuplicatesOptions
from relit.fit.instances import View
from relit.fit.round_bodies import placed_round
from relit.geometry.mesh import extract_mesh
from relit.geometry.sdf import node_positions, redistance

N = 64
UP = np.array([0.0, 1.0, 0.0])
WIDE, SLOPE, LONG = 0.35, 0.1, 0.6
SIDES = ([1, 0.2, 0], [0, -0.4, 1], [-1, 0.6, 0.5], [0.3, 0.5, -1], [-0.6, -0.5, -0.7])
OPTIONS = DuplicatesOptions(levels=(N // 2, N), level_steps=(1, 1))


def egg(bumps=0.0, lobes=7):
    """An egg, its radius off by `bumps`."""
    p = node_positions(N).astype(np.float64)
    radius, turn, y = np.hypot(p[..., 0], p[..., 2]), np.arctan2(p[..., 0], p[..., 2]), p[..., 1]
    wide = WIDE - SLOPE * y + bumps * np.cos(lobes * turn + 5 * y * (lobes > 2))
    return extract_mesh(redistance(0.35 * (np.hypot(radius / wide, y / LONG) - 1)))


def placed(mesh, truth, lean=0.0, without=()):
    """What `placed_round` makes of a mesh whose instances, silhouettes of the truth, lean by some degrees; the poses; what it says."""
    said, views, poses = [], [], []
    for k, side in enumerate(SIDES):
        camera, turn = looking_at_origin(side), np.eye(4)
        mask = coverage(truth, camera)
        turn[:3, :3] = exp_so3(np.radians(lean) * np.array([np.cos(2 * k), 0, np.sin(2 * k)]))
        views.append(View(k, camera, np.repeat(mask[..., None], 3, -1) * 0.5, mask, np.ones_like(mask), 1.0))
        poses.append(turn @ camera.world_from_camera)
    options = OPTIONS if not without else DuplicatesOptions(levels=OPTIONS.levels, level_steps=(1, 1), without=without)
    return placed_round(mesh, views, np.array(poses), SimpleNamespace(say=said.append), options), np.array(poses), said


def leans(poses):
    return [
        np.degrees(np.arccos(np.clip(UP @ p[:3, :3] @ looking_at_origin(s).world_from_camera[:3, :3].T @ UP, -1, 1)))
        for p, s in zip(poses, SIDES, strict=True)
    ]


def test_bumps_go_and_axes_come_upright():
    truth, bumpy = egg(), egg(0.006)
    (even, poses), before, said = placed(bumpy, truth, lean=0.8)
    side = lambda m: np.abs(m.vertices[:, 1]) < 0.4  # noqa: E731
    wide = lambda y: (WIDE - SLOPE * y) * np.sqrt(1 - (y / LONG) ** 2)  # noqa: E731
    off = lambda m: np.std((np.hypot(m.vertices[:, 0], m.vertices[:, 2]) - wide(m.vertices[:, 1]))[side(m)])  # noqa: E731
    assert off(even) < 0.3 * off(bumpy)
    assert np.median(leans(before)) > 0.5 and np.median(leans(poses)) < 0.4 * np.median(leans(before))
    assert len(said) == 1 and "body of revolution" in said[0]


def test_an_oval_and_what_is_asked_to_stay_are_left():
    oval = egg(0.022, 2)
    result, _, said = placed(oval, oval)
    assert result is None and not said
    assert placed(egg(0.006), egg(), without=("rounding",))[0] is None

"""A body of revolution with bumps is made round; an oval is not."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from relit.fit.duplicates.options import DuplicatesOptions
from relit.fit.duplicates.round_bodies import made_round
from relit.fit.registration.instances.views import InstanceView
from relit.geometry.mesh import extract_mesh
from relit.geometry.sdf import node_positions, redistance
from support.outlined_ball import coverage, looking_at_origin

N = 64
WIDE, SLOPE, LONG = 0.35, 0.1, 0.6
SIDES = ([1, 0.2, 0], [0, -0.4, 1], [-1, 0.6, 0.5], [0.3, 0.5, -1], [-0.6, -0.5, -0.7])
OPTIONS = DuplicatesOptions(levels=(N // 2, N), level_steps=(1, 1))


def egg(bumps=0.0, lobes=7):
    """An egg, its radius off by `bumps`."""
    p = node_positions(N).astype(np.float64)
    radius, turn, y = np.hypot(p[..., 0], p[..., 2]), np.arctan2(p[..., 0], p[..., 2]), p[..., 1]
    wide = WIDE - SLOPE * y + bumps * np.cos(lobes * turn + 5 * y * (lobes > 2))
    return extract_mesh(redistance(0.35 * (np.hypot(radius / wide, y / LONG) - 1)))


def asked(mesh, truth, **changes):
    """What `made_round` makes of a mesh whose instances are silhouettes of the truth; what it
    says."""
    said, views, poses = [], [], []
    for k, side in enumerate(SIDES):
        camera = looking_at_origin(side)
        mask = coverage(truth, camera)
        views.append(
            InstanceView(
                k, camera, np.repeat(mask[..., None], 3, -1) * 0.5, mask, np.ones_like(mask), 1.0
            )
        )
        poses.append(camera.world_from_camera)
    return made_round(
        mesh, views, np.array(poses), SimpleNamespace(say=said.append), replace(OPTIONS, **changes)
    ), said


@pytest.mark.slow
def test_bumps_go():
    truth, bumpy = egg(), egg(0.006)
    even, said = asked(bumpy, truth)
    side = lambda m: np.abs(m.vertices[:, 1]) < 0.4  # noqa: E731
    wide = lambda y: (WIDE - SLOPE * y) * np.sqrt(1 - (y / LONG) ** 2)  # noqa: E731

    def off(m):
        return np.std(
            (np.hypot(m.vertices[:, 0], m.vertices[:, 2]) - wide(m.vertices[:, 1]))[side(m)]
        )

    assert off(even) < 0.3 * off(bumpy)
    assert len(said) == 1 and "body of revolution" in said[0]


@pytest.mark.slow
def test_an_oval_and_what_is_asked_to_stay_are_left():
    oval = egg(0.022, 2)  # its outlines would move by .8 of a pixel
    result, said = asked(oval, oval)
    assert result is oval and not said
    bumpy = egg(0.006)
    assert asked(bumpy, egg(), without=("rounding",))[0] is bumpy

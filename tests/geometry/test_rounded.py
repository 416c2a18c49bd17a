"""Bodies of revolution made round: ripples go, handles, windows and what is not round stay."""

from __future__ import annotations

import numpy as np
import pytest

from relit.geometry.mesh import extract_mesh
from relit.geometry.revolution_axis import Axis
from relit.geometry.rounded import refine_axis, rounded
from relit.geometry.sdf import node_positions, redistance

N = 48
STEP = 2 / (N - 1)
AXIS = Axis(
    np.array([0.02, 0, -0.01]), np.array([0.1, 0.99, 0.05]) / np.linalg.norm([0.1, 0.99, 0.05])
)


def lathe(bumps=lambda turn, height: 0 * turn, extra=None):
    """A rounded cylinder of radius .35 about AXIS with a waist, its radius changed by bumps(turn,
    height); extra: distances of more."""
    p = node_positions(N).astype(np.float64)
    height, radius = AXIS.heights(p), AXIS.radii(p)
    across = np.linalg.svd(AXIS.direction[None])[2][1:]
    turn = np.arctan2((p - AXIS.point) @ across[0], (p - AXIS.point) @ across[1])
    wide = 0.35 + 0.06 * np.cos(4 * height) + bumps(turn, height)
    values = np.maximum(radius - wide, np.abs(height) - 0.6)
    return extract_mesh(redistance(values if extra is None else np.minimum(values, extra(p))))


def off(mesh, sides=0.5):
    """(of the vertices on the side: by how much the radius is off, their angles to the true normals
    in degrees)"""
    height, radius = AXIS.heights(mesh.vertices), AXIS.radii(mesh.vertices)
    side = (np.abs(height) < sides) & (radius > 0.2)
    away = mesh.vertices - AXIS.point - height[:, None] * AXIS.direction
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    true = away + (0.24 * np.sin(4 * height))[:, None] * AXIS.direction
    true /= np.linalg.norm(true, axis=1, keepdims=True)
    angle = np.degrees(np.arccos(np.clip((true * mesh.normals).sum(1), -1, 1)))
    return (radius - 0.35 - 0.06 * np.cos(4 * height))[side], angle[side]


@pytest.mark.slow
def test_ripples_go():
    mesh = lathe(lambda turn, height: 0.005 * np.sin(9 * turn + 7 * height))
    (before, slanted), (after, upright) = off(mesh), off(rounded(mesh, AXIS, STEP))
    assert before.std() > 0.003 and np.median(slanted) > 3.5
    assert after.std() < 0.25 * before.std() and abs(after.mean()) < 0.1 * STEP
    assert np.median(upright) < 0.35 * np.median(slanted)


@pytest.mark.slow
def test_a_handle_stays():
    away = np.cross(AXIS.direction, [0, 0, 1.0])
    place = AXIS.point + 0.5 * away / np.linalg.norm(away)
    mesh = lathe(extra=lambda p: np.linalg.norm(p - place, axis=-1) - 0.2)
    ball = np.linalg.norm(mesh.vertices - place, axis=1) < 0.21
    ball &= AXIS.radii(mesh.vertices) > 0.42 + 4 * STEP  # away from where it meets the body
    moved = np.linalg.norm(rounded(mesh, AXIS, STEP).vertices - mesh.vertices, axis=1)
    assert ball.sum() > 100 and moved[ball].max() < 0.3 * STEP and np.median(moved[ball]) == 0


@pytest.mark.slow
def test_a_window_stays():
    deep = 3 * STEP

    def window(turn, height):
        return -deep * ((np.abs(turn) < 0.6) & (np.abs(height) < 0.3))

    mesh = lathe(window)
    after = rounded(mesh, AXIS, STEP)
    away = off(after, 0.2)[0]
    before = off(mesh, 0.2)[0]
    inside = before < -2 * STEP
    assert inside.sum() > 100
    assert np.median(away[inside]) == pytest.approx(-deep, abs=0.3 * STEP) and np.median(
        away[~inside]
    ) == pytest.approx(0, abs=0.1 * STEP)


@pytest.mark.slow
def test_an_oval_stays():
    mesh = lathe(lambda turn, height: 0.1 * np.cos(2 * turn))
    before, after = off(mesh)[0], off(rounded(mesh, AXIS, STEP))[0]
    assert after.std() > 0.95 * before.std()


@pytest.mark.slow
def test_an_axis_that_is_off_is_found():
    lean = np.cross(AXIS.direction, [0, 0, 1.0]) * 0.02
    wrong = Axis(
        AXIS.point + np.array([0.006, 0, 0.004]),
        (AXIS.direction + lean) / np.linalg.norm(AXIS.direction + lean),
    )
    mesh = lathe(lambda turn, height: 0.004 * np.sin(9 * turn + 7 * height))
    found = wrong
    for _ in range(3):
        found = refine_axis(mesh, found, STEP)
    assert np.degrees(np.arccos(found.direction @ AXIS.direction)) < 0.1
    between = found.point - AXIS.point
    assert np.linalg.norm(between - between @ AXIS.direction * AXIS.direction) < 0.03 * STEP
    (before, _), (after, _) = off(mesh), off(rounded(mesh, wrong, STEP))
    assert after.std() < 0.3 * before.std()

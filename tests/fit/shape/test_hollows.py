"""The hull's lid is opened, thin parts and silhouettes stay."""

import numpy as np
import pytest

from relit.fit.shape.hollows import HollowOptions, bare, opened, without
from relit.geometry.hull import distance_of
from relit.geometry.sdf import node_positions
from relit.scene import Camera

N = 32


def cameras():
    out = []
    for height in (-1.5, 0.0, 1.5, 3.0):
        for turn in np.linspace(0, 2 * np.pi, 8, endpoint=False):
            centre = np.array([4 * np.cos(turn), height, 4 * np.sin(turn)])
            z = -centre / np.linalg.norm(centre)
            x = np.cross(z, [0.0, -1.0, 0.0])
            x /= np.linalg.norm(x)
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = np.stack([x, np.cross(z, x), z], 1), centre
            out.append(Camera(96, 96, 130.0, 130.0, 48.0, 48.0, pose))
    return out


@pytest.fixture(scope="module")
def pot():
    """A solid upright cylinder with a thin handle: what the hull of a pot is. Inside (N, N, N)
    bool, the lid's error map."""
    p = node_positions(N)
    r = np.hypot(p[..., 0], p[..., 2])
    body = (r < 0.5) & (np.abs(p[..., 1]) < 0.5)
    handle = (
        (np.abs(p[..., 2]) < 0.07) & (np.abs(p[..., 0] - 0.65) < 0.2) & (np.abs(p[..., 1]) < 0.07)
    )
    error = np.full((N, N, N), 0.005)
    error[(p[..., 1] > 0.4) & (r < 0.42)] = 0.03
    error[handle] = 0.03
    return body, handle & ~body, error


def test_lid_is_opened_and_walls_and_handle_stay(pot):
    body, handle, error = pot
    left = opened(distance_of(body | handle), error, cameras(), HollowOptions(N)) < 0
    p = node_positions(N)
    r = np.hypot(p[..., 0], p[..., 2])
    core = (r < 0.25) & (p[..., 1] > -0.25) & (p[..., 1] < 0.5)
    assert not (left & core).any()
    assert (left | ~(body & (r > 0.42))).all(), "the wall stays"
    assert (left | ~(body & (p[..., 1] < -0.4))).all(), "the bottom stays"
    assert (left | ~handle).all(), "the handle is badly explained too, but the silhouettes need it"


def test_evenly_explained_surface_is_left_alone(pot):
    body, handle, error = pot
    assert (
        opened(distance_of(body | handle), np.full_like(error, 0.01), cameras(), HollowOptions(N))
        is None
    )


def test_bare_knows_what_silhouettes_need(pot):
    body, handle, _ = pot
    assert (bare(cameras(), body, handle)[handle] > 0).mean() > 0.7
    p = node_positions(N)
    inner = (np.hypot(p[..., 0], p[..., 2]) < 0.3) & (np.abs(p[..., 1]) < 0.3)
    assert not bare(cameras(), body & ~inner, inner).any()


def test_hollows_are_taken_away_on_a_finer_grid(pot):
    body, _, _ = pot
    inner = distance_of(body) < -0.2
    fine = np.where(np.linalg.norm(node_positions(48), axis=-1) < 0.7, -0.1, 0.1).astype(np.float32)
    cut = without(fine, distance_of(inner))
    assert cut[24, 24, 24] > 0 > fine[24, 24, 24]
    assert (cut >= fine).all()
    assert without(fine, None) is fine

"""An object and two lights made of formulas, for the demo and for tests: nothing is downloaded,
everything is known.

The object is a turned and painted pawn: a fluted foot of rough clay, a waist, a gold collar, a
glazed head with spots. It has what
a reconstruction must tell apart: concavities that shadow themselves, paint under gloss, metal, and
roughness from .15 to .8.
"""

from __future__ import annotations

import numpy as np

from relit.conventions import environment_directions
from relit.scene import Material, Mesh

# Half a section of the pawn from the bottom to the top: (radius, height), smoothed by a spline;
# object units.
PROFILE = np.array(
    [
        (0.00, 0.00),
        (0.34, 0.00),
        (0.50, 0.03),
        (0.52, 0.14),
        (0.44, 0.26),
        (0.28, 0.42),
        (0.20, 0.62),
        (0.21, 0.78),
        (0.34, 0.86),
        (0.36, 0.92),
        (0.27, 0.98),
        (0.30, 1.08),
        (0.37, 1.24),
        (0.34, 1.42),
        (0.20, 1.55),
        (0.00, 1.60),
    ]
)
FLUTES = 9  # around the foot
COLLAR = (0.80, 0.965)  # heights of the gold collar
FOOT = 0.60  # height below which the clay is bare


def pawn(rows: int = 160, columns: int = 240, texture: int = 512) -> tuple[Mesh, Material]:
    """The object: a closed surface of revolution with flutes, v along the section (0 = top of the
    head), u around it.

    rows, columns: quads along and around. texture: pixels a side. Returns a mesh with smooth
    normals and analytic texture coordinates, height 1.6, +Y up, and its material (linear colours).
    """
    v = np.linspace(0, 1, rows + 1)
    u = np.linspace(0, 1, columns + 1)
    uu, vv = np.meshgrid(u, v)  # (rows + 1, columns + 1); the seam's column is there twice
    vertices = _surface(uu, vv).reshape(-1, 3)
    normals = _normals(uu, vv).reshape(-1, 3)
    a = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    b, c, d = a + 1, a + columns + 1, a + columns + 2  # a b on the upper row, c d below
    upper, lower = np.stack([a, c, d], 1), np.stack([a, d, b], 1)
    top, bottom = np.arange(columns), np.arange((rows - 1) * columns, rows * columns)
    lower, upper = (
        np.delete(lower, top, 0),
        np.delete(upper, bottom, 0),
    )  # at the poles one triangle of each quad has no area
    faces = np.concatenate([upper, lower]).astype(np.int32)
    mesh = Mesh(
        vertices.astype(np.float32),
        faces,
        normals.astype(np.float32),
        np.stack([uu, vv], -1).reshape(-1, 2).astype(np.float32),
    )
    return mesh, _paint(texture)


def _section(v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Radius and height at v in [0, 1] (0 = top)."""
    from scipy.interpolate import PchipInterpolator

    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(PROFILE, axis=0), axis=1))])
    at = (1 - v) * length[-1]
    return PchipInterpolator(length, PROFILE[:, 0])(at), PchipInterpolator(length, PROFILE[:, 1])(
        at
    )


def _surface(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    radius, height = _section(v)
    phi = 2 * np.pi * u
    fluted = np.clip((0.50 - height) / 0.2, 0, 1) * np.clip(height / 0.05, 0, 1)
    radius = radius * (1 + 0.06 * fluted * np.cos(FLUTES * phi + 2.5 * height))
    return np.stack([radius * np.sin(phi), height, radius * np.cos(phi)], -1)


def _normals(u: np.ndarray, v: np.ndarray, step: float = 1e-4) -> np.ndarray:
    """Unit normals by central differences; the axis at the poles."""
    lo, hi = np.clip(v - step, 0, 1), np.clip(v + step, 0, 1)
    along = _surface(u, hi) - _surface(u, lo)
    around = _surface(u + step, v) - _surface(u - step, v)
    n = np.cross(along, around)
    length = np.linalg.norm(n, axis=-1, keepdims=True)
    axis = np.where(v[..., None] < 0.5, [0.0, 1.0, 0.0], [0.0, -1.0, 0.0])
    return np.where(length > 1e-12, n / np.maximum(length, 1e-12), axis)


def _paint(size: int) -> Material:
    c = (np.arange(size) + 0.5) / size
    u, v = np.meshgrid(c, c)
    _, height = _section(v)
    phi = 2 * np.pi * u
    wave = 0.5 + 0.5 * np.sin(3 * phi + 9 * height)
    clay = np.array([0.42, 0.16, 0.08]) * (0.75 + 0.25 * wave)[..., None]
    clay = np.where(
        (np.sin(FLUTES * phi + 2.5 * height) > 0.55)[..., None], [0.62, 0.52, 0.36], clay
    )
    glaze = np.array([0.03, 0.28, 0.33]) + (0.12 * wave)[..., None] * np.array([0.2, 1.0, 0.6])
    spots = (np.cos(7 * phi + np.round(height * 9) * np.pi) * np.cos(height * 9 * np.pi * 2)) > 0.45
    glaze = np.where(spots[..., None], [0.80, 0.70, 0.50], glaze)
    foot, collar = (
        (height < FOOT)[..., None],
        ((height > COLLAR[0]) & (height < COLLAR[1]))[..., None],
    )
    base = np.where(foot, clay, glaze)
    base = np.where(collar, [0.90, 0.62, 0.25], base)
    roughness = np.where(foot[..., 0], 0.65 + 0.15 * wave, np.where(spots, 0.45, 0.18))
    roughness = np.where(collar[..., 0], 0.28, roughness)
    metallic = collar[..., 0].astype(np.float32)
    return Material(base.astype(np.float32), roughness.astype(np.float32), metallic)


# ---------------------------------------------------------------- lights


def studio(height: int = 128) -> np.ndarray:
    """(H, 2H, 3) linear radiance: pale sky, soft sun, one warm and one blue card, brown ground."""
    d = environment_directions(height, 2 * height)
    out = _sky(d, zenith=(0.25, 0.38, 0.65), horizon=(0.75, 0.75, 0.72), ground=(0.16, 0.12, 0.09))
    out += _sun(d, (0.55, 0.60, 0.58), degrees=7, radiance=(42.0, 38.0, 32.0))
    out += _card(d, (-0.9, 0.25, 0.2), (0.30, 0.45), (7.0, 3.2, 1.2))
    out += _card(d, (0.1, 0.15, -1.0), (0.55, 0.25), (1.2, 2.6, 6.0))
    return out.astype(np.float32)


def evening(height: int = 128) -> np.ndarray:
    """(H, 2H, 3) linear radiance: dim blue sky, a low orange sun, a green card: another place to
    put the object."""
    d = environment_directions(height, 2 * height)
    out = _sky(d, zenith=(0.05, 0.08, 0.20), horizon=(0.45, 0.26, 0.16), ground=(0.05, 0.05, 0.05))
    out += _sun(d, (-0.8, 0.25, -0.5), degrees=5, radiance=(80.0, 38.0, 12.0))
    out += _card(d, (0.9, 0.5, 0.3), (0.35, 0.35), (1.0, 4.0, 1.5))
    return out.astype(np.float32)


def _unit(v) -> np.ndarray:
    return np.asarray(v, dtype=np.float64) / np.linalg.norm(v)


def _smooth(x: np.ndarray) -> np.ndarray:
    t = np.clip(x, 0, 1)
    return t * t * (3 - 2 * t)


def _sky(d: np.ndarray, zenith, horizon, ground) -> np.ndarray:
    up = d[..., 1:2]
    sky = np.array(horizon) + (np.array(zenith) - np.array(horizon)) * np.sqrt(np.clip(up, 0, 1))
    return np.where(
        up > 0,
        sky,
        np.array(ground)
        + (np.array(horizon) * 0.4 - np.array(ground)) * np.exp(8 * np.minimum(up, 0)),
    )


def _sun(d: np.ndarray, towards, degrees: float, radiance) -> np.ndarray:
    """A disc of angular radius `degrees` with a soft rim."""
    angle = np.degrees(np.arccos(np.clip(d @ _unit(towards), -1, 1)))[..., None]
    return _smooth((degrees - angle) / 2 + 0.5) * np.array(radiance)


def _card(d: np.ndarray, towards, half: tuple[float, float], radiance) -> np.ndarray:
    """A rectangle at distance 1 in direction `towards`; half: half width and height there."""
    z = _unit(towards)
    x = _unit(np.cross([0, 1, 0], z))
    y = np.cross(z, x)
    depth = d @ z
    safe = np.maximum(depth, 1e-6)
    inside = _smooth((half[0] - np.abs(d @ x) / safe) / 0.06 + 0.5) * _smooth(
        (half[1] - np.abs(d @ y) / safe) / 0.06 + 0.5
    )
    return (inside * (depth > 0.05))[..., None] * np.array(radiance)

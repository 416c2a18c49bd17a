"""THE page of conventions: every frame, unit and encoding of Relit, and every conversion between
them.

Inside Relit there is one frame and one encoding:

* Camera axes are OpenCV's: +x right, +y down, +z into the scene. Poses are named `b_from_a` and are
  4x4 float64 matrices that act on column vectors: `x_b = b_from_a @ x_a`.
* Images are row-major (H, W, C) float32, linear Rec.709 radiance. The centre of the pixel in column
  i and row j is at (i + 0.5, j + 0.5).
* Roughness r is perceptual (glTF's); the GGX width is alpha = r^2.
* Environment maps are lat-long images in Mitsuba's axes with an identity `to_world`: the row is the
  polar angle from +Y, and u(+X) = .25, u(+Z) = .5, u(-X) = .75, u(-Z) = 0.
* `world` is the frame of the user's cameras; `unit` is the frame in which the object sphere is the
  unit sphere at the origin (`world_from_unit` is a similarity).

Each conversion below has a round-trip test in `tests/test_conventions.py`.
"""

from __future__ import annotations

import numpy as np

FLIP_YZ = np.diag(
    [1.0, -1.0, -1.0, 1.0]
)  # OpenCV <-> OpenGL camera axes (x right, y up, looks along -z)
FLIP_XY = np.diag(
    [-1.0, -1.0, 1.0, 1.0]
)  # OpenCV <-> Mitsuba camera axes (x left, y up, looks along +z)


# ---------------------------------------------------------------- colour


def srgb_from_linear(linear):
    """Linear Rec.709 -> sRGB (IEC 61966-2-1), not clipped above 1. Any shape, float."""
    x = np.maximum(np.asarray(linear, dtype=np.float32), 0.0)
    return np.where(
        x <= 0.0031308, 12.92 * x, 1.055 * np.power(np.maximum(x, 0.0031308), 1 / 2.4) - 0.055
    ).astype(np.float32)


def linear_from_srgb(encoded):
    """sRGB (IEC 61966-2-1) -> linear Rec.709. Any shape, float."""
    x = np.maximum(np.asarray(encoded, dtype=np.float32), 0.0)
    return np.where(
        x <= 0.04045, x / 12.92, np.power((np.maximum(x, 0.04045) + 0.055) / 1.055, 2.4)
    ).astype(np.float32)


def luminance(linear):
    """Rec.709 luminance of (..., 3) linear colour -> (...)."""
    return np.asarray(linear) @ np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)


# ---------------------------------------------------------------- material


def alpha_from_roughness(roughness):
    """GGX width from glTF's perceptual roughness: alpha = r^2."""
    return roughness * roughness


def roughness_from_alpha(alpha):
    """glTF's perceptual roughness from the GGX width: r = sqrt(alpha)."""
    return np.sqrt(alpha)


def f0_from_ior(ior):
    """Reflectance at normal incidence of a dielectric in air: ((n - 1) / (n + 1))^2."""
    return ((ior - 1.0) / (ior + 1.0)) ** 2


def ior_from_f0(f0):
    """Index of refraction of a dielectric in air from its reflectance at normal incidence."""
    s = np.sqrt(f0)
    return (1.0 + s) / (1.0 - s)


# ---------------------------------------------------------------- cameras


def world_from_cv_camera(world_from_gl_camera):
    """OpenGL/NeRF/Blender camera pose (4x4) -> OpenCV camera pose (4x4). Its own inverse."""
    return np.asarray(world_from_gl_camera, dtype=np.float64) @ FLIP_YZ


def world_from_gl_camera(world_from_camera):
    """OpenCV camera pose (4x4) -> OpenGL/NeRF/Blender camera pose (4x4)."""
    return np.asarray(world_from_camera, dtype=np.float64) @ FLIP_YZ


def world_from_mitsuba_camera(world_from_camera):
    """OpenCV camera pose (4x4) -> Mitsuba's `to_world` (4x4)."""
    return np.asarray(world_from_camera, dtype=np.float64) @ FLIP_XY


def cv_from_mitsuba_axes(vector):
    """(..., 3) along Mitsuba's camera axes (left, up, forward) -> along OpenCV's (right, down,
    forward). Its own inverse."""
    return np.asarray(vector, dtype=np.float64) @ FLIP_XY[:3, :3]


def similarity(rotation, translation, scale=1.0):
    """4x4 float64 with x' = scale * rotation @ x + translation."""
    out = np.eye(4)
    out[:3, :3] = scale * np.asarray(rotation, dtype=np.float64)
    out[:3, 3] = translation
    return out


def scale_of(b_from_a):
    """Scale of a 4x4 similarity."""
    return float(np.cbrt(np.linalg.det(np.asarray(b_from_a)[:3, :3])))


def move_pose(b_from_a, a_from_camera):
    """Carry a camera pose through a similarity `b_from_a`: the rotation stays a rotation, the
    centre moves."""
    s = scale_of(b_from_a)
    out = np.asarray(b_from_a, dtype=np.float64) @ np.asarray(a_from_camera, dtype=np.float64)
    out[:3, :3] /= s
    return out


def move_points(b_from_a, points):
    """Carry (..., 3) points through a 4x4 affine map."""
    m = np.asarray(b_from_a, dtype=np.float64)
    return np.asarray(points, dtype=np.float64) @ m[:3, :3].T + m[:3, 3]


# ---------------------------------------------------------------- environment maps


def uv_from_direction(direction):
    """Unit directions (..., 3) -> lat-long coordinates (..., 2) in [0, 1): Mitsuba's `envmap` with
    identity `to_world`."""
    d = np.asarray(direction, dtype=np.float64)
    u = np.arctan2(d[..., 0], -d[..., 2]) / (2 * np.pi)
    v = np.arccos(np.clip(d[..., 1], -1.0, 1.0)) / np.pi
    return np.stack([u - np.floor(u), v], axis=-1)


def direction_from_uv(uv):
    """Lat-long coordinates (..., 2) -> unit directions (..., 3); inverse of `uv_from_direction`."""
    uv = np.asarray(uv, dtype=np.float64)
    phi, theta = uv[..., 0] * 2 * np.pi, uv[..., 1] * np.pi
    s = np.sin(theta)
    return np.stack([s * np.sin(phi), np.cos(theta), -s * np.cos(phi)], axis=-1)


def environment_directions(height, width):
    """Directions (H, W, 3) of the texel centres of a lat-long map."""
    u, v = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
    return direction_from_uv(np.stack([u, v], -1))


def environment_solid_angles(height, width):
    """Solid angle (H, W) in steradians of each texel of a lat-long map; they sum to 4 pi."""
    edges = np.cos(np.arange(height + 1) * np.pi / height)
    return np.repeat(((edges[:-1] - edges[1:]) * 2 * np.pi / width)[:, None], width, axis=1)


def gltf_environment(environment):
    """Lat-long map in Relit's axes -> the axes of three.js / glTF viewers: a roll by W/4, no
    mirror."""
    return np.roll(environment, environment.shape[1] // 4, axis=1)


def environment_from_gltf(environment):
    """Inverse of `gltf_environment`."""
    return np.roll(environment, -(environment.shape[1] // 4), axis=1)


def rotate_environment(environment, b_from_a):
    """Resample a lat-long map (H, W, 3) given in frame a so that it stands in frame b (rotation 3x3
    or 4x4), bilinear."""
    rotation = np.asarray(b_from_a, dtype=np.float64)[:3, :3]
    rotation = rotation / np.cbrt(np.linalg.det(rotation))
    h, w = environment.shape[:2]
    return sample_environment(environment, environment_directions(h, w) @ rotation)


def sample_environment(environment, direction):
    """Bilinear look-up of a lat-long map (H, W, C) in unit directions (..., 3) -> (..., C)."""
    h, w = environment.shape[:2]
    uv = uv_from_direction(direction)
    x, y = uv[..., 0] * w - 0.5, np.clip(uv[..., 1] * h - 0.5, 0, h - 1)
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = (x - x0)[..., None], (y - y0)[..., None]
    y1 = np.minimum(y0 + 1, h - 1)
    top = environment[y0, x0 % w] * (1 - fx) + environment[y0, (x0 + 1) % w] * fx
    bottom = environment[y1, x0 % w] * (1 - fx) + environment[y1, (x0 + 1) % w] * fx
    return (top * (1 - fy) + bottom * fy).astype(np.float32)

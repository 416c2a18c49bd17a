"""Rotations, rigid motions and similarities in NumPy, float64. Matrices act on column vectors;
poses are `b_from_a`."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from relit.conventions import similarity


def hat(v: np.ndarray) -> np.ndarray:
    """(3,) -> (3, 3) matrix with hat(v) @ x = v x x."""
    x, y, z = v
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=np.float64)


def exp_so3(w: np.ndarray) -> np.ndarray:
    """Rotation vector (3,), radians -> (3, 3). Rodrigues' formula, with its series below 1e-4 rad
    (the quotients cancel there)."""
    w = np.asarray(w, dtype=np.float64)
    theta2 = float(w @ w)
    theta = np.sqrt(theta2)
    a, b = (
        (1 - theta2 / 6, 0.5 - theta2 / 24)
        if theta < 1e-4
        else (np.sin(theta) / theta, (1 - np.cos(theta)) / theta2)
    )
    k = hat(w)
    return np.eye(3) + a * k + b * k @ k


def log_so3(rotation: np.ndarray) -> np.ndarray:
    """(3, 3) -> rotation vector (3,) with angle in [0, pi]. Through the unit quaternion, which is
    well conditioned at 0 and at pi."""
    r = np.asarray(rotation, dtype=np.float64)
    # Bar-Itzhack 2000: the quaternion is the dominant eigenvector of this symmetric matrix; robust
    # to rounding in r
    k = np.array(
        [
            [r[0, 0] - r[1, 1] - r[2, 2], r[1, 0] + r[0, 1], r[2, 0] + r[0, 2], r[2, 1] - r[1, 2]],
            [r[1, 0] + r[0, 1], r[1, 1] - r[0, 0] - r[2, 2], r[2, 1] + r[1, 2], r[0, 2] - r[2, 0]],
            [r[2, 0] + r[0, 2], r[2, 1] + r[1, 2], r[2, 2] - r[0, 0] - r[1, 1], r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], r[0, 0] + r[1, 1] + r[2, 2]],
        ]
    )
    q = np.linalg.eigh(k)[1][:, -1]
    q = -q if q[3] < 0 else q
    sine = float(np.linalg.norm(q[:3]))
    angle = 2 * np.arctan2(sine, q[3])
    return q[:3] * (angle / sine if sine > 1e-12 else 2.0)


def rotation_angle(rotation: np.ndarray) -> float:
    """Angle in degrees of a (3, 3) rotation."""
    return float(np.degrees(np.linalg.norm(log_so3(rotation))))


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """The rotation nearest to a (3, 3) matrix in the Frobenius norm."""
    u, _, vt = np.linalg.svd(matrix)
    return u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt


def rotation_from(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The shortest rotation (3, 3) that carries the direction a (3,) to the direction b (3,)."""
    a, b = (np.asarray(v, np.float64) / np.linalg.norm(v) for v in (a, b))
    axis, cosine = np.cross(a, b), float(a @ b)
    if cosine < -0.999999:  # half a turn about any axis at right angles to a
        side = np.cross(a, np.eye(3)[np.argmin(np.abs(a))])
        return 2 * np.outer(side, side) / (side @ side) - np.eye(3)
    k = hat(axis)
    return np.eye(3) + k + k @ k / (1 + cosine)


def umeyama(points_a: np.ndarray, points_b: np.ndarray, with_scale: bool = True) -> np.ndarray:
    """Least-squares similarity (4, 4) b_from_a of paired points (N, 3). Umeyama 1991, Eqs.
    (40)-(42)."""
    a, b = np.asarray(points_a, dtype=np.float64), np.asarray(points_b, dtype=np.float64)
    mean_a, mean_b = a.mean(0), b.mean(0)
    da, db = a - mean_a, b - mean_b
    u, d, vt = np.linalg.svd(db.T @ da / len(a))
    s = np.array([1, 1, np.sign(np.linalg.det(u) * np.linalg.det(vt)) or 1.0])
    rotation = u @ np.diag(s) @ vt
    variance = float((da**2).sum() / len(a))
    scale = float(d @ s) / variance if with_scale and variance > 0 else 1.0
    return similarity(rotation, mean_b - scale * rotation @ mean_a, scale)


def align_cameras(a_from_camera: np.ndarray, b_from_camera: np.ndarray) -> np.ndarray:
    """Similarity (4, 4) b_from_a that carries poses (N, 4, 4) onto poses of the same cameras in
    another frame.

    The rotation is the mean over the cameras' orientations (it stands when all centres lie on a
    line or in one point); scale and translation come from the centres.
    """
    a, b = np.asarray(a_from_camera, dtype=np.float64), np.asarray(b_from_camera, dtype=np.float64)
    rotation = nearest_rotation(np.einsum("nij,nkj->ik", b[:, :3, :3], a[:, :3, :3]))
    ca, cb = a[:, :3, 3], b[:, :3, 3]
    da, db = (ca - ca.mean(0)) @ rotation.T, cb - cb.mean(0)
    spread = float((da**2).sum())
    scale = float((da * db).sum()) / spread if spread > 1e-20 else 1.0
    scale = scale if scale > 0 else 1.0
    return similarity(rotation, cb.mean(0) - scale * rotation @ ca.mean(0), scale)


def camera_errors(
    a_from_camera: np.ndarray, b_from_camera: np.ndarray, robust: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """Errors after the best similarity: rotation in degrees (N,), centre distance in units of b
    (N,).

    robust: fit the similarity again without the cameras whose rotation is more than 3 medians (and
    1 degree) off.
    """
    a, b = np.asarray(a_from_camera, dtype=np.float64), np.asarray(b_from_camera, dtype=np.float64)
    keep = np.ones(len(a), bool)
    for _ in range(3 if robust else 1):
        m = align_cameras(a[keep], b[keep])
        r = nearest_rotation(m[:3, :3])
        angle = np.array(
            [rotation_angle(y[:3, :3].T @ r @ x[:3, :3]) for x, y in zip(a, b, strict=True)]
        )
        distance = np.linalg.norm(a[:, :3, 3] @ m[:3, :3].T + m[:3, 3] - b[:, :3, 3], axis=1)
        keep = angle <= max(3 * float(np.median(angle)), 1.0)
    return angle, distance


def look_at(eye, target=(0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0), roll: float = 0.0) -> np.ndarray:
    """(..., 4, 4) world_from_camera, OpenCV axes, at `eye` (..., 3) looking at `target`, `up`
    upwards in the image; roll in radians about its axis."""
    eye, up = np.asarray(eye, dtype=np.float64), np.asarray(up, dtype=np.float64)

    def unit(v):
        return v / np.linalg.norm(v, axis=-1, keepdims=True)

    z = unit(np.asarray(target, dtype=np.float64) - eye)
    x = np.cross(z, up)
    upright = np.linalg.norm(x, axis=-1, keepdims=True) >= 1e-6
    x = unit(
        np.where(upright, x, np.cross(z, np.roll(up, 1)))
    )  # looks along `up`: any other direction will do
    y = np.cross(z, x)
    c, s = np.cos(roll), np.sin(roll)
    out = np.zeros((*eye.shape[:-1], 4, 4))
    out[..., :3, :] = np.stack([c * x + s * y, c * y - s * x, z, eye], axis=-1)
    out[..., 3, 3] = 1
    return out


def turns_apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(N,) degrees by which each object is turned from one set of poses (N, 4, 4)
    object_from_camera to the other, after the turn of the whole that most objects agree on."""
    turns = [x[:3, :3] @ y[:3, :3].T for x, y in zip(a, b, strict=True)]
    angles = np.array([[rotation_angle(s.T @ t) for t in turns] for s in turns])
    return angles[np.median(angles, 1).argmin()]


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """(4,) unit (w, x, y, z), w >= 0, of a rotation matrix (3, 3)."""
    turn = Rotation.from_matrix(np.asarray(rotation, np.float64))
    return np.roll(turn.as_quat(canonical=True), 1)

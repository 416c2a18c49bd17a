"""Bring a reconstruction into the frame of the truth: Sim(3) from matched cameras, and what is left
of their poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from relit.conventions import move_points, move_pose, rotate_environment, scale_of
from relit.errors import UserError
from relit.geometry import se3
from relit.scene import Asset, Camera, Flash

TRIMMED_STEPS = 10  # of the fit to the best half; it stays after three or four
LOST = 180.0  # degrees: the rotation error of what has no pose, an instance or a photo


def align_points(source, target, with_scale: bool = True) -> np.ndarray:
    """Least-squares similarity (4, 4) target_from_source of matched points (N, 3); Umeyama 1991,
    Eqs. 34-43.

    Raises UserError for fewer than 3 points or points on a line, where the rotation is not
    determined.
    """
    x, y = np.asarray(source, np.float64), np.asarray(target, np.float64)
    if len(x) < 3:
        raise UserError(
            f"{len(x)} matched points cannot fix a similarity",
            "at least 3 that are not on a line are needed",
        )
    d = np.linalg.svd((y - y.mean(0)).T @ (x - x.mean(0)) / len(x), compute_uv=False)
    if d[1] < 1e-9 * max(d[0], 1e-30):
        raise UserError(
            "the matched points lie on a line", "the rotation around that line is not determined"
        )
    return se3.umeyama(x, y, with_scale)


def align_centres(source, target, robust: bool = True) -> np.ndarray:
    """target_from_source (4, 4) similarity of matched camera CENTRES (N, 3) alone (Procrustes, as
    BARF and SAMURAI), so that orientations can be scored that the fit has not used.

    robust: fit again without the centres that are more than 3 medians off; the papers use all.
    Raises UserError where the centres lie on a line, which leaves a rotation open.
    """
    x, y = np.asarray(source, np.float64), np.asarray(target, np.float64)
    keep = np.ones(len(x), bool)
    similarity = align_points(x, y)
    for _ in range(3 if robust else 0):
        off = np.linalg.norm(move_points(similarity, x) - y, axis=1)
        keep = off <= max(3 * float(np.median(off)), 1e-9 * float(np.ptp(y)))
        if keep.sum() < 3:
            break
        similarity = align_points(x[keep], y[keep])
    return similarity


def align_named_cameras(recovered: dict[str, Camera], truth: dict[str, Camera]) -> np.ndarray:
    """truth_from_recovered (4, 4) similarity from the cameras that both hold under one name.

    Fitted on the camera centres together with one point ahead of each, at the mean distance of the
    cameras from their common
    centre: turntables and arcs, whose centres alone nearly lie in a line or plane, are well
    determined that way. Fitted again to the half of the cameras that fits best (least trimmed
    squares; Rousseeuw & Van Driessen 2006), at last to all within 3 medians: a few wrong ones do
    not move the others.
    """
    names = sorted(set(recovered) & set(truth))
    if not names:
        raise UserError(
            "no recovered camera has the name of a true one",
            f"recovered: {', '.join(sorted(recovered)[:3])} ...; truth: {', '.join(sorted(truth)[:3])} ...",
        )
    a = np.array([recovered[n].world_from_camera for n in names])
    b = np.array([truth[n].world_from_camera for n in names])
    keep = np.ones(len(names), bool)
    if len(names) < 2 or np.ptp(a[:, :3, 3], axis=0).max() < 1e-12:
        raise UserError(
            f"{len(names)} matched cameras cannot fix a scale",
            "at least 2 apart from each other are needed",
        )
    similarity, off = _fit_poses(a, b, keep)
    for step in range(TRIMMED_STEPS + 1 if len(names) >= 5 else 0):
        medians = 3 if step == TRIMMED_STEPS else 1
        keep = off <= medians * np.median(off) + 1e-9 * np.ptp(b[:, :3, 3])
        similarity, off = _fit_poses(a, b, keep)
    return similarity


def _fit_poses(a: np.ndarray, b: np.ndarray, keep: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """b_from_a (4, 4) of the poses `keep` (N,) of (N, 4, 4), and how far each pose is off (N,): the
    farther of its centre and of the point ahead of it."""
    spreads = (
        np.linalg.norm(c - c.mean(0), axis=1).mean() for c in (a[keep, :3, 3], b[keep, :3, 3])
    )
    found, true = (
        np.stack([m[:, :3, 3], m[:, :3, 3] + m[:, :3, 2] * spread], 1)
        for m, spread in zip((a, b), spreads, strict=True)
    )
    similarity = align_points(found[keep].reshape(-1, 3), true[keep].reshape(-1, 3))
    return similarity, np.linalg.norm(move_points(similarity, found) - true, axis=-1).max(1)


def angle_between(a, b) -> float:
    """Angle in degrees between two rotations (3, 3)."""
    return se3.rotation_angle(np.asarray(a, np.float64).T @ np.asarray(b, np.float64))


def angles_between(a, b) -> np.ndarray:
    """Angles (...) in degrees between rotations (..., 3, 3), broadcast against each other."""
    r = np.swapaxes(np.asarray(a, np.float64), -1, -2) @ np.asarray(b, np.float64)
    off = np.stack(
        [r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]], -1
    )
    trace = r[..., 0, 0] + r[..., 1, 1] + r[..., 2, 2]
    # atan2 of twice the sine and twice the cosine: precise near 0, where arccos is not
    return np.degrees(np.arctan2(np.linalg.norm(off, axis=-1), trace - 1))


def turned_cameras(centre, cameras: dict[str, Camera], rotations: np.ndarray) -> dict[str, Camera]:
    """Each camera turned about a point (3,) by its rotation of (N, 3, 3): distance and aim stay."""
    out = {}
    for (name, camera), turn in zip(cameras.items(), rotations, strict=True):
        motion = np.eye(4)
        motion[:3, :3] = turn
        motion[:3, 3] = np.asarray(centre) - turn @ np.asarray(centre)
        out[name] = camera.with_pose(motion @ camera.world_from_camera)
    return out


def pose_errors(
    recovered: dict[str, Camera], truth: dict[str, Camera], truth_from_recovered
) -> tuple[np.ndarray, np.ndarray]:
    """(rotation errors in degrees, distances between centres in world units) of the matched
    cameras, sorted by name."""
    rotations, distances = [], []
    for name in sorted(set(recovered) & set(truth)):
        moved = move_pose(truth_from_recovered, recovered[name].world_from_camera)
        rotations.append(angle_between(moved[:3, :3], truth[name].world_from_camera[:3, :3]))
        distances.append(float(np.linalg.norm(moved[:3, 3] - truth[name].centre)))
    return np.array(rotations), np.array(distances)


def same_frame(recovered: dict[str, Camera], truth: dict[str, Camera]) -> bool:
    """Whether the recovered cameras stand in the truth's frame already: median rotation under 5
    degrees and median centre within 5 % of the cameras' mean distance from their middle. Cameras
    that were given pass, refined or not; an SfM frame never does."""
    names = set(recovered) & set(truth)
    if not names:
        return False
    rotations, distances = pose_errors(recovered, truth, np.eye(4))
    centres = np.array([truth[n].centre for n in names])
    spread = np.linalg.norm(centres - centres.mean(0), axis=1).mean()
    return bool(np.median(rotations) < 5.0 and np.median(distances) <= 0.05 * max(spread, 1e-12))


def aligned(
    asset: Asset, truth: dict[str, Camera], recovered: dict[str, Camera]
) -> tuple[Asset, str]:
    """The asset carried into the frame of the true cameras, and how: 'identity' when its cameras
    stand there already (they were given) or it has none, 'sim3' when they were recovered from
    photos and the frame is free."""
    if not recovered or same_frame(recovered, truth):
        return asset, "identity"
    s = align_named_cameras(recovered, truth)
    k = scale_of(s)
    flash = (
        None if asset.flash is None else Flash(asset.flash.offset * k, asset.flash.intensity * k**2)
    )
    environment = None if asset.environment is None else rotate_environment(asset.environment, s)
    cameras = tuple(
        (name, camera.with_pose(move_pose(s, camera.world_from_camera)))
        for name, camera in asset.cameras
    )
    placed = s @ asset.world_from_asset
    return replace(
        asset, world_from_asset=placed, environment=environment, cameras=cameras, flash=flash
    ), "sim3"

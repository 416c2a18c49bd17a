"""The recovered pile laid on the true one. The photo's camera is known, so they differ by one scale
about that camera, which a photo does not know, and by the choice of the object's own frame: the one
that agrees best with all registered instances.
"""

from __future__ import annotations

import numpy as np

from relit.conventions import move_points, scale_of, similarity
from relit.evaluate.alignment import angles_between
from relit.geometry.se3 import nearest_rotation
from relit.scene import Camera

GUESSED = 0.1  # weight of a first guess beside one instance


def object_turn(poses: dict, true_poses: dict) -> np.ndarray:
    """(3, 3) object_from_true_object: the turn of the object's frame that most registered instances
    agree on."""
    turns = np.array(
        [
            nearest_rotation(poses[k][:3, :3]).T @ nearest_rotation(true_poses[k][:3, :3])
            for k in poses
        ]
    )
    angles = angles_between(turns[:, None], turns[None])
    middle = int(np.argmin(np.median(angles, axis=1)))
    near = angles[middle] <= max(3 * float(np.median(angles[middle])), 1.0)
    return nearest_rotation(turns[near].sum(0))


def scene_alignment(
    poses: dict, true_poses: dict, photo: Camera, true_points: np.ndarray, vertices: np.ndarray
) -> tuple[float, np.ndarray, np.ndarray]:
    """Of poses world_from_object (4, 4) by label and their truth: the scale about the camera that
    carries the recovered scene onto the true one; the point (3,) of the recovered object's frame
    that is the middle of the true one (`scale_about`); and object_from_true_object (4, 4) with the
    turn of `object_turn`, refined between the surfaces (ICP). vertices: of the recovered object.
    Without the refinement: `frame_by_poses`."""
    turn = object_turn(poses, true_poses)
    middle = (true_points.min(0) + true_points.max(0)) / 2
    own = (vertices.min(0) + vertices.max(0)) / 2
    size = np.ptp(vertices, axis=0).max() / np.ptp(true_points, axis=0).max()
    frame = similarity(turn, own - size * turn @ middle, size)
    frame = icp(true_points[::10], vertices.astype(np.float64), frame)
    return *scale_about(photo.centre, poses, true_poses, middle, move_points(frame, middle)), frame


def frame_by_poses(
    poses: dict, true_poses: dict, scale: float, own: np.ndarray, middle: np.ndarray
) -> np.ndarray:
    """object_from_true_object (4, 4) from the poses alone, as SfD's `blender_align`: the camera
    fixes all but one scale, the poses fix that, and no surface is consulted, so an error of the
    poses stays in what is measured after it. scale, own: of `scale_about`. middle: (3,) of the true
    object."""
    turn = object_turn({k: p for k, p in poses.items() if k in true_poses}, true_poses)
    sizes = [
        scale_of(true_poses[k]) / (scale * scale_of(poses[k])) for k in poses if k in true_poses
    ]
    size = float(np.median(sizes))
    return similarity(turn, own - size * turn @ middle, size)


def scale_about(
    centre: np.ndarray, poses: dict, true_poses: dict, middle: np.ndarray, guess: np.ndarray
) -> tuple[float, np.ndarray]:
    """(scale, point (3,) of the recovered object's frame) with which the recovered scene, grown
    about the camera's `centre`, has its objects' points where the true ones have their `middle`:
    linear least squares over the instances, with less weight for those that are off. guess: (3,) of
    that point; it counts for little, but where there is one instance alone. Distances tell the
    scale far better than sizes, a per cent of a distance is a tenth of an object; and the point
    follows from the poses, as the alignment of two surfaces does not tell it well enough where one
    has thicker walls."""
    keys = [k for k in poses if k in true_poses]
    there = np.array([move_points(true_poses[k], middle) - centre for k in keys])
    rows = np.stack(
        [np.concatenate([(poses[k][:3, 3] - centre)[:, None], poses[k][:3, :3]], 1) for k in keys]
    )
    held = GUESSED * scale_of(poses[keys[0]]) * np.concatenate([-guess[:, None], np.eye(3)], 1)
    weight = np.ones(len(keys))
    for _ in range(20):
        root = np.sqrt(weight)[:, None]
        a, b = (
            np.concatenate([(rows * root[..., None]).reshape(-1, 4), held]),
            np.append(there * root, np.zeros(3)),
        )
        solved = np.linalg.lstsq(a, b, rcond=None)[0]
        off = np.linalg.norm(rows @ solved - there, axis=1)
        weight = 1 / (1 + np.square(off / max(float(np.median(off)), 1e-9)))
    return float(solved[0]), solved[1:] / solved[0]


def icp(source: np.ndarray, target: np.ndarray, start: np.ndarray, rounds: int = 30) -> np.ndarray:
    """Similarity (4, 4) that carries points onto points, from `start`; nearest neighbours, the
    farthest tenth left out."""
    from scipy.spatial import cKDTree

    from relit.geometry.se3 import umeyama

    tree, frame = cKDTree(target), start
    for _ in range(rounds):
        moved = move_points(frame, source)
        distance, index = tree.query(moved)
        keep = distance <= np.quantile(distance, 0.9)
        frame = umeyama(source[keep], target[index[keep]])
    return frame


def grown_about(centre: np.ndarray, scale: float) -> np.ndarray:
    """(4, 4) scaling about a point."""
    return similarity(np.eye(3), np.asarray(centre) * (1 - scale), scale)

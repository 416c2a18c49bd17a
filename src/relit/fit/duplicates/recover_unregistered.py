"""Who was left out of a volume pass is sought in its model
(fit/registration/instances/recovery.py): those whom the search could not place and those who do not
agree with the others. In the last of the passes for the poses alone who is found, or nearly, takes
part in one more, as it may show what nobody else does; in the finished model who is found has its
place there, and shapes nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial

import mitsuba as mi
import numpy as np

from relit.conventions import similarity
from relit.fit.duplicates.options import DuplicatesOptions
from relit.fit.duplicates.pose_passes import light_turns, related
from relit.fit.duplicates.poses import instance_name
from relit.fit.duplicates.vessels import body_axis
from relit.fit.passes.pixels import PixelBank
from relit.fit.passes.volume import VolumeModel
from relit.fit.registration.instances.azimuth import others_of, turned_alike
from relit.fit.registration.instances.outliers import LEAST, MOST, view_errors
from relit.fit.registration.instances.recovery import galleries_of, sought_again
from relit.fit.registration.instances.views import InstanceView, ViewId
from relit.geometry.mesh import extract_mesh
from relit.geometry.sdf import dense_values
from relit.geometry.se3 import nearest_rotation
from relit.scene import Mesh

MANY = 20  # instances; the shape of more has no need of those that were left out


def joiners(
    others: list[InstanceView],
    views: list[InstanceView],
    poses: np.ndarray,
    after: np.ndarray,
    model: VolumeModel,
    mesh: Mesh,
    level: float,
    *,
    run,
    options: DuplicatesOptions,
    seed: int,
) -> dict[ViewId, np.ndarray]:
    """Poses, by view, of those of `others` who are to take part in the next pass: what shows them is
    found in the model of this one, or nearly. So few are taken that they are told to be odd if they
    stand wrong (fit/registration/instances/outliers.py).

    views: of the pass. poses, after: theirs (N, 4, 4) in its model, and what became of them then,
    which the result goes with. mesh: of the pass. level: median of the views' errors.
    """
    count = len(views) + len(others)
    if (
        "search" in options.without
        or len(views) < LEAST
        or count > MANY
        or len(others) > MOST * count
    ):
        return {}
    if body_axis(mesh) is not None:  # these are placed by their outlines, in the end
        return {}
    seek, found = seeker(views, poses, model, level, seed), {}
    for view in others:
        pose, sure = seek(view, guess=True)
        if pose is not None:
            so = "was" if sure else "may have been"
            run.say(
                f"the object with {instance_name(view)} {so} found in the model of the others: it takes part in the next pass"
            )
            found[view.id] = pose
    return carried(found, poses, after)


def seeker(
    views: list[InstanceView], poses: np.ndarray, model: VolumeModel, level: float, seed: int
) -> Callable:
    """`sought_again` in the model of a pass; views, poses: that it was fitted to. level: median of
    their errors."""
    scene = related(views, poses)
    turns = None if len(scene.motions) == 1 else lambda some: light_turns(some, scene)
    galleries = lru_cache(1)(
        partial(galleries_of, model, float(np.linalg.norm(poses[0][:3, 3])))
    )  # they are large

    def seek(view: InstanceView, **how):
        return sought_again(view, views[0], poses[0], model, level, turns, galleries, seed, **how)

    return seek


def with_found(
    views: list[InstanceView],
    poses: np.ndarray,
    others: list[InstanceView],
    on_axes: dict[ViewId, np.ndarray],
    model: VolumeModel,
    bank: PixelBank,
    run,
    seed,
):
    """(views, poses, vague: see `volume_stage`) with those of `others` that are found in the model,
    which gets their entries."""
    level, mesh = (
        float(np.nanmedian(view_errors(bank, model, seed))),
        extract_mesh(dense_values(model.grid)),
    )
    seek = seeker(views, poses, model, level, seed)
    found, vague, turned = [], [], turned_by_others(mesh, views, poses)
    for view in others:
        pose, sure = seek(view, on_axis=on_axes.get(view.id), turned=turned)
        if pose is not None and not sure:
            run.say(
                f"note: the object with {instance_name(view)} is placed on its axis; its turn about that is a guess"
            )
        else:
            run.say(
                f"the object with {instance_name(view)} was {'' if sure else 'not '}found in the finished model of the others"
            )
        if pose is not None:
            (found if sure else vague).append((view, pose))
    count = len(found) + len(vague)
    model.reflections = mi.Float(
        np.concatenate([np.array(model.reflections), np.zeros(4 * count, np.float32)])
    )
    return (
        [*views, *(v for v, _ in found)],
        np.concatenate([poses, *(p[None] for _, p in found)]),
        vague,
    )


def turned_by_others(mesh: Mesh, views: list[InstanceView], poses: np.ndarray):
    """What turns another view's pose about the axis of a body of revolution, as `sought_again` asks
    for it, by what `views` show; the pose as it is where they show no texture, and None where the
    mesh is no such body."""
    axis = body_axis(mesh)
    if axis is None:
        return None
    others = others_of(mesh, views, poses)
    return (
        (lambda _, pose: pose)
        if others is None
        else (lambda view, pose: turned_alike(others, view, pose, axis))
    )


def carried(
    some: dict[ViewId, np.ndarray], before: np.ndarray, after: np.ndarray
) -> dict[ViewId, np.ndarray]:
    """Poses of the object's frame before passes that have moved it, in that after them: by the
    similarity that those (N, 4, 4) tell which have gone along."""
    turn = nearest_rotation(np.sum(after[:, :3, :3] @ before[:, :3, :3].transpose(0, 2, 1), 0))
    far = [
        np.linalg.norm(p[:, :3, 3] - p[:, :3, 3].mean(0), axis=1).mean() for p in (before, after)
    ]
    scale = far[1] / far[0] if len(before) > 1 and far[0] > 0 else 1.0
    shift = np.median(after[:, :3, 3] - scale * before[:, :3, 3] @ turn.T, axis=0)
    return {
        k: similarity(turn @ p[:3, :3], scale * turn @ p[:3, 3] + shift) for k, p in some.items()
    }

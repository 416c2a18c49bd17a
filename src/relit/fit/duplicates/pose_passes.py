"""Volume passes of identical objects with the poses of all instances: those for the poses alone,
which are made until textures lie on one another, and what the last one shares with them. For the
recipe `duplicates`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import mitsuba as mi
import numpy as np

from relit.errors import EXIT_FAILED, UserError
from relit.fit.duplicates.mirrored_silhouettes import (
    Symmetry,
    find_symmetry,
    mirrored_rays,
    mirrored_views,
)
from relit.fit.duplicates.options import DuplicatesOptions
from relit.fit.duplicates.photo_motions import SharedScene, gather, motion_or_none
from relit.fit.duplicates.poses import instance_name
from relit.fit.duplicates.vessels import body_axis
from relit.fit.passes.pixels import PixelBank
from relit.fit.passes.volume import VolumeModel, VolumeOptions, fit_volume, start_model
from relit.fit.registration.instances.near_symmetry_search import coherent_turns
from relit.fit.registration.instances.options import DETAILED, Search
from relit.fit.registration.instances.outliers import odd_instances, view_errors
from relit.fit.registration.instances.views import (
    InstanceView,
    ViewId,
    carved,
    hold_distances,
    instance_crops,
    move_poses,
    moved_poses,
    pixel_bank,
)
from relit.fit.registration.register import crop_rings
from relit.fit.shape.alignment import follow_views
from relit.fit.shape.outlines import follow_with_poses
from relit.geometry.hull import NoShape
from relit.geometry.mesh import extract_mesh
from relit.geometry.sdf import dense_values
from relit.geometry.se3 import rotation_angle, turns_apart
from relit.recipe import FitContext
from relit.rendering.appearance.world_light import shade_world, start_world_light
from relit.scene import Mesh

HOLD = 40  # steps of a volume pass of one level before poses move
HOLD_OPENED = 100  # the same of a pass that begins with the shape of the one before, mended
# volume passes for the poses alone, at most, until those who were left out are sought, and again
# where they have joined
PASSES = 4
ORDINALS = ("first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth")
JOINT = ("joint", *(f"joint_{k}" for k in range(2, 2 * PASSES + 1)))  # their stages
WORSE = 1.1  # times the others' error with those who have joined, and these are out again
ARRIVED = 0.5  # degrees; a pass that turns the instances by less was the last one
CLOSE, CLOSER = (
    0.25,
    0.9,
    # so was one that leaves textures within these pixels, or not even a tenth closer than the one
    # before
)


Seek = Callable[
    [list[InstanceView], np.ndarray, np.ndarray, VolumeModel, Mesh, float], dict[ViewId, np.ndarray]
]  # see `fit.duplicates.recover_unregistered.joiners`


@dataclass(frozen=True)
class Pass:
    """What a volume pass for the poses alone gives. poses: (N, 4, 4). odd: (N,) bool, who shows
    what does not agree with the model of all.
    errors: (N,) squared differences, see `view_errors`. turn: degrees by which it has turned the
    instances, the median. off: pixels, see `followed`. symmetry: of its shape; None where that is
    not even. mixed: whether instances were turned then by which the object nearly
    looks like itself: what it has built is of no use. one_sided: whether the shape has turned out
    to be its own mirror image, and silhouettes bounded it from one side only; a body of revolution
    has no other side. joining, joining_poses: views that are to take part in the next pass, and
    their poses (M, 4, 4). values: (n, n, n) distances of its shape."""

    poses: np.ndarray
    odd: np.ndarray
    errors: np.ndarray
    turn: float
    off: float | None
    symmetry: Symmetry | None
    mixed: bool = False
    one_sided: bool = False
    joining: tuple[ViewId, ...] = ()
    joining_poses: np.ndarray = field(default_factory=lambda: np.zeros((0, 4, 4)))
    values: np.ndarray | None = None

    @property
    def found(self) -> dict[ViewId, np.ndarray]:
        """Poses of the views that are to take part in the next pass."""
        return dict(zip(self.joining, self.joining_poses, strict=True))

    @property
    def exact(self) -> bool:
        """Whether textures lie on one another as closely as flow can tell."""
        return self.off is not None and self.off < CLOSE

    def arrived(self, last: Pass | None) -> bool:
        """Whether another one would only lead the poses away again: textures brought them back to
        where they had been before, or as close together as flow can tell on a shape that
        silhouettes bound from both sides, where it has two, or hardly closer than in the pass
        before."""
        if self.off is None or self.mixed:
            return False
        settled = (
            last is not None
            and last.off is not None
            and not last.mixed
            and self.off > CLOSER * last.off
        )
        return settled or self.turn < ARRIVED or (self.exact and not self.one_sided)


def joint_stages(
    views: list[InstanceView],
    poses: np.ndarray,
    others: list[InstanceView],
    seek: Callable,
    fit: FitContext,
):
    """(views, poses, odd (N,) bool, arrived: see `Pass`, the last pass) after a first volume pass,
    and others while textures say that poses are still on their way (at most PASSES): what each
    gives is thrown away but for the poses, and which instances show what does not agree with the
    model of all. A shape that grew up with better poses is sharper, and moves them on. Those of
    `others` whom the last pass finds (see `fit.duplicates.recover_unregistered.joiners`) take part in more, until poses
    have arrived again, and the rest is sought once more then; where those of before agree clearly
    less for it, all is as it was. seek: of those who are sought, and as Seek."""
    run = fit.run
    views, poses, odd, last, arrived, ago = (
        list(views),
        poses.copy(),
        np.zeros(len(views), bool),
        None,
        False,
        None,
    )
    number, end = 0, PASSES
    while True:
        left = [v for v in others if v.id not in {w.id for w in views}]
        while number < end:
            rest = np.flatnonzero(~odd)
            asked = partial(seek, left) if left and number + 1 < len(JOINT) else None
            task = PassTask(number, last, asked, number + 1 == end)
            one = joint_stage([views[k] for k in rest], poses[rest], task, fit)
            poses[rest], odd[rest] = one.poses, one.odd
            last, arrived, number = one, one.arrived(last), number + 1
            if arrived or one.off is None:
                break
        if ago and worse(ago[-1], last):
            run.say("the others agree less for it: all is as it was before")
            return ago
        if not last.found:
            return views, poses, odd, arrived, last
        ago, end = ([*views], poses.copy(), odd, arrived, last), min(number + PASSES, len(JOINT))
        back = [v for v in left if v.id in last.found]
        views, odd = [*views, *back], np.append(odd, np.zeros(len(back), bool))
        poses = np.concatenate([poses, *(last.found[v.id][None] for v in back)])


def worse(before: Pass, after: Pass) -> bool:
    """Whether those who took part in a pass agree clearly less with the model of a later one, in
    which more do."""
    stayed = before.errors[~before.odd]  # those who joined come after them
    return bool(np.nanmedian(after.errors[: len(stayed)]) > WORSE * np.nanmedian(stayed))


@dataclass(frozen=True)
class PassTask:
    """number: of the pass, from 0. last: the one before. seek: finds the views that take part in the
    next one, where this is `final`, or poses have arrived with it."""

    number: int
    last: Pass | None = None
    seek: Seek | None = None
    final: bool = False


def joint_stage(
    views: list[InstanceView], poses: np.ndarray, task: PassTask, fit: FitContext
) -> Pass:
    """One such pass. Textures count here already: what the pass has built in the wrong place it does
    not take back."""
    options = fit.options

    def computed(stage) -> Pass:
        symmetry = task.last and task.last.symmetry
        model, bank, moved = shape_and_poses(
            views, poses, fit.run, stage, options, fit.seed, symmetry
        )
        return judged_pass(views, (poses, moved), model, bank, task, fit)

    return fit.run.cached(
        JOINT[task.number],
        Pass,
        computed,
        steps=sum(options.level_steps),
        title=f"shape and poses ({ORDINALS[task.number]} pass)",
    )


def judged_pass(
    views: list[InstanceView],
    moves: tuple[np.ndarray, np.ndarray],
    model: VolumeModel,
    bank: PixelBank,
    task: PassTask,
    fit: FitContext,
) -> Pass:
    """What a pass gives that has ended with `model`. moves: poses (N, 4, 4) before and after it."""
    run, options, seed, last = fit.run, fit.options, fit.seed, task.last
    before, poses = moves[0], moves[1]
    built, off, turned = poses.copy(), None, None
    errors = view_errors(bank, model, seed)
    odd = odd_instances(errors)
    some = [views[k] for k in np.flatnonzero(~odd)]
    for k in np.flatnonzero(odd):
        run.say(
            f"note: the object with {instance_name(views[k])} is left out: what it shows does not agree with the model of all"
        )
    values = dense_values(model.grid)
    mesh = extract_mesh(values, faces=options.faces)
    if "textures" not in options.without:
        better, moved, off = followed(mesh, some, poses[~odd], run, options)
        if off is not None:
            mesh, poses[~odd] = better, moved
            # where textures lie on one another all poses are right, but after a mixed pass
            if off >= CLOSE or (last and last.mixed):
                turned = resolve_near_symmetry(mesh, some, moved, run, options, seed)
    turn = float(np.median(turns_apart(before[~odd], poses[~odd])))
    symmetry = None
    if "symmetry" not in options.without and turned is None:
        symmetry = find_symmetry(mesh, views, poses)
    if task.number == 0 and symmetry is not None:
        run.say("the object is its own mirror image: its silhouettes bound it from both sides")
    if turned is not None:
        poses[~odd] = turned
    one = Pass(
        poses,
        odd,
        errors,
        turn,
        off,
        symmetry,
        turned is not None,
        bounded_from_one_side(mesh, symmetry, last),
        values=values,
    )
    if task.seek and turned is None and (off is None or one.arrived(last) or task.final):
        level = float(np.nanmedian(errors))
        found = task.seek(some, built[~odd], poses[~odd], model, mesh, level)
        there = np.array([*found.values()]).reshape(-1, 4, 4)
        one = replace(one, joining=tuple(found), joining_poses=there)
    return one


def bounded_from_one_side(mesh: Mesh, symmetry: Symmetry | None, last: Pass | None) -> bool:
    """See `Pass.one_sided`. mesh, symmetry: of a pass. last: the one before, or None."""
    news = symmetry is not None and (last is None or last.symmetry is None)
    return news and body_axis(mesh) is None


def resolve_near_symmetry(
    mesh: Mesh,
    views: list[InstanceView],
    poses: np.ndarray,
    run,
    options: DuplicatesOptions,
    seed: int,
) -> np.ndarray | None:
    """The poses (N, 4, 4) with those turned that stand wrong by a turn by which the object nearly
    looks like itself (`fit.registration.instances.near_symmetry_search.coherent_turns`); None where there are none. Poses are
    exact by now, so that silhouettes tell more. Bodies of revolution are turned by their decoration
    (fit/registration/instances/revolution_search.py), and not asked. mesh: of the pass."""
    if len(views) < 4 or "search" in options.without or body_axis(mesh) is not None:
        return None
    crops = instance_crops(views)
    turned = coherent_turns(
        views,
        crops,
        crop_rings(crops, DETAILED),
        poses,
        Search(),
        seed=seed,
        exact=True,
        say=run.say,
    )
    return None if turned is None else turned.poses


def followed(
    mesh: Mesh, views: list[InstanceView], poses: np.ndarray, run, options: DuplicatesOptions
) -> tuple[Mesh, np.ndarray, float | None]:
    """(mesh, poses, off) as outlines, and where these are not exact textures too, have them. off:
    pixels by which textures do not lie on one another then (median); None where they have no part
    in it."""
    cameras = [v.camera.with_pose(p) for v, p in zip(views, poses, strict=True)]
    pictures, masks, known = zip(*((v.rgb, v.mask, v.known) for v in views), strict=True)
    if "textures" in options.without:
        return *follow_with_poses(mesh, cameras, masks, known, options.outlines), None
    mesh, poses, off = follow_views(mesh, cameras, pictures, masks, known, options.outlines)
    if off is None:
        return mesh, poses, None
    before, after = off
    run.say(
        f"poses that follow the labels alone leave textures {before:.1f} pixels off (median): they follow both now ({after:.1f} pixels)"
    )
    return mesh, poses, after


def placed_by_outlines(
    mesh: Mesh,
    views: list[InstanceView],
    poses: np.ndarray,
    run,
    options: DuplicatesOptions,
    still: bool = False,
) -> tuple[Mesh, np.ndarray, None]:
    """As `followed`, by outlines alone and with the turns of the poses as they are; textures are
    not asked. still: the mesh stays too."""
    cameras = [v.camera.with_pose(p) for v, p in zip(views, poses, strict=True)]
    masks, known = zip(*((v.mask, v.known) for v in views), strict=True)
    return *follow_with_poses(
        mesh, cameras, masks, known, options.outlines, turning=False, still=still
    ), None


def shape_and_poses(
    views: list[InstanceView],
    poses: np.ndarray,
    run,
    stage,
    options: DuplicatesOptions,
    seed: int,
    symmetry: Symmetry | None = None,
    still: bool = False,
    vessel: np.ndarray | None = None,
):
    """One volume pass: (model, its pixel bank, poses). symmetry: of the shape of the pass before,
    or None. still: the poses stay as they are. vessel: distances that it begins with in the place
    of a hull, without the coarse level, or None."""
    bank = pixel_bank(views, poses)
    inside = np.concatenate([v.rgb[v.mask > 0.99] for v in views])
    beside, there = (
        mirrored_views(symmetry, views, poses) if symmetry else ([], np.zeros((0, 4, 4)))
    )
    values = (
        vessel
        if vessel is not None
        else instance_hull([*views, *beside], np.concatenate([poses, there]), options.levels[0])
    )
    model = start_model(values, np.maximum(inside.mean(0), 1e-3), None, full=False)
    scene = related(views, poses, run)
    model.appearance = (
        shade_world
        if len(scene.motions) == 1
        else partial(shade_world, turns=light_turns(views, scene))
    )
    model.reflections, model.rates = start_world_light(float(inside.mean()), len(views))
    model.mirrored = symmetry and mirrored_rays(symmetry, bank, beside)
    rate = 0.0 if still else pose_rate(views, options)
    if rate > 0:
        move_poses(bank, model)
    # on a coarse grid the shape is wrong by more than the poses, which would follow it away from
    # where they are
    hold = options.level_steps[0] if len(options.levels) > 1 else HOLD
    coarse = 0 if vessel is None else 1
    levels, steps = options.levels[coarse:], options.level_steps[coarse:]
    o = VolumeOptions(
        levels,
        steps,
        options.rays,
        refine_cameras=rate,
        hold=hold if vessel is None else HOLD_OPENED,
    )

    def begin_level(model: VolumeModel) -> None:
        if rate > 0 and model.grid.n not in options.levels[:2]:
            hold_distances(model)

    fit_volume(bank, model, o, stage, seed, begin_level)
    return model, bank, moved_poses(bank, views, poses)


def instance_hull(views: list[InstanceView], poses: np.ndarray, nodes: int) -> np.ndarray:
    """Distances (n, n, n) of the visual hull. Raises UserError where nothing is left."""
    try:
        return carved(views, poses, nodes, 0.15, Search.depth, crossed=True)
    except NoShape:
        raise UserError(
            "the silhouettes have nothing in common",
            "poses are wrong, or the objects differ",
            "check the label image",
            code=EXIT_FAILED,
        ) from None


def pose_rate(views: list[InstanceView], options: DuplicatesOptions) -> float:
    """Step of the pose corrections in the volume pass."""
    return 0.0 if "refinement" in options.without or len(views) < 2 else options.refine_poses


def related(views: list[InstanceView], poses: np.ndarray, run=None) -> SharedScene:
    """How the photos stand to each other (see `fit.duplicates.recipe.photo_motions`); says so where a run
    is given and there are several."""
    scene = gather(np.linalg.inv(poses), np.array([v.photo for v in views]))
    if run is not None and len(scene.motions) > 1:
        for number, motion in enumerate(scene.motions[1:], 2):
            if motion is None:
                run.say(
                    f"note: photo {number} could not be related to the first: it helps to find the shape, but not material and light"
                )
                continue
            run.say(
                f"photo {number} is turned by {rotation_angle(motion[:3, :3]):.0f} degrees against the first"
            )
        used = [m for m in scene.motions if m is not None]
        run.say(f"{len(scene.standing)} instances in {len(used)} photos")
    return scene


def light_turns(views: list[InstanceView], scene: SharedScene):
    """Rotations from each view's photo to the first one's axes, flat, for `shade_world`."""
    turns = [motion_or_none(scene.motions[v.photo])[:3, :3] for v in views]
    return mi.Float(np.concatenate([t.ravel() for t in turns]).astype(np.float32))

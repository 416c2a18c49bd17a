"""What matches between photos tell of their poses: groups that COLMAP could put together
(cameras/links.py), as evidence for the search.

A group that is large enough is where the shape begins: its photos keep their poses to each other,
all other photos are searched for in a model of them, and join. Smaller groups vote: where most of a
group's photos agree on where the group lies, the others are tried there too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from relit.cameras.links import Group, link_photos
from relit.capture.sphere import SphereView, find_sphere, up_direction
from relit.conventions import similarity
from relit.device import load_pycolmap
from relit.errors import UserError
from relit.fit.collection.photos import CollectionPhoto
from relit.fit.passes.load_photos import resize
from relit.fit.registration.photos.depth import depth_limit
from relit.fit.registration.photos.few import FEW
from relit.fit.registration.photos.framing import is_cut, slide
from relit.fit.registration.photos.poses import (
    COARSE,
    HINT,
    PARTS,
    SLACK,
    best_refined,
    coarse_model,
)
from relit.fit.registration.register import (
    Crop,
    crop_rings,
    directions_around,
    hint_prior,
    make_gallery,
    near,
    refine,
    search,
    views_from,
    volume_render,
)
from relit.geometry.se3 import nearest_rotation, rotation_angle, rotation_from

BEGINS = 8  # photos of a group from which on the shape begins with it
NEARLY_ALL, FEWEST = (
    0.75,
    4,
)  # share of few photos, and how many, that do as well: six photos of a can are linked by its label
FITS = 0.8  # mean score of its photos in a model of themselves, below which a group is not believed
ALIKE = 20.0  # degrees within which two photos of a group agree on where it lies
CONTRADICTED = (
    50.0  # degrees: median of the angles to the hints, above which a group is not believed
)
LOSS = 0.03  # of score that a photo may lose where its group wants it


@dataclass(frozen=True)
class LinkedGroups:
    """Groups of linked photos, the largest first."""

    groups: tuple[Group, ...]


def links_stage(shots: list[CollectionPhoto], run, seed: int) -> LinkedGroups:
    """Groups of linked photos: one of all where they come with cameras; none where pycolmap is
    missing or nothing matches."""
    if all(s.given is not None for s in shots):
        return LinkedGroups((group_of_cameras(shots),))

    def computed(stage) -> LinkedGroups:
        try:
            load_pycolmap()
        except UserError as error:
            run.say(f"note: photos are not matched with each other: {error}")
            return LinkedGroups(())
        photos = [_full(s) for s in shots]
        return LinkedGroups(tuple(link_photos(photos, stage.folder / "work", seed, run.say)))

    return run.cached("links", LinkedGroups, computed, title="matches between photos")


def group_of_cameras(shots: list[CollectionPhoto]) -> Group:
    """The given cameras as if matches had found them: believed like those, as far as the
    silhouettes agree."""
    focals = np.array([s.camera.fx / max(s.camera.width, s.camera.height) for s in shots])
    return Group(
        np.arange(len(shots)),
        np.array([s.given for s in shots]),
        focals,
        np.zeros((0, 3)),
        np.zeros(0, int),
    )


def _full(shot: CollectionPhoto):
    """(rgb, mask, focal length or 0) of the photo at its own size."""
    pixels = shot.photo.load()
    h, w = pixels.rgb.shape[:2]
    mask = resize(shot.mask, w, h) if pixels.mask is None else pixels.mask
    known = shot.photo.camera.fx if shot.photo.camera is not None else shot.photo.focal_hint
    return pixels.rgb, mask, float(known or 0)


def with_focals(shots: list[CollectionPhoto], groups: Sequence[Group]) -> list[CollectionPhoto]:
    """The shots, those of groups with the focal length that COLMAP found."""
    out = list(shots)
    for group in groups:
        for i, focal in zip(group.photos, group.focals, strict=True):
            c = out[i].camera
            f = float(focal) * max(c.width, c.height)
            out[i] = replace(out[i], camera=replace(c, fx=f, fy=f))
    return out


def poses_of_group(
    group: Group, shots: list[CollectionPhoto], directions: np.ndarray, heard=None
) -> tuple[np.ndarray, float]:
    """Poses (n, 4, 4) of a group in the object's frame, the object within radius 1 about the
    origin, and the median angle to the hints (degrees; 0 where fewer than three photos have one).
    Without hints up is where the cameras' is, and the front is arbitrary.
    heard: (n,) bool, photos whose masks say where the object is, or None.

    Raises UserError where the masks have no place in common.
    """
    cameras = [shots[i].camera.with_pose(p) for i, p in zip(group.photos, group.poses, strict=True)]
    heard = np.ones(len(cameras), bool) if heard is None else heard
    views = [
        SphereView(c, None, shots[i].mask)
        for c, i, h in zip(cameras, group.photos, heard, strict=True)
        if h
    ]
    sphere, _ = find_sphere(views, group.points)
    centres = group.poses[:, :3, 3] - sphere.centre
    toward = centres / np.linalg.norm(centres, axis=1, keepdims=True)
    said = directions[group.photos]
    hinted = np.linalg.norm(said, axis=1) > 0.5
    up = up_direction(cameras)
    up = np.array([0.0, 1.0, 0.0]) if up is None else up
    if hinted.sum() >= 3:
        # hints of a few photos from one side leave a turn open: what is up in the pictures is up
        turn = nearest_rotation(
            said[hinted].T @ toward[hinted] + 0.3 * hinted.sum() * np.outer([0, 1, 0], up)
        )
        angle = float(
            np.degrees(
                np.median(
                    np.arccos(np.clip((said[hinted] * (toward[hinted] @ turn.T)).sum(1), -1, 1))
                )
            )
        )
    else:
        turn, angle = rotation_from(up, np.array([0.0, 1.0, 0.0])), 0.0
    poses = np.array(group.poses)
    poses[:, :3, :3] = turn @ poses[:, :3, :3]
    poses[:, :3, 3] = centres @ turn.T / sphere.radius
    return poses, angle


def poses_from_links(
    crops: list[Crop],
    groups: Sequence[Group],
    shots: list[CollectionPhoto],
    directions: np.ndarray,
    degrees: float,
    keep: int,
    seed,
    say,
):
    """(poses (P, 4, 4), scores (P,), held (P,) bool) that begin with the largest group, or None
    where no group carries a shape.

    held: photos whose poses come from matches; no search moves them.
    """
    if not groups or len(groups[0].photos) < min(BEGINS, max(FEWEST, NEARLY_ALL * len(crops))):
        return None
    members, everyone = groups[0].photos, np.ones(len(groups[0].photos), bool)
    try:
        own, angle = poses_of_group(groups[0], shots, directions)
    except UserError as error:
        say(f"note: the linked photos have no common object ({error})")
        return None
    if angle > CONTRADICTED:
        say(
            f"note: the linked photos contradict the hints ({angle:.0f} degrees at the median): they are not used"
        )
        return None
    count = len(crops)
    poses, scores = np.tile(np.eye(4), (count, 1, 1)), np.zeros(count)
    held, doubted = np.zeros((2, count), bool)
    model, agree = begun_with(crops, members, own, everyone, seed)
    mean = float(agree.mean())
    say(f"{len(members)} linked photos begin the shape: mean score {mean:.3f}")
    if mean < FITS:
        found = without_one(crops, groups[0], shots, directions, seed)
        if found is None:
            say("note: they do not fit a common shape and are not used")
            return None
        own, model, agree, left_out = found
        rest = float(np.delete(agree, left_out).mean())
        doubted[members[left_out]] = True
        say(
            f"note: without {shots[members[left_out]].photo.name} they do (mean score {rest:.3f}); look at its mask"
        )
    poses[members], scores[members] = own, agree
    held[members] = True
    render = volume_render(model)
    others = np.flatnonzero(~held)
    for turn in range(2 if len(others) else 0):
        found, height = found_in(
            model, [crops[i] for i in others], directions[others], degrees, keep, seed + turn
        )
        poses[others], scores[others] = found, height
        poses, scores = voted(crops, groups[1:], poses, scores, render)
        trusted = np.flatnonzero((held & ~doubted) | (scores > np.median(scores[held]) - 0.05))
        say(
            f"{len(trusted) - held.sum()} of {len(others)} other photos join: mean score {scores[others].mean():.3f}"
        )
        model = coarse_model(
            [crops[i] for i in trusted], poses[trusted], 48, 150, 0.12, seed + 1 + turn
        )
        render = volume_render(model)
    return poses, scores, held


def begun_with(
    crops: list[Crop], members: np.ndarray, own: np.ndarray, heard: np.ndarray, seed: int
):
    """(a coarse model of the `heard` ones (n,) bool of a group's photos at their poses `own` (n, 4,
    4), scores (n,) of all of them)."""
    some = [crops[i] for i, h in zip(members, heard, strict=True) if h]
    limit = depth_limit(some, own[heard], 48) if len(crops) < FEW else None
    model = coarse_model(some, own[heard], 48, 150, 0.12, seed, limit)
    whole = [crops[i] for i in members]
    _, scores = refine(
        whole, own, volume_render(model), rings=crop_rings(whole, PARTS), steps=(), parts=PARTS
    )
    return model, scores


def without_one(
    crops: list[Crop], group: Group, shots: list[CollectionPhoto], directions: np.ndarray, seed: int
):
    """(poses (n, 4, 4), model, scores (n,), which) of the few photos of a group but one, which is
    in its place as well but whose mask is
    not heard: one mask that takes a glass beside the can along moves the middle and the size of
    all. None where none of them is to blame.
    """
    count, best, most = len(group.photos), None, FITS
    for i in range(count if FEWEST < count < FEW else 0):
        heard = np.arange(count) != i
        try:
            own, _ = poses_of_group(group, shots, directions, heard)
            model, scores = begun_with(crops, group.photos, own, heard, seed)
        except (UserError, ValueError):
            continue
        if scores[heard].mean() > most:
            best, most = (own, model, scores, i), float(scores[heard].mean())
    return best


def found_in(
    model, crops: list[Crop], directions: np.ndarray, degrees: float, keep: int, seed: int
):
    """Poses (P, 4, 4) and scores (P,) of photos searched for in a model; those that the frame cuts
    with place and size free."""
    render, rings = volume_render(model), crop_rings(crops, PARTS)
    cameras = views_from(directions_around(400, seed))
    gallery = make_gallery(render, cameras, PARTS)
    hinted = np.linalg.norm(directions, axis=1) > 0.5
    prior = HINT * hint_prior(gallery, directions, degrees, 45.0) * hinted[:, None, None]
    allowed = near(gallery, directions, degrees + SLACK) | ~hinted[:, None]
    found = search(crops, gallery, keep, rings=rings, prior=prior, allowed=allowed)
    cut = np.flatnonzero([is_cut(c) for c in crops])
    if len(cut):
        more = slide(
            [crops[i] for i in cut], render, cameras, keep, allowed[cut], prior[cut].max(2)
        )
        found.poses[cut], found.scores[cut] = more.poses, more.scores
    return best_refined(crops, found, render, rings, keep, COARSE)


def voted(
    crops: list[Crop], groups: Sequence[Group], poses: np.ndarray, scores: np.ndarray, render
):
    """(poses, scores) after each group's vote on where it lies: a photo whose pose does not go with
    most of its group's is tried where the group wants it, and stays there unless it fits much
    worse."""
    poses, scores = poses.copy(), scores.copy()
    for group in groups:
        wanted = consensus(group, poses)
        if wanted is None:
            continue
        off = np.array(
            [
                rotation_angle(poses[i][:3, :3].T @ r) > ALIKE
                for i, r in zip(group.photos, wanted, strict=True)
            ]
        )
        if not off.any():
            continue
        lost = group.photos[off]
        some = [crops[i] for i in lost]
        start = poses[lost].copy()
        for k, r in enumerate(wanted[off]):
            start[k] = similarity(r, r @ poses[lost[k]][:3, :3].T @ poses[lost[k]][:3, 3])
        other, height = refine(
            some, start, render, rings=crop_rings(some, PARTS), steps=COARSE, parts=PARTS
        )
        better = height > scores[lost] - LOSS
        poses[lost[better]], scores[lost[better]] = other[better], height[better]
    return poses, scores


def consensus(group: Group, poses: np.ndarray) -> np.ndarray | None:
    """Rotations (n, 3, 3) of the group's photos where most of them want it, or None where they do
    not agree: each photo's present rotation says how the group's frame is turned; the turn with the
    most others near it counts."""
    turns = np.array(
        [poses[i][:3, :3] @ p[:3, :3].T for i, p in zip(group.photos, group.poses, strict=True)]
    )
    close = np.array([[rotation_angle(a.T @ b) < ALIKE for b in turns] for a in turns])
    best = int(close.sum(1).argmax())
    if close[best].sum() < max(3, 0.5 * len(turns)):
        return None
    turn = nearest_rotation(turns[close[best]].sum(0))
    return turn @ group.poses[:, :3, :3]

"""The turns about the axis of the object that were guessed, as the photo shows them: shape,
material and light are known by then.

What is placed on its axis by its outline alone (fit/registration/instances/azimuth.py) is turned by
how much its picture looks like the others'. Under one
light they hardly do: gloss and shading stand still while the paint turns. Rendered, every turn
shows what it would look like, gloss and all; the one that differs least from the photo is taken.
The turn that an instance has was laid on its photo, while all others hang on an
axis that is a little off, so that edges come to lie a pixel aside: each picture is laid on the
photo before it is compared. Where what it shows looks nearly the same at several turns, the
materials' errors would choose: the turn it has stays then. Such an instance takes no part in shape
and paint, before and after.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np

from relit.conventions import srgb_from_linear
from relit.fit.registration.instances.azimuth import turned_by
from relit.fit.registration.instances.views import InstanceView, ViewId
from relit.fit.shape.picture_alignment import align_picture, moved_by
from relit.geometry.revolution_axis import Axis
from relit.reference.mitsuba_scene import Scene, render
from relit.reference.photographed import lit_scene
from relit.scene import Asset, Camera

TURNS, PLACES = (
    24,
    3,
    # about the axis; of these its own and the best ones that their neighbours do not beat are looked
    # into
)
# of what differs at its own turn that may differ elsewhere at most, or it stays: wrong turns were
# seen to leave .9 of it
CLEARLY = 0.8
HALVINGS = 2  # how often half the way to the next turn is tried on both sides
SCENES = TURNS + 2 * HALVINGS * PLACES  # that are rendered
SIDE, SAMPLES = (
    128,
    8,
)  # pixels of the pictures that are compared, longer side; rays a pixel of each of two pictures
SOLID = 0.98  # of a pixel that must be the instance's
# pixels beside those that are rendered: a picture is laid on its photo from a pixel or two away
AROUND = 8


def turned_as_shown(
    asset: Asset,
    views: list[InstanceView],
    cameras: list[Camera],
    poses: np.ndarray,
    axis: Axis,
    seed: int = 0,
    progress: Callable[[int], None] = lambda steps: None,
) -> np.ndarray:
    """The poses (V, 4, 4), object_from_world, each turned about the axis until the view, rendered,
    differs least from its photo.

    asset: with all instances; those of the views stand at `poses` in it. views: of instances that
    were turned by guess. cameras: theirs, in the world. axis: in the object's frame of the poses.
    progress: told how many of SCENES were rendered.
    """
    photos = [compared(v) for v in views]
    count = 0

    def differences(angles: np.ndarray) -> np.ndarray:
        nonlocal count
        turned = [turned_by(p, axis, a) for p, a in zip(poses, angles, strict=True)]
        moves = {v.id: np.linalg.inv(t) @ p for v, t, p in zip(views, turned, poses, strict=True)}
        scene = lit_scene(with_instances_moved(asset, moves))
        count += 1
        progress(count)
        return np.array(
            [difference(scene, c, *photo, seed) for c, photo in zip(cameras, photos, strict=True)]
        )

    grid = 2 * np.pi / TURNS * np.arange(TURNS)
    found = np.array([differences(np.full(len(views), a)) for a in grid])
    ends = []
    for place in places(found)[
        :PLACES
    ]:  # a window seen a little aslant can be worse than another one seen right
        angle, value, step = grid[place], np.take_along_axis(found, place[None], 0)[0], grid[1]
        for _ in range(HALVINGS):
            step, middle = step / 2, angle
            for side in (-step, step):
                tried = differences(middle + side)
                angle, value = (
                    np.where(tried < value, middle + side, angle),
                    np.minimum(tried, value),
                )
        ends.append((angle, value))
    angles, values = (np.array(each) for each in zip(*ends, strict=True))
    best = np.where(values.min(0) < CLEARLY * values[0], values.argmin(0), 0)
    return np.array(
        [
            turned_by(p, axis, a)
            for p, a in zip(poses, angles[best, np.arange(len(poses))], strict=True)
        ]
    )


def places(found: np.ndarray) -> np.ndarray:
    """(TURNS, V) numbers of the turns that are worth looking into, of differences (TURNS, V): first
    the best one within a step of the turn that a view has, then those that their neighbours do not
    beat, the best first, then the rest."""
    rank = np.where(
        (found <= np.roll(found, 1, 0)) & (found <= np.roll(found, -1, 0)), found, np.inf
    )
    near = np.array([0, 1, len(found) - 1])
    own = near[found[near].argmin(0)]
    rank[near] = np.inf
    rank[own, np.arange(found.shape[1])] = -np.inf
    return np.argsort(rank, axis=0, kind="stable")


def compared(view: InstanceView) -> tuple[np.ndarray, np.ndarray]:
    """A view's photo, shrunk to SIDE and as displays show it (h, w, 3), and which of its pixels are
    all the instance's (h, w) bool."""
    small = view.camera.within(SIDE)
    size = small.width, small.height
    photo = cv2.resize(view.rgb, size, interpolation=cv2.INTER_AREA)
    solid = (
        cv2.resize((view.mask * view.known).astype(np.float32), size, interpolation=cv2.INTER_AREA)
        > SOLID
    )
    return srgb_from_linear(np.clip(photo, 0, 1)), solid


def difference(
    scene: Scene, camera: Camera, photo: np.ndarray, solid: np.ndarray, seed: int
) -> float:
    """Mean squared difference of what a camera sees, laid on its photo, from that photo, see
    `compared`; 0 where nothing is seen whole. The
    product of what two pictures with samples of their own differ: the square of one would prefer
    what has less noise."""
    if not solid.any():
        return 0.0
    small, where = (
        camera.within(SIDE),
        cv2.dilate(solid.astype(np.uint8), np.ones((2 * AROUND + 1,) * 2, np.uint8)) > 0,
    )
    pictures = [
        srgb_from_linear(
            np.clip(
                render(scene, small, spp=SAMPLES, seed=2 * seed + k, where=where)[..., :3], 0, 1
            )
        )
        for k in (0, 1)
    ]
    at = align_picture(sum(pictures) / 2, photo, solid)
    one, other = ((moved_by(p, at) - photo)[solid] for p in pictures)
    return float((one * other).mean())


def with_instances_moved(asset: Asset, moves: dict[ViewId, np.ndarray]) -> Asset:
    """The asset with some instances moved by (4, 4) in the world."""
    stand = []
    for i in asset.instances:
        move = moves.get(ViewId(i.photo, i.label))
        pose = i.world_from_object if move is None else move @ i.world_from_object
        stand.append(replace(i, world_from_object=pose))
    return replace(asset, instances=tuple(stand))

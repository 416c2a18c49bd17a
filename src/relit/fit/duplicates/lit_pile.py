"""A pile as the surface pass sees it: what the photos show of each instance, and everything that
shadows it, in the scene frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from relit.conventions import similarity
from relit.fit.duplicates.options import DuplicatesOptions
from relit.fit.duplicates.placed_pile import PlacedPile
from relit.fit.duplicates.scene import (
    alone_bank,
    instance_meshes,
    photo_bank,
    pile_scene,
    spread_moves,
)
from relit.fit.passes.material_priors import SurfaceOptions
from relit.fit.passes.pixels import PixelBank
from relit.geometry.mesh import vertex_areas
from relit.rendering.transport import TraceableMesh
from relit.scene import Camera, Mesh

TOE = 0.05  # see `surface.parsimony`
# of `surface.light_prior`: light changes its tint less from place to place than its strength
TINT = 4.0


@dataclass(frozen=True)
class LitPile:
    """bank: pixels of the instances. traced: all instances and the ground. alone: no instance, and
    no ground, shadows another. instances: the meshes where they are. cameras: of the related photos.
    level: mean radiance of the object."""

    bank: PixelBank
    traced: TraceableMesh
    alone: bool
    instances: Mesh
    cameras: list[Camera]
    level: float


def pile_surface_options(o: DuplicatesOptions) -> SurfaceOptions:
    off = {"metallic_binary": 0.0, "metallic_sparse": 0.0} if "metal" in o.without else {}
    light = {"light_tint": TINT, "light_cells": True}
    return SurfaceOptions(
        o.surface_steps,
        o.points,
        o.directions,
        o.texture,
        o.light,
        scale_power=1.0,
        parsimony_toe=TOE,
        **light,
        **off,
    )


def lit_pile(
    shots, camera: Camera, pile: PlacedPile, max_pixels: int, *, alone: bool = False
) -> LitPile:
    """The pile in the scene frame: the world's axes, those of `camera`, the first photo's; the
    origin is the pile's middle. shots: (pixels, camera in its own frame) of each photo. alone: set
    all instances apart, so that nothing shadows them."""
    turn = camera.world_from_camera[:3, :3]
    standing = [np.linalg.inv(p) for p in pile.poses]
    middle = np.mean([s[:3, 3] for s in standing], 0)
    scene_from_photo = similarity(turn, -turn @ middle)
    scene = pile_scene(pile, scene_from_photo, shots[0][0], camera)
    numbers = [int(n) for n in np.flatnonzero(pile.related)]
    used = [shots[n][0] for n in numbers]
    cameras = [shots[n][1].with_pose(scene_from_photo @ pile.motions[n]) for n in numbers]
    shown = [pile.shown_in(n) for n in numbers]
    if alone:
        moves = spread_moves(standing, scene_from_photo)
        traced = TraceableMesh(*instance_meshes(pile, scene_from_photo, moves))
        bank = alone_bank(used, cameras, shown, moves, max_pixels)
    else:
        traced = scene.traceable()
        bank = photo_bank(used, cameras, [set(some) for some in shown], max_pixels)
    areas = vertex_areas(pile.mesh)
    level = float((pile.radiance.mean(0) * areas[:, None]).sum() / areas.sum() / 3)
    return LitPile(bank, traced, alone, scene.instances, cameras, level)

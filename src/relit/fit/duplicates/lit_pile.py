"""A pile as the surface pass sees it: what the photos show of each instance, and everything that
shadows it, in the scene frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from relit.conventions import similarity
from relit.fit.duplicates.options import DuplicatesOptions
from relit.fit.duplicates.scene import alone_bank, photo_bank, scene_mesh, spread_moves
from relit.fit.passes.material_priors import SurfaceOptions
from relit.fit.passes.pixels import PixelBank
from relit.fit.registration.instances.views import ANOTHER_PHOTO
from relit.geometry.mesh import vertex_areas
from relit.rendering.transport import TraceableMesh
from relit.scene import Camera, Mesh

TOE = 0.05  # see `surface.parsimony`
# of `surface.light_prior`: light changes its tint less from place to place than its strength
TINT = 4.0


@dataclass(frozen=True)
class LitPile:
    """bank: pixels of the instances. traced: all instances and the ground. alone: no instance, and
    no ground, shadows another. pile: the mesh as it stands. cameras: of the related photos. level:
    mean radiance of the object."""

    bank: PixelBank
    traced: TraceableMesh
    alone: bool
    pile: Mesh
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
    shots, camera: Camera, mesh: Mesh, parts, max_pixels: int, *, alone: bool = False
) -> LitPile:
    """The pile of the first photo's world, whose axes are those of `camera`, the first photo's; the
    origin is the pile's middle. shots: (pixels, camera in its own frame) of each photo. mesh: of
    the object. parts: see `fit.duplicates.shape.shape_stages`. alone: stand all instances apart, so
    that nothing shadows them."""
    pixels = shots[0][0]
    turn = camera.world_from_camera[:3, :3]
    standing = [np.linalg.inv(p) for p in parts["poses"]]
    middle = np.mean([s[:3, 3] for s in standing], 0)
    scene_from_photo = similarity(turn, -turn @ middle)
    pile, radiance = scene_mesh(mesh, parts, standing, scene_from_photo, pixels, camera)
    numbers = np.flatnonzero(parts["related"])
    used, cameras = (
        [shots[n][0] for n in numbers],
        [shots[n][1].with_pose(scene_from_photo @ parts["motions"][n]) for n in numbers],
    )
    keys = parts["view_keys"]
    told = ~np.isin(
        keys, parts.get("vague", ())
    )  # what is turned by guess shows nothing at its place
    shown = [(keys // ANOTHER_PHOTO == n) & told for n in numbers]
    labels = [(keys[own] % ANOTHER_PHOTO).tolist() for own in shown]
    whole = pile
    if alone:
        moves = spread_moves(standing, scene_from_photo)
        whole, radiance = scene_mesh(mesh, parts, standing, scene_from_photo, pixels, camera, moves)
        instances = [parts["view_instances"][own].tolist() for own in shown]
        placed = [
            dict(zip(some, of, strict=True)) for some, of in zip(labels, instances, strict=True)
        ]
        bank = alone_bank(used, cameras, placed, moves, max_pixels)
    else:
        bank = photo_bank(used, cameras, [set(some) for some in labels], max_pixels)
    areas = vertex_areas(mesh)
    level = float((parts["radiance"].mean(0) * areas[:, None]).sum() / areas.sum() / 3)
    return LitPile(bank, TraceableMesh(whole, radiance), alone, pile, cameras, level)

"""Coarse models of some instances, to register others against; where these tell a plane of
symmetry, each of them counts twice."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from relit.fit.registration.instances.mirror_plane import Flipped, Plane, find_plane
from relit.fit.registration.instances.options import Growth
from relit.fit.registration.instances.views import InstanceView, albedo_render, fit_model, taut_body
from relit.fit.registration.register import Gallery, Render, make_gallery
from relit.scene import Camera


@dataclass(frozen=True)
class CoarseBody:
    """render: of the model. gallery: its renderings. poses: (N, 4, 4) of the instances, with the
    corrections of the fit. plane: of symmetry, or None."""

    render: Render
    gallery: Gallery
    poses: np.ndarray
    plane: Plane | None


def body_of(
    views: list[InstanceView],
    poses: np.ndarray,
    cameras: list[Camera],
    parts,
    o: Growth,
    *,
    steps: int,
    seed: int,
    pictures: Flipped | None = None,
    plane: Plane | None = None,
) -> CoarseBody:
    """A model of `views` at `poses`, rendered for `cameras`; pictures: the views, flipped, for the
    plane to be sought. plane: the one of before (see `find_plane`), or, without pictures, the one
    that holds. Raises NoShape where the silhouettes have nothing in common."""
    if pictures is None:
        return fit_body(views, poses, cameras, parts, o, steps, seed, plane)
    body = fit_body(views, poses, cameras, parts, o, steps, seed, None)
    found = find_plane(views, pictures, body.poses, body.gallery, body.render, parts, last=plane)
    return body if found is None else fit_body(views, poses, cameras, parts, o, steps, seed, found)


def fit_body(
    views: list[InstanceView],
    poses: np.ndarray,
    cameras: list[Camera],
    parts,
    o: Growth,
    steps: int,
    seed: int,
    plane: Plane | None,
) -> CoarseBody:
    """`body_of` with what is known of the plane. A photo of an object that is its own mirror image
    is as well the photo that a mirrored
    camera takes of it: such cameras stand beside the others, and since the light stands with the
    camera, it is mirrored too."""
    count = len(views)
    if plane is not None:
        views, poses = [*views, *views], np.concatenate([poses, plane.mirror @ poses])
    values = taut_body(views, poses, o.nodes, o.tolerance, o.depth, crossed=count > 3)
    o.effort.spend(steps)
    model, moved = fit_model(
        views, poses, values, steps, refine_cameras=o.rate, rays=o.rays, seed=seed
    )
    render = albedo_render(model)
    return CoarseBody(render, make_gallery(render, cameras, parts), moved[:count], plane)

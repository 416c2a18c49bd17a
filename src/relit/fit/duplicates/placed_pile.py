"""The object of a pile and where its instances are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from relit.fit.duplicates.photo_motions import SharedScene, motion_or_none
from relit.fit.registration.instances.views import InstanceView, ViewId
from relit.scene import Mesh


@dataclass(frozen=True)
class PlacedPile:
    """The object and its K instances, as N views in P photos show them.

    mesh: of the object. radiance: (K, V, 3) of its vertices on each instance, linear. poses: (K, 4,
    4) object_from_first_photo. ids: of the instances: the first view of each. views: of the
    instances in all related photos. view_instances: (N,) which instance each view shows. motions:
    (P, 4, 4) first_from_photo. related: (P,) bool, photos whose motion is known. base: (V, 3) base
    colour of the vertices up to scale, or None. plane: (2, 3) point and unit normal of the ground in
    the first photo's frame, or None. guessed: instances whose turn about the object's axis is a
    guess.
    """

    mesh: Mesh
    radiance: np.ndarray
    poses: np.ndarray
    ids: tuple[ViewId, ...]
    views: tuple[ViewId, ...]
    view_instances: np.ndarray
    motions: np.ndarray
    related: np.ndarray
    base: np.ndarray | None = None
    plane: np.ndarray | None = None
    guessed: tuple[ViewId, ...] = ()

    def shown_in(self, photo: int) -> dict[int, int]:
        """{label: instance} of the views of a photo, those with a guessed turn left out: they show
        nothing at its place."""
        return {
            view.label: int(k)
            for view, k in zip(self.views, self.view_instances, strict=True)
            if view.photo == photo and view not in self.guessed
        }

    @property
    def with_known_turn(self) -> np.ndarray:
        """(K,) bool: instances that a view shows whose turn is no guess."""
        known = [
            k
            for view, k in zip(self.views, self.view_instances, strict=True)
            if view not in self.guessed
        ]
        return np.isin(np.arange(len(self.poses)), known)


def placed_pile(
    mesh: Mesh, views: list[InstanceView], scene: SharedScene, radiance: list[np.ndarray]
) -> PlacedPile:
    """Which instances are where, and which views show them. radiance: (V, 3) of the mesh's vertices
    in each view."""
    shown = [np.flatnonzero(scene.of_view == n) for n in range(len(scene.standing))]
    return PlacedPile(
        mesh=mesh,
        radiance=np.stack([np.mean([radiance[k] for k in some], 0) for some in shown]),
        poses=np.linalg.inv(scene.standing),
        ids=tuple(views[some[0]].id for some in shown),
        views=tuple(v.id for v, n in zip(views, scene.of_view, strict=True) if n >= 0),
        view_instances=scene.of_view[scene.of_view >= 0],
        motions=np.array([motion_or_none(m) for m in scene.motions]),
        related=np.array([m is not None for m in scene.motions]),
    )

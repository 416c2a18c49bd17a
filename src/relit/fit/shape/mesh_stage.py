"""From distances to a textured mesh: outlines, atlas, and what lies on each texel."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from relit.errors import EXIT_FAILED, UserError
from relit.fit.passes.load_photos import UnitPhotos
from relit.fit.shape.inpaint import painted_over
from relit.fit.shape.odd_photos import check_overlaps, mask_overlaps, note_of_odd_photos
from relit.fit.shape.outlines import follow_outlines
from relit.geometry.atlas import unwrap
from relit.geometry.bake import fill_gutters, interpolate, rasterise_atlas
from relit.geometry.hull import NoShape, visual_hull
from relit.materials.field import MaterialField, normal_map, pictures
from relit.run import Run
from relit.scene import Camera, Mesh


def hull_of_masks(photos: UnitPhotos, nodes: int, else_give: str) -> np.ndarray:
    """Distances (nodes, nodes, nodes) of the visual hull. else_give: what to give where there is
    none, for the message. Raises UserError where the masks have no point of space in common."""
    try:
        return visual_hull(photos.cameras, photos.masks, nodes)
    except NoShape:
        raise UserError(
            "the masks and the cameras do not agree: no point of space lies inside the masks of nearly all photos",
            "wrong cameras, a wrong camera convention, inverted masks, or an object sphere that misses the object",
            f"look at `relit inspect INPUT`; give {else_give}",
            code=EXIT_FAILED,
        ) from None


def outlined_mesh(
    mesh: Mesh,
    photos: UnitPhotos,
    cameras: Sequence[Camera],
    rounds: int,
    run: Run,
) -> Mesh:
    """The mesh after `rounds` rounds in which its outlines follow the masks. cameras: those of the
    photos, as the mesh has them. Photos whose masks it does not fill are named; raises UserError
    where it fills hardly any."""
    mesh = follow_outlines(mesh, cameras, photos.masks, rounds)
    overlaps = mask_overlaps(mesh, cameras, photos.masks)
    check_overlaps(overlaps, run)
    if note := note_of_odd_photos(overlaps, photos.names):
        run.say(note)
    return mesh


def with_atlas(mesh: Mesh, size: int, say: Callable[[str], None]) -> Mesh:
    """The mesh with texture coordinates, for textures of `size` texels a side."""
    mesh, how = unwrap(mesh, size)
    if how != "xatlas":
        say(
            "note: the mesh was too difficult for charts; its atlas has one cell for every two faces"
        )
    return mesh


@dataclass(frozen=True)
class TexelMap:
    """Where the texels of an atlas lie on its mesh. face: (S, S) int32, -1 where there is none.
    bary: (S, S, 3) float32 barycentric coordinates."""

    mesh: Mesh
    face: np.ndarray
    bary: np.ndarray

    @property
    def known(self) -> np.ndarray:
        """(S, S) bool: texels that lie on a face."""
        return self.face >= 0

    def on_faces(self, values: np.ndarray) -> np.ndarray:
        """(S, S, C) of vertex values (V, C); 0 where there is no face."""
        return interpolate(values, self.mesh.faces, self.face, self.bary)

    def spread(self, values: np.ndarray) -> np.ndarray:
        """(S, S, C) of vertex values (V, C), gutters filled."""
        return self.filled(self.on_faces(values))

    def filled(self, texture: np.ndarray) -> np.ndarray:
        """The texture with its gutters filled."""
        return fill_gutters(texture, self.known)

    def material_maps(self, material: MaterialField, seen: np.ndarray) -> dict[str, np.ndarray]:
        """base_color, roughness, metallic and normal (tangent space) of a fitted material, gutters
        filled. What lies on faces that are not `seen` (F,) continues what lies on those that
        are; the normals stay."""
        names = ("base_color", "roughness", "metallic")
        paint = {
            name: self.filled(texture)
            for name, texture in zip(names, pictures(material), strict=True)
        }
        painted = painted_over(self.mesh, seen, paint, self.face, self.bary)
        return {**painted, "normal": normal_map(material)}


def texels_of(mesh: Mesh, size: int) -> TexelMap:
    """The texels of an atlas of `size` texels a side."""
    return TexelMap(mesh, *rasterise_atlas(mesh, size))

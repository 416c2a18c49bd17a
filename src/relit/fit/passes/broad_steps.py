"""Steps of the base colour over whole stretches of surface.

A texel is looked at now and then only, so steps of single texels take away slowly what lies over
many of them: the shade that the first colours hold, in hollows and on undersides. By then the
lights have learnt to explain it. Here a stretch's colour is multiplied by what its pixels showed
over what was predicted for them, both added up over many steps (the closed solution for a factor a
stretch and channel).
"""

from __future__ import annotations

import drjit as dr
import numpy as np
from scipy.sparse import coo_matrix, diags, identity

from relit.geometry.bake import fill_gutters, interpolate, rasterise_atlas
from relit.geometry.tangents import edges
from relit.scene import Mesh

RINGS = 4  # of vertices around each one that share a factor
MOST = 1.4  # a factor at once, up or down
FEW = 0.002  # of what is predicted, added to both sides: dark and rarely seen places stay


class BroadSteps:
    """Sums over the vertices of a mesh, and the factors that follow."""

    def __init__(self, mesh: Mesh, size: int):
        """size: texels a side."""
        self.mesh, self.size = mesh, size
        self.face, self.bary = rasterise_atlas(mesh, size)
        self.known = self.face >= 0
        _, self.place = np.unique(
            mesh.vertices, axis=0, return_inverse=True
        )  # seams double vertices
        self.place = self.place.ravel()
        count = int(self.place.max()) + 1
        corner = np.take_along_axis(
            mesh.faces[np.maximum(self.face, 0)], self.bary.argmax(-1)[..., None], -1
        )[..., 0]
        self.nearest = np.where(self.known, self.place[corner], 0)
        sides = self.place[edges(mesh.faces)]
        sides = np.concatenate([sides, sides[:, ::-1]])
        near = coo_matrix((np.ones(len(sides)), (sides[:, 0], sides[:, 1])), (count, count)).tocsr()
        near.data[:] = 1
        near = near + identity(count)
        self.pool = diags(1 / np.asarray(near.sum(1)).ravel()) @ near
        self.clear()

    def clear(self) -> None:
        """Forget what was added up."""
        self.shown, self.predicted = np.zeros((2, self.pool.shape[0], 3))

    def add(self, uv, weight, a, b, target) -> None:
        """uv: Point2f of pixels. weight: Color3f, 0 where nothing counts. a, b: Color3f,
        independent estimates of the radiance. target: Color3f."""
        uv, weight, a, b, target = (np.array(dr.detach(v)).T for v in (uv, weight, a, b, target))
        x, y = np.clip((uv * self.size).astype(int), 0, self.size - 1).T
        at, heard = self.nearest[y, x], weight * self.known[y, x, None]
        for c in range(3):
            self.shown[:, c] += np.bincount(
                at, heard[:, c] * target[:, c] * (a[:, c] + b[:, c]) / 2, len(self.shown)
            )
            self.predicted[:, c] += np.bincount(
                at, heard[:, c] * a[:, c] * b[:, c], len(self.shown)
            )

    def factors(self) -> np.ndarray:
        """(S, S, 4) float32, what base colour and roughness (1) of each texel are to be multiplied
        by; forgets the sums."""
        shown, predicted = self.shown, self.predicted
        for _ in range(RINGS):
            shown, predicted = self.pool @ shown, self.pool @ predicted
        few = FEW * predicted.mean(0) + 1e-12
        factor = np.clip((shown + few) / np.maximum(predicted + few, 1e-12), 1 / MOST, MOST)
        self.clear()
        textures = fill_gutters(
            interpolate(factor[self.place], self.mesh.faces, self.face, self.bary), self.known
        )
        return np.concatenate([textures, np.ones_like(textures[..., :1])], -1)

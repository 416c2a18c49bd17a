"""Paint of what no photo shows: a guess from what is next to it.

A texel that no photo looks at keeps whatever its start and the priors make of it, often a colour
that is nowhere on the object. Here
it takes the harmonic function over the surface that continues what is seen: the smoothest one,
which invents no colour.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix, diags, identity

from relit.fit.shape.sparse import solved_symmetric
from relit.geometry.bake import fill_gutters, interpolate
from relit.geometry.tangents import edges
from relit.scene import Mesh

# steps of diffusion among vertices that are seen: at the rim a texel is told by few grazing rays,
# and is often noise
RINGS = 20
LEAK = 1e-6  # pull to the mean of what is seen: parts that hang on nothing seen take it


def painted_over(
    mesh: Mesh,
    seen: np.ndarray,
    textures: dict[str, np.ndarray],
    face: np.ndarray,
    bary: np.ndarray,
):
    """The textures, {name: (S, S) or (S, S, C)}, with the texels of faces that are not seen
    continued from those that are; as they are where all or nothing is seen. seen: (F,) bool. face,
    bary: of `geometry.bake.rasterise_atlas`."""
    if seen.all() or not seen.any():
        return textures
    names, sizes = list(textures), [t[0, 0].size for t in textures.values()]
    together = np.concatenate([t.reshape(*t.shape[:2], -1) for t in textures.values()], -1).astype(
        np.float64
    )
    known = face >= 0
    unseen = known & ~seen[np.maximum(face, 0)]
    shown = fill_gutters(
        together, known & ~unseen
    )  # a corner of a seen face may lie on a texel of one that is not
    guessed = interpolate(continued(mesh, seen, shown), mesh.faces, face, bary)
    out = fill_gutters(np.where(unseen[..., None], guessed, together).astype(np.float32), known)
    parts = np.split(out, np.cumsum(sizes)[:-1], -1)
    return {
        n: p.reshape(textures[n].shape).astype(textures[n].dtype)
        for n, p in zip(names, parts, strict=True)
    }


def continued(mesh: Mesh, seen: np.ndarray, texture: np.ndarray) -> np.ndarray:
    """(V, C) texture at the vertices: looked up where a seen face meets, and smoothed there;
    harmonic elsewhere. seen: (F,) bool; texture: (S, S, C)."""
    _, place = np.unique(mesh.vertices, axis=0, return_inverse=True)  # seams double vertices
    place, size = place.ravel(), texture.shape[0]
    count = int(place.max()) + 1
    corners = mesh.faces[seen].ravel()
    x, y = np.clip((mesh.uvs[corners] * size).astype(int), 0, size - 1).T
    at, weight = place[corners], np.bincount(place[corners], minlength=count)
    values = np.stack(
        [np.bincount(at, texture[y, x, c], count) for c in range(texture.shape[-1])], -1
    )
    values /= np.maximum(weight, 1)[:, None]
    free = weight == 0
    if free.any():
        sides = place[edges(mesh.faces)]
        sides = np.concatenate([sides, sides[:, ::-1]])
        near = coo_matrix((np.ones(len(sides)), (sides[:, 0], sides[:, 1])), (count, count)).tocsr()
        near.data[:] = 1
        values[~free] = diffused(values[~free], near[~free][:, ~free])
        laplacian = (diags(np.asarray(near.sum(1)).ravel()) - near + LEAK * identity(count)).tocsr()
        mean = values[~free].mean(0)
        right = LEAK * mean - laplacian[free][:, ~free] @ values[~free]
        values[free] = solved_symmetric(laplacian[free][:, free], right)
    return values[place]


def diffused(values: np.ndarray, near) -> np.ndarray:
    """Values (V, C) after RINGS steps towards the mean of the neighbours. near: (V, V), 1 for
    neighbours, sparse."""
    degree = np.asarray(near.sum(1)).reshape(-1, 1)
    for _ in range(RINGS):
        values = 0.5 * (
            values + np.where(degree > 0, near @ values / np.maximum(degree, 1), values)
        )
    return values

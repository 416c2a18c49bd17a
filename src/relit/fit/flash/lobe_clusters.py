"""Which places of a surface are alike, and how they share what highlights tell of them (PIR Sec.
3.5, without a network).

A highlight tells of few texels at a time, and only where the flash happens to be mirrored. Texels
belong, by the similarity of their features, to a few groups with one specular albedo and one alpha
each; a texel has its own deviation from that besides, which fades where nothing supports it. The
groups gather the evidence of all their texels: what is seen here holds for like places everywhere.

A broad strong lobe over a dark base looks much like a narrow weak one over a brighter base but for
its very peak, and steps along gradients stop in between, the diffuse albedo of every texel having
settled on what the wrong lobe leaves over. So the groups' numbers are searched
for: for each width of the lobe on a ladder, the specular albedo and a factor and a grey shift of
the diffuse albedo are a linear least-squares problem; the width with the least error is taken. The
diffuse albedo is here the one that the capture tells before
any fit: the noise of a texture in the middle of its fit would weaken its column, and a broad lobe
would take its place.

A group that no photo shows near the mirror direction, such as an underside, has no say, not even
over itself: what a lobe changes there is how the diffuse light falls off towards grazing angles,
and errors of the shape change that more. It takes what the likest groups know.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from relit.materials.field import nearest_texel
from relit.materials.plastic_field import PlasticField
from relit.materials.rough_plastic import Plastic

NEAREST = 4  # groups of a texel
LADDER = np.geomspace(0.04, 0.75, 18)  # widths alpha that are tried
# lobe of a specular albedo of 1, diffuse light as it is, diffuse light of an albedo of 1, photo
COLUMNS = 4
FORGET = 0.8  # of the running sums per call
SEEN = (
    0.008,
    0.02,
    # strength of a narrow lobe over a white base, root mean square, where a group's evidence begins and
    # is whole
)
NARROW = 6  # rung of the ladder, alpha .11, that this is asked of
SCALES = (
    0.16,
    0.08,
    0.04,
    0.02,
    0.01,
)  # distances of features over which evidence is shared, from broad to narrow
LENT = (
    0.02,
    1.0,
    8.0,
    8.0,
)  # information about the lobe that each but the narrowest lends to the next at most
UNSEEN_OWN = (
    0.8  # part of what a texel has to itself that is kept per step where no highlight is seen
)
LEAST = 1e-4  # evidence below this part of the mean group's tells nothing
PRIOR = (
    1e-4,
    1e-5,
    1e-5,
    # belief in no change of specular albedo, factor and shift, against the evidence of the mean group
)


@dataclass
class Kinship:
    """groups: their number. index: UInt32 [texels * NEAREST]. weight: Float [texels * NEAREST],
    summing to 1 for each texel. level: Float [groups * 2], specular albedo and alpha of each group.
    apart: (groups, groups), squared distances of their features.
    trust: (groups,), how far a group's own evidence counts, 0 to 1.
    sums: (LADDER, groups, COLUMNS, COLUMNS), running weighted sums of products of
    `share_evidence`'s columns."""

    groups: int
    index: Any
    weight: Any
    level: Any
    apart: np.ndarray
    sums: np.ndarray
    trust: np.ndarray

    def spread(self, values, channels: int = 2):
        """Float [groups * channels] -> Float [texels * channels]."""
        k = dr.arange(mi.UInt32, dr.width(self.weight) // NEAREST * channels)
        texel, channel = k // channels, k % channels
        out = mi.Float(0)
        for j in range(NEAREST):
            at = texel * NEAREST + j
            group = dr.gather(mi.UInt32, self.index, at)
            out = dr.fma(
                dr.gather(mi.Float, self.weight, at),
                dr.gather(mi.Float, values, group * channels + channel),
                out,
            )
        return out

    def own(self, usual: float):
        """Float [texels * 2]: part of what a texel has to itself that is kept per step; `usual`
        where highlights are seen."""
        per_group = UNSEEN_OWN + (usual - UNSEEN_OWN) * self.trust
        return self.spread(mi.Float(np.repeat(per_group, 2).astype(np.float32)))

    def take_up(self, level: np.ndarray, sums: np.ndarray) -> None:
        """Go on from what a checkpoint kept, (groups * 2,) and as `sums`."""
        self.level, self.sums = mi.Float(level), sums
        if sums.any():
            self.trust = highlights_seen(sums)


def start_kinship(
    features: np.ndarray,
    known: np.ndarray,
    lobe: np.ndarray,
    groups: int = 160,
    width: float = 0.08,
) -> Kinship:
    """Groups by k-means. features: (S, S, C), distances of about `width` are alike. known: (S, S)
    bool. lobe: (S, S, 2) start of specular albedo and alpha."""
    from scipy.cluster.vq import kmeans2
    from scipy.spatial import cKDTree

    flat = features.reshape(-1, features.shape[-1]).astype(np.float64)
    rng = np.random.default_rng(5)
    some = flat[known.ravel()]
    some = some[rng.integers(0, len(some), 20_000)] + rng.normal(0, 1e-4, (20_000, flat.shape[1]))
    centres, _ = kmeans2(some, groups, iter=20, minit="++", rng=rng)
    distance, index = cKDTree(centres).query(flat, NEAREST)
    weight = np.exp((distance[:, :1] ** 2 - distance**2) / (2 * width**2))
    weight /= weight.sum(1, keepdims=True)
    level = np.tile(np.median(lobe[known], axis=0), (groups, 1))
    apart = np.square(centres[:, None] - centres[None]).sum(-1)
    numbers = lambda a: mi.Float(np.ascontiguousarray(a, np.float32).ravel())  # noqa: E731
    return Kinship(
        groups,
        mi.UInt32(index.astype(np.uint32).ravel()),
        numbers(weight),
        numbers(level),
        apart,
        np.zeros((len(LADDER), groups, COLUMNS, COLUMNS)),
        np.ones(groups),
    )


def share_evidence(
    kin: Kinship,
    field: PlasticField,
    uv,
    plastic: Plastic,
    shade: Callable,
    photo,
    weight,
    rate: float,
) -> None:
    """Move all groups by `rate` of the way to their best numbers, in the levels and in the texture.

    plastic: at the points, its diffuse albedo as the capture tells it. shade: Plastic -> radiance
    (Color3f) at the points, linear in the albedos. photo: Color3f, what direct light should show.
    weight: Color3f of squared differences.
    """
    group = dr.gather(mi.UInt32, kin.index, nearest_texel(field, uv) * NEAREST)  # the nearest
    one = mi.Float(1)
    now = np.zeros_like(kin.sums)
    for k, alpha in enumerate(LADDER):
        width = dr.opaque(mi.Float, float(alpha))
        columns = [
            shade(Plastic(mi.Color3f(0), one, width)),
            shade(Plastic(plastic.diffuse, mi.Float(0), width)),
        ]
        columns += [shade(Plastic(mi.Color3f(1), mi.Float(0), width)), photo]
        totals = {}
        for i in range(COLUMNS):
            for j in range(i, COLUMNS):
                value = dr.sum(columns[i] * columns[j] * weight)
                totals[i, j] = dr.zeros(mi.Float, kin.groups)
                dr.scatter_reduce(
                    dr.ReduceOp.Add, totals[i, j], dr.select(dr.isfinite(value), value, 0), group
                )
        dr.eval(totals)
        for (i, j), total in totals.items():
            now[k, :, i, j] = now[k, :, j, i] = np.array(total)
    keep = FORGET if kin.sums.any() else 0.0
    kin.sums = keep * kin.sums + (1 - keep) * now
    level = np.array(kin.level).reshape(-1, 2)
    kin.trust = highlights_seen(kin.sums)
    best = best_lobes(pooled(kin), level)
    change = mi.Float((rate * (best[:, :2] - level)).astype(np.float32).ravel())
    kin.level = kin.level + change
    field.lobe = field.lobe + kin.spread(change)
    dr.eval(kin.level, field.lobe)


def highlights_seen(sums: np.ndarray) -> np.ndarray:
    """(groups,) 0 to 1: how far the photos look at each group near the mirror direction, where its
    lobe would show."""
    lobe, white = sums[NARROW, :, 0, 0], sums[NARROW, :, 2, 2]
    strength = np.sqrt(lobe / np.maximum(white, 1e-12))
    return np.clip((strength - SEEN[0]) / (SEEN[1] - SEEN[0]), 0, 1) * (white > 0)


def pooled(kin: Kinship) -> np.ndarray:
    """(LADDER, groups, COLUMNS, COLUMNS): what each group's lobe is judged by, the trusted evidence
    of groups of like features, from the broadest scale to the narrowest. What a scale tells is lent
    to the next as far as LENT: a group that knows enough by itself, or from its very likest, does
    not ask others; one that no photo shows near the mirror direction takes what the likest know."""
    weight = [np.exp(-kin.apart / (2 * scale**2)) * kin.trust for scale in SCALES]
    weight[0] /= np.maximum(weight[0].max(1, keepdims=True), 1e-9)
    total = np.einsum("gh,lhij->lgij", weight[0], kin.sums)
    amount = evidence_in(total)
    for narrower, most in zip(weight[1:], LENT, strict=True):
        lent = np.minimum(1, most / np.maximum(information(total), 1e-12))
        total = np.einsum("gh,lhij->lgij", narrower, kin.sums) + lent[:, None, None] * total
    return (
        total * np.maximum(amount / np.maximum(evidence_in(total), 1e-12), 1)[:, None, None]
    )  # lent or own, as much to believe


def evidence_in(sums: np.ndarray) -> np.ndarray:
    """(groups,): how much there is."""
    return np.einsum("lgii->g", sums[..., :3, :3])


def information(sums: np.ndarray) -> np.ndarray:
    """(groups,): of the evidence about the specular albedo, the diffuse albedo being free (Schur
    complement), for a narrow lobe."""
    lobe, base = sums[NARROW, :, 0, 0], sums[NARROW, :, 1:3, 1:3]
    mixed = sums[NARROW, :, 0, 1:3]
    ridge = (1e-6 * np.trace(base, axis1=1, axis2=2) + 1e-12)[:, None, None] * np.eye(2)
    return lobe - np.einsum(
        "gi,gi->g", mixed, np.linalg.solve(base + ridge, mixed[..., None])[..., 0]
    )


def best_lobes(sums: np.ndarray, level: np.ndarray) -> np.ndarray:
    """From the sums the best specular albedo, alpha, factor and shift of the diffuse albedo:
    (groups, 4).

    level: (groups, 2), what holds where a group has no evidence.
    """
    normal, right, photo = sums[..., :3, :3], sums[..., :3, 3], sums[..., 3, 3]
    belief = (
        np.array(PRIOR) * np.einsum("lgii->i", normal) / (sums.shape[0] * sums.shape[1]) + 1e-12
    )
    prior = np.stack([level[:, 0], np.ones(len(level)), np.zeros(len(level))], 1)  # (groups, 3)
    normal = normal + np.diag(belief)
    right = right + belief * prior
    found = np.linalg.solve(normal, right[..., None])[..., 0]  # (LADDER, groups, 3)
    found[..., 0] = np.maximum(found[..., 0], 0.01)
    error = (
        photo - 2 * (found * right).sum(-1) + np.einsum("lgi,lgij,lgj->lg", found, normal, found)
    )
    k = np.clip(error.argmin(0), 1, len(LADDER) - 2)
    g = np.arange(len(level))
    a, b, c = error[k - 1, g], error[k, g], error[k + 1, g]
    t = np.clip(0.5 * (a - c) / np.maximum(a - 2 * b + c, 1e-12), -1, 1)[
        :, None
    ]  # the parabola through three rungs of log alpha
    blend = np.where(
        t < 0,
        (1 + t) * found[k, g] - t * found[k - 1, g],
        (1 - t) * found[k, g] + t * found[k + 1, g],
    )
    alpha = LADDER[k] * (LADDER[1] / LADDER[0]) ** t[:, 0]
    evidence = evidence_in(sums)
    known = evidence > LEAST * evidence.mean()
    out = np.stack(
        [
            np.clip(blend[:, 0], 0, 2),
            alpha,
            np.clip(blend[:, 1], 0.7, 1.4),
            np.clip(blend[:, 2], -0.1, 0.1),
        ],
        1,
    )
    return np.where(known[:, None], out, np.stack([*level.T, prior[:, 1], prior[:, 2]], 1))

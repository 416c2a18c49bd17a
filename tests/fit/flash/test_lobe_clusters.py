"""What groups of like places learn from each other: as much as they do not know by themselves."""

import numpy as np
import pytest

from relit.fit.flash.lobe_clusters import COLUMNS, LADDER, Kinship, best_lobes, pooled


def evidence(
    specular: float, alpha: float, amount: float, highlights: bool = True, seed: int = 0
) -> np.ndarray:
    """(LADDER, COLUMNS, COLUMNS): sums of `amount` times 20 pixels of a place with a lobe over a
    base of .5."""
    rng = np.random.default_rng(seed)
    tangent = rng.uniform(0 if highlights else 0.6, 0.8, 400)
    lobe = lambda a: 0.01 / (a**2 * (1 + (tangent / a) ** 2) ** 2)  # noqa: E731
    white = 1 - 0.4 * tangent
    told = white * rng.uniform(0.45, 0.55, 400)
    photo = specular * lobe(alpha) + told + rng.normal(0, 1e-3, 400)
    columns = [np.stack([lobe(a), told, white, photo]) for a in LADDER]
    return 0.05 * amount * np.stack([c @ c.T for c in columns])


def kin_of(places: np.ndarray, sums: list[np.ndarray], trust: list[float]) -> Kinship:
    apart = np.square(places[:, None] - places[None]).astype(float)
    return Kinship(len(places), None, None, None, apart, np.stack(sums, 1), np.array(trust, float))


def settled(kin: Kinship) -> np.ndarray:
    """(groups, 2) specular albedo and alpha after as many calls as a pass makes at least, each from
    what the last one found."""
    level = np.tile([0.7, 0.2], (kin.groups, 1))
    for _ in range(40):
        level = level + 0.5 * (best_lobes(pooled(kin), level)[:, :2] - level)
    return level


def test_a_group_that_knows_is_not_overruled_by_a_likeness_with_more_pixels():
    kin = kin_of(
        np.array([0.0, 0.16]),
        [evidence(1.0, 0.12, 10.0), evidence(0.5, 0.22, 300.0, seed=1)],
        [1, 1],
    )
    small, large = settled(kin)
    assert small[0] == pytest.approx(1.0, rel=0.15) and small[1] == pytest.approx(0.12, rel=0.15)
    assert large[0] == pytest.approx(0.5, rel=0.05) and large[1] == pytest.approx(0.22, rel=0.05)


def test_a_group_that_knows_little_takes_what_its_likes_know():
    faint = evidence(2.0, 0.7, 1e-6, seed=2)  # its own few pixels tell something else
    kin = kin_of(
        np.array([0.0, 0.04, 0.8]),
        [faint, evidence(0.5, 0.22, 1.0), evidence(1.2, 0.1, 5.0, seed=3)],
        [1, 1, 1],
    )
    found = settled(kin)
    assert found[0, 0] == pytest.approx(0.5, rel=0.1) and found[0, 1] == pytest.approx(
        0.22, rel=0.1
    )


def test_a_group_without_highlights_has_no_say_over_itself():
    shaded = evidence(1.8, 0.6, 50.0, highlights=False, seed=4)
    kin = kin_of(np.array([0.0, 0.3]), [shaded, evidence(0.5, 0.22, 1.0)], [0, 1])
    found = settled(kin)
    np.testing.assert_allclose(found[0], [0.5, 0.22], rtol=0.1)


def test_evidence_has_the_shape_of_the_sums():
    kin = kin_of(np.array([0.0, 0.1]), [evidence(1, 0.1, 1), evidence(0.5, 0.2, 1)], [1, 1])
    assert pooled(kin).shape == (len(LADDER), 2, COLUMNS, COLUMNS)

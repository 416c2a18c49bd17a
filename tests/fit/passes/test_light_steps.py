"""Steps of an environment map by cells of several widths."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from relit.conventions import environment_directions, environment_solid_angles
from relit.fit.passes.light_steps import SIDES, LightSteps
from relit.fit.passes.optimiser import Adam
from relit.lighting.environment import cells_of_texels

ROWS = 32
AREA = environment_solid_angles(ROWS, 2 * ROWS)


def flat(a):
    """Copied into Dr.Jit's own memory, see test_exchange.py."""
    return mi.Float(np.asarray(a, np.float32).ravel().tolist())


@pytest.mark.parametrize("rows, side", [(32, 1), (32, 2), (32, 4), (30, 4), (5, 4)])
def test_cells_cover_the_map_once_and_are_alike_in_size(rows, side):
    cell = cells_of_texels(rows, 2 * rows, side)
    assert cell.shape == (2 * rows * rows,) and set(cell) == set(range(cell.max() + 1))
    grid, area = cell.reshape(rows, -1), environment_solid_angles(rows, 2 * rows)
    size = np.bincount(cell, area.ravel())
    if rows % side == 0:
        assert size.max() < 4 * size.min()  # of texels: 20 to 40 times
        middle = grid[rows // 2 : rows // 2 + side, :side]
        assert (middle == middle[0, 0]).all() and (grid == middle[0, 0]).sum() == side * side
    for c in (grid[0, 0], cell.max(), grid[rows // 2, rows]):  # each hangs together
        y, x = np.nonzero(grid == c)
        assert np.ptp(y) < side and np.ptp(x) + 1 == len(set(x))


def walk(step, truth, noise: float, steps: int = 250, rate: float = 0.05):
    """Log radiance after steps along the gradients of Σ area (l - l*)², with noise as of a Monte
    Carlo estimate."""
    rng, light = np.random.default_rng(3), flat(np.zeros_like(truth))
    for i in range(steps):
        at = np.array(light).reshape(truth.shape)
        gradient = AREA[..., None] * (at - truth) + noise * np.sqrt(AREA)[..., None] * rng.normal(
            size=truth.shape
        )
        light = step(light, flat(gradient), rate * (1 - 0.95 * i / steps))
    return np.array(light).reshape(truth.shape)


def wrong(light, truth) -> float:
    return float(np.sqrt((AREA[..., None] * (light - truth) ** 2).sum() / (3 * AREA.sum())))


def test_noise_moves_less_and_lamps_are_found():
    """A dark room with one lamp, its pull much smaller than the noise of one step: nearer to the
    truth than Adam on the texels, all over and at the pole."""
    d = environment_directions(ROWS, 2 * ROWS)
    truth = np.full((ROWS, 2 * ROWS, 3), -1.0)
    truth[d @ np.array([0.6, 0.48, 0.64]) > np.cos(0.25)] = 2.5
    adam = Adam(truth.size)
    plain = walk(adam.step, truth, noise=1.0)
    ours = walk(LightSteps(ROWS).step, truth, noise=1.0)
    assert wrong(ours, truth) < 0.75 * wrong(plain, truth)
    assert np.abs(ours - truth)[:2].mean() < 0.6 * np.abs(plain - truth)[:2].mean()


def test_a_texel_can_move_alone():
    """Where there is no noise the map comes to any truth, texels that differ from their neighbours
    too."""
    truth = np.random.default_rng(1).normal(size=(ROWS, 2 * ROWS, 3))
    light = walk(LightSteps(ROWS).step, truth, noise=0.0, steps=600)
    assert np.abs(light - truth)[ROWS // 2 - 3 : ROWS // 2 + 3].mean() < 0.02


def test_a_step_compiles_nothing_new():
    moves = LightSteps(16)
    rng, light = np.random.default_rng(0), flat(np.zeros(16 * 32 * 3))

    def one(light):
        light = moves.step(light, flat(rng.normal(size=16 * 32 * 3)), 0.05 * rng.uniform())
        dr.eval(light)
        return light

    for _ in range(2):
        light = one(light)
    dr.kernel_history_clear()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        one(light)
        history = dr.kernel_history()
    assert any("cache_hit" in k for k in history) and all(
        k["cache_hit"] for k in history if "cache_hit" in k
    )
    assert set(moves.adam) == {f"light_{side}" for side in SIDES}

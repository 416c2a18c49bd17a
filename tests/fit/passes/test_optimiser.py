"""The optimiser against its NumPy twin, and the loop around it."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from relit.fit.passes.optimiser import Adam, cosine_decay, memory, recall, run_steps


class Twin:
    """Adam in float64 (Kingma & Ba 2015, Algorithm 1), epsilon outside the root; floor adds floor *
    mean(v) to every second moment."""

    def __init__(self, size, beta1=0.9, beta2=0.99, floor=0.0):
        self.m, self.v, self.t = np.zeros(size), np.zeros(size), 0
        self.b1, self.b2, self.floor = beta1, beta2, floor

    def step(self, x, g, rate, ratio=1.0):
        self.t += 1
        self.m = self.b1 * self.m + (1 - self.b1) * g
        self.v = self.b2 * self.v + (1 - self.b2) * g * g
        mhat = self.m / (1 - self.b1**self.t)
        vhat = (self.v + self.floor * self.v.mean()) / (1 - self.b2**self.t)
        return x - rate * ratio * mhat / (np.sqrt(vhat) + 1e-12)


@pytest.mark.parametrize("floor", [0.0, 0.3, 1.0])
def test_adam_equals_its_twin(floor):
    rng = np.random.default_rng(0)
    size = 50
    ratio = rng.uniform(0.5, 2, size)
    adam, twin = Adam(size, floor=floor), Twin(size, floor=floor)
    a, b = mi.Float(np.zeros(size, np.float32)), np.zeros(size)
    scale = 10.0 ** rng.uniform(-4, 2, size)
    for i in range(30):
        g = rng.normal(size=size) * scale * (rng.uniform(size=size) < 0.7)
        a = adam.step(
            a, mi.Float(g.astype(np.float32)), 0.1 / (1 + i), mi.Float(ratio.astype(np.float32))
        )
        b = twin.step(b, g, 0.1 / (1 + i), ratio)
        dr.eval(a)
    np.testing.assert_allclose(np.array(a), b, rtol=1e-3, atol=1e-5)


def test_the_floor_keeps_noise_from_moving_at_full_rate():
    """Some entries have evidence, the rest noise a thousand times smaller: with the floor it stays,
    without it drifts."""
    moved = {}
    for floor in (0.0, 1.0):
        rng = np.random.default_rng(1)
        adam, x = Adam(1000, floor=floor), mi.Float(np.zeros(1000, np.float32))
        for _ in range(40):
            g = rng.normal(size=1000) * 1e-3
            g[:100] = 1.0 + 0.1 * rng.normal(size=100)
            x = adam.step(x, mi.Float(g.astype(np.float32)), 0.01)
            dr.eval(x)
        moved[floor] = np.abs(np.array(x))
    assert moved[0.0][100:].mean() > 0.03 and moved[1.0][100:].mean() < 1e-3
    assert moved[0.0][:100].min() > 0.38 and moved[1.0][:100].min() > 0.25


def test_cosine_decay():
    assert (
        cosine_decay(0, 0.1) == 1
        and cosine_decay(1, 0.1) == pytest.approx(0.1)
        and cosine_decay(0.5, 0.1) == pytest.approx(0.55)
    )
    assert cosine_decay(-1, 0.1) == 1 and cosine_decay(7, 0.1) == pytest.approx(0.1)


def test_the_loop_reports_and_saves_when_it_is_due():
    class Stage:
        said, saved = [], []

        def step(self, i, **losses):
            self.said.append((i, {k: v() for k, v in losses.items()}))

        def checkpoint_due(self):
            return len(self.said) == 2

        def save(self, name, **arrays):
            self.saved.append((name, arrays))

    stage = Stage()
    run_steps(stage, 3, 6, lambda i: {"a": [10.0 * i]}, lambda: {"x": 1})
    assert stage.said == [(4, {"a": 30.0}), (5, {"a": 40.0}), (6, {"a": 50.0})]
    assert stage.saved == [("checkpoint", {"step": 5, "x": 1})]


def test_what_is_remembered_goes_on_as_if_nothing_had_happened():
    def steps(x, rng, adam, count):
        for _ in range(count):
            x = adam["x"].step(x, x - rng.next_float32(), 0.1)
            dr.eval(x, rng)
        return x

    def begin():
        return mi.PCG32(size=9, initstate=3), {"x": Adam(9, floor=0.5)}

    rng, adam = begin()
    half = steps(mi.Float(np.linspace(-1, 1, 9)), rng, adam, 5)
    kept = memory(rng, adam)
    whole = np.array(steps(half, rng, adam, 5))
    rng, adam = begin()
    recall(kept, rng, adam)
    np.testing.assert_allclose(np.array(steps(half, rng, adam, 5)), whole, atol=1e-6)
    rng, adam = begin()
    recall(None, rng, adam)  # no checkpoint
    recall({"step": np.array(5)}, rng, adam)  # one without memory
    assert np.abs(np.array(steps(half, rng, adam, 5)) - whole).max() > 0.05

"""A pass that was stopped and is taken up from its checkpoint moves as it would have moved: same
random numbers, same moments."""

from __future__ import annotations

import numpy as np
import pytest

from relit.fit.passes.explore import explore
from relit.fit.passes.material_priors import SurfaceOptions
from relit.fit.passes.optimiser import NoStage
from relit.fit.passes.surface import EnvironmentTerms, TexelStart, fit_surface, start_surface
from relit.fit.passes.volume import VolumeOptions, fit_volume
from relit.rendering.background import start_background
from support.small_passes import PASSES, SURFACE, TEXELS, VOLUME, ball_model

AT, MORE = 70, 3


def multiview_volume(shot, stage):
    """In front of a background."""
    model = ball_model()
    model.background = start_background(8, np.full(3, 0.3))
    fit_volume(shot[0], model, VolumeOptions(**VOLUME), stage)


def multiview_surface(shot, stage):
    """With steps that paint and light trade."""
    bank, _, mesh, _ = shot
    o = SurfaceOptions(**SURFACE, light=8)
    known = np.ones((TEXELS, TEXELS), bool)
    begun = TexelStart(np.full((TEXELS, TEXELS, 3), 0.3, np.float32), known, 0.3)
    model = start_surface(begun, o)
    fit_surface(EnvironmentTerms(bank, mesh, model, o), stage)


def field_of_everything(shot, stage):
    explore(shot[0], start_background(8, np.full(3, 0.3)), 500, 256, stage)


class Over(Exception):
    pass


class Stopped(NoStage):
    """Keeps every checkpoint, and stops after AT + MORE steps. saved: what the pass begins from."""

    def __init__(self, saved=None):
        super().__init__()
        self.saved, self.kept = saved, {}

    def load(self, name):
        return self.saved

    def checkpoint_due(self):
        return True

    def save(self, name, **arrays):
        self.kept[int(arrays["step"])] = arrays
        if arrays["step"] == AT + MORE:
            raise Over


@pytest.mark.slow
@pytest.mark.parametrize(
    "run",
    [*PASSES, multiview_volume, multiview_surface, field_of_everything],
    ids=lambda f: f.__name__,
)
def test_a_pass_moves_on_as_if_it_had_not_been_stopped(shot, run):
    whole = Stopped()
    with pytest.raises(Over):
        run(shot, whole)
    resumed = Stopped(whole.kept[AT])
    with pytest.raises(Over):
        run(shot, resumed)
    assert sorted(resumed.kept) == list(range(AT + 1, AT + MORE + 1))
    before, after, again = whole.kept[AT], whole.kept[AT + MORE], resumed.kept[AT + MORE]
    assert after.keys() == again.keys() and np.array_equal(after["rng"], again["rng"])
    for name in after.keys() - {"rng", "correction_model"}:
        a, b, c = (np.asarray(state[name], float) for state in (before, after, again))
        moved = np.linalg.norm(b - a) if a.shape == b.shape else 0.0  # a history grows
        assert np.linalg.norm(c - b) <= 0.01 * moved + 1e-5 * np.linalg.norm(b), name

"""Memory stays flat over hundreds of steps of every pass, and its steps launch the kernels that the
first ones compiled."""

from __future__ import annotations

import gc
import io
import sys
from contextlib import redirect_stdout
from pathlib import Path

import drjit as dr
import pytest

from relit.fit.passes.optimiser import NoStage
from support.small_passes import LAST, PASSES, SETTLED, STEPS


class Watch(NoStage):
    """Counts what lives after SETTLED and LAST steps, and the kernels of those that follow."""

    def __init__(self):
        self.alive: dict[int, tuple[int, int, float]] = {}
        self.kernels: list[dict] = []

    def step(self, i, **losses):
        if i % 50 == 0 and i < LAST:
            dr.kernel_history()  # else what Dr.Jit records after the pass before is never freed
        if i in (SETTLED, LAST):
            gc.collect()
            said = io.StringIO()
            with redirect_stdout(said):
                dr.whos()
            resident = int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 2**20
            self.alive[i] = len(said.getvalue().splitlines()), sys.getallocatedblocks(), resident
        if i == LAST:  # from here on: the history takes memory itself
            dr.set_flag(dr.JitFlag.KernelHistory, True)
            dr.kernel_history_clear()
        if i == STEPS:
            self.kernels = dr.kernel_history()
            dr.set_flag(dr.JitFlag.KernelHistory, False)


@pytest.mark.slow
@pytest.mark.parametrize("run", PASSES, ids=lambda f: f.__name__)
def test_memory_stays_flat(shot, run, monkeypatch):
    monkeypatch.setattr(
        "relit.fit.collection.surface.HISTORY", 100
    )  # full once the pass has settled
    watch = Watch()
    run(shot, watch)
    arrays, objects, resident = (
        b - a for a, b in zip(watch.alive[SETTLED], watch.alive[LAST], strict=True)
    )
    assert arrays <= 2  # Dr.Jit's variables; what a step leaves behind counts 590 times
    assert objects < 0.9 * (LAST - SETTLED)  # of Python
    assert resident < 6  # MB, of everything
    assert len(watch.kernels) >= 10 and all(
        k["cache_hit"] for k in watch.kernels if "cache_hit" in k
    )

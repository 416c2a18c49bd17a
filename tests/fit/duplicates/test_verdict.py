"""What is said of uncertain poses, and which are refused."""

import numpy as np
import pytest

from relit.errors import EXIT_FAILED, UserError
from relit.fit.duplicates.verdict import judge_pile_poses
from relit.fit.registration.instances.left_out import LeftOut
from relit.run import Run

NAMES = ["label 1", "label 2", "label 3"]


def test_uncertain_poses_are_named_and_contradicted_ones_refused(tmp_path):
    with Run.open(tmp_path / "run", {"capture": "duplicates"}) as run:
        judge_pile_poses(NAMES, np.array([0.1, 0.6, 0.2]), False, run)
        assert "1 of 3 poses are uncertain (label 2)" in (run.folder / "log.txt").read_text()
        with pytest.raises(UserError, match="contradicts the poses") as raised:
            judge_pile_poses(NAMES, np.array([0.9, 0.9, 0.6]), True, run)
        assert raised.value.code == EXIT_FAILED and "80%" in str(raised.value)
        run.force = True
        judge_pile_poses(NAMES, np.array([0.9, 0.9, 0.6]), True, run)
        assert "kept by --force" in (run.folder / "log.txt").read_text()


def test_poses_that_were_not_asked_are_not_judged(tmp_path):
    with Run.open(tmp_path / "run", {"capture": "duplicates"}) as run:
        judge_pile_poses(NAMES, np.full(3, np.nan), False, run)
        assert (
            not (run.folder / "log.txt").exists()
            or "uncertain" not in (run.folder / "log.txt").read_text()
        )


def asked(within, own, other) -> LeftOut:
    return LeftOut(*(np.full(4, x) for x in (within, own, other, 90.0)))


def test_poses_are_contradicted_where_they_lose_much_and_others_lead():
    assert asked(0.9, 0.55, 0.65).contradicted
    assert not asked(0.9, 0.55, 0.45).contradicted  # little agrees, but nothing else does better
    assert not asked(0.87, 0.73, 0.86).contradicted  # a plain body of revolution, rightly placed
    assert not asked(0.95, 0.85, 0.5).contradicted

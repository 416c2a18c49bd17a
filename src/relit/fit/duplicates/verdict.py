"""Whether the photo supports the poses of a pile."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from relit.fit.registration.instances.left_out import WRONG
from relit.run import Run

UNCERTAIN = 0.5  # chance of being wrong from which on a pose is named


def judge_pile_poses(
    names: Sequence[str], chances: np.ndarray, contradicted: bool, run: Run
) -> None:
    """Name the uncertain poses; refuse poses that the photo contradicts. names: of the registered
    instances, chances: (N,) of being wrong, NaN where unknown, contradicted: see `LeftOut`."""
    known = np.isfinite(chances)
    if not known.any():
        return
    expected = f"{chances[known].mean():.0%} of the poses are expected to be wrong by more than {WRONG:.0f} degrees"
    if contradicted:
        run.refuse(
            f"the photo contradicts the poses that were found: {expected}",
            "most instances agree better with a model of the others at another pose: the objects are not identical, the "
            "labels are wrong, the object is plain or nearly symmetric, or the sides that are shown lie too far apart",
            "check the label image; add objects, or another photo of the pile",
        )
    low = [name for name, chance in zip(names, chances, strict=True) if chance >= UNCERTAIN]
    if low:
        run.say(
            f"note: {len(low)} of {len(names)} poses are uncertain ({', '.join(low)}): in a model of the others another pose agrees as well "
            "or better; the object is nearly symmetric, its texture repeats, it mirrors its surroundings, or what tells is hidden"
        )
    run.log.note(f"{expected} (mean of their chances)")

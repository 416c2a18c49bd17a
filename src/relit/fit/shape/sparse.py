"""Sparse linear equations."""

from __future__ import annotations

import numpy as np
from scipy.sparse.linalg import splu


def solved_symmetric(matrix, right: np.ndarray) -> np.ndarray:
    """x with matrix x = right, for a sparse symmetric positive definite matrix (N, N) and right
    (N,) or (N, K).

    Ordered by the matrix's own pattern, not by that of its square, as is the default: a few dense
    rows (poses among vertices) fill it several times as much there."""
    return splu(
        matrix.tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    ).solve(right)

"""NumPy twin of what is computed on the grid of signed distances."""

import numpy as np

from relit.geometry.sdf import SdfGrid, dense_values


def eikonal_energy(grid: SdfGrid) -> float:
    """The energy whose gradient `smoothness_gradient` returns, for weight 1."""
    v, h = dense_values(grid).astype(np.float64), grid.h
    sides = [
        (np.roll(v, -1, k)[1:-1, 1:-1, 1:-1], np.roll(v, 1, k)[1:-1, 1:-1, 1:-1]) for k in (0, 1, 2)
    ]
    norm = np.sqrt(sum(((p - m) / (2 * h)) ** 2 for p, m in sides))
    band = np.zeros(grid.n**3, bool)
    band[np.array(grid.nodes)] = True
    band = band.reshape(v.shape)[1:-1, 1:-1, 1:-1]
    return float(((norm - 1) ** 2)[band].sum() / (grid.rows - 1))

"""The figures of a recovered environment light."""

from __future__ import annotations

import numpy as np

from relit.evaluate import metrics as m
from relit.evaluate.baselines import Constants

_SHOWN = "recovered against true light, lat-long 256x512, clipped to [0, 1], to the power 1/2.2"
_UPPER = "mean of the texels above the horizon"
ENVIRONMENT_DEFINITIONS = {
    "environment_mse": ("", f"{_SHOWN}, mean of all texels (SfD)"),
    "environment_mse_upper": (
        "",
        f"{_SHOWN}, {_UPPER}: of an object on the ground the lower half is filled in, not measured",
    ),
    "environment_mse_scaled": (
        "",
        "as environment_mse, the recovered light divided by the albedo's factor first",
    ),
    "environment_mse_upper_scaled": (
        "",
        "as environment_mse_upper, the recovered light divided by the albedo's factor first",
    ),
    "environment_log_rmse": (
        "stops",
        "root mean square difference of log2 radiance by solid angle at 32x64, below 1 % of the "
        "mean raised to it, light divided by the albedo's factor first",
    ),
}


def environment_figures(
    recovered: np.ndarray, light: np.ndarray, factor: np.ndarray, constants: Constants
) -> dict[str, float]:
    """environment_mse over the whole sphere and its upper half, as recovered and divided by the
    albedo's factor (3,), and environment_log_rmse."""
    out = {}
    for upper, name in ((False, "environment_mse"), (True, "environment_mse_upper")):
        for scaled, tail in ((recovered, ""), (recovered / factor, "_scaled")):
            out[name + tail] = m.environment_mse(scaled, light, upper)
            constants.add(name + tail, m.encoded_environment(light, upper))
    out["environment_log_rmse"] = m.environment_log_rmse(recovered / factor, light)
    return out

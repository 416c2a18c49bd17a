"""A striped box with a room that is open below, which no silhouette shows, and photos of it."""

from dataclasses import replace

import numpy as np

from relit.fit.shape.lids import FIRST, THEN
from relit.geometry.hull import distance_of
from relit.geometry.sdf import node_positions
from relit.geometry.se3 import look_at
from relit.scene import Camera

N, SIZE = 40, 72
P = node_positions(N)
BOX = (np.abs(P[..., 0]) < 0.5) & (np.abs(P[..., 2]) < 0.45) & (np.abs(P[..., 1]) < 0.3)
ROOM = (np.abs(P[..., 0]) < 0.38) & (np.abs(P[..., 2]) < 0.33) & (P[..., 1] < 0.15)  # open below
FIRST_SMALL = replace(FIRST, nodes=N, steps=60, rays=2048, least=60, probes=40_000)
THEN_SMALL = replace(THEN, nodes=N + 8, steps=120, rays=2048, probes=40_000)


def cameras():
    out = []
    for height in (-2.2, -0.9, 0.0, 1.2):
        for turn in np.linspace(0, 2 * np.pi, 8, endpoint=False) + height:
            o = np.array([np.cos(turn), 0, np.sin(turn)]) * np.sqrt(9 - height**2) + [0, height, 0]
            out.append(Camera(SIZE, SIZE, 95.0, 95.0, SIZE / 2, SIZE / 2, look_at(o)))
    return out


LEVEL = np.array([0.3, 0.3, 0.3])


def pictures(inside):
    """Photos of a shape, striped inside and out: (rgb, coverage) of each camera."""
    import mitsuba as mi

    from relit.fit.passes.volume import start_model
    from relit.fit.registration.register import volume_render

    model = start_model(distance_of(inside), LEVEL, None, full=True)
    stripes = [
        0.3 + 0.25 * np.sin(k * P[..., 0] + 1) * np.cos(k * P[..., c])
        for k, c in ((14, 2), (12, 1), (13, 2))
    ]
    colours = np.stack([*stripes, 0 * stripes[0]], -1)
    model.grid.features = mi.Float(
        np.concatenate([np.zeros((1, 4)), colours.reshape(-1, 4)]).astype(np.float32).ravel()
    )
    model.inv_s = 3.0 / model.grid.h
    return volume_render(model)(cameras())


def photographed(inside):
    """The bank of the photos of a shape, and a start for fits."""
    from relit.fit.passes.pixels import make_bank
    from relit.fit.passes.volume import start_model

    rgb, alpha = pictures(inside)
    return make_bank(cameras(), list(rgb), list(alpha)), lambda values: start_model(
        values, LEVEL, None, full=True
    )

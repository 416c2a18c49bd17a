"""What several tests of the page share."""

from __future__ import annotations

import threading

import numpy as np

from relit.conventions import environment_directions, srgb_from_linear

WIDTH, HEIGHT = 96, 80
READY = {"wait": "window.relit?.ready"}


def lopsided(height=32):
    """(H, 2H, 3) radiance with a warm sun, a blue window and a gradient: no mirror or turn of it
    looks like itself."""
    d = environment_directions(height, 2 * height)
    sun = 8 * np.exp(40 * (d @ [0.6, 0.7, -0.39] - 1))[..., None] * [1, 0.8, 0.5]
    window = 3 * np.exp(20 * (d @ [-0.9, 0.1, 0.42] - 1))[..., None] * [0.3, 0.5, 1]
    return (np.clip(0.3 + 0.2 * d, 0, None) + sun + window).astype(np.float32)


def serve(make):
    server = make()
    threading.Thread(
        target=server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True
    ).start()
    return server


def psnr(picture, reference):
    """Of sRGB values where the reference is wholly covered. picture: (H, W, 3) in [0, 1] sRGB;
    reference: linear RGBA."""
    inside = reference[..., 3] > 0.99
    e = (picture - np.clip(srgb_from_linear(reference[..., :3]), 0, 1))[inside]
    return -10 * np.log10((e**2).mean())

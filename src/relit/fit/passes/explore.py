"""Where the object is, for photos without masks: a coarse radiance field of the whole scene, and a
first shape from its depths.

A signed distance field that starts as a ball has to find its topology through its own surface; a
density has gradients everywhere. So the whole scene is first fitted as density and colour in
contracted space (rendering/background.py), the depths that the photos see in it are fused (Curless
& Levoy 1996), and the fused distance is where the volume pass begins. The field stays as the
background.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from relit.fit.passes.losses import display_loss
from relit.fit.passes.optimiser import Adam, cosine_decay, memory, recall, run_steps
from relit.fit.passes.pixels import PixelBank, batch_of, draw_pixels, rays_through
from relit.geometry.fusion import fuse_depths
from relit.rendering.background import Background, median_depth, render_everything
from relit.scene import Camera

INSIDE = 48  # samples within the object sphere
DEPTH_PIXELS = 20_000  # of each photo's depth map, about


def explore(
    bank: PixelBank, field: Background, steps: int, rays: int, stage, seed: int = 0
) -> Background:
    """Fit the field to all photos. Resumes from the stage's checkpoint."""
    saved = stage.load("field")
    first = int(saved["step"]) if saved else 0
    if saved:
        field.cells = mi.Float(saved["cells"])
    adam = {"cells": Adam(dr.width(field.cells))}
    ratio = mi.Float(
        np.tile(np.array([2, 0.5, 0.5, 0.5], np.float32), field.n**3)
    )  # densities have farther to go than colours
    rng = mi.PCG32(size=rays, initstate=seed * 7919 + 5)
    recall(saved, rng, adam)

    def step(i: int) -> dict:
        pixel = draw_pixels(bank, rng, rays)
        jitter = rng.next_float32()
        dr.eval(pixel, jitter, rng)
        batch = batch_of(bank, pixel)
        dr.eval(batch.o, batch.d, batch.rgb)
        dr.enable_grad(field.cells)
        rgb, density = render_everything(field, batch.o, batch.d, jitter, INSIDE)
        loss = display_loss(rgb, batch.rgb)
        dr.backward(loss + 1e-4 * dr.mean(density))  # empty unless the photos say otherwise
        gradient = dr.grad(field.cells)
        dr.disable_grad(field.cells)
        dr.eval(gradient, loss)
        field.cells = adam["cells"].step(
            dr.detach(field.cells), gradient, 0.15 * cosine_decay(i / steps, 0.1), ratio
        )
        dr.eval(field.cells)
        return {"colour": loss}

    run_steps(
        stage,
        first,
        steps,
        step,
        lambda: {"cells": np.array(field.cells), **memory(rng, adam)},
        "field",
    )
    return field


def first_shape(bank: PixelBank, cameras: list[Camera], field: Background, n: int) -> np.ndarray:
    """(n, n, n) signed distances fused from the depths that every photo sees in the field."""
    depths, small = [], []
    for view, camera in enumerate(cameras):
        shrink = min(1.0, np.sqrt(DEPTH_PIXELS / (camera.width * camera.height)))
        w, h = max(8, round(camera.width * shrink)), max(8, round(camera.height * shrink))
        index = dr.arange(mi.UInt32, w * h)
        x, y = (
            (mi.Float(index % w) + 0.5) * (camera.width / w),
            (mi.Float(index // w) + 0.5) * (camera.height / h),
        )
        o, d = rays_through(bank.cameras, dr.opaque(mi.UInt32, view, w * h), x, y)
        o = o + dr.zeros(mi.Vector3f, w * h)
        dr.eval(o, d)
        depths.append(np.array(median_depth(field, o, d, INSIDE)).reshape(h, w))
        small.append(camera.resized(w, h))
    return fuse_depths(small, depths, n, truncation=0.12)

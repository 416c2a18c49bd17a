"""Held-out photos of a capture with cameras: how well the volume pass predicts them."""

from __future__ import annotations

import json

import numpy as np

from relit.conventions import move_pose, srgb_from_linear
from relit.files import write_text
from relit.fit.passes.pixels import sphere_pixels
from relit.fit.passes.volume import VolumeModel, render_views
from relit.scene import Capture


def score_held_out(capture: Capture, model: VolumeModel, run, unit_from_found: np.ndarray) -> None:
    """Say how well the volume pass predicts the photos that the capture sets aside (never used in the fit); stages/volume/held_out.json.

    unit_from_found: (4, 4), the frame of the fitted cameras against that of the given ones; the identity where cameras are exact.
    """
    if not capture.held_out or any(p.camera is None for p in capture.held_out):
        return
    found_from_world = np.linalg.inv(capture.sphere.world_from_unit @ unit_from_found)
    scores = {}
    for photo in capture.held_out:
        pixels = photo.load()
        camera = photo.camera.with_pose(move_pose(found_from_world, photo.camera.world_from_camera))
        covered = sphere_pixels(camera, 1.0)
        if covered.any():
            shown = srgb_from_linear(np.clip(render_views(model, [camera])[0], 0, 1))
            error = (shown - srgb_from_linear(np.clip(pixels.rgb, 0, 1)))[covered]
            scores[photo.name] = round(float(-10 * np.log10(np.mean(error**2))), 3)
    mean = float(np.mean(list(scores.values())))
    definition = "PSNR in dB of the volume pass's picture, sRGB, pixels whose ray meets the object sphere, mean over held-out photos"
    record = {"value": mean, "definition": definition, "per_view": scores}
    write_text(run.folder / "stages" / "volume" / "held_out.json", json.dumps(record))
    run.say(f"{len(scores)} photos set aside: {mean:.2f} dB ({definition})")

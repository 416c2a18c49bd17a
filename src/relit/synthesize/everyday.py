"""Everyday captures with known truth: an object on a textured table, photographed by hand with a
phone.

Photos, and what is handed over, are those of `synthesize.delivery` (neither masks nor cameras by
default); the truth is that of `synthesize.object_truth`. The object casts its shadow on the table,
and light from the table falls on the object: a fit that knows only the light of the environment
finds the table's in it.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from relit.geometry.se3 import look_at
from relit.scene import Camera
from relit.synthesize.camera_model import FULL_FRAME_DIAGONAL, PRESETS
from relit.synthesize.delivery import (
    Delivery,
    delivered_shots,
    delivery_truth,
    pinholes,
    write_cameras,
    write_photo,
)
from relit.synthesize.multiview import RADIUS, claim_folder, tell_progress, write_json
from relit.synthesize.object_truth import (
    CaptureFiles,
    Sampling,
    settings_for,
    stage_truth,
    write_object_truth,
)
from relit.synthesize.surroundings import Support, staged, table_texture

EVERYDAY_SAMPLING = Sampling(views=40, test_views=8, resolution=400, spp=128, test_spp=192)
EVERYDAY = Delivery(PRESETS["phone"], masks=False, cameras=False)
FOCAL = 27.0  # mm, 35 mm equivalent of a phone's main camera
ASPECT = 0.75
PORTRAIT = 0.4  # share of photos
RINGS = ((12.0, 22.0), (28.0, 42.0), (50.0, 65.0))  # degrees of elevation, by turns
FILL = (0.65, 0.95)  # of half the shorter side, by the object's sphere
ROLL, AIM = 6.0, 0.06  # degrees; share of the shorter side, standard deviations
TABLE = 4.0 * RADIUS  # half a side: its far edge is in view in low photos
BACKGROUND_BLUR = 1.0  # degrees, by which what is behind is out of focus


def synthesize_everyday(
    files: CaptureFiles,
    out: str | Path,
    sampling: Sampling = EVERYDAY_SAMPLING,
    *,
    texture: str | Path = "wood",
    delivery: Delivery = EVERYDAY,
    say: Callable[[str], None] = lambda text: None,
) -> Path:
    """Render hand-held photos of an object on a table, with their truth, into `out`; returns `out`.

    texture: of the table, one of `surroundings.TEXTURES` or a picture file. Deterministic by the
    seed; takes up where a killed call stopped. Raises UserError as `synthesize_multiview`.
    """
    out, texture = Path(out), str(texture)
    colour, roughness = table_texture(texture, sampling.seed)
    if claim_folder(out, settings_for("everyday", files, sampling, delivery, texture=texture)):
        return out
    ideal = hand_held_cameras(sampling.views, sampling.resolution, sampling.seed)
    test = hand_held_cameras(sampling.test_views, sampling.resolution, sampling.seed + 1, "t_")
    shots = delivered_shots(delivery, ideal, sampling.seed)
    write_cameras(out, delivery, shots, test)
    truth = stage_truth(out, files, sampling, test, say)
    table = Support("square", TABLE, truth.lowest, colour, roughness, turn=0.35)
    stage = staged(truth.thing, truth.environment, (table,), BACKGROUND_BLUR)
    for i, (name, shot) in enumerate(shots):
        write_photo(out, delivery, name, shot, stage.take, sampling.spp)
        tell_progress(say, "photo", i, len(shots))
    content = write_object_truth(truth, files, pinholes(shots), test)
    settings = settings_for("everyday", files, sampling, delivery, texture=texture)
    content |= {"settings": settings, "table": {"height": truth.lowest, "half_side": TABLE}}
    write_json(out / "truth" / "truth.json", {**content, **delivery_truth(out, delivery, shots)})
    return out


def hand_held_cameras(
    count: int, resolution: int, seed: int, prefix: str = "IMG_"
) -> list[tuple[str, Camera]]:
    """(name, Camera) pairs around the object and above the table, as a person walks: RINGS by turns,
    uneven steps, distances, roll and aim; landscape and portrait."""
    rng = np.random.default_rng([seed, 71])
    start, out = rng.uniform(0, 2 * np.pi), []
    for i in range(count):
        elevation = np.radians(rng.uniform(*RINGS[i % len(RINGS)]))
        azimuth = start + 2 * np.pi * (i + rng.normal() * 0.25) / count * len(RINGS)
        azimuth += 2 * np.pi * (i % len(RINGS)) / count  # rings are shifted to each other
        long, short = resolution, round(resolution * ASPECT)
        w, h = (short, long) if rng.random() < PORTRAIT else (long, short)
        focal = FOCAL / FULL_FRAME_DIAGONAL * np.hypot(w, h)
        seen = 0.5 * short * rng.uniform(*FILL)
        distance = RADIUS * np.hypot(1, focal / seen)
        y, r = np.sin(elevation), np.cos(elevation)
        eye = distance * np.array([r * np.cos(azimuth), y, r * np.sin(azimuth)])
        target = rng.normal(size=3) * AIM * short * distance / focal
        pose = look_at(eye, target, roll=np.radians(rng.normal() * ROLL))
        out.append((f"{prefix}{i:03d}", Camera(w, h, focal, focal, w / 2, h / 2, pose)))
    return out

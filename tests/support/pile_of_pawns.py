"""A pile of pawns: true poses and the options of a small run."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np

from relit.capture.open import open_capture
from relit.conventions import scale_of
from relit.fit.duplicates import recipe

# all on the ground
SIZES = {
    "count": 4,
    "seed": 3,
    "resolution": 96,
    "test_resolution": 32,
    "spp": 8,
    "test_spp": 8,
    "test_views": 2,
}


def true_poses(pile, number=0):
    """object_from_camera of the photo `number` in a frame whose unit is the object's radius over
    .8."""
    truth = json.loads((pile / "truth" / "truth.json").read_text())
    camera = open_capture(pile).photos[number].camera
    poses = []
    for i in truth["instances"]:
        m = np.linalg.inv(camera.world_from_camera) @ np.array(i["world_from_object"])
        s = scale_of(m)
        own = np.linalg.inv(m)  # asset units; the asset's bounding sphere has the radius 0.8 / s
        own[:3, :3] *= s
        own[:3, 3] *= s
        poses.append(own)
    return np.array(poses)


SMALL = {
    "levels": (24,),
    "level_steps": (60,),
    "rays": 1024,
    "faces": 800,
    "texture": 32,
    "surface_steps": 4,
    "points": 128,
}


def small_options(**changes):
    return replace(
        recipe.options_for("draft"), **{**SMALL, **changes}, directions=8, light=8, side=64
    )

"""Settings of the recipe `duplicates`."""

from __future__ import annotations

from dataclasses import dataclass

from relit.cameras.matcher import STEP
from relit.lighting.spherical_gaussians import MAX_LOBES
from relit.settings import check_parts, preset


@dataclass(frozen=True)
class DuplicatesOptions:
    """side: pixels of an instance's window in the volume pass. search_rounds: of fit and search for
    all poses. searches: of few objects (up to 8) from the start, until two of them agree.
    regrowths: times that objects which were not sure of their places are taken out and join again.
    search_effort: the search for poses of N instances ends after N / 2 + 10 times as many coarse
    models, with the best poses so far (fit/duplicates/poses.py). levels, level_steps, rays: of the
    volume pass. refine_poses: step of the pose corrections in it (radians, unit lengths). faces,
    texture: of the object. outlines: rounds in which the poses and the mesh follow the labels
    (fit/shape/outlines.py). surface_steps, points,
    directions, light: of the surface pass. gaussians: the light is so many spherical Gaussians
    (SfD: 128), 0 for a map. max_pixels: of the photos. matcher: 'module:function', see
    `cameras.matcher`. matcher_step: degrees by which it sees one picture of a pair turned, a
    divisor of 360 (SfD: 4, as for the built-in SIFT, which this does not concern). normal_network:
    an ONNX file, see `capture.networks`.
    without: parts that are switched off, names of WITHOUT.
    """

    side: int = 320
    search_rounds: int = 1
    searches: int = 3
    regrowths: int = 12
    search_effort: float = 22.0
    levels: tuple[int, ...] = (48, 96, 192)
    level_steps: tuple[int, ...] = (400, 500, 400)
    rays: int = 6144
    refine_poses: float = 0.004
    faces: int = 16_000
    outlines: int = 5
    texture: int = 512
    surface_steps: int = 900
    points: int = 4096
    directions: int = 48
    light: int = 64
    gaussians: int = 0
    max_pixels: int = 4_000_000
    matcher: str = ""
    matcher_step: int = STEP
    normal_network: str = ""
    without: tuple[str, ...] = ()

    def __post_init__(self):
        if not 0 <= self.gaussians <= MAX_LOBES:
            raise ValueError(f"gaussians={self.gaussians} is outside 0 to {MAX_LOBES}")
        if not 1 <= self.matcher_step <= 90 or 360 % self.matcher_step:
            raise ValueError(f"matcher_step={self.matcher_step} is no divisor of 360 from 1 to 90")
        check_parts(self.without, WITHOUT)


WITHOUT = {
    "rotation_sweep": "pictures are matched as they are, not turned against each other",
    "matching": "no features are matched",
    "guided": "matches are not sought again once poses are known",
    "search": "what matching does not link is dropped, and of several sets that it links all but the largest",
    "refinement": "poses stay as search has found them",
    "textures": "mesh and poses follow the outlines of the labels alone",
    "symmetry": "silhouettes bound the object from the sides that show them alone, also where it is its own mirror image",
    "vessels": "bodies of revolution end as silhouettes leave them",
    "unseen": "sides that no view shows stay as large as silhouettes let them be",
    "rounding": "bodies of revolution keep the bumps that the volume pass leaves",
    "visibility": "no instance, and no ground, shadows another",
    "normals": "normal priors are not used",
    "metal": "no term pulls metallic to 0 or 1",
    "first_material": "every place begins as paint",
    "ground": "no ground is looked for",
    "hidden": "what no photo shows throws back what the volume pass makes of it, without shadows",
}

PRESETS = {
    "draft": {
        "side": 200,
        "searches": 1,
        "regrowths": 4,
        "search_effort": 12.0,
        "levels": (48, 96),
        "level_steps": (150, 200),
        "rays": 4096,
        "faces": 8_000,
        "outlines": 3,
        "texture": 256,
        "surface_steps": 300,
        "points": 2048,
        "directions": 32,
        "light": 32,
        "max_pixels": 1_000_000,
    },
    "standard": {},
    "high": {
        "side": 480,
        "level_steps": (500, 600, 700),
        "texture": 1024,
        "surface_steps": 2500,
        "directions": 64,
    },
}


def options_for(quality: str) -> DuplicatesOptions:
    """The recipe's options for 'draft', 'standard' or 'high'. Raises UserError (code 2) for
    others."""
    return DuplicatesOptions(**preset(quality, PRESETS))

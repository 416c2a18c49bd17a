"""Options of the `collection` recipe, and their values for each quality."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from relit.settings import check_parts, preset

WITHOUT = (
    "quadrants",
    "search",
    "multiplex",
    "posterior",
    "coarse_to_fine",
    "light_prior",
    "links",
)


@dataclass(frozen=True)
class CollectionOptions:
    """side: pixels of the photos' longer side. rounds: of coarse fit and registration. polish:
    turns of descent and search after them.
    keep: hypotheses of each photo that are refined (SAMURAI's multiplex). assignment: 'best': one
    of them takes part in the coarse fits; 'soft': several, by SAMURAI's shares with memory and
    momentum. hints: whether quadrants or angles are used. holdout: every so many photos are set
    aside (0: none but those of held_out.json). starts: photos that growth begins from without
    hints, where pairs hold too few together. least_score: of the registration, on average, and
    least_agreement: share of photos that find their place in a model of the others, below which the
    poses are taken for wrong. levels, level_steps, rays: of the volume pass; mask_weights: of its
    mask term, level by level: outlines of masks wander, and the surface would follow them into
    bumps. refine_cameras: step of the camera corrections in it. hollows: flat faces of the hull
    that are asked whether a space lies under them that no silhouette shows (fit/shape/lids.py), 0
    for none. faces, texture, surface_steps, points, directions: of mesh and surface pass.
    frozen_steps: of the fit of held-out photos. light_network: folder of Neural-PIL's network,
    which then takes the place of the shipped prior of lights.
    init_colour: weight of SAMURAI's L_init in the surface pass, a tenth of it after the share
    lambda_a of its steps (80k of 300k in the paper). lambda_c: sharpness of the soft assignment in
    the first and the last round. without: what an ablation switches off.
    """

    side: int = 400
    rounds: int = 6
    polish: int = 3
    keep: int = 3
    assignment: Literal["best", "soft"] = "best"
    hints: bool = True
    holdout: int = 0
    starts: int = 4
    least_score: float = 0.84
    least_agreement: float = 0.2
    levels: tuple[int, ...] = (64, 128, 192)
    level_steps: tuple[int, ...] = (400, 500, 400)
    mask_weights: tuple[float, ...] = (0.8, 0.2, 0.1)
    rays: int = 6144
    refine_cameras: float = 0.003
    hollows: int = 3
    faces: int = 30_000
    texture: int = 512
    surface_steps: int = 1500
    points: int = 8192
    directions: int = 32
    frozen_steps: int = 150
    light_network: str = ""
    init_colour: float = 0.0
    lambda_a: float = 0.27
    lambda_c: tuple[float, float] = (1.0, 10.0)
    without: tuple[str, ...] = ()

    @property
    def hypotheses(self) -> int:
        """How many of each photo are refined wherever photos are searched for."""
        return 1 if "multiplex" in self.without else self.keep

    @property
    def max_pixels(self) -> int:
        """Of all photos together, for the forecast of memory: each is shrunk as it is read."""
        return 150 * self.side**2

    def __post_init__(self):
        if self.lambda_a <= 0 or min(self.lambda_c) <= 0:
            raise ValueError("lambda_a and lambda_c must be positive")
        if not self.mask_weights or min(self.mask_weights) < 0:
            raise ValueError("mask_weights must be at least one number, none of them negative")
        check_parts(self.without, WITHOUT)


PRESETS = {
    "draft": {
        "side": 200,
        "keep": 2,
        "starts": 2,
        "levels": (48, 80),
        "level_steps": (200, 250),
        "rays": 4096,
        "hollows": 0,
        "faces": 10_000,
        "texture": 256,
        "surface_steps": 250,
        "points": 2048,
        "frozen_steps": 80,
    },
    "standard": {},
    "high": {
        "side": 800,
        "levels": (64, 128, 192),
        "level_steps": (500, 600, 600),
        "rays": 8192,
        "faces": 60_000,
        "texture": 1024,
        "surface_steps": 2000,
        "directions": 64,
    },
}


def options_for(quality: str) -> CollectionOptions:
    """The recipe's options for 'draft', 'standard' or 'high'. Raises UserError (code 2) for
    others."""
    return CollectionOptions(**preset(quality, PRESETS))

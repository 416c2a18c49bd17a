"""Objects photographed from all around in a dark room, by a flash that moves with the camera."""

from __future__ import annotations

import math

from relit.benchmark.suites.multiview import GRASS, STUDIO
from relit.benchmark.suites.suite import Item, Suite

TEA = "assets/tea_set_01_1k.glb"


def offset(degrees: float) -> tuple[float, float, float]:
    """Offset of a flash, to the left and above, that the object sees `degrees` away from the camera
    at the mean distance of the suite's cameras."""
    aside, above = -0.878, -0.479  # direction of the default offset
    length = MEAN_DISTANCE * math.tan(math.radians(degrees))
    return aside * length, above * length, 0.0


# Mean distance of `synthesize.multiview.orbit_cameras`: radius .8 / sin 20 degrees, times 1.04.
MEAN_DISTANCE = 0.8 / math.sin(math.radians(20.0)) * 1.04
REPORT_ITEMS = (
    # Offset of the flash, with dark and bright paint.
    Item("dark-0", "procedural:140:blob", (), {"paint": "dark", "offset": offset(0)}),
    Item("bright-3", "procedural:145:blob", (), {"paint": "bright", "offset": offset(3)}),
    Item("cat-6", "assets/concrete_cat_statue.glb", (), {"offset": offset(6)}),
    Item("pot-10", "assets/pot_enamel_01.glb", (), {"offset": offset(10)}),
    # A room that is not quite dark.
    Item("box-ambient-5", "assets/cardboard_box_01.glb", GRASS, {"ambient": 0.05}),
    Item("duck-ambient-20", "assets/rubber_duck_toy.glb", STUDIO, {"ambient": 0.2}),
    # Materials that a rough plastic does not describe: Mitsuba's `principled`.
    Item("goblet", "assets/brass_goblet1.glb", (), {"material": "own"}),
    Item("can", "assets/can_rusted.glb", (), {"material": "own"}),
    Item("gloss-144", "procedural:144:gloss", (), {"material": "own"}),
    # Parts that shadow others, and hollows that light themselves.
    Item("chair", "assets/SchoolChair_01.glb", ()),
    Item("bowl-141", "procedural:141:bowl", ()),
)
FLASH = Suite(
    kind="flash",
    items=(
        Item("spot", "assets/spot/spot.obj", ()),
        Item("teapot", TEA, (), {"nodes": ["tea_set_01_teapot_01", "tea_set_01_teapot_01_lid"]}),
        Item(
            "cup", TEA, (), {"nodes": ["tea_set_01_cup_small_01"]}
        ),  # concave: its inside lights itself
    ),
    options={
        "views": 120,
        "test_views": 20,
        "resolution": 400,
        "spp": 64,
        "test_spp": 64,
        "seed": 0,
    },
    report_items=REPORT_ITEMS,
    synthesize="relit.synthesize.flash.synthesize_flash",
    evaluate="relit.evaluate.flash.evaluate_flash",
    bars={
        "seconds": ("<=", 720.0),
        "peak_memory": ("<=", 4.0),
        "novel_psnr": (">=", 32.4),
        "diffuse_psnr": (">=", 36.3),
        "specular_psnr": (">=", 30.2),
        "roughness_mse": ("<=", 0.85e-3),
        "flash_angle": ("<=", 0.2),
    },
    ablations={
        name: (f"without={name}",)
        for name in ("offset", "shadow", "interreflection", "features", "refinement")
    }
    | {"offset+shadow": ("without=offset,shadow",), "hollows": ("hollows=0",)},
)

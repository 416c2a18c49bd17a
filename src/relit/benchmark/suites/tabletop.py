"""An object on a table with neither masks nor cameras: photographed by hand (everyday), and on a
plate that turns before a still camera (turntable). Truth and photos are Mitsuba's `principled`, not
the package's BRDF."""

from __future__ import annotations

from relit.benchmark.suites.multiview import GRASS, MOON, STUDIO
from relit.benchmark.suites.suite import REPORT_RELIGHTS, TUNE_RELIGHTS, Item, Suite

SIZES = {"test_views": 8, "resolution": 400, "spp": 128, "test_spp": 192, "seed": 0}
EVERYDAY_SUITE = Suite(
    kind="multiview",
    items=(
        Item("boombox", "assets/BoomBox.glb", "envmaps/kiara_1_dawn_1k.hdr"),
        Item(
            "cabinet",
            "assets/painted_wooden_cabinet_1k.glb",
            "envmaps/lebombo_1k.hdr",
            {"table": "cloth"},
        ),
    ),
    relights=TUNE_RELIGHTS,
    report_items=(
        Item("duck", "assets/rubber_duck_toy.glb", GRASS, {"table": "wood"}),
        Item("can", "assets/can_rusted.glb", STUDIO, {"table": "cloth"}),
        Item("goblet", "assets/brass_goblet1.glb", GRASS, {"table": "speckle"}),
        Item("barrel", "assets/barrel_03.glb", MOON, {"table": "wood"}),
        Item("bowl-121", "procedural:121:bowl", STUDIO, {"table": "wood"}),
        Item("gloss-124", "procedural:124:gloss", GRASS, {"table": "cloth"}),
    ),
    report_relights=REPORT_RELIGHTS,
    options={"views": 40, **SIZES},
    synthesize="relit.benchmark.photographed.synthesize_everyday_item",
    settings="relit.benchmark.photographed.everyday_settings",
)
TURNTABLE_SUITE = Suite(
    kind="multiview",
    items=(
        Item("boombox", "assets/BoomBox.glb", "envmaps/kiara_1_dawn_1k.hdr"),
        Item("bottle", "assets/WaterBottle.glb", "envmaps/lebombo_1k.hdr"),
    ),
    relights=TUNE_RELIGHTS,
    report_items=(
        Item("cat", "assets/concrete_cat_statue.glb", GRASS),
        Item("can", "assets/can_rusted.glb", STUDIO),
        Item("mixer", "assets/Mixer.glb", GRASS),
        Item("chair", "assets/SchoolChair_01.glb", MOON),
        Item("blob-130", "procedural:130:blob", STUDIO),
        Item("bowl-131", "procedural:131:bowl", GRASS),
    ),
    report_relights=REPORT_RELIGHTS,
    options={"views": 48, "elevations": (15.0, 45.0), **SIZES},
    synthesize="relit.benchmark.photographed.synthesize_turntable_item",
    settings="relit.benchmark.photographed.turntable_settings",
)

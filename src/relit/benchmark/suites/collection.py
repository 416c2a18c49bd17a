"""Photos of one object in other places, under other lights, by other cameras."""

from __future__ import annotations

from relit.benchmark.suites.suite import REPORT_LIGHTS, REPORT_RELIGHTS, TUNE_RELIGHTS, Item, Suite

TUNE_LIGHTS = tuple(
    f"envmaps/{name}_1k.hdr"
    for name in (
        "adams_place_bridge",
        "empty_warehouse_01",
        "forest_slope",
        "immenstadter_horn",
        "kiara_1_dawn",
        "lebombo",
    )
)

CYCLES = {"renderer": "cycles", "test_spp": 96}
MITSUBA = {"renderer": "mitsuba"}
# Octant hints of which one in ten is wrong, things in front of one photo in five, any roll.
HARD = {"wrong_hints": 0.1, "occluders": 0.2, "roll": 180.0}
REPORT_ITEMS = (
    Item("cat", "assets/concrete_cat_statue.glb", REPORT_LIGHTS, MITSUBA),
    Item("pot", "assets/pot_enamel_01.glb", REPORT_LIGHTS, CYCLES),
    Item("mixer-hints", "assets/Mixer.glb", REPORT_LIGHTS, {**CYCLES, "wrong_hints": 0.1}),
    Item("crate-occluders", "assets/wooden_crate_02.glb", REPORT_LIGHTS, {"occluders": 0.2}),
    Item("chair-roll", "assets/SchoolChair_01.glb", REPORT_LIGHTS, {**CYCLES, "roll": 180.0}),
    Item("blob-150-hard", "procedural:150:blob", REPORT_LIGHTS, {**MITSUBA, **HARD}),
    Item("duck-6", "assets/rubber_duck_toy.glb", REPORT_LIGHTS, {**CYCLES, "views": 6}),
    Item("box-12", "assets/cardboard_box_01.glb", REPORT_LIGHTS, {**MITSUBA, "views": 12}),
    Item("bowl-151-12", "procedural:151:bowl", REPORT_LIGHTS, {**MITSUBA, "views": 12}),
)
COLLECTION = Suite(
    kind="collection",
    items=(
        Item("spot", "assets/spot/spot.obj", TUNE_LIGHTS, {"roughness": 0.4, "metallic": 0.0}),
        Item("boombox", "assets/BoomBox.glb", TUNE_LIGHTS),
        Item("stool", "assets/painted_wooden_stool_1k.glb", TUNE_LIGHTS),
    ),
    relights=TUNE_RELIGHTS,
    report_items=REPORT_ITEMS,
    report_relights=REPORT_RELIGHTS,
    options={
        "views": 60,
        "test_views": 6,
        "resolution": 400,
        "spp": 48,
        "test_spp": 192,
        "seed": 0,
    },
    synthesize="relit.synthesize.collection.synthesize_collection",
    evaluate="relit.evaluate.collection.evaluate_collection",
    bars={
        "seconds": ("<=", 1500.0),
        "peak_memory": ("<=", 4.0),
        "rotation_mean": ("<=", 3.0),
        "rotation_within_10": (">=", 95.0),
        "novel_psnr": (">=", 25.0),
        "albedo_psnr": (">=", 22.0),
    },
    ablations={
        name: (f"without={name}",)
        for name in (
            "multiplex",
            "search",
            "posterior",
            "coarse_to_fine",
            "quadrants",
            "light_prior",
        )
    },
)

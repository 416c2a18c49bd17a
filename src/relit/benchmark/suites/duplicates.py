"""One photo, or several, of a pile of identical objects."""

from __future__ import annotations

from relit.benchmark.suites.flash import TEA
from relit.benchmark.suites.multiview import GRASS, MITSUBA, MOON, STUDIO
from relit.benchmark.suites.suite import REPORT_RELIGHTS, TUNE_RELIGHTS, Item, Suite

SPOT_MATERIAL = {"roughness": 0.4, "metallic": 0.0}
CYCLES = {"renderer": "cycles", "spp": 48, "test_spp": 96}
REPORT_ITEMS = (
    Item("box-4", "assets/cardboard_box_01.glb", GRASS, {**MITSUBA, "count": 4}),
    Item("crate-12", "assets/wooden_crate_02.glb", STUDIO, {**CYCLES, "count": 12}),
    Item("duck-10", "assets/rubber_duck_toy.glb", GRASS, {**CYCLES, "count": 10}),  # a toy
    Item("mixer-8", "assets/Mixer.glb", STUDIO, {**CYCLES, "count": 8}),  # a tool, part mirror
    Item("vase-10", "assets/ceramic_vase_01.glb", GRASS, {**MITSUBA, "count": 10}),  # a bottle
    Item("can-20", "assets/can_rusted.glb", MOON, {**MITSUBA, "count": 20}),  # near revolution
    Item("fruit-160-16", "procedural:160:blob", STUDIO, {**CYCLES, "count": 16}),
    Item("bowl-161-30", "procedural:161:bowl", GRASS, {**MITSUBA, "count": 30}),
    Item("duck-60", "assets/rubber_duck_toy.glb", STUDIO, {**MITSUBA, "count": 60}),
    # Several photos of one pile; one object in several photos.
    Item("cat-6-photos-3", "assets/concrete_cat_statue.glb", GRASS, {"count": 6, "photos": 3}),
    Item("barrel-1-photos-8", "assets/barrel_03.glb", STUDIO, {**CYCLES, "count": 1, "photos": 8}),
)
DUPLICATES = Suite(
    kind="duplicates",
    items=(
        Item(
            "spot-10",
            "assets/spot/spot.obj",
            "envmaps/lebombo_1k.hdr",
            {"count": 10, **SPOT_MATERIAL},
        ),
        Item(
            "bottle-10", "assets/WaterBottle.glb", "envmaps/kiara_1_dawn_1k.hdr", {"count": 10}
        ),  # part metal
        Item(
            "cup-10",
            TEA,
            "envmaps/immenstadter_horn_1k.hdr",
            {"count": 10, "nodes": ["tea_set_01_cup_small_01"]},
        ),
        Item(
            "spot-6",
            "assets/spot/spot.obj",
            "envmaps/lebombo_1k.hdr",
            {"count": 6, **SPOT_MATERIAL},
        ),
        Item(
            "spot-20",
            "assets/spot/spot.obj",
            "envmaps/lebombo_1k.hdr",
            {"count": 20, **SPOT_MATERIAL},
        ),
        Item(
            "spot-30",
            "assets/spot/spot.obj",
            "envmaps/lebombo_1k.hdr",
            {"count": 30, **SPOT_MATERIAL},
        ),
        Item(
            "spot-60",
            "assets/spot/spot.obj",
            "envmaps/lebombo_1k.hdr",
            {"count": 60, **SPOT_MATERIAL},
        ),
    ),
    relights=TUNE_RELIGHTS,
    report_items=REPORT_ITEMS,
    report_relights=REPORT_RELIGHTS,
    options={
        "test_views": 8,
        "resolution": 1600,
        "test_resolution": 400,
        "spp": 64,
        "test_spp": 128,
        "seed": 0,
    },
    synthesize="relit.synthesize.duplicates.synthesize_duplicates",
    evaluate="relit.evaluate.duplicates.evaluate_duplicates",
    bars={
        "seconds": ("<=", 600.0),
        "peak_memory": ("<=", 4.0),
        "rotation_median": ("<=", 0.3),
        "registered": (">=", 95.0),
        "albedo_psnr": (">=", 20.0),
        "relit_psnr": (">=", 23.5),
        "roughness_mse": ("<=", 0.06),
        "environment_mse": ("<=", 0.05),
        "chamfer": ("<=", 0.03),
    },
    ablations={
        name: (f"without={name}",)
        for name in (
            *("rotation_sweep", "matching", "guided", "search", "refinement"),
            *(
                "textures",
                "symmetry",
                "visibility",
                "hidden",
                "unseen",
                "metal",
                "first_material",
                "ground",
                "normals",
            ),
        )
    },
)

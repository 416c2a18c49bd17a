"""Objects photographed from all around under one light, with masks and cameras."""

from __future__ import annotations

from relit.benchmark.suites.suite import (
    REPORT_LIGHTS,
    REPORT_RELIGHTS,
    TUNE_RELIGHTS,
    Item,
    Suite,
)

STUDIO, GRASS, NIGHT, MOON = REPORT_LIGHTS
# Cycles takes 4 to 8 s a picture of 400 x 400 on 2 cores. Its truth has 128 samples a pixel, so
# that an object takes about 15 minutes; the ceiling includes the noise.
CYCLES = {"renderer": "cycles", "spp": 48, "test_spp": 128}
MITSUBA = {"renderer": "mitsuba"}
REPORT_ITEMS = (
    Item("cat", "assets/concrete_cat_statue.glb", GRASS, MITSUBA),  # matte
    Item("box", "assets/cardboard_box_01.glb", STUDIO, CYCLES),  # matte
    Item("crate", "assets/wooden_crate_02.glb", NIGHT, MITSUBA),  # matte, metal fittings
    Item("vase", "assets/ceramic_vase_01.glb", STUDIO, CYCLES),  # white gloss without texture
    Item("pot", "assets/pot_enamel_01.glb", MOON, MITSUBA),  # dark gloss
    Item("television", "assets/Television_01.glb", GRASS, CYCLES),  # dark glossy screen
    Item("goblet", "assets/brass_goblet1.glb", STUDIO, CYCLES),  # polished metal
    Item("airduct", "assets/airduct_round_corner.glb", GRASS, MITSUBA),  # rough metal
    Item("mixer", "assets/Mixer.glb", NIGHT, CYCLES),  # mirror and enamel
    Item("chair", "assets/SchoolChair_01.glb", GRASS, CYCLES),  # thin chrome legs
    # Gloss does not follow colour in what follows.
    Item("blob-100", "procedural:100:blob", MOON, MITSUBA),
    Item("bowl-101", "procedural:101:bowl", STUDIO, CYCLES),  # concave, with contents
    Item("thin-102", "procedural:102:thin", NIGHT, MITSUBA),
    Item("metal-103", "procedural:103:metal", GRASS, MITSUBA),
    Item("gloss-104", "procedural:104:gloss", STUDIO, CYCLES),
    Item("bowl-106", "procedural:106:bowl", GRASS, MITSUBA),
)

MULTIVIEW = Suite(
    kind="multiview",
    items=(
        Item(
            "spot",
            "assets/spot/spot.obj",
            "envmaps/lebombo_1k.hdr",
            {"roughness": 0.4, "metallic": 0.0},
        ),
        Item("boombox", "assets/BoomBox.glb", "envmaps/kiara_1_dawn_1k.hdr"),
        Item(
            "stool", "assets/painted_wooden_stool_1k.glb", "envmaps/immenstadter_horn_1k.hdr"
        ),  # a sun of 7040
    ),
    relights=TUNE_RELIGHTS,
    report_items=REPORT_ITEMS,
    report_relights=REPORT_RELIGHTS,
    options={
        "views": 60,
        "test_views": 12,
        "resolution": 400,
        "spp": 64,
        "test_spp": 256,
        "seed": 0,
    },
    bars={
        "seconds": ("<=", 360.0),
        "peak_memory": ("<=", 4.0),
        "novel_psnr": (">=", 32.0),
        "relit_psnr": (">=", 31.0),
        "albedo_psnr": (">=", 26.0),
        "normal_mae": ("<=", 8.0),
        "chamfer_percent": ("<=", 0.5),
        "glb_roundtrip_psnr": (">=", 35.0),
    },
    draft_bars={"seconds": ("<=", 90.0), "peak_memory": ("<=", 4.0)},
    ablations={
        "hull": ("levels=128", "level_steps=0"),  # the shape is the visual hull of the masks
        "interreflection": ("without=interreflection",),
        "exchange": ("without=exchange",),
        "material_prior": ("without=material_prior",),
        "colour_smoothing": ("without=colour_smoothing",),
        "light_prior": ("without=light_prior",),
        "white": ("without=white",),
        "parsimony": ("without=parsimony",),
        "normal_map": ("without=normal_map",),
        "first_material": ("without=first_material",),
        "priors": ("without=material_prior,colour_smoothing,light_prior",),
    },
)

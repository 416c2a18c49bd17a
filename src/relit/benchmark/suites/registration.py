"""Poses of piles alone, of objects that no setting was chosen on (`benchmark.splits`): textured,
plain, near to bodies of revolution, thin, glossy, metal. The lights are those of the tune split:
poses alone are measured."""

from __future__ import annotations

from relit.benchmark.suites.suite import Item, Suite

REGISTRATION = Suite(
    kind="duplicates",
    items=(),
    report_items=tuple(
        Item(f"{name}-{count}", asset, f"envmaps/{light}_1k.hdr", {"count": count, "seed": seed})
        for seed, (name, asset, light, count) in enumerate(
            (
                ("blob103", "procedural:103:blob", "lebombo", 6),
                ("cat", "assets/concrete_cat_statue.glb", "kiara_1_dawn", 6),
                ("duck", "assets/rubber_duck_toy.glb", "immenstadter_horn", 6),
                ("can", "assets/can_rusted.glb", "forest_slope", 6),
                ("vase", "assets/ceramic_vase_01.glb", "adams_place_bridge", 6),
                ("crate", "assets/wooden_crate_02.glb", "empty_warehouse_01", 6),
                ("gloss106", "procedural:106:gloss", "lebombo", 6),
                ("metal105", "procedural:105:metal", "kiara_1_dawn", 6),
                ("thin104", "procedural:104:thin", "forest_slope", 6),
                ("goblet", "assets/brass_goblet1.glb", "adams_place_bridge", 6),
                ("blob110", "procedural:110:blob", "immenstadter_horn", 10),
                ("gloss111", "procedural:111:gloss", "empty_warehouse_01", 10),
                ("cat", "assets/concrete_cat_statue.glb", "lebombo", 10),
                ("barrel", "assets/barrel_03.glb", "kiara_1_dawn", 10),
                ("blob112", "procedural:112:blob", "forest_slope", 20),
                ("cat", "assets/concrete_cat_statue.glb", "adams_place_bridge", 20),
            )
        )
    ),
    options={
        "test_views": 1,
        "resolution": 800,
        "test_resolution": 32,
        "spp": 48,
        "test_spp": 1,
    },
    synthesize="relit.synthesize.duplicates.synthesize_duplicates",
    evaluate="relit.evaluate.registration.evaluate_registration",
    flags=("--until=poses", "--force"),
    bars={
        "rotation_median": ("<=", 1.5),
        "determined_sure": (">=", 95.0),
        "undetermined_unsure": (">=", 90.0),
        "wrong_sure": ("<=", 1.0),
    },
    draft_bars={"wrong_sure": ("<=", 1.0)},
)

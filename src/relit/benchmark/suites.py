"""The suites: what is rendered, how it is reconstructed and scored, the bars of its means, its
named ablations.

A suite of another capture kind is one entry of SUITES, most readably from a module of its own that
only holds it.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

Bar = tuple[str, float]  # ('>=' or '<=', value)


@dataclass(frozen=True)
class Item:
    """One object of a suite. asset: file relative to the data folder, or procedural:SEED[:KIND]. light: one such file, or
    several (photos under many lights, ...).
    options: what goes to the synthesizer for this object alone, before the suite's own options."""

    name: str
    asset: str
    light: str | tuple[str, ...]
    options: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Suite:
    """kind: as `relit reconstruct --capture` knows it. relights: lights, relative to the data
    folder, for the truth of relighting.

    options: keyword arguments of the synthesizer, for all objects.
    synthesize: 'module.function', called as f(asset, light, out, relights=[...], **options,
    say=...) -> capture folder; several lights come as a list. Beside it in its module stands
    settings_of(asset, light, relights=[...], **options): everything that the capture depends on,
    whose hash names the folder in the cache.
    evaluate: 'module.function', called as f(run, capture, spp=...) -> {"metrics": {name: {"value",
    "unit", "definition"}}, ...}.
    bars: of the means at quality standard, figure -> bar; draft_bars: at draft.
    flags: words added to every `relit reconstruct` of the suite.
    ablations: name -> words for `relit reconstruct`: each is 'key=value' (a --set) or a flag such
    as '--masks=none'.
    """

    kind: str
    items: tuple[Item, ...]
    relights: tuple[str, ...] = ()
    options: Mapping[str, Any] = field(default_factory=dict)
    synthesize: str = "relit.synthesize.multiview.synthesize_multiview"
    evaluate: str = "relit.evaluate.dispatch.evaluate"
    bars: Mapping[str, Bar] = field(default_factory=dict)
    draft_bars: Mapping[str, Bar] = field(default_factory=dict)
    flags: tuple[str, ...] = ()
    ablations: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def bar(self, figure: str, quality: str) -> Bar | None:
        """The bar of a figure at a quality, or None."""
        return {"standard": self.bars, "draft": self.draft_bars}.get(quality, {}).get(figure)


def function_at(path: str) -> Callable:
    """The function 'module.function'."""
    module, _, function = path.rpartition(".")
    return getattr(importlib.import_module(module), function)


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
    relights=("envmaps/adams_place_bridge_1k.hdr", "envmaps/forest_slope_1k.hdr"),
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

TEA = "assets/tea_set_01_1k.glb"
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

LIGHTS = tuple(
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
COLLECTION = Suite(
    kind="collection",
    items=(
        Item("spot", "assets/spot/spot.obj", LIGHTS, {"roughness": 0.4, "metallic": 0.0}),
        Item("boombox", "assets/BoomBox.glb", LIGHTS),
        Item("stool", "assets/painted_wooden_stool_1k.glb", LIGHTS),
    ),
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

SPOT_MATERIAL = {"roughness": 0.4, "metallic": 0.0}
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
    relights=("envmaps/adams_place_bridge_1k.hdr", "envmaps/forest_slope_1k.hdr"),
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

# poses alone, of objects that no setting was chosen on (benchmark/splits.py): textured, plain, near
# to bodies of revolution, thin, glossy, metal
REGISTRATION = Suite(
    kind="duplicates",
    items=tuple(
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

SUITES: dict[str, Suite] = {
    "multiview": MULTIVIEW,
    "flash": FLASH,
    "collection": COLLECTION,
    "duplicates": DUPLICATES,
    "registration": REGISTRATION,
}

"""What settings may be chosen on, and what results are reported on: the only place that says so.

Procedural objects are `procedural:SEED[:KIND]` (synthesize/objects.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from relit.synthesize.objects import object_spec


@dataclass(frozen=True)
class Split:
    """name: 'tune' or 'report'. assets: files relative to the data folder. seeds: of procedural
    objects."""

    name: str
    assets: tuple[str, ...]
    seeds: range


TUNE = Split(
    "tune",
    (
        "assets/BoomBox.glb",
        "assets/WaterBottle.glb",
        "assets/tea_set_01_1k.glb",
        "assets/painted_wooden_stool_1k.glb",
        "assets/painted_wooden_cabinet_1k.glb",
        "assets/spot/spot.obj",
        "assets/bob/bob_tri.obj",
    ),
    range(0, 100),
)
REPORT = Split(
    "report",
    (
        "assets/brass_goblet1.glb",
        "assets/airduct_round_corner.glb",
        "assets/Mixer.glb",
        "assets/barrel_03.glb",
        "assets/Television_01.glb",
        "assets/pot_enamel_01.glb",
        "assets/concrete_cat_statue.glb",
        "assets/cardboard_box_01.glb",
        "assets/SchoolChair_01.glb",
        "assets/ceramic_vase_01.glb",
        "assets/jug_01.glb",
        "assets/can_rusted.glb",
        "assets/rubber_duck_toy.glb",
        "assets/wooden_crate_02.glb",
    ),
    range(100, 2**31),
)
SPLITS = (TUNE, REPORT)
SPLIT_NAMES = tuple(split.name for split in SPLITS)


def split_of(asset: str | Path) -> Split | None:
    """The split of an asset by its file's name or its seed, None for an object of neither."""
    name = PurePosixPath(asset).name
    spec = object_spec(name)
    for split in SPLITS:
        if spec is not None and spec.seed in split.seeds:
            return split
        if spec is None and name in {PurePosixPath(a).name for a in split.assets}:
            return split
    return None

"""Multi-view captures through the whole model of a phone's camera, with the masks of a segmenter:
exposure, white balance, response, lens, noise, blur, JPEG and EXIF differ from photo to photo."""

from __future__ import annotations

from relit.benchmark.suites.multiview import CYCLES, GRASS, MITSUBA, MOON, STUDIO
from relit.benchmark.suites.suite import REPORT_RELIGHTS, TUNE_RELIGHTS, Item, Suite

UNPOSED = {"cameras": False}  # cameras are found from the photos
PHONE = Suite(
    kind="multiview",
    items=(
        Item("boombox", "assets/BoomBox.glb", "envmaps/kiara_1_dawn_1k.hdr"),
        Item("stool", "assets/painted_wooden_stool_1k.glb", "envmaps/lebombo_1k.hdr", UNPOSED),
    ),
    relights=TUNE_RELIGHTS,
    report_items=(
        Item("can", "assets/can_rusted.glb", GRASS, {**MITSUBA, **UNPOSED}),
        Item("pot", "assets/pot_enamel_01.glb", STUDIO, CYCLES),
        Item("airduct", "assets/airduct_round_corner.glb", MOON, MITSUBA),
        Item("mixer", "assets/Mixer.glb", GRASS, CYCLES),
        Item("blob-110", "procedural:110:blob", STUDIO, MITSUBA),
        Item("bowl-111", "procedural:111:bowl", GRASS, {**CYCLES, **UNPOSED}),
    ),
    report_relights=REPORT_RELIGHTS,
    options={
        "views": 60,
        "test_views": 12,
        "resolution": 400,
        "spp": 64,
        "test_spp": 256,
        "seed": 0,
        "camera_model": "phone",
        "mask_errors": "segmenter",
    },
    synthesize="relit.benchmark.photographed.synthesize_phone",
    settings="relit.benchmark.photographed.phone_settings",
)

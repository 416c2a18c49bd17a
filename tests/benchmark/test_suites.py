"""What the suites are made of: objects and lights of each split, renderers, kinds of material."""

from pathlib import Path

import pytest

from relit.benchmark.splits import REPORT, TUNE, split_of
from relit.benchmark.suites import SUITES

LIGHTS_OF = {split: set() for split in ("tune", "report")}
for _name, _suite in SUITES.items():
    if _name == "registration":  # poses alone, by the lights of the tune split
        continue
    for _split, _lights in LIGHTS_OF.items():
        for _item in _suite.items_of(_split):
            _lights |= {_item.light} if isinstance(_item.light, str) else {*_item.light}
        _lights |= {*_suite.relights_of(_split)}


@pytest.mark.parametrize("name", SUITES)
def test_objects_are_of_their_split(name):
    suite = SUITES[name]
    for split in (TUNE, REPORT):
        items = suite.items_of(split.name)
        if name != "registration" or split is REPORT:
            assert items
        assert len({i.name for i in items}) == len(items)
        for item in items:
            assert split_of(item.asset) is split, item


def test_no_light_of_the_report_was_tuned_on():
    assert LIGHTS_OF["report"] and not LIGHTS_OF["report"] & LIGHTS_OF["tune"]


@pytest.mark.parametrize("name", SUITES)
def test_relighting_is_by_other_lights_than_the_photos(name):
    suite = SUITES[name]
    for split in ("tune", "report") if name != "collection" else ("report",):
        for item in suite.items_of(split):
            own = {item.light} if isinstance(item.light, str) else {*item.light}
            assert not own & {*suite.relights_of(split)}, item


def test_a_third_of_the_scenes_is_rendered_by_cycles():
    for name in ("multiview", "phone", "collection", "duplicates"):
        items = SUITES[name].report_items
        by_cycles = [i for i in items if i.options.get("renderer") == "cycles"]
        assert 3 * len(by_cycles) >= len(items), name
    for item in SUITES["multiview"].report_items:  # none by the package's own BRDF
        assert item.options["renderer"] in ("cycles", "mitsuba")


def test_the_report_covers_what_the_suites_promise():
    items = SUITES["multiview"].report_items
    assert len(items) >= 10
    assert {"bowl", "thin", "metal", "gloss"} <= {i.asset.split(":")[-1] for i in items}
    counts = {i.options["count"] for i in SUITES["duplicates"].report_items}
    assert min(c for c in counts if c > 1) == 4 and max(counts) == 60
    assert {i.options.get("photos", 1) for i in SUITES["duplicates"].report_items} > {1, 3}
    views = {i.options.get("views", 60) for i in SUITES["collection"].report_items}
    assert views == {6, 12, 60}
    ambient = {i.options.get("ambient", 0.0) for i in SUITES["flash"].report_items}
    assert ambient == {0.0, 0.05, 0.2}


def test_the_assets_are_in_the_data():
    data = next(
        (
            p / "shared" / "data"
            for p in Path(__file__).resolve().parents
            if (p / "shared").is_dir()
        ),
        None,
    )
    if data is None:
        pytest.skip("the folder of third-party data, shared/data, is absent")
    for suite in SUITES.values():
        for split in ("tune", "report"):
            files = [i.asset for i in suite.items_of(split) if not i.asset.startswith("procedural")]
            assert all((data / f).is_file() for f in (*files, *suite.relights_of(split)))
    assert all((data / f).is_file() for lights in LIGHTS_OF.values() for f in lights)

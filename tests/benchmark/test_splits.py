"""The split into objects that settings are chosen on and objects that are reported."""

import pytest

from relit.benchmark.runner import data_folder
from relit.benchmark.splits import REPORT, SPLITS, TUNE, split_of
from relit.errors import UserError


def test_no_object_is_in_both_splits():
    assert not set(TUNE.assets) & set(REPORT.assets)
    assert len(TUNE.assets) == 7 and len(REPORT.assets) == 14
    assert TUNE.seeds.stop <= REPORT.seeds.start
    for split in SPLITS:
        assert all(split_of(asset) is split for asset in split.assets)


def test_seeds_decide_for_procedural_objects():
    assert split_of("procedural:0") is TUNE and split_of("procedural:99:bowl") is TUNE
    assert split_of("procedural:100:thin") is REPORT
    assert split_of("mine.glb") is None


def test_every_asset_of_the_data_folder_is_in_a_split():
    try:
        data = data_folder()
    except UserError:
        pytest.skip("no third-party data")
    files = {p.relative_to(data).as_posix() for p in data.glob("assets/**/*")}
    assert {a for split in SPLITS for a in split.assets} == {
        f for f in files if f.endswith((".glb", ".obj"))
    }

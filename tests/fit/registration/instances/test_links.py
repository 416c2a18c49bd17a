"""Sets that matching has linked are begun from whole where their silhouettes and paint bear the
links out."""

from __future__ import annotations

import numpy as np
import pytest

from relit.conventions import similarity
from relit.fit.registration.instances import links as instance_links
from relit.fit.registration.instances.links import verified_links
from relit.fit.registration.instances.options import DETAILED, Growth
from relit.fit.registration.instances.views import instance_crops
from relit.fit.registration.register import crop_rings
from relit.geometry.se3 import exp_so3
from support.painted_ellipsoid import painted

SMALL = Growth(nodes=28, steps=50, viewpoints=300, keep=3)
HALF = similarity(exp_so3(np.array([0, np.pi, 0])), np.zeros(3))


@pytest.fixture(scope="module")
def linked():
    """Five views of a painted body that look from 0 to 120 degrees, and their poses."""
    return painted([0, 30, 60, 90, 120])


def asked(views, poses, members):
    crops = instance_crops(views)
    return verified_links(
        views, crops, crop_rings(crops, DETAILED), DETAILED, (members, poses), (), SMALL, 0
    )


@pytest.mark.slow
def test_a_set_whose_members_lead_is_kept_whole(linked):
    views, poses = linked
    members, same = asked(views, poses, [0, 1, 2, 3, 4])
    assert members == [0, 1, 2, 3, 4] and same is poses


@pytest.mark.slow
def test_of_a_set_of_which_some_are_half_a_turn_off_the_first_link_is_left(linked):
    views, poses = linked
    wrong = poses.copy()
    wrong[2:4] = HALF @ poses[2:4]
    members, _ = asked(views, wrong, [0, 1, 2, 3, 4])
    assert members == [0, 1]


def test_most_of_them_decide_and_a_pair_is_not_asked(linked, monkeypatch):
    views, poses = linked
    some: set[int] = set()
    monkeypatch.setattr(
        instance_links, "leads_there", lambda v, c, r, p, linked, k, links, o, seed: k in some
    )
    for some in ({0, 1, 2}, {0, 1}):
        assert asked(views, poses, [0, 1, 2, 3, 4])[0] == (
            [0, 1, 2, 3, 4] if len(some) == 3 else [0, 1]
        )
    some = set()
    assert asked(views, poses, [3, 4])[0] == [3, 4]
    monkeypatch.setattr(instance_links, "ASKED", 2)
    some = {0, 1, 2, 3, 4}
    assert asked(views, poses, [0, 1, 2, 3, 4])[0] == [0, 1, 2, 3, 4]

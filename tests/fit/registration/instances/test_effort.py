"""A search ends with the best that it has when its effort is spent."""

import numpy as np
import pytest

from relit.conventions import similarity
from relit.fit.registration.instances.options import Effort, Growth, Search
from relit.fit.registration.instances.regrowth import Placed, improved


def test_work_is_counted_in_fits_of_a_hundred_steps():
    effort = Effort(2.0)
    effort.spend(150)
    assert effort.spent == 1.5 and not effort.over
    effort.spend(50)
    assert effort.over and not Effort().over


def test_growth_and_search_count_on_one_effort():
    effort = Effort(1.0)
    o = Search(growth=Growth(effort=effort))
    o.effort.spend(100)
    assert o.growth.effort.over and o.effort is effort


def test_nothing_is_grown_again_once_the_effort_is_spent():
    effort = Effort(1.0)
    o = Search(growth=Growth(effort=effort))
    poses = np.tile(similarity(np.eye(3), [0, 0, -5]), (6, 1, 1))
    unsure = Placed(poses, np.full(6, 0.8), (0, 1), (2, 3, 4, 5), (1.0,))
    with pytest.raises(AttributeError):  # these views cannot be grown
        improved([None] * 6, None, None, unsure, o, seed=0)
    effort.spend(100)
    assert improved([None] * 6, None, None, unsure, o, seed=0) is unsure

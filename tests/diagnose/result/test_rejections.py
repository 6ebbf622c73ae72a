"""Tables of the effects that were examined and not named."""

from __future__ import annotations

import numpy as np

from gyrostab.diagnose.identify.selections import Selection
from gyrostab.diagnose.result.rejections import Rejection, find_unsupported, rejected_tables


def test_rejected_effects_are_listed_from_the_closest_on_and_impossible_ones_last():
    nats = {"shupe": 5.0, "earth_rate": np.nan, "warm_up": 1.0}
    rejected = [Rejection(name, ("x",), "noise", value) for name, value in nats.items()]
    tables = rejected_tables(rejected)
    assert [table["name"] for table in tables] == ["warm_up", "shupe", "earth_rate"]


def test_an_effect_that_is_dropped_for_its_size_is_rejected_with_a_size_of_zero():
    kept = Selection("shupe", (), ("x",), (), 20.0, 8.0)
    dropped = Selection("warm_up", (), ("z",), (), 20.0, 8.0)
    (rejection,) = find_unsupported([kept, dropped], [kept])
    assert rejection[:3] == ("warm_up", ("z",), "a size of zero")
    assert np.isnan(rejection.nats)

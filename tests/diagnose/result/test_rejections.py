"""Tables of the effects that were examined and not named."""

from __future__ import annotations

import numpy as np

from gyrostab.diagnose.result.rejections import Rejection, rejected_tables


def test_rejected_effects_are_listed_from_the_closest_on_and_impossible_ones_last():
    nats = {"shupe": 5.0, "earth_rate": np.nan, "warm_up": 1.0}
    rejected = [Rejection(name, ("x",), "noise", value) for name, value in nats.items()]
    tables = rejected_tables(rejected)
    assert [table["name"] for table in tables] == ["warm_up", "shupe", "earth_rate"]

"""A filter of the logger is one for all axes."""

from __future__ import annotations

import numpy as np
import pytest

from gyrostab.diagnose.calibration.baseline import calibrate
from gyrostab.diagnose.effects.candidates import effect_candidates
from gyrostab.diagnose.effects.cells import begin_state
from gyrostab.diagnose.effects.search import gains
from gyrostab.diagnose.gains.folds import fold_blocks
from gyrostab.diagnose.naming.filters import on_all_axes
from gyrostab.diagnose.naming.parts import by_key, gain_sum
from gyrostab.diagnose.naming.structure import possible
from gyrostab.diagnose.reduction.reduced import reduce_log
from gyrostab.log import make_log


@pytest.mark.parametrize(
    ("late", "one_filter"), [((0.1, 0.1, 0.1), True), ((0.1,), True), ((0.0, 0.0, 0.15), False), ((0.15, 0.15, 0.0), False)]
)
def test_a_filter_that_other_axes_deny_is_none_of_the_logger(late, one_filter):
    """So much of every sample comes with the next: one law for a logger, and a noise of their own for axes of which one has none of it."""
    share = np.array(late)[:, None]
    raw = np.random.default_rng(5).standard_normal((share.size, 18_001))
    reduced = reduce_log(make_log((1.0 - share) * raw[:, 1:] + share * raw[:, :-1], rate=10.0, unit="deg/h"))
    baseline = calibrate(reduced)
    filters = [one for one in effect_candidates(reduced, baseline["coefficient"])[0] if one.effect == "logger_filter"]
    state = begin_state(reduced, baseline)
    parts = by_key(gains(filters, reduced, state, fold_blocks(reduced)))["logger_filter"]
    assert gain_sum(parts) > 10.0
    assert on_all_axes(parts, state) == one_filter
    assert possible(parts, state) == (parts if one_filter else [])

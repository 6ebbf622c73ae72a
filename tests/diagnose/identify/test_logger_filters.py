"""A filter of the logger is the same for all axes."""

from __future__ import annotations

import numpy as np
import pytest

from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.identify.components import sum_evidence
from gyrostab.diagnose.identify.identifiability import keep_physical
from gyrostab.diagnose.predict.linear_model import initial_state
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.statistics.build_candidates import effect_candidates
from gyrostab.ingest.make_log import make_log
from tests.support.candidates import find_components, winning_forms


@pytest.mark.parametrize(
    ("late", "one_filter"),
    [
        ((0.1, 0.1, 0.1), True),
        pytest.param((0.1,), True, marks=pytest.mark.full),
        ((0.0, 0.0, 0.15), False),
        pytest.param((0.15, 0.15, 0.0), False, marks=pytest.mark.full),
    ],
)
def test_filter_must_fit_all_axes(late, one_filter):
    """Neighbouring samples are correlated: on all axes for a logger, or on one axis only."""
    share = np.array(late)[:, None]
    raw = np.random.default_rng(5).standard_normal((share.size, 18_001))
    blocks = reduce_log(
        make_log((1.0 - share) * raw[:, 1:] + share * raw[:, :-1], rate=10.0, unit="deg/h")
    )
    baseline = calibrate_noise(blocks)
    filters = [
        candidate
        for candidate in effect_candidates(blocks, baseline["coefficient"])[0]
        if candidate.effect == "logger_filter"
    ]
    state = initial_state(blocks, baseline)
    components = find_components(filters, state)["logger_filter"]
    assert sum_evidence(components) > 10.0
    assert ("a filter on each axis" not in winning_forms(components, state)) == one_filter
    assert keep_physical(components, state)[0] == (components if one_filter else [])

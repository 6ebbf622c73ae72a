"""A filter of the logger is the same for all axes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import butter, lfilter

from gyrostab.arrays import Floats
from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.identify.components import sum_evidence
from gyrostab.diagnose.identify.identifiability import keep_physical
from gyrostab.diagnose.predict.candidates import Component
from gyrostab.diagnose.predict.linear_model import State, initial_state
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.diagnose.statistics.build_candidates import effect_candidates
from gyrostab.ingest.make_log import make_log
from tests.support.candidates import find_components, winning_forms


def _find_filter(rates: Floats) -> tuple[list[Component], State]:
    """Return the components of a filter in the noise of a log at 10 Hz, and the state."""
    blocks = reduce_log(make_log(rates, rate=10.0, unit="deg/h"))
    baseline = calibrate_noise(blocks)
    filters = [
        candidate
        for candidate in effect_candidates(blocks, baseline["coefficient"])[0]
        if candidate.effect == "logger_filter"
    ]
    state = initial_state(blocks, baseline)
    components = find_components(filters, state)["logger_filter"]
    assert sum_evidence(components) > 10.0
    return components, state


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
    components, state = _find_filter((1.0 - share) * raw[:, 1:] + share * raw[:, :-1])
    assert ("a filter on each axis" not in winning_forms(components, state)) == one_filter
    assert keep_physical(components, state)[0] == (components if one_filter else [])


def test_a_filter_stops_noise_and_does_not_add_any():
    """Noise with less power at low frequencies has the form of a low-pass of a negative share."""
    raw = np.random.default_rng(6).standard_normal((2, 3, 18_000))
    fast = lfilter(*butter(1, 1.0, "highpass", fs=10.0), raw[1])
    components, state = _find_filter(raw[0] + fast)
    remaining, (form, nats) = keep_physical(components, state)
    assert (remaining, form) == ([], "an impossible size")
    assert np.isnan(nats)

"""A log through a logger's filter: the filter is the effect, the noise is that without it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from gyrostab.diagnose.core import diagnose
from gyrostab.ingest.make_log import make_log

RATE, CUTOFF, OVERSAMPLING = 10.0, 1.0, 10


@pytest.mark.full
def test_filter_is_identified_with_its_cutoff_and_the_noise_without_it() -> None:
    """Four seeds give cutoffs of 0.95 to 1.03 Hz, and N within 5 %."""
    fine = np.random.default_rng(2).standard_normal((2, 9000 * OVERSAMPLING))
    pole = np.exp(-2.0 * np.pi * CUTOFF / RATE / OVERSAMPLING)
    rates = lfilter([1.0 - pole], [1.0, -pole], fine, axis=1)[:, ::OVERSAMPLING]
    diagnosis = diagnose(make_log(rates, rate=RATE, unit="deg/h"), nulls=100)
    (effect,) = diagnosis.effects
    assert (effect["name"], effect["axes"]) == ("logger_filter", ["x", "y"])
    cutoff = effect["parameters"]["cutoff"]
    assert cutoff["low"] <= CUTOFF <= cutoff["high"] < 1.3 * cutoff["low"]
    for axis in "xy":
        white = 1.0 / np.sqrt(RATE * OVERSAMPLING * 3600.0)  # of the samples before the filter
        assert diagnosis.model["noise"][axis]["N"] == pytest.approx(white, rel=0.1)

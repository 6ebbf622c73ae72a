"""The noise of a record behind a logger's filter is calibrated as that of the instrument."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from scipy.signal import lfilter

from gyrostab.diagnose.baseline.calibrate import calibrate_noise
from gyrostab.diagnose.estimate.joint_fit import fit_identifications
from gyrostab.diagnose.reduce.block_statistics import reduce_log
from gyrostab.ingest.make_log import make_log
from gyrostab.units import HOUR
from tests.support.named import name_effects, nulls
from tests.support.repetitions import first_of

RATE, N = 20.0, 0.05


def filtered_blocks(
    numerator: list[float], denominator: list[float], seed: int, size: int = 24_000
) -> xr.Dataset:
    """Pass white noise of two axes, N and 1.1 N, through a filter at the rate of the log."""
    raw = np.random.default_rng(seed).standard_normal((2, size + 200))
    white = N * np.sqrt(HOUR * RATE) * np.array([[1.0], [1.1]]) * raw
    rates = lfilter(numerator, denominator, white, axis=1)[:, 200:]
    return reduce_log(make_log(rates, rate=RATE, unit="deg/h"))


@pytest.mark.slow
@pytest.mark.parametrize("seed", first_of(1, 2, 3))
@pytest.mark.parametrize(
    "taps", [2, 8, *(pytest.param(taps, marks=pytest.mark.full) for taps in (1, 3, 4))]
)
def test_noise_behind_an_average_is_that_of_the_instrument(taps: int, seed: int) -> None:
    baseline = calibrate_noise(filtered_blocks([1.0 / taps] * taps, [1.0], seed))
    coefficient = baseline["coefficient"]
    assert coefficient.sel(term="N").values == pytest.approx([N, 1.1 * N], rel=0.03)
    assert (coefficient.sel(term="K").values < 1.0).all()  # 2.3 with the slope of the average in K
    assert not baseline.attrs["slow_noise_apart"]


@pytest.mark.parametrize("seed", first_of(1, 2, 3))
def test_noise_behind_a_low_pass_is_that_of_the_instrument(seed: int) -> None:
    baseline = calibrate_noise(filtered_blocks([0.4], [1.0, -0.6], seed))
    assert baseline["coefficient"].sel(term="N").values == pytest.approx([N, 1.1 * N], rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("taps", "seed"),
    [
        pytest.param(2, 4, marks=pytest.mark.full),
        pytest.param(3, 4, marks=pytest.mark.full),
        pytest.param(4, 5, marks=pytest.mark.full),
        (8, 4),
    ],
)
def test_average_is_named_with_its_length(taps: int, seed: int) -> None:
    """A low-pass of one pole at a quarter of the rate is the average of two samples."""
    blocks = filtered_blocks([1.0 / taps] * taps, [1.0], seed, size=9_000)
    baseline, records = nulls(blocks, 10)
    identifications = name_effects(blocks, baseline, records)
    assert not identifications.unidentified
    (fitted,) = (
        fitted
        for fitted in fit_identifications(identifications, baseline)
        if fitted.identification.effect == "logger_filter"
    )
    assert fitted.identification.axes == ("x", "y")
    if "cutoff" in fitted.parameters:
        assert taps == 2
        assert fitted.parameters["cutoff"].low < RATE / 4.0 < fitted.parameters["cutoff"].high
    else:
        assert fitted.parameters["length"].value == pytest.approx(taps / RATE)


def test_hump_in_the_spectrum_is_not_taken_for_a_filter() -> None:
    """A resonance of one axis has no filter in common with the other."""
    rng = np.random.default_rng(6)
    raw = N * np.sqrt(HOUR * RATE) * rng.standard_normal((2, 24_000))
    hump = lfilter([1.0], [1.0, -1.2, 0.9], raw[:1], axis=1)
    baseline = calibrate_noise(
        reduce_log(make_log(np.concatenate([raw[1:], raw[1:] + hump]), rate=RATE, unit="deg/h"))
    )
    assert baseline["coefficient"].sel(axis="x", term="N").item() == pytest.approx(N, rel=0.03)

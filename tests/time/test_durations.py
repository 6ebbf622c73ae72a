"""Averaging times and durations of any size: an answer or a clear error."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st

from gyrostab.errors import OptionError
from gyrostab.time.durations import averaging_factors, duration_seconds, format_duration, samples


@given(window=st.integers(2, 3000), taus=st.integers(1, 10**20))
def test_averaging_factors_are_rising_and_fit_the_window(window, taus):
    factors = averaging_factors(taus, rate=100.0, window=window)
    assert factors[0] == 1
    assert (np.diff(factors) > 0).all()
    assert factors[-1] <= max(1, window // 3)
    assert factors.size <= taus


@given(window=st.integers(6, 2000), excess=st.floats(0.0, 3.0))
def test_enough_averaging_times_are_all_of_them(window, excess):
    """The spacing in log falls below half a sample where the shortcut begins."""
    limit = window // 3
    count = int((2 * limit * np.log(limit) + 2) * (1 + excess)) + 1
    spaced = np.unique(np.round(np.geomspace(1, limit, count)).astype(int))
    np.testing.assert_array_equal(averaging_factors(count, rate=1.0, window=window), spaced)
    np.testing.assert_array_equal(spaced, np.arange(1, limit + 1))


@pytest.mark.parametrize("text", ["1" + "0" * 400, "9" * 5000, "²", "٣", "1" + "0" * 400 + "s"])
def test_numbers_of_any_length_are_refused_clearly(text):
    with pytest.raises(OptionError):
        averaging_factors(text, rate=100.0, window=1000)
    with pytest.raises(OptionError):
        samples(text, 100.0, "window")


@pytest.mark.parametrize("value", ["9" * 5000 + "samples", 10**400, "1e400s", float("inf")])
def test_lengths_out_of_range_are_refused_clearly(value):
    with pytest.raises(OptionError):
        samples(value, 100.0, "window")
    with pytest.raises(OptionError):
        duration_seconds(value, "window")


def test_averaging_times_that_rounding_changes_have_a_warning():
    with pytest.warns(UserWarning, match="at 50 Hz: '0.013s' to 0.02 s, '0.03s' to 0.04 s"):
        factors = averaging_factors("0.013s,0.03s,0.05s,1s", rate=50.0, window=1000)
    assert factors.tolist() == [1, 2, 50]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert averaging_factors("0.0195s,0.07s", rate=50.0, window=1000).tolist() == [1, 4]


def test_printed_averaging_times_are_found_again():
    """Messages print six digits of an averaging time."""
    for factor in (7, 10, 242, 3333):
        tau = f"{factor / 300.0:g}s"
        assert averaging_factors("all", rate=300.0, window=10_000, tau_max=tau)[-1] == factor


def test_half_of_a_long_window_fits_as_longest_averaging_time():
    """The error of printed digits is several samples here, and must not lengthen the limit."""
    factors = averaging_factors(20, rate=100.0, window=1_000_000, tau_max="5000s")
    assert factors[-1] == 500_000


def test_tau_max_limits_a_list():
    factors = averaging_factors(["1s", "4s"], rate=100.0, window=1000, tau_max="2s")
    assert factors.tolist() == [100]
    with pytest.raises(OptionError, match="no averaging time is given up to tau_max of 2 s"):
        averaging_factors("3s,4s", rate=100.0, window=1000, tau_max="2s")


@pytest.mark.parametrize("taus", [40.0, None, np.array(0.5), True])
def test_averaging_times_of_another_type_are_refused_clearly(taus):
    with pytest.raises(OptionError, match="give a number of averaging times above 0"):
        averaging_factors(taus, rate=100.0, window=1000)


@pytest.mark.parametrize("value", [True, "nan", "NaT", np.timedelta64("NaT"), [1.0]])
def test_what_is_no_length_is_refused_clearly(value):
    for read in (lambda: samples(value, 100.0, "step"), lambda: duration_seconds(value, "step")):
        with pytest.raises(OptionError, match=r"step .* is not a duration; write for instance"):
            read()


@pytest.mark.parametrize("taus", [[0.1, 40], np.array([0.1, 40.0]), ["0.1s", "40s"]])
def test_messages_on_averaging_times_have_their_unit(taus):
    with pytest.raises(OptionError, match=r"tau ('40s'|40 s) is longer .*window \(--window\)"):
        averaging_factors(taus, rate=10.0, window=100)


@pytest.mark.parametrize("text", ["1,5min", "1, 5 min", "1 5min", "1.5.3s", "1 00:00:05"])
def test_numbers_without_a_unit_between_them_are_refused(text):
    with pytest.raises(OptionError, match="is not a duration"):
        duration_seconds(text, "window")


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("1 day, 2:00:00", 93600.0),
        ("2h,30min", 9000.0),
        ("1.5h 2.5min", 5550.0),
        ("10μs", 1e-5),
        ("1.5d2h", 136800.0),
    ],
)
def test_durations_of_several_units_are_read(text, seconds):
    assert duration_seconds(text, "window") == seconds


@pytest.mark.parametrize("seconds", [1e-5, 0.25, 59.9996, 90.0, 7200.0, 14288.4 * 86400, 1e9])
def test_a_formatted_duration_is_one_that_options_take(seconds):
    assert duration_seconds(format_duration(seconds), "window") == pytest.approx(seconds, rel=5e-4)


def test_an_averaging_time_of_a_surface_is_a_duration():
    tau = xr.DataArray([0.1, 1.0], dims="tau", attrs={"units": "s"})
    np.testing.assert_array_equal(averaging_factors(tau, rate=10.0, window=100), [1, 10])
    assert averaging_factors("all", rate=10.0, window=100, tau_max=tau[1])[-1] == 10
    assert duration_seconds(xr.DataArray(np.timedelta64(90, "s")), "window") == 90.0
    with pytest.raises(OptionError, match=r"window 1\.0 has no unit"):
        samples(tau[1], 10.0, "window")

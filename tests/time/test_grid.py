"""The computed time axis against exact rational arithmetic, and as an xarray index."""

from __future__ import annotations

import pickle
from fractions import Fraction

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st

from gyrostab.errors import OptionError
from gyrostab.ingest.make_log import make_log
from gyrostab.time.grid import TimeGridIndex, first_stamp, grid_index, grid_times, time_coordinate

START = pd.Timestamp("2026-11-20T23:59:59.123456789").value


@given(
    rate=st.one_of(
        st.sampled_from([300.0, 99.3, 1 / 7, 248.553, 400.0, 1e6]), st.floats(1e-3, 1e6)
    ),
    index=st.integers(0, 10**9),
)
def test_every_stamp_is_right_to_a_nanosecond(rate, index):
    exact = Fraction(index) * 10**9 / Fraction(repr(rate))
    if exact > 2**62:
        return
    got = int(grid_times(0, rate, index))
    assert abs(got - exact) <= Fraction(1, 2) + Fraction(1, 10**5)


def test_two_hundred_hours_at_300_hz_end_on_the_nanosecond():
    n = 200 * 3600 * 300
    assert int(grid_times(START, 300.0, n)) - START == 200 * 3600 * 10**9
    assert int(grid_times(START, 300.0, n - 1)) - START == round(Fraction(n - 1, 300) * 10**9)


def test_positions_undo_stamps():
    index = np.array([0, 1, 12345, 2 * 10**8])
    np.testing.assert_allclose(
        grid_index(START, 99.3, grid_times(START, 99.3, index)), index, atol=1e-6
    )


@pytest.fixture
def log():
    return xr.Dataset(
        {"x": ("time", np.arange(3000.0))}, coords=time_coordinate(START, 300.0, 3000)
    )


class TestIndex:
    def test_a_day_of_samples_takes_no_memory(self):
        log = xr.Dataset(coords=time_coordinate(START, 1000.0, 10**11))  # three years
        assert log.time[-1].values == np.datetime64(
            int(grid_times(START, 1000.0, 10**11 - 1)), "ns"
        )
        assert first_stamp(log) == START

    def test_slices_stay_lazy_and_exact(self, log):
        part = log.isel(time=slice(100, 2000, 7))
        assert isinstance(part.xindexes["time"], TimeGridIndex)
        np.testing.assert_array_equal(part.time.values, log.time.values[100:2000:7])
        assert part.xindexes["time"].rate == pytest.approx(300 / 7)
        assert first_stamp(part) == log.time.values[100].astype(np.int64)

    def test_labels_select_as_pandas_does(self, log):
        frame = log.x.to_series()
        for a, b in (
            ("2026-11-21T00:00:00", "2026-11-21T00:00:03"),
            (None, "2026-11-20T23:59:59.5"),
            ("2026-11-21", None),
            (None, log.time.values[4]),
            (log.time.values[4], log.time.values[8]),
        ):
            np.testing.assert_array_equal(log.x.sel(time=slice(a, b)), frame.loc[a:b])
        np.testing.assert_array_equal(log.x.sel(time="2026-11-20"), frame.loc["2026-11-20"])
        stamp = log.time.values[777]
        assert float(log.x.sel(time=stamp)) == 777
        assert float(log.x.sel(time=stamp + np.timedelta64(10**6, "ns"), method="nearest")) == 777
        np.testing.assert_array_equal(log.x.sel(time=log.time.values[[5, 9]]), [5, 9])
        np.testing.assert_array_equal(log.x.sel(time=log.time[[5, 9]], method="nearest"), [5, 9])

    def test_labels_that_are_not_there_are_refused(self, log):
        off = log.time.values[5] + np.timedelta64(1, "ns")
        with pytest.raises(KeyError, match="no sample exactly"):
            log.sel(time=off)
        with pytest.raises(KeyError, match="no sample within"):
            log.sel(time=off, method="nearest", tolerance="0ns")
        with pytest.raises(ValueError, match="nearest"):
            log.sel(time=off, method="ffill")

    def test_it_survives_pickling_copying_alignment_and_arithmetic(self, log):
        restored = pickle.loads(pickle.dumps(log))
        xr.testing.assert_identical(restored, log)
        xr.testing.assert_identical((log + log.copy()) / 2, log)
        assert (log.isel(time=slice(0, 10)).x + log.isel(time=slice(0, 10)).x).sizes["time"] == 10
        renamed = log.rename(time="t")
        np.testing.assert_array_equal(renamed.t.values, log.time.values)
        assert log.resample(time="1s").mean().sizes["time"] == 11
        assert log.to_dataframe().index[-1] == pd.Timestamp(log.time.values[-1])


def test_a_start_that_is_no_time_is_refused():
    with pytest.raises(OptionError, match="start 'soon' is not a date and time"):
        make_log(np.zeros(3), rate=1.0, unit="deg/h", start="soon")


def test_a_start_with_an_offset_is_utc_in_the_log():
    log = make_log(np.zeros(3), rate=1.0, unit="deg/h", start="2026-01-01T02:00+02:00")
    assert log["time"].values[0] == np.datetime64("2026-01-01T00:00")

"""The computed time axis against exact rational arithmetic, and as an xarray index."""

from __future__ import annotations

import pickle
from datetime import datetime
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
            ("1700", "2200"),
            (pd.Timestamp("2026-11-21T00:00:01"), pd.Timestamp("2026-11-21T00:00:02")),
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
        assert float(log.x.sel(time=pd.Timestamp(stamp))) == 777
        np.testing.assert_array_equal(log.x.sel(time=log.x > 2990), np.arange(2991.0, 3000))
        assert float(log.x.sel(time="1700", method="nearest")) == 0

    @pytest.mark.parametrize(
        ("zone", "hours"), [("Z", 0), ("+00", 0), ("+02", 2), ("+0200", 2), ("-05:30", -5.5)]
    )
    def test_labels_with_an_offset_select_as_pandas_does(self, log, zone, hours):
        frame = log.x.to_series().tz_localize("UTC")
        first, last = (
            f"{pd.Timestamp(text) + pd.Timedelta(hours=hours):%Y-%m-%dT%H:%M:%S}{zone}"
            for text in ("2026-11-21T00:00:01", "2026-11-21T00:00:03")
        )
        expected = frame.loc[first:last]
        assert expected.size == 900
        np.testing.assert_array_equal(log.x.sel(time=slice(first, last)), expected)
        minute = f"{first[:16]}{zone}"
        np.testing.assert_array_equal(log.x.sel(time=minute), frame.loc[minute])

    def test_a_reversed_axis_is_not_sliced_wrongly(self, log):
        backwards = log.isel(time=slice(None, None, -1))
        stamps = log.time.values
        part = backwards.x.sel(time=slice(stamps[20], stamps[10]))
        np.testing.assert_array_equal(part, np.arange(20.0, 9.0, -1))

    @pytest.mark.parametrize(
        "part",
        [
            [5, 9, 2],
            [-1, 0],
            [],
            np.arange(3000) % 7 == 3,
            xr.Variable("time", [4, 4]),
            slice(None, None, -1),
            slice(40, 10, -7),
        ],
    )
    def test_other_samples_keep_their_times(self, log, part):
        ordinary = log.assign_coords(time=log.time.values)
        chosen, expected = (data.x.isel(time=part) for data in (log, ordinary))
        assert chosen.xindexes["time"].equals(expected.xindexes["time"])
        pd.testing.assert_series_equal(chosen.to_series(), expected.to_series())

        with pytest.raises(IndexError):
            log.x.isel(time=[0, 3000])

    def test_other_samples_are_aligned_by_their_times(self, log):
        common = log.x.isel(time=[5, 9]) - log.x.isel(time=[9, 5])
        np.testing.assert_array_equal(common, [0.0, 0.0])
        assert (log.x.isel(time=[5, 9]) - log.x.isel(time=[9, 12])).sizes == {"time": 1}

    def test_a_selection_without_the_dimension_of_time_has_no_index(self, log):
        assert "time" not in log.x.isel(time=5).xindexes
        places = xr.Variable("event", [5, 9])
        assert "time" not in log.x.isel(time=places).xindexes
        np.testing.assert_array_equal(log.x.isel(time=places).time, log.time.values[[5, 9]])

    def test_labels_that_are_not_there_are_refused(self, log):
        off = log.time.values[5] + np.timedelta64(1, "ns")
        with pytest.raises(KeyError, match="no sample exactly"):
            log.sel(time=off)
        with pytest.raises(KeyError, match="no sample within"):
            log.sel(time=off, method="nearest", tolerance="0ns")
        with pytest.raises(ValueError, match="nearest"):
            log.sel(time=off, method="ffill")
        with pytest.raises(KeyError, match="no sample near NaT"):
            log.sel(time=np.datetime64("NaT"), method="nearest")
        with pytest.raises(KeyError, match="5 is not a time"):
            log.sel(time=5)

    @pytest.mark.parametrize(
        ("one", "two", "is_computed"),
        [
            (slice(0, 20), slice(10, 40), True),
            (slice(0, 20), slice(20, 40), True),
            (slice(0, 20), slice(30, 40), False),
            (slice(0, 60, 3), slice(6, 90, 3), True),
            (slice(0, 60, 3), slice(0, 60, 2), False),
        ],
    )
    def test_parts_of_a_grid_align_as_ordinary_axes_do(self, log, one, two, is_computed):
        plain = log.to_dataframe().to_xarray()
        for how in ("inner", "outer", "left", "right"):
            got = xr.align(log.isel(time=one), log.isel(time=two), join=how)
            expected = xr.align(plain.isel(time=one), plain.isel(time=two), join=how)
            for mine, theirs in zip(got, expected, strict=True):
                np.testing.assert_array_equal(mine.time.values, theirs.time.values)
                np.testing.assert_array_equal(mine.x, theirs.x)
        united = xr.align(log.isel(time=one), log.isel(time=two), join="outer")[0]
        assert isinstance(united.xindexes["time"], TimeGridIndex) == is_computed
        total = log.isel(time=one) + log.isel(time=two)
        np.testing.assert_array_equal(total.x, (plain.isel(time=one) + plain.isel(time=two)).x)

    def test_it_survives_pickling_copying_alignment_and_arithmetic(self, log):
        restored = pickle.loads(pickle.dumps(log))
        xr.testing.assert_identical(restored, log)
        xr.testing.assert_identical((log + log.copy()) / 2, log)
        assert (log.isel(time=slice(0, 10)).x + log.isel(time=slice(0, 10)).x).sizes["time"] == 10
        renamed = log.rename(time="t")
        np.testing.assert_array_equal(renamed.t.values, log.time.values)
        assert log.resample(time="1s").mean().sizes["time"] == 11
        assert log.to_dataframe().index[-1] == pd.Timestamp(log.time.values[-1])


@pytest.mark.parametrize(
    ("start", "words"),
    [
        ("soon", "start 'soon' is not a date and time"),
        (1.5e9, "is not a date and time"),
        (datetime(2300, 1, 1), "is outside the years 1678 to 2262"),
    ],
)
def test_a_start_that_is_no_time_is_refused(start, words):
    with pytest.raises(OptionError, match=words):
        make_log(np.zeros(3), rate=1.0, unit="deg/h", start=start)


@pytest.mark.parametrize("rate", [0.0, 1e-12, 2e9, np.nan])
def test_a_rate_beyond_64_bit_nanoseconds_is_refused(rate):
    with pytest.raises(OptionError, match="a number from 1e-09 to 1e"):
        make_log([1.0], rate=rate, unit="deg/h")


def test_a_start_with_an_offset_is_utc_in_the_log():
    log = make_log(np.zeros(3), rate=1.0, unit="deg/h", start="2026-01-01T02:00+02:00")
    assert log["time"].values[0] == np.datetime64("2026-01-01T00:00")

"""Times as integers: exact, or refused where nanoseconds of 64 bits cannot hold them."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from gyrostab import from_dataarray
from gyrostab.errors import OptionError, TimeError
from gyrostab.time.stamps import stamp_ns, to_nanoseconds


@pytest.mark.parametrize("unit", ["D", "s", "ms", "us", "Y"])
@pytest.mark.parametrize("order", ["<", ">"])
def test_dates_are_never_wrapped_around(unit, order):
    stamps = np.array(
        ["1677-09-15", "2026-01-01", "2300-01-01", "NaT"], dtype="datetime64[s]"
    ).astype(f"{order}M8[{unit}]")
    known, nat = 1_767_225_600 * 10**9, np.iinfo(np.int64).min
    assert to_nanoseconds(stamps, far_as_nat=True).tolist() == [nat, known, nat, nat]
    assert to_nanoseconds(stamps[1::2]).tolist() == [known, nat]
    assert to_nanoseconds(stamps[1:2].astype(f"{order}M8[ns]")).tolist() == [known]
    with pytest.raises(TimeError, match=r"the time 2300.* is outside the years 1678 to 2262"):
        to_nanoseconds(stamps[1:])


@pytest.mark.parametrize(
    "text",
    [
        "2016-12-31T12:30+99:99",
        "2016-12-31T12:30+24:00",
        "2016-12-31T12:30-01:60",
        "2016-12-31T12:30:60",
        "20161231T123060",
    ],
)
def test_instants_that_do_not_exist_are_refused(text):
    with pytest.raises(OptionError, match="is not a date and time"):
        stamp_ns(text)


def test_a_leap_second_is_the_last_one_of_a_day_in_utc():
    new_year = 1_483_228_800 * 10**9
    for text in ("2016-12-31T23:59:60", "2017-01-01T05:29:60+05:30", "2017-01-01T00:00"):
        assert stamp_ns(text) == new_year


@pytest.mark.parametrize("rate", [None, 1.0])
def test_a_log_of_far_dates_is_refused(rate):
    times = np.datetime64("2500-01-01", "s") + np.arange(100)
    signal = xr.DataArray(np.zeros(100), {"time": times}, "time", attrs={"units": "deg/h"})
    with pytest.raises(TimeError, match="outside the years 1678 to 2262"):
        from_dataarray(signal, rate=rate)


@pytest.mark.parametrize("number", [0, 1_767_225_600, np.int64(5), 5.0, True])
def test_a_bare_number_is_no_instant(number):
    with pytest.raises(OptionError, match="is not a date and time"):
        stamp_ns(number)

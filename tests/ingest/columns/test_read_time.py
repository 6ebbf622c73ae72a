"""Stamps in every format: unambiguous ones are read exactly, others refused or counted."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cf_units
import cftime
import dask.array
import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from pyarrow import parquet

from gyrostab.errors import FormatError, OptionError, UnitError
from gyrostab.ingest import read_log, scan_file
from gyrostab.ingest.columns.stamps import NAT, integers_to_ns, parse_time_unit
from gyrostab.ingest.grid.regularise import regularise
from gyrostab.time.stamps import stamp_ns
from tests.ingest.field_files import las_text
from tests.support.columns import write_columns

ROWS = 40


def write_stamped(path: Path, stamps: np.ndarray, **attributes: Any) -> Path:
    """Write NetCDF or HDF5 with one axis, and stamps with these attributes."""
    gyro = np.arange(ROWS), "deg/h"
    return write_columns(path, {"time": (stamps, attributes), "gyro_x": gyro})


def dates(year: int, unit: str = "us") -> np.ndarray:
    return np.datetime64(f"{year}-05-06", unit) + np.arange(ROWS) * np.timedelta64(
        10**6, "us"
    ).astype(f"timedelta64[{unit}]")


def write_dates(path: Path, stamps: np.ndarray, unit: str = "us") -> Path:
    if path.suffix == ".csv":
        rows = "\n".join(f"{stamp}Z,{row}" for row, stamp in enumerate(stamps))
        path.write_text(f"time,gyro_x [deg/h]\n{rows}\n")
    else:
        parquet.write_table(
            pa.table(
                {
                    "time": pa.array(stamps, pa.timestamp(unit)),
                    "gyro_x [deg/h]": np.arange(len(stamps)),
                }
            ),
            path,
        )
    return path


@pytest.mark.parametrize("name", ["log.csv", "log.parquet"])
@pytest.mark.parametrize("year", [1500, 1677, 2263, 2300])
def test_dates_outside_64_bits_are_counted_or_refused(tmp_path, name, year):
    stamps = dates(2026)
    stamps[7] = dates(year)[7]
    raw = read_log(write_dates(tmp_path / name, stamps))
    assert np.flatnonzero(np.isnat(raw.time.values)).tolist() == [7]
    assert raw.attrs["unreadable_rows"] == 1
    good = np.delete(np.arange(ROWS), 7)
    np.testing.assert_array_equal(raw.time.values[good], stamps[good])
    with pytest.raises(FormatError, match="1678 to 2262"):
        read_log(write_dates(tmp_path / f"all_{name}", dates(year)))


@pytest.mark.parametrize("name", ["log.csv", "log.parquet"])
def test_serial_dates_of_matlab_have_a_unit(tmp_path, name):
    days = 719_529.25 + np.arange(ROWS) / 64  # 1970-01-01T06:00
    table = pd.DataFrame({"t": days, "gyro_x [deg/h]": np.arange(ROWS)})
    path = tmp_path / name
    table.to_csv(path, index=False) if path.suffix == ".csv" else table.to_parquet(path)
    expected = np.datetime64("1970-01-01T06:00") + np.arange(ROWS) * np.timedelta64(1350, "s")
    np.testing.assert_array_equal(read_log(path, unit={"time": "datenum"}).time.values, expected)
    with pytest.raises(FormatError, match="--unit time=datenum"):
        read_log(path, unit={"time": "day"})


@pytest.mark.parametrize("unit", ["s", "ms", "us", "ns"])
def test_dates_of_every_unit_of_parquet(tmp_path, unit):
    stamps = dates(2026, unit)
    raw = read_log(write_dates(tmp_path / "log.parquet", stamps, unit))
    np.testing.assert_array_equal(raw.time.values, stamps)
    zoned = pa.array(stamps, pa.timestamp(unit, tz="Europe/Berlin"))  # the stored numbers are UTC
    parquet.write_table(
        pa.table({"time": zoned, "gyro_x [deg/h]": np.arange(ROWS)}), tmp_path / "zoned.parquet"
    )
    np.testing.assert_array_equal(read_log(tmp_path / "zoned.parquet").time.values, stamps)


SAME_INSTANT = [
    "Seconds Since 2026-01-02 03:04:05",
    "SECONDS SINCE 2026-01-02 03:04:05",
    "sec since 2026-1-2 3:4:5.0",
    "s since 2026-01-02T03:04:05Z",
    "second since 2026-01-02 03:04:05 UTC",
    "seconds since 2026-01-02 04:34:05 +1:30",
    "seconds since 20260102T030405",
]


@pytest.mark.parametrize("text", SAME_INSTANT)
def test_epochs_are_read_as_udunits_reads_them(text):
    unit = parse_time_unit(text)
    assert unit.epoch == stamp_ns("2026-01-02T03:04:05")
    assert (
        cf_units.Unit(text).convert(0.0, cf_units.Unit("seconds since 1970-01-01"))
        == unit.epoch / 1e9
    )


@pytest.mark.parametrize(
    "text", ["week", "days", "Hours", "min", "msec", "microseconds", "0.25 s", "1e-3 minutes"]
)
def test_units_of_time_are_those_of_udunits(text):
    assert float(parse_time_unit(text).ns) == pytest.approx(
        cf_units.Unit(text.lower()).convert(1e9, "s"), rel=1e-14
    )


@pytest.mark.parametrize("suffix", [".nc", ".h5"])
@pytest.mark.parametrize(
    "units",
    [
        "seconds since now",
        "seconds since 01-02-2026",
        "seconds since 01/02/2026",
        "seconds since 2026-02-30",
        "seconds since yesterday",
        "seconds since",
        "seconds since 26-01-02",
        "months since 2026-01-01",
        "seconds since 2026",
    ],
)
def test_an_epoch_that_must_be_guessed_is_refused(tmp_path, units, suffix):
    path = write_stamped(tmp_path / f"log{suffix}", np.arange(ROWS), units=units)
    with pytest.raises(
        UnitError,
        match=rf"log{suffix}: column 'time': time unit '{units}'.*--unit \"time=seconds since",
    ):
        read_log(path)
    assert any("time unit" in note for note in scan_file(path).notes)
    given = read_log(path, unit={"time": "seconds since 2026-01-02"})
    assert given.time.values[1] == np.datetime64("2026-01-02T00:00:01")


@pytest.mark.parametrize("suffix", [".nc", ".h5"])
@pytest.mark.parametrize(
    "calendar", ["noleap", "365_day", "all_leap", "366_day", "360_day", "none", "tai"]
)
def test_calendars_without_real_dates_are_refused(tmp_path, calendar, suffix):
    stamps = np.cumsum(np.random.default_rng(1).uniform(0.9, 1.1, ROWS))
    path = write_stamped(
        tmp_path / f"log{suffix}", stamps, units="seconds since 2026-02-28", calendar=calendar
    )
    with pytest.raises(
        UnitError, match=f"log{suffix}: column 'time': .*{calendar}.*standard calendar"
    ):
        read_log(path)


@pytest.mark.parametrize("calendar", ["standard", "Gregorian", "proleptic_gregorian", "julian"])
@pytest.mark.parametrize("epoch", ["2026-02-28 12:00:00", "1858-11-17", "1600-01-01", "0001-01-01"])
def test_calendars_of_real_dates_are_converted(tmp_path, calendar, epoch):
    year, month, day = map(int, epoch.split(" ")[0].split("-"))
    begin = cftime.datetime(year, month, day, 12 if " " in epoch else 0, calendar=calendar.lower())
    end = cftime.datetime(2026, 3, 1, 6, calendar="standard")
    days = end.toordinal(fractional=True) - begin.toordinal(fractional=True)
    microseconds = np.rint(days * 86400).astype(np.int64) * 10**6 + 10_000 * np.arange(ROWS)
    raw = read_log(
        write_stamped(
            tmp_path / "log.nc",
            microseconds,
            units=f"microseconds since {epoch}",
            calendar=calendar,
        )
    )
    np.testing.assert_array_equal(
        raw.time.values, np.datetime64("2026-03-01T06", "us") + microseconds - microseconds[0]
    )


@pytest.mark.parametrize(
    "unit",
    [
        "ns",
        "us",
        "7 us",
        "0.1 s",
        "0.5 ns",
        "d",
        "seconds since 0001-01-01",
        "days since 9000-01-01",
        "ns since 1800-01-01",
        "3 us since 2200-01-01",
    ],
)
def test_whole_numbers_become_exact_stamps_or_nat(unit):
    parsed = parse_time_unit(unit)
    counts = np.array(
        [0, 1, -1, 2**31, -(2**40), 62_900_000_000, 2**62, -(2**62), 2**63 - 1, -(2**63) + 1]
    )
    zero = parsed.epoch or 0
    stamps = integers_to_ns(counts, parsed, 0)
    for count, stamp in zip(counts.tolist(), stamps.tolist(), strict=True):
        exact = count * parsed.ns + zero
        if stamp != NAT:
            assert abs(stamp - exact) <= 0.5
        else:  # near the ends a stamp of a fractional unit may be given up
            assert abs(exact) > (2**63 - 1 if parsed.ns.denominator == 1 else 2**61)


@pytest.mark.parametrize("option", ["start", "epoch"])
@pytest.mark.parametrize(
    "text",
    [
        "now",
        "today",
        "01-02-2026",
        "01/02/2026",
        "Jan 2 2026",
        "1500-01-01",
        "2300-01-01",
        "2026-02-30",
        "2026",
    ],
)
def test_start_and_epoch_are_not_guessed(tmp_path, option, text):
    path = tmp_path / "log.csv"
    path.write_text("gyro_x [deg/h]\n1\n2\n")
    with pytest.raises(OptionError, match=f"--{option} '{text}'.*(write|give)"):
        read_log(path, rate=1.0, **{option: text})


def test_unused_epoch_is_noted(tmp_path):
    raw = read_log(
        write_stamped(tmp_path / "log.nc", np.arange(ROWS), units="seconds since 2026-01-02"),
        epoch="2020-01-01",
    )
    assert raw.time.values[0] == np.datetime64("2026-01-02")
    assert any("--epoch is not used" in note for note in raw.attrs["notes"])


def test_dates_of_las_files_are_counted_or_read(tmp_path):
    rows = (f"{1500 if row == 7 else 2026}-05-06 00:00:{row:02d} {row}" for row in range(ROWS))
    path = tmp_path / "log.las"
    path.write_text(las_text("DATE. TIME. GYRO_X.deg/h", rows))
    stamps = read_log(path).time.values
    assert np.flatnonzero(np.isnat(stamps)).tolist() == [7]
    assert stamps[8] == np.datetime64("2026-05-06T00:00:08")


def test_a_tdms_waveform_that_begins_after_2262_is_refused(tmp_path):
    nptdms = pytest.importorskip("nptdms")
    begin = {
        "wf_increment": 0.01,
        "wf_start_time": np.datetime64("2300-01-01", "us"),
        "unit_string": "deg/h",
    }
    with nptdms.TdmsWriter(tmp_path / "log.tdms") as writer:
        writer.write_segment(
            [nptdms.ChannelObject("imu", "gyro_x", np.arange(40.0), properties=begin)]
        )
    with pytest.raises(FormatError, match=r"log\.tdms: .*2262"):
        read_log(tmp_path / "log.tdms")


@pytest.mark.parametrize("block", [2**9, 2**22])
@pytest.mark.parametrize(("name", "days"), [("log.csv", 1), ("log.csv", 7), ("log.parquet", 1)])
@pytest.mark.parametrize("jitter", [0.0, 0.002])
def test_clock_that_begins_again_at_midnight_is_continued(
    tmp_path, monkeypatch, name, days, jitter, block
):
    monkeypatch.setattr("gyrostab.ingest.formats.text.BLOCK_BYTES", block)
    clock = 86400.0 * days - 100.0 + np.arange(4000) / 20
    clock = np.round(clock + jitter * np.random.default_rng(1).standard_normal(clock.size), 4)
    table = pd.DataFrame({"time [s]": clock % (86400 * days), "gyro_x [deg/h]": np.arange(4000.0)})
    table.loc[7, "time [s]"] = np.nan
    path = tmp_path / name
    table.to_csv(path, index=False) if name.endswith("csv") else table.to_parquet(path)
    raw = read_log(path)
    read = raw.time.values.astype("datetime64[ns]").view(np.int64) / 1e9
    np.testing.assert_allclose(np.delete(read, 7), np.delete(clock, 7), atol=1e-6)
    assert sum("the clock begins again" in note for note in raw.attrs["notes"]) == 1
    log = regularise(raw)
    assert log.sizes["time"] == 4000
    assert not (log.gap_samples.values > 1).any()


@pytest.mark.parametrize("name", ["log.h5", "log.nc"])
@pytest.mark.parametrize("batch", [128, 2**20])
def test_clock_is_continued_over_batches_and_on_disk(tmp_path, monkeypatch, name, batch):
    monkeypatch.setattr("gyrostab.ingest.columns.pieces.SPILL_BYTES", 1000)
    monkeypatch.setattr("gyrostab.ingest.columns.typed.BATCH_ROWS", batch)
    clock = 86400.0 - 100.0 + np.arange(10_000) / 20
    clock = np.round(clock + 0.002 * np.random.default_rng(1).standard_normal(clock.size), 4)
    columns = {"time": (clock % 86400, "s"), "gyro_x": (np.arange(10_000.0), "deg/h")}
    raw = read_log(write_columns(tmp_path / name, columns, "NETCDF3_64BIT_OFFSET"))
    assert isinstance(raw.rate.data, dask.array.Array)
    read = raw.time.values.astype("datetime64[ns]").view(np.int64) / 1e9
    np.testing.assert_allclose(read, clock, atol=1e-6)
    assert sum("the clock begins again" in note for note in raw.attrs["notes"]) == 1


@pytest.mark.parametrize(
    ("unit", "tick"), [("us", 1e-6), ("s", 1e-6), ("0.1 ms", 1e-4), ("ms", 1e-3)]
)
@pytest.mark.parametrize("lowest", [0, -(2**31)])
def test_clock_of_a_32_bit_counter_is_continued(tmp_path, unit, tick, lowest):
    count = lowest + 2**32 - round(5 / tick) + np.rint(np.arange(2000) / 100 / tick).astype(int)
    written = (count - lowest) % 2**32 + lowest
    path = tmp_path / "log.csv"
    times = [f"{value * 1e-6:.6f}" if unit == "s" else str(value) for value in written.tolist()]
    pd.DataFrame({f"time [{unit}]": times, "gyro_x [deg/h]": np.arange(2000.0)}).to_csv(path)
    log = regularise(read_log(path))
    assert log.sizes["time"] == 2000
    np.testing.assert_array_equal(log.rate.values[0], np.arange(2000.0))
    (note,) = [note for note in log.attrs["notes"] if "the clock begins again" in note]
    assert f"after {2**32 * tick:.10g} s, when its 32-bit counter is full, (1 time)" in note


def write_files(folder, clock, names, unit="s"):
    """Write a log in one file for each name, with the number of the row as rate."""
    for name, rows in zip(names, np.array_split(np.arange(len(clock)), len(names)), strict=True):
        cells = {f"time [{unit}]": clock[rows], "gyro_x [deg/h]": rows.astype(float)}
        pd.DataFrame(cells).to_csv(folder / name, index=False)


@pytest.mark.parametrize("limit", [2**26, 1000])
@pytest.mark.parametrize("start", [2300, 4294.2, 3000])
def test_clock_that_begins_again_between_files_is_continued(tmp_path, monkeypatch, start, limit):
    monkeypatch.setattr("gyrostab.ingest.reading.SPILL_BYTES", limit)
    clock = (np.arange(4000) * 5_000_000 + round(start * 1e6)) % 2**32  # of 20 000 s
    write_files(tmp_path, clock, [f"run_{number}.csv" for number in range(1, 12)], "us")
    log = regularise(read_log(tmp_path / "run_*.csv"))
    np.testing.assert_array_equal(log.rate.values[0], np.arange(4000.0))
    assert any("continued from the file before" in note for note in log.attrs["notes"])


def test_files_of_other_days_keep_the_order_of_their_stamps(tmp_path):
    clock = 1_767_225_600.0 + np.arange(300) * 864  # three days, counted from 1970
    write_files(tmp_path, clock, ["mon.csv", "tue.csv", "fri.csv"])
    log = regularise(read_log(tmp_path / "*.csv"))
    np.testing.assert_array_equal(log.rate.values[0], np.arange(300.0))
    assert not any("begins again" in note for note in log.attrs["notes"])


def test_clock_that_restarts_between_files_is_not_continued(tmp_path):
    write_files(
        tmp_path, np.r_[np.arange(4000.0, 4100.0), np.arange(5.0, 105.0)], ["a.csv", "b.csv"]
    )
    log = regularise(read_log(tmp_path / "*.csv"))
    assert not any("begins again" in note for note in log.attrs["notes"])
    assert log.attrs["source_files"] == ["b.csv", "a.csv"]


@pytest.mark.parametrize("first", [0.2, 40.0])
def test_clock_that_restarts_elsewhere_is_not_continued(tmp_path, first):
    clock = np.concatenate([50_000 + np.arange(100) / 20, first + np.arange(100) / 20])
    if first < 1:
        clock[:100] += 36_390  # ends 5 s before midnight
    path = tmp_path / "log.csv"
    pd.DataFrame({"time [s]": clock, "gyro_x [deg/h]": 1.0}).to_csv(path, index=False)
    raw = read_log(path)
    assert raw.time.values.astype("datetime64[ns]").view(np.int64)[100] == round(first * 1e9)
    assert not any("the clock begins again" in note for note in raw.attrs["notes"])


def test_one_wrong_stamp_is_not_midnight(tmp_path):
    clock = 86_398 + np.arange(100) / 20
    clock[40:] += 1e-3
    clock[39] = 0.0
    path = tmp_path / "log.csv"
    pd.DataFrame({"time [s]": clock, "gyro_x [deg/h]": 1.0}).to_csv(path, index=False)
    stamps = read_log(path).time.values.astype("datetime64[ns]").view(np.int64)
    assert stamps[40] == round(clock[40] * 1e9)


WEEK_2300 = np.datetime64("2024-02-04", "ns")  # 1980-01-06 and 2300 weeks


def write_weeks(path: Path, header: str, *rows: str) -> Path:
    path.write_text("\n".join([header, *rows, ""]))
    return path


@pytest.mark.parametrize(
    ("header", "options"),
    [
        ("GPS TOW (s),GPS Week,Ang Rate X (deg/s)", {"map": {"Ang Rate X": "gyro_x"}}),
        ("gps_tow,gps_week,gyro_x [deg/s]", {"map": {"gps_tow": "time [s]"}}),
        ("GpsToW [s],GpsWeek,gyro_x [deg/s]", {}),
        ("Time of Week [s],Week No.,gyro_x [deg/s]", {}),
    ],
)
def test_gps_weeks_are_added_to_times_of_week(tmp_path, header, options):
    """The last second of a week, a row with a quoted cell, and half a minute without rows."""
    rows = [f"{604799 + n / 10:.2f},2300,{n}" for n in range(10)]
    rows += ['"0.00",2301,10', *(f"{30 + n / 10:.2f},2301,{n}" for n in range(10))]
    path = write_weeks(tmp_path / "log.csv", header, *rows)
    raw = read_log(path, **options)
    seconds = np.r_[604799 + np.arange(10) / 10, 604800, 604830 + np.arange(10) / 10]
    expected = WEEK_2300 + np.round(seconds * 1e9).astype("timedelta64[ns]")
    np.testing.assert_array_equal(raw.time.values, expected)
    assert sum("GPS time, which has no leap seconds" in note for note in raw.attrs["notes"]) == 1
    assert not any("--epoch" in note for note in raw.attrs["notes"])
    assert list(raw.data_vars) == ["rate"]
    if "map" not in options:
        summary = scan_file(path)
        assert (summary.first, summary.last) == (expected[0], expected[-1])


def test_gps_weeks_of_parquet_are_added_to_times_of_week(tmp_path):
    table = pa.table(
        {
            "week": pa.array([2300, None, 2300, 0], pa.int32()),
            "tow [s]": np.arange(4) + 0.5,
            "gyro_x [deg/s]": np.arange(4.0),
        }
    )
    parquet.write_table(table, tmp_path / "log.parquet")
    raw = read_log(tmp_path / "log.parquet")
    assert np.isnat(raw.time.values).tolist() == [False, True, False, True]
    assert raw.time.values[2] == WEEK_2300 + np.timedelta64(2500, "ms")
    assert raw.attrs["unreadable_rows"] == 2
    assert scan_file(tmp_path / "log.parquet").last == raw.time.values[2]


def test_rows_before_the_first_gps_week_are_unreadable(tmp_path):
    rows = ["0,0,1", "0.1,,2", "345600.25,2300,3", "345600.35,2300,4", "345600.45,2300,5"]
    raw = read_log(write_weeks(tmp_path / "log.csv", "tow [s],week,gyro_x [deg/s]", *rows))
    assert np.isnat(raw.time.values).tolist() == [True, True, False, False, False]
    assert raw.time.values[2] == np.datetime64("2024-02-08T00:00:00.25")
    assert raw.attrs["unreadable_rows"] == 2


@pytest.mark.parametrize(
    ("columns", "cells", "reason"),
    [
        ("week", "252", "below 1024"),
        ("week,gps_week", "2300,2300", "'gps_week' too"),
    ],
)
def test_the_week_is_asked_for_where_it_is_ambiguous(tmp_path, columns, cells, reason):
    rows = [f"{n},{cells},{n}" for n in range(4)]
    path = write_weeks(tmp_path / "log.csv", f"tow [s],{columns},gyro_x [deg/s]", *rows)
    with pytest.raises(UnitError, match=rf"'week' may hold .*{reason}.*--epoch 2026-03-08"):
        read_log(path)
    raw = read_log(path, epoch="2026-03-08")
    assert raw.time.values[1] == np.datetime64("2026-03-08T00:00:01")


@pytest.mark.parametrize(
    ("header", "rows"),
    [
        ("time [s],week,gyro_x [deg/s]", ["1.5,2300,1", "2.5,2300,2"]),  # of another clock
        ("tow [s],week,gyro_x [deg/s]", ["604801.5,2300,1", "604802.5,2300,2"]),
        ("tow [s],week,gyro_x [deg/s]", ["1.5,,1", "2.5,,2"]),
        ("tow [s],gyro_x [deg/s]", ["1.5,1", "2.5,2"]),
    ],
)
def test_times_without_a_gps_week_need_an_epoch(tmp_path, header, rows):
    raw = read_log(write_weeks(tmp_path / "log.csv", header, *rows))
    assert raw.time.values[0] < np.datetime64("1970-01-09")
    assert any("give --epoch for another zero" in note for note in raw.attrs["notes"])

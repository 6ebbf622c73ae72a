"""Dates in other forms than ISO 8601, and in two columns."""

from __future__ import annotations

import re
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

from gyrostab import read_log, scan
from gyrostab.errors import FormatError, OptionError, UnitError
from gyrostab.ingest.columns.dates import DAY_FIRST, MONTH_FIRST, YEAR_FIRST, as_iso, find_order
from gyrostab.ingest.columns.stamps import NAT, cells_to_ns

STAMPS = pd.date_range("2026-05-12 23:59:58.250", periods=200, freq="40ms")


def write(path: Path, form: str, header: str = "time,gyro_x [deg/h]", separator: str = ",") -> Path:
    lines = [
        separator.join([stamp, str(n % 7 - 3)]) for n, stamp in enumerate(STAMPS.strftime(form))
    ]
    path.write_text("\n".join([header.replace(",", separator), *lines]) + "\n")
    return path


def stamps_of(raw: xr.Dataset) -> np.ndarray:
    return np.asarray(raw["time"].values, dtype="datetime64[ns]")


@pytest.mark.parametrize(
    "form",
    [
        "%Y/%m/%d %H:%M:%S.%f",
        "%Y.%m.%d %H:%M:%S.%fZ",
        "%d.%m.%Y %H:%M:%S.%f",
        "%d-%b-%Y %H:%M:%S.%f",
        "%d %B %Y %H:%M:%S.%f",
        "%d-%b-%y %H:%M:%S.%f",
        "%m/%d/%Y %I:%M:%S.%f %p",  # May 13 follows
        "%m-%d-%Y %H:%M:%S.%f",
    ],
)
def test_dates_of_one_meaning_are_read(form: str, tmp_path: Path) -> None:
    raw = read_log(write(tmp_path / "log.csv", form))
    np.testing.assert_array_equal(stamps_of(raw), STAMPS.values)
    assert raw["rate"].values[0, :5].tolist() == [-3, -2, -1, 0, 1]


@pytest.mark.parametrize(("separator", "header"), [
    (",", "Date,Time,gyro_x [deg/h]"), ("\t", "Date,Time,gyro_x [deg/h]"),
    (" ", "Date,Time,gyro_x[deg/h]"), (" ", "time,gyro_x[deg/h]"),
])  # fmt: skip
@pytest.mark.parametrize("form", ["%Y-%m-%d|%H:%M:%S.%f", "%d.%m.%Y|%H:%M:%S.%f"])
def test_date_and_time_of_day_in_two_columns_are_one(
    form: str, separator: str, header: str, tmp_path: Path
) -> None:
    path = write(tmp_path / "log.txt", form.replace("|", separator), header, separator)
    raw = read_log(path)
    np.testing.assert_array_equal(stamps_of(raw), STAMPS.values)
    assert raw["rate"].values[0, :5].tolist() == [-3, -2, -1, 0, 1]
    assert scan(path)["end"].iloc[0] == STAMPS[-1]


def test_order_that_is_given_holds_for_dates_with_points(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"  # the kernel reads two digits of the hour only
    path.write_text("time,gyro_x [deg/h]\n05.01.2026 9:59:59,1\n05.01.2026 10:00:00,2\n")
    stamps = stamps_of(read_log(path, unit={"time": MONTH_FIRST}))
    assert stamps.astype("datetime64[s]").astype(str).tolist() == [
        "2026-05-01T09:59:59",
        "2026-05-01T10:00:00",
    ]


@pytest.mark.parametrize("damage", ["", "****,****,****", "2026-05-12", "2026-05-12,23:59:5", "a"])
def test_damaged_row_does_not_part_date_and_time_of_day(damage: str, tmp_path: Path) -> None:
    path = write(tmp_path / "log.csv", "%Y-%m-%d,%H:%M:%S.%f", "Date,Time,gyro_x [deg/h]")
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:3], damage, *lines[4:]]) + "\n")
    raw = read_log(path)
    is_finite = np.isfinite(raw["rate"].values[0])
    np.testing.assert_array_equal(stamps_of(raw)[is_finite], np.delete(STAMPS.values, 2))


def test_pair_that_is_not_the_time_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    rows = [f"{n / 10},2026-05-01,08:00:0{n},{n}" for n in range(9)]
    path.write_text("\n".join(["time [s],Date,Clock,gyro_x [deg/h]", *rows]) + "\n")
    raw = read_log(path)
    assert raw["rate"].values[0].tolist() == list(range(9))
    assert stamps_of(raw)[1] == np.datetime64("1970-01-01T00:00:00.1")


def test_decimal_comma_in_seconds(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text(
        "Zeit;gyro_x [deg/h]\n01.05.2026 08:00:00,125;0,5\n01.05.2026 08:00:00,250;1,5\n"
    )
    raw = read_log(path)
    assert stamps_of(raw)[0] == np.datetime64("2026-05-01T08:00:00.125")
    assert raw["rate"].values[0].tolist() == [0.5, 1.5]


@pytest.mark.parametrize("form", ["%Y-%m-%d %H:%M:%S,%f", "%d.%m.%Y %H:%M:%S,%f"])
@pytest.mark.parametrize("separator", [";", "\t", ",", " "])
def test_comma_before_the_fraction_of_a_second(form: str, separator: str, tmp_path: Path) -> None:
    header, form = (
        ("time,gyro_x[deg/h]", form.replace(" ", "T")) if separator == " " else
        ("Zeit,gyro_x [deg/h]", f'"{form}"' if separator == "," else form)
    )  # fmt: skip
    path = write(tmp_path / "log.csv", form, header, separator)
    path.write_text(re.sub(r"(-?\d)$", r"\1.5", path.read_text(), flags=re.MULTILINE))
    raw = read_log(path)
    np.testing.assert_array_equal(stamps_of(raw), STAMPS.values)
    assert raw["rate"].values[0, 3:6].tolist() == [0.5, 1.5, 2.5]
    assert scan(path)["end"].iloc[0] == STAMPS[-1]


def test_comma_in_a_second_between_commas_is_refused_with_advice(tmp_path: Path) -> None:
    path = write(tmp_path / "log.csv", "%Y-%m-%d %H:%M:%S,%f")
    with pytest.raises(FormatError, match=r"line 2 .* a comma precedes the fraction .* quotes"):
        read_log(path)


def test_column_of_stamps_of_any_name_is_the_time(tmp_path: Path) -> None:
    rows = [f"{n / 10},{n % 7}" for n in range(99)]
    path = tmp_path / "log.csv"
    path.write_text("\n".join(["Zeit [s],gyro_x [deg/h]", *rows]) + "\n")
    assert stamps_of(read_log(path))[98] == np.datetime64("1970-01-01T00:00:09.8")
    path = write(tmp_path / "log.csv", "%Y-%m-%d %H:%M:%S.%f", "Zeit,gyro_x [deg/h]")
    lines = path.read_text().splitlines()  # the clock steps back
    path.write_text("\n".join([*lines[:20], *lines[10:]]) + "\n")
    assert stamps_of(read_log(path))[-1] == STAMPS[-1]


def test_two_columns_in_units_of_time_are_not_the_time(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    rows = [f"{n / 10},{2 * n},{n % 7}" for n in range(99)]
    path.write_text("\n".join(["on [s],lag [ms],gyro_x [deg/h]", *rows]) + "\n")
    with pytest.raises(OptionError, match="no time column"):
        read_log(path)


def test_clock_without_a_date_is_the_time_unless_the_rate_is_given(tmp_path: Path) -> None:
    path = write(tmp_path / "log.csv", "%H:%M:%S.%f", "Uhrzeit,gyro_x [deg/h]")
    with pytest.raises(UnitError, match=r"'Uhrzeit' holds times of day without a date"):
        read_log(path)
    assert read_log(path, rate=25).sizes["row"] == len(STAMPS)


def test_date_of_two_meanings_needs_the_order(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("time,gyro_x [deg/h]\n05/01/2026 08:00:00,1\n05/01/2026 08:00:01,2\n")
    with pytest.raises(UnitError, match=r"log\.csv: the dates .* --unit time=DD/MM/YYYY or"):
        read_log(path)
    for order, first in ((DAY_FIRST, "2026-01-05"), ("m/d/yyyy", "2026-05-01")):
        raw = read_log(path, unit={"time": order})
        assert stamps_of(raw)[0] == np.datetime64(f"{first}T08:00:00")
    path.write_text(path.read_text().replace("time", "time [MM/DD/YYYY hh:mm:ss]"))
    assert stamps_of(read_log(path))[0] == np.datetime64("2026-05-01T08:00:00")


@pytest.mark.parametrize("header", ["time,gyro_x [deg/h]", "Zeit,gyro_x [deg/h]"])
@pytest.mark.parametrize("options", [{}, {"unit": {"time": MONTH_FIRST}}])
def test_name_of_a_zone_is_refused(tmp_path: Path, header: str, options: dict[str, Any]) -> None:
    path = write(tmp_path / "log.csv", "%m/%d/%Y %H:%M:%S.%f CDT", header)
    with pytest.raises(UnitError, match=r"CDT', with the name of a time zone; write the offset"):
        read_log(path, **options)


@pytest.mark.parametrize(
    ("header", "unit", "hours"),
    [
        ("time [UTC+02:00]", None, -2),
        ('"Date Time, GMT-05:30"', None, 5.5),
        ("time [UTC]", None, 0),
        ("Timestamp (CEST)", "UTC+2", -2),
        ("time [UTC+02:00]", "UTC", 0),
        ("time", "YYYY-MM-DD GMT+02:00", -2),
    ],
)
def test_offset_in_a_header_holds_for_times_without_one(
    tmp_path: Path, header: str, unit: str | None, hours: float
) -> None:
    path = write(tmp_path / "log.csv", "%Y-%m-%d %H:%M:%S.%f", f"{header},gyro_x [deg/h]")
    slow_row = path.read_text().replace(",-3\n", ",-3D0\n", 1)  # which the kernel leaves
    path.write_text(slow_row)
    options = {} if unit is None else {"unit": {"time": unit}}
    expected = STAMPS + pd.Timedelta(hours=hours)
    np.testing.assert_array_equal(stamps_of(read_log(path, **options)), expected.values)
    ends = scan(path, **options)[["start", "end"]].to_numpy()[0]
    assert [*ends] == [expected[0], expected[-1]]


def test_offset_in_a_cell_overrules_that_in_the_header(tmp_path: Path) -> None:
    header = "time [UTC+02:00],gyro_x [deg/h]"
    path = write(tmp_path / "log.csv", "%Y-%m-%dT%H:%M:%S.%f+01:00", header)
    expected = STAMPS - pd.Timedelta(hours=1)
    np.testing.assert_array_equal(stamps_of(read_log(path)), expected.values)


@pytest.mark.parametrize("header", ["Timestamp (CEST)", "time [Europe/Oslo]", "time EST"])
def test_name_of_a_zone_in_a_header_is_refused(tmp_path: Path, header: str) -> None:
    path = write(tmp_path / "log.csv", "%Y-%m-%d %H:%M:%S.%f", f"{header},gyro_x [deg/h]")
    with pytest.raises(UnitError, match=r"names the time zone .*--unit time=UTC-06:00"):
        read_log(path)


ZONE_COLUMNS = [
    ("tz", "+02:00"),
    ("timezone", "CEST"),
    ("Time Zone", "Europe/Oslo"),
    ("utc_offset", "-6"),
    ("utc_offset [h]", "2"),
    ("zone", "UTC-06:00"),
    ("zone", "CEST"),
]


def write_zone(folder: Path, form: str, column: str, cell: str, time: str = "time") -> Path:
    """Write a log with a column beside the times, which Parquet stores as text or as a date."""
    cells: Any = STAMPS.strftime("%Y-%m-%d %H:%M:%S.%f")
    times = STAMPS if form == "parquet of dates" else cells
    table = pd.DataFrame({time: times, column: cell, "gyro_x [deg/h]": np.arange(len(STAMPS)) % 7})
    if form == "csv":
        table.to_csv(folder / "log.csv", index=False)
        return folder / "log.csv"
    if cell.lstrip("+-").isdigit():
        table[column] = int(cell)
    table.to_parquet(folder / "log.parquet")
    return folder / "log.parquet"


FORMS = ["csv", "parquet of text", "parquet of dates"]


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(("column", "cell"), ZONE_COLUMNS)
def test_zone_in_another_column_is_refused_until_the_user_says_what_the_times_are(
    tmp_path: Path, form: str, column: str, cell: str
) -> None:
    path = write_zone(tmp_path, form, column, cell)
    with pytest.raises(UnitError, match=rf"{re.escape(repr(cell))}.*--unit time=UTC.*UTC-06:00"):
        read_log(path)
    local = read_log(path, unit={"time": "UTC+02:00"})
    np.testing.assert_array_equal(stamps_of(local), (STAMPS - pd.Timedelta(hours=2)).values)
    np.testing.assert_array_equal(stamps_of(read_log(path, unit={"time": "UTC"})), STAMPS.values)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(
    ("column", "cell"),
    [
        ("tz", "UTC"),
        ("tz", "+00:00"),
        ("utc_offset", "0"),
        ("tz", ""),
        ("zone", "3"),
        ("zone", "B"),
    ],
)
def test_column_that_states_no_other_zone_than_utc_is_not_refused(
    tmp_path: Path, form: str, column: str, cell: str
) -> None:
    path = write_zone(tmp_path, form, column, cell)
    np.testing.assert_array_equal(stamps_of(read_log(path)), STAMPS.values)


@pytest.mark.parametrize(
    ("header", "offset", "hours"),
    [
        ("time", "+01:00", -1),
        ("time_utc", "", 0),
        ("time [GMT]", "", 0),
        ("time [UTC-05:00]", "", 5),
    ],
)
def test_zone_in_another_column_is_not_needed_for_times_that_have_one(
    tmp_path: Path, header: str, offset: str, hours: int
) -> None:
    form = f"%Y-%m-%dT%H:%M:%S.%f{offset},+02:00"
    path = write(tmp_path / "log.csv", form, f"{header},tz,gyro_x [deg/h]")
    expected = STAMPS + pd.Timedelta(hours=hours)
    np.testing.assert_array_equal(stamps_of(read_log(path)), expected.values)


@pytest.mark.parametrize("zone", ["UTC", "Europe/Oslo"])
def test_zone_in_another_column_is_not_needed_for_dates_of_parquet_that_have_one(
    tmp_path: Path, zone: str
) -> None:
    table = pd.DataFrame({"time": STAMPS.tz_localize("UTC").tz_convert(zone), "tz": "CEST"})
    table["gyro_x [deg/h]"] = np.arange(len(STAMPS))
    table.to_parquet(tmp_path / "log.parquet")
    np.testing.assert_array_equal(stamps_of(read_log(tmp_path / "log.parquet")), STAMPS.values)


@pytest.mark.parametrize("form", FORMS)
def test_offset_in_the_header_holds_for_every_format(tmp_path: Path, form: str) -> None:
    path = write_zone(tmp_path, form, "tz", "CEST", time="Date Time, GMT-06:00")
    expected = STAMPS + pd.Timedelta(hours=6)
    np.testing.assert_array_equal(stamps_of(read_log(path)), expected.values)


def test_times_of_day_alone_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UnitError, match=r"'time' holds times of day without a date"):
        read_log(write(tmp_path / "log.csv", "%H:%M:%S.%f"))


@settings(max_examples=60)
@given(
    st.datetimes(
        min_value=pd.Timestamp("1700-01-02").to_pydatetime(),
        max_value=pd.Timestamp("2199-12-30").to_pydatetime(),
    ),
    st.sampled_from("-/."),
    st.sampled_from([YEAR_FIRST, DAY_FIRST, MONTH_FIRST]),
)
def test_cells_in_any_order_give_the_same_stamp(stamp, mark, order):  # type: ignore[no-untyped-def]
    form = {YEAR_FIRST: "%Y|%m|%d", DAY_FIRST: "%d|%m|%Y", MONTH_FIRST: "%m|%d|%Y"}[order]
    cell = f"{stamp:{form.replace('|', mark)} %H:%M:%S.%f}"
    if stamp.year < 1000:
        return
    expected = np.datetime64(stamp, "ns").astype(np.int64)
    assert cells_to_ns([cell], None, 0, order)[0] == expected
    by_form = DAY_FIRST if mark == "." and order == MONTH_FIRST else order  # nobody gives the order
    assert find_order([cell]) in (by_form, None)


@pytest.mark.parametrize("year", [1969, 1998, 2000, 2068])
def test_years_of_two_digits_are_those_of_strptime(year: int) -> None:
    cell = f"14-Mar-{year % 100:02d}"
    assert as_iso(cell, DAY_FIRST) == f"{datetime.strptime(cell, '%d-%b-%y'):%Y-%m-%d}"
    assert as_iso(cell, DAY_FIRST) == f"{year}-03-14"


@pytest.mark.parametrize("cell", ["31.02.2026", "2026/13/01", "1.5.2026 13:00 PM", "5 Mei 2026"])
def test_impossible_dates_are_unreadable(cell: str) -> None:
    assert as_iso("5/1/2026", YEAR_FIRST) is None
    assert cells_to_ns([cell], None, 0, DAY_FIRST)[0] == NAT


@pytest.mark.parametrize(("day", "form", "expected"), [
    ("2026-10-25", "%Y-%m-%d %H:%M:%S", "probably the end of daylight saving time"),
    ("2026-03-29", "%d.%m.%Y %H:%M:%S", "may be the beginning of daylight saving time"),
    ("2026-10-25", "%Y-%m-%dT%H:%M:%S%z", ""),
    ("2026-10-26", "%Y-%m-%d %H:%M:%S", ""),
])  # fmt: skip
@pytest.mark.parametrize("rate", [1, 10])
def test_change_of_daylight_saving_time_is_named(
    day: str, form: str, expected: str, rate: int, tmp_path: Path
) -> None:
    stamps = pd.date_range(day, periods=3 * 3600 * rate, freq=f"{1000 // rate}ms", tz="UTC")
    cells = stamps.tz_convert("Europe/Berlin").strftime(form)
    rows = [f"{cell},{n % 7}" for n, cell in enumerate(cells)]
    path = tmp_path / "log.csv"
    path.write_text("\n".join(["time,gyro_x [deg/h]", *rows]) + "\n")
    notes = scan(path).loc[0, "odd"]
    assert (expected in notes) if expected else ("daylight" not in notes)
    assert ("log in UTC" in notes) == bool(expected)


def test_restart_of_a_clock_by_an_hour_is_not_daylight_saving_time(tmp_path: Path) -> None:
    clock = np.concatenate([np.arange(5000), np.arange(1400, 4000)])
    path = tmp_path / "log.csv"
    pd.DataFrame({"time [s]": clock, "gyro_x [deg/h]": clock % 7}).to_csv(path, index=False)
    assert "daylight" not in scan(path).loc[0, "odd"]


def write_fractions(path: Path, milliseconds: np.ndarray, form: str) -> Path:
    """Write stamps, with milliseconds as a number `n`, or as a fraction `f` without last zeros."""
    rows = [
        form.format(s=f"{ms // 1000:02d}", n=ms % 1000, f=f"{ms % 1000:03d}".rstrip("0") or "0")
        for ms in milliseconds.tolist()
    ]
    lines = ("time;gyro_x [deg/h]", *(f"2026-05-01 12:00:{row};{n}" for n, row in enumerate(rows)))
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("form", ["{s}.{n}", "{s},{n}"])
@pytest.mark.parametrize("step", [1, 5, 50])
def test_fractions_without_leading_zeros_are_refused(tmp_path: Path, form: str, step: int) -> None:
    path = write_fractions(tmp_path / "log.csv", step * np.arange(10_000 // step), form)
    with pytest.raises(UnitError, match=r"log.csv: line \d+: the time '12:00:00.*leading zeros"):
        read_log(path)


@pytest.mark.parametrize("form", ["{s}.{f}", "{s}.{n:03d}"])
def test_fractions_of_rows_out_of_order_are_read(tmp_path: Path, form: str) -> None:
    milliseconds = 5 * np.random.default_rng(1).permutation(2000)
    raw = read_log(write_fractions(tmp_path / "log.csv", milliseconds, form))
    since = stamps_of(raw) - np.datetime64("2026-05-01T12:00:00")
    np.testing.assert_array_equal(since / np.timedelta64(1, "ms"), milliseconds)

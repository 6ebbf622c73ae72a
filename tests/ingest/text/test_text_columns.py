"""Columns of text logs: layouts, headers, units, mapping, and messages."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from gyrostab.errors import FormatError, GyrostabError, MissingUnitError, OptionError, UnitError
from gyrostab.ingest import read_log
from gyrostab.ingest.columns.headers import FileColumn, distinct_columns
from gyrostab.ingest.grid.regularise import regularise
from gyrostab.ingest.make_log import make_log
from gyrostab.io.datasets import to_netcdf
from gyrostab.units import INNER
from tests.support.text_logs import PLAIN, ns, write

# --- layouts


@pytest.mark.parametrize(
    "text",
    [
        "time [s],gyro_x [deg/h]\n0,1.5\n1,2.5\n",
        "time [s], gyro_x [deg/h]\n0, 1.5\n1, 2.5\n",
        "TIME [s];Gyro_X [deg/h]\n0;1.5\n1;2.5\n",
        "time [s];gyro_x [deg/h]\n0,0;1,5\n1,0;2,5\n",
        "time [s]  gyro_x [deg/h]\n  0   1.5  \n  1   2.5\n",
        "t_s\tgyro_x [deg/h]\n0\t1.5\n1\t2.5\n",
        "% made by a script\n# two comments\n\ntime [s],gyro_x [deg/h]\n0,1.5\n1,2.5\n# end\n",
        "#time [s],gyro_x [deg/h]\n0,1.5\n1,2.5\n",
        "# time [s] gyro_x [deg/h]\n0 1.5\n1 2.5\n",
        "Logger 7\nSerial: 12\ntime [s],gyro_x [deg/h]\n0,1.5\n1,2.5\n",
        "time [s],gyro_x [deg/h]\n0,1.5,\n1,2.5,\n",
        '"time [s]","gyro_x [deg/h]"\n"0","1.5"\n"1","2.5"\n',
        "\ufefftime [s],gyro_x [deg/h]\r\n0,1.5\r\n1,2.5",
        "timestamp_seconds,gyro_x[deg/h],note\n0,1.5,a # b\n1,2.5,c\n",
        "time [s],event,gyro_x [deg/h]\n0,run#1,1.5\n1,run#2,2.5\n",
        'time [s],event,gyro_x [deg/h]\n0,,1.5\n1,"no. #2, late",2.5\n',
        "time [s],gyro_x [deg/h]\n0,1.5 # begin\n1,2.5 # on, still\n",
        "time [s] gyro_x [deg/h]\n0 1.5 # begin\n1 2.5 # on still\n",
        ",time [s],gyro_x [deg/h]\n0,0,1.5\n1,1,2.5\n",
        "time,gyro_x\ns,deg/h\n0,1.5\n1,2.5\n",
        "Logger 7\ntime;gyro_x;state\n[s];[deg/h];text\n0,0;1,5;on\n1,0;2,5;on\n",
        "time gyro_x\n  s deg/h\n  0   1.5  \n  1   2.5\n",
        "time [s],gyro_x,n\n(ms),(deg/h),\n0,1.5,7\n1,2.5,7\n",
        "day,clock,gyro_x\nYYYY-MM-DD,,deg/h\n1970-01-01,00:00:00,1.5\n1970-01-01,00:00:01,2.5\n",
        "time,gyro_x\nDD/MM/YYYY,deg/h\n01/01/1970 00:00,1.5\n01/01/1970 00:00:01,2.5\n",
        "time [s]\tgyro_x [deg/h]\n0,0\t1,5\n1,0\t2,5\n",
        "time [s];gyro_x [deg/h]\n0,0;1,5\u00a0\n1,0;2,5\u00a0\n",
        "t;gyro_x [deg/h]\n01.01.1970, 00:00:00;1,5\n01.01.1970, 00:00:01;2,5\n",
        "time [s] gyro_x [deg/h]\n 0.000D+00 0.150D+01\n 0.100D+01 0.250D+01\n",
        "time,battery,gyro_x [deg/h]\n1970-01-01T00:00:00,87%,1.5\n1970-01-01T00:00:01,87%,2.5\n",
        "date [DD/MM/YYYY],time [hh:mm:ss],gyro_x [deg/h]\n"
        "01/01/1970,00:00:00,1.5\n01/01/1970,00:00:01,2.5\n",
    ],
)
def test_layouts_of_the_same_log(tmp_path: Path, text: str) -> None:
    raw = read_log(write(tmp_path, text))
    assert ns(raw) == [0, 10**9]
    np.testing.assert_array_equal(raw.rate[0], [1.5, 2.5])
    assert raw.attrs["unreadable_rows"] == 0


def test_units_under_the_header_need_no_options_and_yield_to_them(tmp_path: Path) -> None:
    text = "time,gyro_x,temperature,note\ns,deg/s,degC,\n0,1.5,20,\n1,2.5,21,\n"
    raw = read_log(write(tmp_path, text))
    assert raw.rate[0].values.tolist() == [5400.0, 9000.0]
    assert raw.temperature.values.tolist() == [20, 21]
    raw = read_log(write(tmp_path, text), unit={"gyro": "deg/h"})
    assert raw.rate[0].values.tolist() == [1.5, 2.5]
    raw = read_log(write(tmp_path, text.replace("s,deg/s,degC,", "x,off,on,deg/s")), unit={
        "time": "s", "gyro": "deg/h"
    })  # fmt: skip
    assert raw.attrs["unreadable_rows"] == 1


def test_numbers_without_a_header_are_mapped_by_column(tmp_path: Path) -> None:
    path = write(tmp_path, "0 7 1.5\n1 7 2.5\n", "log.txt")
    with pytest.raises(FormatError, match="no gyro column"):
        read_log(path)
    raw = read_log(path, map={"0": "time [s]", "2": "gyro_z [deg/s]"})
    assert list(raw.axis.values) == ["z"]
    np.testing.assert_array_equal(raw.rate[0], [5400.0, 9000.0])


def test_first_row_of_numbers_after_a_byte_order_mark_is_read(tmp_path: Path) -> None:
    path = write(tmp_path, "\ufeff0 1.5\n1 2.5\n", "log.txt")
    raw = read_log(path, map={"0": "time [s]", "1": "gyro_x [deg/h]"})
    assert ns(raw) == [0, 10**9]


def test_point_among_decimal_commas_is_not_a_number(tmp_path: Path) -> None:
    lines = [f"{n},0;900,5" for n in range(250)] + ["250,0;1.250", "251;1.251"]
    raw = read_log(write(tmp_path, "\n".join(["time [s];gyro_x [deg/h]", *lines, ""])))
    np.testing.assert_array_equal(raw.rate[0].values[-3:], [900.5, np.nan, np.nan])


@pytest.mark.parametrize(("version", "second"), [("1.2", "0,25"), ("", "1.101")])
def test_decimal_mark_is_that_of_most_numbers(tmp_path: Path, version: str, second: str) -> None:
    """A point may also be in a version, or separate thousands."""
    lines = [f"{n},5\t{version}\t{second if n % 2 else '900,5'}" for n in range(9)]
    raw = read_log(write(tmp_path, "\n".join(["time [s]\tver\tgyro_x [deg/h]", *lines, ""])))
    assert ns(raw)[:1] == [500_000_000]
    expected = [900.5, 0.25 if version else np.nan]
    np.testing.assert_array_equal(raw.rate[0].values[:2], expected)


@pytest.mark.parametrize("separator", [";", "\t"])
def test_decimal_commas_after_whole_numbers_are_read(tmp_path: Path, separator: str) -> None:
    rows = [f"{row};{row % 7}" for row in range(300)] + ["300;1,5", "300,5;-2", "301,0;3.5"]
    text = "\n".join(["time [s];gyro_x [deg/h]", *rows, ""]).replace(";", separator)
    raw = read_log(write(tmp_path, text))
    assert raw.rate[0].values[-3:].tolist() == [1.5, -2.0, 3.5]
    assert ns(raw)[-2:] == [300_500_000_000, 301_000_000_000]
    raw = read_log(write(tmp_path, text.replace(f"7{separator}0\n", f"7{separator}0.0\n")))
    assert np.isnan(raw.rate[0].values[-3])  # the points are decimal, so the comma is not


def test_a_latin_1_header_is_read_with_a_note(tmp_path: Path) -> None:
    path = write(
        tmp_path, "time [s],gyro_x [°/h],temperature [°C]\n0,1,20\n1,2,21\n".encode("latin-1")
    )
    raw = read_log(path)
    assert raw.temperature.values.tolist() == [20, 21]
    assert any("line 1 is not UTF-8" in note for note in raw.attrs["notes"])


def test_every_gyro_unit_of_the_contract(tmp_path: Path) -> None:
    rad = 180 / np.pi * 3600
    factors = {
        "deg/h": 1,
        "deg/s": 3600,
        "rad/s": rad,
        "mrad/s": rad / 1e3,
        "urad/s": rad / 1e6,
        "nrad/s": rad / 1e9,
        "arcsec/s": 1,
        "rpm": 21600,
    }
    for unit, factor in factors.items():
        raw = read_log(write(tmp_path, f"gyro_x [{unit}]\n1.25\n-3\n"), rate=1)
        np.testing.assert_allclose(raw.rate[0], [1.25 * factor, -3 * factor], rtol=1e-14)


def test_channels_convert_by_name(tmp_path: Path) -> None:
    headers = "gyro_x [deg/h],"
    headers += "temperature [degF],vibration [m/s^2],rotation_rate [rpm],supply_voltage [mV],"
    headers += "pressure [bar],mag_x [gauss],ramp,mud [%]"
    raw = read_log(
        write(tmp_path, headers + "\n1,212,9.80665,10,5000,2,0.5,7,3\n1,,,,,,,,\n"), rate=1
    )
    expected = {
        "temperature": (100, "degree_Celsius"),
        "vibration": (1, "g"),
        "rotation_rate": (60, "degree s-1"),
        "supply_voltage": (5, "V"),
        "pressure": (2e5, "Pa"),
        "mag_x": (50, "uT"),
        "ramp": (7, "1"),
        "mud": (3, "%"),
    }
    for name, (value, units) in expected.items():
        assert float(raw[name][0]) == pytest.approx(value, rel=1e-12)
        assert np.isnan(raw[name][1])
        assert raw[name].attrs["units"] == units
    assert raw.attrs["unreadable_cells"] == 0  # an empty cell of a channel is not a fault


def test_angles_are_never_guessed(tmp_path: Path) -> None:
    path = write(tmp_path, "time [s],angle_x [arcsec]\n0,3600\n1,7200\n")
    with pytest.raises(OptionError, match=r"--kind angle.*--kind rate"):
        read_log(path)
    cumulative, increments = read_log(path, kind="angle"), read_log(path, kind="rate")
    assert (cumulative.attrs["kind"], increments.attrs["kind"]) == ("angle", "increment")
    for raw in (cumulative, increments):
        np.testing.assert_allclose(raw.angle[0], [1, 2])
        assert raw.angle.attrs["units"] == "degree"
    with pytest.raises(OptionError, match="--kind angle, but column 'gyro_x"):
        read_log(write(tmp_path, PLAIN + "0,1\n1,2\n"), kind="angle")
    with pytest.raises(UnitError, match="partly rates, partly angles"):
        read_log(
            write(tmp_path, "time [s],gyro_x [deg/h],angle_y [deg]\n0,1,1\n1,2,1\n"), kind="rate"
        )


# --- mapping and units


def test_a_mapped_unit_overrules_the_header_and_an_option_does_not(tmp_path: Path) -> None:
    path = write(tmp_path, "time [s],gyro_x [deg/h]\n0,1\n1,2\n")
    log = read_log(path, unit={"gyro": "deg/s"})
    assert float(log.rate[0, 0]) == 1
    assert any("--unit gyro=deg/s is not applied" in note for note in log.attrs["notes"])
    assert float(read_log(path, map={"gyro_x": "gyro_x [deg/s]"}).rate[0, 0]) == 3600


def test_units_for_one_axis_for_all_and_with_a_factor(tmp_path: Path) -> None:
    path = write(tmp_path, "gyro_x,gyro_y,wz\n10,10,10\n10,10,10\n")
    raw = read_log(
        path, rate=1, map={"WZ": "gyro_z"}, unit={"gyro": "0.1 arcsec/s", "gyro_y": "deg/s"}
    )
    np.testing.assert_allclose(raw.rate[:, 0], [1, 36000, 1])


def test_unknown_columns_are_kept_with_a_unit_and_left_out_without(tmp_path: Path) -> None:
    raw = read_log(write(tmp_path, "gyro_x [deg/h],depth [m],state\n1,2,a\n1,2,b\n"), rate=1)
    assert list(raw.data_vars) == ["rate", "depth"]
    assert any("state" in note for note in raw.attrs["notes"])
    assert "depth" not in read_log(
        write(tmp_path, "gyro_x [deg/h],depth [m]\n1,2\n1,2\n"), rate=1, map={"depth": "-"}
    )


@pytest.mark.parametrize(
    ("header", "names"),
    [
        ("Motor voltage [V],Motor_voltage [V]", ["Motor_voltage", "Motor_voltage_2"]),
        ("Temperature_2 [degC],temperature_2 [degC]", ["temperature_2", "temperature_2_2"]),
        ("count [V],count_channel [V]", ["count_channel", "count_channel_2"]),
        ("count [V],count [V]", ["count_channel", "count_channel_2"]),
    ],
)
def test_channels_of_one_name_in_the_log_are_kept(
    tmp_path: Path, header: str, names: list[str]
) -> None:
    raw = read_log(write(tmp_path, f"gyro_x [deg/h],{header}\n1,2,3\n1,2,3\n"), rate=1)
    assert [(name, raw[name].values[0]) for name in names] == [(names[0], 2), (names[1], 3)]
    assert any("are renamed" in note and names[1] in note for note in raw.attrs["notes"])


def test_channel_named_like_the_stamps_of_another_gets_another_name(tmp_path: Path) -> None:
    header = "time [s],gyro_x [deg/h],time_temperature [s],temperature [degC]"
    rows = [f"{n},{n},{n},{20 if n % 4 == 0 else ''}" for n in range(12)]
    log = regularise(read_log(write(tmp_path, "\n".join([header, *rows, ""]))))
    assert log.temperature.dims == ("time_temperature",)
    assert log.time_temperature_channel.values.tolist() == list(range(12))


def test_only_the_ramp_has_any_scale(tmp_path: Path) -> None:
    raw = read_log(write(tmp_path, "gyro_x [deg/h],ramp [V],ramp_out [V]\n1,2,3\n1,2,3\n"), rate=1)
    assert [raw[name].attrs["units"] for name in ("ramp", "ramp_out")] == ["1", "V"]


def test_keys_of_columns_are_unique() -> None:
    columns = [FileColumn(name) for name in ("wx", "wx", "wx", "wx_2", "wx")]
    keys = [column.key for column in distinct_columns(columns)]
    assert keys == ["wx", "wx_3", "wx_4", "wx_2", "wx_5"]


@pytest.mark.parametrize(
    ("text", "options", "error", "message"),
    [
        (
            "time [s],gyro_x [deg],angle_x [deg]\n0,1,1\n1,2,1\n",
            {"kind": "rate"},
            FormatError,
            r"2 columns are called 'gyro_x' or 'angle_x' \(.*--map \"angle_x=-\"",
        ),
        (
            "time [s],gyro_x\n0,1\n1,2\n",
            {},
            MissingUnitError,
            r"'gyro_x' carries no unit.*--unit gyro=deg/s",
        ),
        (
            "time [s],gyro_x [furlong]\n0,1\n1,2\n",
            {},
            UnitError,
            r"'furlong' is not known.*--unit gyro=deg/s",
        ),
        (
            "time [s],gyro_x [r/s]\n0,1\n1,2\n",
            {},
            UnitError,
            r"'gyro_x \[r/s\]': unit 'r/s' may be revolutions or radians .*write rev/s or rad/s",
        ),
        (
            "time [s],gyro_x [degC]\n0,1\n1,2\n",
            {},
            UnitError,
            r"a unit of temperature, not of rate",
        ),
        (
            "time [s],gyro_x [deg/h],T\n0,1,2\n1,2,3\n",
            {"map": {"T": "temperature"}},
            MissingUnitError,
            r"--unit temperature=degC.*--map",
        ),
        (
            "time [s],gyro_x [deg/h],temperature [V]\n0,1,2\n1,2,3\n",
            {"unit": {"temperature": "mV"}},
            UnitError,
            r"not a known unit of temperature",
        ),
        (
            "time,gyro_x [deg/h]\n0,1\n1,2\n",
            {},
            MissingUnitError,
            r"time column 'time' carries no unit.*--unit time=s",
        ),
        (
            "time,gyro_x [deg/h]\n05/20/26 08:00:00,1\n05/20/26 08:00:01,2\n",
            {},
            MissingUnitError,
            r"holds '05/20/26 08:00:0.', which is .*year with four digits",
        ),
        (
            "time,gyro_x [deg/h]\n2026-05-20 08:00:00 CST,1\n2026-05-20 08:00:01 CST,2\n",
            {},
            UnitError,
            r"holds '2026-05-20 08:00:0. CST', with the name of a time zone; write the offset",
        ),
        (
            "time,gyro_x [deg/h]\n0,1\n1,2\n",
            {"unit": {"time": "parsec"}},
            UnitError,
            r"'parsec' is not known",
        ),
        (
            "time [s],gyro_x [deg/h],gyro_x [deg/h]\n0,1,1\n1,2,1\n",
            {},
            FormatError,
            r"2 columns are called 'gyro_x'",
        ),
        (
            "time [s],gyro_x [deg/h],Gyro_X [deg/s]\n0,1,1\n1,2,1\n",
            {},
            FormatError,
            r"2 columns are called 'gyro_x'",
        ),
        ("gyro_x [deg/h]\n1\n2\n", {}, OptionError, r"no time column.*--rate HZ"),
        (
            "t_s,gx_dps,gy_dps\n0,1,1\n1,2,1\n",
            {},
            FormatError,
            r"Columns: t_s, gx_dps, gy_dps.*gx_dps=gyro_x\" --unit gyro=deg/s",
        ),
        (
            "time [s],gyro_x [deg/h]\n0,1\n1,2\n",
            {"map": {"wx": "gyro_y"}},
            OptionError,
            r"--map wx: no such column in log.csv; the columns are time \[s\], gyro_x \[deg/h\]",
        ),
        (
            "time [s],gyro_x [deg/h]\n0,1\n1,2\n",
            {"unit": {"gryo": "deg/s"}},
            OptionError,
            r"--unit gryo: no such column",
        ),
        ("time [s],gyro_x [deg/h]\n0,1\n1,2\n", {"rate": -1.0}, OptionError, r"from 1e-09"),
        ("time [s],gyro_x [deg/h]\n0,1\n1,2\n", {"kind": "speed"}, OptionError, r"'rate'.*'angle'"),
        (
            "time [s],gyro_x [deg/h]\n0,1\n1,2\n",
            {"epoch": "long ago"},
            OptionError,
            r"--epoch 'long ago'",
        ),
        (
            "time [s],gyro_x\n0,1\n1,2\n",
            {"unit": {"gyro": "0 deg/s"}},
            UnitError,
            r"'gyro_x': .*the factor 0 is not usable",
        ),
        (
            "time [s],temperature [degC]\n0,1\n1,2\n",
            {},
            FormatError,
            r"no gyro column.*give it as --channel log\.csv",
        ),
        (b"", {}, FormatError, r"log.csv: the file is empty"),
        (b"time [s],gyro_x [deg/h]\r0,1\r", {}, FormatError, r"end with CR alone.* tr '\\r' '\\n'"),
        (b"\n\n  \n", {}, FormatError, r"empty"),
        ("# only\n# comments\n", {}, FormatError, r"only 2 blank or comment lines"),
        (PLAIN, {}, FormatError, r"header \(line 1\) but no data row"),
        (PLAIN + "# end\n", {}, FormatError, r"no data row"),
        (PLAIN + "0,1\n", {}, FormatError, r"only one row of data"),
        (b"PK\x03\x04" + bytes(range(256)) * 8, {}, FormatError, r"this file is packed; unpack it"),
        (b"AB" + bytes(range(256)) * 8, {}, FormatError, r"not text but binary"),
        ("time,gyro_x\n".encode("utf-16"), {}, FormatError, r"UTF-16.*UTF-8"),
        (
            PLAIN + "0,1\n" + "x,y\n" * 3,
            {},
            FormatError,
            r"75 % of 4 rows are unreadable, the first is line 3",
        ),
        ("Dear all,\nplease find the log below.\nRegards\nA.\n", {}, GyrostabError, r"log.csv"),
    ],
)
def test_bad_input_is_explained(
    tmp_path: Path, text: str | bytes, options: dict, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        read_log(write(tmp_path, text), **options)


def test_a_time_column_may_be_mapped_away_or_chosen(tmp_path: Path) -> None:
    path = write(tmp_path, "time [s],timestamp [us],gyro_x [deg/h]\n1,5,1\n2,6,2\n")
    assert ns(read_log(path, map={"timestamp": "-"})) == [10**9, 2 * 10**9]
    assert ns(read_log(path, map={"timestamp": "time", "time": "-"})) == [5000, 6000]
    bare = write(tmp_path, "clock,gyro_x [deg/h]\n1,1\n2,2\n")
    assert ns(read_log(bare, map={"clock": "time [ms]"})) == [10**6, 2 * 10**6]


def test_temperature_called_t_is_not_the_time(tmp_path: Path) -> None:
    raw = read_log(write(tmp_path, "time [s],gyro_x [deg/h],T [degC]\n0,1,20\n1,2,21\n"))
    assert raw["T"].values.tolist() == [20, 21]
    assert ns(read_log(write(tmp_path, "t [s],gyro_x [deg/h]\n0,1\n1,2\n"))) == [0, 10**9]


@pytest.mark.parametrize("units", [True, False])
def test_names_that_differ_in_case_only_are_mapped_as_written(tmp_path: Path, units: bool) -> None:
    """Time and temperature are often called t and T."""
    header = "t [s],gyro_x [deg/h],T [degC]" if units else "t,gyro_x,T"
    unit = {} if units else {"time": "s", "gyro": "deg/h", "temperature": "degC"}
    path = write(tmp_path, f"{header}\n0,1,20\n1,2,21\n")
    for names in ({"t": "time", "T": "temperature"}, {"T": "temperature"}):
        raw = read_log(path, map=names, unit=unit)
        assert raw.temperature.values.tolist() == [20, 21]
        assert ns(raw) == [0, 10**9]
    alone = write(tmp_path, "t [s],gyro_x [deg/h]\n0,1\n1,2\n")
    assert ns(read_log(alone, map={"T": "time"})) == [0, 10**9]


# --- statements of the page on formats


def _page() -> str:
    text = (Path(__file__).resolve().parents[3] / "docs" / "formats.md").read_text(encoding="utf-8")
    return text[text.index("## A log as text") :].split("\n## ")[0]


def _named_on_the_page() -> list[tuple[str, str]]:
    """Yield all columns and units of the page; groups of units belong to names in order."""
    pairs = []
    for row in re.findall(r"^\| (`.*)\|$", _page(), re.M):
        cells = [cell.strip() for cell in row.split("|")]
        names, groups = (
            re.findall(r"`(\w+)`", cells[0]),
            [group.split(", ") for group in cells[2].split(";")],
        )
        if cells[2] != "any, or none" and names != ["rotation_rate"]:
            units_by_name = (
                zip(names, groups, strict=True)
                if len(groups) > 1
                else [(name, groups[0]) for name in names]
            )
            pairs += [(name, unit.strip()) for name, units in units_by_name for unit in units]
    assert {
        ("angle_x", "arcsec"),
        ("gyro_z", "rpm"),
        ("pressure", "psi"),
        ("time", "us"),
        ("mag_y", "nT"),
    } < set(pairs)
    return pairs


def test_every_unit_on_the_page_is_understood(tmp_path: Path) -> None:
    for name, unit in _named_on_the_page():
        others = [] if name == "time" else ["time [s]"]
        header = ",".join(
            [
                *others,
                f"{name} [{unit}]",
                *([] if name.startswith(("gyro", "angle")) else ["gyro_w [deg/h]"]),
            ]
        )
        path = write(
            tmp_path,
            f"{header}\n"
            + "".join(f"{row},{row}" + ",1" * (header.count(",") - 1) + "\n" for row in range(2)),
        )
        raw = read_log(path, kind="angle" if name.startswith("angle") else None)
        assert name in ("time", *raw.data_vars) or name.split("_")[1] in raw["axis"], (name, unit)
        if name in raw.data_vars:
            assert raw[name].units in INNER.values(), (name, unit)


def test_the_log_on_the_page_is_read(tmp_path: Path) -> None:
    raw = read_log(
        write(
            tmp_path,
            "\n".join(line[4:] for line in _page().splitlines() if line.startswith("    ")) + "\n",
        )
    )
    assert raw["axis"].values.tolist() == ["x", "y", "z"]
    assert raw["temperature"].values[0] == 61.2
    assert np.diff(ns(raw)).tolist() == [10_000_000]


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
@pytest.mark.parametrize(("code", "repeats", "is_noted"), [
    (-999.25, 120, True), (9999.0, 3, True), (-999.25, 2, False), (0.0, 120, False),
])  # fmt: skip
def test_a_value_that_repeats_far_outside_all_others_is_noted(
    tmp_path: Path, code: float, repeats: int, is_noted: bool, suffix: str
) -> None:
    random = np.random.default_rng(1)
    gyro = 40.0 + np.round(random.standard_normal((2, 3000)), 4)
    gyro[0, random.choice(3000, repeats, replace=False)] = code
    switch = np.repeat([0.0, 5.0], 1500)
    table = pd.DataFrame({
        "time [s]": np.arange(3000) / 10.0, "gyro_x [deg/s]": gyro[0], "gyro_y [deg/s]": gyro[1],
        "supply_voltage [V]": switch,
    })  # fmt: skip
    path = tmp_path / f"log.{suffix}"
    table.to_csv(path, index=False) if suffix == "csv" else table.to_parquet(path)
    notes = [note for note in read_log(path).attrs["notes"] if "code for a missing" in note]
    assert len(notes) == is_noted
    assert all(f"'gyro_x [deg/s]' is {code:g} in {repeats} of the first" in note for note in notes)


@pytest.mark.parametrize("block_bytes", [2**16, 2**22])
@pytest.mark.parametrize(("first", "step"), [(2500, 50), (2990, 1)])
def test_a_code_that_begins_late_is_noted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, block_bytes: int, first: int, step: int
) -> None:
    monkeypatch.setattr("gyrostab.ingest.columns.raw_log._CODE_ROWS", 1000)
    monkeypatch.setattr("gyrostab.ingest.formats.text.BLOCK_BYTES", block_bytes // 32)
    gyro = np.random.default_rng(1).standard_normal((2, 3000)).round(4)
    gyro[1, first::step] = -999.25
    table = pd.DataFrame({
        "time [s]": np.arange(3000) / 10.0, "gyro_x [deg/s]": gyro[0], "gyro_y [deg/s]": gyro[1],
    })  # fmt: skip
    table.to_csv(tmp_path / "log.csv", index=False)
    notes = [note for note in read_log(tmp_path / "log.csv").attrs["notes"] if "code" in note]
    assert len(notes) == 1
    assert (
        f"'gyro_y [deg/s]' is -999.25 in 10 of {3500 - first} rows from row {first - 500} on"
        in notes[0]
    )


def test_a_common_code_among_few_readings_is_noted(tmp_path: Path) -> None:
    """A coarse temperature has few different values; a switch has two, and no common code."""
    random = np.random.default_rng(1)
    temperature = 20.0 + random.integers(0, 10, 3000)
    temperature[random.choice(3000, 150, replace=False)] = -999.25
    table = pd.DataFrame({
        "time [s]": np.arange(3000) / 10.0, "gyro_x [deg/s]": random.standard_normal(3000),
        "temperature [degC]": temperature, "state [1]": np.where(np.arange(3000) % 9, 0, 5),
    })  # fmt: skip
    table.to_csv(tmp_path / "log.csv", index=False)
    notes = [note for note in read_log(tmp_path / "log.csv").attrs["notes"] if "code" in note]
    assert len(notes) == 1
    assert "'temperature [degC]' is -999.25 in 150 of the first 3000 rows, far" in notes[0]


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_declared_codes_are_missing_and_other_values_stay(
    tmp_path: Path, suffix: str, dtype: type
) -> None:
    """Also where most rows have one: they are readable, unlike other cells without a number."""
    random = np.random.default_rng(2)
    gyro = random.standard_normal((2, 3000)).round(3)
    is_code = random.random((2, 3000)) < 0.7
    temperature = 20.0 + random.integers(0, 10, 3000)
    is_cold = random.random(3000) < 0.1
    table = pd.DataFrame({
        "time [s]": np.arange(3000) / 10.0,
        "gyro_x [deg/s]": np.where(is_code[0], -999.25, gyro[0]).astype(dtype),
        "gyro_y [deg/s]": np.where(is_code[1], 999.99, gyro[1]).astype(dtype),
        "temperature [degF]": np.where(is_cold, -999.25, temperature).astype(dtype),
    })  # fmt: skip
    path = tmp_path / f"log.{suffix}"
    table.to_csv(path, index=False) if suffix == "csv" else table.to_parquet(path)
    raw = read_log(path, missing_value=[-999.25, 999.99])
    expected = np.where(is_code, np.nan, 3600.0 * gyro)
    np.testing.assert_allclose(raw["rate"], expected, rtol=1e-6)
    in_celsius = np.where(is_cold, np.nan, (temperature - 32.0) / 1.8)
    np.testing.assert_allclose(raw["temperature"], in_celsius, rtol=1e-5, atol=1e-5)
    assert raw.attrs["unreadable_rows"] == raw.attrs["unreadable_cells"] == 0
    (note,) = (note for note in raw.attrs["notes"] if "cells that" in note)
    assert note == (
        f"log.{suffix}: cells that are -999.25 or 999.99 are missing: {is_code[0].sum()} of "
        f"'gyro_x [deg/s]', {is_code[1].sum()} of 'gyro_y [deg/s]', {is_cold.sum()} of "
        "'temperature [degF]'"
    )


def test_a_declared_code_hides_no_unreadable_cell(tmp_path: Path) -> None:
    rows = ["time [s],gyro_x [deg/s]", *(f"{i / 10},{i % 7}" for i in range(100))]
    rows[5], rows[9] = "0.4,-999.25", "0.8,oops"
    path = write(tmp_path, "\n".join(rows) + "\n")
    raw = read_log(path, missing_value=-999.25)
    assert np.flatnonzero(np.isnan(raw["rate"].values[0])).tolist() == [4, 8]
    assert raw.attrs["unreadable_rows"] == 1
    assert "line 10 ('oops')" in raw.attrs["notes"][-1]
    # without the option, the code is a value
    assert read_log(path)["rate"].values[0, 4] == -999.25 * 3600.0


@pytest.mark.parametrize("code", [np.nan, np.inf, "-", [0.0, "x"]])
def test_a_code_is_a_number(tmp_path: Path, code: object) -> None:
    path = write(tmp_path, "time [s],gyro_x [deg/s]\n0.0,1\n0.1,2\n")
    with pytest.raises(OptionError, match=r"missing-value .*: give a number such as"):
        read_log(path, missing_value=code)


def test_a_declared_code_is_not_used_on_a_regular_log(tmp_path: Path) -> None:
    """Its values are converted already, so that the number of the file is no longer there."""
    path = to_netcdf(make_log(np.arange(200.0), rate=10.0, unit="deg/h"), tmp_path / "log.nc")
    log = read_log(path, missing_value=5.0)
    assert log["rate"].values[0, 5] == 5.0
    assert any("so --missing-value is not used" in note for note in log.attrs["notes"])

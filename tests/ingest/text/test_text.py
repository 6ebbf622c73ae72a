"""Text logs: layouts, exact stamps, unreadable rows, and a clear message for every bad file."""

from __future__ import annotations

import gzip
from decimal import Decimal
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gyrostab.errors import FormatError, UnitError
from gyrostab.ingest import ReadOptions, read_log, scan_file
from gyrostab.ingest.columns.dates import is_iso
from gyrostab.ingest.columns.stamps import (
    NAT,
    cells_to_ns,
    floats_to_ns,
    integers_to_ns,
    parse_time_unit,
)
from gyrostab.ingest.formats import text as text_reader
from gyrostab.ingest.grid.regularise import regularise
from gyrostab.ingest.text.layout import find_layout
from tests.support.text_logs import PLAIN, ns, write

# --- round trips

NUMBERS = st.floats(-1e6, 1e6, allow_nan=False).map(lambda value: float(f"{value:.9g}"))
VOIDS = {
    ",": ["", "nan", "****", "err"],
    ";": ["", "NaN", "--"],
    "\t": ["", "oops"],
    " ": ["nan", "****"],
}


@st.composite
def logs(draw: st.DrawFn) -> dict[str, object]:
    separator = draw(st.sampled_from([",", ";", "\t", " "]))
    rows = draw(st.integers(2, 12))
    axes = draw(st.lists(st.sampled_from("xyz"), min_size=1, max_size=3, unique=True))
    stamps = draw(st.lists(st.integers(-(10**15), 2 * 10**15), min_size=rows, max_size=rows))
    cells = {axis: draw(st.lists(NUMBERS, min_size=rows, max_size=rows)) for axis in axes}
    order = draw(st.permutations(["time", *axes]))
    holes = draw(st.sets(st.tuples(st.integers(0, rows - 1), st.sampled_from(axes)), max_size=3))
    junk = draw(
        st.lists(
            st.tuples(
                st.integers(0, rows),
                st.sampled_from(["# remark", "", "broken", "1 2 3 4 5 6 7 8 9"]),
            ),
            max_size=2,
        )
    )
    return {
        "separator": separator,
        "rows": rows,
        "axes": axes,
        "stamps": stamps,
        "cells": cells,
        "order": order,
        "holes": {hole: draw(st.sampled_from(VOIDS[separator])) for hole in holes},
        "junk": junk,
        "end": draw(st.sampled_from(["\n", "\r\n"])),
        "gz": draw(st.booleans()),
    }


def render(log: dict[str, object]) -> tuple[str, list[int | None]]:
    """Return the text, and for every expected row its data row, or None if unreadable."""
    separator, holes = log["separator"], log["holes"]
    headers = {"time": "time [us]", **{axis: f"gyro_{axis} [deg/h]" for axis in log["axes"]}}
    lines = [separator.join(headers[name] for name in log["order"])]
    expected: list[int | None] = []
    for row in range(log["rows"] + 1):
        for at, junk in log["junk"]:
            if at == row:
                lines.append(junk)
                expected += [None] if junk.strip() and not junk.startswith("#") else []
        if row < log["rows"]:
            values = {
                axis: holes.get((row, axis), repr(log["cells"][axis][row])) for axis in log["axes"]
            }
            lines.append(
                separator.join(
                    {"time": str(log["stamps"][row]), **values}[name] for name in log["order"]
                )
            )
            expected.append(row)
    return log["end"].join(lines) + log["end"], expected


@given(logs())
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_written_values_are_read_back(tmp_path: Path, log: dict[str, object]) -> None:
    text, expected = render(log)
    data = gzip.compress(text.encode()) if log["gz"] else text.encode()
    path = write(tmp_path, data, "log.csv.gz" if log["gz"] else "log.csv")
    lost = [
        row is None or all((row, axis) in log["holes"] for axis in log["axes"]) for row in expected
    ]
    if sum(lost) > 0.5 * len(expected):
        with pytest.raises(FormatError, match="rows are unreadable"):
            read_log(path)
        return
    raw = read_log(path)
    assert raw.sizes["row"] == len(expected)
    assert raw.attrs["unreadable_rows"] == sum(lost)
    inside = [
        log["stamps"][row] * 1000
        for row, bad in zip(expected, lost, strict=True)
        if row is not None and not bad
    ]
    for index, row in enumerate(expected):
        stamp = int(raw.time.values[index].astype(np.int64))
        if row is None:
            assert stamp == NAT
        elif not lost[index] or min(inside) <= log["stamps"][row] * 1000 <= max(inside):
            assert stamp == log["stamps"][row] * 1000
        else:
            assert stamp == NAT
        for axis in log["axes"]:
            value = float(raw.rate.sel(axis=axis)[index])
            if row is None or (row, axis) in log["holes"]:
                assert np.isnan(value)
            else:
                assert value == log["cells"][axis][row]


@given(st.data())
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_block_size_does_not_matter(tmp_path: Path, data: st.DataObject) -> None:
    rows = [f"{n},{n * 0.25}" for n in range(300)]
    for at in data.draw(st.sets(st.integers(0, 299), max_size=6)):
        rows[at] = data.draw(st.sampled_from(["1,2,3", "x,y", "# c", "", f"{at},****"]))
    path = write(tmp_path, PLAIN + "\n".join(rows))
    whole = read_log(path)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(text_reader, "BLOCK_BYTES", data.draw(st.integers(16, 900)))
        pieces = text_reader.read(path, ReadOptions())
    np.testing.assert_array_equal(pieces.rate, whole.rate)
    np.testing.assert_array_equal(pieces.time, whole.time)
    for name in ("unreadable_rows", "unreadable_cells", "notes"):
        assert pieces.attrs[name] == whole.attrs[name]


# --- stamps


@pytest.mark.parametrize(
    ("unit", "texts"),
    [
        ("s", ["1767225600.123456789", "1767225600.1234567894"]),
        ("s", ["0.1", "0.30000000000000004"]),
        ("s", ["1.7672256e9", "1767225600.5"]),
        ("s", ["-0.5", "0.25"]),
        ("ms", ["1767225600123.456789", "1767225600123.456790"]),
        ("us", ["1767225600123457", "1767225600123459"]),
        ("us", ["9007199254740993.125", "9007199254740993.5"]),
        ("ns", ["1767225600123456789", "1767225600123456791"]),
        ("ns", ["1.40363657975856E+018", "1.40363657976356E+018"]),
        ("0.1 ms", ["17672256001234", "17672256001235"]),
        ("min", ["29453760.1", "29453760.2"]),
    ],
)
def test_stamps_keep_every_digit(tmp_path: Path, unit: str, texts: list[str]) -> None:
    raw = read_log(
        write(
            tmp_path, f"time [{unit}],gyro_x [deg/h]\n" + "".join(f"{text},1\n" for text in texts)
        )
    )
    per_unit = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1, "0.1 ms": 10**5, "min": 60 * 10**9}[
        unit
    ]
    assert ns(raw) == [round(Fraction(Decimal(text)) * per_unit) for text in texts]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("2026-11-20T14:00:00", "2026-11-20T14:00:00"),
        ("2026-11-20 14:00:00.123456789", "2026-11-20T14:00:00.123456789"),
        ("2026-11-20T14:00:00Z", "2026-11-20T14:00:00"),
        ("2026-11-20T16:00:00.5+02:00", "2026-11-20T14:00:00.5"),
        ("20261120T140000", "2026-11-20T14:00:00"),
        ("2026-11-20", "2026-11-20T00:00:00"),
    ],
)
def test_iso_stamps(tmp_path: Path, text: str, expected: str) -> None:
    raw = read_log(write(tmp_path, f"time,gyro_x [deg/h]\n{text},1\n{text},2\n"))
    assert raw.time.values.tolist() == [np.datetime64(expected, "ns").item()] * 2
    assert not any("1970" in note for note in raw.attrs["notes"])


def test_stamps_of_mixed_zones(tmp_path: Path) -> None:
    rows = (
        "2026-01-01T00:00:00Z,1\n2026-01-01T01:00:01+01:00,2\n2026-01-01T00:00:02,3\nyesterday,4\n"
    )
    raw = read_log(write(tmp_path, "time,gyro_x [deg/h]\n" + rows))
    start = int(np.datetime64("2026-01-01", "ns").astype(np.int64))
    assert ns(raw) == [start, start + 10**9, start + 2 * 10**9, NAT]


def test_epoch_shifts_numeric_time_and_is_noted_once(tmp_path: Path) -> None:
    path = write(tmp_path, "time [s],gyro_x [deg/h]\n0,1\n0.5,2\n")
    assert (
        sum(
            "1970-01-01" in note
            for note in read_log([path, write(tmp_path, path.read_text(), "b.csv")]).attrs["notes"]
        )
        == 1
    )
    raw = read_log(path, epoch="2026-01-01T00:00:00Z")
    assert raw.time.values[1] == np.datetime64("2026-01-01T00:00:00.5")
    assert raw.attrs["notes"] == []


@given(
    st.integers(-(2**62), 2**62),
    st.sampled_from(["s", "ms", "us", "ns"]),
    st.integers(-(10**18), 10**18),
)
def test_integers_convert_exactly_or_not_at_all(value: int, unit: str, epoch: int) -> None:
    parsed = parse_time_unit(unit)
    exact = value * int(parsed.ns) + epoch
    stamp = int(integers_to_ns(np.array([value]), parsed, epoch)[0])
    assert stamp == exact or (stamp == NAT and abs(value * int(parsed.ns)) > 2**63 - 2 - 10**18)


@given(st.floats(-1e9, 1e9), st.sampled_from(["s", "ms"]))
def test_binary_floats_convert_to_the_nearest_nanosecond(value: float, unit: str) -> None:
    parsed = parse_time_unit(unit)
    stamp = int(floats_to_ns(np.array([value]), parsed, 0)[0])
    assert abs(stamp - Fraction(value) * parsed.ns) <= Fraction(1, 2) + Fraction(1, 10**6)


def test_cell_parser_refuses_text_that_is_not_a_number() -> None:
    cells = ["1", " 2.5 ", "1_0", "0x10", "nan", "inf", "", "1e400", "1e-400"]
    assert cells_to_ns(cells, parse_time_unit("s"), 0).tolist() == [
        10**9,
        25 * 10**8,
        NAT,
        NAT,
        NAT,
        NAT,
        NAT,
        NAT,
        0,
    ]
    assert not is_iso("20261120")
    with pytest.raises(UnitError, match="time unit 'fortnight'"):
        parse_time_unit("fortnight")


# --- unreadable rows


def test_unreadable_rows_are_counted_and_named_by_line(tmp_path: Path) -> None:
    lines = ["# head", "time [s],gyro_x [deg/h],gyro_y [deg/h],temperature [degC]"]
    lines += [
        "0,1,1,20",
        "1,2,****,",
        "2,3",
        "# pause",
        "",
        "3,oops,4,warm",
        "4,5,5,",
        "5,nan,inf,",
        "6,1,1,1,1",
        "7,8,8,21",
    ]
    raw = read_log(write(tmp_path, "\n".join(lines)))
    nan = np.nan
    np.testing.assert_array_equal(
        raw.rate, [[1, 2, nan, nan, 5, nan, nan, 8], [1, nan, nan, 4, 5, nan, nan, 8]]
    )
    np.testing.assert_array_equal(raw.temperature, [20, nan, nan, nan, nan, nan, nan, 21])
    assert ns(raw) == [0, 10**9, NAT, 3 * 10**9, 4 * 10**9, 5 * 10**9, NAT, 7 * 10**9]
    assert raw.attrs["unreadable_rows"] == 3
    notes = " | ".join(raw.attrs["notes"])
    assert "3 of 8 rows are unreadable: lines 5 ('2,3'), 10, 11" in notes
    places = "lines 4 ('****'), 8"
    assert f"2 gyro cells hold no number in rows that are readable otherwise: {places}" in notes


def test_number_in_an_unreadable_row_is_not_a_stamp(tmp_path: Path) -> None:
    raw = read_log(write(tmp_path, "time [s],gyro_x [deg/h]\n100,1\n101,2\n102,\n103,3\n5,\n"))
    assert ns(raw) == [100 * 10**9, 101 * 10**9, 102 * 10**9, 103 * 10**9, NAT]


def test_unmatched_quote_does_not_hide_rows(tmp_path: Path) -> None:
    rows = (
        "".join(f"{n},{n},ok\n" for n in range(20))
        .replace("7,7,ok", '7,7,"5 inch')
        .replace("9,9,ok", '9,9,5" hole')
    )
    raw = read_log(write(tmp_path, "time [s],gyro_x [deg/h],remark\n" + rows))
    assert ns(raw) == [n * 10**9 for n in range(20)]
    assert raw.attrs["unreadable_rows"] <= 1


@pytest.mark.parametrize("junk", [bytes(4096), bytes(range(256)) * 20, bytes(100) + b'"'])
def test_binary_data_within_a_log_affects_single_rows(tmp_path: Path, junk: bytes) -> None:
    rows = [f"{n},{n}\n".encode() for n in range(2000)]
    raw = read_log(
        write(
            tmp_path, PLAIN.encode() + b"".join(rows[:1000]) + junk + b"\n" + b"".join(rows[1000:])
        )
    )
    good = np.isfinite(raw.rate[0].values)
    assert set(raw.rate[0].values[good]) == set(range(2000))
    assert 1 <= raw.attrs["unreadable_rows"] <= 1 + 2 * junk.count(b"\n")


@pytest.mark.parametrize("keep", [0.02, 0.5, 0.99])
def test_a_truncated_gzip_is_refused_with_advice(tmp_path: Path, keep: float) -> None:
    rng = np.random.default_rng(0)
    whole = gzip.compress(
        (PLAIN + "".join(f"{n},{v:.6f}\n" for n, v in enumerate(rng.normal(size=50_000)))).encode()
    )
    path = write(tmp_path, whole[: int(keep * len(whole))], "log.csv.gz")
    with pytest.raises(
        FormatError, match=r"log.csv.gz: the gzip stream is damaged or cut off; .* bytes.*gzip -dc"
    ):
        read_log(path)


def test_a_scan_reports_problems_instead_of_raising(tmp_path: Path) -> None:
    summary = scan_file(write(tmp_path, "t_s,gx_dps\n0,1\n1,2\n"))
    assert summary.axes == ()
    assert any("no gyro column" in note for note in summary.notes)
    assert [column.role for column in summary.columns] == ["time", "left out"]
    assert summary.last == np.datetime64(1, "s")


def test_the_head_of_a_big_file_may_end_inside_a_line() -> None:
    layout = find_layout(Path("x.csv"), b"time [s],gyro_x [deg/h]\n0,1\n1,2\n2,", complete=False)
    assert layout.samples == (("0", "1"), ("1", "2"))
    assert (layout.offset, layout.line) == (24, 2)


def test_layout_is_that_of_the_first_lines_and_a_later_bad_byte_is_noted() -> None:
    head = b"\xef\xbb\xbf# a tool\ntime [s],gyro_x [deg/h]\n" + b"".join(
        b"%d,1.5\n\n" % n for n in range(3000)
    )
    short = find_layout(Path("x.csv"), head[: head.index(b"\n400,")], complete=False)
    assert (short.headers, short.line) == (("time [s]", "gyro_x [deg/h]"), 3)
    assert find_layout(Path("x.csv"), head, complete=True) == short
    strange = find_layout(
        Path("x.csv"), head[3:].replace(b"\n2500,1.5", b"\n2500,\xb0"), complete=True
    )
    assert strange.notes == ("line 5003 is not UTF-8 (b'\\xb0'); the text was read as Latin-1",)


def test_lines_above_the_header_may_be_padded_to_its_width(tmp_path: Path) -> None:
    """Spreadsheets write a title with the separators of the table."""
    text = "Tester v3;;;\nSerial;123;;\ntime;gyro_x;gyro_y;gyro_z\ns;deg/h;deg/h;deg/h\n"
    raw = read_log(write(tmp_path, text + "0;1;2;3\n1;4;5;6\n"))
    assert raw.rate.values.T.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert any("skipped 2 lines above the header" in note for note in raw.attrs["notes"])


LABVIEW = "LabVIEW Measurement\t\nWriter_Version\t2\nReader_Version\t2\nSeparator\tTab\n" + (
    "Decimal_Separator\t,\nMulti_Headings\tNo\nX_Columns\tOne\nTime_Pref\tRelative\nOperator\tK\n"
    "Date\t2026/05/01\nTime\t08:00:00,5\n***End_of_Header***\t\n\t\nChannels\t2\t\t\n"
    "Samples\t3\t3\t\nDate\t2026/05/01\t2026/05/01\t\nTime\t08:00:00,5\t08:00:00,5\t\n"
    "Y_Unit_Label\tdeg/h\tdeg/h\t\nX_Dimension\tTime\tTime\t\nX0\t0,0E+0\t0,0E+0\t\n"
    "Delta_X\t0,100000\t0,100000\t\n***End_of_Header***\t\t\t\nX_Value\tgyro_x\tgyro_y\tComment\n"
)


@pytest.mark.parametrize(
    ("above", "rows", "line"),
    [
        ("key,value\n" * 30 + "X_Value,gyro_x,gyro_y\n", "{},{},-2.5\n", 32),
        ("title: a b\n" * 150 + "X_Value,gyro_x,gyro_y,\n", "{},{},-2.5\n", 152),
        (LABVIEW, "{}\t{}\t-2,5\n", 24),
        (LABVIEW, "{}\t{}\t-2,5\t\n", 24),
    ],
)
def test_a_header_may_be_below_many_lines_and_longer_than_its_rows(
    tmp_path: Path, above: str, rows: str, line: int
) -> None:
    path = write(tmp_path, above + "".join(rows.format(row, 3 * row) for row in range(40)))
    raw = read_log(path, map={"X_Value": "time"}, unit={"time": "s", "gyro": "deg/h"})
    assert find_layout(path, path.read_bytes(), complete=True).line == line
    np.testing.assert_array_equal(raw["rate"], [range(0, 120, 3), [-2.5] * 40])


@pytest.mark.parametrize(
    ("labels", "is_noted"), [("AB", True), ("ABC", True), ("AAAABBBB", False), ("A", False)]
)
@pytest.mark.parametrize("lag", [0, 37])
def test_rows_of_several_tools_in_one_file_are_noted(
    tmp_path: Path, labels: str, lag: int, is_noted: bool
) -> None:
    """Rows of tools that log at the same time, or one shortly after another."""
    tools = len(set(labels))
    rows = "".join(
        f"{n // tools * 100 + n % tools * lag},{labels[n % len(labels)]},{n % 7}\n"
        for n in range(300)
    )
    path = write(tmp_path, "time [ms],tool,gyro_x [deg/h]\n" + rows)
    notes = [*scan_file(path).notes, *read_log(path).attrs["notes"]]
    found = [note for note in notes if "several tools" in note]
    assert len(found) == 2 * is_noted
    assert all("'tool'" in note and "write a file for each" in note for note in found)


@pytest.mark.parametrize("damage", ["", "4,bad,,3,2\n"])
def test_axes_and_channels_without_a_number_are_named(tmp_path: Path, damage: str) -> None:
    header = "time [s],gyro_x [deg/h],gyro_y [deg/h],gyro_z [deg/h],temperature [degC]\n"
    rows = "".join(f"{n},{n % 3},{n % 2},,\n" for n in range(40))
    path = write(tmp_path, header + rows.replace("4,1,0,,\n", damage or "4,1,0,,\n", 1))
    text = "\n".join(regularise(read_log(path)).attrs["notes"])
    named = ["axis z", "channel temperature"] if not damage else []
    for name in named:
        assert f"no row holds a number for {name}" in text
    assert ("--map HEADER=- drops" in text) == (not damage)  # every reading command has --map
    assert ("lines 2 ('0,0,0,,'), 3, 4" in text) == bool(damage)


def test_cells_without_a_number_are_counted_without_those_of_an_empty_axis(tmp_path: Path) -> None:
    rows = "".join(f"{n},{'' if n == 7 else n % 3},{n % 2},\n" for n in range(40))
    header = "time [s],gyro_x [deg/h],gyro_y [deg/h],gyro_z [deg/h]\n"
    (note,) = read_log(write(tmp_path, header + rows + "bad,1,2,\n")).attrs["notes"][-1:]
    assert note.endswith("1 gyro cells hold no number in rows that are readable otherwise")


@pytest.mark.parametrize(
    ("later", "change"),
    [
        (
            "time [s],gyro_x [deg/s],gyro_y [deg/h]",
            r"'gyro_x \[deg/s\]' in place of 'gyro_x \[°/h\]'",
        ),
        (
            "time [s],gyro_y [deg/h],gyro_x [°/h]",
            r"'gyro_y \[deg/h\]' in place of 'gyro_x \[°/h\]'",
        ),
        (
            "time [s],gyro_x [°/h],gyro_y [deg/h],gyro_z [deg/h]",
            r"'gyro_z \[deg/h\]' in place of ''",
        ),
        ("time [s],gyro_x [°/h],gyro_y [deg/h]", None),
        ("time is lost,gyro_x,", None),
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "latin-1"])
def test_a_later_header_that_differs_is_refused(
    tmp_path: Path, later: str, change: str | None, encoding: str
) -> None:
    """A logger that was configured anew appends a header; the rows below it have other units."""
    rows = [f"{n},{n % 7},{n % 5}\n" for n in range(600)]
    text = "time [s],gyro_x [°/h],gyro_y [deg/h]\n" + "".join(
        [*rows[:300], later + "\n", *rows[300:]]
    )
    path = write(tmp_path, text.encode(encoding))
    if change is None:
        raw = read_log(path)
        assert (raw.sizes["row"], raw.attrs["unreadable_rows"]) == (601, 1)
        return
    with pytest.raises(FormatError, match=rf"log.csv: line 302 is a header .*: {change}; cut"):
        read_log(path)


@pytest.mark.parametrize(("unit", "is_refused"), [("deg/h", False), ("deg/s", True)])
def test_later_units_under_a_header_are_compared(
    tmp_path: Path, unit: str, is_refused: bool
) -> None:
    head = "time;gyro_x\ns;{}\n"
    rows = "".join(f"{n};{n % 7}\n" for n in range(30))
    path = write(tmp_path, head.format("deg/h") + rows + head.format(unit) + rows)
    if not is_refused:
        assert read_log(path).attrs["unreadable_rows"] == 2
        return
    with pytest.raises(FormatError, match=r"log.csv: line 34 is .* 'deg/s' in place of 'deg/h'"):
        read_log(path)


@pytest.mark.parametrize("ending", ["csv", "csv.gz"])
def test_minus_signs_of_typography_are_read(tmp_path: Path, ending: str) -> None:
    """.NET writes U+2212 in Norwegian, Swedish and Finnish."""
    numbers = np.random.default_rng(0).normal(size=(300, 2)).round(4)
    rows = "".join(f"{n / 50 - 3:.2f};{x:.4f};{y:.3e}\n" for n, (x, y) in enumerate(numbers))
    head = "time [s];gyro_x [deg/h];gyro_y [deg/h]\n"
    plain = read_log(write(tmp_path, head + rows.replace(".", ",")))
    text = (head + rows.replace(".", ",").replace("-", "\N{MINUS SIGN}")).encode()
    path = write(tmp_path, gzip.compress(text) if "gz" in ending else text, f"signs.{ending}")
    raw = read_log(path)
    np.testing.assert_array_equal(raw.rate, plain.rate)
    np.testing.assert_array_equal(raw.time, plain.time)
    assert len(raw.attrs["notes"]) == 1
    assert scan_file(path).first == plain.time[0]


def test_negative_numbers_of_spreadsheets_are_in_parentheses(tmp_path: Path) -> None:
    rows = "".join(
        f"{n};" + (f"{x},25" if x >= 0 else f"({-x},25)") + "\n"
        for n, x in enumerate(range(-12, 12))
    )
    raw = read_log(write(tmp_path, "time [s];gyro_x [deg/h]\n" + rows))
    expected = [x + (0.25 if x >= 0 else -0.25) for x in range(-12, 12)]
    assert raw.rate.values.tolist() == [expected]
    assert not any("unreadable" in note for note in raw.attrs["notes"])


def test_exponents_of_fortran_are_read(tmp_path: Path) -> None:
    rows = "".join(f"{n},{n - 3}.5D-01,{n}d0\n" for n in range(20))
    raw = read_log(write(tmp_path, "time [s],gyro_x [deg/h],gyro_y [deg/h]\n" + rows))
    expected = [[float(f"{n - 3}.5e-1") for n in range(20)], list(range(20))]
    assert raw.rate.values.tolist() == expected
    assert not any("unreadable" in note for note in raw.attrs["notes"])


def test_the_first_of_many_unreadable_rows_is_quoted(tmp_path: Path) -> None:
    rows = "0,1\n" + "".join(f"{n},1.5*10^{n}\n" for n in range(1, 20))
    with pytest.raises(FormatError, match=r"the first is line 3: '1\.5\*10\^1'; look at it"):
        read_log(write(tmp_path, "time [s],gyro_x [deg/h]\n" + rows))

"""Rows of text read by the kernel, against Python reading the same cells."""

from datetime import UTC, datetime, timedelta
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gyrostab.ingest.columns.stamps import NAT
from gyrostab.kernels.encoding.rows import (
    BLANKS,
    DAY_FIRST,
    MONTH_FIRST,
    NUMBER,
    NUMERIC_TIME,
    SKIPPED,
    YEAR_FIRST,
    read_rows,
)

EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def rows_of(
    text: str,
    roles: list[int],
    *,
    separator: str = ",",
    point: str = ".",
    digits: int = 9,
    between: str = " ",
):
    code = BLANKS if separator == " " else ord(separator)
    held = np.frombuffer(text.encode("latin-1"), dtype=np.uint8)
    lines, roles = text.count("\n"), np.array(roles)
    values = np.empty((np.count_nonzero(roles == NUMBER), lines))
    stamps, starts = np.empty(lines, np.int64), np.empty(lines, np.int64)
    row, stop = read_rows(
        held, 0, 0, roles, code, ord(point), digits, ord(between), values, stamps, starts
    )
    return values[:, :row], stamps[:row], stop


numbers = st.one_of(
    st.floats(-1e18, 1e18).map(repr),
    st.floats(-1e-3, 1e-3).map(repr),
    st.tuples(st.integers(-(10**9), 10**9), st.integers(0, 12)).map(
        lambda t: f"{t[0] / 7:.{t[1]}f}"
    ),
    st.integers(-(2**63), 2**63).map(str),
    st.tuples(st.integers(0, 10**18), st.integers(-45, 20)).map(lambda t: f"{t[0]}e{t[1]:+d}"),
    st.sampled_from(
        [
            "0",
            "-0.0",
            "+5",
            ".5",
            "5.",
            "9007199254740993",
            "9007199254740993.0",
            "1e23",
            "8.41e21",
            "1.8446744073709551e19",
        ]
    ),
)


@given(st.lists(numbers, min_size=1, max_size=20))
def test_number_is_the_nearest_double_or_is_not_read(cells):
    for cell in cells:
        values, _, stop = rows_of(cell + "\n", [NUMBER])
        if stop:
            assert values[0, 0] == float(cell)
            assert np.signbit(values[0, 0]) == np.signbit(float(cell))


@pytest.mark.parametrize(
    "cell",
    [
        "0.1",
        "-12.345678",
        "1767225600.0025",
        "3.141592653589793",
        "-2.2250738585072014e-8",
        "1e-5",
        "123456789012345678",
    ],
)
def test_common_numbers_are_read(cell):
    values, _, stop = rows_of(f"{cell}\n", [NUMBER])
    assert stop == len(cell) + 1
    assert values[0, 0] == float(cell)


@pytest.mark.parametrize(
    "cell",
    [
        "****",
        "1_000",
        "0x10",
        "inf",
        "1e",
        "1e5000",
        "-",
        ".",
        "1.2.3",
        '"1',
        '1"',
        ' "1"',
        '"1"2',
        '"1""2"',
        "12 34",
        "1#",
        "e5",
        "-na",
        "nan1",
        "nulls",
        "nothing",
        "--1",
        "1" * 25,
    ],
)
def test_cells_other_than_plain_numbers_are_not_read(cell):
    values, _, stop = rows_of(f"1.5\n{cell}\n2.5\n", [NUMBER])
    assert stop == 4
    assert values.tolist() == [[1.5]]


@pytest.mark.parametrize("row", ["1", "1,2,3", "1,2,", ",,", "1;2"])
def test_row_of_another_width_is_not_read(row):
    assert rows_of(f"{row}\n", [NUMBER, NUMBER])[2] == 0


@pytest.mark.parametrize(
    ("cell", "value"),
    [
        ("", np.nan),
        ("  ", np.nan),
        *((word, np.nan) for word in ("nan", "-NaN", "NA", "N/A", "null", "None", '""', '"NA "')),
        (" 7.5 ", 7.5),
        ("\t7", 7.0),
        ('"7.5"', 7.5),
        ('" -7 " ', -7.0),
    ],
)
def test_void_cells_and_blanks_around_cells(cell, value):
    values, stamps, stop = rows_of(f"1,{cell}\r\n", [NUMERIC_TIME, NUMBER], digits=0)
    assert stop > 0
    assert np.array_equal(values[0], [value], equal_nan=True)
    assert stamps.tolist() == [1]


def test_lines_without_data_are_skipped():
    values, stamps, stop = rows_of(
        "\n# said\n \r\n  % too\n1,2\n\n\n3,\n", [NUMERIC_TIME, NUMBER], digits=0
    )
    assert stop == 28
    assert stamps.tolist() == [1, 3]
    assert np.array_equal(values, [[2.0, np.nan]], equal_nan=True)


def test_any_number_of_blanks_separates_cells():
    values, stamps, stop = rows_of(
        "  1.5   2\t-3 \n4 5 6\n7 8\n", [NUMBER, SKIPPED, NUMERIC_TIME], separator=" ", digits=0
    )
    assert values.tolist() == [[1.5, 4.0]]
    assert stamps.tolist() == [-3, 6]
    assert stop == 20


def test_decimal_comma_and_skipped_columns():
    values, _, stop = rows_of(
        "word;1,25;2,5\n", [SKIPPED, NUMBER, NUMBER], separator=";", point=","
    )
    assert values.tolist() == [[1.25], [2.5]]
    assert stop == 14
    values, _, _ = rows_of('"a;b";"1,25";2\n', [SKIPPED, NUMBER, NUMBER], separator=";", point=",")
    assert values.tolist() == [[1.25], [2.0]]
    for cell in ('"a"";b"', 'a"b"', '"a', '"a#"'):
        assert rows_of(f"{cell};1;2\n", [SKIPPED, NUMBER, NUMBER], separator=";")[2] == 0


@pytest.mark.parametrize(
    ("zone", "minutes"),
    [("Z", 0), ("+00:00", 0), ("+01", 60), ("-0530", -330), ("+13:45", 825), ("", 0)],
)
def test_zones_of_dates(zone, minutes):
    stamps = rows_of(f"1970-01-02T00:00:00.5{zone},1\n", [YEAR_FIRST, NUMBER])[1]
    assert stamps.tolist() == [86_400_500_000_000 - minutes * 60 * 10**9]


@pytest.mark.parametrize("zone", ["+", "+1", "+24:00", "-00:60", "+01:", "+1:30", "z", " Z"])
def test_wrong_zones_are_not_read(zone):
    assert rows_of(f"1970-01-02T00:00:00{zone},1\n", [YEAR_FIRST, NUMBER])[2] == 0


def test_rows_after_a_row_of_the_caller():
    text = np.frombuffer(b"1\n# said\n2\nword\n3\n", dtype=np.uint8)
    values, stamps, starts = np.zeros((1, 4)), np.empty(4, np.int64), np.zeros(4, np.int64)
    options = np.array([NUMBER]), 44, 46, 0, 32, values, stamps, starts
    assert read_rows(text, 0, 0, *options) == (2, 11)
    assert read_rows(text, 16, 3, *options) == (4, 18)
    assert values.tolist() == [[1.0, 2.0, 0.0, 3.0]]
    assert starts.tolist() == [0, 9, 0, 16]


@given(st.integers(-(10**18), 10**18), st.integers(0, 9), st.integers(0, 9))
def test_numeric_times_are_exact_and_halves_round_to_even(count, decimals, digits):
    text = (
        f"{'-' if count < 0 else ''}{abs(count) // 10**decimals}"
        f".{abs(count) % 10**decimals:0{decimals}d}"
        if decimals
        else str(count)
    )
    _, stamps, stop = rows_of(f"{text}\n", [NUMERIC_TIME], digits=digits)
    expected = round(Fraction(count, 10**decimals) * 10**digits)
    if stop:
        assert stamps[0] == expected
    else:
        assert abs(expected) >= 10**18 or digits == 0 or len(text.strip("-").replace(".", "")) > 19


@given(
    st.datetimes(datetime(1700, 1, 1), datetime(2199, 12, 31), timezones=st.just(UTC)),
    st.integers(0, 9),
    st.sampled_from("T "),
    st.sampled_from(["", "Z"]),
)
def test_dates_are_those_of_the_calendar(moment, digits, between, zone):
    fraction = f".{moment.microsecond:06d}000"[: digits + 1] if digits else ""
    text = f"{moment:%Y-%m-%d}".rjust(10, "0") + between + f"{moment:%H:%M:%S}{fraction}{zone}"
    _, stamps, stop = rows_of(f"{text}\n", [YEAR_FIRST])
    whole = moment.replace(microsecond=0) - EPOCH
    part = int(fraction[1:].ljust(9, "0")) if fraction else 0
    assert stop == len(text) + 1
    assert stamps[0] == whole // timedelta(seconds=1) * 10**9 + part


@pytest.mark.parametrize(
    "text",
    [
        "2025-02-29T00:00:00",
        "2026-04-31T00:00:00",
        "2026-13-01T00:00:00",
        "2026-01-01T24:00:00",
        "2026-01-01T00:00:60",
        "2026-01-01T00:0",
    ],
)
def test_dates_that_do_not_exist_are_not_read(text):
    assert rows_of(f"{text}\n", [YEAR_FIRST])[2] == 0
    assert rows_of("\n", [YEAR_FIRST])[1].tolist() == []
    assert rows_of(",1\n", [YEAR_FIRST, NUMBER])[1].tolist() == [NAT]


def test_dates_to_the_minute():
    stamps = rows_of("1970-01-02 00:01,1.5\n1970-01-02T00:02Z,1.5\n", [YEAR_FIRST, NUMBER])[1]
    assert stamps.tolist() == [86_460 * 10**9, 86_520 * 10**9]


@given(
    st.datetimes(datetime(1700, 1, 1), datetime(2199, 12, 31)),
    st.sampled_from("-/."),
    st.sampled_from("T ,"),
    st.sampled_from([YEAR_FIRST, DAY_FIRST, MONTH_FIRST]),
)
def test_dates_of_any_order_and_mark(stamp, mark, between, order):
    parts = {YEAR_FIRST: "%Y|%m|%d", DAY_FIRST: "%d|%m|%Y", MONTH_FIRST: "%m|%d|%Y"}[order]
    text = f"{stamp:{parts.replace('|', mark)}{between}%H:%M:%S.%f}"
    stamps = rows_of(f"{text},1\n", [order, NUMBER], between=between)[1]
    expected = (stamp.replace(tzinfo=UTC) - EPOCH) // timedelta(microseconds=1) * 1000
    assert stamps.tolist() == [expected]
    if between == ",":  # two cells only where the caller says so
        assert rows_of(f"{text},1\n", [order, NUMBER])[2] == 0


@pytest.mark.parametrize("text", ["2026-05/01 08:00:00", "2026-13-01 08:00:00", "1/5/2026 8:00:00"])
def test_other_dates_are_left_to_the_caller(text):
    assert rows_of(f"{text} ,1\n", [YEAR_FIRST, NUMBER])[2] == 0


@pytest.mark.parametrize(("separator", "cell", "is_read"), [
    (";", "2026-05-01 08:00:00,25", True), (" ", "2026-05-01T08:00:00,25", True),
    (",", '"2026-05-01 08:00:00,25"', True), (",", "2026-05-01 08:00:00,25", False),
])  # fmt: skip
def test_comma_before_the_fraction_of_a_second(separator: str, cell: str, is_read: bool) -> None:
    text = f"{cell}{separator}1.5\n"
    values, stamps, stop = rows_of(text, [YEAR_FIRST, NUMBER], separator=separator)
    assert stop == (len(text) if is_read else 0)
    if is_read:
        assert np.datetime64(int(stamps[0]), "ns") == np.datetime64("2026-05-01T08:00:00.25")
        assert values[0, 0] == 1.5

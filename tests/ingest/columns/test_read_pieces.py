"""Columns in pieces, in memory and on disk."""

from __future__ import annotations

import threading
from pathlib import Path

import dask
import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st

from gyrostab.ingest import read_log, reading
from gyrostab.ingest.columns import pieces
from gyrostab.ingest.columns.pieces import EvenPiece, Spool, find_even, find_line
from gyrostab.ingest.columns.raw_log import clean_column
from gyrostab.store.lazy import concatenate_columns, read_into, read_slice
from gyrostab.store.threads import MAX_WORKERS, map_in_order


def bits(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values).view(np.int64)


@pytest.mark.parametrize("where", ["memory", "disk", "both"])
def test_pieces_of_every_kind_in_memory_and_on_disk(where):
    spool = Spool()
    values = np.array([1.5, np.nan, 1 / 3, 0.25])
    stamps = np.array([5, 10, 15, 20, 100, 200]).view("datetime64[ns]")
    first, last, uneven = (
        spool.store(part) if where in kinds else part
        for part, kinds in (
            (values[:3], ("disk", "both")),
            (values[3:], ("disk",)),
            (stamps[4:], ("disk",)),
        )
    )
    column = concatenate_columns([first, last], 3)
    times = concatenate_columns([EvenPiece(5, 5, 4), uneven], 3)
    for begin, end in [(0, 4), (2, 4), (3, 4), (2, 2)]:
        np.testing.assert_array_equal(bits(read_slice(column, begin, end)), bits(values[begin:end]))
    for begin, end in [(0, 6), (2, 4), (3, 6), (5, 5)]:
        np.testing.assert_array_equal(read_slice(times, begin, end), stamps[begin:end])
    apart = np.empty((6, 2), "datetime64[ns]")
    read_into(times, 0, 0, apart[:, 1])
    np.testing.assert_array_equal(apart[:, 1], stamps)


def test_stamps_at_even_steps_are_one_piece():
    stamps = np.arange(7, 5000, 5).view("datetime64[ns]")
    assert find_line([find_even(stamps)]) == (7, 5)
    assert find_line([find_even(stamps[:1])]) == (7, 0)
    assert find_line([find_even(part) for part in (stamps[:9], stamps[9:10])]) == (7, 5)
    assert find_line([find_even(part) for part in (stamps[:9], stamps[10:])]) is None
    assert find_line([find_even(stamps[:9]), stamps[9:]]) is None
    uneven = np.delete(stamps, 3)
    assert find_even(uneven) is uneven
    uneven = np.where(np.arange(999) == 3, np.datetime64("NaT"), stamps)
    assert find_even(uneven) is uneven


def text_log(path: Path, first: int, rows: int, *, decimals: int) -> Path:
    rng = np.random.default_rng(first)
    lines = ["time [ms],gyro_x [deg/h],gyro_y [0.02 deg/h],temperature [degC]"]
    for n in range(rows):
        x, y = rng.normal(scale=30), rng.integers(-500, 500)
        temperature = f"{20 + n / 1000:.2f}" if n % 10 == 0 else ""
        lines.append(
            f"{(first + n + 40 * (n > 700)) * 10},{x:.{decimals}f},"
            f"{'****' if n == 333 else y},{temperature}"
        )
    lines[500] = "@@@@,,,"
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("module", [pieces, reading])
@pytest.mark.parametrize("decimals", [3, 12])
def test_log_in_pieces_equals_the_plain_log(tmp_path, monkeypatch, module, decimals):
    paths = [
        text_log(tmp_path / f"{number}.csv", 1100 * number, 1000, decimals=decimals)
        for number in range(3)
    ]
    plain = read_log(paths)
    assert isinstance(plain.rate.data, np.ndarray)
    monkeypatch.setattr(module, "SPILL_BYTES", 100)
    piecewise = read_log(paths)
    assert piecewise.rate.chunks is not None
    xr.testing.assert_identical(piecewise.compute(), plain)
    np.testing.assert_array_equal(bits(piecewise.rate.compute().values), bits(plain.rate.values))


def test_results_come_in_the_order_of_the_items_and_few_are_fetched_ahead():
    fetched: list[int] = []

    def items():
        for n in range(50):
            fetched.append(n)
            yield n

    results = map_in_order(lambda n: n * n, items(), workers=2)
    assert next(results) == 0
    assert len(fetched) <= 5
    assert list(results) == [n * n for n in range(1, 50)]
    with pytest.raises(ZeroDivisionError):
        list(map_in_order(lambda n: 1 / n, [2, 1, 0, 3]))


@pytest.mark.parametrize("cores", [1, 2, 1000])
def test_dask_limits_the_threads(cores: int) -> None:
    with dask.config.set(num_workers=cores):
        names = [*map_in_order(lambda _: threading.current_thread().name, range(40))]
    assert len(set(names)) <= min(cores, MAX_WORKERS)


@given(
    st.lists(
        st.floats(-1e6, 1e6)
        | st.sampled_from([np.nan, np.inf, -np.inf])
        | st.integers(-100, 100).map(float)
        | st.just(7.0)
    )
)
def test_column_is_converted_and_its_range_found(values):
    column = np.array(values, dtype=np.float64)
    is_known = np.isfinite(column) & (column != 7.0)
    missing, declared, low, high, whole = clean_column(held := column.copy(), 3.7, 0.1, [7.0])
    finite = column[is_known]
    assert missing == len(column) - len(finite)
    assert declared == (column == 7.0).sum()
    assert np.array_equal(held, np.where(is_known, column * 3.7 + 0.1, np.nan), equal_nan=True)
    assert (low, high) == (finite.min(initial=np.inf), finite.max(initial=-np.inf))
    assert whole == (finite == np.rint(finite)).all()

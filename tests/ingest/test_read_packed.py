"""Columns are packed in less than 8 bytes a value, and restored exactly."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st

from gyrostab.ingest import read_log, reading
from gyrostab.ingest.columns import pieces
from gyrostab.ingest.columns.pieces import (
    CountsPiece,
    EvenStampsPiece,
    PiecewiseColumn,
    PlainPiece,
    Spool,
)
from gyrostab.ingest.combine import memory_bytes
from gyrostab.ingest.formats import text
from gyrostab.kernels.encoding.compact import (
    even_steps,
    find_grid,
    pack_counts,
    unpack_counts,
    unroll_steps,
)
from gyrostab.kernels.grid.stamps import NO_STAMP, new_state, place
from gyrostab.store.threads import map_in_order


def bits(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values + 0.0).view(np.int64)  # a packed zero has no sign


@given(
    st.lists(st.integers(-(2**31) + 2, 2**31 - 2), min_size=1, max_size=40),
    st.integers(0, 9),
    st.sampled_from([(1.0, 0.0), (0.02, 0.0), (1 / 3, 0.0), (1.8, 32.0)]),
    st.sampled_from([None, np.nan, np.inf, -np.inf]),
)
def test_packed_decimals_equal_parsed_ones(wholes, digits, law, missing):
    texts = [
        f"{'-' * (n < 0)}{abs(n) // 10**digits}.{abs(n) % 10**digits:0{digits}d}"
        if digits
        else str(n)
        for n in wholes
    ]
    values = np.array([float(text) for text in texts] + ([] if missing is None else [missing]))
    counts, (factor, offset) = np.empty(values.size, np.int32), law
    fits, absent, low, high, whole = pack_counts(values, 1.0, 10.0**digits, counts)
    known = values[np.isfinite(values)]
    assert fits
    assert absent == values.size - known.size
    assert whole == bool((known == np.rint(known)).all())
    if known.size:
        assert (low, high) == (known.min(), known.max())
    back = np.empty(values.size)
    unpack_counts(counts, 1.0, 10.0**digits, factor, offset, back)
    expected = np.where(np.isfinite(values), values, np.nan) * factor + offset
    np.testing.assert_array_equal(
        bits(back[np.isfinite(values)]), bits(expected[np.isfinite(values)])
    )
    assert np.isnan(back[~np.isfinite(values)]).all()


def test_the_count_of_missing_values_is_not_packed_as_a_value():
    values = np.array([1.0, 2.0, -(2.0**31), 3.0])
    assert not pack_counts(values, 1.0, 1.0, np.empty(4, dtype=np.int32))[0]


def test_a_negative_zero_is_packed_as_zero():
    values = np.array([-0.0, 0.02, -0.04])  # as np.rint makes one of -0.3 counts
    counts = np.empty(3, np.int32)
    assert find_grid(values) == (1.0, 100.0)
    assert pack_counts(values, 0.02, 1.0, counts)[0]
    assert counts.tolist() == [0, 1, -2]


@pytest.mark.parametrize("odd", [1 / 3, 2.0**31, np.nextafter(0.25, 1), 1e300])
def test_other_numbers_than_32_bit_decimals_are_not_packed(odd):
    values = np.array([1.0, odd, 2.5])
    assert not pack_counts(values, 1.0, 100.0, np.empty(3, np.int32))[0]
    assert find_grid(np.array([1.0, 2.5, np.nan])) == (1.0, 10.0)


@given(
    st.lists(st.integers(-(2**24), 2**24), min_size=1, max_size=300),
    st.floats(1e-12, 1e6),
    st.booleans(),
)
def test_counts_times_any_scale_or_over_any_sensitivity_are_packed(counts, scale, is_divisor):
    wholes = np.array([1, *counts], float)
    values = wholes / scale if is_divisor else wholes * scale
    grid = find_grid(values)
    assert grid is not None
    packed, back = np.empty(values.size, np.int32), np.empty(values.size)
    fits, _, low, high, _ = pack_counts(values, *grid, packed)
    assert fits or len(counts) > 256
    if fits:
        assert (low, high) == (values.min(), values.max())
        unpack_counts(packed, *grid, 1.0, 0.0, back)
        np.testing.assert_array_equal(back, values)


@given(st.integers(0, 2**32 - 1), st.integers(1, 400))
def test_packed_even_steps_are_restored(seed, n):
    rng = np.random.default_rng(seed)
    steps = np.where(rng.random(n) < 0.005, rng.integers(-(10**12), 10**12, n), 2_500_000)
    stamps = 1_767_225_600_000_000_000 + np.cumsum(steps)
    stamps[rng.random(n) < 0.002] = NO_STAMP
    table = even_steps(stamps)
    if table is None:
        assert n < 2000
        return
    for begin, end in [(0, n), (n // 3, n // 2), (n - 1, n)]:
        out = np.empty(end - begin, np.int64)
        unroll_steps(table, begin, out)
        np.testing.assert_array_equal(out, stamps[begin:end])


def test_uneven_steps_are_not_packed():
    jitter = np.random.default_rng(0).integers(-50, 50, 5000)
    assert even_steps(np.arange(5000) * 2_500_000 + jitter) is None
    assert len(even_steps(np.arange(5000) * 2_500_000)) == 1


@pytest.mark.parametrize("where", ["memory", "disk", "both"])
def test_pieces_of_every_kind_in_memory_and_on_disk(where):
    spool = Spool()
    floats = np.array([0.5, np.nan, 1 / 3])
    pieces = PiecewiseColumn(
        np.float64,
        [
            CountsPiece(np.array([15, -(2**31), 7], np.int32), (1.0, 10.0), 3600.0, 1.0),
            PlainPiece(bits(floats)),
        ],
    )
    expected = np.array([1.5 * 3600 + 1, np.nan, 0.7 * 3600 + 1, *floats])
    stamps = np.array([5, 10, 15, 20, 100, 200])
    times = PiecewiseColumn(
        "datetime64[ns]", [EvenStampsPiece(np.array([[0, 5, 5]]), 4), PlainPiece(stamps[4:].copy())]
    )
    if where == "both":
        pieces._pieces[0] = pieces._pieces[0].to_spool(spool)
    if where == "disk":
        held = pieces.memory_bytes
        pieces.move_to(spool)
        times.view(np.int64).move_to(spool)  # a view is the same column
        assert held == 12 + 24
        assert pieces.memory_bytes == 0
        assert times.memory_bytes == 24
    for begin, end in [(0, 6), (2, 4), (3, 6), (5, 5)]:
        np.testing.assert_array_equal(bits(pieces[begin:end]), bits(expected[begin:end]))
        np.testing.assert_array_equal(times[begin:end].view(np.int64), stamps[begin:end])
    times.changed, times.value = np.array([1, 5]), NO_STAMP
    stamps[[1, 5]] = NO_STAMP
    np.testing.assert_array_equal(times[:].view(np.int64), stamps)


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


@pytest.mark.parametrize("limit", [100, 10**9])
@pytest.mark.parametrize("decimals", [3, 12])
def test_packed_log_equals_the_plain_log(tmp_path, monkeypatch, limit, decimals):
    paths = [
        text_log(tmp_path / f"{number}.csv", 1100 * number, 1000, decimals=decimals)
        for number in range(3)
    ]
    plain = read_log(paths)
    assert isinstance(plain.rate.data, np.ndarray)
    monkeypatch.setattr(pieces, "_MAX_PLAIN_VALUES", 0)
    monkeypatch.setattr(reading, "SPILL_BYTES", limit)
    packed = read_log(paths)
    assert packed.rate.chunks is not None
    xr.testing.assert_identical(packed.compute(), plain)
    np.testing.assert_array_equal(bits(packed.rate.compute().values), bits(plain.rate.values))


def test_reading_ahead_stops_with_an_error(tmp_path, monkeypatch):
    paths = [
        text_log(tmp_path / f"{number}.csv", 2000 * number, 2000, decimals=3) for number in range(3)
    ]
    sizes: list[int] = []
    take = text._parse_block

    def slowly(block, **options):
        time.sleep(0.005)
        sizes.append(len(block))
        return take(block, **options)

    def refuse(number, count, path):
        if number == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(text, "_parse_block", slowly)
    monkeypatch.setattr(text, "BLOCK_BYTES", 256)
    with pytest.raises(KeyboardInterrupt):
        read_log(paths, on_file=refuse)
    assert sum(sizes) < paths[0].stat().st_size / 3
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("gyrostab-")]


def test_whole_numbers_at_even_steps_take_less_than_half_the_memory(tmp_path, monkeypatch):
    monkeypatch.setattr(pieces, "_MAX_PLAIN_VALUES", 0)
    path = text_log(tmp_path / "log.csv", 0, 3000, decimals=2)
    assert memory_bytes(read_log(path)) < 0.55 * 8 * 4 * 3000


def test_even_stamps_are_placed_like_nearly_even_ones():
    """With a nanosecond of jitter the kernel takes another path; the log exceeds its memory."""
    rng = np.random.default_rng(5)
    samples = np.sort(rng.choice(50_000, 49_900, replace=False))
    rows = np.concatenate(
        [samples[:30_000], samples[30_001:30_006], samples[30_000:30_001], samples[30_006:]]
    )  # one row comes late
    stamps = 7_000_000_000 + rows * 2_500_000
    stamps[123] = NO_STAMP
    placements = []
    for jitter in (0, 1):
        state, ring = new_state()
        shaken = np.where(
            stamps == NO_STAMP, stamps, stamps + jitter * (np.arange(stamps.size) % 3)
        )
        runs, events = place(
            np.arange(stamps.size), shaken, stamps.size, 2_500_000.0, 0.75, 1e9, state, ring
        )
        placements.append((runs, events[:, :3], state[:3], np.array(ring)))
    for first, second in zip(*placements, strict=True):
        np.testing.assert_array_equal(first, second)
    assert len(placements[0][1]) == 1  # the late row
    assert len(placements[0][0]) > 90  # the gaps


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

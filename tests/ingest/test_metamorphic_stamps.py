"""One log with its rows in other pieces, orders, units of time, zones, blocks and chunks."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import gyrostab
from gyrostab.errors import GyrostabError
from tests.support.raw_rows import START, raw_log, regularise_in_parts, stamps_of

RATE, ROWS = 50.0, 3000
SAMPLES = np.r_[0:1200, 1300:2100, 2101:3101]
VALUES = np.round(np.random.default_rng(8).normal(0, 20, (2, ROWS)), 3)
STAMPS = stamps_of(SAMPLES, RATE)
UNITS = {"s": 10**9, "ms": 10**6, "us": 1000, "ns": 1}


def write_rows(path: Path, rows: np.ndarray, *, unit: str = "ns", zone: str = "") -> Path:
    """Write a text file of rows, with stamps in a unit, or as ISO 8601 in a zone."""
    if unit == "iso":
        hours = int(zone[:3]) if zone not in ("", "Z") else 0
        times = (STAMPS[rows] + hours * 3600 * 10**9).astype("datetime64[ns]")
        cells, header = [f"{text}{zone}" for text in np.datetime_as_string(times)], "time"
    else:
        scale, header = UNITS[unit], f"time [{unit}]"
        digits = len(str(scale)) - 1
        cells = [
            f"{stamp // scale}.{stamp % scale:0{digits}d}" if digits else str(stamp)
            for stamp in STAMPS[rows].tolist()
        ]
    lines = [f"{cell},{x},{y}" for cell, x, y in zip(cells, *VALUES[:, rows].tolist(), strict=True)]
    path.write_text("\n".join([f"{header},gyro_x [deg/h],gyro_y [deg/h]", *lines]) + "\n")
    return path


def regular(paths: list[Path], **options) -> xr.Dataset:
    return gyrostab.regularise(gyrostab.read_log(paths), **options)


def assert_same(log: xr.Dataset, other: xr.Dataset) -> None:
    np.testing.assert_allclose(other.rate.values, log.rate.values, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(other.time.values, log.time.values)
    assert other.attrs["sampling_rate_hz"] == log.attrs["sampling_rate_hz"]


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> xr.Dataset:
    return regular([write_rows(tmp_path_factory.mktemp("whole") / "log.csv", np.arange(ROWS))])


def test_log_equals_the_written_one(whole):
    truth = np.full((2, SAMPLES[-1] + 1), np.nan)
    truth[:, SAMPLES] = VALUES
    np.testing.assert_array_equal(whole.rate.values, truth)
    assert whole.time.values[0].astype(np.int64) == START


@pytest.mark.parametrize("unit", [*UNITS])
def test_units_of_time(whole, tmp_path, unit):
    assert_same(whole, regular([write_rows(tmp_path / "log.csv", np.arange(ROWS), unit=unit)]))


@pytest.mark.parametrize("zone", ["", "Z", "+02:00", "-05:00"])
def test_zones(whole, tmp_path, zone):
    assert_same(
        whole, regular([write_rows(tmp_path / "log.csv", np.arange(ROWS), unit="iso", zone=zone)])
    )


@pytest.mark.parametrize("seed", range(6))
def test_pieces_in_any_order(whole, tmp_path, seed):
    random = np.random.default_rng(seed)
    cuts = np.sort(random.choice(np.arange(20, ROWS - 20), random.integers(1, 7), replace=False))
    pieces = np.split(np.arange(ROWS), cuts)
    units = random.choice([*UNITS, "iso"], len(pieces))
    paths = [
        write_rows(tmp_path / f"{i}.csv", rows, unit=unit)
        for i, (rows, unit) in enumerate(zip(pieces, units, strict=True))
    ]
    random.shuffle(paths)
    assert_same(whole, regular(paths))


@pytest.mark.parametrize("seed", range(6))
def test_pieces_that_overlap(whole, tmp_path, seed):
    random = np.random.default_rng(seed)
    cuts = np.sort(random.choice(np.arange(300, ROWS - 300, 300), 3, replace=False))
    bounds = [0, *cuts.tolist(), ROWS]
    paths = []
    for i, (begin, end) in enumerate(pairwise(bounds)):
        more = int(random.integers(1, 200)) if end < ROWS else 0
        paths.append(write_rows(tmp_path / f"{i}.csv", np.arange(begin, end + more)))
    random.shuffle(paths)
    assert_same(whole, regular(paths))


def test_the_same_file_under_two_names(whole, tmp_path):
    paths = [write_rows(tmp_path / f"{i}.csv", np.arange(ROWS)) for i in range(2)]
    assert_same(whole, regular(paths))


@pytest.mark.parametrize("seed", range(3))
def test_single_repeated_rows(whole, tmp_path, seed):
    repeated = np.sort(
        np.random.default_rng(seed).choice(np.arange(50, ROWS - 50), 20, replace=False)
    )
    assert_same(
        whole,
        regular(
            [write_rows(tmp_path / "log.csv", np.insert(np.arange(ROWS), repeated + 1, repeated))]
        ),
    )


@pytest.mark.parametrize("seed", range(3))
def test_repeated_stretch(whole, tmp_path, seed):
    begin = int(np.random.default_rng(seed).integers(200, 1500))
    rows = np.r_[0 : begin + 800, begin:ROWS]
    assert_same(whole, regular([write_rows(tmp_path / "log.csv", rows)]))


@pytest.mark.parametrize("seed", range(3))
def test_swapped_neighbours(whole, tmp_path, seed):
    rows = np.arange(ROWS)
    for at in np.random.default_rng(seed).choice(np.arange(50, 1100, 10), 30, replace=False):
        rows[[at, at + 1]] = rows[[at + 1, at]]
    assert_same(whole, regular([write_rows(tmp_path / "log.csv", rows)]))


@pytest.mark.parametrize("seed", range(3))
def test_rows_in_random_order_are_refused_with_the_reason(tmp_path, seed):
    path = write_rows(tmp_path / "log.csv", np.random.default_rng(seed).permutation(ROWS))
    with pytest.raises(GyrostabError, match=r"log\.csv: .*no order of time"):
        regular([path])


@pytest.mark.parametrize(("block", "chunk"), [(64, 100), (1000, 777), (1 << 20, 10_000)])
@pytest.mark.parametrize("scatter", [0.0, 0.15, 0.5])
def test_blocks_and_chunks(block, chunk, scatter):
    noise = np.random.default_rng(5).normal(0, scatter / RATE * 1e9, ROWS).astype(np.int64)
    raw = raw_log(STAMPS + noise, VALUES)
    assert_same(gyrostab.regularise(raw), regularise_in_parts(raw, block=block, chunk=chunk))


@pytest.mark.parametrize("shift", [1, 10**15, -(10**17)])
def test_different_start_time(shift):
    noise = np.random.default_rng(5).normal(0, 0.4 / RATE * 1e9, ROWS).astype(np.int64)
    log, other = (gyrostab.regularise(raw_log(STAMPS + noise + by, VALUES)) for by in (0, shift))
    np.testing.assert_array_equal(log.rate.values, other.rate.values)
    assert np.unique((other.time.values - log.time.values).astype(np.int64)).tolist() == [shift]

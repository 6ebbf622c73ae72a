"""Recordings with one file for each axis form one log, with a note on the skew of the axes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

import gyrostab
from gyrostab.errors import SchemaError, TimeError
from gyrostab.ingest import ReadOptions, read_log, reading, scan_file
from gyrostab.ingest.concat.grid import group_axes
from gyrostab.ingest.grid.gaps import gap_table
from gyrostab.ingest.grid.regularise import regularise
from gyrostab.store.lazy import find_source
from tests.ingest.field_files import write_trace
from tests.support.columns import write_columns

N, PERIOD_NS = 2000, 10_000_000
START = np.datetime64("2026-03-01T06:00:00", "ns").astype(np.int64)


def truth(axis: str) -> np.ndarray:
    return np.round(np.random.default_rng(ord(axis)).normal(size=N), 6)


def write(
    path: Path,
    axis: str,
    *,
    samples: np.ndarray | None = None,
    skew: float = 0.0,
    stamped: bool = True,
    extra: bool = False,
) -> Path:
    """Make one axis at some samples of the grid, with its stamps `skew` samples late."""
    positions = np.arange(N) if samples is None else samples
    stamps = START + np.rint((positions + skew) * PERIOD_NS).astype(np.int64)
    columns = {f"gyro_{axis} [deg/h]": truth(axis)[positions]}
    if extra:
        columns["temperature [degC]"] = 20.0 + positions / 100
    if stamped:
        columns = {"time [ns]": stamps, **columns}
    if path.suffix == ".parquet":
        parquet.write_table(pa.table(columns), path)
    elif path.suffix == ".nc":
        split = {header: header.rstrip("]").split(" [") for header in columns}
        write_columns(path, {split[h][0]: (columns[h], split[h][1]) for h in columns})
    else:
        rows = "\n".join(
            ",".join(repr(value) for value in row)
            for row in zip(*(column.tolist() for column in columns.values()), strict=True)
        )
        path.write_text(",".join(columns) + "\n" + rows + "\n")
    return path


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".nc"])
def test_three_files_of_one_axis_are_one_log(tmp_path, suffix):
    paths = [write(tmp_path / f"gyro_{axis}{suffix}", axis) for axis in "zxy"]
    log = regularise(read_log(paths))
    assert log.rate.axis.values.tolist() == ["x", "y", "z"]
    assert log.sizes["time"] == N
    np.testing.assert_array_equal(log.rate.values, [truth(axis) for axis in "xyz"])
    assert gap_table(log).empty
    assert log.attrs["source_files"] == [f"gyro_{axis}{suffix}" for axis in "xyz"]
    note = next(note for note in log.attrs["notes"] if "separate stamps" in note)
    assert all(f"{axis} in gyro_{axis}{suffix}" in note for axis in "xyz")
    assert not any("missing" in note or "lie on samples" in note for note in log.attrs["notes"])


@pytest.mark.parametrize(("skew", "shift"), [(1 / 3, 0), (-0.2, 0), (3.3, 3), (-2.0, -2)])
def test_a_skew_is_stated_and_each_sample_is_the_nearest(tmp_path, skew, shift):
    log = regularise(
        read_log([write(tmp_path / "x.csv", "x"), write(tmp_path / "y.csv", "y", skew=skew)])
    )
    begin = min(shift, 0)
    assert log.sizes["time"] == N + abs(shift)
    for axis, first in (("x", -begin), ("y", shift - begin)):
        values = log.rate.sel(axis=axis).values
        np.testing.assert_array_equal(values[first : first + N], truth(axis))
        assert np.isnan(np.delete(values, np.arange(first, first + N))).all()
    late = "y" if skew > 0 else "x"
    assert any(
        f"{late} in {late}.csv (begins {abs(skew):.3g} samples later)" in note
        for note in log.attrs["notes"]
    )
    notes = [note for note in log.attrs["notes"] if "between two samples" in note]
    if skew == shift:
        assert not notes
    else:
        (note,) = notes
        assert "y.csv" in note or "x.csv" in note
        assert f"{abs(skew - round(skew)):.2g} of a sample" in note


def test_missing_samples_of_one_axis_are_a_gap(tmp_path):
    positions = np.setdiff1d(np.arange(N), np.arange(500, 520))
    log = regularise(
        read_log(
            [write(tmp_path / "x.csv", "x"), write(tmp_path / "y.csv", "y", samples=positions)]
        )
    )
    np.testing.assert_array_equal(log.rate.sel(axis="x").values, truth("x"))
    np.testing.assert_array_equal(
        np.flatnonzero(np.isnan(log.rate.sel(axis="y").values)), np.arange(500, 520)
    )
    table = gap_table(log)
    assert table[["samples", "cause"]].values.tolist() == [[20, "missing"]]


def test_each_axis_may_be_in_several_files_and_carry_channels(tmp_path):
    halves = {"a": np.arange(1200), "b": np.arange(1200, N)}
    paths = [
        write(tmp_path / f"{part}_{axis}.csv", axis, samples=samples, extra=axis == "y")
        for part, samples in halves.items()
        for axis in "xy"
    ]  # fmt: skip
    log = regularise(read_log(paths))
    np.testing.assert_array_equal(log.rate.values, [truth("x"), truth("y")])
    np.testing.assert_allclose(log.temperature.values, 20.0 + np.arange(N) / 100)
    assert gap_table(log).empty


def test_axes_without_stamps_begin_together(tmp_path):
    paths = [write(tmp_path / f"{axis}.csv", axis, stamped=False) for axis in "xy"]
    log = regularise(read_log(paths, rate=100.0, start="2026-03-01T06:00:00"))
    np.testing.assert_array_equal(log.rate.values, [truth("x"), truth("y")])


def test_regular_logs_of_one_axis_are_one_log(tmp_path):
    paths = []
    for axis in "xyz":
        log = regularise(read_log(write(tmp_path / f"{axis}.csv", axis)))
        gyrostab.to_netcdf(log, tmp_path / f"{axis}.nc")
        paths.append(tmp_path / f"{axis}.nc")
    log = read_log(paths)
    np.testing.assert_array_equal(log.rate.values, [truth(axis) for axis in "xyz"])
    assert not any("lie on samples" in note or "missing" in note for note in log.attrs["notes"])


def test_axes_recorded_one_after_the_other_are_concatenated_in_time(tmp_path):
    paths = [
        write(tmp_path / "x.csv", "x", samples=np.arange(900)),
        write(tmp_path / "y.csv", "y", samples=np.arange(1000, N)),
    ]
    log = regularise(read_log(paths))
    assert log.sizes["time"] == N
    assert [100, "missing"] in gap_table(log)[["samples", "cause"]].values.tolist()
    assert any("axis x is not in y.csv" in note for note in log.attrs["notes"])


def test_long_files_stay_on_disk_and_are_read_lazily(tmp_path, monkeypatch):
    monkeypatch.setattr(reading, "SPILL_BYTES", 1000)
    paths = [write(tmp_path / f"{axis}.csv", axis) for axis in "xyz"]
    raw = read_log(paths)
    assert raw.rate.chunks is not None
    assert find_source(raw.rate.data) is not None
    log = regularise(raw)
    assert find_source(log.rate.data) is not None
    np.testing.assert_array_equal(log.rate.values, [truth(axis) for axis in "xyz"])
    surface = gyrostab.davar(log, window="5s", step="5s")
    assert np.isfinite(surface.avar.values[:, 0, 0]).all()


def test_logs_are_grouped_by_the_axes_they_share():
    assert group_axes(range(3), [["x", "y"], ["y", "z"], ["z"]]) == [[0, 1, 2]]
    assert group_axes(range(4), [["z"], ["x"], ["y"], ["x"]]) == [[1, 3], [2], [0]]


def write_miniseed(
    path: Path, codes: dict[str, str], *, skew: dict[str, float], start: int = 0, size: int = N
) -> Path:
    """Write channels by code, 100 counts for each deg/h, with stamps in microseconds."""
    with path.open("wb") as file:
        for code, axis in codes.items():
            begin = START + round((start + skew.get(axis, 0.0)) * PERIOD_NS / 1000) * 1000
            counts = np.round(100 * truth(axis)[start : start + size]).astype(np.int32)
            write_trace(file, code, counts, 100.0, begin)
    return path


CODES = {"H_J_X": "x", "H_J_Y": "y", "H_J_Z": "z"}
SKEW = {"y": 0.3, "z": -0.2}


def test_miniseed_files_of_one_channel_are_one_log(tmp_path):
    paths = [
        write_miniseed(tmp_path / f"{axis}.mseed", {code: axis}, skew=SKEW)
        for code, axis in CODES.items()
    ]
    log = regularise(read_log(paths, unit={"gyro": "0.01 deg/h"}))
    np.testing.assert_allclose(
        log.rate.values, [np.round(truth(axis), 2) for axis in "xyz"], atol=1e-9
    )
    assert log.attrs["source_files"] == [
        "z.mseed",
        "x.mseed",
        "y.mseed",
    ]  # by first stamps
    assert any(
        "y.mseed" in note and "0.5 of a sample" in note for note in log.attrs["notes"]
    )  # from z, which begins first


def test_channels_of_one_file_with_a_skew_are_one_log(tmp_path):
    paths = [
        write_miniseed(tmp_path / "a.mseed", CODES, skew=SKEW, size=800),
        write_miniseed(tmp_path / "b.mseed", CODES, skew=SKEW, start=800, size=N - 800),
    ]
    log = regularise(read_log(paths, unit={"gyro": "0.01 deg/h"}))
    np.testing.assert_allclose(
        log.rate.values, [np.round(truth(axis), 2) for axis in "xyz"], atol=1e-9
    )
    assert scan_file(paths[0], ReadOptions(unit={"gyro": "0.01 deg/h"})).axes == ("x", "y", "z")


def test_axes_of_other_rates_are_refused_by_name(tmp_path):
    x, y = (
        write(tmp_path / "x.csv", "x"),
        write(tmp_path / "y.csv", "y", samples=np.arange(0, N, 2)),
    )
    with pytest.raises(TimeError, match=r"x.csv is a log of 100 Hz and y.csv one of 50 Hz"):
        regularise(read_log([x, y]))


def test_selected_rows_are_refused(tmp_path):
    raw = read_log([write(tmp_path / f"{axis}.csv", axis) for axis in "xy"])
    with pytest.raises(SchemaError, match="regularise the whole"):
        regularise(raw.isel(row=slice(0, 3000)))

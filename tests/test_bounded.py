"""Work and memory of the readers stay within the bytes that are there, and within limits that a message names."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from pathlib import Path

import netCDF4
import numpy as np
import pytest

from gyrostab import davar, make_log, read_log, regularise, scan, to_netcdf
from gyrostab.davar import davar_part
from gyrostab.errors import OptionError, TimeError
from gyrostab.limits import check_limits
from gyrostab.read import ReadOptions, arrays
from gyrostab.read import netcdf as netcdf_reader


def write_stamped_netcdf(path: Path, rows: int) -> Path:
    """A CF file with an int64 stamp per sample at 400 Hz."""
    with netCDF4.Dataset(path, "w") as file:
        file.createDimension("time", rows)
        time = file.createVariable("time", "i8", ("time",))
        time.units = "nanoseconds since 1970-01-01"
        gyro = file.createVariable("gyro_x", "f8", ("time",))
        gyro.units = "deg/h"
        time[:] = np.arange(rows) * 2_500_000
        gyro[:] = np.arange(rows) % 7 + 0.5
    return path


def peak_of(work: Callable[[], object]) -> int:
    """Bytes that Python and numpy allocate at most while `work` runs."""
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_foreign_netcdf_takes_no_more_memory_when_it_is_longer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(arrays, "BATCH_ROWS", 2**16)
    short, long = (write_stamped_netcdf(tmp_path / f"{rows}.nc", rows) for rows in (300_000, 1_500_000))
    netcdf_reader.read(short, ReadOptions(), limit=2**20)  # loads modules
    peaks = [peak_of(lambda path=path: netcdf_reader.read(path, ReadOptions(), limit=2**20)) for path in (short, long)]
    assert peaks[1] < peaks[0] + 2**21


def write_csv(path: Path, stamps_ns: np.ndarray) -> Path:
    """A text log of one axis with these stamps."""
    rows = "".join(f"{stamp},{row % 7}.5\n" for row, stamp in enumerate(stamps_ns.tolist()))
    path.write_text("time [ns],gyro_x [deg/h]\n" + rows)
    return path


START_NS = 1_780_000_000 * 10**9
DAY_NS = 86_400 * 10**9


def test_stamp_days_ahead_at_10_khz_is_named_before_the_grid_is_laid_out(tmp_path: Path) -> None:
    stamps = START_NS + np.arange(5000) * 100_000
    stamps[-1] += 9 * DAY_NS
    path = write_csv(tmp_path / "log.csv", stamps)
    with pytest.raises(
        TimeError, match=r"log\.csv: from 2026-05-28T20:26:40.499 \(row 4998\) to 2026-06-06.*--max-gap .*--limit grid_samp"
    ):
        regularise(read_log(path))
    stepped = regularise(read_log(path), max_gap="1h")  # as the message advises
    assert stepped.sizes["time"] == 5001


def test_stamps_a_nanosecond_apart_are_refused_before_the_grid_is_laid_out(tmp_path: Path) -> None:
    stamps = START_NS + np.sort(np.concatenate([np.arange(3000) * 2_500_000, np.arange(3000) * 2_500_000 + 1]))
    with pytest.raises(TimeError, match=r"row 1\).*row 2\).*1e-06 ms apart.*--limit grid_samples=7.5e\+09"):
        scan(write_csv(tmp_path / "log.csv", stamps))


def test_gap_of_eight_days_at_400_hz_stays_a_gap(tmp_path: Path) -> None:
    stamps = START_NS + np.arange(6000) * 2_500_000
    stamps[3000:] += 8 * DAY_NS
    table = scan(write_csv(tmp_path / "log.csv", stamps))
    assert table.loc[0, "gaps"] == 1
    assert table.loc[0, "missing_share"] == pytest.approx(1.0 - 6000 / (8 * 86_400 * 400 + 6000))


def test_logs_years_apart_are_refused_before_the_grid_is_laid_out(tmp_path: Path) -> None:
    for number, start in enumerate(("2026-01-01", "2026-01-09T12:00:00")):
        to_netcdf(make_log(np.arange(2000.0) % 5, rate=1e4, unit="deg/h", start=start), tmp_path / f"{number}.nc")
    with pytest.raises(TimeError, match=r"0\.nc ends at 2026-01-01.*1\.nc begins at 2026-01-09.*--max-gap.*--limit grid_samples="):
        read_log(tmp_path / "?.nc")


def test_long_gap_costs_no_window_sums_and_changes_no_cell() -> None:
    values = np.random.default_rng(1).standard_normal(1_200_000)
    values[300_000:900_000] = np.nan
    log = make_log(values, rate=100.0, unit="deg/h")
    options = {"window": "60s", "step": "30s", "taus": "octave"}
    whole = davar(log, **options)
    direct = davar(log, **options, method="direct")
    np.testing.assert_array_equal(np.isnan(whole["avar"]), np.isnan(direct["avar"]))
    inside = davar_part(log, part=slice(150, 200), **options)
    for name in ("avar", "count", "coverage", "edf", "window_mean"):
        np.testing.assert_array_equal(inside[name], whole[name].isel(time=slice(150, 200)))
    assert not inside["count"].any()
    assert not inside["window_coverage"].any()


def test_limits_have_names_and_are_above_zero() -> None:
    with pytest.raises(OptionError, match="the limits are columns, "):
        check_limits({"rows": 1})
    with pytest.raises(OptionError, match="above 0"):
        check_limits({"columns": "-1"})
    with pytest.raises(OptionError, match="give a number of columns"):
        check_limits({"columns": "many"})

"""Logs with stored times: other programs see them, and gyrostab reads the same log back."""

from __future__ import annotations

import subprocess
import sys

import netCDF4
import numpy as np
import pandas as pd
import pytest
import xarray as xr

import gyrostab
from gyrostab.ingest.convert import as_log
from gyrostab.io.datasets import MAX_STAMPED_SAMPLES, to_netcdf, to_zarr
from gyrostab.io.opening import open_log
from gyrostab.time.grid import TimeGridIndex
from tests.support import synthetic

WRITERS = {"nc": to_netcdf, "zarr": to_zarr}
ADDED = {
    "Conventions", "date_created", "gyrostab_content", "gyrostab_version", "history", "keywords",
    "references", "source", "summary", "time_coverage_end", "time_coverage_start", "title",
}  # fmt: skip


def gap_log() -> xr.Dataset:
    """Make a log with lost samples and a table of gaps."""
    index = pd.date_range("2026-01-01", periods=4000, freq="10ms").delete(range(100, 200))
    values = np.random.default_rng(1).standard_normal((3900, 2))
    frame = pd.DataFrame(values, index, ["gyro_x [deg/h]", "gyro_y [deg/h]"])
    return gyrostab.from_dataframe(frame)


def counts_log() -> xr.Dataset:
    counts = np.random.default_rng(2).integers(-3000, 3000, (3, 5000), dtype=np.int16)
    return gyrostab.make_log(counts, rate=300.0, unit="0.1 deg/h", start="2026-01-01")


def angle_log() -> xr.Dataset:
    angle = np.cumsum(np.random.default_rng(3).standard_normal((1, 3000)), axis=1)
    return gyrostab.make_log(angle, rate=99.3, unit="deg", kind="angle", start="2026-01-01")


def cut_log() -> xr.Dataset:
    """Every third sample of a part of a log with a channel on separate times."""
    return synthetic.log().isel(time=slice(7, 2000, 3))


LOGS = {
    "gaps": gap_log,
    "counts": counts_log,
    "angle": angle_log,
    "separate times": synthetic.log,
    "every third sample": cut_log,
    "one sample": lambda: counts_log().isel(time=slice(5, 6)),
}


def open_plainly(path) -> xr.Dataset:
    """Open a file with xarray alone."""
    return xr.open_dataset(path, engine="zarr" if path.is_dir() else "netcdf4")


@pytest.mark.parametrize("form", WRITERS)
@pytest.mark.parametrize("lazy", [False, True])
@pytest.mark.parametrize("name", LOGS)
def test_a_log_with_stamps_comes_back(tmp_path, form, lazy, name):
    log = LOGS[name]()
    path = WRITERS[form](log.chunk(time=997) if lazy else log, tmp_path / f"log.{form}")
    expected = as_log(log)
    with open_log(path) as back:
        assert isinstance(back.xindexes["time"], TimeGridIndex)
        xr.testing.assert_equal(back.load(), expected)
        attributes = {key: value for key, value in back.attrs.items() if key not in ADDED}
        assert attributes == {
            key: value for key, value in expected.attrs.items() if key not in ADDED
        }
        for name, variable in expected.variables.items():
            units, stored_units = (item.attrs.get("units") for item in (variable, back[name]))
            assert units == stored_units
            assert back[name].encoding.get("scale_factor") == variable.encoding.get("scale_factor")
    with open_plainly(path) as plain:
        signal = "angle" if "angle" in log else "rate"
        assert plain[signal].dims == ("axis", "time")
        for time in (name for name in log.indexes if str(name).startswith("time")):
            np.testing.assert_array_equal(plain[time].values, log[time].values)
            assert plain[time].attrs["standard_name"] == "time"
            assert plain[time].attrs.get("axis") == ("T" if time == "time" else None)
        np.testing.assert_array_equal(plain[signal].values, log[signal].values)


@pytest.mark.parametrize("form", WRITERS)
def test_logs_with_and_without_stamps_are_the_same(tmp_path, form):
    log = synthetic.log()
    with (
        open_log(WRITERS[form](log, tmp_path / f"with.{form}", stamps=True)) as stamped,
        open_log(WRITERS[form](log, tmp_path / f"without.{form}", stamps=False)) as other,
    ):
        xr.testing.assert_equal(stamped.load(), other.load())
        assert {**stamped.attrs, "date_created": "", "history": ""} == {
            **other.attrs,
            "date_created": "",
            "history": "",
        }


@pytest.mark.parametrize("form", WRITERS)
def test_long_logs_have_no_stamps_unless_asked(tmp_path, form, monkeypatch):
    monkeypatch.setattr("gyrostab.io.datasets.MAX_STAMPED_SAMPLES", 3000)
    log = synthetic.log(samples=3000)
    assert log.sizes["time"] < MAX_STAMPED_SAMPLES
    for stamps, size, has_stamps in ((None, 3000, False), (None, 2999, True), (True, 3000, True)):
        part = log.isel(time=slice(size))
        path = WRITERS[form](part, tmp_path / f"log.{form}", overwrite=True, stamps=stamps)
        with open_plainly(path) as plain:
            assert ("time" in plain.variables) is has_stamps
            assert ("time_start" in plain.variables) is not has_stamps


@pytest.mark.parametrize(
    ("rate", "unit"), [(400.0, "microseconds"), (300.0, "nanoseconds"), (2**20, "nanoseconds")]
)
def test_units_represent_every_stamp(tmp_path, rate, unit):
    log = synthetic.log(rate=rate, start=1_790_000_000_000_002_000, samples=1000).drop_dims(
        ["time_temperature", "gap"]
    )
    with netCDF4.Dataset(to_netcdf(log, tmp_path / "log.nc")) as file:
        assert file["time"].units == f"{unit} since 1970-01-01T00:00:00"
        assert file["time"].dtype == np.int64
        assert file["time"].filters()["zlib"]
        stored = file["time"][:].data * {"microseconds": 1000, "nanoseconds": 1}[unit]
    exact = [1_790_000_000_000_002_000 + round(n * 10**9 / rate) for n in range(1000)]
    np.testing.assert_array_equal(stored, exact)


@pytest.mark.parametrize("form", WRITERS)
@pytest.mark.parametrize(
    "change",
    [
        lambda log: log.isel(time=slice(100, 200)),
        lambda log: log.isel(time=slice(None, None, 2)),
        lambda log: log.assign_coords(time=log.time + np.timedelta64(1, "h")),
        lambda log: log.isel(time=np.r_[0:500, 600:3000]),
    ],
    ids=["cut", "every second", "moved", "hole"],
)
def test_stamps_that_xarray_changed_are_read(tmp_path, form, change):
    log = synthetic.log(rate=400.0).drop_dims(["time_temperature", "gap"])
    with open_plainly(WRITERS[form](log, tmp_path / f"log.{form}")) as plain:
        changed = change(plain.load())
    # some operations keep the attributes of the coordinate, and some do not
    changed.time.attrs.update(plain.time.attrs)
    assert "sampling_grid" in changed.time.attrs
    path, changed = tmp_path / f"changed.{form}", changed.drop_encoding()
    changed.to_zarr(path) if form == "zarr" else changed.to_netcdf(path)
    with open_log(path) as back:
        selection = back.sel(time=changed.time.values)
        np.testing.assert_array_equal(selection.rate.values, changed.rate.values)
        assert back.time.values[[0, -1]].tolist() == changed.time.values[[0, -1]].tolist()


@pytest.mark.slow
def test_stamps_of_a_log_in_parts_take_no_memory(tmp_path):
    """A lazy log is written with stamps in a process whose memory holds few of them."""
    code = (
        "import resource, gyrostab, dask.array as da\n"
        "log = gyrostab.make_log(da.zeros((1, 12_000_000), chunks=500_000, dtype='i2'), "
        "rate=1000.0, unit='deg/h')\n"
        "gyrostab.to_netcdf(log.isel(time=slice(1000)), 'first.nc', stamps=True)\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "gyrostab.to_netcdf(log, 'log.nc', stamps=True)\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert int(done.stdout) < 70_000  # KiB; the stamps are 94 000
    with xr.open_dataset(tmp_path / "log.nc", chunks={}) as plain:
        assert plain.time.values[-1] == np.datetime64("1970-01-01T03:19:59.999")


def test_damaged_stamps_are_restored_from_the_rule(tmp_path):
    log = synthetic.log()
    path = to_zarr(log, tmp_path / "log.zarr")
    for chunk in (path / "time").glob("[0-9]*"):
        chunk.write_bytes(b"damaged")
    with open_log(path) as back:
        np.testing.assert_array_equal(back.time.values, log.time.values)


def test_davar_takes_what_xarray_opens(tmp_path):
    log = counts_log()
    path = to_netcdf(log, tmp_path / "log.nc")
    with xr.open_dataset(path) as plain, open_log(path) as own:
        surface, other = (gyrostab.davar(data, window="5s") for data in (plain, own))
    xr.testing.assert_equal(surface, other)


def test_a_plain_plot_of_xarray_is_right(tmp_path, monkeypatch):
    monkeypatch.setenv("MPLBACKEND", "agg")
    import matplotlib.pyplot as plt

    log = gap_log()
    with xr.open_dataset(to_netcdf(log, tmp_path / "log.nc")) as plain:
        (line,) = plain.rate.sel(axis="y").plot()
    assert line.axes.get_ylabel() == "rotation rate [degree hour-1]"
    assert line.axes.get_xlabel() == "time"
    assert line.axes.get_title() == "axis = y"
    np.testing.assert_array_equal(line.get_xdata(), log.time.values)
    np.testing.assert_array_equal(line.get_ydata(), log.rate[1].values)
    plt.close("all")

"""NetCDF logs of gyrostab: their summaries, stamps that were changed, and damage."""

from __future__ import annotations

import h5py
import netCDF4
import numpy as np
import pytest

from gyrostab import make_log, open_log, to_netcdf
from gyrostab.errors import FormatError
from gyrostab.ingest.files import scan_file


def _write_log(path, **options):
    values = np.random.default_rng(1).integers(-99, 99, (2, 5000)) * 0.01
    values[1, 100:200] = np.nan
    log = make_log(values, rate=100.0, unit="deg/h", start="2026-01-01")
    log["rate"].encoding = {"dtype": "int16", "scale_factor": 0.01}
    log["temperature"] = ("time", np.linspace(20.0, 30.0, 5000), {"units": "degree_Celsius"})
    log["temperature"].attrs |= {"long_name": "Kühler", "comment": "", "place_m": [0.1, 0.2]}
    to_netcdf(log, path, **options)


@pytest.mark.filterwarnings("ignore:a file cannot hold a channel of this name")
@pytest.mark.parametrize(("stamps", "named"), [(True, False), (False, False), (True, True)])
def test_a_log_has_the_summary_of_its_samples(tmp_path, stamps, named):
    path = tmp_path / "log.nc"
    _write_log(path, stamps=stamps)
    with open_log(path) as log:
        log = log.load().assign_attrs(notes=["the tool was struck", "twice"])
    log["accel_x"] = ("time", np.full(5000, 1.0), {"units": "g"})
    slow = np.datetime64("2026-01-01", "ns") + np.arange(50) * np.timedelta64(1, "s")
    log = log.assign_coords(time_depth=slow)
    log["depth"] = ("time_depth", np.arange(50.0), {"units": "m"})
    if named:
        log = log.rename(depth="a/b", time_depth="time_a/b")
    to_netcdf(log, path, overwrite=True, stamps=stamps)
    summary = scan_file(path)
    assert {column.unit for column in summary.columns} == {
        "degree hour-1", "degree_Celsius", "g", "m",
    }  # fmt: skip
    assert len(summary.notes) == 2
    channels = ("temperature", "accel_x", "a/b" if named else "depth")
    assert (summary.n_rows, summary.channels) == (5000, channels)


def test_changed_stamps_are_those_of_the_file(tmp_path):
    path = tmp_path / "log.nc"
    _write_log(path)
    with netCDF4.Dataset(path, "a") as file:
        file["time"][:] += 3_600_000_000
    assert str(open_log(path).time.values[0]).startswith("2026-01-01T01:00:00")


def test_a_damaged_heap_is_found(tmp_path):
    path = tmp_path / "log.nc"
    _write_log(path)
    data = bytearray(path.read_bytes())
    begin = data.index(b"GCOL")
    data[begin + 16 : begin + 32] = bytes(16)  # an object 0 of size 0
    path.write_bytes(data)
    with pytest.raises(FormatError, match="global heap"):
        open_log(path)


@pytest.mark.parametrize("filters", [{"scaleoffset": 0}, {"compression": "lzf"}])
def test_a_log_rewritten_with_another_filter_is_read_or_refused(tmp_path, filters):
    path = tmp_path / "log.nc"
    _write_log(path)
    expected = open_log(path).rate.values
    with h5py.File(path, "a") as file:
        old = file["rate"]
        values, attributes = old[:], dict(old.attrs)
        scales = [dim[0].name for dim in old.dims]
        del file["rate"]
        new = file.create_dataset("rate", data=values, chunks=(1, 1000), **filters)
        for place, scale in enumerate(scales):
            new.dims[place].attach_scale(file[scale])
        for name, value in attributes.items():
            if name not in ("DIMENSION_LIST", "_Netcdf4Coordinates", "_Netcdf4Dimid"):
                new.attrs[name] = value
    if "compression" in filters:  # no library has this filter
        with pytest.raises(FormatError, match="Filter error"):
            open_log(path).rate.load()
    else:
        np.testing.assert_array_equal(open_log(path).rate.values, expected)

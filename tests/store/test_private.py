"""Every private interface of xarray has a fallback; here the tests remove them one by one."""

import sys
from types import ModuleType

import dask.array as da
import numpy as np
import pytest
import xarray as xr

from gyrostab import make_log, open_log, to_netcdf
from gyrostab.errors import OptionError
from gyrostab.store import lazy, private
from gyrostab.store.private import close_function, is_in_memory, library_lock
from tests.support.stored import InMemory, make_lazy


@pytest.fixture
def log():
    values = np.random.default_rng(2).standard_normal((2, 200_000))
    return make_log(values, rate=100.0, unit="deg/h")


def test_without_the_lock_of_xarray_files_are_written_and_read(tmp_path, monkeypatch, log):
    assert library_lock() is sys.modules["xarray.backends.netCDF4_"].NETCDF4_PYTHON_LOCK
    monkeypatch.setitem(sys.modules, "xarray.backends.netCDF4_", ModuleType("netCDF4_"))
    assert library_lock() is private._OWN_LOCK
    with library_lock(), library_lock():  # it may be taken again by the same thread
        pass
    path = to_netcdf(log.chunk(time=65_536), tmp_path / "log.nc")
    with open_log(path) as back:
        np.testing.assert_array_equal(back.rate.values, log.rate.values)


def test_a_variable_of_unknown_place_is_copied_and_its_file_kept(tmp_path, monkeypatch):
    path, values = tmp_path / "plain.nc", np.random.default_rng(2).standard_normal((3, 50))
    xr.Dataset({"values": (("axis", "n"), values)}).to_netcdf(path)
    opened = xr.open_dataset(path)
    assert not is_in_memory(opened.variables["values"])
    assert is_in_memory(xr.Variable("n", values[0]))
    monkeypatch.delattr(xr.Variable, "_in_memory")
    assert not is_in_memory(xr.Variable("n", values[0]))
    copy = to_netcdf(opened, tmp_path / "copy.nc")
    np.testing.assert_array_equal(xr.open_dataset(copy)["values"].values, values)
    with pytest.raises(OptionError):
        to_netcdf(opened, path, overwrite=True)


def test_a_dataset_that_hides_its_close_function_is_closed_itself():
    closed = []

    class Hidden:
        def close(self):
            closed.append(True)

    close_function(Hidden())()
    assert closed == [True]


def test_a_source_is_found_in_its_own_array_only():
    made = make_lazy(np.arange(10.0), 4)
    assert isinstance(lazy.find_source(made), InMemory)
    for other in (made + 1.0, made[2:], da.from_array(np.arange(10.0)), np.arange(10.0)):
        assert lazy.find_source(other) is None


def test_an_array_without_its_source_is_read_by_dask(monkeypatch):
    made = make_lazy(np.arange(10.0), 4)
    monkeypatch.setattr(lazy, "_LAYER", "another-name-")
    assert lazy.find_source(made) is None
    np.testing.assert_array_equal(lazy.read_slice(made, 3, 9), np.arange(3.0, 9.0))

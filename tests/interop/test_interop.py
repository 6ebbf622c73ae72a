"""Other programs open a product, a log and a correlation and read the same data (``make interop``).

The numbers are compared with the dataset that was written, not with what gyrostab reads back.
"""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from gyrostab.correlate import correlate, join
from gyrostab.io.datasets import to_netcdf, to_zarr
from tests.support import synthetic

HERE = Path(__file__).parent
DEGREES_AND_HOURS = {
    "avar": "degree2 hour-2",
    "N": "degree hour-1",
    "K": "degree hour-1",
    "Q": "microradian",
    "N_squared": "degree2 hour-1",
    "K_squared": "degree2 hour-3",
    "R": "degree hour-2",
    "tau": "s",
    "temperature": "degree_Celsius",
    "vibration": "9.80665 m s-2",
}


def product() -> xr.Dataset:
    """Whole microseconds, as of nearly every logger, for programs that know no nanoseconds."""
    whole = synthetic.product()
    return whole.assign_coords(
        {
            name: whole[name].astype("M8[us]").astype("M8[ns]").assign_attrs(whole[name].attrs)
            for name in TIMES
        }
    )


TIMES = ("time", "time_bounds")


def correlation() -> xr.Dataset:
    """The product with its correlation beside it, as the command writes it."""
    whole = product()
    return join(whole, correlate(whole))


def log() -> xr.Dataset:
    """Make a log with rates in counts, an axis and a channel in doubles, and odd nanoseconds."""
    whole = synthetic.log(samples=400)
    whole["rate"] = (whole.rate.dims, np.rint(whole.rate.values / 0.01) * 0.01, whole.rate.attrs)
    whole["rate"].encoding = {"dtype": np.dtype("i2"), "scale_factor": 0.01}
    return whole


def as_stored(log: xr.Dataset) -> xr.Dataset:
    """What other programs find of a log without stamps: in place of each time axis its start."""
    starts = {
        f"{name}_start": log[name][0].drop_vars(name).variable
        for name in ("time", "time_temperature")
    }
    return log.drop_vars(["time", "time_temperature"]).assign(starts)


@pytest.fixture(scope="module", params=["product", "log", "log without stamps", "correlation"])
def case(request, tmp_path_factory) -> tuple[xr.Dataset, Path, xr.Dataset, dict[str, bool]]:
    """Write a file with zlib; return what it must hold, its source, and how it was written."""
    made = {"product": product, "correlation": correlation}.get(request.param, log)()
    stamps = request.param != "log without stamps"
    path = to_netcdf(
        made,
        tmp_path_factory.mktemp("interop") / f"{request.param}.nc",
        compression="zlib",
        stamps=stamps,
    )
    return made if stamps else as_stored(made), path, made, {"stamps": stamps}


def disk_order(variable: xr.DataArray) -> np.ndarray:
    order = [dim for dim in ("axis", "term", "tau") if dim in variable.dims]
    last = [dim for dim in ("time", "bnds") if dim in variable.dims]
    return variable.transpose(
        *order, *[dim for dim in variable.dims if dim not in (*order, *last)], *last
    ).values


def names(dataset: xr.Dataset) -> list[str]:
    return [str(name) for name in dataset.variables]


def since_1970(values: np.ndarray, unit: str) -> np.ndarray:
    """Whole units since 1970; the odd nanoseconds of the synthetic log are kept by ``ns``."""
    return (
        values.astype("M8[ns]").astype(np.int64) // {"nanoseconds": 1, "microseconds": 1000}[unit]
    )


def test_the_cases_hold_missing_values():
    for made, name in ((product(), "avar"), (synthetic.log(), "rate")):
        assert 0 < np.isnan(made[name].values).sum() < made[name].size


def test_xarray_alone(case):
    made, path, *_ = case
    with xr.open_dataset(path) as opened:
        for name in names(made):
            if made[name].dtype.kind == "M":
                np.testing.assert_array_equal(
                    disk_order(opened[name]).astype("M8[ns]"), disk_order(made[name])
                )
            else:
                np.testing.assert_array_equal(disk_order(opened[name]), disk_order(made[name]))


def test_xarray_opens_zarr(case, tmp_path):
    made, _, source, options = case
    with xr.open_zarr(to_zarr(source, tmp_path / "case.zarr", **options)) as opened:
        for name in names(made):
            np.testing.assert_array_equal(disk_order(opened[name]), disk_order(made[name]))


def test_zarr_alone(case, tmp_path):
    import zarr

    made, _, source, options = case
    group = zarr.open_group(to_zarr(source, tmp_path / "case.zarr", **options), mode="r")
    for name in names(made):
        if made[name].dtype.kind == "f":
            values = group[name][:]
            if "scale_factor" in group[name].attrs:
                assert values.dtype.kind == "i"
                values = np.where(
                    values == group[name].fill_value,
                    np.nan,
                    values * group[name].attrs["scale_factor"],
                )
            np.testing.assert_array_equal(values, disk_order(made[name]))
            assert group[name].attrs.get("units", "") == DEGREES_AND_HOURS.get(
                name, group[name].attrs.get("units", "")
            )


def test_netcdf4_python_alone(case):
    import netCDF4

    made, path, *_ = case
    with netCDF4.Dataset(path) as file:
        for name in names(made):
            stored, expected = file[name][:], disk_order(made[name])
            if expected.dtype.kind == "f":
                np.testing.assert_array_equal(np.ma.getmaskarray(stored), np.isnan(expected))
                np.testing.assert_array_equal(stored.compressed(), expected[np.isfinite(expected)])
            elif expected.dtype.kind in "iu":
                assert not np.ma.is_masked(stored)
                np.testing.assert_array_equal(stored, expected)
            elif expected.dtype.kind == "U":
                assert [str(text) for text in np.ravel(stored)] == expected.ravel().tolist()
        for name in DEGREES_AND_HOURS.keys() & set(names(made)):
            assert file[name].units == DEGREES_AND_HOURS[name]


def test_netcdf4_python_dates(tmp_path):
    import netCDF4

    made = product()
    with netCDF4.Dataset(to_netcdf(made, tmp_path / "product.nc")) as file:
        dates = netCDF4.num2date(
            file["time"][:],
            file["time"].units,
            file["time"].calendar,
            only_use_cftime_datetimes=False,
        )
    assert [np.datetime64(date, "us") for date in dates] == list(
        made["time"].values.astype("M8[us]")
    )


def test_ncdump(case):
    if shutil.which("ncdump") is None:
        pytest.skip("ncdump is absent; on Debian: apt-get install netcdf-bin")
    made, path, *_ = case
    text = subprocess.run(
        ["ncdump", "-p", "9,17", str(path)], capture_output=True, text=True, check=True
    ).stdout
    head, data = text.split("\ndata:\n")
    for name in names(made):
        (text_values,) = re.findall(rf"^ {name} =\s(.*?) ;$", data, re.M | re.S)
        expected = disk_order(made[name]).ravel()
        if expected.dtype.kind == "f":
            factor = [
                float(number)
                for number in re.findall(rf"^\t\t{name}:scale_factor = (\S+) ;", head, re.M)
            ]
            numbers = [
                np.nan if number == "_" else float(number)
                for number in re.split(r",\s*", text_values.strip())
            ]
            np.testing.assert_array_equal(np.array(numbers) * (factor or [1.0])[0], expected)
        elif expected.dtype.kind in "iu":
            assert [
                int(number) for number in re.split(r",\s*", text_values.strip())
            ] == expected.tolist()
        elif expected.dtype.kind == "M":
            (unit,) = re.findall(
                r'time(?:_start)?:units = "(\w+) since 1970-01-01T00:00:00"', head
            )[:1]
            assert [int(number) for number in re.split(r",\s*", text_values.strip())] == since_1970(
                expected, unit
            ).tolist()
        elif expected.dtype.kind == "U":
            assert re.findall(r'"(.*?)"', text_values) in (expected.tolist(), ["".join(expected)])
    for name in DEGREES_AND_HOURS.keys() & set(names(made)):
        assert f'{name}:units = "{DEGREES_AND_HOURS[name]}"' in head


@pytest.fixture(scope="module")
def octave() -> str:
    program = shutil.which("octave")
    if program is None:
        pytest.skip("Octave is absent; on Debian: apt-get install octave octave-netcdf")
    if (
        "netcdf"
        not in run_octave(
            program, "--eval", "pkg list netcdf; disp(pkg('list', 'netcdf'){1}.name)"
        ).stdout
    ):
        pytest.skip(
            "Octave is there, but not its package netcdf; on Debian: apt-get install octave-netcdf"
        )
    return program


def run_octave(program: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [program, "--no-gui", "--norc", "-q", *arguments],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def test_octave(case, octave, tmp_path):
    made, path, *_ = case
    done = run_octave(octave, str(HERE / "read_all.m"), str(path), str(tmp_path / "seen.txt"))
    assert (tmp_path / "seen.txt").exists(), done.stderr
    lines = (tmp_path / "seen.txt").read_text().splitlines()
    variables = {
        head.split("|")[0]: (*head.split("|")[1:], values)
        for head, values in zip(lines[::2], lines[1::2], strict=True)
    }
    assert set(variables) == set(names(made))
    for name, (kind, units, text) in variables.items():
        expected = disk_order(made[name]).ravel()
        assert units == DEGREES_AND_HOURS.get(name, units)
        if expected.dtype.kind == "f":
            assert kind == "double"
            np.testing.assert_array_equal(np.array(text.split(), dtype=float), expected)
        elif expected.dtype.kind == "U":
            assert text.replace("\0", "") == "".join(expected)  # strings are padded to one length
        else:
            numbers = (
                [
                    int(whole) * 10**9 + int(rest)
                    for whole, rest in (pair.split(":") for pair in text.split())
                ]
                if ":" in text
                else None
            )
            numbers = numbers or [int(number) for number in text.split()]
            unit = (units or (variables.get("time") or variables["time_start"])[1]).split(" ")[0]
            assert (
                numbers
                == (since_1970(expected, unit) if expected.dtype.kind == "M" else expected).tolist()
            )

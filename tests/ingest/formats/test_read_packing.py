"""Packed variables of NetCDF and HDF5 files, compared with the CF conventions by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
import pytest
import xarray as xr
import zarr

from gyrostab.errors import FormatError, UnitError
from gyrostab.ingest import read_log
from gyrostab.ingest.formats.packing import Packing
from tests.support.columns import write_columns

ROWS = 60


def write(
    path: Path,
    stored: np.ndarray,
    attributes: dict[str, Any],
    *,
    time: dict[str, Any] | None = None,
    form: str = "NETCDF4",
) -> Path:
    """Write one gyro axis of stored numbers, with the fill value among the attributes."""
    stamps = np.arange(ROWS, dtype="i4"), {"units": "s", **(time or {})}
    gyro = stored, {"units": "deg/h", **attributes}
    return write_columns(path, {"time": stamps, "gyro_x": gyro}, form)


COUNTS = np.arange(ROWS, dtype="i2") - 30
BYTES = np.arange(100, 100 + ROWS, dtype="u1")
FLOATS = COUNTS.astype("f4") / 10
INVALID = np.isin(COUNTS, [-30, 29])

CASES = {
    "plain": (COUNTS, {}, COUNTS.astype(float)),
    "scale and offset": (COUNTS, {"scale_factor": 0.1, "add_offset": 5.0}, COUNTS * 0.1 + 5.0),
    "whole scale": (
        COUNTS,
        {"scale_factor": np.int16(3), "add_offset": np.int16(-7)},
        COUNTS * 3.0 - 7.0,
    ),
    "big endian": (COUNTS.astype(">i2"), {"scale_factor": 0.5}, COUNTS * 0.5),
    "fill": (
        COUNTS,
        {"_FillValue": np.int16(-30), "missing_value": np.int16(29)},
        np.where(INVALID, np.nan, COUNTS),
    ),
    "several missing": (
        COUNTS,
        {"missing_value": np.array([-30, 29], "i2"), "scale_factor": 2.0},
        np.where(INVALID, np.nan, COUNTS * 2.0),
    ),
    "missing of another type": (
        COUNTS,
        {"missing_value": np.array([-30.0, 29.0, np.nan, 1e9])},
        np.where(INVALID, np.nan, COUNTS),
    ),
    "missing among floats": (
        FLOATS,
        {"missing_value": np.float64(-0.1), "_FillValue": np.float32(np.nan)},
        np.where(COUNTS == -1, np.nan, FLOATS.astype(float)),
    ),
    "valid range": (
        COUNTS,
        {"valid_range": np.array([-29, 28], "i2")},
        np.where(INVALID, np.nan, COUNTS),
    ),
    "valid range, packed": (
        COUNTS,
        {"valid_range": np.array([-29, 28], "i2"), "scale_factor": 0.1},
        np.where(INVALID, np.nan, COUNTS * 0.1),
    ),
    "valid range, unpacked": (
        COUNTS,
        {"valid_range": np.array([-2.9, 2.8]), "scale_factor": 0.1},
        np.where(INVALID, np.nan, COUNTS * 0.1),
    ),
    "valid range, unpacked, mirrored": (
        COUNTS,
        {"valid_min": -2.8, "scale_factor": -0.1},
        np.where(COUNTS > 28, np.nan, COUNTS * -0.1),
    ),
    "valid min": (COUNTS, {"valid_min": np.int16(-29)}, np.where(COUNTS < -29, np.nan, COUNTS)),
    "valid max": (
        COUNTS,
        {"valid_max": np.int16(28), "add_offset": 100.0},
        np.where(COUNTS > 28, np.nan, COUNTS + 100.0),
    ),
    "valid max of a float": (
        FLOATS,
        {"valid_max": 2.8},
        np.where(COUNTS > 28, np.nan, FLOATS.astype(float)),
    ),
    "unsigned": (BYTES.view("i1"), {"_Unsigned": "true"}, BYTES.astype(float)),
    "unsigned, packed": (
        BYTES.view("i1"),
        {"_Unsigned": "true", "scale_factor": 0.5, "add_offset": -50.0},
        BYTES * 0.5 - 50.0,
    ),
    "unsigned, with fill": (
        BYTES.view("i1"),
        {
            "_Unsigned": "true",
            "_FillValue": np.int8(-97),
            "valid_range": np.array([101, -98], "i1"),
            "scale_factor": 0.5,
        },
        np.where((BYTES == 159) | (BYTES == 100), np.nan, BYTES * 0.5),
    ),
    "unsigned, limit beyond its type": (
        BYTES.view("i1"),
        {"_Unsigned": "true", "valid_max": np.int16(300)},
        BYTES.astype(float),
    ),
    "signed": (COUNTS.view("u2"), {"_Unsigned": "false", "scale_factor": 0.5}, COUNTS * 0.5),
}


@pytest.mark.filterwarnings("ignore:variable 'gyro_x' has multiple fill values")
@pytest.mark.parametrize("form", ["NETCDF4", "NETCDF3_CLASSIC", "hdf5"])
@pytest.mark.parametrize("case", list(CASES))
def test_packed_numbers_are_decoded_by_the_cf_conventions(tmp_path, case, form):
    stored, attributes, expected = CASES[case]
    if (form, case) == ("NETCDF3_CLASSIC", "signed"):
        pytest.skip("this format has no unsigned type")
    path = tmp_path / ("log.h5" if form == "hdf5" else "log.nc")
    raw = read_log(write(path, stored, dict(attributes), form=form))
    np.testing.assert_allclose(raw.rate.values[0], expected, rtol=1e-12, atol=0.0)
    assert raw.attrs["unreadable_cells"] == np.isnan(expected).sum()


@pytest.mark.filterwarnings("ignore:variable 'gyro_x' has multiple fill values")
@pytest.mark.parametrize(
    "case", ["scale and offset", "several missing", "unsigned, packed", "signed"]
)
def test_packed_numbers_are_decoded_like_xarray(tmp_path, case):
    stored, attributes, _ = CASES[case]
    path = write(tmp_path / "log.nc", stored, dict(attributes))
    raw = read_log(path)
    with xr.open_dataset(path, decode_times=False) as decoded:
        np.testing.assert_allclose(raw.rate.values[0], decoded["gyro_x"].values, rtol=1e-6)


TIMES = {
    "counts": ({"scale_factor": 0.5}, 0.5, 0.0),
    "range in packed units": (
        {"scale_factor": 0.01, "valid_range": np.array([0, ROWS - 1], "i4")},
        0.01,
        0.0,
    ),
    "range in unpacked units": (
        {"scale_factor": 0.01, "valid_range": np.array([0.0, 0.59])},
        0.01,
        0.0,
    ),
    "offset": (
        {"scale_factor": 0.01, "add_offset": 1_767_225_600.0, "units": "Seconds Since 1970-01-01"},
        0.01,
        1_767_225_600.0,
    ),
    "no whole nanoseconds": ({"scale_factor": 1 / 3, "add_offset": 10.0}, 1 / 3, 10.0),
}


@pytest.mark.parametrize("case", list(TIMES))
@pytest.mark.parametrize("suffix", [".nc", ".h5"])
def test_packed_stamps_keep_every_row(tmp_path, case, suffix):
    attributes, step, start = TIMES[case]
    raw = read_log(write(tmp_path / f"log{suffix}", COUNTS, {}, time=dict(attributes)))
    expected = np.rint((start + step * np.arange(ROWS)) * 1e9)
    np.testing.assert_allclose(
        raw.time.values.astype(np.int64), expected, atol=300.0 if start > 1e9 else 1.0, rtol=0.0
    )


def test_whole_counts_stay_whole_on_the_grid(tmp_path):
    raw = read_log(
        write(
            tmp_path / "log.nc",
            BYTES.view("i1"),
            {"_Unsigned": "true", "scale_factor": 0.5, "_FillValue": np.int8(-97)},
        )
    )
    assert raw.rate.encoding == {
        "dtype": np.dtype("int16"),
        "scale_factor": 0.5,
        "_FillValue": -32767,
    }


@pytest.mark.parametrize(
    "attributes",
    [
        {"scale_factor": 0.0},
        {"scale_factor": "0.1"},
        {"add_offset": np.nan},
        {"valid_range": np.arange(3)},
    ],
)
def test_an_attribute_without_a_usable_value_is_refused_by_name(tmp_path, attributes):
    with pytest.raises(
        FormatError, match=rf"log.nc: variable 'gyro_x': .*{next(iter(attributes))}"
    ):
        read_log(write(tmp_path / "log.nc", COUNTS, attributes))


def test_counts_beyond_the_digits_of_a_float_are_compared_exactly():
    large = np.array([2**62, 2**62 + 1], dtype="i8")
    packing = Packing.from_attributes("x", large.dtype, {"_FillValue": large[0]})
    assert np.ma.getmaskarray(packing.read_counts(large)).tolist() == [True, False]


def write_regular(
    path: Path, stored: np.ndarray, attributes: dict[str, Any], *, zarr_format: int = 3, **time: Any
) -> Path:
    """Write a regular log of another program: axis, stamps, the sampling rate as attribute."""
    stamps = (["time"], np.arange(ROWS) * 10, {"units": "milliseconds since 2026-01-01", **time})
    log = xr.Dataset(
        {"rate": (["axis", "time"], stored[None], {"units": "degree hour-1", **attributes})},
        coords={"axis": ["x"]},
        attrs={"sampling_rate_hz": 100.0},
    ).assign(time_=stamps)
    log = xr.decode_cf(log, decode_times=False, mask_and_scale=False).rename(time_="time")
    if path.suffix == ".zarr":
        log.to_zarr(path, consolidated=False, zarr_format=zarr_format)
    else:
        log.to_netcdf(path, encoding={"rate": {"_FillValue": None}})  # xarray would add NaN
    return path


@pytest.mark.filterwarnings("ignore:The data type")
@pytest.mark.parametrize("suffix", [".nc", ".zarr"])
@pytest.mark.parametrize(
    "case",
    [
        "plain",
        "scale and offset",
        "fill",
        "valid range, packed",
        "valid max",
        "unsigned, packed",
    ],
)
def test_regular_log_of_another_program_is_decoded_like_a_raw_log(tmp_path, case, suffix):
    stored, attributes, expected = CASES[case]
    log = read_log(write_regular(tmp_path / f"log{suffix}", stored, attributes))
    np.testing.assert_allclose(log.rate.values[0], expected, rtol=1e-12)
    np.testing.assert_allclose(log.rate[:, 7:11].values[0], expected[7:11], rtol=1e-12)
    assert log.time.values[5] == np.datetime64("2026-01-01T00:00:00.05")


def test_samples_of_a_regular_log_that_were_not_written_are_missing(tmp_path):
    values = np.append(np.linspace(1.0, 2.0, ROWS - 1), netCDF4.default_fillvals["f8"])
    rate = read_log(write_regular(tmp_path / "log.nc", values, {})).rate.values[0]
    assert np.flatnonzero(np.isnan(rate)).tolist() == [ROWS - 1]
    np.testing.assert_allclose(rate[: ROWS - 1], values[:-1])


@pytest.mark.parametrize(
    ("attribute", "value"), [("calendar", "noleap"), ("units", "seconds since now")]
)
def test_regular_log_with_a_climate_calendar_is_refused(tmp_path, attribute, value):
    with pytest.raises(UnitError, match=f"log.nc: column 'time': .*{value}"):
        read_log(write_regular(tmp_path / "log.nc", COUNTS, {}, **{attribute: value}))


@pytest.mark.parametrize("regular", [True, False])
def test_default_fill_value_of_zarr_is_ignored(tmp_path, regular):
    """Zarr writes a fill value of 0 by default, but samples of 0 are values."""
    path = tmp_path / "log.zarr"
    if regular:
        write_regular(path, COUNTS, {"_FillValue": np.int16(0)}, zarr_format=2)
    else:
        group = zarr.open_group(path, mode="w", zarr_format=2)
        for name, values, unit in (("time", np.arange(ROWS), "s"), ("gyro_x", COUNTS, "deg/h")):
            attributes = {"units": unit, "_ARRAY_DIMENSIONS": ["obs"]}
            group.create_array(name, data=values).attrs.update(attributes)
    np.testing.assert_array_equal(read_log(path).rate.values[0], COUNTS)


@pytest.mark.parametrize("zarr_format", [2, 3])
def test_a_zarr_array_that_does_not_name_its_dimensions_is_refused(tmp_path, zarr_format):
    group = zarr.open_group(tmp_path / "log.zarr", mode="w", zarr_format=zarr_format)
    group.create_array("gyro_x", data=COUNTS)
    with pytest.raises(FormatError, match=r"log.zarr: an array does not name its dimensions"):
        read_log(tmp_path / "log.zarr")

"""Logs of arrays in memory: what is accepted, and what is refused with advice."""

from __future__ import annotations

import dask.array as da
import numpy as np
import pandas as pd
import pytest
import xarray as xr

import gyrostab
from gyrostab.errors import MissingUnitError, OptionError, UnitError
from gyrostab.ingest.convert import as_log
from gyrostab.ingest.make_log import make_log

VALUES = np.random.default_rng(1).standard_normal(50)


@pytest.mark.parametrize(
    "given",
    [
        VALUES.tolist(),
        pd.Series(VALUES),
        xr.DataArray(VALUES, dims="time"),
        xr.DataArray(da.from_array(VALUES)),
        da.from_array(VALUES, chunks=20),
        pd.DataFrame(VALUES[None]),
    ],
)
def test_anything_like_an_array_is_accepted(given):
    log = make_log(given, rate=10.0, unit="deg/h")
    assert log.chunks == (
        {"axis": (1,), "time": (20, 20, 10)} if isinstance(given, da.Array) else {}
    )
    np.testing.assert_array_equal(log.rate.values[0], VALUES)


@pytest.mark.parametrize("to_array", [np.asarray, da.from_array])
def test_infinite_values_are_missing(to_array):
    spoilt = VALUES.astype(np.float32)
    spoilt[[3, 7, 9]] = np.inf, -np.inf, np.nan
    channels = {"temperature": (spoilt, "degC")}
    log = make_log(to_array(spoilt), rate=10.0, unit="deg/h", channels=channels)
    assert log.rate.dtype == np.float32
    for name in ("rate", "temperature"):
        assert np.flatnonzero(np.isnan(np.ravel(log[name].values))).tolist() == [3, 7, 9]
        assert not np.isinf(log[name].values).any()


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"values": VALUES + 1j}, OptionError, "of type complex128; give real numbers"),
        ({"values": ["a", "b"]}, OptionError, "give real numbers"),
        ({"values": [[1.0, 2.0], [3.0]]}, OptionError, "not an array"),
        ({"values": 5.0}, OptionError, r"shape \(\)"),
        ({"values": VALUES[:, None]}, OptionError, r"shape \(50, 1\) do not fit"),
        ({"rate": "10Hz"}, OptionError, "rate '10Hz': give the sampling rate in Hz, a number"),
        ({"rate": None}, OptionError, "rate None: give"),
        ({"channels": {"rate": (VALUES, "deg/h")}}, OptionError, "'rate': variables of gyrostab"),
        ({"channels": {"time": (VALUES, "1")}}, OptionError, "'time': variables of gyrostab"),
        (
            {"channels": {"temperature": (VALUES, "V")}},
            UnitError,
            "'V' is not a unit of temperature",
        ),
        (
            {"channels": {"pressure": (VALUES, "m/s")}},
            UnitError,
            "channel 'pressure': 'm/s' is not a unit of pressure; known are Pa",
        ),
        ({"channels": {"accel_x": (VALUES[1:], "g")}}, OptionError, r"shape \(49,\).* 50 samples"),
        (
            {"channels": {"vibration": VALUES}},
            MissingUnitError,
            r"\{'vibration': \(values, 'g'\)\}",
        ),
        ({"values": [VALUES] * 2, "axis": ["x", "x"]}, OptionError, "give each axis another name"),
        ({"channels": {"pump": (["on"] * 50, "1")}}, OptionError, "of channel 'pump' are of type"),
    ],
)
def test_bad_input_is_refused_with_advice(change, error, message):
    options = {"values": VALUES, "rate": 10.0, "unit": "deg/h", **change}
    with pytest.raises(error, match=message):
        make_log(options.pop("values"), **options)


def _mask_blocks(masked):
    """Return dask chunks with masks that the type of the dask array does not show."""
    plain = da.from_array(np.ma.getdata(masked), chunks=20)
    mask = da.from_array(np.ma.getmaskarray(masked), chunks=20)
    meta = np.empty(0, plain.dtype)
    return da.map_blocks(np.ma.masked_where, mask, plain, meta=meta)


TO_MASKED = pytest.mark.parametrize(
    "to_array", [lambda masked: masked, lambda masked: da.from_array(masked, 20), _mask_blocks]
)


@TO_MASKED
def test_masked_values_are_missing(to_array):
    masked = to_array(np.ma.masked_where(VALUES > 1.0, VALUES))
    channels = {"temperature": (masked, "degC")}
    log = make_log(masked, rate=10.0, unit="deg/h", channels=channels)
    expected = np.where(VALUES > 1.0, np.nan, VALUES)
    np.testing.assert_array_equal(log.rate.values[0], expected)
    np.testing.assert_array_equal(log.temperature.values, expected)


@pytest.mark.parametrize("to_array", [lambda masked: masked, da.from_array])
def test_masked_counts_are_missing(to_array):
    counts = to_array(np.ma.masked_equal([3, 0, 5], 0))
    channels = {"temperature": (counts, "degC")}
    log = make_log(counts, rate=10.0, unit="2 deg/h", channels=channels)
    np.testing.assert_array_equal(log.rate.values[0], [6.0, np.nan, 10.0])
    np.testing.assert_array_equal(log.temperature.values, [3.0, np.nan, 5.0])


@TO_MASKED
def test_masked_values_are_missing_in_windows(to_array):
    """The samples under the mask are far from the others, and change no average."""
    data = np.where(np.arange(400) % 5 == 0, 1e6, np.arange(400) % 3)
    array = to_array(np.ma.masked_equal(data, 1e6))
    attrs = {"units": "degree hour-1"}
    log = make_log(np.zeros(400), rate=10.0, unit="deg/h")
    log = log.assign(
        rate=(("axis", "time"), array[None], attrs), pressure=("time", array, {"units": "Pa"})
    )
    surface = gyrostab.davar(log, window="10s", step="10s").compute()
    expected = np.nanmean(np.where(data == 1e6, np.nan, data).reshape(4, 100), axis=1)
    np.testing.assert_allclose(surface.pressure, expected)
    np.testing.assert_allclose(surface.window_mean[0], expected)


@pytest.mark.parametrize("unit", [None, 3])
def test_values_need_a_unit(unit):
    with pytest.raises(MissingUnitError, match=r"unit=.*for instance 'deg/s'"):
        make_log(VALUES, rate=10.0, unit=unit)


def test_channels_have_the_units_of_channels_of_files(tmp_path):
    given = {"rotation_rate": "rpm", "toolface": "rad", "temperature_case": "V", "ramp": "V"}
    given |= {"flow": "gal/min", "temperature_of_mud": "furlong"}
    channels = {name: (np.ones(50), unit) for name, unit in given.items()}
    log = make_log(VALUES, rate=10.0, unit="deg/h", channels=channels)
    assert {name: (float(log[name][0]), log[name].units) for name in given} == {
        "rotation_rate": (6.0, "degree s-1"),
        "toolface": (pytest.approx(57.29578), "degree"),
        "temperature_case": (1.0, "V"),
        "ramp": (1.0, "V"),
        "flow": (1.0, "gal/min"),
        "temperature_of_mud": (1.0, "furlong"),
    }
    path = gyrostab.to_netcdf(log, tmp_path / "log.nc")
    assert gyrostab.open_log(path).flow.units == "gal/min"


@pytest.mark.parametrize("missing", [[], [11]], ids=["uniform", "gap"])
@pytest.mark.parametrize("make", ["from_dataarray", "from_dataframe", "davar", "lazy"])
def test_infinite_values_of_labelled_data_are_missing_and_counted(make, missing):
    values, temperature = np.arange(400.0) % 7, 20.0 + np.arange(400.0) / 100
    values[[5, 6, 200]] = np.inf, np.inf, -np.inf
    temperature[8] = np.inf
    time = pd.date_range("2026-01-01", periods=400, freq="10ms")
    kept = np.setdiff1d(np.arange(400), missing)
    array = xr.DataArray(values, {"time": time}, attrs={"units": "deg/s"})[kept]
    expected = np.where(np.isinf(values), np.nan, values) * 3600.0
    expected[missing] = np.nan
    if make == "lazy":
        for lazy in (array.chunk(time=150), array.chunk(time=-1)):
            log = gyrostab.from_dataarray(lazy)
            assert log.rate.chunks is not None or missing
            np.testing.assert_array_equal(log.rate.values[0], expected)
        return
    if make == "davar":
        with pytest.warns(UserWarning, match="3 gyro cells are infinite"):
            surface = gyrostab.davar(array, window="1s")
        assert_same = np.testing.assert_array_equal
        log = make_log(expected, rate=100.0, unit="deg/h", start="2026-01-01")
        assert_same(surface.avar.values, gyrostab.davar(log, window="1s").avar.values)
        return
    columns = {"gyro_x [deg/s]": values, "temperature [degC]": temperature}
    given = array if make == "from_dataarray" else pd.DataFrame(columns, time).iloc[kept]
    with pytest.warns(UserWarning, match="3 gyro cells"):
        log = getattr(gyrostab, make)(given)
    np.testing.assert_array_equal(log.rate.values[0], expected)
    assert log.attrs["unreadable_cells"] == (3 if make == "from_dataarray" else 4)
    assert not any(np.isinf(item.values).any() for item in log.values() if item.dtype.kind == "f")


@pytest.mark.parametrize("present", [slice(None), np.r_[0:200, 320:400]])
def test_coordinates_of_a_dataarray_are_channels(present):
    time = pd.date_range("2026-03-14", periods=400, freq="20ms")
    warm = np.linspace(20.0, 30.0, 400)
    coordinates = {
        "time": time,
        "temperature": ("time", 32 + 1.8 * warm, {"units": "degF"}),
        "run": 7,
        "pump": ("time", ["on", "off"] * 200),
    }
    data = xr.DataArray(np.ones(400), coordinates, ("time",), attrs={"units": "deg/h"})
    with pytest.warns(UserWarning, match="'pump' is left out: it holds text"):
        log = gyrostab.from_dataarray(data[present])
    np.testing.assert_allclose(log["temperature"].sel(time=time[present]), warm[present])
    assert log["temperature"].attrs["units"] == "degree_Celsius"
    assert "run" not in log.variables
    surface = gyrostab.davar(data[present].drop_vars("pump"), window="2s")
    assert float(surface["temperature"][0]) == pytest.approx(warm[:100].mean())


@pytest.mark.filterwarnings("error")
def test_an_array_of_a_file_without_infinite_values_has_no_note(tmp_path):
    path = tmp_path / "log.nc"
    gyrostab.to_netcdf(make_log(np.resize(VALUES, 400), rate=10.0, unit="deg/h"), path)
    with xr.open_dataset(path) as stored:
        log = gyrostab.from_dataarray(stored["rate"])
    assert "notes" not in log.attrs


@pytest.mark.parametrize("chunks", [None, {}])
@pytest.mark.parametrize("make", [gyrostab.from_dataarray, as_log])
def test_integers_that_xarray_has_not_decoded_are_decoded(make, chunks, tmp_path):
    time = pd.date_range("2026-05-01", periods=5, freq="10ms")
    rate, temperature = [[0.5, 1.0, np.nan, -2.0, 3.0]], [20.5, 20.5, 21.0, 21.0, 21.5]
    log = xr.Dataset(
        {"rate": (("axis", "time"), rate, {"units": "degree hour-1"})},
        {"time": time, "axis": ["x"]},
    )
    log["temperature"] = "time", temperature, {"units": "degree_Celsius"}
    packing = {"dtype": "i2", "scale_factor": 0.5, "add_offset": 5.0, "_FillValue": -99}
    log.to_netcdf(tmp_path / "log.nc", encoding=dict.fromkeys(["rate", "temperature"], packing))
    with xr.open_dataset(tmp_path / "log.nc", mask_and_scale=False, chunks=chunks) as stored:
        assert stored["rate"].dtype == np.int16
        given = stored["rate"].assign_coords(temperature=stored["temperature"])
        made = make(given if make is gyrostab.from_dataarray else stored).load()
    np.testing.assert_array_equal(made["rate"], rate)
    np.testing.assert_array_equal(made["temperature"], temperature)


def test_a_channel_is_not_called_like_a_dimension_of_texts_in_a_file(tmp_path):
    with pytest.raises(OptionError, match="'string1': variables of gyrostab have this name"):
        make_log(VALUES, rate=10.0, unit="deg/h", channels={"string1": (VALUES, "V")})
    rows = "\n".join(f"{n / 10},{value},5" for n, value in enumerate(np.resize(VALUES, 400)))
    path = tmp_path / "log.csv"
    path.write_text(f"time [s],gyro_x [deg/h],string1 [V]\n{rows}\n")
    log = gyrostab.regularise(gyrostab.read_log(path))
    product = gyrostab.fit_noise(gyrostab.davar(log, window="10s"))
    stored = gyrostab.to_netcdf(product, tmp_path / "product.nc")
    assert "string1_channel" in gyrostab.open_product(stored)


def test_lazy_channels_stay_lazy():
    kelvin = da.from_array(VALUES, chunks=20)
    log = make_log(VALUES, rate=10.0, unit="deg/h", channels={"temperature": (kelvin, "K")})
    assert log.temperature.chunks == ((20, 20, 10),)
    np.testing.assert_allclose(log.temperature, VALUES - 273.15)

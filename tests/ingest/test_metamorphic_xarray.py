"""Logs after xarray operations: the product is correct, or the call is refused."""

from __future__ import annotations

import pickle
import re
from typing import Any

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st

import gyrostab
from gyrostab.errors import (
    GyrostabError,
    MissingUnitError,
    OptionError,
    SchemaError,
    TimeError,
    UnitError,
)
from gyrostab.ingest.convert import as_log
from gyrostab.ingest.make_log import make_log
from gyrostab.time.grid import TimeGridIndex
from tests.reference import direct_angle_surface, direct_surface
from tests.support.regular_logs import log_of, signal

RATE, SIZE, START = 100.0, 6000, "2026-03-01T10:00:00"
KS = [1, 3, 10, 40]


def record(seed: int = 3, *, size: int = SIZE, lost: float = 0.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((2, size)) + 0.02 * np.cumsum(rng.standard_normal((2, size)), axis=1)
    x[:, rng.random(size) < lost] = np.nan
    return x


def make(x: np.ndarray | None = None, *, rate: float = RATE, **options) -> xr.Dataset:
    values = record() if x is None else x
    temperature = 20.0 + np.arange(values.shape[-1]) / 1000
    return make_log(
        values,
        rate=rate,
        unit="deg/h",
        start=START,
        channels={"temperature": (temperature, "degC")},
        **options,
    )


def stamped(log: xr.Dataset) -> xr.Dataset:
    """Return the log with its stamps in memory, as another program would pass it."""
    return log.assign_coords(time=log.time.values)


def surface_of(log, *, rate: float, window: int = 800, **options) -> xr.Dataset:
    made = gyrostab.davar(
        log,
        window=f"{window / rate}s",
        step=f"{window / rate}s",
        taus=[k / rate for k in KS],
        min_strict=0.0,
        min_coverage=0.0,
        **options,
    ).load()
    np.testing.assert_allclose(made.tau, np.array(KS) / rate, rtol=1e-12)
    assert made.attrs["sampling_rate_hz"] == pytest.approx(rate, rel=1e-12)
    return made


def check_against(
    log, x: np.ndarray, *, rate: float, rtol: float = 1e-9, window: int = 800
) -> xr.Dataset:
    """Check that the surface of a log is that of the samples `x`, by the definition; return it."""
    made = surface_of(log, rate=rate, window=window)
    for row, values in enumerate(np.atleast_2d(x)):
        avar, count = direct_surface(values.astype(np.float64), window, window, KS)
        np.testing.assert_array_equal(made["count"][row].values, count)
        np.testing.assert_allclose(made["avar"][row].values[count > 0], avar[count > 0], rtol=rtol)
    return made


@pytest.mark.parametrize("explicit", [False, True])
@pytest.mark.parametrize("chunked", [False, True])
@pytest.mark.parametrize("stride", [2, 3, 7])
def test_thinned_log_has_its_new_rate(explicit, chunked, stride):
    x = record(lost=0.05)
    log = stamped(make(x)) if explicit else make(x)
    log = log.chunk(time=999) if chunked else log
    check_against(
        log.isel(time=slice(None, None, stride)), x[:, ::stride], rate=RATE / stride, window=400
    )
    check_against(
        log.isel(time=np.arange(0, SIZE, stride)), x[:, ::stride], rate=RATE / stride, window=400
    )


@pytest.mark.parametrize("explicit", [False, True])
@pytest.mark.parametrize("chunked", [False, True])
@pytest.mark.parametrize("rate", [100.0, 300.0, 99.3])
def test_dropped_samples_are_missing(explicit, chunked, rate):
    size = 1500  # each run of samples costs time in a lazy log
    x = record(size=size, lost=0.3)
    x[:, 500:650] = np.nan
    log = stamped(make(x, rate=rate)) if explicit else make(x, rate=rate)
    dropped = (log.chunk(time=194) if chunked else log).dropna("time", subset=["rate"])
    assert dropped.sizes["time"] < 0.7 * size
    first, last = np.flatnonzero(~np.isnan(x[0]))[[0, -1]]
    assert "temperature" in check_against(dropped, x[:, first : last + 1], rate=rate, window=200)
    if chunked:
        assert as_log(dropped).rate.chunks is not None


def test_dropped_samples_without_a_declared_rate():
    x = record(lost=0.3)
    dropped = stamped(make(x)).dropna("time", subset=["rate"])
    del dropped.attrs["sampling_rate_hz"]
    first, last = np.flatnonzero(~np.isnan(x[0]))[[0, -1]]
    check_against(dropped, x[:, first : last + 1], rate=RATE)


def test_averaged_log_has_its_new_rate():
    x = record()
    means = x.reshape(2, -1, 4).mean(axis=2)
    check_against(make(x).coarsen(time=4).mean(), means, rate=RATE / 4, window=300)
    seconds = x.reshape(2, -1, 100).mean(axis=2)
    with pytest.raises(OptionError, match="longer than the record"):
        gyrostab.davar(make(x).resample(time="1s").mean(), window="10min")
    made = gyrostab.davar(
        make(x).resample(time="1s").mean(), window="60s", taus=[1.0, 3.0], min_strict=0.0
    ).load()
    avar, _ = direct_surface(seconds[0], 60, 6, [1, 3])
    np.testing.assert_allclose(made.avar[0], avar, rtol=1e-9)


def test_interpolation_to_another_rate():
    x = record()
    log = make(x)
    fine = log.interp(time=pd.date_range(START, periods=2 * SIZE - 1, freq="5ms"))
    expected = np.interp(np.arange(2 * SIZE - 1) / 2, np.arange(SIZE), x[0])
    check_against(fine.sel(axis=["x"]), expected, rate=2 * RATE)


ORDER = {
    "reversed": lambda log: log.isel(time=slice(None, None, -1)),
    "reversed by sorting": lambda log: log.sortby("time", ascending=False),
    "shuffled": lambda log: log.isel(time=np.random.default_rng(1).permutation(SIZE)),
    "an overlap": lambda log: xr.concat(
        [log.isel(time=slice(0, 900)), log.isel(time=slice(800, 2000))], "time"
    ),
    "the second half first": lambda log: xr.concat(
        [log.isel(time=slice(3000, 6000)), log.isel(time=slice(0, 3000))], "time"
    ),
    "a sample twice": lambda log: xr.concat(
        [log.isel(time=slice(0, 900)), log.isel(time=slice(899, 2000))], "time"
    ),
    "padded": lambda log: log.pad(time=5),
    "irregular": lambda log: log.assign_coords(
        time=log.time.values + (1e6 * np.random.default_rng(1).uniform(0, 9, SIZE)).astype("m8[ns]")
    ),
    "half a sample apart": lambda log: xr.concat(
        [
            log.isel(time=slice(0, 900)),
            log.isel(time=slice(1000, 2000)).pipe(
                lambda log: log.assign_coords(time=log.time.values + np.timedelta64(5, "ms"))
            ),
        ],
        "time",
    ),
    "numbers for time": lambda log: log.assign_coords(time=np.arange(SIZE) / RATE),
    "no time": lambda log: log.drop_vars("time"),
    "another name of time": lambda log: log.rename(time="t"),
    "another name of the signal": lambda log: log.rename(rate="gyro"),
    "folded": lambda log: log.coarsen(time=100).construct(time=("time", "fast")),
    "grouped": lambda log: log.groupby("time.second").mean(),
    "without units": lambda log: log.assign(rate=log.rate.drop_attrs(deep=False)),
    "one sample": lambda log: log.isel(time=[5]),
    "no sample": lambda log: log.isel(time=slice(0, 0)),
    "rows as read": lambda log: log.drop_vars("time").rename_dims(time="row"),
    "complex numbers": lambda log: log.assign(rate=log.rate.astype(complex)),
    "text": lambda log: log.assign(rate=log.rate.astype(str)),
    "objects": lambda log: log.assign(rate=log.rate.astype(object)),
    "dates": lambda log: log.assign(rate=log.rate.astype("M8[ns]")),
    "a channel called like a variable of the product": lambda log: log.rename(temperature="count"),
}


@pytest.mark.parametrize("explicit", [False, True])
@pytest.mark.parametrize("name", list(ORDER))
def test_invalid_input_is_refused(name, explicit, tmp_path):
    changed = ORDER[name](stamped(make()) if explicit else make())
    with pytest.raises(GyrostabError) as refusal:
        gyrostab.davar(changed, window="8s")
    assert len(str(refusal.value)) > 30
    with pytest.raises(GyrostabError):
        gyrostab.diagnose(changed)
    is_log = "time" in changed.dims and "rate" in changed and "units" in changed.rate.attrs
    if is_log and name not in ("no sample", "no time", "folded", "one sample"):
        with pytest.raises(GyrostabError):
            gyrostab.to_netcdf(changed, tmp_path / "log.nc")


def test_sorting_repairs_a_log_out_of_order():
    x = record()
    shuffled = make(x).isel(time=np.random.default_rng(1).permutation(SIZE))
    check_against(shuffled.sortby("time"), x, rate=RATE)
    check_against(make(x).isel(time=slice(None, None, -1)).sortby("time"), x, rate=RATE)


@pytest.mark.parametrize("explicit", [False, True])
def test_gap_between_two_pieces_is_missing(explicit):
    x = record()
    log = stamped(make(x)) if explicit else make(x)
    joined = xr.concat([log.isel(time=slice(0, 2000)), log.isel(time=slice(2500, None))], "time")
    lost = x.copy()
    lost[:, 2000:2500] = np.nan
    check_against(joined, lost, rate=RATE)
    whole = xr.concat([log.isel(time=slice(0, 2000)), log.isel(time=slice(2000, None))], "time")
    assert explicit or isinstance(whole.xindexes["time"], TimeGridIndex)
    check_against(whole, x, rate=RATE)


INFINITE = np.random.default_rng(2).random((2, SIZE)) < 0.02
KEEPS = {
    "axes by number": (lambda log: log.assign_coords(axis=[0, 1]), lambda x: x),
    "axes by bytes": (lambda log: log.assign_coords(axis=[b"x", b"y"]), lambda x: x),
    "axes without labels": (lambda log: log.drop_vars("axis"), lambda x: x),
    "infinite values": (
        lambda log: log.assign(rate=log.rate.where(~INFINITE, np.inf)),
        lambda x: np.where(INFINITE, np.nan, x),
    ),
    "infinite values in chunks": (
        lambda log: log.assign(rate=log.rate.chunk(time=700).where(~INFINITE, -np.inf)),
        lambda x: np.where(INFINITE, np.nan, x),
    ),
    "a part of the time": (
        lambda log: log.sel(time=slice("2026-03-01T10:00:10", "2026-03-01T10:00:39.99")),
        lambda x: x[:, 1000:4000],
    ),
    "one axis": (lambda log: log.isel(axis=0), lambda x: x[:1]),
    "one axis by list": (lambda log: log.sel(axis=["y"]), lambda x: x[1:]),
    "axes turned round": (lambda log: log.isel(axis=[1, 0]), lambda x: x[::-1]),
    "less its mean": (lambda log: log - log.mean(), lambda x: x - x.mean(axis=1, keepdims=True)),
    "doubled": (lambda log: log * 2, lambda x: 2 * x),
    "another order of dimensions": (lambda log: log.transpose(), lambda x: x),
    "chunks": (lambda log: log.chunk(time=501, axis=1), lambda x: x),
    "loaded": (lambda log: log.chunk(time=501).load(), lambda x: x),
    "pickled": (lambda log: pickle.loads(pickle.dumps(log)), lambda x: x),
    "copied": (lambda log: log.copy(deep=True), lambda x: x),
    "a mask": (lambda log: log.where(log.rate > 0), lambda x: np.where(x > 0, x, np.nan)),
    "a mask that drops": (
        lambda log: log.where((log.rate > -1).all("axis"), drop=True),
        lambda x: np.where((x > -1).all(axis=0), x, np.nan)[
            :, slice(*(np.flatnonzero((x > -1).all(axis=0))[[0, -1]] + [0, 1]))
        ],
    ),
    "a moving mean": (
        lambda log: log.rolling(time=3).mean(),
        lambda x: np.pad(
            (x[:, 2:] + x[:, 1:-1] + x[:, :-2]) / 3, ((0, 0), (2, 0)), constant_values=np.nan
        ),
    ),
    "differences": (lambda log: log.diff("time"), lambda x: np.diff(x, axis=1)),
    "the head": (lambda log: log.head(time=3000), lambda x: x[:, :3000]),
    "shifted": (
        lambda log: log.shift(time=4),
        lambda x: np.pad(x[:, :-4], ((0, 0), (4, 0)), constant_values=np.nan),
    ),
    "single precision": (lambda log: log.astype(np.float32), lambda x: x),
    "without attributes of the dataset": (lambda log: log.drop_attrs(deep=False), lambda x: x),
    "false attributes": (
        lambda log: log.assign_attrs(sampling_rate_hz=7.0, kind="angle"),
        lambda x: x,
    ),
}


@pytest.mark.parametrize("explicit", [False, True])
@pytest.mark.parametrize("name", list(KEEPS))
def test_operations_that_keep_the_rate(name, explicit):
    change, truth = KEEPS[name]
    x = record()
    log = stamped(make(x)) if explicit else make(x)
    check_against(
        change(log), truth(x), rate=RATE, rtol=1e-4 if name == "single precision" else 1e-9
    )


@pytest.mark.parametrize(
    ("labels", "names"), [([0, 1], ["0", "1"]), ([b"x", b"y"], ["x", "y"]), (None, ["x", "y"])]
)
def test_axes_have_names_whatever_their_labels(labels, names, tmp_path):
    log = make().drop_vars("axis") if labels is None else make().assign_coords(axis=labels)
    surface = gyrostab.davar(log, window="8s", axis=names[1])
    assert surface.axis.values.tolist() == names[1:]
    product = gyrostab.fit_noise(gyrostab.davar(log, window="8s"))
    opened = gyrostab.open_product(gyrostab.to_netcdf(product, tmp_path / "product.nc"))
    assert opened.axis.values.tolist() == names
    gyrostab.plot_signal(log)


def test_infinite_values_are_missing():
    x = record()
    finite = make(np.where(INFINITE, np.nan, x))
    surface, expected = (
        gyrostab.davar(log, window="8s")
        for log in (finite.assign(rate=finite.rate.where(~INFINITE, np.inf)), finite)
    )
    xr.testing.assert_equal(surface, expected)


def test_channels_as_coordinates_are_channels(tmp_path):
    """Also those on their own time, and where samples have been dropped."""
    log = make().assign(pressure=("time_pressure", np.arange(60.0), {"units": "Pa"}))
    log = log.assign_coords(time_pressure=log.time.values[::100])
    expected = surface_of(log, rate=RATE)
    marked = log.set_coords(["temperature", "pressure"])
    xr.testing.assert_identical(surface_of(marked, rate=RATE), expected)
    stored = gyrostab.open_log(gyrostab.to_netcdf(marked, tmp_path / "log.nc"))
    assert {"temperature", "pressure"} <= set(stored.data_vars)
    thinned = as_log(stamped(marked).isel(time=np.delete(np.arange(SIZE), 7)))
    assert np.flatnonzero(np.isnan(thinned.temperature.values)).tolist() == [7]


@pytest.mark.parametrize(
    ("name", "units", "value", "inner", "expected"),
    [
        ("temperature", "degC", 20.0, "degree_Celsius", 20.0),
        ("temperature_case", "K", 293.15, "degree_Celsius", 20.0),
        ("accel_x", "m s-2", 9.80665, "g", 1.0),
        ("rotation_rate", "rpm", 10.0, "degree s-1", 60.0),
        ("mag_x", "G", 0.5, "uT", 50.0),
        ("probe", "bar", 2.0, "Pa", 2e5),
        ("flow", "L/min", 3.0, "L/min", 3.0),
        ("temperature", "V", 3.0, "V", 3.0),
    ],
)
@pytest.mark.parametrize("chunked", [False, True])
def test_units_of_channels_are_converted(name, units, value, inner, expected, chunked):
    values = xr.Variable("time", np.full(SIZE, value), {"units": units})
    log = as_log(make().assign({name: values.chunk(time=999) if chunked else values}))
    assert log[name].units == inner
    np.testing.assert_allclose(log[name].values, expected)
    assert (log[name].chunks is not None) == chunked


@pytest.mark.parametrize(
    ("units", "size"), [("deg/s", 3600.0), ("degree s-1", 3600.0), ("°/h", 1.0)]
)
@pytest.mark.parametrize("chunked", [False, True])
def test_units_of_the_signal_are_converted(units, size, chunked, tmp_path):
    x = record()
    log = make(x)
    log["rate"] = (log.rate / size).assign_attrs(units=units)
    log = log.chunk(time=999) if chunked else log
    check_against(log, x, rate=RATE)
    check_against(log.isel(axis=1), x[1], rate=RATE)
    check_against(gyrostab.open_log(gyrostab.to_netcdf(log, tmp_path / "log.nc")), x, rate=RATE)
    assert (as_log(log).rate.chunks is not None) == chunked


@pytest.mark.parametrize("units", ["furlong", "degC", "deg", "1", None])
@pytest.mark.parametrize("axis", [slice(None), 1])
def test_a_signal_without_a_known_unit_is_neither_used_nor_written(units, axis, tmp_path):
    log = make()
    log["rate"].attrs = {} if units is None else {"units": units}
    with pytest.raises(SchemaError, match=r"has no units|has units .* deg/s"):
        gyrostab.davar(log.isel(axis=axis), window="8s")
    with pytest.raises(SchemaError, match=r"has no units|has units .* deg/s"):
        gyrostab.to_netcdf(log.isel(axis=axis), tmp_path / "log.nc")
    assert not any(tmp_path.iterdir())


def test_a_file_keeps_the_units_of_channels(tmp_path):
    log = make().assign(temperature_case=("time", np.full(SIZE, 293.15), {"units": "K"}))
    stored = gyrostab.open_log(gyrostab.to_netcdf(log, tmp_path / "log.nc"))
    assert stored.temperature_case.units == "K"
    np.testing.assert_array_equal(stored.temperature_case, 293.15)


@pytest.mark.parametrize("axis", [["y"], np.array(["y"]), xr.DataArray(["y"]), {"y": 1}.keys()])
def test_axes_are_selected_by_any_sequence(axis):
    assert gyrostab.davar(make(), window="8s", axis=list(axis)).axis.values.tolist() == ["y"]
    assert gyrostab.davar(make(), window="8s", axis=axis).axis.values.tolist() == ["y"]


@pytest.mark.parametrize("keep", [True, False])
def test_arithmetic_with_and_without_attributes(keep):
    x = record()
    with xr.set_options(keep_attrs=keep):
        doubled = 2 * make(x)
    if keep:
        check_against(doubled, 2 * x, rate=RATE)
    else:
        with pytest.raises(SchemaError, match="has no units"):
            gyrostab.davar(doubled, window="8s")


def test_a_log_of_angles():
    theta = np.cumsum(record()[0]) / 3600 / RATE
    log = make_log(theta, rate=RATE, unit="deg", kind="angle", start=START)
    avar, count = direct_angle_surface(theta[::2], 400, 400, KS, 2 / RATE)
    made = surface_of(log.isel(time=slice(None, None, 2)), rate=RATE / 2, window=400)
    np.testing.assert_array_equal(made["count"][0], count)
    np.testing.assert_allclose(made["avar"][0], avar * 3600**2, rtol=1e-6)
    theta[1000:1200] = np.nan
    avar, count = direct_angle_surface(theta, 800, 800, KS, 1 / RATE)
    made = surface_of(
        make_log(theta, rate=RATE, unit="deg", kind="angle", start=START).dropna("time"), rate=RATE
    )
    np.testing.assert_array_equal(made["count"][0], count)


@given(
    rate=st.sampled_from([1.0, 3.0, 7.3, 99.3, 100.0, 300.0, 1024.0, 1e4, 1 / 3]),
    size=st.integers(2, 400),
    stride=st.integers(1, 9),
    lost=st.floats(0.0, 0.9),
    resolution=st.sampled_from([1, 1000]),
    declared=st.booleans(),
    seed=st.integers(0, 999),
)
def test_grid_is_found_for_any_subset_of_samples(
    rate, size, stride, lost, resolution, declared, seed
):
    """Every kept sample stays in place, and the rate is that of the grid or a whole fraction."""
    rng = np.random.default_rng(seed)
    log = make_log(np.arange(float(size)), rate=rate, unit="deg/h", start=START)
    log = log.assign_coords(
        time=log.time.values.astype(np.int64) // resolution * resolution
    ).assign_coords(time=lambda log: ("time", log.time.values.astype("datetime64[ns]")))
    if not declared:
        del log.attrs["sampling_rate_hz"]
    samples = np.flatnonzero(rng.random(size) >= lost)
    samples = samples[samples % stride == 0]
    if samples.size < 2:
        return
    try:
        back = as_log(log.isel(time=samples))
    except TimeError:
        assert not declared or lost > 0  # few samples of an unknown rate
        return
    present = ~np.isnan(back.rate.values[0])
    np.testing.assert_array_equal(back.rate.values[0][present], samples)
    stamps = log.time.values[samples]
    assert (
        np.abs((back.time.values[present] - stamps).astype(np.int64)).max()
        <= 0.1e9 / back.attrs["sampling_rate_hz"]
    )
    ratio = rate / back.attrs["sampling_rate_hz"]
    if (
        declared
    ):  # two stamps, each cut to the resolution, bound the rate by one step of it over their span
        rounding = resolution / float(np.ptp(stamps.astype(np.int64)))
        assert ratio == pytest.approx(
            np.gcd.reduce(np.diff(samples)), rel=max(1.001 * rounding, 1e-7)
        )


@pytest.mark.parametrize("explicit", [False, True])
@pytest.mark.parametrize("chunked", [False, True])
def test_gaps_of_a_log_without_a_table_are_its_missing_samples(explicit, chunked, monkeypatch):
    x = np.ones((2, 3000))
    x[0, 1000:1100] = x[1, 1050:1120] = x[:, 0] = np.nan
    log = make_log(x, rate=50.0, unit="deg/h", start="2026-03-01T10:00")
    log = stamped(log) if explicit else log
    log = log.chunk(time=700) if chunked else log
    monkeypatch.setattr("gyrostab.ingest.grid.gaps.BLOCK_ROWS", 1060)
    assert gap_rows(log) == [["00.00", 1, "missing"], ["20.00", 120, "missing"]]
    assert gap_rows(log.isel(time=slice(1, 1000))) == []
    assert gyrostab.gap_table(log).end[1] == np.datetime64("2026-03-01T10:00:22.4")
    assert gap_rows(gyrostab.from_dataarray(log.rate)) == gap_rows(log)


def gap_rows(log: xr.Dataset) -> list[list]:
    table = gyrostab.gap_table(log)
    return [[f"{row.start:%S.%f}"[:5], row.samples, row.cause] for row in table.itertuples()]


@pytest.mark.parametrize("explicit", [False, True])
def test_the_table_of_gaps_follows_the_samples(explicit, tmp_path):
    x = signal(3000, holes=0.0)
    x[:, 1000:1100] = x[:, 2000:2001] = np.nan  # at 20 s and 40 s
    first = log_of(x)
    log = make_log(x, rate=50.0, unit="deg/h", start="2026-03-01T10:00").assign(
        {name: first[name] for name in first if "gap" in str(name)}
    )
    assert gap_rows(log) == [["20.00", 100, "missing"], ["40.00", 1, "missing"]]
    log = stamped(log) if explicit else log
    path = tmp_path / "log.nc"

    def written(changed: xr.Dataset) -> list[list]:
        return gap_rows(gyrostab.open_log(gyrostab.to_netcdf(changed, path, overwrite=True)))

    assert written(log) == [["20.00", 100, "missing"], ["40.00", 1, "missing"]]
    assert written(log.isel(time=slice(1050, None))) == [
        ["21.00", 50, "missing"],
        ["40.00", 1, "missing"],
    ]
    assert written(log.isel(time=slice(0, 900))) == []
    dropped = log.dropna("time", subset=["rate"])
    assert written(dropped) == [["20.00", 100, "missing"], ["40.00", 1, "missing"]]
    more = dropped.isel(
        time=np.setdiff1d(np.arange(dropped.sizes["time"]), np.r_[500:510, 990:1000])
    )
    assert written(more) == [
        ["10.00", 10, "missing"],
        ["19.80", 10, "missing"],
        ["20.00", 100, "missing"],
        ["40.00", 1, "missing"],
    ]
    if explicit:
        assert [row[1:] for row in written(log.coarsen(time=10).mean())] == [[10, "missing"]]
    else:
        assert written(log.isel(time=slice(0, None, 10))) == [
            ["20.00", 10, "missing"],
            ["40.00", 1, "missing"],
        ]
        assert written(log.isel(time=slice(1, None, 10))) == [["20.02", 10, "missing"]]
    spoilt = log.drop_vars("gap_start")
    assert "gap_samples" not in as_log(spoilt)


def test_simulate_like_and_the_report_of_a_thinned_log(tmp_path):
    x = record()
    x[:, 1000:1200] = np.nan
    thinned = make(x).isel(time=slice(None, None, 2))
    like = gyrostab.simulate({"noise": {"N": 0.003}}, like=thinned).load()
    assert like.attrs["sampling_rate_hz"] == 50.0
    np.testing.assert_array_equal(np.isnan(like.rate), np.isnan(x[:, ::2]))
    # white noise of N deg/sqrt(h): standard deviation N * 60 * sqrt(rate)
    assert float(like.rate.std()) == pytest.approx(0.003 * 60 * np.sqrt(50.0), rel=0.05)
    assert "50 Hz" in gyrostab.plot_signal(thinned).get_suptitle()
    assert gyrostab.regularise(thinned).attrs["sampling_rate_hz"] == 50.0
    opened = gyrostab.open_log(gyrostab.to_zarr(thinned, tmp_path / "log.zarr"))
    check_against(opened, x[:, ::2], rate=50.0, window=400)


def test_a_dask_log_is_not_loaded_whole():
    held = []

    def block(block_info=None):
        held.append(block_info[None]["array-location"][1])
        return np.zeros((1, 1000))

    import dask.array as da

    data = da.map_blocks(block, chunks=((1,), (1000,) * 500), dtype=float, meta=np.zeros((0, 0)))
    log = stamped(make_log(data, rate=100.0, unit="deg/h", start=START)).isel(
        time=np.r_[0:1000, 1300:500_000]
    )
    back = as_log(log)
    assert not held
    assert back.sizes["time"] == 500_000
    gyrostab.davar(back.isel(time=slice(0, 3000)), window="10s").avar.compute()
    assert len(set(held)) < 100


class TestDataArray:
    def test_one_or_more_axes_in_any_order(self):
        x = record()
        log = make(x)
        check_against(log.rate, x, rate=RATE)
        check_against(log.rate.T, x, rate=RATE)
        check_against(log.rate.sel(axis="y"), x[1], rate=RATE)
        check_against(log.rate.sel(axis="y", drop=True), x[1], rate=RATE)
        check_against(log.rate[:, ::4], x[:, ::4], rate=RATE / 4, window=400)
        check_against(stamped(log).rate.dropna("time"), x, rate=RATE)
        assert gyrostab.from_dataarray(log.rate.chunk(time=999)).rate.chunks is not None

    def test_units(self):
        x = record()
        radians = make(x).rate.copy(data=x * np.pi / 180 / 3600).assign_attrs(units="rad/s")
        check_against(radians, x, rate=RATE)
        check_against(gyrostab.from_dataarray(make(x).rate / 3600, units="deg/s"), x, rate=RATE)
        with pytest.raises(
            MissingUnitError, match=r"gyrostab\.from_dataarray\(da, units='deg/s'\)"
        ):
            gyrostab.davar(make(x).rate.drop_attrs(), window="8s")
        with pytest.raises(UnitError, match="unit of temperature"):
            gyrostab.davar(make(x).temperature, window="8s")
        with pytest.raises(UnitError, match="not known"):
            gyrostab.from_dataarray(make(x).rate, units="furlong")

    @pytest.mark.parametrize("option", [{"rate": "100"}, {"rate": -1.0}, {"max_gap": "soon"}])
    def test_options_are_checked_though_the_time_is_uniform(self, option):
        with pytest.raises(OptionError, match=next(iter(option))):
            gyrostab.from_dataarray(make().rate, **option)

    def test_angles(self):
        theta = np.cumsum(record()[0]) / 3600 / RATE
        log = make_log(theta, rate=RATE, unit="deg", kind="angle", start=START)
        xr.testing.assert_identical(
            gyrostab.from_dataarray(log.angle).angle.drop_attrs(), log.angle.drop_attrs()
        )
        with pytest.raises(OptionError, match="kind='angle' if they are cumulative"):
            gyrostab.from_dataarray(log.angle.rename("theta"))
        steps = gyrostab.from_dataarray(log.angle.diff("time").rename("theta"), kind="rate")
        np.testing.assert_allclose(steps.rate.values[0], np.diff(theta) * RATE * 3600, rtol=1e-9)

    def test_stamps_with_jitter_are_for_regularise(self):
        x = record()
        rng = np.random.default_rng(4)
        late = make(x).time.values + rng.integers(0, 3_000_000, SIZE).astype("m8[ns]")
        array = make(x).rate.assign_coords(time=late)
        with pytest.raises(TimeError, match=r"not uniform.*gyrostab\.from_dataarray"):
            gyrostab.davar(array, window="8s")
        log = gyrostab.from_dataarray(array)
        assert log.attrs["sampling_rate_hz"] == pytest.approx(RATE, rel=1e-4)
        with pytest.raises(TimeError, match="runs backwards"):
            gyrostab.from_dataarray(array.isel(time=rng.permutation(SIZE)))

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            (lambda a: a.rename(time="t"), "rename them"),
            (lambda a: a.drop_vars("time"), "no datetime64 coordinate 'time'"),
            (lambda a: a.expand_dims("run"), "rename them"),
            (
                lambda a: xr.concat([a, a], "axis").drop_vars("axis"),
                r"4 axes without names; .*assign_coords",
            ),
        ],
    )
    def test_other_inputs_are_refused(self, change, message):
        with pytest.raises(SchemaError, match=message):
            gyrostab.davar(change(make().rate), window="8s")


class TestDataFrame:
    def frame(self, x: np.ndarray, names=("gyro_x", "gyro_y")) -> pd.DataFrame:
        return pd.DataFrame(
            dict(zip(names, x, strict=True)), pd.date_range(START, periods=x.shape[1], freq="10ms")
        )

    @pytest.mark.filterwarnings("ignore::UserWarning")
    def test_columns_and_units(self):
        x = record()
        check_against(gyrostab.from_dataframe(self.frame(x), units="deg/h"), x, rate=RATE)
        check_against(
            gyrostab.from_dataframe(self.frame(x, ("x", "y")), units="deg/h"), x, rate=RATE
        )
        check_against(self.frame(x, ("gyro_x [deg/h]", "gyro_y [deg/h]")), x, rate=RATE)
        check_against(
            gyrostab.from_dataframe(
                self.frame(x, ("wx", "wy")), units="deg/h", map={"wx": "gyro_x", "wy": "gyro_y"}
            ),
            x,
            rate=RATE,
        )
        series = self.frame(x)["gyro_x"] / 3600
        series.attrs["units"] = "deg/s"
        check_against(series, x[0], rate=RATE)
        hot = self.frame(x).assign(temperature=300.0)
        log = gyrostab.from_dataframe(hot, units={"gyro": "deg/h", "temperature": "K"})
        np.testing.assert_allclose(log.temperature, 26.85)

    @pytest.mark.filterwarnings("ignore::UserWarning")
    @pytest.mark.parametrize("units", ["deg", {"gyro": "deg"}, {"angle": "deg"}])
    def test_units_of_angles(self, units):
        x = record()
        angles = self.frame(x, ("angle_x", "angle_y"))
        log = gyrostab.from_dataframe(angles, units=units, kind="angle")
        np.testing.assert_array_equal(log.angle, x)

    @pytest.mark.parametrize("names", [("x", "y", "z"), ("X", "y", "z [deg/h]")])
    def test_a_map_overrules_the_names_x_y_z(self, names):
        x = record()[:, :50]
        frame = self.frame(np.vstack([x, x[0] + 1]), names)
        mapped = {"x": "gyro_z", "y": "-", "Z": "gyro_x"}
        log = gyrostab.from_dataframe(frame, units="deg/h", map=mapped)
        assert log.axis.values.tolist() == ["x", "z"]
        np.testing.assert_array_equal(log.rate, [x[0] + 1, x[0]])

    @pytest.mark.filterwarnings("ignore::UserWarning")
    def test_dropped_rows_and_time_zones(self):
        x = record(lost=0.1)
        x[:, [0, -1]] = 0.0
        frame = self.frame(x).tz_localize("Europe/Berlin").dropna()
        log = gyrostab.from_dataframe(frame, units="deg/h")
        check_against(log, x, rate=RATE)
        assert log.time[0].values == np.datetime64("2026-03-01T09:00:00")

    def test_invalid_input_is_refused(self):
        x = record()
        with pytest.raises(
            MissingUnitError,
            match=r"'gyro_x' carries no unit; give it: gyrostab\.from_dataframe\(df, units='deg/s'",
        ):
            gyrostab.davar(self.frame(x), window="8s")
        for function in (
            gyrostab.regularise, gyrostab.fit_noise, gyrostab.plot_davar, gyrostab.gap_table,
        ):  # fmt: skip
            with pytest.raises(SchemaError, match=r"this is a DataFrame.*gyrostab\.from_dataframe"):
                function(self.frame(x))
        with pytest.raises(SchemaError, match=r"transpose it: df\.T"):
            gyrostab.davar(self.frame(x).T, window="8s")
        with pytest.raises(SchemaError, match="not times"):
            gyrostab.davar(self.frame(x).reset_index(drop=True), window="8s")
        with pytest.raises(SchemaError, match=r"set one: df\.set_index\('when'\)"):
            gyrostab.davar(self.frame(x).reset_index(names="when"), window="8s")
        angles = self.frame(x, ("angle_x", "angle_y"))
        with pytest.raises(MissingUnitError, match=r"'angle_x' carries .*\(df, units='deg'\)"):
            gyrostab.from_dataframe(angles)
        angles.attrs["units"] = "deg"
        with pytest.raises(OptionError, match=r"kind='angle' .*; gyrostab\.from_dataframe\(df, "):
            gyrostab.davar(angles, window="8s")
        with pytest.raises(TimeError, match=r"sort it: df\.sort_index"):
            gyrostab.from_dataframe(self.frame(x)[::-1], units="deg/h")
        with pytest.raises(GyrostabError, match="no gyro column"):
            gyrostab.from_dataframe(self.frame(x, ("left", "right")), units="deg/h")
        with pytest.raises(SchemaError):
            gyrostab.davar([1.0, 2.0], window="8s")


class TestSurface:
    def surface(self) -> xr.Dataset:
        return gyrostab.davar(make(), window="8s", taus=12).load()

    def test_parts_of_a_surface_are_fitted(self):
        surface = self.surface()
        whole = gyrostab.fit_noise(surface)
        xr.testing.assert_allclose(
            gyrostab.fit_noise(surface.isel(time=slice(None, None, 2))).N, whole.N[:, ::2]
        )
        xr.testing.assert_allclose(gyrostab.fit_noise(surface.sel(axis=["y"])).N, whole.N[1:])

    @pytest.mark.parametrize(
        "change",
        [
            lambda s: s.avar,
            lambda s: s.avar.isel(axis=0).to_pandas(),
            lambda s: s.isel(tau=slice(None, None, -1)),
            lambda s: s.assign_coords(tau=s.tau * 1.5),
            lambda s: s.assign_attrs(sampling_rate_hz=33.0),
            lambda s: s.assign(avar=s.avar.drop_attrs()),
            lambda s: s.drop_attrs(deep=False),
        ],
    )
    def test_other_inputs_are_refused(self, change):
        with pytest.raises(GyrostabError):
            gyrostab.fit_noise(change(self.surface()))

    @pytest.mark.parametrize(
        "function",
        [
            "fit_noise",
            "plot_davar",
            "plot_davar_3d",
            "plot_coefficients",
            "to_kalibr",
            "survey_terms",
            "correlate",
            "confidence_interval",
        ],
    )
    def test_array_is_not_a_surface(self, function, tmp_path):
        extra = (tmp_path / "imu.yaml",) if function == "to_kalibr" else ()
        with pytest.raises(SchemaError, match="this is a DataArray"):
            getattr(gyrostab, function)(self.surface().avar, *extra)

    @pytest.mark.parametrize("form", ["nc", "zarr"])
    @pytest.mark.parametrize("turned", [False, True])
    @pytest.mark.filterwarnings("ignore:Consolidated metadata")
    def test_files_written_by_xarray_are_opened(self, tmp_path, form, turned):
        product = gyrostab.fit_noise(self.surface())
        path = tmp_path / f"product.{form}"
        given = product.transpose("tau", "time", ...) if turned else product
        given.to_netcdf(path) if form == "nc" else given.to_zarr(path)
        with gyrostab.open_product(path) as back:
            assert back.avar.dims == ("axis", "time", "tau")
            for name in ("avar", "N", "B_upper", "observable", "edf"):
                np.testing.assert_array_equal(
                    back[name].values, product[name].transpose(*back[name].dims).values
                )
            np.testing.assert_array_equal(back.time.values, product.time.values)
            np.testing.assert_array_equal(back.time_bounds.values, product.time_bounds.values)
            xr.testing.assert_allclose(
                gyrostab.fit_noise(gyrostab.open_surface(path)).compute().N, product.N
            )

    @pytest.mark.parametrize("form", ["nc", "zarr"])
    @pytest.mark.parametrize("reader", [gyrostab.open_log, gyrostab.read_log])
    @pytest.mark.filterwarnings("ignore:Consolidated metadata")
    def test_log_written_by_xarray_is_opened(self, tmp_path, form, reader):
        x = record(lost=0.2)
        path = tmp_path / f"log.{form}"
        thinned = make(x).isel(time=slice(None, None, 2)).dropna("time", subset=["rate"])
        thinned.to_netcdf(path) if form == "nc" else thinned.to_zarr(path)
        present = np.flatnonzero(~np.isnan(x[0, ::2]))
        check_against(
            reader(path), x[:, ::2][:, present[0] : present[-1] + 1], rate=50.0, window=400
        )


@pytest.mark.filterwarnings("ignore:.*unreadable")
def test_a_row_of_a_table_without_a_stamp_is_placed_by_its_neighbours() -> None:
    index = pd.date_range("2026-03-14", periods=200, freq="20ms")
    table = pd.DataFrame({"gyro_x [deg/h]": np.arange(200.0)}, index.where(np.arange(200) != 5))
    log = gyrostab.from_dataframe(table)
    assert log.rate.values[0].tolist() == list(range(200))
    with pytest.raises(TimeError, match=r"backwards after row 7 \(2026-03-14 00:00:00.140000\)"):
        gyrostab.from_dataframe(table.iloc[[*range(8), *range(6, 200)]])


def make_table(**columns) -> pd.DataFrame:
    values = {name: np.arange(200.0) if value is None else value for name, value in columns.items()}
    return pd.DataFrame(values, index=pd.date_range("2026-03-01", periods=200, freq="10ms"))


@pytest.mark.parametrize(("table", "options", "expected"), [
    (make_table(a=None), {"units": "deg/h"}, r"map=\{'a': 'gyro_x'\}, units=\{'gyro': 'deg/s'\}$"),
    (make_table(gyro_x=None), {"units": "furlong"},
     r"with a factor units=\{'gyro': '0.1 arcsec/s'\}"),
    (make_table(gyro_x=None), {"units": "deg"}, "give kind='angle' if it is the cumulative angle"),
    (make_table(gyro_x=np.nan), {"units": "deg/h"}, "unreadable.*check the columns and the index"),
    (make_table(gyro_x=np.arange(200) * 1j), {"units": "deg/h"}, "unreadable.*check the columns"),
    (make_table(temperature=None), {"units": "deg/h"}, r"one: map=\{'NAME': 'gyro_x'\}$"),
    (make_table(gyro_x=None, angle_x=None), {"units": {"gyro": "deg/h", "angle": "deg"}},
     r"drop the others, for instance map=\{'angle_x': '-'\}"),
    (make_table(gyro_x=None)[:0], {"units": "deg/h"}, "the DataFrame has 0 rows"),
    (make_table(gyro_x=None)[:1], {"units": "deg/h"}, "give it with rate=HZ"),
    (make_table(gyro_x=None).set_index(pd.DatetimeIndex(["2026-03-01"] * 200)),
     {"units": "deg/h"}, "all stamps are the same.*make_log"),
    (make_table(gyro_x=None), {"units": "deg/h", "rate": 70.0}, "leave rate out to use the times"),
])  # fmt: skip
def test_errors_on_tables_advise_keywords_and_nothing_of_files(table, options, expected):
    with pytest.raises(GyrostabError, match=expected) as raised:
        gyrostab.from_dataframe(table, **options)
    assert not re.search("--|copy it|separator|gyrostab scan", str(raised.value))


def test_notes_on_tables_advise_keywords():
    with pytest.warns(UserWarning, match=r"units=\{'temperature': 'degC'\}"):
        log = gyrostab.from_dataframe(make_table(gyro_x=None, temperature=None), units="deg/h")
    assert not any("--" in note for note in log.attrs["notes"])


def test_a_code_for_missing_values_in_a_table_is_missing_in_its_log():
    codes = np.arange(200) % 9 == 4
    gyro, temperature = np.arange(200.0), np.linspace(60.0, 62.0, 200)
    table = make_table(
        gyro_x=np.where(codes, -999.25, gyro), temperature=np.where(codes, -9999, temperature)
    )
    units = {"gyro": "deg/s", "temperature": "degF"}
    with pytest.warns(UserWarning, match=r"missing with missing_value=-999\.25"):
        assert gyrostab.from_dataframe(table, units=units).rate.values.min() == -999.25 * 3600
    with pytest.warns(UserWarning, match="cells that are -999.25 or -9999 are missing: 22 of"):
        log = gyrostab.from_dataframe(table, units=units, missing_value=[-999.25, -9999])
    np.testing.assert_allclose(log.rate.values[0], np.where(codes, np.nan, gyro * 3600))
    expected = np.where(codes, np.nan, (temperature - 32) / 1.8)
    np.testing.assert_allclose(log.temperature.values, expected)
    with pytest.raises(OptionError, match="missing_value nan: give a number"):
        gyrostab.from_dataframe(table, units=units, missing_value=np.nan)


@pytest.mark.parametrize("calendar", ["standard", "noleap", "periods"])
def test_advice_for_other_dates_gives_a_log(calendar):
    """The calls that the messages advise are run as they are written."""
    values = np.arange(200.0)[None]
    time: Any = (
        pd.period_range("2026-03-01", periods=200, freq="s")
        if calendar == "periods"
        else xr.date_range("2026-03-01", periods=200, freq="s", calendar=calendar, use_cftime=True)
    )
    expected = pd.date_range("2026-03-01", periods=200, freq="s")
    da = xr.DataArray(values, {"axis": ["x"], "time": time}, attrs={"units": "deg/h"})
    log = make_log(values, rate=1.0, unit="deg/h").assign_coords(time=time)
    for name, data in (("da", da), ("log", log)):
        with pytest.raises(SchemaError) as raised:
            gyrostab.davar(data, window="20s")
        advice = re.search(rf"(?<= ){name}\..*", str(raised.value))
        assert advice is not None, raised.value
        converted = eval(advice[0], {name: data})
        np.testing.assert_array_equal(as_log(converted).time.values, expected)
    df = pd.DataFrame({"gyro_x [deg/h]": values[0]}, index=da.indexes["time"])
    with pytest.raises(SchemaError, match=r"convert it: df\.") as raised:
        gyrostab.from_dataframe(df)
    converted = eval(str(raised.value).split("convert it: ")[1], {"df": df})
    np.testing.assert_array_equal(gyrostab.from_dataframe(converted).time.values, expected)


def test_advice_for_an_index_of_several_levels_gives_a_log():
    log = make(record(size=300))
    time = pd.DatetimeIndex(log.time.values)
    table = pd.DataFrame(log.rate.values.T, time, ["gyro_x", "gyro_y"])
    runs = table.set_index(pd.MultiIndex.from_arrays([["a"] * 300, time], names=["run", None]))
    stacked = log.rate.to_series()
    for data, expression in (
        (runs, r"df.xs\('a', level='run'\)"),
        (stacked, r"series.unstack\('axis'\)"),
        (table.T.set_index([["gyro"] * 2, ["x", "y"]]).T, r"df.columns.map\('_'.join\)"),
    ):
        with pytest.raises(
            SchemaError, match=rf"^the (index|columns) of .* 2 levels; .*{expression}"
        ):
            gyrostab.from_dataframe(data, units="deg/h")
        call = re.search(expression, str(_error_of(gyrostab.from_dataframe, data)))[0]
        changed = eval(call, {"df": data, "series": data})
        if isinstance(changed, pd.Index):
            changed = data.set_axis(changed, axis=1)
        made = gyrostab.from_dataframe(changed, units="deg/h")
        np.testing.assert_array_equal(made.rate, log.rate)


def _error_of(call, *arguments) -> Exception:
    with pytest.raises(GyrostabError) as refused:
        call(*arguments)
    return refused.value


@pytest.mark.parametrize("as_array", [False, True])
def test_advice_for_a_multi_index_gives_a_log(as_array):
    log = make(record(size=300))
    stamps = log.time.values
    bare = log.drop_vars("time").assign_coords(stamp=("time", stamps), run=("time", ["a"] * 300))
    named = stamped(log).assign_coords(sensor=("axis", ["g", "g"]))
    for data, expected in (
        (stamped(log).stack(sample=("axis", "time")), "sample"),
        (bare.set_index(time=["run", "stamp"]), "time"),
        (named.rename_vars(axis="label").set_index(axis=["sensor", "label"]), "axis"),
    ):
        convert = gyrostab.from_dataarray if as_array else as_log
        given = data.rate if as_array else data
        message = str(_error_of(convert, given))
        assert f"dimension {expected!r} of the" in message
        call = message.partition("undo it with ")[2].replace("[...]", "['x', 'y']")
        made = convert(eval(f"given{call}", {"given": given}))
        np.testing.assert_array_equal(made.rate, log.rate)
        np.testing.assert_array_equal(made.time, stamps)


def test_columns_of_a_table_are_mapped_by_any_label():
    log = make(record(size=300))
    table = pd.DataFrame(log.rate.values.T, log.time.values)
    made = gyrostab.from_dataframe(table, units="deg/h", map={0: "gyro_x", 1: "gyro_y"})
    np.testing.assert_array_equal(made.rate, log.rate)
    for wrong in ({"map": {0: 1}}, {"units": {"gyro": None}}):
        with pytest.raises(OptionError, match=r"0: 1 is not a text|gyro: None is not a text"):
            gyrostab.from_dataframe(table, **{"units": "deg/h", **wrong})

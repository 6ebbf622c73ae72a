"""What the checks of a surface and a product refuse, and what their messages advise."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

import gyrostab
from gyrostab.errors import FormatError, OptionError, SchemaError
from gyrostab.schema import check_product
from tests.support import synthetic


@pytest.fixture(scope="module")
def product() -> xr.Dataset:
    return synthetic.product(windows=12)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda p: p.sel(axis="x"), r"keep the dimension 'axis'.*\.isel\(axis=\[0\]\)"),
        (
            lambda p: p.transpose("axis", "tau", "time", ...),
            r"\.transpose\('axis', 'time', 'tau', \.\.\.\).*engine='gyrostab'",
        ),
        (lambda p: p.rename(axis="sensor"), "rename 'sensor' to 'axis'"),
        (
            lambda p: p.rename(time="window").expand_dims(case=["before", "after"]),
            r"select one label of 'case': \.isel\(case=0\)$",
        ),
        (lambda p: p.drop_vars("Q_upper"), "no variable 'Q_upper'"),
        (lambda p: p.sel(term=["N", "B"]), "'term' of the product holds N, B, expected Q, N"),
        (lambda p: p.assign_coords(axis=[1, 2, 3]), r"'axis' of the .* holds 1, 2, 3, not names"),
        (lambda p: p.assign_coords(time=np.arange(12)), "'time' of the .* not dates and times"),
        (
            lambda p: p.assign_coords(time=p.time.where(p.time != p.time[3])),
            "'time' of the .* not dates and times",
        ),
        (
            lambda p: p.assign(fit_tau_min=p.N.drop_attrs()),
            "concatenated along 'time'.*data_vars='minimal'",
        ),
        (
            lambda p: p.assign(fit_tau_min=("axis", [1.0, 1.0, 1.0])).where(p.time > p.time[5]),
            r"instead of \.where\(\.\.\.\).* along 'time', select with \.isel\(time=",
        ),
        (
            lambda p: p.drop_dims("term"),
            r"holds no coefficients yet; call gyrostab\.fit_noise .* first",
        ),
        (
            lambda p: xr.concat([p, p], "axis", data_vars="minimal"),
            r"'x', 'y', 'z', 'x', 'y', 'z' have names in common; .*\.assign_coords\(axis=",
        ),
        (lambda p: p.drop_vars("edf"), "not a product, which gyrostab.fit_noise makes.* 'edf'"),
        (
            lambda p: p.assign_attrs(sampling_rate_hz="20 Hz"),
            "sampling_rate_hz .* is '20 Hz', not a number",
        ),
        (
            lambda p: p.assign_coords(tau=np.where(p.tau == p.tau[1], np.nan, p.tau)),
            "averaging times of the surface are not rising whole numbers of samples",
        ),
    ],
)
def test_what_is_not_a_product_is_refused_with_advice(
    product: xr.Dataset, change: Callable[[xr.Dataset], xr.Dataset], words: str
) -> None:
    with pytest.raises(SchemaError, match=words):
        check_product(change(product))


def test_the_advice_to_transpose_makes_a_product_of_a_file_that_plain_xarray_opened(
    product: xr.Dataset,
) -> None:
    stored = product.transpose("axis", "term", "tau", "time", ...)
    check_product(stored.transpose("axis", "time", "tau", ...))


@pytest.mark.parametrize(
    "draw",
    [gyrostab.plot_coefficients, lambda product: gyrostab.plot_adev(product, "x")],
    ids=["coefficients", "adev"],
)
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda p: p.rename(N="n"), "no variable 'N'"),
        (lambda p: p.drop_vars("K_upper"), "no variable 'K_upper'"),
        (lambda p: p.isel(time=slice(0, 0)), "no window"),
    ],
)
def test_figures_refuse_products_without_what_they_draw(
    product: xr.Dataset,
    draw: Callable[[xr.Dataset], object],
    change: Callable[[xr.Dataset], xr.Dataset],
    words: str,
) -> None:
    with pytest.raises(SchemaError, match=words):
        draw(change(product))


@pytest.mark.parametrize(
    "draw", [gyrostab.plot_coefficients, gyrostab.plot_davar, gyrostab.plot_adev]
)
def test_figures_of_a_selected_axis(product: xr.Dataset, draw: Callable[..., Any]) -> None:
    single, whole = draw(product.sel(axis="y")), draw(product, axis="y")
    for own, expected in zip(single.axes, whole.axes, strict=True):
        assert own.get_ylabel() == expected.get_ylabel()
        assert own.dataLim.bounds == expected.dataLim.bounds


def test_the_interval_of_a_selected_axis(product: xr.Dataset) -> None:
    interval = gyrostab.confidence_interval(product.sel(axis="y"))
    xr.testing.assert_equal(interval, gyrostab.confidence_interval(product).sel(axis=["y"]))


def test_a_selected_axis_is_fitted_correlated_and_stored(
    product: xr.Dataset, tmp_path: Path
) -> None:
    single, listed = product.sel(axis="y"), product.sel(axis=["y"])
    for function in (gyrostab.fit_noise, gyrostab.correlate):
        xr.testing.assert_identical(function(single), function(listed))
    paths = (
        gyrostab.to_netcdf(single, tmp_path / "single.nc"),
        gyrostab.to_zarr(single, tmp_path / "single.zarr"),
    )
    for path in paths:
        xr.testing.assert_equal(gyrostab.open_product(path).load(), listed)


def test_a_correlation_of_a_selected_axis_is_tabulated_and_drawn(product: xr.Dataset) -> None:
    correlation = gyrostab.correlate(product, variables="window_mean", max_lag=0)
    single, listed = correlation.sel(axis="y"), correlation.sel(axis=["y"])
    rows = gyrostab.correlation_rows(single)
    assert rows == gyrostab.correlation_rows(listed) == gyrostab.correlation_rows(correlation)[2:4]
    drawn, expected = (gyrostab.plot_correlation(part).axes for part in (single, listed))
    assert [panel.dataLim.bounds for panel in drawn] == [panel.dataLim.bounds for panel in expected]
    for function in (gyrostab.correlation_rows, gyrostab.plot_correlation):
        with pytest.raises(SchemaError, match=r"no dimension 'driver'; .*\.isel\(driver=\[0\]\)"):
            function(correlation.sel(driver="temperature"))


def test_a_product_with_some_of_its_terms_is_fitted_again() -> None:
    expected = gyrostab.fit_noise(gyrostab.davar(synthetic.log(), window="5s"))
    for part in (expected.sel(term=["N", "B"]), expected.sel(term="N")):
        xr.testing.assert_equal(gyrostab.fit_noise(part), expected)


def test_a_single_window_is_stored_and_refused_as_a_product(
    product: xr.Dataset, tmp_path: Path
) -> None:
    path = gyrostab.to_netcdf(product.isel(time=3), tmp_path / "window.nc")
    with xr.open_dataset(path) as opened:
        assert opened.time.values == product.time.values[3]
        assert opened.attrs["time_coverage_start"] == opened.attrs["time_coverage_end"]
    with pytest.raises(FormatError, match=r"keep the dimension 'time'"):
        gyrostab.open_product(path)


def test_a_stored_product_with_a_fault_is_refused_with_its_reason(
    product: xr.Dataset, tmp_path: Path
) -> None:
    joined = product.assign(fit_tau_min=product.N.drop_attrs())
    path = gyrostab.to_netcdf(joined, tmp_path / "joined.nc")
    with pytest.raises(FormatError, match=r"concatenated along 'time'.*data_vars='minimal'"):
        gyrostab.open_product(path)


def test_an_allan_deviation_of_several_axes_needs_one(product: xr.Dataset) -> None:
    with pytest.raises(OptionError, match="axis='x'; there are x, y, z"):
        gyrostab.plot_adev(product)


@pytest.mark.parametrize(
    ("function", "opener"),
    [
        (gyrostab.davar, "gyrostab.open_log, or a file of another program with"),
        (gyrostab.regularise, "gyrostab.read_log"),
        (gyrostab.fit_noise, "gyrostab.open_surface"),
        (gyrostab.correlate, "gyrostab.open_product"),
        (gyrostab.plot_coefficients, "gyrostab.open_product"),
    ],
)
def test_the_name_of_a_file_is_no_dataset(function: Callable[[Any], Any], opener: str) -> None:
    for name in ("run.nc", Path("run.nc")):
        with pytest.raises(SchemaError, match=f"'run.nc' is the name of a file.*{opener}"):
            function(name)


def test_other_datasets_are_no_log(product: xr.Dataset) -> None:
    for function in (gyrostab.davar, gyrostab.plot_signal, gyrostab.gap_table):
        with pytest.raises(SchemaError, match="this is a product, not a log; give the log from"):
            function(product)
    log = synthetic.log()
    del log.rate.attrs["units"]
    with pytest.raises(SchemaError, match=r"dataset\['rate'\]\.attrs\['units'\] = 'degree hour-1'"):
        gyrostab.davar(log)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda p: p.isel(time=slice(None, None, -1)), r"not in the order of time.*sortby\('time'"),
        (lambda p: p.isel(time=[0, 0, 1, 2]), "occur twice"),
        (lambda p: p.isel(time=slice(0, 0)), "there is no window"),
        (lambda p: p.drop_vars("time_bounds"), "no 'time_bounds'"),
    ],
)
def test_correlation_needs_windows_in_the_order_of_time(
    product: xr.Dataset, change: Callable[[xr.Dataset], xr.Dataset], words: str
) -> None:
    with pytest.raises(SchemaError, match=words):
        gyrostab.correlate(change(product))

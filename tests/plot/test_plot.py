"""Figures show the data with labels and units."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.collections import PathCollection, QuadMesh
from matplotlib.dates import date2num
from scipy.stats import chi2

from gyrostab import correlate, correlation_rows, davar, fit_noise, make_log, plot_correlation
from gyrostab.allan.confidence import interval_limits
from gyrostab.allan.fit import refit
from gyrostab.errors import OptionError, SchemaError
from gyrostab.noise import LAWS, model_avar
from gyrostab.plot import plot_adev, plot_coefficients, plot_davar, plot_davar_3d, plot_signal
from gyrostab.plot.correlation import _shift_driver
from gyrostab.plot.signal import thin
from gyrostab.plot.style import COLOURS, axis_style, save_png
from gyrostab.report.product import write_report
from tests.support import coupled, synthetic
from tests.support.repetitions import first_of


@pytest.fixture(scope="module")
def product() -> xr.Dataset:
    return synthetic.product()


def shaded(ax):
    return [item for item in ax.collections if item.get_gid() == "shaded"]


def test_signal_has_a_panel_with_unit_for_each_axis_and_channel():
    figure = plot_signal(synthetic.log())
    assert [ax.get_ylabel().replace("\n", " ") for ax in figure.axes] == [
        "x [deg/h]",
        "y [deg/h]",
        "z [deg/h]",
        "vibration [g]",
        "temperature [°C]",
        "pump [gal/min]",
    ]
    assert figure.axes[-1].get_xlabel() == "time (UTC)"
    assert "300 Hz" in figure.get_suptitle()


def test_notebooks_show_a_figure_as_the_value_of_a_cell(product):
    picture = plot_adev(product, "x")._repr_png_()
    assert picture.startswith(b"\x89PNG")


def test_signal_of_chosen_axis_and_channels():
    figure = plot_signal(synthetic.log(), axis="z", channels=["temperature"])
    assert [ax.get_ylabel() for ax in figure.axes] == ["z [deg/h]", "temperature\n[°C]"]
    with pytest.raises(OptionError, match="channel mud is not in the log; it has vibration"):
        plot_signal(synthetic.log(), channels="mud")
    with pytest.raises(OptionError, match="channel 3 is not in the log"):
        plot_signal(synthetic.log(), channels=3)
    for columns in (0, 1.5, "9"):
        with pytest.raises(OptionError, match=f"columns={columns!r}: give a whole number above 0"):
            plot_signal(synthetic.log(), columns=columns)
        for draw in (plot_davar, plot_davar_3d):
            with pytest.raises(OptionError, match=f"columns={columns!r}: give a whole number"):
                draw(synthetic.product(), columns=columns)
    with pytest.raises(OptionError, match="axis 'q' is not in the data; it has x, y, z"):
        plot_signal(synthetic.log(), axis="q")


def test_one_spike_in_a_long_record_is_drawn():
    log = synthetic.log(samples=90_000)
    log["rate"][1, 12_345], log["rate"][1, 12_346] = 1e6, -2e6
    (line,) = plot_signal(log, channels=[], columns=500).axes[1].lines
    drawn = line.get_ydata()
    assert drawn.size <= 1000
    assert (np.nanmax(drawn), np.nanmin(drawn)) == (1e6, -2e6)
    assert np.isnan(drawn).any()  # the line is broken at the gap


@given(
    values=st.lists(st.one_of(st.floats(-1e9, 1e9), st.just(np.nan)), min_size=1, max_size=300),
    columns=st.integers(1, 50),
)
def test_thinning_keeps_the_extremes_of_every_column(values, columns):
    record = xr.DataArray(np.array(values), dims="time", coords={"time": np.arange(len(values))})
    first, low, high = thin(record, columns=columns)
    edges = [*first.tolist(), len(values)]
    assert first.size <= max(2 * columns, 1)
    for start, stop, lowest, highest in zip(edges[:-1], edges[1:], low, high, strict=True):
        part = [value for value in values[start:stop] if not np.isnan(value)]
        assert (
            (lowest, highest) == (min(part), max(part))
            if part
            else np.isnan([lowest, highest]).all()
        )


@pytest.mark.parametrize("table", [True, False])
def test_gaps_of_the_signal_are_shaded(table):
    log = synthetic.log()
    expected = date2num(log.time.values[[1500, 1799]])
    if not table:
        log = log.drop_vars(["gap_start", "gap_end", "gap_samples", "gap_cause"])
    for ax in plot_signal(log).axes:
        (bars,) = shaded(ax)
        extent = bars.get_paths()[0].get_extents()
        np.testing.assert_allclose([extent.x0, extent.x1], expected, atol=0.01 / 86400)


def test_signal_without_gaps_has_no_shade():
    log = synthetic.log().drop_dims("gap").fillna(7.0)
    assert not any(shaded(ax) for ax in plot_signal(log).axes)


def test_davar_has_a_panel_per_axis_and_a_colour_bar_with_unit(product):
    figure = plot_davar(product)
    assert [ax.get_ylabel() for ax in figure.axes] == [
        "axis x\naveraging time τ [s]",
        "axis y\naveraging time τ [s]",
        "axis z\naveraging time τ [s]",
        "Allan deviation σ(τ) [deg/h]",
    ]
    assert figure.axes[0].get_yscale() == "log"
    assert figure.get_suptitle() == "Dynamic Allan deviation, windows of 6 s every 30 s"
    assert len(plot_davar(product, axis="y").axes) == 2


def test_davar_draws_the_deviation_and_leaves_gaps_blank(product):
    ax = plot_davar(product, axis="y").axes[0]
    (mesh,) = [item for item in ax.collections if isinstance(item, QuadMesh)]
    drawn = mesh.get_array()
    expected = np.sqrt(product.avar.sel(axis="y").values.T)
    np.testing.assert_array_equal(np.ma.getmaskarray(drawn), np.isnan(expected))
    np.testing.assert_allclose(drawn.filled(np.nan), expected)
    assert ax.patch.get_hatch()


def test_davar_marks_weighted_cells_only(product):
    (dots,) = [
        item
        for item in plot_davar(product, axis="x").axes[0].collections
        if isinstance(item, PathCollection)
    ]
    marked = {(x, y) for x, y in np.round(dots.get_offsets().data, 4)}
    times, taus = date2num(product.time.values), product.tau.values
    cells = product.estimator.sel(axis="x").values
    weighted = {(round(times[i], 4), round(taus[j], 4)) for i, j in np.argwhere(cells == 2)}
    assert marked
    assert marked <= weighted
    strict = product.assign(estimator=product.estimator.where(product.estimator != 2, 1))
    assert not [
        item
        for item in plot_davar(strict, axis="x").axes[0].collections
        if isinstance(item, PathCollection)
    ]


def test_davar_of_very_many_windows_is_averaged_in_variance():
    product = synthetic.product(windows=130, axes="x")
    ax = plot_davar(product, columns=40).axes[0]
    drawn = ax.collections[0].get_array()
    assert drawn.shape == (product.sizes["tau"], 33)
    np.testing.assert_allclose(drawn[:, 0], np.sqrt(product.avar[0, :4].mean("time")))


def test_change_of_the_davar_is_relative_to_the_median(product):
    figure = plot_davar(product, axis="x", relative=True)
    drawn = figure.axes[0].collections[0].get_array()
    np.testing.assert_allclose(np.ma.median(drawn, axis=1), 1.0, rtol=0.05)
    low, high = figure.axes[0].collections[0].get_clim()
    assert low * high == pytest.approx(1.0)  # white is "no change"
    assert figure.axes[1].get_ylabel() == "σ(τ) / its median over time"


def test_davar_3d_is_logarithmic_with_units(product):
    ax = plot_davar_3d(product, axis="z").axes[0]
    assert ax.get_zlabel() == "Allan deviation σ [deg/h]"
    assert ax.get_ylabel() == "averaging time τ [s]"
    assert "[min]" in ax.get_xlabel()
    logs = np.log10(product.tau.values)
    assert min(ax.get_ylim()) <= logs.min() < logs.max() <= max(ax.get_ylim())
    sigma = np.log10(np.sqrt(product.avar.sel(axis="z").values))
    low, high = ax.get_zlim()
    assert low <= np.nanmin(sigma)
    assert high >= np.nanmax(sigma)
    assert ax.get_zscale() == "linear"
    assert ax.zaxis.get_major_formatter()(1.0) == "10"


def test_coefficients_have_five_panels_in_customary_units(product):
    figure = plot_coefficients(product)
    assert [ax.get_ylabel() for ax in figure.axes] == [
        "Q [µrad]",
        "N [deg/√h]",
        "B [deg/h]",
        "K [deg/h^1.5]",
        "R [deg/h²]",
    ]
    assert [ax.get_title(loc="left") for ax in figure.axes] == [
        *(law.name for law in list(LAWS.values())[:4]),
        "rate ramp: upper limits only",
    ]
    colours = {line.get_color() for line in figure.axes[1].lines if line.get_label() in "xyz"}
    assert len(colours) == 3
    assert len(plot_coefficients(product, axis="x").axes) == 5


@pytest.mark.parametrize("windows", [40, 200])
def test_values_limits_and_unobservable_spans_of_the_coefficients(windows):
    product = synthetic.product(windows=windows)
    figure = plot_coefficients(product, axis="y")
    part = product.sel(axis="y")
    for ax, symbol in zip(figure.axes, LAWS, strict=True):
        line = next(line for line in ax.lines if line.get_label() == "y")
        is_observed = part.observable.sel(term=symbol) == 2
        np.testing.assert_allclose(line.get_ydata(), part[symbol].where(is_observed).values)
        assert ax.get_ylim()[0] <= np.nanmin(
            part[symbol].where(is_observed, part[f"{symbol}_upper"])
        )
        (limits,) = [item for item in ax.collections if str(item.get_gid()).startswith("upper")]
        drawn = limits.get_offsets()[:, 1]
        known = part[f"{symbol}_upper"].values
        assert set(np.round(drawn, 9)) <= set(np.round(known[np.isfinite(known)], 9))
        assert bool(drawn.size) is bool(np.isfinite(known).any())
        assert len(shaded(ax)) == 1
    lone = [
        line
        for line in figure.axes[0].lines
        if line.get_linestyle() == "None" and line.get_marker() == "s"
    ]
    # Q is observed in every other window only: its points stand alone and are still drawn
    assert windows == 40 or lone


def test_axis_without_coefficients_leaves_the_panels_of_the_others_white(product):
    def legend(figure):
        return [text.get_text() for text in figure.legends[0].get_texts()]

    alone = plot_coefficients(product.sel(axis=["x", "z"]))
    dead = product.copy(deep=True)
    row = {"axis": list(dead.axis.values).index("y")}
    dead.observable[row] = 0
    for name in [name for name in dead.data_vars if name.partition("_")[0] in LAWS]:
        dead[name][row] = np.nan
    figure = plot_coefficients(dead)
    for ax, expected in zip(figure.axes, alone.axes, strict=True):
        assert [bar.get_alpha() for bar in shaded(ax)] == [
            bar.get_alpha() for bar in shaded(expected)
        ]
        assert [len(bar.get_paths()) for bar in shaded(ax)] == [
            len(bar.get_paths()) for bar in shaded(expected)
        ]
    assert legend(figure)[:3] == ["axis x", "axis y: not observable", "axis z"]
    # the figure of this axis alone is grey
    assert all(len(shaded(ax)) == 1 for ax in plot_coefficients(dead, axis="y").axes)


def test_standard_errors_are_drawn(product):
    panel = plot_coefficients(product, axis="x").axes[1]
    bars = next(item for item in panel.collections if item.__class__.__name__ == "LineCollection")
    segment = bars.get_segments()[0]
    expected = (
        product.N.sel(axis="x").values[0]
        + np.array([-1, 1]) * product.N_stderr.sel(axis="x").values[0]
    )
    np.testing.assert_allclose(sorted(segment[:, 1]), expected)


@pytest.mark.parametrize(("names", "places"), [("ax", [0, 1]), ("xa", [0, 1]), ("zx", [2, 0])])
def test_every_axis_has_another_colour(names, places):
    axes = xr.Dataset(coords={"axis": list(names)})
    colours = [axis_style(axes, name)["color"] for name in names]
    assert colours == [COLOURS[place] for place in places]


def test_coefficients_of_a_surface_are_refused():
    with pytest.raises(SchemaError, match=r"no coefficients yet; call gyrostab\.fit_noise"):
        plot_coefficients(synthetic.surface())


@given(edf=st.floats(1.0, 1e5), avar=st.floats(1e-6, 1e6))
def test_band_is_the_chi_square_band(edf, avar):
    low, high = interval_limits(avar, edf)
    assert float(low) == pytest.approx(avar * edf / chi2.ppf(0.975, edf), rel=1e-8)
    assert float(high) == pytest.approx(avar * edf / chi2.ppf(0.025, edf), rel=1e-8)


def test_band_covers_the_truth_in_95_percent(product):
    low, high = interval_limits(product.avar.values, product.edf.values)
    truth = np.stack(
        [
            [model_avar(product.tau.values, _truth(a, t, product.sizes["time"])) for t in range(40)]
            for a in range(3)
        ]
    )
    known = np.isfinite(low)
    share = ((low <= truth) & (truth <= high))[known].mean()
    assert share == pytest.approx(0.95, abs=4 * np.sqrt(0.05 * 0.95 / known.sum()))


def _truth(axis: int, window: int, windows: int) -> dict[str, float]:
    growth = 1.0 + 2.0 * window / (windows - 1)
    return {
        s: value * (1 + 0.5 * axis) * (growth if s == "N" else 1.0)
        for s, value in synthetic.COEFFICIENTS.items()
    }


def test_adev_draws_the_requested_window(product):
    when = product.time.values[7]
    figure = plot_adev(product, "y", when=when)
    ax = figure.axes[0]
    assert ax.get_xlabel() == "averaging time τ [s]"
    assert ax.get_ylabel() == "Allan deviation σ(τ) [deg/h]"
    assert (ax.get_xscale(), ax.get_yscale()) == ("log", "log")
    lines = {line.get_label(): line for line in ax.lines}
    window = product.sel(axis="y").isel(time=7)
    np.testing.assert_allclose(lines["axis y, measured"].get_ydata(), np.sqrt(window.avar.values))
    estimates = refit(product.sel(axis=["y"]).isel(time=[7])).squeeze()
    fitted = {s: float(estimates[s]) for s in LAWS}
    (curve,) = (
        line
        for label, line in lines.items()
        if label.startswith("sum of the fitted terms, χ²/dof = ")
    )
    np.testing.assert_allclose(curve.get_ydata(), np.sqrt(model_avar(window.tau.values, fitted)))
    words = [text.get_text() for text in ax.get_legend().get_texts()]
    assert any(word.startswith("N = ") and "deg/√h" in word for word in words)
    assert any(word.startswith("R < ") and "deg/h²" in word for word in words)
    assert f"centred on {str(when)[:23].replace('T', ' ')} UTC" in figure.get_suptitle()


def test_adev_takes_a_time_of_any_type(product):
    title = plot_adev(product, "y", when=product.time.values[7]).get_suptitle()
    stamp = product.time[7]
    zoned = pd.Timestamp(stamp.values, tz="UTC").tz_convert("America/Chicago")
    for when in (stamp, zoned, zoned.floor("us").to_pydatetime(), str(zoned)):
        assert plot_adev(product, "y", when=when).get_suptitle() == title


def test_adev_without_a_time_avoids_the_gap(product):
    ax = plot_adev(product, "x").axes[0]
    assert np.isfinite(ax.lines[0].get_ydata()).any()


@pytest.mark.parametrize(
    ("when", "words"),
    [
        ("2031-01-01", "outside the record"),
        ("noon", "not understood"),
        ("NaT", "not understood"),
        ([1, 2], "not understood"),
        (5, "time 5 is not understood"),  # seconds or nanoseconds
    ],
)
def test_adev_refuses_an_impossible_time(product, when, words):
    with pytest.raises(OptionError, match=words):
        plot_adev(product, "x", when=when)


def test_adev_takes_times_within_half_a_window_of_the_first(product):
    first = product["time"].values[0]
    half = np.timedelta64(int(500 * product.attrs["window_s"]), "ms")
    plot_adev(product, "x", when=first - half)
    with pytest.raises(OptionError, match="outside the record"):
        plot_adev(product, "x", when=first - half - np.timedelta64(1, "s"))


def save_all(product: xr.Dataset, folder: Path) -> None:
    figures = (
        plot_davar(product),
        plot_davar(product, relative=True),
        plot_coefficients(product),
        plot_adev(product, "x"),
    )
    for number, figure in enumerate(figures):
        save_png(figure, folder / f"{number}.png", dpi=40)


@pytest.mark.parametrize("windows", [1, 2])
def test_shortest_products_can_be_drawn(tmp_path, windows):
    short = synthetic.product(windows=40, axes="x").isel(time=slice(0, windows))
    save_all(short, tmp_path)
    if windows > 1:
        save_png(plot_davar_3d(short), tmp_path / "3d.png", dpi=40)
    else:
        with pytest.raises(OptionError, match="two windows"):
            plot_davar_3d(short)


def test_product_without_any_sample_can_be_drawn(tmp_path):
    product = synthetic.product(axes="x")
    save_all(product.isel(time=slice(20, 24)), tmp_path)


def test_figures_do_not_use_pyplot(product):
    import matplotlib.pyplot as plt

    plot_davar(product)
    plot_coefficients(product)
    assert plt.get_fignums() == []


def test_negative_variance_has_no_deviation(product):
    """The published recursion drifts below zero almost without noise; the cell is blank."""
    spoiled = product.copy(deep=True)
    cell = {"axis": "x", "time": product.time[3], "tau": product.tau[2]}
    assert np.isfinite(product.avar.sel(cell))
    spoiled["avar"].loc[cell] = -1e-18
    before, after = (
        next(
            np.ma.filled(item.get_array(), np.nan)
            for item in plot_davar(surface, axis="x").axes[0].collections
            if isinstance(item, QuadMesh)
        )
        for surface in (product, spoiled)
    )
    assert np.isnan(after).sum() == np.isnan(before).sum() + 1


@pytest.mark.parametrize("share", first_of(0.7, 1.0))
def test_product_of_a_constant_signal_is_drawn_without_warnings(share, tmp_path):
    values = np.random.default_rng(1).standard_normal(6000)
    values[: int(share * 6000)] = 7.5
    log = make_log(values, rate=10.0, unit="deg/h")
    product = fit_noise(davar(log, window="1min", step="30s")).load()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", DeprecationWarning)  # of one library to another
        save_all(product, tmp_path)
        save_png(plot_davar_3d(product), tmp_path / "3d.png", dpi=40)
        write_report(product, tmp_path / "report.html")


@pytest.mark.parametrize("width", [0.0, -85.0, 1e9, float("nan"), "85"])
def test_impossible_widths_are_refused(product, width):
    with pytest.raises(OptionError, match=r"cannot be .* mm wide; give --width"):
        plot_coefficients(product, width=width)


def test_points_are_drawn_where_the_fit_knows_the_channel():
    time = np.datetime64("2026-01-01", "ns") + np.arange(40) * np.timedelta64(60, "s")
    values = np.where((np.arange(40) >= 10) & (np.arange(40) < 20), np.nan, np.arange(40.0))
    values[30] = np.nan
    driver = xr.DataArray(values, {"time": time})
    moved, change = _shift_driver(driver, 60.0, 120.0)
    assert (change > 0.0).all()
    known = np.r_[1:11, 21:40]
    np.testing.assert_allclose(moved[known], known - 1.0)
    assert np.isnan(moved[[0, *range(11, 21)]]).all()


def test_a_constant_channel_neither_rises_nor_falls():
    product = coupled.product(axes="x", terms=False, gap=False)
    course = np.r_[np.full(60, 20.0), np.linspace(20.0, 50.0, 31)[1:], np.full(30, 50.0)]
    product["temperature"] = product["temperature"].copy(data=course)
    result = correlate(product, channel="temperature", variables="window_mean", max_lag=0)
    (panel,) = plot_correlation(result, driver="temperature").axes
    points = {line.get_marker(): line.get_xdata().size for line in panel.lines}
    assert points["v"] == 0
    assert points["o"] > 80
    assert points["^"] + points["o"] == 120


def test_a_long_lag_is_written_without_an_exponent():
    product = coupled.product(axes="x", terms=False, slope=0.3, noises="white")
    result = correlate(product, variables="window_mean", max_lag=0)
    result["coupling_lag"] = xr.full_like(result["coupling_lag"], 1920.0)
    assert correlation_rows(result)[0]["lag [s]"] == "1920"
    assert ", 32 min late, p" in plot_correlation(result).axes[0].get_title()

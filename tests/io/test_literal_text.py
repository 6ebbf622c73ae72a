"""Names and units that look like formulas: figures show them literally, files use safe names."""

from __future__ import annotations

import os

import numpy as np
import pytest
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.text import Text

from gyrostab import (
    correlate,
    davar,
    fit_noise,
    make_log,
    open_log,
    open_product,
    plot,
    to_netcdf,
    to_zarr,
)
from gyrostab.plot.figures import product_figures
from gyrostab.plot.style import draws_figure, new_figure, save_png
from gyrostab.report import write_report
from tests.support.command_line import WINDOW, call, write_log

FORMULA = r"$\frac{$"


@draws_figure
def draw_text(text: str) -> Figure:
    figure = new_figure(2.0, 2.0)
    figure.suptitle(text)
    figure.add_subplot().plot([1, 2], label=text)
    figure.axes[0].legend(title=text)
    figure.axes[0].set_xlabel(text)
    return figure


@pytest.mark.parametrize("text", [FORMULA, "$x^$", r"a $ b \$ c $", "${}$", "$$", "\\"])
def test_a_text_is_shown_as_it_is(text, tmp_path):
    save_png(draw_text(text), tmp_path / "figure.png")


def formula_log(formula: str) -> xr.Dataset:
    """Noise of one axis, and a channel, all called like a formula."""
    rng = np.random.default_rng(2)
    values = rng.standard_normal((1, 6000))
    log = make_log(
        values,
        rate=20.0,
        unit="deg/h",
        start="2026-05-01",
        channels={"temperature": (values[0], "degC")},
    )
    log = log.assign_coords(axis=[formula])
    log[formula] = log["temperature"].assign_attrs(units=formula)
    return log


@pytest.mark.full
def test_figures_show_names_and_units_as_they_are(tmp_path):
    formula = FORMULA
    log = formula_log(formula)
    product = fit_noise(davar(log, window="1min", step="20s", taus=8)).compute()
    correlation = correlate(product, channel=formula, max_lag="20s")
    figures = [
        plot.plot_correlation(correlation),
        plot.plot_signal(log),
        plot.plot_adev(product, formula),
    ]
    for figure in (*figures, *(draw() for draw in product_figures(product).values())):
        save_png(figure, tmp_path / "figure.png", dpi=40)
        shown = [text.get_text() for text in figure.findobj(Text) if formula in text.get_text()]
        assert shown
    write_report(product, tmp_path / "report.html", log=log)


def test_powers_of_ten_are_still_formulas():
    product = fit_noise(davar(formula_log("x"), window="1min", step="20s", taus=8)).compute()
    figure = plot.plot_adev(product, "x")
    figure.canvas.draw()
    labels = [label for label in figure.axes[0].get_xticklabels() if label.get_text()]
    assert labels
    assert all(label.get_parse_math() for label in labels)


@pytest.mark.parametrize("suffix", ["nc", "zarr"])
@pytest.mark.parametrize("own_time", [False, True])
def test_names_that_no_file_can_hold_come_back(tmp_path, suffix, own_time):
    names = [
        "<svg onload=alert(1)>",
        "{{7*7}}",
        "a/b",
        "bell\x07",
        ".zattrs",
        "../up",
        " ",
        "__x",
        "é" * 150,
        "plain",
        "\udc80",
        "trailing ",
    ]
    log = make_log(np.arange(10.0)[None], rate=10.0, unit="deg/h", start="2026-05-01")
    for number, name in enumerate(names):
        dim = f"time_{name}" if own_time else "time"
        if own_time:
            log = log.assign_coords({dim: log["time"].values[::3]})
        log[name] = (dim, np.arange(4.0 if own_time else 10.0) + number, {"units": "K"})
    path = tmp_path / f"log.{suffix}"
    with pytest.warns(UserWarning, match="'a/b' as 'a_b'"):
        (to_netcdf if suffix == "nc" else to_zarr)(log, path)
    opened = open_log(path)
    for name in names:
        np.testing.assert_array_equal(opened[name].values, log[name].values)
        assert opened[name].dims == log[name].dims
    with xr.open_dataset(path, engine="zarr" if suffix == "zarr" else "netcdf4") as plain:
        assert plain["a_b"].attrs["long_name"] == "a/b"
        assert "plain" in plain.variables
    assert [item.name for item in tmp_path.iterdir()] == [path.name]


def test_a_name_that_no_file_can_hold_goes_all_the_way(tmp_path, capfd):
    log = write_log(
        tmp_path / "log.csv",
        header="time [s],gyro_x [deg/h],gyro_y [deg/h],<svg onload=x> [K]",
        change=lambda rows: [f"{row},{20 + index / 1000}" for index, row in enumerate(rows)],
    )
    assert call("run", log, "-o", tmp_path / "product.nc", *WINDOW, "--quiet-progress") == 0
    assert "'<svg_onload=x>' as 'svg_onload_x'" in capfd.readouterr().err
    options = ["--with", "<svg_onload=x>", "--max-lag", "5s", "--quiet-progress"]
    assert call("correlate", tmp_path / "product.nc", *options) == 0


def test_file_names_that_are_not_utf8_go_all_the_way(tmp_path, capfd):
    """As of loggers that write Latin-1; ``surrogateescape`` is how Python holds such bytes."""
    log = write_log(tmp_path / os.fsdecode(b"m\xe4rz.csv"))
    probe = tmp_path / os.fsdecode(b"f\xfchler.csv")
    probe.write_text("time [s],temperature [degC]\n0,20\n30,21\n60,22\n")
    product = tmp_path / "product.nc"
    assert call("scan", log) == 0
    assert call("run", log, "--channel", probe, "-o", product, *WINDOW, "--quiet-progress") == 0
    for name, form in (
        ("imu.yaml", "kalibr"),
        ("tool.csv", "iscwsa"),
        ("tool.json", "iscwsa"),
        ("tool.xml", "iscwsa"),
    ):
        assert call("export", product, "--format", form, "-o", tmp_path / name) == 0
    assert r"m\udce4rz.csv" in (tmp_path / "imu.yaml").read_text("utf-8")
    assert r"m\udce4rz.csv" in capfd.readouterr().out
    with open_product(product) as opened:
        assert r"f\udcfchler.csv" in opened.attrs["history"]

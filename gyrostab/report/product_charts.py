"""Charts of a product that can be zoomed, turned and read off, and data of its windows."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from gyrostab.allan.confidence import interval_limits
from gyrostab.allan.variance import variance_name
from gyrostab.arrays import Floats
from gyrostab.noise import LAWS
from gyrostab.plot.adev import fitted_curves
from gyrostab.plot.coefficients import find_shown_values
from gyrostab.plot.style import axis_names, axis_style, unit_symbol
from gyrostab.report.charts import (
    DEVIATION_LABEL,
    SYMBOLS,
    TAU_LABEL,
    TIME_AXIS,
    Chart,
    add_channel,
    decade_bar,
    embeddable,
    gap_shapes,
    label_panel,
    log_axis,
    milliseconds,
    new_chart,
    plain_text,
    single,
    stacked_panels,
)
from gyrostab.schema import split_coefficient
from gyrostab.time.durations import largest_unit
from gyrostab.time.stamps import label_stamp

if TYPE_CHECKING:
    import plotly.graph_objects as go

#: Largest numbers of windows that are drawn over time, and of windows and averaging times of which
#: the whole surface is in the page: a page of three axes then has about 7 MB, 4.8 of them plotly.
_MAX_WINDOWS, _MAX_SURFACE_WINDOWS, _MAX_TAUS = 1000, 200, 60
_MAX_CHANNELS = 4


def product_charts(product: xr.Dataset, log: xr.Dataset | None = None) -> list[Chart]:
    """Make the charts of a product, with the gaps of its log.

    They are ``record``, ``coefficients``, ``map``, ``window`` and, with at least two windows and
    averaging times, ``surface``. The last three show the first axis; `window_data` holds the
    others.
    """
    gaps, variance = gap_shapes(log), variance_name(product)
    surface = _thin_product(product, _MAX_SURFACE_WINDOWS, _MAX_TAUS)
    times = _thin_product(product, _MAX_WINDOWS, product.sizes["tau"])
    charts = [
        ("record", f"{variance} deviation of the whole record", _draw_record(product)),
        ("coefficients", "Noise coefficients over time", _draw_coefficients(times, gaps)),
        ("map", f"Dynamic {variance} deviation", _draw_map(surface, gaps)),
        ("window", f"{variance} deviation of one window", _draw_window(surface)),
    ]
    if min(surface.sizes["time"], surface.sizes["tau"]) > 1:
        title = f"Dynamic {variance} deviation as a surface"
        charts.append(("surface", title, _draw_surface(surface)))
    drawn: dict[str, Mapping[Any, int]] = {
        "record": {"tau": surface.sizes["tau"]},
        "coefficients": times.sizes,
    }
    return [
        Chart(
            name,
            title,
            _describe_thinning(product, drawn.get(name, surface.sizes)),
            embeddable(figure.to_json()),
        )
        for name, title, figure in charts
    ]


def window_data(product: xr.Dataset) -> str:
    """Return what the chart of one window shows, for every window and axis, as JSON.

    It has ``axes``, ``colours``, ``times`` (labels), ``tau`` [s] and for each axis ``measured``,
    ``low``, ``high`` and ``fitted`` [degree hour-1], 32-bit floats in base 64, window by window. It
    can stand in a script element.
    """
    part = _thin_product(product, _MAX_SURFACE_WINDOWS, _MAX_TAUS)
    low, high = interval_limits(part["avar"].values, part["edf"].values)
    squares = {
        "measured": part["avar"].values,
        "low": low,
        "high": high,
        "fitted": fitted_curves(part)[1],
    }
    names = axis_names(part)
    content = {
        "axes": names,
        "colours": [axis_style(product, name)["color"] for name in names],
        "times": [label_stamp(time) for time in part["time"].values],
        "tau": part["tau"].values.tolist(),
        "values": [
            {
                key: base64.b64encode(np.sqrt(values[row]).astype("<f4").tobytes()).decode("ascii")
                for key, values in squares.items()
            }
            for row in range(len(names))
        ],
    }
    return embeddable(json.dumps(content))


def _thin_product(product: xr.Dataset, windows: int, taus: int) -> xr.Dataset:
    """Select at most so many windows and averaging times, evenly spaced."""
    chosen = {
        dim: np.unique(np.linspace(0, product.sizes[dim] - 1, limit).round().astype(int))
        for dim, limit in (("time", windows), ("tau", taus))
        if product.sizes[dim] > limit
    }
    if "tau" in chosen:  # evenly in the logarithm
        tau = product["tau"].values
        targets = np.geomspace(tau[0], tau[-1], taus)
        chosen["tau"] = np.unique(np.searchsorted(tau, targets * (1 - 1e-9)).clip(0, tau.size - 1))
    return product.isel(chosen).compute()


def _deviation_label(product: xr.Dataset) -> str:
    return DEVIATION_LABEL.replace("Allan", variance_name(product))


def _describe_thinning(product: xr.Dataset, drawn: Mapping[Any, int]) -> str:
    """Say which share of the windows and averaging times is drawn, if not all."""
    return "".join(
        f" One {name} in {product.sizes[dim] / drawn[dim]:.3g} is drawn."
        for dim, name in (("time", "window"), ("tau", "averaging time"))
        if drawn.get(dim, product.sizes[dim]) < product.sizes[dim]
    )


def _draw_record(product: xr.Dataset) -> go.Figure:
    """Draw the Allan deviation of each axis over all windows, with the terms fitted to it."""
    record = _average_windows(product)
    measured, fitted = (
        np.sqrt(part[:, 0]) for part in (record["avar"].values, fitted_curves(record)[1])
    )
    figure = new_chart(
        xaxis=log_axis(TAU_LABEL, record["tau"].values),
        yaxis=log_axis(_deviation_label(product), measured),
        height=460,
    )
    for row, name in enumerate(axis_names(record)):
        style = axis_style(product, name)
        shared = {
            "x": record["tau"].values,
            "legendgroup": name,
            "hovertemplate": "%{x:.3g} s: %{y:.3g} deg/h",
        }
        figure.add_scatter(
            **shared,
            y=measured[row],
            mode="markers",
            name=f"axis {plain_text(name)}, measured",
            marker={"color": style["color"], "size": 8, "symbol": SYMBOLS[row % len(SYMBOLS)]},
        )
        figure.add_scatter(
            **shared,
            y=fitted[row],
            mode="lines",
            name=f"axis {plain_text(name)}, fitted",
            line={"color": style["color"], "width": 1.5},
        )
    return figure


def _average_windows(product: xr.Dataset) -> xr.Dataset:
    """Average the surface over all windows, as one window with the terms of all of them."""
    surface = product[[name for name in product.data_vars if product[name].dims[-1:] == ("tau",)]]
    mean = surface.mean("time", keep_attrs=True).expand_dims(time=1, axis=1)
    record = product.isel(time=[product.sizes["time"] // 2])
    record = record.assign({name: mean[name].transpose(*product[name].dims) for name in surface})
    if "window_trend" in product:  # ramps add the mean of their squares to the mean surface
        trend = (product["window_trend"] ** 2).mean("time") ** 0.5
        record["window_trend"] = trend.expand_dims(time=1, axis=1)
    # the mean of that has a sign, and does not belong to the root mean square of the other
    return _thin_product(record.drop_vars("difference_trend", errors="ignore"), 1, _MAX_TAUS)


def _draw_coefficients(product: xr.Dataset, gaps: list[dict[str, Any]]) -> go.Figure:
    """Draw the coefficients and the channels over time, one panel each on one time axis."""
    channels = [
        str(name)
        for name in product.data_vars
        if product[name].dims == ("time",) and product[name].dtype.kind == "f"
    ][:_MAX_CHANNELS]
    figure = stacked_panels(len(LAWS) + len(channels), height=130)
    figure.update_layout(shapes=gaps)
    for row, symbol in enumerate(LAWS):
        panel = f"y{row + 1 if row else ''}"
        label = unit_symbol(LAWS[symbol].label)
        label_panel(figure, panel, f"{symbol}, {LAWS[symbol].name} [{label}]")
        _add_coefficient(figure, product, symbol, panel, label)
    for row, name in enumerate(channels, start=len(LAWS)):
        add_channel(figure, row, name, milliseconds(product), product[name], colour="#404040")
    return figure


def _add_coefficient(
    figure: go.Figure, product: xr.Dataset, symbol: str, panel: str, label: str
) -> None:
    """Add estimates as points with standard errors, and upper limits as open arrows."""
    values, limits = split_coefficient(product, symbol)
    shown = find_shown_values(product, symbol)
    is_wide = shown.size > 0 and shown.max() > 10 * shown.min()  # than a decade
    scale = log_axis("", shown, labels=5) if is_wide else {"rangemode": "tozero"}
    figure.layout[panel.replace("y", "yaxis")].update(scale)
    for row, name in enumerate(axis_names(product)):
        colour = axis_style(product, name)["color"]
        shared = {"x": milliseconds(product), "yaxis": panel, "legendgroup": name}
        if np.isfinite(limits[row]).any():
            figure.add_scatter(
                **shared,
                y=single(limits[row]),
                mode="markers",
                name=f"axis {plain_text(name)}, upper limit",
                marker={"color": colour, "symbol": "arrow-bar-down-open", "size": 8},
                hovertemplate=f"< %{{y:.3g}} {label}",
                showlegend=False,
            )
        figure.add_scatter(
            **shared,
            y=single(values[row]),
            error_y={
                "array": single(product[f"{symbol}_stderr"].values[row]),
                "color": colour,
                "thickness": 1,
                "width": 0,
            },
            mode="lines+markers",
            name=f"axis {plain_text(name)}",
            line={"color": colour, "width": 1},
            marker={"size": 5, "symbol": SYMBOLS[row % len(SYMBOLS)]},
            hovertemplate=f"%{{y:.3g}} {label}",
            showlegend=symbol == "N",
        )


def _log_deviation(product: xr.Dataset) -> Floats:
    """Return the logarithm of the Allan deviation of the first axis, (tau, time)."""
    avar = product["avar"].values[0].T
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(avar > 0, 0.5 * np.log10(avar), np.nan)


def _draw_map(product: xr.Dataset, gaps: list[dict[str, Any]]) -> go.Figure:
    figure = new_chart(
        xaxis=TIME_AXIS, yaxis=log_axis(TAU_LABEL, product["tau"].values), height=380, shapes=gaps
    )
    values = _log_deviation(product)
    figure.add_heatmap(
        x=milliseconds(product),
        y=product["tau"].values,
        z=single(values),
        customdata=single(10.0**values),
        colorscale="Viridis",
        colorbar=decade_bar(values),
        hovertemplate="%{x}<br>%{y:.3g} s: %{customdata:.3g} deg/h<extra></extra>",
    )
    return figure


def _draw_window(product: xr.Dataset) -> go.Figure:
    """Draw the frame of the chart of one window, which the page fills."""
    avar, tau = product["avar"].values, product["tau"].values
    shown = np.sqrt(avar[np.isfinite(avar) & (avar > 0)])
    limits = (shown.min() / 2, shown.max() * 2) if shown.size else (0.1, 10.0)
    figure = new_chart(
        xaxis=log_axis(TAU_LABEL, tau),
        yaxis=log_axis(_deviation_label(product), shown, range=np.log10(limits), autorange=False),
        height=400,
    )
    empty = np.full(tau.size, np.nan)
    for name, look in (
        ("low", {"line": {"width": 0}, "showlegend": False, "hoverinfo": "skip"}),
        ("95 % band", {"line": {"width": 0}, "fill": "tonexty", "hoverinfo": "skip"}),
        ("fitted", {"line": {"color": "#1a1a1a", "width": 1.5}}),
        ("measured", {"mode": "markers", "marker": {"size": 7}}),
    ):
        figure.add_scatter(
            **{"x": tau, "y": empty, "mode": "lines", "name": name, **look},
            hovertemplate="%{x:.3g} s: %{y:.3g} deg/h",
        )
    return figure


def _draw_surface(product: xr.Dataset) -> go.Figure:
    values = _log_deviation(product)
    # from the first window, because WebGL computes with 32 bits
    seconds = (milliseconds(product) - milliseconds(product)[0]) / 1e3
    size, unit = largest_unit(float(seconds[-1]) / 3)
    figure = new_chart(
        scene={
            "xaxis": {"title": {"text": f"time [{unit}]"}},
            "yaxis": log_axis(TAU_LABEL, product["tau"].values, labels=5),
            "zaxis": log_axis("deg/h", 10.0**values),
            "camera": {"eye": {"x": -1.7, "y": -2.0, "z": 1.0}, "center": {"z": -0.2}},
            "aspectratio": {"x": 1.8, "y": 1.1, "z": 0.8},
        },
        height=520,
        margin={"l": 0, "r": 0, "t": 30, "b": 0},
    )
    figure.add_surface(
        x=seconds / size,
        y=product["tau"].values,
        z=single(10.0**values),
        surfacecolor=single(values),
        colorscale="Viridis",
        colorbar=decade_bar(values),
        hovertemplate=f"%{{x:.4g}} {unit}<br>%{{y:.3g}} s: %{{z:.3g}} deg/h<extra></extra>",
    )
    return figure

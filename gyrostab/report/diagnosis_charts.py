"""Charts of a diagnosis: recording and simulations, before and after the effects are added."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from gyrostab.arrays import Floats
from gyrostab.noise import NORMAL_95
from gyrostab.plot.style import COLOURS, axis_names, axis_style, find_true_runs
from gyrostab.plot.surface import CHANGE_CMAP
from gyrostab.report.charts import (
    DEVIATION_LABEL,
    SYMBOLS,
    TAU_LABEL,
    Chart,
    add_channel,
    embeddable,
    label_panel,
    log_axis,
    new_chart,
    plain_text,
    single,
    stacked_panels,
    to_milliseconds,
)
from gyrostab.report.static import static_png

if TYPE_CHECKING:
    import plotly.graph_objects as go

_RED = "#D00000"
_CASES = {"before": "simulation before", "after": "simulation after"}
_MAX_CHANNELS = 3  # panels below the means
_INSIDE_BAND_OPACITY = 0.3  # of cells inside the 95 % band
#: Labels of ticks less than a minute, or a day, apart [ms]: dates without the year, so that
#: those of panels side by side do not touch.
_SHORT_DATES = [
    {"dtickrange": [1_000, 59_999], "value": "%H:%M:%S\n%b %-d"},
    {"dtickrange": [60_000, 86_399_999], "value": "%H:%M\n%b %-d"},
]


def diagnosis_charts(surfaces: xr.Dataset, content: Mapping[str, Any]) -> list[Chart]:
    """Make the charts of a diagnosis: ``change``, ``means``, ``deviations`` and ``spectra``.

    `surfaces` and `content` are the contents of ``diagnosis.nc`` and ``diagnosis.json``.
    """
    draw: dict[str, tuple[str, Callable[..., go.Figure]]] = {
        "change": ("Where recording and simulation differ", draw_change),
        "means": ("Mean rate over time, and what drives it", _draw_means),
        "deviations": ("Allan deviation of the whole record", _draw_deviations),
        "spectra": ("Power spectrum of the whole record", _draw_spectra),
    }
    figures = {name: function(surfaces, content) for name, (_, function) in draw.items()}
    return [
        Chart(name, draw[name][0], "", embeddable(figure.to_json()), static_png(figure))
        for name, figure in figures.items()
    ]


def _find_regions(
    content: Mapping[str, Any], axis: str, *, over_tau: bool
) -> list[Mapping[str, Any]]:
    """Find the mismatches of an axis over averaging times, or those of its mean rate."""
    views = ("davar", "cross_axis") if over_tau else ("mean", "restart")
    return [
        region
        for region in content["mismatches"]
        if axis in region["axes"]
        and region["view"] in views
        and (region["tau_min_s"] or not over_tau)
    ]


def _find_change(surfaces: xr.Dataset, case: str) -> tuple[Floats, Floats]:
    """Divide the Allan deviation of the recording by that of a simulation, (axis, tau, window).

    The second array is the opacity of each cell, less inside the 95 % band of the simulation.
    """
    names = ["avar", "avar_low", "avar_high"]
    cells = surfaces[names].transpose("case", "axis", "tau", "window")
    recording = cells["avar"].sel(case="recording").values
    avar, low, high = (cells[name].sel(case=case).values for name in names)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.sqrt(recording / avar)
        is_usual = (recording >= low) & (recording <= high)
    return ratio, np.where(is_usual, _INSIDE_BAND_OPACITY, 1.0)


def _select_channels(surfaces: xr.Dataset, content: Mapping[str, Any]) -> list[str]:
    """Return the channels to draw: first those that named effects follow."""
    drivers = [str(effect["driver"] or "").split(",") for effect in content["effects"]]
    named = [name.strip() for names in drivers for name in names]
    return [
        name
        for name in dict.fromkeys([*named, "temperature", "vibration", "rotation_rate"])
        if f"channel_{name}" in surfaces and np.isfinite(surfaces[f"channel_{name}"]).any()
    ][:_MAX_CHANNELS]


def _centre_stamps(surfaces: xr.Dataset, content: Mapping[str, Any], kind: str = "") -> Floats:
    """Return the centres of windows, or with "block_" of blocks [ms since 1970]."""
    start = np.datetime64(content["recording"]["start"].removesuffix("Z"), "ns").astype(np.int64)
    seconds = (surfaces[f"{kind}begin"].values + surfaces[f"{kind}end"].values) / 2.0
    return to_milliseconds(start + 1e9 * seconds)


def draw_change(surfaces: xr.Dataset, content: Mapping[str, Any]) -> go.Figure:
    """Draw the recording over the simulations, by time and averaging time."""
    from plotly.subplots import make_subplots

    names, tau = axis_names(surfaces), surfaces["tau"].values
    frame = make_subplots(
        rows=len(names), cols=2, shared_xaxes="all", shared_yaxes="all",
        horizontal_spacing=0.13, vertical_spacing=0.05,
        column_titles=["without the effects", "with the effects"],
    )  # fmt: skip
    for column, case in enumerate(_CASES, start=1):
        ratio, opacity = _find_change(surfaces, case)
        with np.errstate(divide="ignore"):
            colour = np.log2(ratio) * opacity
        for row in range(len(names)):
            frame.add_heatmap(
                x=_centre_stamps(surfaces, content), y=tau, z=single(colour[row]),
                customdata=single(ratio[row]), coloraxis="coloraxis", row=row + 1, col=column,
                hovertemplate="%{x}<br>%{y:.3g} s: %{customdata:.2f}<extra></extra>",
            )  # fmt: skip
    frame.update_yaxes(log_axis("", tau, labels=5))
    for row, name in enumerate(names, start=1):
        title = f"axis {plain_text(name)}<br>{TAU_LABEL}"
        frame.update_yaxes(title={"text": title, "font": {"size": 12}}, col=1, row=row)
    frame.update_xaxes(type="date", tickformatstops=_SHORT_DATES)
    for row, name in enumerate(names):
        for region in _find_regions(content, name, over_tau=True):
            _frame_region(frame, region, row)
    figure = new_chart(
        height=170 * len(names) + 130,
        margin={"l": 70, "r": 20, "t": 50, "b": 50},  # room for the buttons above the colour scale
        plot_bgcolor="#e8e8e8",
        coloraxis={
            "colorscale": CHANGE_CMAP, "cmin": -1, "cmax": 1,
            "colorbar": {
                "title": {"text": "σ(τ), recording / simulation [1]", "side": "right"},
                "tickvals": [-1, -0.5, 0, 0.5, 1], "ticktext": ["≤ 0.5", "0.7", "1", "1.4", "≥ 2"],
            },
        },
    )  # fmt: skip
    return frame.update_layout(figure.layout)


def _frame_region(figure: go.Figure, region: Mapping[str, Any], row: int) -> None:
    for column in (0, 1):
        number = 2 * row + column + 1
        axis = str(number) if number > 1 else ""
        figure.add_shape(
            type="rect", xref=f"x{axis}", yref=f"y{axis}", x0=region["start"], x1=region["end"],
            y0=region["tau_min_s"] / 1.3, y1=region["tau_max_s"] * 1.3,
            line={"color": _RED, "width": 1 if column else 2, "dash": "dot" if column else "solid"},
            label=None if column else _region_label(region),
        )  # fmt: skip


def _region_label(region: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "text": str(region["id"]),
        "textposition": "top left",
        "font": {"color": _RED, "size": 14, "weight": 700},
    }


def _band_outline(x: Floats, low: Floats, high: Floats) -> tuple[Floats, Floats]:
    """Return the outline of a band: a polygon for each stretch without a missing value.

    Examples
    --------
    >>> x, y = _band_outline(np.arange(4.0), np.array([0.0, 0, np.nan, 0]), np.ones(4))
    >>> x.tolist(), y.tolist()
    ([0.0, 1.0, 1.0, 0.0, 0.0, 3.0, 3.0, 3.0], [0.0, 0.0, 1.0, 1.0, nan, 0.0, 1.0, nan])
    """
    present = np.isfinite(low) & np.isfinite(high)
    place, edge = [x[:0]], [low[:0]]
    for part in map(slice, *find_true_runs(present)):
        place += [x[part], x[part][::-1], x[part][:1]]
        edge += [low[part], high[part][::-1], np.full(1, np.nan)]
    return np.concatenate(place), np.concatenate(edge)


def _draw_means(surfaces: xr.Dataset, content: Mapping[str, Any]) -> go.Figure:
    """Draw the mean rate of each axis with both simulations, and the channels below."""
    names, channels = axis_names(surfaces), _select_channels(surfaces, content)
    figure = stacked_panels(len(names) + len(channels), height=170)
    window, block = _centre_stamps(surfaces, content), _centre_stamps(surfaces, content, "block_")
    for row, name in enumerate(names):
        panel, part = f"y{row + 1 if row else ''}", surfaces.sel(axis=name)
        label_panel(figure, panel, f"axis {plain_text(name)}, mean rate [deg/h]")
        shared = {"yaxis": panel, "showlegend": row == 0}
        figure.add_scatter(
            x=block, y=single(part["block_mean"].values), mode="markers", name="recording",
            legendgroup="recording", marker={"color": "#595959", "size": 3}, **shared,
        )  # fmt: skip
        for number, (case, title) in enumerate(_CASES.items()):
            colour = COLOURS[1 - number]
            mean = part["mean"].sel(case=case).values
            band = NORMAL_95 * part["mean_stderr"].sel(case=case).values
            place, edge = _band_outline(window, mean - band, mean + band)
            common = {"mode": "lines", "legendgroup": case, **shared}
            figure.add_scatter(
                x=place, y=single(edge), fill="toself", line={"width": 0}, hoverinfo="skip",
                fillcolor=colour, opacity=0.18,
                **(common | {"showlegend": False}),
            )  # fmt: skip
            figure.add_scatter(
                x=window, y=single(mean), name=f"{title}, 95 %",
                line={"color": colour, "dash": "solid" if number else "dash"}, **common,
            )  # fmt: skip
        figure.layout[panel.replace("y", "yaxis")].range = _limit_means(part)
        for region in _find_regions(content, name, over_tau=False):
            figure.add_shape(
                type="rect", xref="x", yref=f"{panel} domain", x0=region["start"],
                x1=region["end"], y0=0, y1=1, fillcolor=_RED, opacity=0.12, line={"width": 0},
                label=_region_label(region),
            )  # fmt: skip
    for row, channel in enumerate(channels, start=len(names)):
        course = surfaces[f"channel_{channel}"]
        add_channel(figure, row, channel, block, course, colour=COLOURS[2], mode="lines")
    return figure


def _limit_means(part: xr.Dataset) -> tuple[float, float] | None:
    """Find limits without the outermost 2 % of the block means, which would flatten the rest."""
    mean, blocks = part["mean"].values, part["block_mean"].values
    shown = mean[np.isfinite(mean)]
    if np.isfinite(blocks).any():
        shown = np.append(shown, np.nanquantile(blocks, [0.01, 0.99]))
    if not shown.size:
        return None
    margin = 0.25 * np.ptp(shown) + 1e-12
    return float(shown.min() - margin), float(shown.max() + margin)


def _add_cases(figure: go.Figure, surfaces: xr.Dataset, x: Floats, values: xr.DataArray) -> None:
    """Add lines of the simulations before (dashed) and after, in the colour of each axis."""
    for name in axis_names(surfaces):
        colour = axis_style(surfaces, name)["color"]
        for case, title in _CASES.items():
            figure.add_scatter(
                x=x, y=single(values.sel(axis=name, case=case).values), mode="lines",
                name=f"axis {plain_text(name)}, {title}", legendgroup=name,
                line={"color": colour, "dash": "dash" if case == "before" else "solid"},
            )  # fmt: skip


def _draw_deviations(surfaces: xr.Dataset, content: Mapping[str, Any]) -> go.Figure:
    tau = surfaces["tau"].values
    with np.errstate(invalid="ignore"):
        deviation = surfaces["avar"].mean("window", skipna=True) ** 0.5
    figure = new_chart(
        xaxis=log_axis(TAU_LABEL, tau),
        yaxis=log_axis(DEVIATION_LABEL, deviation.values),
        height=460,
    )
    for row, name in enumerate(axis_names(surfaces)):
        figure.add_scatter(
            x=tau, y=single(deviation.sel(axis=name, case="recording").values), mode="markers",
            name=f"axis {plain_text(name)}, recording", legendgroup=name,
            marker={
                "color": axis_style(surfaces, name)["color"], "size": 8,
                "symbol": SYMBOLS[row % len(SYMBOLS)],
            },
        )  # fmt: skip
    _add_cases(figure, surfaces, tau, deviation)
    return figure


def _draw_spectra(surfaces: xr.Dataset, content: Mapping[str, Any]) -> go.Figure:
    frequency, lines = surfaces["line_frequency"].values, surfaces["line_density"]
    figure = new_chart(
        xaxis=log_axis("frequency [Hz]", frequency),
        yaxis=log_axis("power density [(deg/h)²/Hz]", lines.values),
        height=460,
    )
    for name in axis_names(surfaces):
        colour = axis_style(surfaces, name)["color"]
        figure.add_scatter(
            x=single(frequency), y=single(lines.sel(axis=name).values),
            mode="lines", name=f"axis {plain_text(name)}, recording", legendgroup=name,
            line={"color": colour, "width": 0.7}, opacity=0.6,
        )  # fmt: skip
    _add_cases(figure, surfaces, surfaces["frequency"].values, surfaces["density"])
    return figure

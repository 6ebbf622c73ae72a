"""Draw a chart as a picture, for pages that are printed or opened without JavaScript."""

from __future__ import annotations

import html
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gyrostab.arrays import Array
from gyrostab.plot.style import (
    INCH_MM,
    MARKERS,
    PAGE_MM,
    draws_figure,
    encode_png,
    label_log_axis,
    log_edges,
    new_figure,
    time_axis,
)
from gyrostab.plot.surface import CHANGE_CMAP, find_time_edges
from gyrostab.report.charts import SYMBOLS

if TYPE_CHECKING:
    import plotly.graph_objects as go
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_PIXEL_INCHES = PAGE_MM / INCH_MM / 1000.0  # the page shows a chart about 1000 pixels wide
_PIXEL_POINTS = 72.0 * _PIXEL_INCHES
_DASHES = {"dash": "--", "dot": ":"}
_MARKERS = dict(zip(SYMBOLS, MARKERS, strict=True))


def static_png(chart: go.Figure) -> str:
    """Return the picture of a chart as PNG in base 64."""
    return encode_png(draw_static(chart))


@draws_figure
def draw_static(chart: go.Figure) -> Figure:
    """Draw what the charts of a diagnosis hold: lines, points, bands, maps and regions of time.

    The domains of the axes of the chart give the rows and columns of panels.
    """
    layout = chart.layout
    axes = {  # by the name of the vertical one
        y.plotly_name.replace("axis", ""): (layout[f"xaxis{(y.anchor or 'x')[1:]}"], y)
        for y in chart.select_yaxes()
    }
    columns = sorted({x.domain for x, _ in axes.values()})
    rows = sorted({y.domain for _, y in axes.values()}, reverse=True)
    figure = new_figure(PAGE_MM / INCH_MM, layout.height * _PIXEL_INCHES)
    grid = figure.subplots(
        len(rows),
        len(columns),
        sharex=True,
        sharey=len(columns) > 1,
        squeeze=False,
        gridspec_kw={"wspace": 0.08},
    )
    panels = {
        name: grid[rows.index(y.domain), columns.index(x.domain)] for name, (x, y) in axes.items()
    }
    legend: list[tuple[str, Any]] = []
    for trace in chart.data:
        name = trace.yaxis or "y"
        x = trace.x
        if axes[name][0].type == "date":  # milliseconds
            x = np.asarray(x * 1e6).astype(np.int64).astype("datetime64[ns]")
        if trace.type == "heatmap":
            _draw_map(panels[name], x, trace, layout.coloraxis)
        elif artist := _draw_scatter(panels[name], x, trace):
            legend.append((trace.legendgroup, artist))
    for name, panel in panels.items():
        panel.set_facecolor(layout.plot_bgcolor or "white")
        _set_axes(panel, *axes[name], is_lowest=panel in grid[-1])
    for shape in layout.shapes:
        _draw_region(panels[shape.yref.split()[0]], shape)
    for note in layout.annotations:
        row = 0 if note.yref == "paper" else rows.index(axes[note.yref.split()[0]][1].domain)
        grid[row, int(note.x * len(columns))].set_title(_unescape_text(note.text), loc=note.xanchor)
    labels = layout.coloraxis.colorbar
    if labels.tickvals:
        bar = figure.colorbar(grid[0, 0].collections[0], ax=grid, aspect=40, pad=0.02)
        bar.set_ticks(labels.tickvals, labels=labels.ticktext)
        bar.set_label(_unescape_text(labels.title.text))
    if legend:
        groups = list(dict.fromkeys(group for group, _ in legend))
        figure.legend(
            handles=[artist for name in groups for group, artist in legend if group == name],
            loc="outside upper center",
            ncols=min(len(groups), 4),
            frameon=False,
        )
    return figure


def _unescape_text(text: str) -> str:
    return html.unescape(text.replace("<br>", "\n"))


def _draw_map(panel: Axes, times: NDArray[np.datetime64], trace: Any, scale: Any) -> None:
    """Draw a map over time and logarithmic averaging time."""
    edges = find_time_edges(times), log_edges(trace.y)
    panel.pcolormesh(
        *edges,
        np.ma.masked_invalid(trace.z),
        cmap=CHANGE_CMAP,
        vmin=scale.cmin,
        vmax=scale.cmax,
        rasterized=True,
    )
    panel.set_xlim(*edges[0][[0, -1]])
    panel.set_ylim(*edges[1][[0, -1]])


def _draw_scatter(panel: Axes, x: Array, trace: Any) -> Any:
    """Draw a line, points or a band; return what the legend shows of it."""
    if trace.fill:
        panel.fill(x, trace.y, color=trace.fillcolor, alpha=trace.opacity, linewidth=0.0)
        return None
    look = trace.marker if trace.mode == "markers" else trace.line
    (line,) = panel.plot(
        x,
        trace.y,
        color=look.color,
        alpha=trace.opacity,
        marker=_MARKERS[look.symbol or SYMBOLS[0]] if trace.mode == "markers" else "",
        markersize=(trace.marker.size or 0.0) * _PIXEL_POINTS,
        markeredgewidth=0.0,
        linestyle="" if trace.mode == "markers" else _DASHES.get(trace.line.dash, "-"),
        linewidth=(trace.line.width or 2.0) * _PIXEL_POINTS,
        label=_unescape_text(trace.name),
    )
    return None if trace.showlegend is False else line


def _set_axes(panel: Axes, x: Any, y: Any, *, is_lowest: bool) -> None:
    """Set scales, limits and labels."""
    panel.set(xscale="log" if x.type == "log" else "linear")
    panel.set(
        yscale="log" if y.type == "log" else "linear", ylabel=_unescape_text(y.title.text or "")
    )
    if y.range:
        panel.set_ylim(*y.range)
    for scale, axis in ((x, panel.xaxis), (y, panel.yaxis)):
        if scale.type == "log":
            label_log_axis(axis, *axis.get_view_interval())
    if x.type != "date":
        panel.set_xlabel(_unescape_text(x.title.text))
        return
    panel.margins(x=0.0)
    if is_lowest:
        time_axis(panel, np.array([]))


def _draw_region(panel: Axes, shape: Any) -> None:
    """Shade or frame a region, and write its label at the upper left."""
    from matplotlib.dates import date2num

    begin, end = date2num(  # type: ignore[no-untyped-call]
        [np.datetime64(x.removesuffix("Z")) for x in (shape.x0, shape.x1)]
    )
    is_full_height = shape.yref.endswith("domain")
    place = panel.get_xaxis_transform() if is_full_height else panel.transData
    panel.fill(
        [begin, end, end, begin],
        [shape.y0, shape.y0, shape.y1, shape.y1],
        facecolor=shape.fillcolor or "none",
        edgecolor=shape.line.color or "none",
        alpha=shape.opacity,
        linewidth=shape.line.width * _PIXEL_POINTS,
        linestyle=_DASHES.get(shape.line.dash, "-"),
        transform=place,
    )
    if shape.label.text:
        top = shape.y1 if is_full_height else min(shape.y1, panel.get_ylim()[1])
        panel.annotate(
            shape.label.text,
            (max(begin, panel.get_xlim()[0]), top),
            (2, -2),
            xycoords=place,
            textcoords="offset points",
            va="top",
            ha="left",
            fontsize="small",
            color="white",
            weight="bold",
            bbox={"facecolor": shape.label.font.color, "edgecolor": "none", "pad": 1.2},
        )

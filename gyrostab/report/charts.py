"""What pages and their charts share: template, frame, axes, escaping, and the plotly script."""

from __future__ import annotations

import functools
import html
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import metadata, resources
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.arrays import Array, Floats
from gyrostab.plot.style import unit_label
from gyrostab.time.stamps import to_nanoseconds

if TYPE_CHECKING:
    import plotly.graph_objects as go

DEVIATION_LABEL, TAU_LABEL = "Allan deviation [deg/h]", "averaging time [s]"
TIME_AXIS = {"type": "date", "title": {"text": "time (UTC)"}}
#: Markers of the axes, by number, like `gyrostab.plot.style.MARKERS`.
SYMBOLS = ("circle", "square", "diamond", "cross", "x", "star")
_GAP_COLOUR = "rgba(120, 120, 120, 0.25)"
_MAX_GAPS = 200


@dataclass(frozen=True)
class Chart:
    """A chart of a page."""

    #: Identifier in the page, heading, and what to add to the caption.
    name: str
    title: str
    note: str
    figure: str  # plotly figure as JSON that can stand in a script element
    png: str = ""  # its picture in base 64, shown in print and without JavaScript


@functools.cache
def plotly_script() -> str:
    """Return the source text of plotly.js, which a page needs to work without a network."""
    from plotly.offline import get_plotlyjs

    return str(get_plotlyjs())


def page_text(template: str, *, title: str, plotly: str = "", **content: Any) -> str:
    """Render a template, with the time and the version that made the page.

    Parameters
    ----------
    template : str
        Name of the template, which extends ``frame.html.jinja``.
    plotly : str
        Address of plotly.js, relative to the page; by default the page holds all of it.
    """
    import jinja2

    templates = jinja2.Environment(
        loader=jinja2.PackageLoader("gyrostab", "report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
    )
    script = resources.files("gyrostab.report").joinpath("charts.js")
    made = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    return templates.get_template(template).render(
        title=title,
        made=made,
        version=metadata.version("gyrostab"),
        plotly="" if plotly else plotly_script(),
        plotly_address=plotly,
        charts_script=script.read_text(encoding="utf-8"),
        **content,
    )


def embeddable(text: str) -> str:
    """Escape what would end a script element."""
    return text.replace("<", "\\u003c")


def gap_shapes(log: xr.Dataset | None) -> list[dict[str, Any]]:
    """Shade the longest gaps of a log over the height of a chart."""
    if log is None or "gap_start" not in log.variables:
        return []
    longest = np.argsort(-np.asarray(log["gap_samples"].values), kind="stable")[:_MAX_GAPS]
    return [
        {
            "type": "rect",
            "xref": "x",
            "yref": "paper",
            "x0": str(log["gap_start"].values[i]),
            "x1": str(log["gap_end"].values[i]),
            "y0": 0,
            "y1": 1,
            "fillcolor": _GAP_COLOUR,
            "line": {"width": 0},
            "layer": "below",
        }
        for i in longest
    ]


def new_chart(**layout: Any) -> go.Figure:
    """Start a figure with the looks of the page, and more of plotly's layout."""
    import plotly.graph_objects as go

    shared = {
        "template": "plotly_white",
        "font": {"size": 14, "color": "#1a1a1a"},
        "margin": {"l": 70, "r": 20, "t": 20, "b": 50},
        "legend": {"orientation": "h", "yanchor": "bottom", "y": 1.0},
        "hovermode": "closest",
    }
    return go.Figure(layout={**shared, **layout})


def log_axis(title: str, values: Floats, *, labels: int = 12, **options: Any) -> dict[str, Any]:
    """Label a logarithmic axis at 1, 2 and 5 of each decade, or with many decades at 1 only."""
    shown = values[np.isfinite(values) & (values > 0)]
    decades = np.log10(shown.max() / shown.min()) if shown.size else 1.0
    step = "D2" if 3 * decades <= labels else max(1, round(decades / labels))
    title_ = {"text": title}
    return {"type": "log", "title": title_, "tickformat": "~g", "dtick": step, **options}


def to_milliseconds(nanoseconds: Array) -> Floats:
    """Return times as plotly counts them [ms since 1970], from nanoseconds.

    They have a fraction: plotly takes a whole number of four digits for a year.

    Examples
    --------
    >>> to_milliseconds(np.array([5_000_000_000]))
    array([5000.001])
    """
    return np.asarray(nanoseconds / 1e6 + 1e-3)


def milliseconds(product: xr.Dataset) -> Floats:
    """Return window centres as plotly counts them [ms since 1970]."""
    return to_milliseconds(to_nanoseconds(product["time"].values))


def single(values: Any) -> NDArray[np.float32]:
    """Convert numbers to 32 bits, which halves their size in the page."""
    return np.asarray(values, dtype=np.float32)


def plain_text(value: Any) -> str:
    """Escape a name of the user, because plotly takes labels for HTML."""
    return html.escape(str(value))


def decade_bar(values: Floats) -> dict[str, Any]:
    """Label a colour scale of logarithms with the numbers themselves."""
    shown = values[np.isfinite(values)]
    low, high = (shown.min(), shown.max()) if shown.size else (0.0, 1.0)
    marks = np.array([factor * 10.0**n for n in range(-12, 13) for factor in (1, 2, 5)])
    marks = marks[(np.log10(marks) >= low) & (np.log10(marks) <= high)]
    step = max(1, -(-marks.size // 8))
    return {
        "title": {"text": "deg/h"},
        "tickvals": np.log10(marks[::step]),
        "ticktext": [f"{mark:g}" for mark in marks[::step]],
    }


def stacked_panels(count: int, *, height: int) -> go.Figure:
    """Start a figure with panels below each other on one time axis, each `height` pixels high."""
    axes: dict[str, Any] = {}
    for row in range(count):
        top = 1.0 - row / count
        axes[f"yaxis{row + 1 if row else ''}"] = {
            "domain": [top - 0.78 / count, top - 0.08 / count],
            "tickformat": "~g",
            "nticks": 5,
        }
    return new_chart(
        **axes,
        xaxis={**TIME_AXIS, "anchor": f"y{count if count > 1 else ''}"},
        height=height * count + 70,
        hovermode="x unified",
        hoversubplots="axis",
    )


def label_panel(figure: go.Figure, panel: str, text: str) -> None:
    """Write above the left end of a panel what it shows."""
    place = {"xref": "paper", "x": 0.0, "xanchor": "left", "yref": f"{panel} domain", "y": 1.0}
    figure.add_annotation(text=text, yanchor="bottom", showarrow=False, font_size=12, **place)


def add_channel(
    figure: go.Figure,
    row: int,
    name: str,
    times: Floats,
    channel: xr.DataArray,
    *,
    colour: str,
    **look: Any,
) -> None:
    """Draw a channel over time [ms since 1970] in a panel that shows nothing else."""
    words, unit = name.replace("_", " "), unit_label(channel.attrs.get("units"))
    label_panel(figure, f"y{row + 1}", plain_text(f"{words} {unit}"))
    figure.add_scatter(
        x=times,
        y=single(channel.values),
        yaxis=f"y{row + 1}",
        name=plain_text(words),
        line={"color": colour, "width": 1.5},
        showlegend=False,
        **look,
    )

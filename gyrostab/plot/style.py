"""What the figures share: colours safe for colour-blind readers, unit labels, time axes."""

from __future__ import annotations

import base64
import functools
import io
import os
from collections.abc import Callable, Sequence
from typing import IO, TYPE_CHECKING, Any, ParamSpec

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.errors import OptionError, SchemaError
from gyrostab.units import DAY, HOUR, INNER

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

__all__ = [
    "COLOURS",
    "MARKERS",
    "axis_names",
    "axis_style",
    "duration",
    "embedded",
    "label_log_axis",
    "literal_text",
    "log_edges",
    "new_figure",
    "save_png",
    "shade_spans",
    "stack_panels",
    "time_axis",
    "unit_label",
    "unit_of_time",
    "window_text",
]

P = ParamSpec("P")

#: Palette of Okabe and Ito, without its yellow, which is hard to see in print.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
MARKERS = ("o", "s", "D", "P", "X", "*")
GREY = "#8c8c8c"
_DPI = 110

_LABELS = {
    INNER["rate"]: "deg/h",
    INNER["angle"]: "deg",
    INNER["temperature"]: "°C",
    INNER["rotation_rate"]: "deg/s",
    INNER["magnetic"]: "µT",
    "degree_Celsius hour-1": "°C/h",
    "K hour-1": "°C/h",
}


def unit_label(units: Any) -> str:
    """Spell a unit in the customary way, in brackets; empty for a dimensionless number.

    Examples
    --------
    >>> unit_label("degree hour-1")
    '[deg/h]'
    """
    text = str(units if units is not None else "1")
    return "" if text == "1" else f"[{_LABELS.get(text, text)}]"


def duration(seconds: float) -> str:
    """Format a length of time.

    Examples
    --------
    >>> duration(90.0), duration(0.25), duration(7200)
    ('1.5 min', '0.25 s', '2 h')
    """
    for size, name in ((DAY, "d"), (HOUR, "h"), (60.0, "min")):
        if seconds >= size:
            return f"{seconds / size:.4g} {name}"
    return f"{seconds:.3g} s"


def unit_of_time(seconds: float) -> tuple[float, str]:
    """Choose the largest unit that is at most a third of a length of time: seconds and name.

    Examples
    --------
    >>> unit_of_time(7200.0)
    (60.0, 'min')
    """
    return next(
        (
            (size, name)
            for size, name in ((DAY, "d"), (HOUR, "h"), (60.0, "min"))
            if seconds >= 3 * size
        ),
        (1.0, "s"),
    )


def log_edges(values: NDArray[Any]) -> NDArray[Any]:
    """Find the edges of cells around rising values, half-way between them in the logarithm."""
    logs = np.log(values)
    inner = (logs[1:] + logs[:-1]) / 2
    first, last = (logs[1] - logs[0], logs[-1] - logs[-2]) if values.size > 1 else (1.0, 1.0)
    return np.asarray(np.exp([logs[0] - first / 2, *inner, logs[-1] + last / 2]))


def window_text(product: xr.Dataset) -> str:
    """Describe window and step for a title; empty if the attributes are missing."""
    window, step = product.attrs.get("window_s"), product.attrs.get("step_s")
    return (
        ""
        if window is None or step is None
        else f"windows of {duration(float(window))} every {duration(float(step))}"
    )


def axis_names(dataset: xr.Dataset, axis: str | None) -> list[str]:
    """List the axes to draw; raise `OptionError` if `axis` is not in the data."""
    names = [str(name) for name in dataset["axis"].values]
    if axis is None:
        return names
    if axis not in names:
        raise OptionError(f"axis {axis!r} is not in the data; it has {', '.join(names)}")
    return [axis]


def axis_style(dataset: xr.Dataset, axis: str) -> dict[str, Any]:
    """Choose colour and marker of an axis, the same in every figure."""
    number = [str(name) for name in dataset["axis"].values].index(axis)
    return {"color": COLOURS[number % len(COLOURS)], "marker": MARKERS[number % len(MARKERS)]}


def new_figure(width: float, height: float, *, stacked: bool = False) -> Figure:
    """Make an empty figure [inches] with automatic layout, or for `stack_panels`."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    from gyrostab.plot.notebook import NotebookFigure

    figure = NotebookFigure(
        figsize=(width, height), layout=None if stacked else "constrained", dpi=_DPI
    )
    FigureCanvasAgg(figure)  # attaches to the figure, so that text can be measured
    return figure


def literal_text(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """Decorate a drawing function so that no text of its figure is parsed as mathtext.

    Names and units of a log may hold dollar signs.
    """

    @functools.wraps(draw)
    def draw_literally(*arguments: P.args, **options: P.kwargs) -> Figure:
        figure = draw(*arguments, **options)
        _keep_literal(figure)
        return figure

    return draw_literally


def _keep_literal(artist: Any) -> None:
    """Turn off mathtext for an artist, except for tick labels, which may hold powers of ten."""
    from matplotlib.axis import Axis
    from matplotlib.text import Text

    for child in artist.get_children():
        if isinstance(child, Axis):
            child.label.set_parse_math(False)
            continue
        if isinstance(child, Text):
            child.set_parse_math(False)
        _keep_literal(child)


def stack_panels(
    panels: Sequence[Axes] | NDArray[Any],
    *,
    between: float = 0.13,
    below: float = 0.0,
    right: float = 0.2,
) -> None:
    """Lay out panels in one column, with aligned y labels.

    The margins are known, so only the tick labels are measured; the layout engine of matplotlib
    measures every artist, twice.

    Parameters
    ----------
    panels : sequence of matplotlib.axes.Axes
        All panels of a figure made with ``stacked=True``, with their labels set.
    between : float
        Distance between panels [inches].
    below : float
        Space for a legend under the label of the time axis [inches].
    right : float
        Space to the right of the panels [inches].
    """
    from matplotlib.transforms import ScaledTranslation

    figure: Any = panels[0].figure
    _keep_literal(figure)  # before the labels are measured
    width, height = figure.get_size_inches()
    top, bottom = 0.3 + between, 0.55 + below
    average = (height - top - bottom - between * (len(panels) - 1)) / len(panels)
    figure.subplots_adjust(
        top=1 - top / height,
        bottom=bottom / height,
        right=1 - right / width,
        hspace=between / average,
    )
    renderer = figure.canvas.get_renderer()
    ticks = [
        label.get_window_extent(renderer).width
        for panel in panels
        for label in panel.get_yticklabels(which="both")
        if label.get_text()
    ]
    labels = [panel.yaxis.label.get_window_extent(renderer).width for panel in panels]
    inches = max(ticks, default=0.0) / figure.dpi + 0.14
    figure.subplots_adjust(left=(inches + max(labels) / figure.dpi + 0.1) / width)
    for panel in panels:
        panel.yaxis.set_label_coords(
            0.0,
            0.5,
            transform=panel.transAxes + ScaledTranslation(-inches, 0.0, figure.dpi_scale_trans),
        )


def label_log_axis(axis: Axis, low: float, high: float) -> None:
    """Label a logarithmic axis from `low` to `high` by powers of ten; 1, 2, 5 over a short span."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.set_minor_formatter(NullFormatter())
    if high < 100.0 * low:
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(FuncFormatter(lambda number, _: f"{number:g}"))


def save_png(
    figure: Figure, target: str | os.PathLike[str] | IO[bytes], *, dpi: int = _DPI, colours: int = 0
) -> None:
    """Write a figure as PNG, drawing it once; ``figure.savefig`` draws and lays it out twice.

    Parameters
    ----------
    figure : matplotlib.figure.Figure
        Figure to write.
    target : path-like or binary file
        File to write to.
    dpi : int
        Pixels per inch.
    colours : int
        Largest number of colours, 2 to 256, for a file a third as large; 0 keeps all.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    before = figure.dpi
    drawn: Any = io.BytesIO() if colours else target
    try:
        figure.set_dpi(dpi)
        FigureCanvasAgg(figure).print_png(drawn, pil_kwargs={"compress_level": 3})  # type: ignore[no-untyped-call]
    finally:
        figure.set_dpi(before)
    if colours:
        from PIL import Image

        Image.open(drawn).convert("RGB").quantize(colours).save(target, format="PNG", optimize=True)


def embedded(figure: Figure, alt: str, caption: str) -> dict[str, str]:
    """Prepare a figure for a self-contained page: PNG in base 64, short description, caption."""
    buffer = io.BytesIO()
    save_png(figure, buffer)
    return {
        "png": base64.b64encode(buffer.getvalue()).decode("ascii"),
        "alt": alt,
        "caption": caption,
    }


def time_axis(ax: Axes, times: NDArray[Any]) -> None:
    """Label the time axis with dates and times, as short as is unambiguous."""
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter

    locator = AutoDateLocator(minticks=4, maxticks=9)  # type: ignore[no-untyped-call]
    ax.xaxis.set_major_locator(locator)
    ax.xaxis.set_major_formatter(ConciseDateFormatter(locator))  # type: ignore[no-untyped-call]
    ax.set_xlabel("time (UTC)")
    if times.size > 1:
        ax.set_xlim(times[0], times[-1])


def shade_spans(
    ax: Axes,
    starts: Any,
    ends: Any,
    *,
    label: str | None = None,
    alpha: float = 0.35,
    hatch: str | None = None,
) -> None:
    """Shade the spans from `starts` to `ends` (datetime64) over the full height of the panel."""
    from matplotlib.dates import date2num

    first, last = (np.atleast_1d(date2num(np.asarray(edge))) for edge in (starts, ends))  # type: ignore[no-untyped-call]
    bars = ax.broken_barh(
        list(zip(first, last - first, strict=True)),
        (0.0, 1.0),
        transform=ax.get_xaxis_transform(),
        facecolor=GREY,
        edgecolor="#5a5a5a" if hatch else "none",
        linewidth=0.0,
        alpha=alpha,
        hatch=hatch,
        label=label,
        zorder=0.5,
    )
    bars.set_gid("shaded")


def require_coefficients(product: xr.Dataset) -> None:
    """Raise `SchemaError` if the dataset has no coefficients."""
    if not isinstance(product, xr.Dataset):
        raise SchemaError(
            f"this is a {type(product).__name__}, not a product: give what gyrostab.fit_noise "
            "returns"
        )
    if "observable" not in product.variables:
        raise SchemaError(
            "this surface holds no coefficients yet; call gyrostab.fit_noise (or 'gyrostab fit') "
            "first"
        )

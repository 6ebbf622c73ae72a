"""What the figures share: colours safe for colour-blind readers, unit labels, time axes."""

from __future__ import annotations

import base64
import functools
import io
import os
from collections.abc import Callable
from typing import IO, TYPE_CHECKING, Any, ParamSpec, cast

import numpy as np
import xarray as xr

from gyrostab.arrays import Array
from gyrostab.errors import OptionError
from gyrostab.schema import check_coefficients, require_dataset
from gyrostab.time.durations import format_duration
from gyrostab.units import INNER

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

P = ParamSpec("P")

#: Palette of Okabe and Ito, without its yellow, which is hard to see in print.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
MARKERS = ("o", "s", "D", "P", "X", "*")
GREY = "#8c8c8c"
#: Width of the text of a printed page [mm], the default of every figure. A column has 85 mm.
PAGE_MM = 180.0
INCH_MM = 25.4
NARROW_MM = 120.0
#: Widths that a figure can have [mm]; a narrower one has no room for its labels.
MIN_WIDTH_MM, MAX_WIDTH_MM = 80.0, 1000.0
_DPI = 155
_FONT_POINTS = 8.0
#: Sizes relative to `_FONT_POINTS`, and line widths [points].
_STYLE: dict[Any, Any] = {
    "axes.titlesize": "medium",
    "axes.labelsize": "medium",
    "figure.titlesize": "large",
    "figure.labelsize": "medium",
    "xtick.labelsize": 0.94 * _FONT_POINTS,
    "ytick.labelsize": 0.94 * _FONT_POINTS,
    "legend.fontsize": 0.88 * _FONT_POINTS,
    "axes.linewidth": 0.6,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.minor.width": 0.4,
    "ytick.minor.width": 0.4,
    "grid.linewidth": 0.5,
    "hatch.linewidth": 0.5,
}

_LABELS = {
    INNER["rate"]: "deg/h",
    INNER["angle"]: "deg",
    INNER["temperature"]: "°C",
    INNER["rotation_rate"]: "deg/s",
    INNER["magnetic"]: "µT",
    "degree_Celsius hour-1": "°C/h",
    "K hour-1": "°C/h",
    "urad": "µrad",
    "deg/sqrt(h)": "deg/√h",
    "deg/h^2": "deg/h²",
}


def unit_symbol(units: Any) -> str:
    """Write a unit with symbols, for figures; empty for a dimensionless number.

    Examples
    --------
    >>> unit_symbol("degree hour-1"), unit_symbol("deg/sqrt(h)")
    ('deg/h', 'deg/√h')
    """
    text = str(units if units is not None else "1")
    return "" if text == "1" else _LABELS.get(text, text)


def unit_label(units: Any) -> str:
    """Write a unit with symbols and in brackets; empty for a dimensionless number.

    Examples
    --------
    >>> unit_label("degree hour-1")
    '[deg/h]'
    """
    text = unit_symbol(units)
    return f"[{text}]" if text else ""


def log_edges(values: Array) -> Array:
    """Find the edges of cells around rising values, half-way between them in the logarithm."""
    logs = np.log(values)
    inner = (logs[1:] + logs[:-1]) / 2
    first, last = (logs[1] - logs[0], logs[-1] - logs[-2]) if values.size > 1 else (1.0, 1.0)
    return np.asarray(np.exp([logs[0] - first / 2, *inner, logs[-1] + last / 2]))


def window_text(product: xr.Dataset) -> str:
    """Describe window and step for a title; empty if the attributes are missing."""
    if "window_s" not in product.attrs or "step_s" not in product.attrs:
        return ""
    window, step = (float(product.attrs[name]) for name in ("window_s", "step_s"))
    return f"windows of {format_duration(window, ' ')} every {format_duration(step, ' ')}"


def axis_names(dataset: xr.Dataset, axis: str | None = None) -> list[str]:
    """List the axes to draw; raise `OptionError` if `axis` is not in the data."""
    names = [str(name) for name in dataset["axis"].values]
    if axis is None:
        return names
    if axis not in names:
        raise OptionError(f"axis {axis!r} is not in the data; it has {', '.join(names)}")
    return [axis]


def check_columns(columns: Any) -> None:
    """Raise `OptionError` unless this is a number of columns to which a record is reduced."""
    if not (isinstance(columns, int | np.integer) and columns >= 1):
        raise OptionError(f"columns={columns!r}: give a whole number above 0, for instance 1500")


def axis_style(dataset: xr.Dataset, axis: str) -> dict[str, Any]:
    """Choose colour and marker of an axis: by name if all are x, y or z, else by its place."""
    names = axis_names(dataset)
    number = ("xyz" if {*names} <= {*"xyz"} else names).index(axis)
    return {"color": COLOURS[number % len(COLOURS)], "marker": MARKERS[number % len(MARKERS)]}


def new_figure(width: float, height: float) -> Figure:
    """Make an empty figure [inches] with automatic layout."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    from gyrostab.plot.notebook import NotebookFigure

    figure = NotebookFigure(figsize=(width, height), layout="constrained", dpi=_DPI)
    FigureCanvasAgg(figure)  # attaches to the figure, so that text can be measured
    return figure


def draws_figure(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """Decorate a drawing function: fonts and lines for print, and no text parsed as mathtext.

    Names and units of a log may hold dollar signs. Figures narrower than 120 mm, by the option
    `width` [mm] of the function, have a font of 7 instead of 8 points.
    """

    @functools.wraps(draw)
    def draw_styled(*arguments: P.args, **options: P.kwargs) -> Figure:
        import matplotlib as mpl

        width = cast(float, options.get("width", PAGE_MM))
        is_number = isinstance(width, int | float | np.number)
        if not (is_number and MIN_WIDTH_MM <= width <= MAX_WIDTH_MM):
            raise OptionError(
                f"a figure cannot be {width} mm wide; give --width (width=) from "
                f"{MIN_WIDTH_MM:g} to {MAX_WIDTH_MM:g}, for instance 180 for a page"
            )
        points = _FONT_POINTS if width >= NARROW_MM else _FONT_POINTS - 1.0
        sizes = {
            name: size * points / _FONT_POINTS if name.endswith("size") else size
            for name, size in _STYLE.items()
            if not isinstance(size, str)
        }
        with mpl.rc_context({**_STYLE, **sizes, "font.size": points}):
            figure = draw(*arguments, **options)
            _keep_literal(figure)
        return figure

    return draw_styled


def is_narrow(figure: Any) -> bool:
    """Return whether a figure is made for a column of a page rather than for its whole width."""
    return bool(figure.get_figwidth() < NARROW_MM / INCH_MM)


def title_figure(figure: Figure, *parts: str) -> None:
    """Give a figure its title; a narrow figure has one line per part."""
    figure.suptitle(("\n" if is_narrow(figure) else ", ").join(filter(None, parts)))


def upper_limit_marker() -> Any:
    """Make the marker of an upper limit: a bar with an arrow that points down."""
    from matplotlib.path import Path

    corners = [(-1, 0), (1, 0), (0, 0), (0, -2.2), (-0.6, -1.5), (0, -2.2), (0.6, -1.5)]
    move, line = Path.MOVETO, Path.LINETO
    return Path(corners, [move, line, move, line, move, line, line])


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


def label_log_axis(axis: Axis, low: float, high: float) -> None:
    """Label a logarithmic axis from `low` to `high` with numbers: powers of ten, or also 2 and 5.

    Numbers below 0.001 and above 10 000 are written as powers of ten.
    """
    from matplotlib.ticker import FuncFormatter, LogFormatterMathtext, LogLocator, NullFormatter

    powers = LogFormatterMathtext()
    powers.set_axis(axis)
    short = high < 100.0 * low
    if short:
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    plain = short or (low > 5e-4 and high < 2e4)
    axis.set_major_formatter(
        FuncFormatter(lambda number, place: f"{number:g}" if plain else powers(number, place))
    )
    axis.set_minor_formatter(NullFormatter())


def save_png(
    figure: Figure, target: str | os.PathLike[str] | IO[bytes], *, dpi: int = _DPI, colours: int = 0
) -> None:
    """Write a figure as PNG, drawing it once; ``figure.savefig`` draws and lays it out twice.

    Parameters
    ----------
    colours : int
        Largest number of colours, 2 to 256, for a file a third as large; 0 keeps all.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure_dpi = figure.dpi
    drawn: Any = io.BytesIO() if colours else target
    try:
        figure.set_dpi(dpi)
        FigureCanvasAgg(figure).print_png(drawn, pil_kwargs={"compress_level": 3})  # type: ignore[no-untyped-call]
    finally:
        figure.set_dpi(figure_dpi)
    if colours:
        from PIL import Image

        Image.open(drawn).convert("RGB").quantize(colours).save(target, format="PNG", optimize=True)


def encode_png(figure: Figure) -> str:
    """Return a figure as PNG in base 64, for a self-contained page."""
    buffer = io.BytesIO()
    save_png(figure, buffer)
    return base64.b64encode(buffer.getvalue()).decode("ascii")


def write_in_middle(panel: Axes, text: str) -> None:
    """Write in the middle of an empty panel why it is empty."""
    panel.text(0.5, 0.5, text, transform=panel.transAxes, ha="center", va="center")


def time_axis(ax: Axes, times: Array) -> None:
    """Label the time axis with dates and times, as short as is unambiguous."""
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter

    locator = AutoDateLocator(minticks=3, maxticks=5 if is_narrow(ax.figure) else 9)  # type: ignore[no-untyped-call]
    ax.xaxis.set_major_locator(locator)
    ax.xaxis.set_major_formatter(ConciseDateFormatter(locator))  # type: ignore[no-untyped-call]
    ax.set_xlabel("time (UTC)")
    if times.size > 1:
        ax.set_xlim(times[0], times[-1])


def find_true_runs(mask: Array) -> tuple[Array, Array]:
    """Find the first index of each run of True, and the index after its last."""
    edges = np.flatnonzero(np.diff(mask, prepend=False, append=False))
    return edges[::2], edges[1::2]


def shade_spans(
    ax: Axes, starts: Any, ends: Any, *, label: str | None = None, alpha: float = 0.35
) -> None:
    """Shade the spans from `starts` to `ends` (datetime64) over the full height of the panel."""
    from matplotlib.dates import date2num

    first, last = (np.atleast_1d(date2num(np.asarray(edge))) for edge in (starts, ends))  # type: ignore[no-untyped-call]
    bars = ax.broken_barh(
        list(zip(first, last - first, strict=True)),
        (0.0, 1.0),
        transform=ax.get_xaxis_transform(),
        facecolor=GREY,
        edgecolor="none",
        linewidth=0.0,
        alpha=alpha,
        label=label,
        zorder=0.5,
    )
    bars.set_gid("shaded")


def require_coefficients(product: xr.Dataset) -> None:
    """Raise `SchemaError` if the dataset has no coefficients, whatever the order of its axes."""
    require_dataset(product, "product")
    check_coefficients(product.transpose("axis", "time", ..., missing_dims="ignore"))

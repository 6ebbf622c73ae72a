"""The five noise coefficients over time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from gyrostab.arrays import Array
from gyrostab.noise import LAWS
from gyrostab.plot.style import (
    GREY,
    INCH_MM,
    PAGE_MM,
    axis_names,
    axis_style,
    draws_figure,
    find_true_runs,
    is_narrow,
    label_log_axis,
    new_figure,
    require_coefficients,
    shade_spans,
    time_axis,
    title_figure,
    unit_label,
    upper_limit_marker,
    window_text,
    write_in_middle,
)
from gyrostab.plot.surface import find_time_edges
from gyrostab.schema import NOT_OBSERVABLE, OBSERVED, UPPER_LIMIT_ONLY, split_coefficient, with_axis

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@draws_figure
def plot_coefficients(
    product: xr.Dataset, *, axis: str | None = None, width: float = PAGE_MM
) -> Figure:
    """Draw Q, N, B, K and R over time, one panel per coefficient.

    Bands or bars are standard errors, arrows pointing down are 95 % upper limits. Grey spans are
    those where the coefficient is not observable; darker grey, on more axes. An axis without any
    coefficient is named so in the legend, and leaves the panels of the others white.

    Parameters
    ----------
    product : xarray.Dataset
        Product with coefficients by ``(axis, time)``.
    axis : str, optional
        Draw this axis only.
    width : float
        Width of the figure [mm]: 180 for a page, 85 for a column.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    SchemaError, OptionError
        If `product` has no coefficients or no such axis.

    Examples
    --------
    >>> from gyrostab import davar, fit_noise, make_log
    >>> log = make_log(np.random.default_rng(1).standard_normal(6000), rate=100.0, unit="deg/h")
    >>> len(plot_coefficients(fit_noise(davar(log, window="20s"))).axes)  # Q, N, B, K and R
    5
    """
    product = with_axis(product)
    require_coefficients(product)
    names = axis_names(product, axis)
    figure = new_figure(width / INCH_MM, 7.6)
    panels = figure.subplots(len(LAWS), 1, sharex=True)
    time = product["time"].values
    edges = find_time_edges(time)
    shaded = _axes_to_shade(product, names)
    for panel, (symbol, law) in zip(panels, LAWS.items(), strict=True):
        for name in names:
            _draw_axis(panel, product.sel(axis=name), symbol, name, axis_style(product, name))
            hidden = product["observable"].sel(axis=name, term=symbol).values == NOT_OBSERVABLE
            if hidden.any() and name in shaded:
                first, last = find_true_runs(hidden)
                shade_spans(panel, edges[first], edges[last], alpha=0.6 / len(shaded))
        _set_scale(panel, product, symbol, names)
        panel.set_ylabel(f"{symbol} {unit_label(law.label)}")
        panel.set_title(_title_panel(product, symbol, names), loc="left", pad=3, y=1.0)
        panel.grid(alpha=0.3)
    keys = _legend_handles(product, names, shaded)
    figure.legend(
        handles=keys,
        loc="outside lower center",
        ncols=3 if is_narrow(figure) else len(keys),
        frameon=False,
    )
    whose = f" of axis {names[0]}" if len(names) == 1 else ""
    title_figure(figure, f"Noise coefficients{whose} over time", window_text(product))
    time_axis(panels[-1], edges)
    figure.align_ylabels()
    return figure


def _axes_to_shade(product: xr.Dataset, names: list[str]) -> list[str]:
    """List the axes of which a window observes a term or limits it, or all if there are none."""
    state = product["observable"].sel(axis=names, term=list(LAWS))
    has_any = (state != NOT_OBSERVABLE).any(("time", "term")).values
    return [name for name, is_alive in zip(names, has_any, strict=True) if is_alive] or names


def _title_panel(product: xr.Dataset, symbol: str, names: list[str]) -> str:
    """Name the term, and say so if no window of any axis observes it."""
    state = product["observable"].sel(axis=names, term=symbol).values
    only = UPPER_LIMIT_ONLY in state and OBSERVED not in state
    return f"{LAWS[symbol].name}: upper limits only" if only else LAWS[symbol].name


def _draw_axis(
    panel: Axes, part: xr.Dataset, symbol: str, name: str, style: dict[str, Any]
) -> None:
    time = part["time"].values
    value, upper = split_coefficient(part, symbol)
    error = part[f"{symbol}_stderr"].values
    few = time.size <= 80
    marks = style | {"markersize": 3.5 if few else 2.5, "linewidth": 1.0}
    panel.plot(time, value, **(marks if few else marks | {"marker": ""}), label=name)
    if not few:  # a single point does not make a line
        first, end = find_true_runs(np.isfinite(value))
        single = first[end - first == 1]
        panel.plot(time[single], value[single], **marks | {"linestyle": "none", "markersize": 2.0})
    if few:
        panel.errorbar(
            time,
            value,
            yerr=np.nan_to_num(error),
            fmt="none",
            ecolor=style["color"],
            elinewidth=0.9,
            alpha=0.7,
        )
    else:
        panel.fill_between(
            time, value - error, value + error, color=style["color"], alpha=0.25, linewidth=0
        )
    marked = np.flatnonzero(np.isfinite(upper))
    marked = marked[:: max(1, marked.size // 150)]
    limits = panel.scatter(
        time[marked],
        upper[marked],
        marker=upper_limit_marker(),
        s=55,
        facecolors="none",
        edgecolors=style["color"],
        linewidths=0.7,
    )
    limits.set_gid(f"upper {symbol} {name}")


def _set_scale(panel: Axes, product: xr.Dataset, symbol: str, names: list[str]) -> None:
    """Use a log scale if the values span more than a decade, else a linear one from zero."""
    numbers = find_shown_values(product.sel(axis=names), symbol)
    if numbers.size and numbers.max() > 10 * numbers.min():
        panel.set_yscale("log")
        panel.set_ylim(numbers.min() / 1.5, numbers.max() * 1.5)
        label_log_axis(panel.yaxis, numbers.min(), numbers.max())
    elif numbers.size:
        panel.set_ylim(0.0, numbers.max() * 1.15)
    else:
        panel.set_yticks([])
        write_in_middle(panel, "not observable in any window")


def find_shown_values(product: xr.Dataset, symbol: str) -> Array:
    """Find the values and upper limits of a term that figures show, if they are above zero."""
    numbers = np.stack(split_coefficient(product, symbol))
    return np.asarray(numbers[np.isfinite(numbers) & (numbers > 0)])


def _legend_handles(product: xr.Dataset, names: list[str], shaded: list[str]) -> list[Any]:
    """List the axes, and of the other marks those that a panel shows."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    keys: list[Any] = [
        Line2D(
            [],
            [],
            **axis_style(product, name),
            label=f"axis {name}" + ": not observable" * (name not in shaded),
            markersize=4.0,
        )
        for name in names
    ]
    state = product["observable"].sel(axis=names, term=list(LAWS)).values
    mark: dict[str, Any] = {"color": "black", "linestyle": "none", "markersize": 9.0}
    if (state == OBSERVED).any():
        keys.append(Line2D([], [], **mark, marker="|", label="standard error"))
    if (state == UPPER_LIMIT_ONLY).any():
        limit = {"marker": upper_limit_marker(), "markerfacecolor": "none"}
        keys.append(Line2D([], [], **mark, **limit, label="95 % upper limit"))
    if (product["observable"].sel(axis=shaded, term=list(LAWS)) == NOT_OBSERVABLE).any():
        keys.append(Patch(facecolor=GREY, alpha=0.5, label="not observable"))
    return keys

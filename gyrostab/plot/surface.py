"""The dynamic Allan deviation as heat map and three-dimensional surface."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import xarray as xr

from gyrostab.allan.variance import variance_name
from gyrostab.arrays import Array
from gyrostab.errors import OptionError
from gyrostab.plot.style import (
    INCH_MM,
    PAGE_MM,
    axis_names,
    check_columns,
    draws_figure,
    is_narrow,
    label_log_axis,
    log_edges,
    new_figure,
    time_axis,
    title_figure,
    window_text,
)
from gyrostab.schema import ESTIMATORS, check_surface, with_axis
from gyrostab.time.durations import largest_unit
from gyrostab.time.stamps import to_nanoseconds

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import QuadMesh
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

CMAP = "viridis"
CHANGE_CMAP = "PuOr_r"  # safe for colour-blind readers, white where nothing changes
#: Look of cells without an estimate.
_EMPTY: dict[str, Any] = {"facecolor": "#d0d0d0", "edgecolor": "#909090", "hatch": "////"}
_WEIGHTED = ESTIMATORS.index("weighted_clusters")


@draws_figure
def plot_davar(
    product: xr.Dataset,
    *,
    axis: str | None = None,
    relative: bool = False,
    columns: int = 1500,
    width: float = PAGE_MM,
) -> Figure:
    """Draw the Allan deviation as colour over time and averaging time, one panel per axis.

    Cells without an estimate are hatched grey; cells estimated from incomplete clusters are marked
    with white dots.

    Parameters
    ----------
    product : xarray.Dataset
        Surface or product, ``avar`` [degree2 hour-2] with dims ``(axis, time, tau)``.
    axis : str, optional
        Draw this axis only.
    relative : bool
        Draw the ratio to the median over time at each averaging time, to show changes.
    columns : int
        Largest number of columns; if there are more windows, neighbouring windows are averaged in
        Allan variance.
    width : float
        Width of the figure [mm]: 180 for a page, 85 for a column.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    SchemaError, OptionError
        If `product` is not a surface or has no such axis, or `columns` is less than 1.

    Examples
    --------
    >>> from gyrostab import davar, make_log
    >>> log = make_log(np.random.default_rng(1).standard_normal(6000), rate=100.0, unit="deg/h")
    >>> len(plot_davar(davar(log, window="20s")).axes)  # one axis and the colour bar
    2
    """
    product = with_axis(product)
    check_surface(product)
    from matplotlib.colors import LogNorm

    names = axis_names(product, axis)
    figure = new_figure(width / INCH_MM, 1.1 + 1.9 * len(names))
    panels = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    time, tau = product["time"].values, product["tau"].values
    cells, merged = _merge_windows(product, names, columns)
    time_edges = find_time_edges(time, merged, product.attrs.get("step_s"))
    tau_edges = log_edges(tau)
    if relative:
        cells = [(_divide_by_median(deviation), weighted) for deviation, weighted in cells]
    norm = LogNorm(*_colour_limits([deviation for deviation, _ in cells], relative=relative))
    for panel, name, (deviation, weighted) in zip(panels, names, cells, strict=True):
        mesh = _draw_cells(panel, time_edges, tau_edges, deviation, norm, relative=relative)
        _mark_weighted(panel, time_edges, tau, weighted)
        panel.set_yscale("log", subs=(2, 5))
        label_log_axis(panel.yaxis, tau[0], tau[-1])
        panel.set_ylabel(f"axis {name}\naveraging time τ [s]")
    kind = f"{variance_name(product)} deviation"
    label = "σ(τ) / its median over time" if relative else f"{kind} σ(τ) [deg/h]"
    if handles := _cell_handles(cells):
        figure.legend(
            handles=handles,
            loc="outside lower left",
            ncols=1 if is_narrow(figure) else 2,
            frameon=False,
        )
    title_figure(
        figure,
        f"{'Change of the dynamic' if relative else 'Dynamic'} {kind}",
        window_text(product),
        f"{merged} windows averaged per column" if merged > 1 else "",
    )
    time_axis(panels[-1], time_edges)
    figure.align_ylabels(panels)
    bar = figure.colorbar(
        mesh, ax=panels, label=label, extend="both", fraction=0.08, pad=0.01, aspect=12 * len(names)
    )
    _label_colours(bar, relative=relative)
    return figure


@draws_figure
def plot_davar_3d(
    product: xr.Dataset, *, axis: str | None = None, columns: int = 120, width: float = PAGE_MM
) -> Figure:
    """Draw the Allan deviation of one axis as a surface over time and log averaging time.

    Parameters
    ----------
    product : xarray.Dataset
        Surface or product.
    axis : str, optional
        Axis to draw; the first by default.
    columns : int
        Largest number of windows to draw; more are averaged in Allan variance.
    width : float
        Width of the figure [mm]: 180 for a page, 85 for a column.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    SchemaError, OptionError
        If `product` is not a surface or has no such axis, or `columns` is less than 1.

    Examples
    --------
    >>> from gyrostab import davar, make_log
    >>> log = make_log(np.random.default_rng(1).standard_normal(6000), rate=100.0, unit="deg/h")
    >>> len(plot_davar_3d(davar(log, window="20s")).axes)
    1
    """
    product = with_axis(product)
    check_surface(product)
    from matplotlib.ticker import FuncFormatter, MaxNLocator

    name = axis_names(product, axis)[0]
    if min(product.sizes["time"], product.sizes["tau"]) < 2:
        raise OptionError(
            "a surface needs at least two windows and two averaging times; draw this product with "
            "plot_adev"
        )
    ((deviation, _),), merged = _merge_windows(product, [name], columns)
    time = product["time"].values
    seconds = (time[::merged] - time[0]) / np.timedelta64(1, "s")
    size, unit = largest_unit(seconds[-1] / 3)
    figure = new_figure(width / INCH_MM, 0.8 + 0.6 * width / INCH_MM)
    panel: Any = figure.add_subplot(projection="3d")
    x, y = np.meshgrid(seconds / size, np.log10(product["tau"].values), indexing="ij")
    with np.errstate(divide="ignore"):
        z = np.log10(np.where(deviation > 0, deviation, np.nan))
    panel.plot_surface(
        x,
        y,
        z,
        cmap=CMAP,
        rcount=columns,
        ccount=60,
        linewidth=0.15,
        edgecolor="#222222",
        antialiased=True,
    )
    begin = str(np.datetime_as_string(time[0], unit="s")).replace("T", " ")
    narrow = is_narrow(figure)
    panel.set_xlabel(f"time [{unit}]" if narrow else f"time since {begin} [{unit}]")
    panel.set_ylabel("τ [s]" if narrow else "averaging time τ [s]")
    panel.set_zlabel("σ [deg/h]" if narrow else f"{variance_name(product)} deviation σ [deg/h]")
    for scale in (panel.yaxis, panel.zaxis):
        scale.set_major_locator(MaxNLocator(nbins=3 if narrow else 6, integer=True))
        scale.set_major_formatter(FuncFormatter(lambda power, _: f"{10.0**power:g}"))
    # the steep side of short averaging times goes to the back, where it hides nothing
    panel.invert_yaxis()
    panel.view_init(elev=30, azim=-62)
    panel.set_box_aspect((1.5, 1.15, 0.85), zoom=0.9 if narrow else 1.0)
    panel.tick_params(pad=-2 if narrow else 2)
    title_figure(
        figure, f"Dynamic {variance_name(product)} deviation of axis {name}", window_text(product)
    )
    return figure


def _merge_windows(
    product: xr.Dataset, names: list[str], columns: int
) -> tuple[list[tuple[Array, Array]], int]:
    """Average windows to at most `columns`, and count the windows per column.

    The cells of an axis are the Allan deviation and the mask of weighted cells, shape (time, tau).
    """
    check_columns(columns)
    merged = max(1, -(-product.sizes["time"] // columns))
    part = product[["avar", "estimator"]].sel(axis=names).drop_vars("time").compute()
    is_weighted = (part["estimator"] == _WEIGHTED).astype(np.float64)
    avar = part["avar"].astype(np.float64).coarsen(time=merged, boundary="pad").mean().values
    weighted = is_weighted.coarsen(time=merged, boundary="pad").max().values > 0.0
    # the published recursion drifts below zero where there is almost no noise
    deviation = np.sqrt(np.where(avar >= 0.0, avar, np.nan))
    return list(zip(deviation, weighted & np.isfinite(deviation), strict=True)), merged


def _draw_cells(
    panel: Axes,
    time_edges: Array,
    tau_edges: Array,
    deviation: Array,
    norm: Normalize,
    *,
    relative: bool,
) -> QuadMesh:
    """Draw the cells of one axis as colours, on a hatched background."""
    panel.set_facecolor(_EMPTY["facecolor"])
    panel.patch.set_hatch(_EMPTY["hatch"])
    panel.patch.set_edgecolor(_EMPTY["edgecolor"])
    shown = np.ma.masked_invalid(np.where(deviation > 0, deviation, np.nan))
    return panel.pcolormesh(
        time_edges,
        tau_edges,
        shown.T,
        norm=norm,
        cmap=CHANGE_CMAP if relative else CMAP,
        rasterized=True,
    )


def _cell_handles(cells: list[tuple[Array, Array]]) -> list[Any]:
    """List the legend's handles of empty and of weighted cells, where there are any."""
    from matplotlib.patches import Patch

    handles: list[Any] = []
    if any(not (deviation > 0).all() for deviation, _ in cells):
        handles.append(Patch(**_EMPTY, label="no estimate (gap, or too few terms)"))
    if any(weighted.any() for _, weighted in cells):
        handles.append(_dot_handle())
    return handles


def _divide_by_median(deviation: Array) -> Array:
    """Divide by the median over time; NaN where that is zero, as for a constant signal."""
    cells = pd.DataFrame(deviation)
    median = cells.median()
    return (cells / median.where(median > 0.0)).to_numpy()


def _colour_limits(values: list[Array], *, relative: bool) -> tuple[float, float]:
    finite = np.concatenate([value[np.isfinite(value) & (value > 0)] for value in values])
    if not finite.size:
        return (0.5, 2.0)
    low, high = np.quantile(finite, [0.001, 0.999])
    if relative:
        reach = float(max(1.25, high, 1.0 / low))
        return (1.0 / reach, reach)
    return (float(low), float(high if high > low else 1.001 * low))


def _label_colours(bar: Any, *, relative: bool) -> None:
    """Label the colour bar with numbers; one of ratios with round ones."""
    low, high = bar.mappable.get_clim()
    label_log_axis(bar.ax.yaxis, low, high)
    if relative:
        ticks = [
            tick
            for tick in (0.1, 0.2, 0.33, 0.5, 0.67, 0.8, 1.0, 1.25, 1.5, 2.0, 3.0, 5.0, 10.0)
            if low <= tick <= high
        ]
        bar.set_ticks(ticks, labels=[f"{tick:g}" for tick in ticks])
        bar.minorticks_off()


def find_time_edges(time: Array, merged: int = 1, step: Any = None) -> Array:
    """Find the edges of the columns, half-way between window centres."""
    stamps = to_nanoseconds(time)
    half = (
        int(float(step) * 5e8)
        if step is not None
        else int(np.median(np.diff(stamps)) // 2)
        if stamps.size > 1
        else 5 * 10**8
    )
    inner = [
        stamps[i - 1] + (stamps[i] - stamps[i - 1]) // 2 for i in range(merged, stamps.size, merged)
    ]
    return np.array([stamps[0] - half, *inner, stamps[-1] + half]).astype("datetime64[ns]")


def _mark_weighted(panel: Axes, time_edges: Array, tau: Array, weighted: Array) -> None:
    """Mark weighted cells with dots, thinned so that they stay distinguishable."""
    max_columns = 30 if is_narrow(panel.figure) else 60
    columns = np.arange(0, weighted.shape[0], -(-weighted.shape[0] // max_columns))
    rows = np.arange(0, weighted.shape[1], max(1, weighted.shape[1] // 12))
    chosen = np.zeros_like(weighted)
    chosen[np.ix_(columns, rows)] = True
    where = np.argwhere(weighted & chosen)
    if not where.size and weighted.any():
        where = np.argwhere(weighted)[:: max(1, int(weighted.sum()) // 500)]
    if where.size:
        centres = time_edges[:-1] + (time_edges[1:] - time_edges[:-1]) // 2
        dots = panel.scatter(
            centres[where[:, 0]],
            tau[where[:, 1]],
            s=4,
            color="white",
            edgecolors="black",
            linewidths=0.3,
        )
        dots.set_gid("weighted")


def _dot_handle() -> Any:
    from matplotlib.lines import Line2D

    style = {
        "marker": "o",
        "markersize": 4.0,
        "markerfacecolor": "white",
        "markeredgecolor": "black",
        "linestyle": "none",
    }
    return Line2D([], [], **style, label="estimated from incomplete (weighted) clusters")  # type: ignore[arg-type]

"""Plot a diagnosis: the recording and both simulations side by side, with the mismatches."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.noise import NORMAL_95
from gyrostab.plot.style import (
    COLOURS,
    GREY,
    INCH_MM,
    PAGE_MM,
    axis_names,
    draws_figure,
    label_log_axis,
    log_edges,
    new_figure,
    unit_label,
    unit_of_time,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
_TITLES = {"recording": "Recording", "before": "Simulation before", "after": "Simulation after"}
_STYLES: dict[str, dict[str, Any]] = {
    "recording": {"color": "black", "lw": 0.0, "marker": "o", "ms": 3.0},
    # dashed and on top, so that it shows where both coincide
    "before": {"color": COLOURS[1], "lw": 1.6, "ls": "--", "zorder": 3},
    "after": {"color": COLOURS[0], "lw": 1.6, "zorder": 2.5},
}
MAX_CHANNELS = 3  # panels below the means
INSIDE_BAND_OPACITY = 0.3  # of cells inside the 95 % band
MIN_FRAME_SHARE = 0.012  # width of a frame, as a share of the panel
_RED = "#D00000"


def find_regions(
    content: Mapping[str, Any], axis: str, *, over_tau: bool
) -> list[Mapping[str, Any]]:
    """Find the mismatches of an axis over averaging times, or those of its mean rate."""
    views = ("davar", "cross_axis") if over_tau else ("mean", "restart")
    regions = [region for region in content["mismatches"] if axis in region["axes"]]
    regions = [region for region in regions if region["view"] in views]
    return [region for region in regions if not over_tau or region["tau_min_s"]]


def find_change(surfaces: xr.Dataset, case: str) -> tuple[Array, Array]:
    """Divide the Allan deviation of the recording by that of a simulation, (axis, window, tau).

    The second array is the opacity of each cell, less inside the 95 % band of the simulation.
    """
    names = ["avar", "avar_low", "avar_high"]
    cells = surfaces[names].transpose("case", "axis", "window", "tau")
    recording = cells["avar"].sel(case="recording").values
    avar, low, high = (cells[name].sel(case=case).values for name in names)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.sqrt(recording / avar)
        is_usual = (recording >= low) & (recording <= high)
    return ratio, np.where(is_usual, INSIDE_BAND_OPACITY, 1.0)


def select_channels(surfaces: xr.Dataset, content: Mapping[str, Any]) -> list[str]:
    """Return the channels to draw: first those that named effects follow."""
    available = [
        str(name).removeprefix("channel_")
        for name in surfaces.data_vars
        if str(name).startswith("channel_")
    ]
    available = [
        name for name in available if np.isfinite(surfaces[f"channel_{name}"].values).any()
    ]
    named = [
        name.strip()
        for effect in content["effects"]
        for name in str(effect["driver"] or "").split(",")
    ]
    usual = [name for name in ("temperature", "vibration", "rotation_rate") if name in available]
    first = [name for name in dict.fromkeys(named) if name in available]
    return list(dict.fromkeys([*first, *usual]))[:MAX_CHANNELS]


def _window_edges(begin: Array, end: Array) -> Array:
    """Return the edges of windows that may overlap: halfway between their centres."""
    centre = (begin + end) / 2.0
    if centre.size == 1:
        return np.array([begin[0], end[0]])
    inner = (centre[1:] + centre[:-1]) / 2.0
    return np.concatenate([[begin[0]], inner, [end[-1]]])


def _find_span(
    region: Mapping[str, Any], content: Mapping[str, Any], size: float
) -> tuple[float, float]:
    """Find begin and end of a mismatch since the start of the recording, in units of `size` [s]."""
    start, *ends = (
        np.datetime64(text.removesuffix("Z"), "ns")
        for text in (content["recording"]["start"], region["start"], region["end"])
    )
    begin, end = (float((stamp - start) / np.timedelta64(1, "s")) / size for stamp in ends)
    return begin, end


def _number_mismatch(panel: Axes, region: Mapping[str, Any], place: Any, **options: Any) -> None:
    """Write the number of a mismatch below and to the right of a place, white on red."""
    panel.annotate(
        str(region["id"]),
        place,
        (2, -2),
        textcoords="offset points",
        va="top",
        ha="left",
        fontsize="small",
        color="white",
        weight="bold",
        bbox={"facecolor": _RED, "edgecolor": "none", "pad": 1.2},
        **options,
    )


def _frame_mismatches(
    panel: Axes, axis: str, content: Mapping[str, Any], size: float, *, taus: Array, faint: bool
) -> None:
    """Frame the mismatches of an axis that have averaging times."""
    from matplotlib.patches import Rectangle

    low_edge, high_edge = log_edges(taus)[[0, -1]]
    left, right = panel.get_xlim()
    for region in find_regions(content, axis, over_tau=True):
        begin, end = _find_span(region, content, size)
        min_width = MIN_FRAME_SHARE * (right - left)
        if end - begin < min_width:
            begin, end = (begin + end - min_width) / 2.0, (begin + end + min_width) / 2.0
        low = max(region["tau_min_s"] / 1.3, low_edge)
        high = min(region["tau_max_s"] * 1.3, high_edge)
        if high <= low:
            continue
        style = {
            "fill": False,
            "edgecolor": _RED,
            "linewidth": 1.0 if faint else 2.0,
            "linestyle": ":" if faint else "-",
        }
        panel.add_patch(Rectangle((begin, low), end - begin, high - low, **style))  # type: ignore[arg-type]
        if not faint:
            _number_mismatch(panel, region, (begin, high))


def _draw_maps(
    surfaces: xr.Dataset,
    content: Mapping[str, Any],
    columns: Sequence[tuple[str, Array, Any]],
    norm: Any,
    cmap: str,
    label: str,
) -> Figure:
    """Draw one row of maps per axis.

    `columns` are titles, values by (axis, window, tau), and the opacity of each cell, or None.
    """
    from matplotlib.cm import ScalarMappable

    names, tau = axis_names(surfaces), surfaces["tau"].values
    begin, end = surfaces["begin"].values, surfaces["end"].values
    size, unit = unit_of_time(float(end[-1]))
    figure = new_figure(PAGE_MM / INCH_MM, 0.5 + 1.6 * len(names))
    panels = figure.subplots(len(names), len(columns), sharex=True, sharey=True, squeeze=False)
    for row, name in enumerate(names):
        for column, (title, values, opacity) in enumerate(columns):
            panel = panels[row, column]
            edges = _window_edges(begin, end) / size, log_edges(tau)
            missing = np.ma.masked_where(np.isfinite(values[row]), np.full(values[row].shape, 0.2))
            panel.pcolormesh(*edges, missing.T, cmap="Greys", vmin=0.0, vmax=1.0, rasterized=True)
            alpha = (
                None if opacity is None else np.where(np.isfinite(values[row]), opacity[row], 0.0).T
            )
            shown = np.ma.masked_invalid(values[row])
            panel.pcolormesh(*edges, shown.T, norm=norm, cmap=cmap, rasterized=True, alpha=alpha)
            panel.set_yscale("log")
            panel.set_xlim(begin[0] / size, end[-1] / size)
            panel.set_ylim(*log_edges(tau)[[0, -1]])
            _frame_mismatches(panel, name, content, size, taus=tau, faint=column > 0)
            if row == 0:
                panel.set_title(title)
            if column == 0:
                panel.set_ylabel(f"axis {name}")
    label_log_axis(panels[0, 0].yaxis, tau[0], tau[-1])
    bar = ScalarMappable(norm, cmap)  # the maps may be partly transparent
    scale = figure.colorbar(bar, ax=panels, label=label, aspect=12 * panels.size, pad=0.02)
    figure.supylabel("averaging time τ [s]")
    figure.supxlabel(f"time since the start [{unit}]")
    label_log_axis(scale.ax.yaxis, norm.vmin, norm.vmax)
    return figure


@draws_figure
def plot_surfaces(surfaces: xr.Dataset, content: Mapping[str, Any]) -> Figure:
    """Draw the Allan deviation over time and averaging time, of the recording and both simulations.

    Parameters
    ----------
    surfaces : xarray.Dataset
        From `gyrostab.diagnose.result.surfaces`: ``avar(case, axis, window, tau)``
        [degree2 hour-2].
    content : mapping
        Contents of `diagnosis.json`; its mismatches are framed.
    """
    from matplotlib.colors import LogNorm

    deviation = np.sqrt(surfaces["avar"].transpose("case", "axis", "window", "tau").values)
    positive = deviation[np.isfinite(deviation) & (deviation > 0)]
    norm = LogNorm(*(np.quantile(positive, [0.005, 0.995]) if positive.size else (0.1, 1.0)))
    cases = [str(name) for name in surfaces["case"].values]
    columns = [
        (_TITLES.get(name, name), deviation[place], None) for place, name in enumerate(cases)
    ]
    return _draw_maps(surfaces, content, columns, norm, "viridis", "Allan deviation σ(τ) [deg/h]")


@draws_figure
def plot_change(surfaces: xr.Dataset, content: Mapping[str, Any]) -> Figure:
    """Draw the Allan deviation of the recording over that of the simulations before and after."""
    from matplotlib.colors import LogNorm
    from matplotlib.ticker import FixedLocator, NullFormatter

    columns = [
        (f"Recording over simulation {word} effects", *find_change(surfaces, case))
        for case, word in (("before", "without"), ("after", "with"))
    ]
    figure = _draw_maps(
        surfaces, content, columns, LogNorm(0.5, 2.0), "PuOr_r", "ratio of Allan deviations"
    )
    bar = figure.axes[-1]
    bar.yaxis.set_major_locator(FixedLocator([0.5, 0.7, 1.0, 1.4, 2.0]))
    bar.set_yticklabels(["≤ 0.5", "0.7", "1", "1.4", "≥ 2"])
    bar.yaxis.set_minor_formatter(NullFormatter())
    return figure


@draws_figure
def plot_means(surfaces: xr.Dataset, content: Mapping[str, Any]) -> Figure:
    """Draw the mean rate over time with the simulations, and the channels below.

    Parameters
    ----------
    surfaces : xarray.Dataset
        ``mean``, ``mean_stderr`` (case, axis, window), ``block_mean(axis, block)`` [degree hour-1]
        and the ``channel_<name>(block)``.
    content : mapping
        Contents of `diagnosis.json`.
    """
    names = axis_names(surfaces)
    channels = select_channels(surfaces, content)
    size, unit = unit_of_time(float(surfaces["end"].values[-1]))
    time = (surfaces["begin"].values + surfaces["end"].values) / (2.0 * size)
    block = (surfaces["block_begin"].values + surfaces["block_end"].values) / (2.0 * size)
    ratios = [1.9] * len(names) + [1.3] * len(channels)
    figure = new_figure(PAGE_MM / INCH_MM, 0.7 + 0.75 * sum(ratios))
    panels = figure.subplots(
        len(ratios), 1, sharex=True, squeeze=False, gridspec_kw={"height_ratios": ratios}
    )[:, 0]
    for panel, name in zip(panels, names, strict=False):
        part = surfaces.sel(axis=name)
        single = part["block_mean"].values
        panel.plot(block, single, ".", color=GREY, ms=2.5, label="recording, blocks")
        panel.plot(
            time,
            part["mean"].sel(case="recording").values,
            color="black",
            lw=1.2,
            label="recording, windows",
        )
        for case in ("before", "after"):
            mean = part["mean"].sel(case=case).values
            error = part["mean_stderr"].sel(case=case).values
            panel.plot(time, mean, **_STYLES[case], label=f"{_TITLES[case].lower()}, 95 %")
            panel.fill_between(
                time,
                mean - NORMAL_95 * error,
                mean + NORMAL_95 * error,
                color=_STYLES[case]["color"],
                alpha=0.18,
                lw=0,
            )
        _mark_spans(panel, name, content, size)
        panel.set_ylabel(f"axis {name}\nmean rate [deg/h]")
        panel.margins(x=0)
        _limit_to_middle(panel, single)
    for panel, channel in zip(panels[len(names) :], channels, strict=True):
        panel.plot(block, surfaces[f"channel_{channel}"].values, color=COLOURS[2], lw=1.2)
        unit_text = unit_label(surfaces[f"channel_{channel}"].attrs.get("units"))
        panel.set_ylabel(f"{channel.replace('_', ' ')}\n{unit_text}")
    panels[-1].set_xlabel(f"time since the start [{unit}]")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(
        handles,
        labels,
        loc="outside upper center",
        ncols=4,
        frameon=False,
    )
    return figure


def _limit_to_middle(panel: Axes, values: Array) -> None:
    """Show the middle 99 % of the block means, so that an outlier does not flatten the rest."""
    good = values[np.isfinite(values)]
    if good.size > 20:
        low, high = np.quantile(good, [0.005, 0.995])
        panel.set_ylim(low - 0.25 * (high - low) - 1e-12, high + 0.25 * (high - low) + 1e-12)


def _mark_spans(panel: Axes, axis: str, content: Mapping[str, Any], size: float) -> None:
    for region in find_regions(content, axis, over_tau=False):
        begin, end = _find_span(region, content, size)
        panel.axvspan(begin, end, color=_RED, alpha=0.05, lw=0)
        panel.axvspan(begin, end, ymin=0.96, color=_RED, lw=0)
        _number_mismatch(panel, region, (begin, 1.0), xycoords=panel.get_xaxis_transform())


def _draw_cases(
    surfaces: xr.Dataset,
    draw_axis: Callable[[Axes, str], None],
    *,
    xlabel: str,
    ylabel: str,
) -> Figure:
    """Draw one panel per axis, side by side."""
    figure, names = new_figure(PAGE_MM / INCH_MM, 2.6), axis_names(surfaces)
    panels = figure.subplots(1, len(names), sharex=True, sharey=True, squeeze=False)[0]
    for panel, name in zip(panels, names, strict=True):
        draw_axis(panel, name)
        panel.set(xscale="log", yscale="log", title=f"axis {name}")
        panel.grid(True, which="major", alpha=0.4)
        label_log_axis(panel.xaxis, *panel.get_xlim())
    figure.supxlabel(xlabel)
    figure.supylabel(ylabel)
    panels[0].legend(frameon=False)
    label_log_axis(panels[0].yaxis, *panels[0].get_ylim())
    return figure


@draws_figure
def plot_deviations(surfaces: xr.Dataset) -> Figure:
    """Draw the Allan deviation of the whole record, one panel per axis."""
    tau = surfaces["tau"].values
    with np.errstate(invalid="ignore"):
        deviation = surfaces["avar"].mean("window", skipna=True) ** 0.5

    def draw_axis(panel: Axes, name: str) -> None:
        for case, style in _STYLES.items():
            values = deviation.sel(axis=name, case=case).values
            panel.plot(tau, values, **style, label=_TITLES[case].lower())

    labels = {"xlabel": "averaging time τ [s]", "ylabel": "Allan deviation σ(τ) [deg/h]"}
    return _draw_cases(surfaces, draw_axis, **labels)


@draws_figure
def plot_spectra(surfaces: xr.Dataset) -> Figure:
    """Draw the power spectrum of the whole record, one panel per axis.

    Parameters
    ----------
    surfaces : xarray.Dataset
        ``density(case, axis, band)`` over ``frequency`` [Hz] and ``line_density(axis, line)`` over
        ``line_frequency``, two-sided [degree2 hour-2 Hz-1].
    """
    frequency, lines = surfaces["frequency"].values, surfaces["line_density"]

    def draw_axis(panel: Axes, name: str) -> None:
        narrow = surfaces["line_frequency"].values, lines.sel(axis=name).values
        panel.plot(*narrow, color=GREY, lw=0.6, label="recording")
        for case in ("before", "after"):
            values = surfaces["density"].sel(axis=name, case=case).values
            panel.plot(frequency, values, **_STYLES[case], label=_TITLES[case].lower())

    labels = {"xlabel": "frequency [Hz]", "ylabel": "power density [(deg/h)²/Hz]"}
    return _draw_cases(surfaces, draw_axis, **labels)

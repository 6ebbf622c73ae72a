"""Plot a diagnosis: the recording and both simulations side by side, with the mismatches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.noise import NORMAL_95
from gyrostab.plot.style import (
    COLOURS,
    GREY,
    label_log_axis,
    literal_text,
    log_edges,
    new_figure,
    unit_label,
    unit_of_time,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = [
    "plot_change",
    "plot_deviations",
    "plot_means",
    "plot_spectra",
    "plot_surfaces",
    "select_channels",
]

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


def _window_edges(begin: Array, end: Array) -> Array:
    """Return the edges of windows that may overlap: halfway between their centres."""
    centre = (begin + end) / 2.0
    if centre.size == 1:
        return np.array([begin[0], end[0]])
    inner = (centre[1:] + centre[:-1]) / 2.0
    return np.concatenate([[begin[0]], inner, [end[-1]]])


def _seconds_since(text: str, start: str) -> float:
    return float(
        (np.datetime64(text.removesuffix("Z"), "ns") - np.datetime64(start.removesuffix("Z"), "ns"))
        / np.timedelta64(1, "s")
    )


def _frame_mismatches(
    panel: Axes, axis: str, content: Mapping[str, Any], size: float, *, taus: Array, faint: bool
) -> None:
    """Frame the mismatches of an axis that have averaging times."""
    from matplotlib.patches import Rectangle

    start = content["recording"]["start"]
    low_edge, high_edge = log_edges(taus)[[0, -1]]
    left, right = panel.get_xlim()
    for region in content["mismatches"]:
        if (
            axis not in region["axes"]
            or region["view"] not in ("davar", "cross_axis")
            or not region["tau_min_s"]
        ):
            continue
        begin, end = (
            _seconds_since(region["start"], start) / size,
            _seconds_since(region["end"], start) / size,
        )
        least = MIN_FRAME_SHARE * (right - left)
        if end - begin < least:
            begin, end = (begin + end - least) / 2.0, (begin + end + least) / 2.0
        low, high = (
            max(region["tau_min_s"] / 1.3, low_edge),
            min(region["tau_max_s"] * 1.3, high_edge),
        )
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
            panel.annotate(
                str(region["id"]),
                (begin, high),
                (2, -2),
                textcoords="offset points",
                va="top",
                ha="left",
                fontsize=9,
                color="white",
                weight="bold",
                bbox={"facecolor": _RED, "edgecolor": "none", "pad": 1.2},
            )


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

    names, tau = [str(name) for name in surfaces["axis"].values], surfaces["tau"].values
    begin, end = surfaces["begin"].values, surfaces["end"].values
    size, unit = unit_of_time(float(end[-1]))
    height = 1.1 + 2.3 * len(names)
    figure = new_figure(12.0, height, stacked=True)
    figure.subplots_adjust(
        left=0.075,
        right=0.9,
        top=1.0 - 0.35 / height,
        bottom=0.6 / height,
        wspace=0.06,
        hspace=0.08,
    )
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
                panel.set_ylabel(f"axis {name}\naveraging time [s]")
            if row == len(names) - 1:
                panel.set_xlabel(f"time since the start [{unit}]")
    label_log_axis(panels[0, 0].yaxis, tau[0], tau[-1])
    bar = ScalarMappable(norm, cmap)  # the maps may be partly transparent
    scale = figure.colorbar(
        bar, cax=figure.add_axes((0.912, 0.6 / height, 0.013, 1.0 - 0.95 / height)), label=label
    )
    label_log_axis(scale.ax.yaxis, norm.vmin, norm.vmax)
    return figure


@literal_text
def plot_surfaces(surfaces: xr.Dataset, content: Mapping[str, Any]) -> Figure:
    """Draw the Allan deviation over time and averaging time, of the recording and both simulations.

    Parameters
    ----------
    surfaces : xarray.Dataset
        From `gyrostab.diagnose.result.surfaces`: ``avar(case, axis, window, tau)``
        [degree2 hour-2].
    content : mapping
        Contents of `diagnosis.json`; its mismatches are framed.

    Returns
    -------
    matplotlib.figure.Figure
    """
    from matplotlib.colors import LogNorm

    deviation = np.sqrt(surfaces["avar"].transpose("case", "axis", "window", "tau").values)
    positive = deviation[np.isfinite(deviation) & (deviation > 0)]
    norm = LogNorm(*(np.quantile(positive, [0.005, 0.995]) if positive.size else (0.1, 1.0)))
    cases = [str(name) for name in surfaces["case"].values]
    columns = [
        (_TITLES.get(name, name), deviation[place], None) for place, name in enumerate(cases)
    ]
    return _draw_maps(surfaces, content, columns, norm, "viridis", "Allan deviation [deg/h]")


@literal_text
def plot_change(surfaces: xr.Dataset, content: Mapping[str, Any]) -> Figure:
    """Draw the Allan deviation of the recording over that of the simulations before and after."""
    from matplotlib.colors import LogNorm
    from matplotlib.ticker import FixedLocator, NullFormatter

    avar, low, high = (
        surfaces[name].transpose("case", "axis", "window", "tau")
        for name in ("avar", "avar_low", "avar_high")
    )
    recording = avar.sel(case="recording").values
    columns = []
    for name in ("before", "after"):
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = np.sqrt(recording / avar.sel(case=name).values)
            usual = (recording >= low.sel(case=name).values) & (
                recording <= high.sel(case=name).values
            )
        columns.append(
            (
                f"Recording over simulation {'without' if name == 'before' else 'with'} effects",
                ratio,
                np.where(usual, INSIDE_BAND_OPACITY, 1.0),
            )
        )
    figure = _draw_maps(
        surfaces, content, columns, LogNorm(0.5, 2.0), "PuOr_r", "ratio of Allan deviations"
    )
    bar = figure.axes[-1]
    bar.yaxis.set_major_locator(FixedLocator([0.5, 0.7, 1.0, 1.4, 2.0]))
    bar.set_yticklabels(["≤ 0.5", "0.7", "1", "1.4", "≥ 2"])
    bar.yaxis.set_minor_formatter(NullFormatter())
    return figure


@literal_text
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
    names = [str(name) for name in surfaces["axis"].values]
    channels = select_channels(surfaces, content)
    size, unit = unit_of_time(float(surfaces["end"].values[-1]))
    time = (surfaces["begin"].values + surfaces["end"].values) / (2.0 * size)
    block = (surfaces["block_begin"].values + surfaces["block_end"].values) / (2.0 * size)
    ratios = [1.9] * len(names) + [1.3] * len(channels)
    figure = new_figure(12.0, 1.0 + sum(ratios))
    panels = figure.subplots(
        len(ratios), 1, sharex=True, squeeze=False, gridspec_kw={"height_ratios": ratios}
    )[:, 0]
    for panel, name in zip(panels, names, strict=False):
        one = surfaces.sel(axis=name)
        single = one["block_mean"].values
        panel.plot(block, single, ".", color=GREY, ms=2.5, label="recording, blocks")
        panel.plot(
            time,
            one["mean"].sel(case="recording").values,
            color="black",
            lw=1.2,
            label="recording, windows",
        )
        for case in ("before", "after"):
            mean, error = (
                one["mean"].sel(case=case).values,
                one["mean_stderr"].sel(case=case).values,
            )
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
        handles, labels, loc="outside upper center", ncols=4, fontsize="small", frameon=False
    )
    return figure


def _limit_to_middle(panel: Axes, values: Array) -> None:
    """Show the middle 99 % of the block means, so that an outlier does not flatten the rest."""
    good = values[np.isfinite(values)]
    if good.size > 20:
        low, high = np.quantile(good, [0.005, 0.995])
        panel.set_ylim(low - 0.25 * (high - low) - 1e-12, high + 0.25 * (high - low) + 1e-12)


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


def _mark_spans(panel: Axes, axis: str, content: Mapping[str, Any], size: float) -> None:
    start = content["recording"]["start"]
    for region in content["mismatches"]:
        if axis in region["axes"] and region["view"] in ("mean", "restart"):
            begin, end = (
                _seconds_since(region["start"], start) / size,
                _seconds_since(region["end"], start) / size,
            )
            panel.axvspan(begin, end, color=_RED, alpha=0.05, lw=0)
            panel.axvspan(begin, end, ymin=0.96, color=_RED, lw=0)
            panel.annotate(
                str(region["id"]),
                (begin, 1.0),
                (2, -2),
                xycoords=panel.get_xaxis_transform(),
                textcoords="offset points",
                va="top",
                fontsize=9,
                color="white",
                weight="bold",
                bbox={"facecolor": _RED, "edgecolor": "none", "pad": 1.2},
            )


@literal_text
def plot_deviations(surfaces: xr.Dataset) -> Figure:
    """Draw the Allan deviation of the whole record, one panel per axis."""
    names, tau = [str(name) for name in surfaces["axis"].values], surfaces["tau"].values
    figure = new_figure(min(4.2 * len(names), 12.0) if len(names) > 1 else 6.0, 3.8)
    panels = figure.subplots(1, len(names), sharey=True, squeeze=False)[0]
    with np.errstate(invalid="ignore"):
        whole = surfaces["avar"].mean("window", skipna=True) ** 0.5
    for panel, name in zip(panels, names, strict=True):
        for case in ("recording", "before", "after"):
            panel.plot(
                tau,
                whole.sel(axis=name, case=case).values,
                **_STYLES[case],
                label=_TITLES[case].lower(),
            )
        panel.set(xscale="log", yscale="log", xlabel="averaging time [s]", title=f"axis {name}")
        panel.grid(True, which="major", alpha=0.4)
    panels[0].set_ylabel("Allan deviation [deg/h]")
    panels[0].legend(fontsize="small", frameon=False)
    label_log_axis(panels[0].yaxis, *panels[0].get_ylim())
    return figure


@literal_text
def plot_spectra(surfaces: xr.Dataset) -> Figure:
    """Draw the power spectrum of the whole record, one panel per axis.

    Parameters
    ----------
    surfaces : xarray.Dataset
        ``density(case, axis, band)`` over ``frequency`` [Hz] and ``line_density(axis, line)`` over
        ``line_frequency``, two-sided [degree2 hour-2 Hz-1].
    """
    names = [str(name) for name in surfaces["axis"].values]
    figure = new_figure(min(4.2 * len(names), 12.0) if len(names) > 1 else 6.0, 3.8)
    panels = figure.subplots(1, len(names), sharey=True, squeeze=False)[0]
    for panel, name in zip(panels, names, strict=True):
        panel.plot(
            surfaces["line_frequency"].values,
            surfaces["line_density"].sel(axis=name).values,
            color=GREY,
            lw=0.6,
            label="recording",
        )
        for case in ("before", "after"):
            values = surfaces["density"].sel(axis=name, case=case).values
            panel.plot(
                surfaces["frequency"].values, values, **_STYLES[case], label=_TITLES[case].lower()
            )
        panel.set(xscale="log", yscale="log", xlabel="frequency [Hz]", title=f"axis {name}")
        panel.grid(True, which="major", alpha=0.4)
    panels[0].set_ylabel("power density [(deg/h)²/Hz]")
    panels[0].legend(fontsize="small", frameon=False)
    label_log_axis(panels[0].yaxis, *panels[0].get_ylim())
    return figure

"""The recorded signal of every axis, with the channels below."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from gyrostab.arrays import Array
from gyrostab.errors import OptionError
from gyrostab.ingest.convert import as_log
from gyrostab.plot.style import (
    INCH_MM,
    PAGE_MM,
    axis_names,
    axis_style,
    check_columns,
    draws_figure,
    find_true_runs,
    new_figure,
    shade_spans,
    time_axis,
    title_figure,
    unit_label,
)
from gyrostab.schema import log_channels, signal_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_BLOCK_SAMPLES = 2**22  # samples read at a time: 32 MiB


@draws_figure
def plot_signal(
    log: xr.Dataset,
    *,
    axis: str | None = None,
    channels: str | Sequence[str] | None = None,
    columns: int = 1500,
    width: float = PAGE_MM,
) -> Figure:
    """Draw the gyro signal of all axes, with the channels below and gaps in grey.

    A long record is reduced to the smallest and largest sample of every column, so spikes stay
    visible. It is read block by block.

    Parameters
    ----------
    log : xarray.Dataset
        Regular log, ``rate`` [degree hour-1] or ``angle`` [degree] with dims ``(axis, time)``.
    axis : str, optional
        Draw this axis only.
    channels : str or sequence of str, optional
        Channels to draw; all by default.
    columns : int
        Number of columns to which a long record is reduced.
    width : float
        Width of the figure [mm]: 180 for a page, 85 for a column.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    OptionError
        If the axis or a channel is not in the log, or `columns` is less than 1.

    Examples
    --------
    >>> from gyrostab.time.grid import time_coordinate
    >>> rate = xr.DataArray(np.full((1, 100), 7.0), dims=("axis", "time"), coords={"axis": ["x"]})
    >>> log = xr.Dataset({"rate": rate.assign_attrs(units="degree hour-1")})
    >>> plot_signal(log.assign_coords(time_coordinate(0, 100.0, 100))).axes[0].get_ylabel()
    'x [deg/h]'
    """
    log = as_log(log)
    check_columns(columns)
    name = signal_name(log)
    axes, available = axis_names(log, axis), log_channels(log)
    is_single = isinstance(channels, str) or not np.iterable(channels)
    chosen: Any = [channels] if is_single else channels
    shown = available if channels is None else list(chosen)
    if missing := [str(channel) for channel in shown if channel not in available]:
        raise OptionError(
            f"channel {', '.join(missing)} is not in the log; "
            f"it has {', '.join(available) or 'none'}"
        )
    height = 0.9 + 1.2 * len(axes) + 1.0 * len(shown)
    figure = new_figure(width / INCH_MM, height)
    ratios = [1.2] * len(axes) + [1.0] * len(shown)
    panels = figure.subplots(len(ratios), 1, sharex=True, squeeze=False, height_ratios=ratios)[:, 0]
    for panel, axis_name in zip(panels, axes, strict=False):
        _draw_trace(
            panel, log[name].sel(axis=axis_name), axis_style(log, axis_name)["color"], columns
        )
        panel.set_ylabel(f"{axis_name} {unit_label(log[name].attrs.get('units'))}")
    for panel, channel in zip(panels[len(axes) :], shown, strict=True):
        _draw_trace(panel, log[channel], "#333333", columns)
        panel.set_ylabel(
            f"{channel.replace('_', ' ')}\n{unit_label(log[channel].attrs.get('units'))}".rstrip()
        )
    starts, ends = _find_gaps(log, columns)
    if starts.size:
        for panel in panels:
            shade_spans(panel, starts, ends, label="gap: no samples")
        panels[0].legend(loc="upper right", framealpha=0.9)
    signal_text = "Rotation rate" if name == "rate" else "Rotation angle"
    rate = log.attrs.get("sampling_rate_hz")
    title_figure(figure, f"{signal_text} as recorded", f"{float(rate):g} Hz" if rate else "")
    time_axis(panels[-1], log["time"][[0, -1]].values)
    figure.align_ylabels()
    return figure


def thin(values: xr.DataArray, *, columns: int = 1500) -> tuple[Array, Array, Array]:
    """Find the smallest and largest sample of every column of a long record.

    Parameters
    ----------
    values : xarray.DataArray
        One-dimensional, on a time axis; NaN where missing.
    columns : int
        Number of columns; a record with fewer than twice as many samples is returned unchanged.

    Returns
    -------
    times, low, high : ndarray
        Time of the first sample of each column, and the extremes; NaN if all samples are missing.

    Examples
    --------
    >>> record = xr.DataArray(np.arange(12.0), dims="time", coords={"time": np.arange(12)})
    >>> thin(record, columns=3)
    (array([0, 4, 8]), array([0., 4., 8.]), array([ 3.,  7., 11.]))
    """
    (dim,) = values.dims
    size = values.size
    width = -(-size // columns) if size > 2 * columns else 1
    per_block = max(1, _BLOCK_SAMPLES // width) * width
    low, high = [], []
    for start in range(0, size, per_block):
        block = np.asarray(values[start : start + per_block].values, dtype=np.float64)
        edges = np.arange(0, block.size, width)
        low.append(np.fmin.reduceat(block, edges))
        high.append(np.fmax.reduceat(block, edges))
    times = values[dim][np.arange(0, size, width)].values
    return times, np.concatenate(low), np.concatenate(high)


def _draw_trace(panel: Axes, values: xr.DataArray, colour: str, columns: int) -> None:
    times, low, high = thin(values, columns=columns)
    if np.array_equal(low, high, equal_nan=True):
        lone = times.size < 60 or not np.any(np.isfinite(low[1:]) & np.isfinite(low[:-1]))
        panel.plot(times, low, color=colour, linewidth=0.7, marker="." if lone else "")
    else:
        panel.plot(
            np.repeat(times, 2), np.stack([low, high], axis=1).ravel(), color=colour, linewidth=0.7
        )
    panel.grid(alpha=0.3)


def _find_gaps(log: xr.Dataset, columns: int) -> tuple[Array, Array]:
    """Find start and end of the gaps: from the gap table, else columns missing on all axes."""
    if "gap_start" in log.variables and "gap_end" in log.variables:
        return log["gap_start"].values, log["gap_end"].values
    signal = log[signal_name(log)]
    missing = []
    for number in range(signal.sizes["axis"]):
        times, low, _ = thin(signal[number], columns=columns)
        missing.append(np.isnan(low))
    first, last = find_true_runs(np.all(missing, axis=0))
    return times[first], np.append(times, log["time"].values[-1])[last]

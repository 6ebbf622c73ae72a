"""Compare two logs of the same time, with and without an effect, in four panels."""

import itertools

import numpy as np

from gyrostab import davar, make_log
from gyrostab.plot.signal import thin
from gyrostab.plot.style import (
    COLOURS,
    GREY,
    INCH_MM,
    draws_figure,
    label_log_axis,
    new_figure,
    unit_label,
)
from gyrostab.plot.surface import CHANGE_CMAP
from gyrostab.time.durations import duration_seconds
from gyrostab.units import HOUR

_WIDTH_MM = 193.04
_STYLES = (
    {"color": GREY, "lw": 2.4},
    {"color": COLOURS[0], "lw": 1.1},
)


@draws_figure
def plot_comparison(
    without,
    with_it,
    *,
    window,
    step=None,
    moments=(),
    driver="",
    difference=False,
    coherency=False,
):
    """Draw what an effect changes: DAVAR, window means, spectrum, and correlation of two axes.

    The first three panels show the first axis, the last one the first two axes.

    Parameters
    ----------
    without, with_it : xarray.Dataset
        Two regular logs with ``rate(axis, time)`` [degree hour-1] on the same stamps.
    window, step : str
        Windows of the dynamic Allan variance, as for `gyrostab.davar`.
    moments : sequence of float or str
        Times since the start [s] at which to draw the Allan deviation; by default, the ratio over
        time is drawn as a map.
    driver : str
        Channel of `with_it` to draw behind the window means.
    difference : bool
        Draw the window means minus those of `without`, for errors of a large rate.
    coherency : bool
        Draw the coherency of the two axes over frequency, in phase and in quadrature. By default,
        draw their Allan correlation over averaging time, ``(avar(x + y) - avar(x - y)) / 4``
        divided by the root of the product of their variances, with its 95 % range by chance.
    """
    logs = without, with_it
    figure = new_figure(_WIDTH_MM / INCH_MM, 4.9)
    panels = figure.subplots(2, 2)
    pair = tuple(
        davar(log, window=window, step=step, taus=30, axis=[str(log["axis"].values[0])])
        .isel(axis=0)
        .load()
        for log in logs
    )
    seconds = float(pair[0].attrs["window_s"])
    size, unit = (HOUR, "h") if seconds >= HOUR else (60.0, "min") if seconds >= 600 else (1.0, "s")
    name = f"{seconds / size:g} {unit}"
    if moments:
        times = [duration_seconds(moment, "moment", zero=True) for moment in moments]
        _draw_curves(panels[0, 0], logs, pair, times)
        panels[0, 0].set_title(f"Allan deviation, windows of {name}")
    else:
        _draw_ratio(panels[0, 0], logs, pair)
        panels[0, 0].set_title(f"σ with / σ without, windows of {name}")
    _draw_means(panels[0, 1], logs, pair, difference=difference)
    if driver:
        _draw_channel(panels[0, 1], with_it, driver)
    _draw_spectra(panels[1, 0], logs)
    (_draw_coherency if coherency else _draw_allan_correlation)(panels[1, 1], logs)
    for panel in panels.flat:
        panel.grid(visible=True, lw=0.3, alpha=0.6)
        for scale, limits in ((panel.xaxis, panel.get_xlim()), (panel.yaxis, panel.get_ylim())):
            if scale.get_scale() == "log":
                label_log_axis(scale, *limits)
    return figure


def _time_since_start(log, times):
    """Convert times to hours since the start for long logs, else to minutes; with the unit."""
    hour = np.timedelta64(int(HOUR) * 10**9, "ns")
    start, end = log["time"].values[[0, -1]]
    unit, word = (hour, "h") if end - start > 1.5 * hour else (hour / 60, "min")
    return (np.asarray(times) - start) / unit, word


def _draw_curves(panel, logs, pair, moments):
    centres, word = _time_since_start(logs[0], pair[0]["time"].values)
    tau = pair[0]["tau"].values
    panel.loglog(
        tau,
        np.sqrt(np.nanmean(pair[0]["avar"].values, axis=0)),
        **_STYLES[0],
        label="without, mean",
    )
    lines = zip(itertools.cycle(COLOURS), itertools.cycle(("-", "--", "-.", ":")), strict=True)
    for moment, (colour, dashes) in zip(moments, lines, strict=False):
        when = moment / {"h": HOUR, "min": 60.0}[word]
        curve = np.sqrt(pair[1]["avar"].values[np.abs(centres - when).argmin()])
        panel.loglog(tau, curve, dashes, color=colour, lw=1.3, label=f"with, at {when:g} {word}")
    label_log_axis(panel.yaxis, *panel.get_ylim())
    panel.legend(framealpha=0.9, edgecolor="none", loc="lower left")
    panel.set(xlabel="averaging time [s]", ylabel="[deg/h]")


def _draw_ratio(panel, logs, pair):
    from matplotlib.colors import LogNorm

    centres, word = _time_since_start(logs[0], pair[0]["time"].values)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.sqrt(pair[1]["avar"].values / pair[0]["avar"].values)
    size = np.abs(np.log(ratio[np.isfinite(ratio) & (ratio > 0)]))
    reach = float(np.clip(np.exp(np.quantile(size, 0.995)) if size.size else 1.0, 1.1, 1e3))
    panel.set_facecolor("#d0d0d0")
    shown = np.ma.masked_invalid(ratio.T)
    mesh = panel.pcolormesh(
        centres,
        pair[0]["tau"].values,
        shown,
        norm=LogNorm(1 / reach, reach),
        cmap=CHANGE_CMAP,
        shading="nearest",
        rasterized=True,
    )
    panel.set(yscale="log", xlabel=f"time [{word}]", ylabel="averaging time [s]")
    bar = panel.figure.colorbar(mesh, ax=panel, extend="both", pad=0.02)
    bar.minorticks_off()
    steps = (1000, 300, 100, 30, 10, 5, 3, 2, 1.5, 1.2, 1.1, 1.05)
    tick = next(step for step in steps if step <= reach)
    bar.set_ticks([1 / tick, 1, tick], labels=[f"1/{tick:g}", "1", f"{tick:g}"])


def _draw_means(panel, logs, pair, *, difference):
    first = pair[0]["window_mean"] if difference else 0.0
    centres, word = _time_since_start(logs[0], pair[0]["time"].values)
    for product, style, label in zip(pair, _STYLES, ("without", "with"), strict=True):
        panel.plot(centres, product["window_mean"] - first, **style, label=label)
    gaps = [
        _time_since_start(logs[0], logs[0][edge].values)[0]
        for edge in ("gap_start", "gap_end")
        if logs[0].sizes.get("gap")
    ]
    if gaps:
        lost = list(zip(gaps[0], gaps[1] - gaps[0], strict=True))
        panel.broken_barh(
            lost,
            (0, 1),
            transform=panel.get_xaxis_transform(),
            color=GREY,
            alpha=0.5,
            lw=0,
            zorder=0.5,
            label="data lost",
        )
    panel.set(
        title="Window mean minus that without" if difference else "Window mean",
        xlabel=f"time [{word}]",
        ylabel="[deg/h]",
    )
    panel.legend(framealpha=0.9, edgecolor="none")


def _draw_channel(panel, log, driver):
    """Draw a channel behind the window means, on a separate scale."""
    overlay = panel.twinx()
    stamps, low, high = thin(log[driver], columns=400)
    times, _ = _time_since_start(log, stamps)
    if np.nanquantile(high - low, 0.8) <= 0.05 * (np.nanmax(high) - np.nanmin(low)):
        overlay.plot(times, (low + high) / 2, ":", color=COLOURS[1], lw=1.2)
    else:  # faster than the columns of the figure
        overlay.fill_between(times, low, high, step="mid", color=COLOURS[1], alpha=0.3, lw=0.6)
    overlay.set_ylabel(
        f"{driver.replace('_', ' ')} {unit_label(log[driver].attrs.get('units'))}", color=COLOURS[1]
    )
    panel.set(zorder=overlay.get_zorder() + 1, facecolor="none")


def _interpolate_gaps(log):
    """Interpolate the first two axes over the gaps, for spectra."""
    rows = log["rate"].transpose("axis", "time").values[:2].astype(float)
    for row in rows:
        bad = np.isnan(row)
        row[bad] = np.interp(np.flatnonzero(bad), np.flatnonzero(~bad), row[~bad])
    return rows[0], rows[1]


def _draw_spectra(panel, logs):
    from scipy.signal import welch

    for log, style in zip(logs, _STYLES, strict=True):
        how = {
            "fs": log.attrs["sampling_rate_hz"],
            "nperseg": max(8, log.sizes["time"] // 10),
            "detrend": "linear",
        }
        f, power = welch(_interpolate_gaps(log)[0], **how)
        panel.loglog(f[1:], power[1:], **style | {"lw": style["lw"] * 0.8})
    label_log_axis(panel.yaxis, *panel.get_ylim())
    panel.set(title="Power spectrum", xlabel="frequency [Hz]", ylabel="[(deg/h)²/Hz]")


def _join_axis_names(log):
    return " and ".join(str(name) for name in log["axis"].values[:2])


def _draw_coherency(panel, logs):
    from scipy.signal import csd, welch

    for log, style, quadrature in zip(logs, _STYLES, (GREY, COLOURS[1]), strict=True):
        how = {
            "fs": log.attrs["sampling_rate_hz"],
            "nperseg": max(8, log.sizes["time"] // 30),
            "detrend": "linear",
        }
        x, y = _interpolate_gaps(log)
        f, cross = csd(x, y, **how)
        ratio = cross / np.sqrt(welch(x, **how)[1] * welch(y, **how)[1])
        panel.semilogx(f[1:], ratio.imag[1:], "--", color=quadrature, lw=0.9, label="in quadrature")
        panel.semilogx(f[1:], ratio.real[1:], **style | {"lw": style["lw"] * 0.8}, label="in phase")
    panel.legend(handles=panel.get_lines()[:1:-1], framealpha=0.9, edgecolor="none")
    panel.set(
        title=f"Coherency of {_join_axis_names(logs[0])}", xlabel="frequency [Hz]", ylim=(-1.1, 1.1)
    )


def _draw_allan_correlation(panel, logs):
    for log, style in zip(logs, _STYLES, strict=True):
        x, y = log["rate"].transpose("axis", "time").values[:2]
        sums = make_log(
            np.stack([x, y, x + y, x - y]),
            rate=log.attrs["sampling_rate_hz"],
            unit="deg/h",
            axis=["x", "y", "sum", "difference"],
        )
        surface = davar(sums, window=f"{sums.sizes['time']}samples", taus=30).isel(time=0).load()
        a, b, plus, minus = surface["avar"].values
        with np.errstate(divide="ignore", invalid="ignore"):
            panel.semilogx(surface["tau"], (plus - minus) / 4.0 / np.sqrt(a * b), **style)
        if log is logs[0]:
            chance = 2.0 / np.sqrt(surface["edf"].values[0])
            panel.fill_between(surface["tau"].values, -chance, chance, color=GREY, alpha=0.15, lw=0)
    panel.set(
        title=f"Allan correlation of {_join_axis_names(logs[0])}",
        xlabel="averaging time [s]",
        ylim=(-1.1, 1.1),
    )

"""Coefficients and window means against a channel."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from gyrostab.correlate.drivers import MAX_GAP_SPACINGS, interpolate_values
from gyrostab.correlate.judge import VERDICTS, format_p_value, require_correlation
from gyrostab.errors import SchemaError
from gyrostab.noise import LAWS
from gyrostab.plot.style import (
    COLOURS,
    INCH_MM,
    PAGE_MM,
    axis_names,
    draws_figure,
    is_narrow,
    new_figure,
    unit_label,
    write_in_middle,
)
from gyrostab.schema import OBSERVED
from gyrostab.time.durations import format_duration
from gyrostab.time.stamps import to_nanoseconds

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Points while the driver rises, while it falls, and while it is constant.
_RISING: dict[str, Any] = {"linestyle": "none", "marker": "^", "color": COLOURS[1]}
_FALLING: dict[str, Any] = {
    "linestyle": "none",
    "marker": "v",
    "color": COLOURS[0],
    "markerfacecolor": "none",
}
_CONSTANT: dict[str, Any] = {"linestyle": "none", "marker": "o", "color": "#6e6e6e"}
_MAX_POINTS = 3000


@draws_figure
def plot_correlation(
    result: xr.Dataset,
    *,
    axis: str | None = None,
    driver: str | None = None,
    width: float = PAGE_MM,
) -> Figure:
    """Draw every variable against the channel at its lag, by variable (rows) and axis (columns).

    Filled triangles pointing up are windows in which the channel rises, open triangles pointing
    down those in which it falls, dots those in which it is constant. The band shows the interval of
    slopes, about the centre of the data; a line, the sensitivity, is drawn only for the verdict
    ``coupled``.

    Parameters
    ----------
    result : xarray.Dataset
        Result of `gyrostab.correlate`.
    axis : str, optional
        Draw this axis only.
    driver : str, optional
        Channel or its rate of change; the channel by default.
    width : float
        Width of the figure [mm]: 180 for a page, 85 for a column.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    SchemaError, OptionError
        If `result` is not a correlation or has no such axis or driver.

    Examples
    --------
    >>> from gyrostab import correlate, davar, fit_noise, make_log
    >>> rate, temperature = np.random.default_rng(1).standard_normal((2, 36_000))
    >>> channels = {"temperature": (temperature, "degC")}
    >>> log = make_log(rate, rate=10.0, unit="deg/h", channels=channels)
    >>> product = fit_noise(davar(log, window="1min", step="30s"))
    >>> plot_correlation(correlate(product, variables="window_mean")).axes[0].get_ylabel()
    'window mean [deg/h]'
    """
    result = require_correlation(result)
    names = axis_names(result, axis)
    driver = str(result["driver"].values[0]) if driver is None else driver
    if driver not in result["driver"].values:
        raise SchemaError(
            f"the correlation has no driver {driver!r}; it has "
            f"{', '.join(map(str, result['driver'].values))}"
        )
    variables = [str(name) for name in result["variable"].values]
    figure = new_figure(width / INCH_MM, 0.9 + 1.55 * len(variables))
    panels = figure.subplots(len(variables), len(names), sharex="col", squeeze=False)
    for row, variable in zip(panels, variables, strict=True):
        for panel, name in zip(row, names, strict=True):
            _draw_panel(panel, result.sel(axis=name), variable, driver)
            panel.grid(alpha=0.3)
        units = unit_label(
            LAWS[variable].label if variable in LAWS else result[variable].attrs.get("units")
        )
        row[0].set_ylabel(f"{variable.replace('_', ' ')} {units}".strip())
    label = f"{driver.replace('_', ' ')} {unit_label(result[driver].attrs.get('units'))}".strip()
    for panel, name in zip(panels[0], names, strict=True):
        panel.annotate(
            f"axis {name}",
            (0.5, 1.0),
            (0, 22),
            "axes fraction",
            "offset points",
            ha="center",
            fontweight="bold",
        )
    panels[-1][len(names) // 2].set_xlabel(label)
    figure.legend(
        handles=_legend_handles(driver, float(result.attrs.get("interval_level", 0.95))),
        loc="outside lower center",
        ncols=2 if is_narrow(figure) else 3,
        frameon=False,
    )
    return figure


def _draw_panel(panel: Axes, part: xr.Dataset, variable: str, driver: str) -> None:
    cell = part.sel(variable=variable, driver=driver)
    lag = float(np.nan_to_num(cell["coupling_lag"]))
    longest = sum(float(part.attrs.get(name, 0.0)) for name in ("window_s", "step_s"))
    x, change = _shift_driver(part[driver], lag, longest)
    y = part[variable].values
    good = np.isfinite(x) & np.isfinite(y)
    if variable in LAWS and "observable" in part:
        good &= part["observable"].sel(term=variable).values == OBSERVED
    every = max(1, int(good.sum()) // _MAX_POINTS)
    for direction, style in ((1, _RISING), (-1, _FALLING), (0, _CONSTANT)):
        chosen = np.flatnonzero(good & (np.sign(change) == direction))[::every]
        panel.plot(x[chosen], y[chosen], markersize=3.5, alpha=0.75, markeredgewidth=0.7, **style)
    verdict = VERDICTS[int(cell["coupling_verdict"])]
    title = _verdict_text(verdict, lag, float(cell["p_value_adjusted"]))
    panel.set_title(title.replace(", ", "\n") if is_narrow(panel.figure) else title, size="small")
    if not good.any():
        write_in_middle(panel, f"{variable.replace('_', ' ')} is not observed\nin any window")
        panel.tick_params(left=False, labelleft=False)
        return
    slope, low, high = (
        float(part[f"{variable}_per_{driver}{end}"]) for end in ("", "_low", "_high")
    )
    if not np.isfinite(slope):
        return
    ends = np.linspace(x[good].min(), x[good].max(), 50)
    middle, level = float(np.mean(x[good])), float(np.mean(y[good]))
    span = np.ptp(y[good]) or 1.0
    if verdict == "coupled":
        panel.plot(ends, level + slope * (ends - middle), color="black", linewidth=1.2)
    edges = [level + value * (ends - middle) for value in (low, high)]
    panel.fill_between(
        ends, np.minimum(*edges), np.maximum(*edges), color="#8c8c8c", alpha=0.3, linewidth=0
    )
    panel.set_ylim(y[good].min() - 0.1 * span, y[good].max() + 0.1 * span)


def _verdict_text(verdict: str, lag: float, p: float) -> str:
    """Write the title of a panel; the p-value only if it belongs to the verdict."""
    late = f", {format_duration(lag, ' ')} late" if lag else ""
    if verdict == "cannot_tell":
        return "cannot tell"
    if verdict == "not_told_apart":
        return f"coupling or another cause{late}"
    return f"{verdict.replace('_', ' ')}{late}, p {'' if p < 1e-4 else '= '}{format_p_value(p)}"


def _shift_driver(driver: xr.DataArray, lag: float, longest: float) -> tuple[Any, Any]:
    """Shift the driver by the lag, and find its rate of change.

    NaN before the record, and in gaps that `gyrostab.correlate` does not bridge.
    """
    values = driver.values.astype(np.float64)
    is_finite = np.isfinite(values)
    if is_finite.sum() < 3:
        return np.full(values.size, np.nan), np.zeros(values.size)
    stamps, values = to_nanoseconds(driver["time"].values), values[is_finite]
    at, stamps = stamps - round(1e9 * lag), stamps[is_finite]
    spacing = float(np.median(np.diff(stamps)))
    moved = interpolate_values(values, stamps, at, max(1e9 * longest, MAX_GAP_SPACINGS * spacing))
    return moved, np.interp(at, stamps, np.gradient(values, stamps))


def _legend_handles(driver: str, level: float) -> list[Any]:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    channel_name = driver.replace("_", " ")
    return [
        Line2D([], [], **_RISING, label=f"{channel_name} rises"),
        Line2D([], [], **_FALLING, label=f"{channel_name} falls"),
        Line2D([], [], **_CONSTANT, label=f"{channel_name} constant"),
        Patch(
            facecolor="#8c8c8c",
            alpha=0.3,
            edgecolor="black",
            label=f"{100 * level:g} % interval of the slope",
        ),
        Line2D([], [], color="black", linewidth=1.2, label="slope where coupled"),
    ]

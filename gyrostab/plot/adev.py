"""The Allan deviation of one window with its confidence band and the fitted terms."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from gyrostab.allan.confidence import interval_limits
from gyrostab.allan.variance import surface_columns, variance_name
from gyrostab.arrays import Floats
from gyrostab.errors import OptionError
from gyrostab.noise import LAWS
from gyrostab.plot.style import (
    COLOURS,
    INCH_MM,
    PAGE_MM,
    axis_names,
    axis_style,
    draws_figure,
    is_narrow,
    label_log_axis,
    new_figure,
    require_coefficients,
    title_figure,
    unit_symbol,
    write_in_middle,
)
from gyrostab.schema import OBSERVED, UPPER_LIMIT_ONLY, check_surface, with_axis
from gyrostab.time.grid import span_of
from gyrostab.time.stamps import label_stamp

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Term -> variable with its response to gaps.
_RESPONSES = {"N": "white_response", "Q": "quantization_response", "R": "ramp_response"}
_DASHES = ("--", "-.", ":", (0, (6, 2, 1, 2, 1, 2)), (0, (8, 3)))


@draws_figure
def plot_adev(
    product: xr.Dataset, axis: str | None = None, *, when: Any = None, width: float = PAGE_MM
) -> Figure:
    """Draw the Allan deviation of one window, with its 95 % band and the fitted noise terms.

    Parameters
    ----------
    product : xarray.Dataset
        Surface or product, ``avar`` [degree2 hour-2] and ``edf`` with dims ``(axis, time, tau)``.
    axis : str, optional
        Axis to draw; not needed if there is only one.
    when : datetime-like, optional
        Time of the window (the nearest window centre); by default, of the windows with the best
        coverage, the one nearest to the middle of the record.
    width : float
        Width of the figure [mm]: 180 for a page, 85 for a column.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    SchemaError, OptionError
        If `product` is not a surface or has no such axis, or `when` is outside the record.

    Examples
    --------
    >>> from gyrostab import davar, make_log
    >>> log = make_log(np.random.default_rng(1).standard_normal(6000), rate=100.0, unit="deg/h")
    >>> plot_adev(davar(log, window="20s"), "x").axes[0].get_xscale()
    'log'
    """
    product = with_axis(product)
    check_surface(product)
    if "observable" in product:
        require_coefficients(product)
    names = axis_names(product, axis)
    if len(names) > 1:
        raise OptionError(f"give the axis to draw: axis={names[0]!r}; there are {', '.join(names)}")
    name = names[0]
    windows = (
        product.sel(axis=[name]).isel(time=[_select_window(product.sel(axis=name), when)]).compute()
    )
    window = windows.isel(axis=0, time=0)
    figure = new_figure(width / INCH_MM, 4.4)
    panel = figure.subplots()
    colour = axis_style(product, name)["color"]
    deviation, upper = _draw_measured(panel, window, colour)
    if "observable" in window:
        terms, total = fitted_curves(windows)
        shades = [shade for shade in COLOURS if shade != colour]
        _draw_terms(panel, window, terms[0, 0], total[0, 0], shades)
    _scale_panel(panel, window["tau"].values, deviation, upper)
    panel.set_xlabel("averaging time τ [s]")
    panel.set_ylabel(f"{variance_name(product)} deviation σ(τ) [deg/h]")
    panel.grid(alpha=0.3)
    if is_narrow(figure):
        figure.legend(loc="outside lower left", frameon=False)
    else:
        panel.legend()
    title_figure(
        figure,
        f"{variance_name(product)} deviation of axis {name}",
        f"window centred on {label_stamp(window['time'].values)} UTC",
    )
    return figure


def _draw_measured(panel: Axes, window: xr.Dataset, colour: str) -> tuple[Floats, Floats]:
    """Draw the Allan deviation with its band; return it, and the upper limit of the band."""
    tau = window["tau"].values
    low, high = interval_limits(window["avar"].values, window["edf"].values)
    panel.fill_between(
        tau, np.sqrt(low), np.sqrt(high), color=colour, alpha=0.2, linewidth=0, label="95 % band"
    )
    deviation = np.sqrt(window["avar"].values)
    panel.plot(
        tau,
        deviation,
        color=colour,
        marker="o",
        markersize=3.5,
        linewidth=1.2,
        label=f"axis {window['axis'].item()}, measured",
    )
    return deviation, np.sqrt(high)


def _scale_panel(panel: Axes, tau: Floats, deviation: Floats, upper: Floats) -> None:
    """Set limits and logarithmic scales; say so if nothing is drawn."""
    shown = deviation[np.isfinite(deviation) & (deviation > 0)]
    panel.set_xlim(tau.min() / 1.3, tau.max() * 1.3)
    if not shown.size:
        panel.set_ylim(0.1, 10.0)
        write_in_middle(panel, "no estimate in this window")
    else:
        panel.set_ylim(shown.min() / 4.0, np.nanmax(upper) * 1.5)
    panel.set_xscale("log")  # after the limits, which data of a constant signal do not give
    panel.set_yscale("log")
    label_log_axis(panel.xaxis, *panel.get_xlim())
    label_log_axis(panel.yaxis, *panel.get_ylim())


def _select_window(part: xr.Dataset, when: Any) -> int:
    time = part["time"].values.astype("datetime64[ns]")
    if when is None:
        coverage = part["window_coverage"].values
        best = (
            np.flatnonzero(coverage >= np.nanmax(coverage) - 1e-9)
            if np.isfinite(coverage).any()
            else np.arange(time.size)
        )
        return int(best[np.argmin(np.abs(best - time.size // 2))])
    try:
        if isinstance(when, int | float | np.number):  # seconds or nanoseconds
            raise ValueError("no time")
        stamp, _ = span_of(when)
    except (TypeError, ValueError) as error:
        raise OptionError(
            f"time {when!r} is not understood; write it as 2026-11-20T14:30:00"
        ) from error
    half = np.timedelta64(int(float(part.attrs.get("window_s", 0.0)) * 0.5e9), "ns")
    if not time[0] - half <= stamp <= time[-1] + half:
        raise OptionError(
            f"time {when} is outside the record, which has windows from {time[0]} to {time[-1]}"
        )
    return int(np.argmin(np.abs(time - stamp)))


def fitted_curves(product: xr.Dataset) -> tuple[Floats, Floats]:
    """Compute the Allan variance of the fitted terms [degree2 hour-2].

    Returns
    -------
    terms : ndarray (axis, time, term, tau)
        Each term, with its response to gaps.
    total : ndarray (axis, time, tau)
        Their sum as the filter of the sensor leaves it; NaN without a fit.
    """
    from gyrostab.allan.band_limit import limit_response
    from gyrostab.allan.fit import refit

    estimates, names = refit(product), list(LAWS)
    squares = np.stack([estimates[name].values ** 2 for name in names], axis=-1)
    terms = surface_columns(product).T * np.nan_to_num(squares)[..., None]
    for name, response in _RESPONSES.items():
        if response in product:
            values = product[response].values
            terms[:, :, names.index(name)] *= np.where(np.isfinite(values), values, 1.0)
    left = terms.copy()
    left[:, :, names.index("N")] *= np.atleast_2d(limit_response(product, product["tau"].values))[
        :, None
    ]
    is_fitted = np.isfinite(squares).any(axis=-1)[..., None]
    return terms, np.where(is_fitted, left.sum(axis=2), np.nan)


def _draw_terms(
    panel: Axes, window: xr.Dataset, terms: Floats, total: Floats, colours: list[str]
) -> None:
    """Draw the fitted curve in black and observed terms dashed; list limits in the legend."""
    tau = window["tau"].values
    for number, (symbol, law) in enumerate(LAWS.items()):
        state = int(window["observable"].sel(term=symbol))
        value, error, upper = (float(window[f"{symbol}{end}"]) for end in ("", "_stderr", "_upper"))
        if state == OBSERVED:
            spread = f" ± {error:.1g}" if np.isfinite(error) else ""
            label = f"{symbol} = {value:.3g}{spread} {unit_symbol(law.label)} ({law.name})"
            panel.plot(
                tau,
                np.sqrt(terms[number]),
                linestyle=_DASHES[number],
                color=colours[number],
                linewidth=1.3,
                label=label,
            )
        elif state == UPPER_LIMIT_ONLY:
            label = f"{symbol} < {upper:.3g} {unit_symbol(law.label)} ({law.name})"
            panel.plot([], [], linestyle="none", label=label)
    if np.nansum(total) > 0:
        panel.plot(tau, np.sqrt(total), color="black", linewidth=1.6, label=_name_curve(window))


def _name_curve(window: xr.Dataset) -> str:
    """Label the fitted curve, with its misfit."""
    from gyrostab.allan.window_fit import is_described

    chi2, dof = float(window["fit_chi2"]), float(window["fit_dof"])
    if not dof > 0:
        return "sum of the fitted terms"
    verdict = "" if is_described(chi2, dof) else ": the terms do not describe this window"
    return f"sum of the fitted terms, χ²/dof = {chi2 / dof:.3g}{verdict}"

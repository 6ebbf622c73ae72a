"""Options of a fit, and the cells of a surface as arrays."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import xarray as xr

from gyrostab.allan.compute import TREND_RESPONSES
from gyrostab.allan.freedoms import thin_factors
from gyrostab.allan.window_fit import FitTables, fit_tables
from gyrostab.arrays import Ints
from gyrostab.errors import OptionError, SchemaError
from gyrostab.kernels.fit.covariance import STOCHASTIC
from gyrostab.noise import TERMS
from gyrostab.schema import check_surface
from gyrostab.time.durations import PRINTED_DIGITS, duration_seconds
from gyrostab.units import HOUR

#: Variables of a surface that a fit uses: by averaging time, and those of the trend by window.
FIT_VARIABLES = (
    "avar",
    "white_response",
    "quantization_response",
    "ramp_response",
    "gap_factor",
    "window_trend",
    *TREND_RESPONSES,
)
#: Those that the first versions did not write, and others with their dimensions.
_LATER_VARIABLES = {
    "ramp_response": "white_response",
    "trend_quantization_response": "trend_response",
    "trend_flicker_response": "trend_response",
    "trend_walk_response": "trend_response",
}


def term_bits(terms: Iterable[str]) -> int:
    """Return a set of terms as the bits of a number, Q the lowest."""
    return sum(1 << TERMS.index(term) for term in terms)


def check_fit_options(
    terms: str | Iterable[str] = "QNBKR", tau_min: Any = None, tau_max: Any = None, **other: Any
) -> tuple[list[str], float, float]:
    """Check options of `fit_noise` as far as they do not depend on the surface; ignore others.

    Returns
    -------
    terms : list of str
        Terms to fit.
    low, high : float
        Shortest and longest averaging time to fit [s].

    Examples
    --------
    >>> check_fit_options("NB", tau_min="1min")
    (['N', 'B'], 60.0, inf)
    """
    fitted_terms = list(dict.fromkeys(terms if np.iterable(terms) else [terms]))
    unknown = [term for term in fitted_terms if term not in TERMS]
    if unknown or not fitted_terms:
        raise OptionError(f"terms {unknown or fitted_terms}: choose among {', '.join(TERMS)}")
    low = 0.0 if tau_min in (None, "all") else duration_seconds(tau_min, "tau_min (--fit-from)")
    high = np.inf if tau_max is None else duration_seconds(tau_max, "tau_max (--fit-to)")
    return fitted_terms, low, high


def resolve_fit_options(
    surface: xr.Dataset, terms: str | Iterable[str], tau_min: Any, tau_max: Any
) -> tuple[list[str], Ints]:
    """Check the options of a fit; return the terms, and the positions of the averaging times."""
    check_surface(surface)
    fitted_terms, low, high = check_fit_options(terms, tau_min, tau_max)
    if surface.attrs.get("variance") == "hadamard" and fitted_terms == ["R"]:
        raise OptionError("terms 'R': the Hadamard variance does not see a ramp")
    tau = surface["tau"].values
    chosen = np.flatnonzero(
        (tau >= low * (1 - PRINTED_DIGITS)) & (tau <= high * (1 + PRINTED_DIGITS))
    )
    if chosen.size == 0:
        limits = [f"from {low:g} s on"] * (low > 0) + [f"up to {high:g} s"] * (high < np.inf)
        raise OptionError(
            f"the surface has no averaging time {' and '.join(limits)}; it has {tau[0]:g} s to "
            f"{tau[-1]:g} s; change tau_min (--fit-from) or tau_max (--fit-to)"
        )
    return fitted_terms, chosen


def fit_inputs(surface: xr.Dataset, allowed: int = 31) -> tuple[list[Any], Ints, float, int]:
    """Collect the cells as (axis, time, tau) arrays, averaging factors, rate and window length.

    Trend and its responses follow, and whether its product with the noise is removed (axis, time,
    1). The line of slope b through a window of which the second differences show the slope s adds
    ``b (2 s - b) tau^2 / 2`` to the Allan variance. Without gaps s is near b, and its scatter is
    known (`gyrostab.kernels.fit.trend`). Through gaps it is not, but s is measured, and what
    exceeds ``b^2 tau^2 / 2`` is removed here.
    """
    try:
        rate = float(surface.attrs["sampling_rate_hz"])
        window = int(surface.attrs["window_samples"])
    except KeyError as missing:
        raise SchemaError(
            f"the surface lacks the attribute {missing}; it is not what gyrostab.davar writes"
        ) from missing
    ks = np.round(np.asarray(surface["tau"].values) * rate).astype(np.int64)
    absent = [name for name in FIT_VARIABLES if name not in {*surface, *_LATER_VARIABLES}]
    if absent:
        raise SchemaError(
            f"the surface lacks {absent}, which the fit needs to account for gaps and ramps; make "
            "it with gyrostab.davar"
        )
    for name, similar in _LATER_VARIABLES.items():  # written by a version that took it as 1
        if name not in surface:
            surface = surface.assign({name: xr.ones_like(surface[similar])})
    cells = [surface[name].data for name in FIT_VARIABLES]
    cells[5:] = [plane[..., None] for plane in cells[5:]]
    if "difference_trend" in surface and allowed >> STOCHASTIC & 1:
        trend, difference_trend = cells[5], surface["difference_trend"].data
        excess = cells[3] * (surface["tau"].values / HOUR) ** 2 * trend * (difference_trend - trend)
        cells[0] = cells[0] - np.nan_to_num(excess)
        exact = np.isfinite(difference_trend).any(axis=-1, keepdims=True)
    else:
        exact = np.zeros_like(cells[5], dtype=bool)
    return [*cells, exact], ks, rate, window


def prepare_fit(
    surface: xr.Dataset, within: Ints, allowed: int
) -> tuple[list[Any], FitTables, Ints]:
    """Return the cells of a surface, and tables and positions of the averaging times to fit."""
    cells, ks, rate, window = fit_inputs(surface, allowed)
    chosen = within[thin_factors(ks[within])]
    variance = surface.attrs.get("variance", "avar")
    tables = fit_tables(tuple(ks[chosen].tolist()), rate, window, variance)
    return cells, tables, chosen

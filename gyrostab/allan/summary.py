"""Summaries of a product over the whole record: noise terms, misfit, outliers and motion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import xarray as xr

from gyrostab.allan.fit import refit
from gyrostab.allan.judgement import judge_product
from gyrostab.allan.window_fit import is_described
from gyrostab.arrays import Bools, Floats
from gyrostab.noise import LAWS
from gyrostab.schema import OBSERVED, UPPER_LIMIT_ONLY, check_product
from gyrostab.wording import format_rounded, format_share

#: Largest number of windows that are fitted again to find the averaging time from which the terms
#: describe the record.
_MAX_TRIED_WINDOWS = 24
#: Share of failing windows up to which nothing is reported: a window that the terms do describe
#: fails in 0.1 to 1 % of cases (docs/method.md), and one of a few windows is not evidence.
_MAX_FAILING_SHARE = 0.05
#: Smallest ratio of longest to shortest averaging time: over a decade, the Allan variances of
#: neighbouring terms, whose slopes differ by one, diverge by a factor of ten.
_MIN_TAU_RATIO = 10.0
#: Twice the rotation rate of the Earth, 15.041 deg/h: the largest change of the mean rate that a
#: change of attitude at rest can cause.
_MAX_CHANGE_AT_REST_DPH = 30.082
#: Largest ratio of the scatter next to gaps to that elsewhere (median of the windows) that is not
#: reported: at least 1.7 standard deviations in a record of one window with few gaps.
_MAX_EDGE_RATIO = 1.25
#: Largest Allan deviation of a constant axis, divided by its mean: rounding errors.
_ROUNDING = 1e-9


@dataclass(frozen=True)
class TermSummary:
    """One noise term of one axis over all windows."""

    #: Axis, symbol of IEEE Std 952, unit of the coefficient.
    axis: str
    symbol: str
    unit: str
    #: ``observed`` if at least as many windows observe the term as give only an upper limit, else
    #: ``upper_limit_only``; ``not_observable`` if no window gives either.
    status: Literal["observed", "upper_limit_only", "not_observable"]
    #: Median, 5 % and 95 % quantiles over the windows that observe the term [unit]; NaN without
    #: such windows.
    median: float
    low: float
    high: float
    #: Median of the upper limits over the windows with an upper limit only [unit]; NaN without such
    #: windows.
    limit: float
    #: Shares of the windows [1].
    observed_share: float
    limited_share: float

    @property
    def value(self) -> float:
        """Median of the values or upper limits, by `status` [unit]; NaN if not observable."""
        return {"observed": self.median, "upper_limit_only": self.limit}.get(self.status, np.nan)


@dataclass(frozen=True)
class FitSummary:
    """How well the fitted terms describe the windows of one axis."""

    axis: str  # axis
    windows: int  # windows with a fit
    chi2_per_dof: float  # median of ``fit_chi2 / fit_dof`` [1]; NaN without a fit
    failing_share: float  # share of the windows that the terms do not describe [1]
    #: Shortest averaging time of the fit and time constant of the filter of the sensor [s]; the
    #: latter is 0 without a filter.
    tau_min: float
    filter_time_constant: float

    @property
    def fails(self) -> bool:
        """True if more windows fail than chance explains."""
        return self.failing_share > _MAX_FAILING_SHARE


def summarise_terms(product: xr.Dataset) -> list[TermSummary]:
    """Summarise each noise term of each axis over the windows of a product.

    Returns
    -------
    list of TermSummary
        By axis, in the order Q, N, B, K, R.

    Raises
    ------
    SchemaError
        If `product` is not a product.

    Examples
    --------
    >>> from gyrostab import davar, fit_noise, make_log
    >>> noise = 6.0 * np.random.default_rng(1).standard_normal(60_000)  # N = 0.01 deg/sqrt(h)
    >>> product = fit_noise(davar(make_log(noise, rate=100.0, unit="deg/h"), window="1min"))
    >>> term = summarise_terms(product)[1]
    >>> term.symbol, term.status, float(f"{term.value:.1g}")
    ('N', 'observed', 0.01)
    """
    check_product(product)
    terms = product[["observable", *LAWS, *(f"{symbol}_upper" for symbol in LAWS)]]
    return [
        _summarise_term(part, str(axis), symbol)
        for axis, part in ((axis, terms.sel(axis=axis)) for axis in product["axis"].values)
        for symbol in LAWS
    ]


def _summarise_term(part: xr.Dataset, axis: str, symbol: str) -> TermSummary:
    state = part["observable"].sel(term=symbol).values
    values = _drop_nans(part[symbol].values[state == OBSERVED])
    limits = _drop_nans(part[f"{symbol}_upper"].values[state == UPPER_LIMIT_ONLY])
    status: Literal["observed", "upper_limit_only", "not_observable"] = "not_observable"
    if values.size >= max(limits.size, 1):
        status = "observed"
    elif limits.size:
        status = "upper_limit_only"
    low, median, high = np.quantile(values, [0.05, 0.5, 0.95]) if values.size else (np.nan,) * 3
    limit = float(np.median(limits)) if limits.size else np.nan
    shares = (number / max(state.size, 1) for number in (values.size, limits.size))
    return TermSummary(
        axis,
        symbol,
        LAWS[symbol].label,
        status,
        float(median),
        float(low),
        float(high),
        limit,
        *shares,
    )


def find_constant_axes(product: xr.Dataset) -> list[str]:
    """Find the axes whose values differ by no more than rounding errors.

    Examples
    --------
    >>> from gyrostab import davar, make_log
    >>> rate = np.array([np.full(600, 0.1), np.random.default_rng(1).standard_normal(600)])
    >>> find_constant_axes(davar(make_log(rate, rate=10.0, unit="deg/h"), window="1min"))
    ['x']
    """
    rounding = (_ROUNDING * abs(product["window_mean"]).max("time")) ** 2
    is_constant = product["avar"].max(("time", "tau")) <= rounding
    return [str(axis) for axis in product["axis"].values[is_constant.values]]


def _drop_nans(values: Floats) -> Floats:
    return values[np.isfinite(values)]


def summarise_fit(product: xr.Dataset) -> list[FitSummary]:
    """Summarise for each axis of a product how well the fitted terms describe its windows.

    Examples
    --------
    >>> from gyrostab import davar, fit_noise, make_log
    >>> noise = np.random.default_rng(1).standard_normal(60_000)
    >>> product = fit_noise(davar(make_log(noise, rate=100.0, unit="deg/h"), window="1min"))
    >>> summarise_fit(product)[0].fails
    False
    """
    check_product(product)
    summaries = []
    for axis in product["axis"].values:
        chi2, dof = (product[name].sel(axis=axis).values for name in ("fit_chi2", "fit_dof"))
        fitted = np.isfinite(chi2) & (dof > 0)
        count = int(np.count_nonzero(fitted))
        ratio = float(np.median(chi2[fitted] / dof[fitted])) if count else np.nan
        failing = float(np.mean(~is_described(chi2[fitted], dof[fitted]))) if count else 0.0
        band = (
            float(product[name].sel(axis=axis)) if name in product else 0.0
            for name in ("fit_tau_min", "filter_time_constant")
        )
        summaries.append(FitSummary(str(axis), count, ratio, failing, *band))
    return summaries


def find_fit_from(product: xr.Dataset) -> float | None:
    """Find the shortest averaging time from which the fitted terms describe a product.

    A filter, a spectral line or motion bends the curve at short averaging times. Up to 24 windows,
    spread over the record, are fitted again from averaging times a factor of two apart. Windows
    with outliers do not count, because outliers add to N at every averaging time.

    Returns
    -------
    float or None
        Averaging time [s] for ``--fit-from`` (``tau_min`` of `gyrostab.fit_noise`); None if the
        terms describe the product as it is, or no such averaging time leaves a decade to fit.
    """
    judged = _without_outliers(product)
    failing = [summary.axis for summary in summarise_fit(judged) if summary.fails]
    if not failing:
        return None
    is_fitted = np.isfinite(judged["fit_chi2"].sel(axis=failing).transpose("axis", "time").values)
    used = np.flatnonzero(is_fitted.any(axis=0))
    places = np.linspace(0, used.size - 1, min(_MAX_TRIED_WINDOWS, used.size))
    tried = used[np.unique(places.round().astype(int))]
    windows = product.sel(axis=failing).isel(time=tried).compute()
    tau = windows["tau"].values
    longest = float(product.attrs.get("fit_tau_max_s", tau[-1]))
    shortest = 2.0 * float(product.attrs.get("fit_tau_min_s", tau[0]))
    for start in tau[tau <= longest / _MIN_TAU_RATIO]:
        if start < shortest:
            continue
        refitted = _without_outliers(refit(windows, tau_min=float(start)))
        if not any(summary.fails for summary in summarise_fit(refitted)):
            return float(start)
        shortest = 2.0 * start
    return None


def _without_outliers(product: xr.Dataset) -> xr.Dataset:
    """Remove the misfit of the windows that hold outliers."""
    if "outlier_count" not in product:
        return product
    return product.assign(fit_chi2=product["fit_chi2"].where(product["outlier_count"] == 0))


def format_product(product: xr.Dataset) -> str:
    """Format a product as the text that ``gyrostab run`` prints.

    Returns
    -------
    str
        A table of the terms, one line each on misfit, outliers and motion, and two of judgement.
    """
    windows = product.sizes["time"]
    # together, because dask spends milliseconds on each variable
    product = product.assign(product.drop_dims("tau").compute().data_vars)
    if windows == 1:
        over, columns = " of a single window", ("value", "standard error")
    else:
        over, columns = f", median over {windows} windows", ("median", "5 % to 95 %")
    lines = [f"Noise coefficients{over} (<: 95 % upper limit)", ""]
    rows = [("axis", "term", *columns, "unit", "observed in")]
    for term in summarise_terms(product):
        spread = describe_spread(product, term) if term.status == "observed" else ""
        sign = "< " if term.status == "upper_limit_only" else ""
        rows.append(
            (
                term.axis,
                term.symbol,
                sign + _number_text(term.value),
                spread,
                term.unit,
                _share_or_all(term.observed_share),
            )
        )
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines += [
        "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True))
        for row in rows
    ]
    return "\n".join([*lines, "", *describe_record(product), *judge_product(product)])


def describe_spread(product: xr.Dataset, term: TermSummary) -> str:
    """Return the range of a term over the windows, or its standard error in a single window."""
    if product.sizes["time"] > 1:
        return f"{_number_text(term.low)} to {_number_text(term.high)}"
    return _number_text(float(product[f"{term.symbol}_stderr"].sel(axis=term.axis)[0]))


def describe_record(product: xr.Dataset) -> list[str]:
    """Describe in a few sentences the misfit of a product, its outliers and motion.

    Returns
    -------
    list of str
        One sentence on the misfit, and one each on a filter of the sensor, outliers, losses of
        noisy samples and motion if there are any.
    """
    return [
        *_describe_misfit(product),
        *_describe_filter(product),
        *_describe_outliers(product),
        *_describe_losses(product),
        *_describe_motion(product),
    ]


def _number_text(value: float) -> str:
    return format_rounded(value, 3) if np.isfinite(value) else "-"


def _share_or_all(share: float) -> str:
    return "all" if share == 1.0 else format_share(share)


def _count_windows(affected: Bools) -> str:
    """Return the number of affected windows in words.

    Examples
    --------
    >>> _count_windows(np.array([True, False])), _count_windows(np.array([True, True]))
    ('1 window', '2 windows')
    """
    count = int(np.count_nonzero(affected))
    return f"{count} window{'s' * (count > 1)}"


def _describe_misfit(product: xr.Dataset) -> list[str]:
    fits = [summary for summary in summarise_fit(product) if summary.windows]
    if not fits:
        return []
    ratios = ", ".join(f"{fit.axis} {_number_text(fit.chi2_per_dof)}" for fit in fits)
    lines = [f"Misfit, median chi2/dof (0.8 to 1 where the terms describe the noise): {ratios}."]
    failing = [
        f"{fit.axis} in {_share_or_all(fit.failing_share)} of its windows"
        for fit in fits
        if fit.fails
    ]
    if failing:
        line = f"The terms do not describe {', '.join(failing)}; no term counts as observed there"
        start = find_fit_from(product)
        if start:
            remedy = f"they do above {start:g} s: fit again with tau_min (--fit-from) {start:g}s"
        elif not any(fit.fails for fit in summarise_fit(_without_outliers(product))):
            remedy = "these windows hold outliers, which no tau_min (--fit-from) removes"
        else:
            remedy = (
                "no tau_min (--fit-from) changes that: look for spectral lines, vibration or "
                "motion in the record"
            )
        if len(product.attrs.get("fit_terms", LAWS)) < len(LAWS):
            remedy += f", or fit all terms (--terms {''.join(LAWS)})"
        lines.append(f"{line}; {remedy}.")
    return lines


def _describe_filter(product: xr.Dataset) -> list[str]:
    filtered = [
        f"{fit.axis} below {_number_text(fit.tau_min)} s (like a low-pass with a time constant of "
        f"{_number_text(fit.filter_time_constant)} s)"
        for fit in summarise_fit(product)
        if fit.filter_time_constant > 0
    ]
    if not filtered:
        return []
    return [
        f"Averaging times at which a filter shapes the noise are left out: {', '.join(filtered)}. "
        "N, B and K describe the noise without the filter; Q is not observable."
    ]


def _describe_outliers(product: xr.Dataset) -> list[str]:
    if "outlier_count" not in product:
        return []
    worst = {
        str(axis): product["outlier_count"].sel(axis=axis).values for axis in product["axis"].values
    }
    affected = [
        f"{axis} in {_count_windows(counts > 0)} (at most {int(counts.max())} in one)"
        for axis, counts in worst.items()
        if counts.size and counts.max() > 0
    ]
    if affected:
        return [
            f"Outliers, single samples far from both neighbours: {', '.join(affected)}; N includes "
            "them."
        ]
    return []


def _describe_losses(product: xr.Dataset) -> list[str]:
    """Say which axes lose samples while their noise is high, and how low that makes N."""
    if "gap_edge_ratio" not in product:
        return []
    affected = []
    for axis in product["axis"].values:
        part = product.sel(axis=axis)
        judged = np.isfinite(part["gap_edge_ratio"].values) & (part["outlier_count"].values == 0)
        if not judged.any():
            continue
        ratio = float(np.median(part["gap_edge_ratio"].values[judged]))
        present = float(np.median(part["window_coverage"].values[judged]))
        if ratio > _MAX_EDGE_RATIO:
            low = 1.0 - 1.0 / np.sqrt(present + (1.0 - present) * ratio**2)
            too_low = f"N may be too low by {100 * low:.0f} %"
            affected.append(f"{axis} {_number_text(ratio)} times ({too_low})")
    if not affected:
        return []
    return [
        f"Noise next to gaps is higher than elsewhere: {', '.join(affected)}. Samples are lost "
        "while the noise is high, and the record underestimates it."
    ]


def _describe_motion(product: xr.Dataset) -> list[str]:
    moved = []
    for axis in product["axis"].values:
        mean = product["window_mean"].sel(axis=axis).values
        away = np.abs(mean - np.nanmedian(mean)) if np.isfinite(mean).any() else np.zeros(1)
        moving = away > _MAX_CHANGE_AT_REST_DPH
        if moving.any():
            largest = _number_text(float(np.nanmax(away)))
            moved.append(f"{axis} in {_count_windows(moving)} (up to {largest} deg/h)")
    if not moved:
        return []
    return [
        "The mean rate departs from its median by more than twice the Earth rate: "
        f"{', '.join(moved)}. The cause is motion or a drifting bias; leave out such times "
        "(--exclude, or log.sel(time=...))."
    ]

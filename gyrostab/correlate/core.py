"""Correlate window means and coefficients with a channel and its rate of change."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.correlate.dataset import assemble
from gyrostab.correlate.drivers import Driver, align_drivers, other_channels
from gyrostab.correlate.judge import VERDICTS, describe_coupling, driver_limits, slope_label
from gyrostab.errors import OptionError
from gyrostab.kernels.regression.coupling import (
    Laws,
    calibrated,
    decompose,
    fit_lags,
    noise_laws,
    null_weights,
    p_values,
    project_out,
    simulate_p_values,
    slope_interval,
    uncalibrated,
    weights,
)
from gyrostab.kernels.regression.windows import average_windows
from gyrostab.noise import TERMS
from gyrostab.schema import OBSERVED, check_product
from gyrostab.time.durations import duration_seconds

__all__ = ["correlate"]

Array = NDArray[np.float64]
_MAX_BLOCKS = 160  # longer records are averaged further
_MAX_LAGS = 48
_MAX_SIMULATED_LAGS = 12  # in the simulation of the search; lags in between add no information
_MAX_WINDOWS_PER_LENGTH = 8  # more add no information
_MIN_BLOCKS = 12
_SIGNIFICANCE = 0.05
_NOISE_DRAWS = (300, 4000)  # the second where the result of the first may be significant
#: Smallest share of the variance of a driver that the other drivers do not explain.
_MIN_UNEXPLAINED = 1e-3
#: Keys of `_estimate_sensitivity`, and those of the same numbers given the other drivers.
_PARTIAL = {
    "slope": "partial",
    "stderr": "partial_stderr",
    "low": "partial_low",
    "high": "partial_high",
    "p_value": "p_partial",
}
#: Largest share of one block in the variance of the driver; above it, that block decides alone.
_MAX_LEVERAGE = 0.35


class _Blocks(NamedTuple):
    """Blocks of the windows that some series share, and the model terms besides the driver."""

    average: Any
    windows: NDArray[np.int64]
    pieces: NDArray[np.int64]
    offsets: Array
    trend: Array
    laws: Laws


def correlate(
    product: xr.Dataset,
    *,
    channel: str | xr.DataArray | Sequence[str | xr.DataArray] = "temperature",
    variables: str | Sequence[str] | None = None,
    max_lag: Any = None,
    level: float = 0.95,
) -> xr.Dataset:
    """Estimate the coupling of window means and coefficients with a channel and its rate of change.

    Each series is regressed on the driver at every lag by generalised least squares, together with
    a constant, a trend in time and a constant for every segment between long gaps. The noise of the
    series is white (shared by overlapping windows) plus a slow part of unknown strength and memory;
    slopes and p-values are averaged over these noise laws, weighted by their restricted likelihood.
    The p-value allows for the search over lags (by simulation with a fixed seed) and over axes,
    variables and drivers (Holm).

    Parameters
    ----------
    product : xarray.Dataset
        Product of `gyrostab.fit_noise`.
    channel : str, DataArray or sequence of them
        Channel of the product, or a channel with a separate time coordinate, which is averaged over
        the windows. With several, the rates of change are drivers only if they are named
        (``["temperature", "temperature_rate", "vibration"]``), and the partial effect of each
        driver is estimated, given the others at their best-fitting lags.
    variables : str or sequence of str, optional
        Names with dims ``(axis, time)``; by default ``window_mean`` and every coefficient that is
        observed in at least one window.
    max_lag : str, timedelta or number, optional
        Longest time by which the gyro may follow the channel [s]; a tenth of the record by default,
        0 for none.
    level : float
        Level of the intervals.

    Returns
    -------
    xarray.Dataset
        By ``(axis, variable, driver)``: ``coupling_lag`` [s], ``correlation``,
        ``partial_correlation_time``, ``partial_correlation_channels``, ``p_value``,
        ``p_value_adjusted``, ``effective_samples``, ``windows_used``, ``coupling_verdict``,
        ``coupling_limits`` (flags), ``statement``; by ``axis`` the sensitivity
        ``<variable>_per_<driver>`` with ``_stderr``, ``_low``, ``_high``, ``_rising``, ``_falling``
        [units of the variable per unit of the driver]; and the series themselves. With several
        channels also ``p_value_partial``, and ``<variable>_per_<driver>_partial`` with
        ``_partial_stderr``, ``_partial_low``, ``_partial_high``.

    Raises
    ------
    OptionError, SchemaError, TimeError
        If a name is unknown, the lag is invalid, or the channel does not overlap the record.

    Examples
    --------
    >>> import gyrostab
    >>> product = gyrostab.open_product("product.nc")                # doctest: +SKIP
    >>> result = gyrostab.correlate(product, max_lag="2h")           # doctest: +SKIP
    >>> result["window_mean_per_temperature"].sel(axis="x")          # doctest: +SKIP
    """
    check_product(product)
    if not 0.5 <= level < 1.0:
        raise OptionError(
            f"level {level:g}: the level of an interval lies between 0.5 and 1, for instance 0.95"
        )
    names = _select_variables(product, variables)
    time = (product["time"].values - product["time"].values[0]) / np.timedelta64(1, "s")
    length, step = _window_lengths(product, time)
    lags = _choose_lags(max_lag, float(time[-1] - time[0]) if time.size else 0.0, step)
    channels = [channel] if isinstance(channel, str | xr.DataArray) else list(channel)
    drivers = align_drivers(product, channels, lags, step)
    others = [product[name].values for name in other_channels(product, drivers)]
    entries: dict[tuple[int, int, int], dict[str, Any]] = {}
    groups: dict[bytes, list[tuple[int, int]]] = {}
    masks, lags, drivers = _usable_windows(product, names, lags, drivers)
    for place, mask in masks.items():
        groups.setdefault(mask.tobytes(), []).append(place)
    for places in groups.values():
        blocks = _make_blocks(
            masks[places[0]], time, length, step, product["window_coverage"].values[places[0][0]]
        )
        series = (
            np.stack([product[names[v]].values[a] for a, v in places], axis=1)[blocks.windows]
            if blocks
            else np.empty((0, len(places)))
        )
        fitted = [
            _fit_driver(blocks, series, driver, others, lags.astype(np.float64) * step, level)
            for driver in drivers
        ]
        if len(channels) > 1:
            for row, of_series in zip(series.T, zip(*fitted, strict=True), strict=True):
                _fit_partial_effects(blocks, row, drivers, of_series, level)
        for d, of_driver in enumerate(fitted):
            entries |= {(*place, d): entry for place, entry in zip(places, of_driver, strict=True)}
    _adjust_p_values(entries)
    for (a, v, d), entry in entries.items():
        entry["unit_label"] = slope_label(product[names[v]], drivers[d].units)
        series_name = f"{names[v].replace('_', ' ')} of axis {product['axis'].values[a]}"
        entry["statement"] = describe_coupling(entry, drivers[d].label, series_name)
    return assemble(product, names, drivers, entries, level=level, longest=float(lags[-1] * step))


def _select_variables(product: xr.Dataset, variables: str | Sequence[str] | None) -> list[str]:
    if variables is None:
        seen = [
            term for term in TERMS if bool((product["observable"].sel(term=term) == OBSERVED).any())
        ]
        return ["window_mean", *seen]
    names = [variables] if isinstance(variables, str) else list(variables)
    for name in names:
        if name not in product or product[name].dims != ("axis", "time"):
            raise OptionError(
                f"variable {name!r} is not in the product by (axis, time); try window_mean, "
                f"{', '.join(TERMS)}"
            )
    return names


def _window_lengths(product: xr.Dataset, time: Array) -> tuple[float, float]:
    """Find length and step of the windows [s]."""
    bounds = product["time_bounds"].values
    length = (
        float(np.median(bounds[:, 1] - bounds[:, 0]) / np.timedelta64(1, "s"))
        if len(bounds)
        else 1.0
    )
    spacing = float(np.median(np.diff(time))) if time.size > 1 else length
    return length, float(product.attrs.get("step_s", spacing))


def _choose_lags(max_lag: Any, span: float, step: float) -> NDArray[np.int64]:
    longest = 0.0
    if max_lag is None:
        longest = 0.1 * span
    elif max_lag and str(max_lag).strip() != "0s":
        longest = duration_seconds(max_lag, "max_lag")
    if longest > span:
        raise OptionError(
            f"max_lag {max_lag} is longer than the record ({span:g} s); give a shorter --max-lag"
        )
    most = int(longest / step + 1e-9)
    return np.unique(np.rint(np.linspace(0, most, min(most + 1, _MAX_LAGS))).astype(np.int64))


def _usable_windows(
    product: xr.Dataset, names: list[str], lags: NDArray[np.int64], drivers: list[Driver]
) -> tuple[dict[tuple[int, int], NDArray[np.bool_]], NDArray[np.int64], list[Driver]]:
    """Find the windows of each (axis, variable) in which series and driver are known at every lag.

    Lags that would cost more than a third of the windows are left out.
    """
    known = np.logical_and.accumulate(
        np.all([np.isfinite(driver.values) for driver in drivers], axis=0), axis=0
    )
    most = int(np.flatnonzero(known.sum(axis=1) >= min(2 / 3 * known[0].sum(), known[0].sum()))[-1])
    lags = lags[: most + 1]
    drivers = [
        Driver(driver.name, driver.label, driver.units, driver.values[: most + 1])
        for driver in drivers
    ]
    masks = {}
    for v, name in enumerate(names):
        good = np.isfinite(product[name].values) & (product["window_coverage"].values > 0.05)
        if name in TERMS:
            good &= product["observable"].sel(term=name).values == OBSERVED
        for a in range(product.sizes["axis"]):
            masks[a, v] = good[a] & known[most]
    return masks, lags, drivers


def _make_blocks(
    mask: NDArray[np.bool_], time: Array, length: float, step: float, share: Array
) -> _Blocks | None:
    """Group windows into blocks at least as long as a window; None if there are too few."""
    windows = np.flatnonzero(mask)
    every = max(1, round(length / step / _MAX_WINDOWS_PER_LENGTH))
    windows = (
        windows[np.rint(time[windows] / step).astype(np.int64) % every == 0]
        if every > 1
        else windows
    )
    if windows.size < _MIN_BLOCKS:
        return None
    centres_s = time[windows]
    block_length = max(length, step, (np.count_nonzero(mask) * step) / _MAX_BLOCKS)
    numbers = np.unique((centres_s / block_length).astype(np.int64), return_inverse=True)[1]
    if numbers[-1] + 1 < _MIN_BLOCKS:
        return None
    average = average_windows(numbers)
    centre = np.asarray(average @ centres_s)
    spacing = np.diff(centre)
    covered = (numbers[-1] + 1) * block_length
    pieces = np.concatenate(
        [[0], np.cumsum(spacing > max(3 * length + block_length, 0.1 * covered))]
    )
    pieces = pieces.astype(np.int64)
    offsets = (pieces[:, None] == np.arange(pieces[-1] + 1)).astype(np.float64)
    trend = ((centre - centre.mean()) / (np.ptp(centre) or 1.0))[:, None]
    laws = noise_laws(average, centres_s, length, np.clip(share[windows], 0.05, 1.0))
    return _Blocks(average, windows, pieces, offsets, trend, laws)


def _fit_driver(
    blocks: _Blocks | None,
    series: Array,
    driver: Driver,
    others: list[Array],
    lags: Array,
    level: float,
) -> list[dict[str, Any]]:
    """Fit one driver to series that share their windows, with one entry per series."""
    if blocks is None:
        return [_empty_entry({"too_few"}) for _ in range(series.shape[1])]
    x = np.asarray(blocks.average @ driver.values[:, blocks.windows].T)
    y = np.asarray(blocks.average @ series)
    limits = driver_limits(
        x[:, 0], blocks.pieces, driver.units, derived=driver.name.endswith("_rate")
    )
    timed = np.concatenate([blocks.offsets, blocks.trend], axis=1)
    nuisance = blocks.offsets if "no_reversal" in limits else timed
    if not limits & {"constant", "too_few"}:
        if x.shape[0] - nuisance.shape[1] - 1 < _MIN_BLOCKS // 2:
            limits = limits | {"too_few"}
        elif _largest_leverage(x[:, 0], nuisance) > _MAX_LEVERAGE:
            limits = limits | {"one_moment"}
    if limits & {"constant", "too_few", "one_moment"}:
        return [_empty_entry(limits, windows=blocks.windows.size) for _ in range(series.shape[1])]
    others = [
        np.asarray(blocks.average @ np.nan_to_num(row[blocks.windows]))
        for row in others
        if np.isfinite(row[blocks.windows]).all()
    ]
    with_channels = np.concatenate(
        [timed, *(_standardise_series(row)[:, None] for row in others if np.ptp(row) > 0)], axis=1
    )
    laws = project_out(blocks.laws, nuisance)
    white_laws = (
        project_out(decompose([_law_covariance(blocks, 0)], np.zeros(1)), nuisance)
        if "no_reversal" in limits
        else None
    )
    entries = []
    for row in y.T:
        if np.ptp(row) == 0.0:
            entries.append(_empty_entry(limits | {"too_few"}, windows=blocks.windows.size))
            continue
        entry = _estimate_sensitivity(laws, row, x, lags, level) | {
            "limits": set(limits),
            "windows": blocks.windows.size,
        }
        column = x[:, entry["best"]]
        entry |= {
            "correlation": _partial_correlation(row, column, np.ones((row.size, 1))),
            "partial_time": _partial_correlation(row, column, timed),
            "partial_channels": _partial_correlation(row, column, with_channels),
            "effective": _effective_samples(row, column, nuisance, entry["stderr"]),
        }
        entry |= _fit_ramps(blocks, entry["law"], nuisance, row[:, None], column[:, None])
        if white_laws is not None:
            white = _estimate_sensitivity(white_laws, row, x, lags, level)
            entry |= {
                f"{key}_white": white[other]
                for key, other in (("p", "p_search"), ("slope", "slope"), ("lag", "lag"))
            }
        if timed.shape[1] < with_channels.shape[1] < row.size - 3:
            channel_fit = fit_lags(
                project_out(blocks.laws, with_channels),
                row[:, None] / np.std(row),
                _standardise_series(column)[:, None],
            )
            entry["p_channels"] = float(p_values(channel_fit)[0, 0])
        entries.append(entry)
    return entries


def _fit_partial_effects(
    blocks: _Blocks | None,
    row: Array,
    drivers: list[Driver],
    entries: Sequence[dict[str, Any]],
    level: float,
) -> None:
    """Fit one series on every driver, given the others at their best-fitting lags."""
    for entry in entries:
        entry |= dict.fromkeys(_PARTIAL.values(), np.nan)
    fitted = [d for d, entry in enumerate(entries) if "best" in entry]
    if blocks is None:
        return
    y = np.asarray(blocks.average @ row)
    columns = {
        d: np.asarray(blocks.average @ drivers[d].values[entries[d]["best"], blocks.windows])
        for d in fitted
    }
    for d in fitted:
        others = [_standardise_series(columns[e])[:, None] for e in fitted if e != d]
        nuisance = np.concatenate([blocks.offsets, blocks.trend, *others], axis=1)
        if (
            y.size - nuisance.shape[1] - 1 < _MIN_BLOCKS // 2
            or _unexplained_share(columns[d], nuisance) < _MIN_UNEXPLAINED
        ):
            continue
        found = _estimate_sensitivity(
            project_out(blocks.laws, nuisance), y, columns[d][:, None], np.zeros(1), level
        )
        entries[d].update({partial: found[name] for name, partial in _PARTIAL.items()})


def _unexplained_share(x: Array, given: Array) -> float:
    """Compute the share of the variance of a series that a linear fit leaves."""
    q, _ = np.linalg.qr(given)
    return float(np.sum((x - q @ (q.T @ x)) ** 2) / max(float(np.var(x)) * x.size, 1e-300))


def _estimate_sensitivity(
    laws: Laws, y: Array, x: Array, lags: Array, level: float
) -> dict[str, Any]:
    """Find lag, slope and interval of one series, and its p-values at that lag and at any lag.

    The p-values are from noise that is simulated under the laws by their weights. The interval
    excludes 0 exactly where the p-value at that lag is below one minus the level.
    """
    scale, driver_scale = float(np.std(y)), np.maximum(np.std(x, axis=0), 1e-300)
    driver = (x - x.mean(axis=0)) / driver_scale
    fit = fit_lags(laws, ((y - y.mean()) / scale)[:, None], driver)
    p_of_lags = p_values(fit)[0]
    best = int(np.argmin(p_of_lags))
    simulated = np.unique(
        np.append(
            np.linspace(0, lags.size - 1, min(lags.size, _MAX_SIMULATED_LAGS)).astype(np.int64),
            best,
        )
    )
    for draws in _NOISE_DRAWS:
        p_of_noise = simulate_p_values(laws, driver[:, simulated], null_weights(fit, 0), draws)
        p_at_lag = p_of_noise[:, np.searchsorted(simulated, best)]
        p_value = calibrated(float(p_of_lags[best]), p_at_lag)
        p_search = max(p_value, calibrated(float(p_of_lags[best]), p_of_noise.min(axis=1)))
        if p_search > _SIGNIFICANCE:
            break
    interval = slope_interval(fit, 0, best, uncalibrated(1.0 - level, p_at_lag))
    slope, error, low, high = (value * scale / float(driver_scale[best]) for value in interval)
    entry = {
        "best": best,
        "lag": float(lags[best]),
        "law": int(np.argmax(weights(fit)[:, 0, best])),
        "p_value": p_value,
        "p_search": p_search,
    }
    return entry | {"slope": slope, "stderr": error, "low": low, "high": high}


def _law_covariance(blocks: _Blocks, law: int) -> Array:
    return np.asarray(blocks.laws.factor[law] @ blocks.laws.factor[law].T)


def _empty_entry(limits: set[str], *, windows: int = 0) -> dict[str, Any]:
    names = (
        "lag",
        "slope",
        "stderr",
        "low",
        "high",
        "p_value",
        "p_search",
        "correlation",
        "partial_time",
        "partial_channels",
    )
    empty = dict.fromkeys(
        (*names, "effective", "rising", "rising_stderr", "falling", "falling_stderr"), np.nan
    )
    return {**empty, "limits": limits, "windows": windows}


def _largest_leverage(x: Array, given: Array) -> float:
    """Find the largest share of one block in the variance of the driver."""
    q, _ = np.linalg.qr(given)
    left = (x - q @ (q.T @ x)) ** 2
    return float(left.max() / max(float(left.sum()), 1e-300))


def _standardise_series(row: Array) -> Array:
    return np.asarray((row - row.mean()) / np.std(row))


def _partial_correlation(y: Array, x: Array, given: Array) -> float:
    q, _ = np.linalg.qr(given)
    y, x = y - q @ (q.T @ y), x - q @ (q.T @ x)
    size = float(np.sqrt((y @ y) * (x @ x)))
    return float(np.clip(y @ x / size, -1.0, 1.0)) if size > 0 else np.nan


def _effective_samples(y: Array, x: Array, nuisance: Array, error: float) -> float:
    """Count the independent samples whose ordinary regression would have this standard error.

    The count is at most the number of blocks.
    """
    q, _ = np.linalg.qr(np.concatenate([nuisance, x[:, None]], axis=1))
    rest = y - q @ (q.T @ y)
    q, _ = np.linalg.qr(nuisance)
    left = x - q @ (q.T @ x)
    wanted = (
        float(rest.var() / (max(float(left.var()), 1e-300) * error**2)) if error > 0 else np.inf
    )
    return float(min(y.size, wanted + nuisance.shape[1] + 1))


def _fit_ramps(blocks: _Blocks, law: int, nuisance: Array, y: Array, x: Array) -> dict[str, float]:
    """Fit the slope while the driver rises and while it falls, each with a separate constant."""
    rises = np.gradient(x[:, 0]) > 0
    covariance = _law_covariance(blocks, law)
    out = {}
    for name, part in (("rising", rises), ("falling", ~rises)):
        chosen = np.flatnonzero(part)
        out[name] = out[f"{name}_stderr"] = np.nan
        columns = nuisance[chosen][:, 1:]  # the offsets of all segments add up to the constant
        columns = np.concatenate(
            [
                np.ones((chosen.size, 1)),
                columns[:, np.ptp(columns, axis=0) > 0] if chosen.size else columns,
            ],
            axis=1,
        )
        if chosen.size < _MIN_BLOCKS // 2 + columns.shape[1] or np.ptp(x[chosen]) < 0.1 * np.ptp(x):
            continue
        if (
            np.linalg.matrix_rank(
                np.concatenate([columns, _standardise_series(x[chosen, 0])[:, None]], axis=1)
            )
            <= columns.shape[1]
        ):
            continue
        fit = fit_lags(
            project_out(decompose([covariance[np.ix_(chosen, chosen)]], np.zeros(1)), columns),
            y[chosen],
            x[chosen],
        )
        out[name], out[f"{name}_stderr"] = float(fit.slope[0, 0, 0]), float(fit.stderr[0, 0, 0])
    return out


def _adjust_p_values(entries: dict[tuple[int, int, int], dict[str, Any]]) -> None:
    """Adjust the p-values of all entries by Holm's method, and set the verdicts."""
    tested = sorted(
        (entry for entry in entries.values() if np.isfinite(entry["p_search"])),
        key=lambda entry: float(entry["p_search"]),
    )
    previous = 0.0
    for rank, entry in enumerate(tested):
        previous = entry["p_adjusted"] = min(
            1.0, max(previous, (len(tested) - rank) * entry["p_search"])
        )
    for entry in entries.values():
        entry.setdefault("p_adjusted", np.nan)
        if entry["limits"] & {"constant", "too_few", "clusters"} or not np.isfinite(
            entry["p_search"]
        ):
            verdict = "cannot_tell"
        elif (
            entry["p_adjusted"] >= _SIGNIFICANCE
            and entry.get("p_white", 1.0) * len(tested) < _SIGNIFICANCE
        ):
            verdict = "not_told_apart"
        elif entry["p_adjusted"] >= _SIGNIFICANCE:
            verdict = "none_seen"
        else:
            # a partial effect that cannot be estimated (NaN) does not count as evidence
            if not all(entry.get(p, 0.0) < _SIGNIFICANCE for p in ("p_channels", "p_partial")):
                entry["limits"].add("other_channel")
            verdict = (
                "not_told_apart"
                if entry["limits"] & {"no_reversal", "other_channel"}
                else "coupled"
            )
        entry["verdict"] = VERDICTS.index(verdict)

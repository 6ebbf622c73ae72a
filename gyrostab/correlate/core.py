"""Coefficients and window means against a channel and its rate of change: lag, sensitivity, and whether it is more than chance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from gyrostab.correlate.dataset import assemble
from gyrostab.correlate.drivers import Driver, align_drivers, other_channels, slope_units
from gyrostab.correlate.judge import VERDICTS, describe_coupling, driver_limits
from gyrostab.errors import OptionError
from gyrostab.kernels.regression.coupling import (
    Laws,
    block_averages,
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
from gyrostab.noise import TERMS
from gyrostab.schema import OBSERVABLE, check_product
from gyrostab.time.durations import duration_seconds

__all__ = ["correlate"]

Array = NDArray[np.float64]
_MAX_BLOCKS = 160  # at most; longer records are averaged further
_MAX_LAGS = 48  # at most
_MAX_SIMULATED_LAGS = (
    12  # lags in the simulation of the search, at most: those between tell nothing new
)
_MAX_WINDOWS_PER_LENGTH = 8  # windows used per window length; more add nothing
_MIN_BLOCKS = 12
_SIGNIFICANCE = 0.05
_NOISE_DRAWS = (300, 4000)  # of noise; the second where the first leaves a claim possible
_MAX_LEVERAGE = (
    0.35  # share of the driver's variance in one block, above which the record hangs on that block
)


class _Blocks(NamedTuple):
    """Blocks of the windows that some series share, and what is beside the driver in the model."""

    average: Any
    windows: NDArray[np.int64]
    pieces: NDArray[np.int64]
    offsets: Array
    trend: Array
    laws: Laws


def correlate(
    product: xr.Dataset,
    *,
    channel: str | xr.DataArray = "temperature",
    variables: str | Sequence[str] | None = None,
    max_lag: Any = None,
    level: float = 0.95,
) -> xr.Dataset:
    """Coupling of the window means and noise coefficients with a channel and with its rate of change.

    Each series is regressed on the driver at every lag by generalised least squares, beside a
    constant, a trend in time and a constant for every stretch between long gaps. The noise of the
    series is white (windows that overlap share it) with a slow part of unknown strength and memory;
    slopes and p-values are averaged over these laws by their restricted likelihood. The p-value
    allows for the search over lags (by simulation with a fixed seed) and over axes, variables and
    drivers (Holm).

    Parameters
    ----------
    product : xarray.Dataset
        Product of `gyrostab.fit_noise`.
    channel : str or DataArray
        Channel of the product, or one with a time coordinate of its own, which is averaged inside
        the windows.
    variables : str or sequence of str, optional
        Names with dims ``(axis, time)``; ``window_mean`` and every coefficient that is observed
        somewhere by default.
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
        ``coupling_limits`` (flags), ``describe_coupling``; by ``axis`` the sensitivity
        ``<variable>_per_<driver>`` with ``_stderr``, ``_low``, ``_high``, ``_rising``, ``_falling``
        [units of the variable per unit of the driver]; and the series themselves.

    Raises
    ------
    OptionError, SchemaError, TimeError
        When a name or the lag makes no sense, or the channel lies outside the record.

    Examples
    --------
    >>> import gyrostab
    >>> product = gyrostab.open_product("product.nc")                # doctest: +SKIP
    >>> found = gyrostab.correlate(product, max_lag="2h")            # doctest: +SKIP
    >>> found["window_mean_per_temperature"].sel(axis="x")           # doctest: +SKIP
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
    found = align_drivers(product, channel, lags, step)
    others = other_channels(product, found[0].name)
    entries: dict[tuple[int, int, int], dict[str, Any]] = {}
    groups: dict[bytes, list[tuple[int, int]]] = {}
    masks, lags, found = _usable_windows(product, names, lags, found)
    for place, mask in masks.items():
        groups.setdefault(mask.tobytes(), []).append(place)
    for places in groups.values():
        frame = _make_blocks(
            masks[places[0]], time, length, step, product["window_coverage"].values[places[0][0]]
        )
        series = (
            np.stack([product[names[v]].values[a] for a, v in places], axis=1)[frame.windows]
            if frame
            else np.empty((0, len(places)))
        )
        for d, driver in enumerate(found):
            others_there = [product[name].values for name in others]
            for place, entry in zip(
                places,
                _fit_driver(
                    frame, series, driver, others_there, lags.astype(np.float64) * step, level
                ),
                strict=True,
            ):
                entries[(*place, d)] = entry
    _adjust_p_values(entries)
    for (a, v, d), entry in entries.items():
        entry["units"] = slope_units(str(product[names[v]].attrs.get("units", "1")), found[d].units)
        what = f"{names[v].replace('_', ' ')} of axis {product['axis'].values[a]}"
        entry["statement"] = describe_coupling(entry, found[d].label, what)
    return assemble(product, names, found, entries, level=level, longest=float(lags[-1] * step))


def _select_variables(product: xr.Dataset, variables: str | Sequence[str] | None) -> list[str]:
    if variables is None:
        seen = [
            term
            for term in TERMS
            if bool((product["observable"].sel(term=term) == OBSERVABLE.index("observed")).any())
        ]
        return ["window_mean", *seen]
    names = [variables] if isinstance(variables, str) else list(variables)
    for name in names:
        if name not in product or product[name].dims != ("axis", "time"):
            raise OptionError(
                f"variable {name!r} is not in the product by (axis, time); try window_mean, {', '.join(TERMS)}"
            )
    return names


def _window_lengths(product: xr.Dataset, time: Array) -> tuple[float, float]:
    """Length and step of the windows [s]."""
    bounds = product["time_bounds"].values
    length = (
        float(np.median(bounds[:, 1] - bounds[:, 0]) / np.timedelta64(1, "s"))
        if len(bounds)
        else 1.0
    )
    apart = float(np.median(np.diff(time))) if time.size > 1 else length
    return length, float(product.attrs.get("step_s", apart))


def _choose_lags(max_lag: Any, span: float, step: float) -> NDArray[np.int64]:
    longest = (
        0.1 * span if max_lag is None else duration_seconds(max_lag, "max_lag") if max_lag else 0.0
    )
    if longest > span:
        raise OptionError(
            f"max_lag {max_lag} is longer than the record ({span:g} s); give a shorter --max-lag"
        )
    most = int(longest / step + 1e-9)
    return np.unique(np.rint(np.linspace(0, most, min(most + 1, _MAX_LAGS))).astype(np.int64))


def _usable_windows(
    product: xr.Dataset, names: list[str], lags: NDArray[np.int64], found: list[Driver]
) -> tuple[dict[tuple[int, int], NDArray[np.bool_]], NDArray[np.int64], list[Driver]]:
    """Windows of each (axis, variable) in which series and driver are known at every lag; lags that cost over a third are left out."""
    known = np.logical_and.accumulate(
        np.isfinite(found[0].values) & np.isfinite(found[1].values), axis=0
    )
    most = int(np.flatnonzero(known.sum(axis=1) >= min(2 / 3 * known[0].sum(), known[0].sum()))[-1])
    lags = lags[: most + 1]
    found = [
        Driver(driver.name, driver.label, driver.units, driver.values[: most + 1])
        for driver in found
    ]
    masks = {}
    for v, name in enumerate(names):
        good = np.isfinite(product[name].values) & (product["window_coverage"].values > 0.05)
        if name in TERMS:
            good &= product["observable"].sel(term=name).values == OBSERVABLE.index("observed")
        for a in range(product.sizes["axis"]):
            masks[a, v] = good[a] & known[most]
    return masks, lags, found


def _make_blocks(
    mask: NDArray[np.bool_], time: Array, length: float, step: float, share: Array
) -> _Blocks | None:
    """Blocks of whole windows, as long as a window at least; None when there are too few."""
    windows = np.flatnonzero(mask)
    every = max(1, round(length / step / _MAX_WINDOWS_PER_LENGTH))
    windows = (
        windows[np.rint(time[windows] / step).astype(np.int64) % every == 0]
        if every > 1
        else windows
    )
    if windows.size < _MIN_BLOCKS:
        return None
    at = time[windows]
    hop = max(length, step, (np.count_nonzero(mask) * step) / _MAX_BLOCKS)
    numbers = np.unique((at / hop).astype(np.int64), return_inverse=True)[1]
    if numbers[-1] + 1 < _MIN_BLOCKS:
        return None
    average, centre, white = block_averages(numbers, at, length, np.clip(share[windows], 0.05, 1.0))
    apart = np.diff(centre)
    held = (numbers[-1] + 1) * hop
    pieces = np.concatenate([[0], np.cumsum(apart > max(3 * length + hop, 0.1 * held))])
    pieces = pieces.astype(np.int64)
    offsets = (pieces[:, None] == np.arange(pieces[-1] + 1)).astype(np.float64)
    trend = ((centre - centre.mean()) / (np.ptp(centre) or 1.0))[:, None]
    return _Blocks(average, windows, pieces, offsets, trend, noise_laws(centre, white))


def _fit_driver(
    frame: _Blocks | None,
    series: Array,
    driver: Driver,
    others: list[Array],
    lags: Array,
    level: float,
) -> list[dict[str, Any]]:
    """Every number of the entries of some series that share their windows, against one driver."""
    if frame is None:
        return [_empty_entry({"too_few"}) for _ in range(series.shape[1])]
    x = np.asarray(frame.average @ driver.values[:, frame.windows].T)
    y = np.asarray(frame.average @ series)
    limits = driver_limits(
        x[:, 0], frame.pieces, driver.units, derived=driver.name.endswith("_rate")
    )
    timed = np.concatenate([frame.offsets, frame.trend], axis=1)
    nuisance = frame.offsets if "no_reversal" in limits else timed
    if not limits & {"constant", "too_few"}:
        if (
            x.shape[0] - nuisance.shape[1] - 1 < _MIN_BLOCKS // 2
        ):  # nearly every block is a stretch of its own
            limits = limits | {"too_few"}
        elif _largest_leverage(x[:, 0], nuisance) > _MAX_LEVERAGE:
            limits = limits | {"one_moment"}
    if limits & {"constant", "too_few", "one_moment"}:
        return [_empty_entry(limits, windows=frame.windows.size) for _ in range(series.shape[1])]
    others = [
        np.asarray(frame.average @ np.nan_to_num(row[frame.windows]))
        for row in others
        if np.isfinite(row[frame.windows]).all()
    ]
    more = np.concatenate(
        [timed, *(_standardise_series(row)[:, None] for row in others if np.ptp(row) > 0)], axis=1
    )
    laws = project_out(frame.laws, nuisance)
    alone = (
        project_out(decompose([_law_covariance(frame, 0)], np.zeros(1)), nuisance)
        if "no_reversal" in limits
        else None
    )
    entries = []
    for row in y.T:
        if np.ptp(row) == 0.0:
            entries.append(_empty_entry(limits | {"too_few"}, windows=frame.windows.size))
            continue
        entry = _estimate_sensitivity(laws, row, x, lags, level) | {
            "limits": set(limits),
            "windows": frame.windows.size,
        }
        column = x[:, entry["best"]]
        entry |= {
            "correlation": _partial_correlation(row, column, np.ones((row.size, 1))),
            "partial_time": _partial_correlation(row, column, timed),
            "partial_channels": _partial_correlation(row, column, more),
            "effective": _effective_samples(row, column, nuisance, entry["stderr"]),
        }
        entry |= _fit_ramps(frame, entry["law"], nuisance, row[:, None], column[:, None])
        if alone is not None:
            white = _estimate_sensitivity(alone, row, x, lags, level)
            entry |= {
                f"{key}_white": white[other]
                for key, other in (("p", "p_search"), ("slope", "slope"), ("lag", "lag"))
            }
        if timed.shape[1] < more.shape[1] < row.size - 3:
            again = fit_lags(
                project_out(frame.laws, more),
                row[:, None] / np.std(row),
                _standardise_series(column)[:, None],
            )
            entry["p_channels"] = float(p_values(again)[0, 0])
        entries.append(entry)
    return entries


def _estimate_sensitivity(
    laws: Laws, y: Array, x: Array, lags: Array, level: float
) -> dict[str, Any]:
    """Lag, slope and interval of one series, and how often noise alone would do as much: at that lag, and at any.

    The noise is simulated under the laws by their weights. The interval leaves out 0 where the
    p-value at that lag is below one less the level, and nowhere else.
    """
    scale, reach = float(np.std(y)), np.maximum(np.std(x, axis=0), 1e-300)
    driver = (x - x.mean(axis=0)) / reach
    fit = fit_lags(laws, ((y - y.mean()) / scale)[:, None], driver)
    p = p_values(fit)[0]
    best = int(np.argmin(p))
    few = np.unique(
        np.append(
            np.linspace(0, lags.size - 1, min(lags.size, _MAX_SIMULATED_LAGS)).astype(np.int64),
            best,
        )
    )
    for draws in _NOISE_DRAWS:
        chance = simulate_p_values(laws, driver[:, few], null_weights(fit, 0), draws)
        alone = chance[:, np.searchsorted(few, best)]
        single = calibrated(float(p[best]), alone)
        search = max(single, calibrated(float(p[best]), chance.min(axis=1)))
        if search > _SIGNIFICANCE:
            break
    found = slope_interval(fit, 0, best, uncalibrated(1.0 - level, alone))
    slope, error, low, high = (value * scale / float(reach[best]) for value in found)
    entry = {
        "best": best,
        "lag": float(lags[best]),
        "law": int(np.argmax(weights(fit)[:, 0, best])),
        "p_value": single,
        "p_search": search,
    }
    return entry | {"slope": slope, "stderr": error, "low": low, "high": high}


def _law_covariance(frame: _Blocks, law: int) -> Array:
    return np.asarray(frame.laws.factor[law] @ frame.laws.factor[law].T)


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
    """Largest share of one block in the variance of the driver."""
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
    """Number of independent samples whose ordinary regression would have this standard error; at most the blocks there are."""
    q, _ = np.linalg.qr(np.concatenate([nuisance, x[:, None]], axis=1))
    rest = y - q @ (q.T @ y)
    q, _ = np.linalg.qr(nuisance)
    left = x - q @ (q.T @ x)
    wanted = (
        float(rest.var() / (max(float(left.var()), 1e-300) * error**2)) if error > 0 else np.inf
    )
    return float(min(y.size, wanted + nuisance.shape[1] + 1))


def _fit_ramps(frame: _Blocks, law: int, nuisance: Array, y: Array, x: Array) -> dict[str, float]:
    """Slope while the driver rises and while it falls, each with a constant of its own."""
    up = np.gradient(x[:, 0]) > 0
    covariance = _law_covariance(frame, law)
    out = {}
    for name, part in (("rising", up), ("falling", ~up)):
        keep = np.flatnonzero(part)
        out[name] = out[f"{name}_stderr"] = np.nan
        columns = nuisance[keep][:, 1:]  # the offsets of all stretches add up to the constant
        columns = np.concatenate(
            [
                np.ones((keep.size, 1)),
                columns[:, np.ptp(columns, axis=0) > 0] if keep.size else columns,
            ],
            axis=1,
        )
        if keep.size < _MIN_BLOCKS // 2 + columns.shape[1] or np.ptp(x[keep]) < 0.1 * np.ptp(x):
            continue
        if (
            np.linalg.matrix_rank(
                np.concatenate([columns, _standardise_series(x[keep, 0])[:, None]], axis=1)
            )
            <= columns.shape[1]
        ):
            continue
        fit = fit_lags(
            project_out(decompose([covariance[np.ix_(keep, keep)]], np.zeros(1)), columns),
            y[keep],
            x[keep],
        )
        out[name], out[f"{name}_stderr"] = float(fit.slope[0, 0, 0]), float(fit.stderr[0, 0, 0])
    return out


def _adjust_p_values(entries: dict[tuple[int, int, int], dict[str, Any]]) -> None:
    """Allow for all the entries by Holm's steps, and give every entry its verdict."""
    tested = sorted(
        (entry for entry in entries.values() if np.isfinite(entry["p_search"])),
        key=lambda entry: float(entry["p_search"]),
    )
    before = 0.0
    for rank, entry in enumerate(tested):
        before = entry["p_adjusted"] = min(
            1.0, max(before, (len(tested) - rank) * entry["p_search"])
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
            if entry.get("p_channels", 0.0) >= _SIGNIFICANCE:
                entry["limits"].add("other_channel")
            verdict = (
                "not_told_apart"
                if entry["limits"] & {"no_reversal", "other_channel"}
                else "coupled"
            )
        entry["verdict"] = VERDICTS.index(verdict)
